"""Searches: sweeps over what has changed end where those over all do; a tracer found twice is joined, two are not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles import search
from lfpiv_cli.particles.fitting import refine
from lfpiv_cli.particles.joining import with_twins_joined
from lfpiv_cli.particles.least_squares import SMALLEST_GAIN
from lfpiv_cli.particles.search import State, Task, blank, disturbance, merge, noise_with, observed, rebuilt
from tests.particle_images import found, light_on, task_with

TYPICAL = 5e5
# Half the distance of two that share a tracer's light: a tenth of a microlens, a twentieth of a millimetre of depth.
APART = np.array([0.005, 0.005, 0.05, 0.0])


@pytest.fixture(scope="module")
def tracers() -> Floats:
    places = np.random.default_rng(3).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    places[0, 3] = TYPICAL
    return places


@pytest.fixture
def task_of(table2: Camera, water: Media) -> Callable[..., Task]:
    """What returns the task that a noisy image of tracers sets."""
    return lambda true, **how: task_with(table2, water, true, np.random.default_rng(4), **how)


@pytest.fixture(scope="module")
def task(table2: Camera, water: Media, tracers: Floats) -> Task:
    return task_with(table2, water, tracers, np.random.default_rng(4))


def begun_with(task: Task, particles: Floats) -> State:
    """Return the state with these particles."""
    return replace(rebuilt(task, blank(task), particles), typical_light=TYPICAL, noise=noise_with(task, TYPICAL))


def begun(task: Task, tracers: Floats) -> State:
    """Return the state with particles a little beside where they are."""
    off = np.random.default_rng(5).normal(size=tracers.shape) * (0.005, 0.005, 0.03, 1e4)
    return begun_with(task, tracers + off)


@pytest.mark.thorough
def test_sweeps_end_where_those_over_all_end(task: Task, tracers: Floats) -> None:
    every, some = begun(task, tracers), begun(task, tracers)
    for _ in range(6):
        refine(observed(task, every, 0.05), every.particles, SMALLEST_GAIN)
    search.sweep(task, some, 0.05, 6, SMALLEST_GAIN)
    # What ends a fit is a tenth of a standard error, and here one is 1e-4 mm laterally, 1e-3 mm in depth, 500 counts.
    np.testing.assert_allclose((some.particles - every.particles) / (1e-4, 1e-4, 1e-3, 500.0), 0.0, atol=0.2)
    np.testing.assert_allclose(some.residual, task.image - light_of(task, some.particles), atol=1e-6)


def light_of(task: Task, particles: Floats) -> Floats:
    return light_on(task.view, particles, task.depths_mm)


@pytest.mark.thorough
def test_a_fit_s_gain_is_what_chi_squared_falls_by(task: Task, tracers: Floats) -> None:
    state = begun(task, tracers)
    observation = observed(task, state, 0.05)
    chosen = np.arange(len(tracers)) == 7
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
    overlaps = search.overlaps_of(task.view, particles)
    seen = np.array([disturbance(overlaps, 10.0 * one) for one in np.eye(5)])
    assert seen[0, 1] == seen[1, 0] == 10.0
    assert not seen.diagonal().any()
    assert seen[0, 1] > seen[0, 2] > 0.0
    assert seen[0, 1] > seen[0, 3] > 0.0
    assert not seen[4].any()
    np.testing.assert_array_equal(disturbance(overlaps, np.full(5, 10.0)), seen.sum(axis=0))
    common = [light_of(task, particles[[n]]) @ light_of(task, particles[[4]]) for n in range(4)]
    assert not np.any(common)


def halves(particle: Floats, apart: Floats = APART) -> Floats:
    """Return two particles that share a tracer's light (2, 4)."""
    return np.stack([particle - apart, particle + apart]) * (1.0, 1.0, 1.0, 0.5)


def joined(task: Task, particles: Floats) -> Floats:
    """Return what becomes of particles, after a look at the residual: it must be what they leave."""
    state = with_twins_joined(task, begun_with(task, particles), 0.02, np.ones(len(particles)))
    np.testing.assert_allclose(state.residual, rebuilt(task, state, state.particles).residual, atol=1e-6)
    assert len(state.prior) == len(state.particles)
    return state.particles


@pytest.mark.thorough
def test_a_tracer_found_twice_is_one_of_which_nothing_is_expected(task: Task, tracers: Floats) -> None:
    particles = joined(task, np.concatenate([halves(tracers[0]), tracers[1:]]))
    assert len(particles) == len(tracers)
    assert found(particles, tracers).all()
    # As good as a fit of one particle: a thousandth of a millimetre, a hundredth of its light.
    one = particles[np.argmin(np.linalg.norm(particles[:, :3] - tracers[0, :3], axis=1))]
    assert np.all(np.abs(one - tracers[0]) < (2e-3, 2e-3, 2e-2, 0.02 * TYPICAL))
    # What was expected of two is not expected of one.
    state = begun_with(task, np.concatenate([tracers[1:], halves(tracers[0])]))
    state = replace(state, expected=np.ones((len(state.particles), 8)))
    state = with_twins_joined(task, state, 0.02, np.ones(len(state.particles)))
    assert len(state.particles) == len(tracers)
    assert np.count_nonzero(~state.expected.any(axis=1)) == 1
    assert not state.expected[-1].any()


@pytest.mark.thorough
def test_a_bright_tracer_found_twice_is_one(task_of: Callable[..., Task], tracers: Floats) -> None:
    """Two solid tracers cannot be in one place: that the one is brighter than all others says nothing."""
    bright = np.concatenate([tracers[:1] * (1.0, 1.0, 1.0, 2.5), tracers[1:]])
    particles = joined(task_of(bright), np.concatenate([halves(bright[0], 0.5 * APART), bright[1:]]))
    assert len(particles) == len(bright)
    assert found(particles, bright).all()


@pytest.mark.thorough
def test_two_tracers_that_look_like_one_stay_two(task_of: Callable[..., Task], tracers: Floats) -> None:
    """In the noise the image does not tell them from one, but one would be brighter than others are."""
    beside = halves(tracers[0], np.array([0.0225, 0.0, 0.0, 0.0]))
    for light, count in ((1.0, len(tracers)), (2.0, len(tracers) + 1)):
        both = np.concatenate([beside * (1.0, 1.0, 1.0, light), tracers[1:]])
        assert len(joined(task_of(both, noise=2000.0), both)) == count


@pytest.mark.thorough
def test_two_tracers_near_each_other_or_faint_stay_two(task_of: Callable[..., Task], tracers: Floats) -> None:
    near, faint = tracers[0] + (0.025, 0.02, 0.1, 0.0), tracers[0] * (1.0, 1.0, 1.0, 0.5)
    for pair in ((tracers[0], near), (faint, faint + (0.06, 0.0, 0.0, 0.0))):
        both = np.concatenate([pair, tracers[1:]])
        assert len(joined(task_of(both), both)) == len(both)


@pytest.mark.thorough
def test_particles_in_one_place_are_added_up_and_few_have_no_twins(task: Task, tracers: Floats) -> None:
    thirds = np.stack([tracers[0] - 0.1 * APART, tracers[0], tracers[0] + 0.1 * APART]) * (1.0, 1.0, 1.0, 1.0 / 3.0)
    state = begun_with(task, np.concatenate([thirds, tracers[1:]]))
    state = replace(state, expected=np.arange(8.0 * len(state.particles)).reshape(-1, 8))
    merged = merge(task, state)
    assert len(merged.particles) == len(merged.expected) == len(tracers)
    assert merged.particles[:, 3].sum() == pytest.approx(tracers[:, 3].sum(), rel=1e-12)
    np.testing.assert_array_equal(merged.expected[-1], state.expected[-1])
    np.testing.assert_allclose(merged.residual, rebuilt(task, merged, merged.particles).residual, atol=1e-6)
    assert len(joined(task, tracers[:1])) == 1
    assert len(joined(task, tracers[:0])) == 0
