"""Particles that the frames before predict: refined where they are, dropped where they are not, the rest searched."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.neighbour_frames import Predicted, find_predicted
from lfpiv_cli.particles.search import Task
from tests.particle_images import found, task_with

# How far off predictions are: a fifth of a microlens, a tenth of a millimetre of depth and some percent of light.
OFF = np.array([0.01, 0.01, 0.05, 0.03])
NEW = 3
# Whom nothing shows but an overlapping one that nobody expected.
BESIDE = np.array([0.03, -0.02, 0.2, 0.0])


@pytest.fixture(scope="module")
def true() -> NDArray[np.float64]:
    """Return particles; the last has come in beside the first, an overlapping one."""
    places = np.random.default_rng(3).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    places[-1] = places[0] + BESIDE
    return places


@pytest.fixture(scope="module")
def task(table2: Camera, water: Media, true: NDArray[np.float64]) -> Task:
    return task_with(table2, water, true, np.random.default_rng(4))


def predicted(particles: NDArray[np.float64], seed: int = 5) -> Predicted:
    """Return particles as tracks predict them: off by what they state."""
    noise = np.random.default_rng(seed).normal(size=particles.shape)
    off = particles + noise * OFF * np.column_stack([np.ones((len(particles), 3)), particles[:, 3]])
    sigma = np.tile(OFF[:3], (len(particles), 1))
    return Predicted(off, sigma, float(OFF[3]))


@pytest.mark.thorough
def test_what_is_predicted_is_found_and_so_is_the_rest(task: Task, true: NDArray[np.float64]) -> None:
    state = find_predicted(task, predicted(true[NEW:-1]))
    assert state is not None
    assert found(state.particles, true).all()
    assert len(state.particles) == len(true)


@pytest.mark.thorough
def test_what_is_not_there_goes(task: Task, true: NDArray[np.float64]) -> None:
    """As surely as it was predicted: ghosts, and particles that have left."""
    gone = np.random.default_rng(6).uniform((-0.9, -0.7, 1.2, 4e5), (0.9, 0.7, 2.6, 6e5), (4, 4))
    assert not found(true, gone).any()
    state = find_predicted(task, predicted(np.concatenate([true, gone])))
    assert state is not None
    assert found(state.particles, true).all()
    assert len(state.particles) == len(true)


@pytest.mark.thorough
def test_a_track_goes_on_beside_one_that_nobody_expected(task: Task, true: NDArray[np.float64]) -> None:
    """The light of the overlapping one draws it away until that one is found."""
    state = find_predicted(task, predicted(true[:-1]))
    assert state is not None
    assert found(state.particles, true[[0, -1]]).all()


def test_predictions_that_fit_nothing_are_refused(task: Task, true: NDArray[np.float64]) -> None:
    elsewhere = np.random.default_rng(7).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    assert find_predicted(task, predicted(elsewhere)) is None
    # Nor is there anything to go on from where none is expected, or none within the volume's depths.
    assert find_predicted(task, predicted(true[:0])) is None
    assert find_predicted(task, predicted(true + (0.0, 0.0, 9.0, 0.0))) is None
