"""Recall, precision and errors of particles on lists whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.validation.volume import match, particle_figures

LOW, HIGH = np.zeros(3), np.full(3, 5.0)


def test_each_true_particle_is_matched_once() -> None:
    true = np.array([[1.0, 1.0, 1.0]])
    found = np.array([[1.02, 1.0, 1.0], [1.01, 1.0, 1.0]])
    pairs = match(found, true, 0.1)
    assert pairs.found.tolist() == [1]
    np.testing.assert_allclose(pairs.error_voxel, [[0.1, 0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize(("offset", "matched"), [((0.049, 0, 0.19), 1), ((0.04, 0.04, 0), 0), ((0, 0, 0.21), 0)])
def test_limits_are_half_a_voxel_and_two_in_depth(offset: tuple[float, float, float], matched: int) -> None:
    true = np.array([[1.0, 1.0, 1.0]])
    assert len(match(true + offset, true, 0.1).found) == matched


def test_figures_of_a_known_list(rng: np.random.Generator) -> None:
    true = rng.uniform(LOW, HIGH, (1000, 3))
    error = rng.normal((0.0, 0.0, 0.01), (0.002, 0.004, 0.02), true.shape)
    found = np.concatenate([(true + error)[:900], rng.uniform(LOW, HIGH, (100, 3))])
    figures = particle_figures(found, true, LOW, HIGH, 0.1)
    # A hundred missing, a hundred invented, some of which meet a true one by chance; three standard errors.
    assert figures["recall"] == pytest.approx(0.9, abs=0.01)
    assert figures["precision"] == pytest.approx(0.9, abs=0.01)
    assert figures["bias_z_voxel"] == pytest.approx(0.1, abs=0.03)
    assert figures["spread_x_voxel"] == pytest.approx(0.02, rel=0.15)
    assert figures["spread_y_voxel"] == pytest.approx(0.04, rel=0.15)


def test_particles_outside_the_volume_count_for_nothing() -> None:
    true = np.array([[1.0, 1.0, 1.0], [6.0, 1.0, 1.0]])
    figures = particle_figures(np.array([[1.0, 1.0, 1.0], [7.0, 1.0, 1.0]]), true, LOW, HIGH, 0.1)
    assert figures["recall"] == figures["precision"] == 1.0


def test_coverage_and_depths_are_those_asked_for(rng: np.random.Generator) -> None:
    true = rng.uniform((0.0, 0.0, -5.0), (50.0, 50.0, 5.0), (2000, 3))
    near = np.abs(true[:, 2]) < 2.0
    sigma = np.full(true.shape, 0.002)
    found = true + np.where(near[:, np.newaxis], 3.0, 1.0) * rng.normal(0.0, sigma)
    found = found[~near | (rng.uniform(size=2000) < 0.5)]
    bounds = np.array([0.0, 0.0, -5.0]), np.array([50.0, 50.0, 5.0])
    inner, outer = (
        particle_figures(found, true, *bounds, 0.1, sigma[: len(found)], band) for band in ((0.0, 2.0), (2.0, np.inf))
    )
    # Within 1.96/3 standard deviations lie 48.6 %; three standard errors of 400 and of 1,200 particles.
    assert inner["coverage_z"] == pytest.approx(0.486, abs=0.08)
    assert outer["coverage_z"] == pytest.approx(0.95, abs=0.02)
    assert inner["recall"] == pytest.approx(0.5, abs=0.06)
    assert outer["recall"] > 0.995
