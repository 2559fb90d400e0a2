"""One tracer that was found twice is joined; two tracers are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.joining import with_twins_joined
from lfpiv_cli.particles.search import State, Task, blank, merge, noise_with, rebuilt
from tests.particle_images import found, task_with

# The fits take half a minute to compile.
pytestmark = pytest.mark.thorough

TYPICAL = 5e5
# Half the distance of two that share a tracer's light: a tenth of a microlens, a twentieth of a millimetre of depth.
APART = np.array([0.005, 0.005, 0.05, 0.0])


@pytest.fixture(scope="module")
def true() -> NDArray[np.float64]:
    places = np.random.default_rng(3).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    places[0, 3] = TYPICAL
    return places


def begun(task: Task, particles: NDArray[np.float64]) -> State:
    """Return the state with these particles."""
    return replace(rebuilt(task, blank(task), particles), typical_light=TYPICAL, noise=noise_with(task, TYPICAL))


def halves(particle: NDArray[np.float64], apart: NDArray[np.float64] = APART) -> NDArray[np.float64]:
    """Return two particles that share a tracer's light (2, 4)."""
    return np.stack([particle - apart, particle + apart]) * (1.0, 1.0, 1.0, 0.5)


def joined(task: Task, particles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what becomes of particles, after a look at the residual: it must be what they leave."""
    state = with_twins_joined(task, begun(task, particles), 0.02, np.ones(len(particles)))
    np.testing.assert_allclose(state.residual, rebuilt(task, state, state.particles).residual, atol=1e-6)
    assert len(state.prior) == len(state.particles)
    return state.particles


def test_a_tracer_found_twice_is_one(table2: Camera, water: Media, true: NDArray[np.float64]) -> None:
    task = task_with(table2, water, true, np.random.default_rng(4))
    particles = joined(task, np.concatenate([halves(true[0]), true[1:]]))
    assert len(particles) == len(true)
    assert found(particles, true).all()
    # As good as a fit of one particle: a thousandth of a millimetre, a hundredth of its light.
    one = particles[np.argmin(np.linalg.norm(particles[:, :3] - true[0, :3], axis=1))]
    assert np.all(np.abs(one - true[0]) < (2e-3, 2e-3, 2e-2, 0.02 * TYPICAL))


def test_a_bright_tracer_found_twice_is_one(table2: Camera, water: Media, true: NDArray[np.float64]) -> None:
    """Two solid tracers cannot be in one place: that the one is brighter than all others says nothing."""
    bright = np.concatenate([true[:1] * (1.0, 1.0, 1.0, 2.5), true[1:]])
    task = task_with(table2, water, bright, np.random.default_rng(4))
    particles = joined(task, np.concatenate([halves(bright[0], 0.5 * APART), bright[1:]]))
    assert len(particles) == len(bright)
    assert found(particles, bright).all()


def test_what_was_expected_of_two_is_not_expected_of_one(
    table2: Camera, water: Media, true: NDArray[np.float64]
) -> None:
    task = task_with(table2, water, true, np.random.default_rng(4))
    state = begun(task, np.concatenate([true[1:], halves(true[0])]))
    state = replace(state, expected=np.ones((len(state.particles), 8)))
    state = with_twins_joined(task, state, 0.02, np.ones(len(state.particles)))
    assert len(state.particles) == len(true)
    assert np.count_nonzero(~state.expected.any(axis=1)) == 1
    assert not state.expected[-1].any()


def test_two_tracers_that_look_like_one_stay_two(table2: Camera, water: Media) -> None:
    """In the noise the image does not tell them from one, but one would be brighter than others are."""
    others = np.random.default_rng(3).uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    apart = np.array([0.045, 0.0, 0.0, 0.0])
    for light, count in ((0.5, len(others)), (1.0, len(others) + 1)):
        both = np.concatenate(
            [[others[0] - 0.5 * apart, others[0] + 0.5 * apart] * np.array([1, 1, 1, light]), others[1:]]
        )
        task = task_with(table2, water, both, np.random.default_rng(4), noise=2000.0)
        assert len(joined(task, both)) == count


def test_two_tracers_near_each_other_stay_two(table2: Camera, water: Media, true: NDArray[np.float64]) -> None:
    """A third of a microlens and a tenth of a millimetre apart they differ from one by a hundred standard errors."""
    both = np.concatenate([true, true[:1] + (0.025, 0.02, 0.1, 0.0)])
    task = task_with(table2, water, both, np.random.default_rng(4))
    assert len(joined(task, both)) == len(both)


def test_two_faint_tracers_apart_stay_two(table2: Camera, water: Media, true: NDArray[np.float64]) -> None:
    beside = true[0] * (1.0, 1.0, 1.0, 0.5)
    both = np.concatenate([[beside, beside + (0.06, 0.0, 0.0, 0.0)], true[1:]])
    task = task_with(table2, water, both, np.random.default_rng(4))
    assert len(joined(task, both)) == len(both)


def test_particles_in_one_place_are_added_up(table2: Camera, water: Media, true: NDArray[np.float64]) -> None:
    task = task_with(table2, water, true, np.random.default_rng(4))
    thirds = np.stack([true[0] - 0.1 * APART, true[0], true[0] + 0.1 * APART]) * (1.0, 1.0, 1.0, 1.0 / 3.0)
    state = begun(task, np.concatenate([thirds, true[1:]]))
    state = replace(state, expected=np.arange(8.0 * len(state.particles)).reshape(-1, 8))
    merged = merge(task, state)
    assert len(merged.particles) == len(merged.expected) == len(true)
    assert merged.particles[:, 3].sum() == pytest.approx(true[:, 3].sum(), rel=1e-12)
    np.testing.assert_array_equal(merged.expected[-1], state.expected[-1])
    np.testing.assert_allclose(merged.residual, rebuilt(task, merged, merged.particles).residual, atol=1e-6)


def test_few_particles_have_no_twins(table2: Camera, water: Media, true: NDArray[np.float64]) -> None:
    task = task_with(table2, water, true, np.random.default_rng(4))
    assert len(joined(task, true[:1])) == 1
    assert len(joined(task, true[:0])) == 0
