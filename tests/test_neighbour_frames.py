"""What frames beside one tell of its particles: found here too where they are there, and ghosts are not."""

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import Scale
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles import neighbour_frames
from lfpiv_cli.particles.neighbour_frames import Predicted, find_predicted, predicted_by, second_frame, second_pass
from lfpiv_cli.particles.rounds import first_pass
from lfpiv_cli.particles.search import Task
from lfpiv_cli.verbs.particles import STEPS
from tests.particle_images import found, task_with

MOVED = np.array([0.12, -0.05, 0.04, 0.0])


@pytest.mark.thorough
def test_what_a_neighbour_found_is_found(
    table2: Camera, water: Media, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = rng.uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    # One beside an overlapping one that splitting may not have separated: what it explains is not free.
    true[1] = true[0] + (0.03, -0.02, 0.2, 0.0)
    task = task_with(table2, water, true, rng, gain=0.2)
    own = true[3:].copy()
    own = np.concatenate([own, [[*(0.5 * (true[0] + true[1]))[:3], true[0, 3] + true[1, 3]]]])
    ghosts = rng.uniform((-0.9, -0.7, 1.2, 4e5), (0.9, 0.7, 2.6, 6e5), (3, 4))
    before = np.concatenate([true, ghosts]) - MOVED
    with monkeypatch.context() as without_search:
        # What follows would find it, too, in an image that is no fuller.
        without_search.setattr(neighbour_frames, "finished", lambda task, state, settings: state)
        assert not found(second_pass(task, own, []).particles, true)[2]
        assert found(second_pass(task, own, [before]).particles, true)[2]
    beside = second_pass(task, own, [before]).particles
    assert found(beside, true).all()
    assert len(beside) == len(true)
    # Two neighbours that know the same name it once.
    both = second_pass(task, own, [before, np.concatenate([true, ghosts]) + MOVED]).particles
    assert found(both, true).all()
    assert len(both) == len(true)


# How far off predictions are: a fifth of a microlens, a tenth of a millimetre of depth and some percent of light.
PREDICTION_OFF = np.array([0.01, 0.01, 0.05, 0.03])
NEW = 3
# Whom nothing shows but an overlapping one that nobody expected.
BESIDE = np.array([0.03, -0.02, 0.2, 0.0])


@pytest.fixture(scope="module")
def true() -> Floats:
    """Return particles; the last has come in beside the first, an overlapping one."""
    places = np.random.default_rng(3).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    places[-1] = places[0] + BESIDE
    return places


@pytest.fixture(scope="module")
def task(table2: Camera, water: Media, true: Floats) -> Task:
    return task_with(table2, water, true, np.random.default_rng(4))


def predicted(particles: Floats, seed: int = 5) -> Predicted:
    """Return particles as tracks predict them: off by what they state."""
    noise = np.random.default_rng(seed).normal(size=particles.shape)
    off = particles + noise * PREDICTION_OFF * np.column_stack([np.ones((len(particles), 3)), particles[:, 3]])
    sigma = np.tile(PREDICTION_OFF[:3], (len(particles), 1))
    return Predicted(off, sigma, float(PREDICTION_OFF[3]))


@pytest.mark.thorough
def test_what_is_predicted_and_the_rest_are_found_and_what_is_not_there_goes(task: Task, true: Floats) -> None:
    gone = np.random.default_rng(6).uniform((-0.9, -0.7, 1.2, 4e5), (0.9, 0.7, 2.6, 6e5), (4, 4))
    assert not found(true, gone).any()
    for expected in (true[NEW:-1], np.concatenate([true, gone])):
        state = find_predicted(task, predicted(expected))
        assert found(state.particles, true).all()
        assert len(state.particles) == len(true)
    # The light of an overlapping one that nobody expected draws a track away until that one is found.
    state = find_predicted(task, predicted(true[:-1]))
    assert found(state.particles, true[[0, -1]]).all()


@pytest.mark.thorough
def test_two_that_every_frame_before_took_for_one_become_two(task: Task, true: Floats) -> None:
    as_one = 0.5 * (true[0] + true[-1])
    as_one[3] *= 2.0
    state = find_predicted(task, predicted(np.concatenate([true[1:-1], [as_one]])))
    assert found(state.particles, true[[0, -1]]).all()
    assert len(state.particles) == len(true)


def test_predictions_that_fit_nothing_are_refused(task: Task, true: Floats) -> None:
    elsewhere = np.random.default_rng(7).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    assert find_predicted(task, predicted(elsewhere)) is None
    # Nor is there anything to go on from where none is expected, or none within the volume's depths.
    assert find_predicted(task, predicted(true[:0])) is None
    assert find_predicted(task, predicted(true + (0.0, 0.0, 9.0, 0.0))) is None


SCALE = Scale(0.1, 1.064)


def strewn(rng: np.random.Generator, count: int = 30) -> Floats:
    return rng.uniform((-0.9, -0.7, 1.2, 4e5), (0.9, 0.7, 2.6, 6e5), (count, 4))


@pytest.mark.thorough
def test_what_fits_and_finds_its_light_is_beyond_doubt(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    true = strewn(rng)
    true[1] = true[0] + (0.03, -0.02, 0.2, 0.0)
    task = task_with(table2, water, true, rng)
    as_one = [*(0.5 * (true[0] + true[1]))[:3], true[0, 3] + true[1, 3]]
    sure = neighbour_frames.beyond_doubt(task, np.concatenate([true[2:], [as_one], strewn(rng, 3)]))
    assert sure[:28].mean() > 0.8
    assert not sure[28:].any()


@pytest.mark.thorough
def test_particles_are_expected_where_the_flow_takes_them(rng: np.random.Generator) -> None:
    trusted = strewn(rng, 60)
    # Half of them are seen already, all of them brighter, and none of the rest is anywhere near.
    seen = (trusted[:30] + MOVED) * (1.0, 1.0, 1.0, 1.2)
    seen[:, :2] += rng.normal(0.0, 2e-4, (30, 2))
    predicted = predicted_by(trusted, seen, SCALE)
    assert len(predicted.particles) == 60
    np.testing.assert_allclose(predicted.particles[:30, :3], seen[:, :3])
    np.testing.assert_allclose(predicted.particles[30:, :3], (trusted + MOVED)[30:, :3], atol=2e-3)
    np.testing.assert_allclose(predicted.particles[:, 3], 1.2 * trusted[:, 3])
    seen[:, :3] += rng.normal(0.0, (0.05, 0.05, 0.05), (30, 3))
    assert len(predicted_by(trusted, seen, SCALE).particles) <= 30
    nothing = np.zeros((0, 4))
    for first, second in ((trusted, nothing), (nothing, seen), (nothing, nothing)):
        assert not len(predicted_by(first, second, SCALE).particles)


@pytest.mark.thorough
def test_the_second_frame_goes_on_from_the_first(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    true, new = strewn(rng), strewn(rng, 2)
    both = np.concatenate([true, new])
    before, task = (task_with(table2, water, each, rng) for each in (true - MOVED, both))
    reported: list[int] = []
    particles = second_frame(task, before, np.concatenate([true - MOVED, strewn(rng, 3)]), reported.append)
    assert found(particles, both).all()
    assert len(particles) == 32
    assert sum(reported) == STEPS
    alone = first_pass(task).particles
    assert particles.shape != alone.shape or not np.array_equal(particles, alone)
    # Particles of another scene predict nothing: all is as without a first frame.
    reported.clear()
    np.testing.assert_array_equal(second_frame(task, before, strewn(rng), reported.append), alone)
    assert sum(reported) == STEPS
