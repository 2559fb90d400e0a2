"""Active sets: sweeps that leave alone what nothing has changed end where sweeps over all particles end."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles import search
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import SMALLEST_GAIN, Observation
from lfpiv_cli.particles.search import Task, blank, disturbance, noise_with, observed, overlaps_of, rebuilt, sweep
from tests.particle_images import task_with

SWEEPS = 6


@pytest.fixture(scope="module")
def true() -> NDArray[np.float64]:
    return np.random.default_rng(3).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))


@pytest.fixture(scope="module")
def task(table2: Camera, water: Media, true: NDArray[np.float64]) -> Task:
    return task_with(table2, water, true, np.random.default_rng(4))


def begun(task: Task, true: NDArray[np.float64]) -> search.State:
    """Return the state with particles a little beside where they are."""
    off = np.random.default_rng(5).normal(size=true.shape) * (0.005, 0.005, 0.03, 1e4)
    state = rebuilt(task, blank(task), true + off)
    return search.replace(state, noise=noise_with(task, 5e5))


@pytest.mark.thorough
def test_sweeps_end_where_those_over_all_particles_end(
    task: Task, true: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    every, some, fitted = begun(task, true), begun(task, true), []

    def counted(
        observation: Observation,
        particles: NDArray[np.float64],
        enough: float,
        chosen: NDArray[np.bool_],
        prior: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        fitted.append(np.count_nonzero(chosen))
        return refine(observation, particles, enough, chosen, prior)

    for _ in range(SWEEPS):
        refine(observed(task, every, 0.05), every.particles, SMALLEST_GAIN)
    monkeypatch.setattr(search, "refine", counted)
    sweep(task, some, 0.05, SWEEPS, SMALLEST_GAIN)
    assert fitted[0] == len(true)
    assert fitted[-1] < 0.6 * len(true)
    # What ends a fit is a tenth of a standard error, and here one is 1e-4 mm laterally, 1e-3 mm in depth, 500 counts.
    np.testing.assert_allclose((some.particles - every.particles) / (1e-4, 1e-4, 1e-3, 500.0), 0.0, atol=0.2)
    np.testing.assert_allclose(some.residual, task.image - light_of(task, some.particles), atol=1e-6)


def light_of(task: Task, particles: NDArray[np.float64]) -> NDArray[np.float64]:
    image = np.zeros_like(task.image)
    add_all(task.view, particles, 1.0, image, task.depths_mm)
    return image


@pytest.mark.thorough
def test_a_fit_s_gain_is_what_chi_squared_falls_by(task: Task, true: NDArray[np.float64]) -> None:
    state = begun(task, true)
    observation = observed(task, state, 0.05)
    chosen = np.arange(len(true)) == 7
    before = np.sum(observation.weight * state.residual**2)
    gain = refine(observation, state.particles, SMALLEST_GAIN, chosen)
    assert gain[7] == pytest.approx(before - np.sum(observation.weight * state.residual**2), rel=1e-6)
    assert gain[7] > 10.0
    assert not gain[~chosen].any()


def test_particles_disturb_those_whose_light_they_share(task: Task) -> None:
    # One on the other, one beside them, one in focus within a wide one's light, and one far away.
    particles = np.array(
        [[0.0, 0.0, 2.0, 1.0], [0.0, 0.0, 2.0, 1.0], [0.1, 0.0, 2.0, 1.0], [0.0, 0.05, 1.0, 1.0], [0.9, 0.7, 1.0, 1.0]]
    )
    overlaps = overlaps_of(task.view, particles)
    seen = np.array([disturbance(overlaps, 10.0 * one) for one in np.eye(5)])
    assert seen[0, 1] == seen[1, 0] == 10.0
    assert not seen.diagonal().any()
    assert seen[0, 1] > seen[0, 2] > 0.0
    assert seen[0, 1] > seen[0, 3] > 0.0
    assert not seen[4].any()
    np.testing.assert_array_equal(disturbance(overlaps, np.full(5, 10.0)), seen.sum(axis=0))
    common = [light_of(task, particles[[n]]) @ light_of(task, particles[[4]]) for n in range(4)]
    assert not np.any(common)
