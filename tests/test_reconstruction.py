"""Solvers: Eq. 12 against its loops, fixed points, falling residuals, guarded sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.reconstruction import solvers
from lfpiv_cli.reconstruction.registry import SOLVERS
from lfpiv_cli.reconstruction.solvers import (
    Momentum,
    Problem,
    SolverSettings,
    Stopping,
    line_of_sight_start,
    lit_support,
    mart_step,
    normalisers,
    reconstruct,
    sart_step,
    smart_step,
)
from lfpiv_cli.weights.build import factorise


class DenseOperator:
    """Weights as a plain matrix (pixels, voxels) on a 1 x 1 x n volume and a 1 x m image.

    Not by BLAS: its kernels read beyond rows as short as these, and may raise flags of what happens to lie there.
    """

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = matrix.astype(np.float32)
        self.shape = (1, 1, matrix.shape[1])

    def forward(self, volume: np.ndarray) -> np.ndarray:
        return np.einsum("pv,v->p", self.matrix, volume.ravel())[np.newaxis]

    def adjoint(self, image: np.ndarray) -> np.ndarray:
        return np.einsum("pv,p->v", self.matrix, image.ravel()).reshape(self.shape)


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
    problem = Problem(dense, image[np.newaxis].astype(np.float32), normalisers(dense))
    start = volume.reshape(dense.shape).astype(np.float32)
    stepped = sart_step(problem, start, dense.forward(start), relaxation=0.7)
    np.testing.assert_allclose(stepped.ravel(), np.maximum(expected, 0.0), rtol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_true_volume_is_a_fixed_point(optical, rng, solver):
    truth = rng.random(optical.shape, dtype=np.float32)
    sums = normalisers(optical)
    image = optical.forward(truth)
    problem = Problem(optical, image, sums)
    seen = sums.inverse_column_sum > 0
    stepped = SOLVERS[solver].step()(problem, truth, image, 1.0)
    # Pixels below the guard are left out of numerator and denominator alike, so only float32 rounding remains.
    np.testing.assert_allclose(stepped[seen], truth[seen], rtol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("solver", SOLVERS)
def test_residual_falls_and_volume_stays_non_negative(optical, rng, solver):
    truth = np.zeros(optical.shape, np.float32)
    truth[rng.integers(0, 6, 8), rng.integers(0, 7, 8), rng.integers(0, 8, 8)] = 100.0
    result = reconstruct(optical, optical.forward(truth), SolverSettings(solver, 12))
    assert np.all(np.diff(result.residual) < 0)
    assert result.residual[-1] < 0.5 * result.residual[0]
    assert result.volume.min() >= 0.0


def test_mart_takes_its_pixels_in_turn(dense, rng):
    # On a 1 x 9 image the blocks of four columns are the pixels 0, 4, 8, then 1, 5, and so on.
    w, image, volume = dense.matrix, rng.random(9) + 0.5, rng.random(5) + 0.5
    expected = volume.copy()
    for first in range(4):
        block = [i for i in range(first, 9, 4) if w[i].sum() > 0]
        now = expected.copy()
        largest = max(sum(w[i, j] for i in block) for j in range(5))
        for j in range(5):
            exponent = sum(w[i, j] * np.log(image[i] / (w[i] @ now)) for i in block)
            expected[j] *= np.exp(0.8 * exponent / largest)
    problem = Problem(dense, image[np.newaxis].astype(np.float32), normalisers(dense))
    start = volume.reshape(dense.shape).astype(np.float32)
    np.testing.assert_allclose(mart_step(problem, start, dense.forward(start), 0.8).ravel(), expected, rtol=1e-4)


def test_smart_multiplies_by_the_geometric_mean_of_the_ratios(dense, rng):
    w, image, volume = dense.matrix, rng.random(9) + 0.5, rng.random(5) + 0.5
    ratio = np.divide(image, w @ volume, out=np.ones(9), where=w.sum(axis=1) > 0)
    expected = volume * np.prod(ratio[:, np.newaxis] ** w, axis=0) ** (0.8 / w.sum(axis=0))
    problem = Problem(dense, image[np.newaxis].astype(np.float32), normalisers(dense))
    start = volume.reshape(dense.shape).astype(np.float32)
    np.testing.assert_allclose(smart_step(problem, start, dense.forward(start), 0.8).ravel(), expected, rtol=1e-4)


@pytest.mark.parametrize("accelerate", [False, True])
@pytest.mark.parametrize("solver", ["sart", "em", "smart"])
def test_excluded_pixels_are_deleted_rows(dense, rng, solver, accelerate):
    image = (dense.matrix @ rng.random(5) * rng.uniform(0.8, 1.2, 9)).astype(np.float32)
    excluded = np.array([False, True, False, False, True, False, False, False, False])
    spoilt = np.where(excluded, np.float32(65535.0), image)[np.newaxis]
    fewer = DenseOperator(dense.matrix[~excluded])
    settings = SolverSettings(solver, 12, accelerate=accelerate)
    expected = reconstruct(fewer, image[np.newaxis, ~excluded], settings)
    for sums in (
        normalisers(dense, excluded[np.newaxis]),
        normalisers(dense).without(dense, excluded[np.newaxis]),
    ):
        found = reconstruct(dense, spoilt, settings, sums=sums)
        np.testing.assert_allclose(found.volume, expected.volume, rtol=1e-4)
        np.testing.assert_allclose(found.residual, expected.residual, rtol=1e-4)


@pytest.mark.parametrize("solver", ["sart", "em", "smart"])
def test_voxels_out_of_the_support_are_deleted_columns(dense, rng, solver):
    image = (dense.matrix @ rng.random(5)).astype(np.float32)[np.newaxis]
    support = np.array([True, False, True, True, False])
    expected = reconstruct(DenseOperator(dense.matrix[:, support]), image, SolverSettings(solver, 12)).volume
    sums = normalisers(dense).within(dense, support.reshape(dense.shape))
    found = reconstruct(dense, image, SolverSettings(solver, 12), sums=sums)
    np.testing.assert_allclose(found.volume.ravel()[support], expected.ravel(), rtol=1e-4)
    assert not found.volume.ravel()[~support].any()
    assert found.support_voxels == 3


def test_line_of_sight_start_is_the_geometric_mean_of_what_pixels_allow(dense, rng):
    w, image = dense.matrix, rng.random(9) + 0.5
    seen = w.sum(axis=1) > 0
    level = image[seen] / w[seen].sum(axis=1)
    expected = np.prod(level[:, np.newaxis] ** w[seen], axis=0) ** (1.0 / w.sum(axis=0))
    start = line_of_sight_start(Problem.of(dense, image[np.newaxis].astype(np.float32), normalisers(dense))).ravel()
    np.testing.assert_allclose(start / start[0], expected / expected[0], rtol=1e-4)
    assert (w @ start)[seen].sum() == pytest.approx(image[seen].sum(), rel=1e-4)


def test_line_of_sight_leaves_dark_voxels_out_for_good(optical):
    truth = np.zeros(optical.shape, np.float32)
    truth[2, 3, 4] = 100.0
    image = optical.forward(truth)
    sums = normalisers(optical)
    support = lit_support(optical, image, sums)
    assert support[2, 3, 4]
    assert support.sum() < 0.5 * support.size
    start = line_of_sight_start(Problem(optical, image, sums))
    assert np.unravel_index(start.argmax(), start.shape) == (2, 3, 4)
    assert start.sum() == pytest.approx(100.0, rel=0.05)
    # voxels of the support do not light the whole sensor: the pixels they miss are left out with the others
    volume = reconstruct(optical, image, SolverSettings("sart", 20, start="line_of_sight")).volume
    assert not volume[~support].any()
    assert volume[2, 3, 4] == volume.max()


@pytest.mark.thorough
def test_stopping_by_change_and_by_residual(optical, rng):
    image = optical.forward(rng.random(optical.shape, dtype=np.float32))
    whole = reconstruct(optical, image, SolverSettings("em", 60))
    relative = 1.0 - whole.residual[1:] / whole.residual[:-1]
    first = int(np.argmax(relative < 0.02))
    by_change = reconstruct(optical, image, SolverSettings("em", 60, stopping=Stopping(change=0.02)))
    np.testing.assert_array_equal(by_change.residual, whole.residual[: first + 2])
    limit = float(whole.residual[7])
    by_residual = reconstruct(optical, image, SolverSettings("em", 60, stopping=Stopping(residual=limit)))
    np.testing.assert_array_equal(by_residual.residual, whole.residual[:8])


def test_pixels_and_voxels_out_of_sight_take_no_part():
    matrix = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]])
    image = np.array([[2.0, 3.0, 50.0]], np.float32)  # the third pixel is lit by nothing in the volume
    for solver in SOLVERS:
        volume = reconstruct(DenseOperator(matrix), image, SolverSettings(solver, 400)).volume.ravel()
        np.testing.assert_allclose(volume, [2.0, 4.0, 0.0], rtol=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize("solver", SOLVERS)
def test_dark_image_gives_an_empty_volume(optical, solver):
    result = reconstruct(optical, np.full(optical.image_shape, -3.0, np.float32), SolverSettings(solver, 3))
    assert not result.volume.any()
    assert np.all(np.isfinite(result.residual))


@pytest.mark.thorough
@pytest.mark.parametrize("solver", SOLVERS)
def test_momentum_reaches_the_same_residual_in_fewer_steps(optical, rng, solver):
    truth = np.zeros(optical.shape, np.float32)
    truth[rng.integers(0, 6, 8), rng.integers(0, 7, 8), rng.integers(0, 8, 8)] = 100.0
    image = optical.forward(truth)
    plain = reconstruct(optical, image, SolverSettings(solver, 24))
    fast = reconstruct(optical, image, SolverSettings(solver, 12, accelerate=True))
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


def test_kernels_are_their_array_twins(rng):
    image, projection = rng.random((2, 7, 5), dtype=np.float32)
    inverse = rng.random((7, 5), dtype=np.float32) * (rng.random((7, 5)) < 0.7).astype(np.float32)
    projection[2, 3] = 0.0
    inverse[2, 3] = 1.0
    np.testing.assert_array_equal(solvers.correction(image, projection, inverse), (image - projection) * inverse)
    lit = (projection > 0.0) & (inverse > 0.0)
    expected = np.divide(image, projection, out=np.zeros_like(image), where=lit)
    np.testing.assert_array_equal(solvers.ratio(image, projection, inverse), expected)
    squares = np.where(inverse > 0.0, (image - projection).astype(np.float64) ** 2, 0.0).sum(axis=1)
    np.testing.assert_allclose(solvers.square_differences(image, projection, inverse), squares, rtol=1e-14)
