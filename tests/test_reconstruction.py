"""Solvers: Eq. 12 against its loops, fixed points, falling residuals, guarded sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.microlenses import Lattice
from lfpiv_cli.reconstruction.images import light, minimum_background
from lfpiv_cli.reconstruction.solvers import SOLVERS, Momentum, Problem, normalisers, reconstruct, sart_step
from lfpiv_cli.weights.build import factorise


class DenseOperator:
    """Weights as a plain matrix (pixels, voxels) on a 1 x 1 x n volume and a 1 x m image."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = matrix.astype(np.float32)
        self.shape = (1, 1, matrix.shape[1])

    def forward(self, volume: np.ndarray) -> np.ndarray:
        return (self.matrix @ volume.ravel())[np.newaxis]

    def adjoint(self, image: np.ndarray) -> np.ndarray:
        return (self.matrix.T @ image.ravel()).reshape(self.shape)


@pytest.fixture
def dense(rng) -> DenseOperator:
    return DenseOperator(rng.random((9, 5)) * (rng.random((9, 5)) < 0.6))


@pytest.fixture
def optical(table2, water):
    camera = replace(table2, columns=220, rows=200, lattice=Lattice.regular(0.1))
    return factorise(camera, water, Grid.centred((8, 7, 6), (0.1, 0.1, 0.5), (0.0, 0.0, 2.0)))


def test_sart_step_is_eq_12_written_as_loops(dense, rng):
    w, image, volume = dense.matrix, rng.random(9), rng.random(5)
    expected = volume.copy()
    for j in range(5):
        numerator = denominator = 0.0
        for i in range(9):
            row_sum = sum(w[i, n] for n in range(5))
            if row_sum > 0:
                numerator += (image[i] - sum(w[i, n] * volume[n] for n in range(5))) / row_sum * w[i, j]
                denominator += w[i, j]
        expected[j] += 0.7 * numerator / denominator
    sums = normalisers(dense)
    problem = Problem(dense, image[np.newaxis].astype(np.float32), sums.inverse_row_sum, sums.inverse_column_sum)
    start = volume.reshape(dense.shape).astype(np.float32)
    stepped = sart_step(problem, start, dense.forward(start), relaxation=0.7)
    np.testing.assert_allclose(stepped.ravel(), np.maximum(expected, 0.0), rtol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_true_volume_is_a_fixed_point(optical, rng, solver):
    truth = rng.random(optical.shape, dtype=np.float32)
    sums = normalisers(optical)
    image = optical.forward(truth)
    problem = Problem(optical, image, sums.inverse_row_sum, sums.inverse_column_sum)
    seen = sums.inverse_column_sum > 0
    stepped = SOLVERS[solver](problem, truth, image, 1.0)
    # Pixels below the guard are left out of numerator and denominator alike, so only float32 rounding remains.
    np.testing.assert_allclose(stepped[seen], truth[seen], rtol=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
def test_residual_falls_and_volume_stays_non_negative(optical, rng, solver):
    truth = np.zeros(optical.shape, np.float32)
    truth[rng.integers(0, 6, 8), rng.integers(0, 7, 8), rng.integers(0, 8, 8)] = 100.0
    result = reconstruct(optical, optical.forward(truth), solver, iterations=30)
    assert np.all(np.diff(result.residual) < 0)
    assert result.residual[-1] < 0.5 * result.residual[0]
    assert result.volume.min() >= 0.0


def test_pixels_and_voxels_out_of_sight_take_no_part():
    matrix = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]])
    image = np.array([[2.0, 3.0, 50.0]], np.float32)  # the third pixel is lit by nothing in the volume
    for solver in SOLVERS:
        volume = reconstruct(DenseOperator(matrix), image, solver, iterations=400).volume.ravel()
        np.testing.assert_allclose(volume, [2.0, 4.0, 0.0], rtol=0.02)


@pytest.mark.parametrize("solver", SOLVERS)
def test_dark_image_gives_an_empty_volume(optical, solver):
    result = reconstruct(optical, np.full(optical.image_shape, -3.0, np.float32), solver, iterations=3)
    assert not result.volume.any()
    assert np.all(np.isfinite(result.residual))


def test_light_takes_off_dark_or_background_and_survives_broken_pixels():
    image = np.array([[10.0, np.nan], [7.0, 3.0]], np.float32)
    dark = np.full((2, 2), 4.0, np.float32)
    np.testing.assert_array_equal(light(image, dark), [[6.0, 0.0], [3.0, -1.0]])
    np.testing.assert_array_equal(light(image, dark, dark + 1), [[5.0, 0.0], [2.0, -2.0]])
    with pytest.raises(InputError, match="does not fit"):
        light(image, dark[:1])


def test_minimum_background_needs_two_images_of_one_shape():
    a, b = np.array([[1.0, 5.0]]), np.array([[2.0, 3.0]])
    np.testing.assert_array_equal(minimum_background([a, b]), [[1.0, 3.0]])
    with pytest.raises(InputError, match="at least two"):
        minimum_background([a])
    with pytest.raises(InputError, match="differ in shape"):
        minimum_background([a, b.T])


@pytest.mark.parametrize("solver", SOLVERS)
def test_momentum_reaches_the_same_residual_in_fewer_steps(optical, rng, solver):
    truth = np.zeros(optical.shape, np.float32)
    truth[rng.integers(0, 6, 8), rng.integers(0, 7, 8), rng.integers(0, 8, 8)] = 100.0
    image = optical.forward(truth)
    plain = reconstruct(optical, image, solver, iterations=60)
    fast = reconstruct(optical, image, solver, iterations=20, accelerate=True)
    assert fast.residual[-1] < plain.residual[-1]
    assert fast.volume.min() >= 0.0


def test_momentum_restarts_where_a_step_points_back():
    volume = np.array([[[1.0, 2.0]]], np.float32)
    ahead = Momentum(5.0).extrapolated(volume, volume - 1, volume)
    back = Momentum(5.0).extrapolated(volume + 1, volume - 1, volume)
    pace = 0.5 * (1.0 + np.sqrt(101.0))
    np.testing.assert_allclose(ahead[1], volume + 4.0 / pace, rtol=1e-6)
    np.testing.assert_array_equal(back[1], volume)
    assert back[0].pace < ahead[0].pace
