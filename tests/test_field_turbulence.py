"""Figures of turbulence: of fields whose figures are known, and what the field's errors do to them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.field_tracks import tracks_of
from lfpiv_cli.fields.spline_field import gradient_covariance_at, spline_field
from lfpiv_cli.fields.stencils import Lattice, rows_of
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.flow.field import (
    dissipation,
    fluctuations,
    kinetic_energy,
    reynolds_stresses,
    spectrum,
)
from lfpiv_cli.synthetic.flows import taylor_green

NONE = np.zeros((1, 9, 9))


def test_fluctuations_are_off_the_mean_over_the_axes_that_are_named(rng):
    velocity = rng.normal(size=(4, 2, 3, 5, 3))
    np.testing.assert_allclose(fluctuations(velocity, (0,)).mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(fluctuations(velocity, (1, 3)).mean(axis=(1, 3)), 0.0, atol=1e-12)
    velocity[0, 0, 0, 0] = np.nan
    assert np.isnan(fluctuations(velocity, (0,))).sum() == 3


def test_reynolds_stresses_are_those_of_the_flow(rng):
    true = rng.multivariate_normal(np.zeros(3), [[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]], 20000)
    # a fit is what the flow would be expected to be, and the flow lies about it
    fitted, true = true, true + rng.normal(0.0, 0.7, true.shape)
    found = reynolds_stresses(fitted, np.full(true.shape, 0.49))
    # of 20000 draws a variance of 4 is known to 0.04
    np.testing.assert_allclose(found, true.T @ true / len(true), atol=0.15)
    assert kinetic_energy(found) == pytest.approx(0.5 * np.trace(found))


def test_dissipation_of_shear_is_viscosity_times_its_square():
    gradient = np.zeros((1, 3, 3))
    gradient[0, 0, 1] = 5.0
    assert dissipation(gradient, NONE, 1e-6, 1.0)[0] == pytest.approx(1e-6 * 25.0)


def test_rotation_dissipates_nothing():
    gradient = np.array([[[0.0, -3.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    assert dissipation(gradient, NONE, 1e-6, 1.0)[0] == 0.0


def test_dissipation_has_what_the_fit_lacks_put_on(rng):
    fitted = rng.normal(size=(3, 3))
    root = 0.8 * rng.normal(size=(9, 9))
    flow = (fitted.ravel() + rng.normal(size=(20000, 9)) @ root.T).reshape(-1, 3, 3)
    strain = 0.5 * (flow + flow.swapaxes(1, 2))
    squares = np.sum(strain**2, axis=(1, 2))
    covariance = np.broadcast_to(root @ root.T, (20000, 9, 9))
    rate, _ = dissipation(np.broadcast_to(fitted, flow.shape), covariance, 0.5, 20000.0)
    # of 20000 draws
    assert abs(rate - np.mean(squares)) < 4.0 * np.std(squares) / np.sqrt(20000.0)
    assert rate > np.sum((0.5 * (fitted + fitted.T)) ** 2)


def test_the_spectrum_sums_up_to_the_kinetic_energy(rng):
    field = rng.normal(size=(16, 16, 20, 3))
    found = spectrum(field, (0.5, 0.5, 0.5))
    window = [np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in (16, 16, 20)]
    square = np.einsum("i,j,k->ijk", *(each**2 / np.mean(each**2) for each in window))
    energy = 0.5 * np.mean(square * np.sum(field**2, axis=-1))
    assert np.sum(found.energy) * found.width == pytest.approx(energy, rel=1e-12)
    # white noise of 16,000 numbers under a window of an effective tenth of them
    assert energy == pytest.approx(1.5, rel=0.15)


def test_the_energy_of_a_wave_lies_at_its_wavenumber():
    z = np.arange(32) * 0.5
    field = np.zeros((32, 16, 16, 3))
    field[..., 1] = np.sin(2.0 * np.pi * z / 4.0)[:, np.newaxis, np.newaxis]
    found = spectrum(field, (0.5, 0.5, 0.5))
    near = np.abs(found.wavenumber - 2.0 * np.pi / 4e-3) < 1.5 * found.width
    assert np.sum(found.energy[near]) > 0.95 * np.sum(found.energy)


def test_a_thin_grid_has_no_spectrum():
    with pytest.raises(ValueError, match="needs 4 planes"):
        spectrum(np.zeros((3, 8, 8, 3)), (1.0, 1.0, 1.0))


def small_field(rng):
    tracks = tracks_of(taylor_green(0.1, 10.0), 150, rng, (8.0, 4.0, 4.0))
    samples = Samples(tracks.middle_mm, tracks.displacement_mm, tracks.covariance_mm2, np.ones(150))
    lattice = Lattice.over(samples.points_mm.min(axis=0), samples.points_mm.max(axis=0), 1.9)
    return spline_field(samples, lattice, "penalised", rng, np.zeros((0, 3)))


@pytest.mark.thorough
def test_gradients_vary_by_their_coefficients(rng):
    """The covariance of differences of the field, by a dense inverse that is put together from its blocks."""
    field = small_field(rng)
    diagonal, below = field.covariance
    plane = int(np.prod(field.lattice.shape[1:]))
    point = np.array([[0.3, -0.4, 0.7]])
    found = gradient_covariance_at(field, point)[0]
    assert np.linalg.eigvalsh(found).min() > 0.0
    for component in range(3):
        for axis in range(3):
            columns, slopes = rows_of(field.lattice, point, axis)
            planes, within = columns[0] // plane, columns[0] % plane
            rows = (planes * 3 + component) * plane + within
            whole = np.zeros((len(rows), len(rows)))
            length = len(diagonal[0])
            for i, row in enumerate(rows):
                for j, column in enumerate(rows):
                    high, low = max(row, column), min(row, column)
                    block = diagonal[high // length] if high // length == low // length else below[low // length]
                    whole[i, j] = block[high % length, low % length]
            assert found[3 * component + axis, 3 * component + axis] == pytest.approx(slopes[0] @ whole @ slopes[0])
