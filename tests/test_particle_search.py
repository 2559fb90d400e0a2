"""Searches: sweeps, tracers found twice, errors that tracers share, their number, the focus of microlenses."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

import lfpiv_cli as lf
from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.white import vignetting_surface
from lfpiv_cli.files.config import carried_config
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles import search, stated
from lfpiv_cli.particles.camera_light import FocalLength, focal_length_of
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.joining import with_twins_joined
from lfpiv_cli.particles.least_squares import SMALLEST_GAIN, observation_of
from lfpiv_cli.particles.noise import ROUNDING_COUNTS
from lfpiv_cli.particles.search import (
    LAST_SWEEPS,
    LAST_UNEXPLAINED,
    State,
    Task,
    blank,
    noise_with,
    observed,
    rebuilt,
    sweep,
    with_measured_noise,
)
from lfpiv_cli.particles.stated import LIT_COUNTS, result, with_offset_known
from lfpiv_cli.particles.view import View, raw_view
from lfpiv_cli.verbs.frames import Bench, bench_of, frame_notices
from lfpiv_cli.verbs.particles import find, frame_of, points_of, task_for, tracers_per_lens
from lfpiv_cli.verbs.tracers import TracerSize, light_notices
from tests.commands import AT_FOCUS, sample_rig
from tests.particle_images import found, light_on, seen_by, task_with
from tests.particle_images import task_for as task_of_image

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
def test_read_noise_is_that_of_pixels_that_are_read(task: Task) -> None:
    shape = task.view.camera.rows, task.view.camera.columns
    counts, excluded = np.rint(np.random.default_rng(6).normal(0.0, 2.0, shape)), np.zeros(shape, bool)
    # The gap of a pixel that is left out is filled from those around it.
    counts[0, 7], excluded[0, 7] = -0.37, True
    made = search.task_of(counts, task.view, task.weights, task.camera, task.sums, excluded)
    assert made.read_counts == pytest.approx(2.0, rel=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize(("dark", "noise"), [(2.6, 0.03), (3.3, 0.03), (3.0, 0.03), (2.6, 0.11)])
def test_light_that_is_rounded_shows_where_dark_is(
    table2: Camera, water: Media, tracers: Floats, rng: np.random.Generator, dark: float, noise: float
) -> None:
    """Of tracers of 15 counts with hardly any noise: of a dark level of 2.6 the dark image shows 3, their light 2.6."""
    camera, grid = replace(table2, columns=500, rows=420), Grid.centred((20, 16, 20), (0.1, 0.1, 0.1), (0.0, 0.0, 1.9))
    true = tracers * (1.0, 1.0, 1.0, 0.008)
    light = seen_by(camera, water, true, grid.bounds_mm(2))
    beside = np.rint(dark + rng.normal(0.0, noise, light.size))
    recorded = np.rint(rng.poisson(50.0 * light) / 50.0 + dark + rng.normal(0.0, noise, light.size)) - beside
    task = task_of_image(recorded, camera, water, grid, haze_error=np.full((420, 500), ROUNDING_COUNTS, np.float32))
    start = rebuilt(task, blank(task), true.copy())
    start = with_measured_noise(task, replace(start, typical_light=0.008 * TYPICAL, noise=noise_with(task, 4e3)))
    for _ in range(3):
        sweep(task, start, LAST_UNEXPLAINED, LAST_SWEEPS)
    known, state = with_offset_known(task, with_measured_noise(task, start))
    assert known.haze is not None
    assert known.haze_error is not None
    assert np.median(known.haze[light > LIT_COUNTS]) == pytest.approx(dark - beside.mean(), abs=0.04)
    assert np.abs(known.haze[light == 0.0]).max() < 0.01
    assert known.haze_error.max() < 0.02
    # With dark as its image shows it depths are wrong by 0.02 to 0.03 mm; where that is right noise makes it 0.004.
    assert np.sqrt(np.mean((state.particles - true)[:, 2] ** 2)) < 0.006
    # Of 45 tracers: of 95 % three are fewer at most by chance.
    end = result(task, start)
    assert end.offset_counts == pytest.approx(dark - beside.mean(), abs=0.04)
    away, number = KDTree(camera.to_image_axes(true[:, :3])).query(end.position_mm)
    error = end.position_mm - camera.to_image_axes(true[number, :3])
    assert away.max() < 0.1
    sigma = np.sqrt(np.diagonal(end.covariance_mm2, axis1=1, axis2=2))
    assert np.all(np.mean(np.abs(error) < 1.96 * sigma, axis=0) > 0.85)


@pytest.mark.thorough
def test_what_is_left_without_light_is_no_particle(table2: Camera, water: Media, tracers: Floats) -> None:
    """Of a particle without light no place is known: it ended the search with a matrix that is singular."""
    camera, grid = replace(table2, columns=500, rows=420), Grid.centred((20, 16, 20), (0.1, 0.1, 0.1), (0.0, 0.0, 1.9))
    true = tracers[:3] * (1.0, 1.0, 1.0, 0.008)
    task = task_of_image(np.rint(seen_by(camera, water, true, grid.bounds_mm(2))), camera, water, grid)
    ghost = np.concatenate([true, [[0.9, 0.7, 2.0, 0.0]]])
    state = replace(rebuilt(task, blank(task), ghost), typical_light=4e3, noise=noise_with(task, 4e3))
    assert len(result(task, state).position_mm) == 3


@pytest.mark.thorough
def test_sweeps_end_where_those_over_all_end(task: Task, tracers: Floats) -> None:
    every, some = begun(task, tracers), begun(task, tracers)
    observation = observed(task, every, 0.05)
    for _ in range(6):
        refine(observation, every.particles, SMALLEST_GAIN)
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
    seen = np.array([search.disturbance(task.view, particles, 10.0 * one) for one in np.eye(5)])
    assert seen[0, 1] == seen[1, 0] == 10.0
    assert not seen.diagonal().any()
    assert seen[0, 1] > seen[0, 2] > 0.0
    assert seen[0, 1] > seen[0, 3] > 0.0
    assert not seen[4].any()
    together = search.disturbance(task.view, particles, np.full(5, 10.0))
    np.testing.assert_allclose(together, seen.sum(axis=0), rtol=1e-12)
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
    merged = search.merge(task, state)
    assert len(merged.particles) == len(merged.expected) == len(tracers)
    assert merged.particles[:, 3].sum() == pytest.approx(tracers[:, 3].sum(), rel=1e-12)
    np.testing.assert_array_equal(merged.expected[-1], state.expected[-1])
    np.testing.assert_allclose(merged.residual, rebuilt(task, merged, merged.particles).residual, atol=1e-6)
    assert len(joined(task, tracers[:1])) == 1
    assert len(joined(task, tracers[:0])) == 0


@pytest.fixture
def view(table2: Camera, water: Media) -> View:
    return raw_view(replace(table2, columns=120, rows=110), water, 0.025)


def test_light_that_is_left_is_counted_without_noise(rng: np.random.Generator) -> None:
    image = rng.uniform(0.0, 500.0, 100_000)
    noise, wrong = rng.normal(0.0, 6.0, image.size), 0.2 * image * rng.choice([-1.0, 1.0], image.size)
    assert stated.light_left(image, noise, 6.0) < 0.003
    assert stated.light_left(image, noise + wrong, 6.0) == pytest.approx(0.2, abs=0.002)
    assert stated.light_left(np.zeros(4), np.zeros(4), 6.0) == 0.0


def test_errors_grow_where_light_is_left_and_most_in_depth(view: View) -> None:
    particles = np.array([[0.0, 0.0, 0.1, 1e5], [0.0, 0.0, 3.0, 1e5]])
    covariance = np.tile(np.diag([1.0, 1.0, 900.0, 1e6]), (2, 1, 1)) + 0.5
    np.testing.assert_array_equal(stated.grown(view, particles, covariance, 0.09), covariance)
    before = covariance
    for left in (1.1, 1.3, 2.0):
        found = stated.grown(view, particles, covariance, 0.1 * left)
        assert np.all(np.linalg.eigvalsh(found) > 0.0)
        assert np.all(np.diagonal(found - before, axis1=1, axis2=2) > 0.0)
        before = found
    growth = np.sqrt(np.diagonal(found / covariance, axis1=1, axis2=2))
    # Fitted by rays, tracers by waves in some 16 lenses were four times as far off in depth as stated, twice sideways.
    assert growth[1, 2] == pytest.approx(4.0, abs=0.5)
    assert growth[1, 0] == pytest.approx(2.2, abs=0.3)
    assert np.all(growth[1] > growth[0])


@pytest.mark.thorough
def test_errors_know_what_is_missing_around(task: Task, tracers: Floats) -> None:
    """Chi-squared of one that stays is 0.95 without a tracer near it, whose light its neighbours take up."""
    sigma = []
    for particles in (tracers, np.delete(tracers, 3, axis=0)):
        state = search.with_measured_noise(task, begun_with(task, particles.copy()))
        search.sweep(task, state, 0.02, 6)
        here = stated.result(task, state)
        which = KDTree(task.camera.to_image_axes(here.position_mm)).query(tracers[23, :3])[1]
        assert here.chi2[which] < 1.0
        sigma.append(np.sqrt(here.covariance_mm2[which, 2, 2]))
    assert sigma[1] > 2.0 * sigma[0]


def test_errors_do_not_grow_for_what_is_noise(view: View) -> None:
    particles, covariance = np.array([[0.0, 0.0, 3.0, 1e5]]), np.eye(4)[np.newaxis]
    known = [stated.grown(view, particles, covariance, 0.2, alike)[0, 2, 2] for alike in (0.0, 0.1, 0.2, 1.0)]
    assert known[0] == 1.0
    assert 1.0 < known[1] < known[2] == known[3]


def test_variances_grow_with_what_the_best_ones_do_not_leave(rng: np.random.Generator) -> None:
    # By noise alone chi-squared of 330 pixels scatters by a thirteenth, and nothing is missing.
    noise = rng.chisquare(330, 2000) / 330
    light, known = rng.uniform(0.6, 1.4, noise.size), np.ones(noise.size, np.bool_)
    assert np.mean(stated.missing_light(noise, light, known, 330.0)) < 1.1
    # Nor is it where noise goes with a particle's light: it is as much larger, and no more.
    np.testing.assert_allclose(
        np.mean(stated.missing_light(light * noise, light, known, 330.0) / light), 1.0 / 0.64, rtol=0.1
    )
    # One by itself tells no other reference than 1.
    assert stated.missing_light(np.array([0.9]), np.ones(1), known[:1], 330.0) == pytest.approx(1.0)
    # A root of chi-squared that is twice that of the best ones counts nearly whole.
    twice = 1.0 + 12.0 / 1.15
    assert stated.missing_light(np.array([4.0]), np.ones(1), ~known[:1], 330.0) == pytest.approx(twice, rel=0.1)
    # In crowds noise seems four times as large as it is, and 1 is no good particle's chi-squared.
    crowd = np.concatenate([0.25 * noise[:200], rng.lognormal(1.0, 1.5, 800), [0.25, 1.0, 100.0]])
    light, known = rng.uniform(0.6, 1.4, crowd.size), np.arange(crowd.size) < 1000
    light[-3:] = 1.0
    at_best, at_one, at_hundred = stated.missing_light(crowd, light, known, 330.0)[-3:]
    assert at_best < 1.5
    assert at_one == pytest.approx(twice, rel=0.2)
    assert at_hundred == pytest.approx(1.0 + 19.0 * 12.0, rel=0.2)


def with_others(view: View, place: tuple[float, ...], light: float, noise: Floats) -> tuple[Floats, bool]:
    """Return standard errors (4,) that cover other places, where they were small, and whether there is another depth.

    `noise` (pixels,) is of the image in standard errors.
    """
    particle = np.array([[*place, light]])
    variance = READ_COUNTS**2 + 2.0 * light_on(view, particle, DEPTHS)
    residual = noise * np.sqrt(variance)
    observation = observation_of(view, residual.copy(), 1.0 / variance, DEPTHS)
    covariance = np.diag(np.square([*SURE_MM, 0.01 * light]))[np.newaxis]
    found, other = stated.with_other_places(observation, particle, covariance, np.ones(1), 0.0)
    np.testing.assert_allclose(observation.residual, residual, atol=1e-6)
    return np.sqrt(np.diagonal(found[0])), bool(other[0])


def test_errors_cover_another_depth_that_explains_the_light(view: View, rng: np.random.Generator) -> None:
    noise = rng.normal(size=view.camera.rows * view.camera.columns)
    # In the middle of a lens, which holds all of its light, half a millimetre further off will do as well.
    sigma, ambiguous = with_others(view, (0.0, 0.0, 0.25), 3e4, noise)
    assert ambiguous
    assert 0.3 < 1.96 * sigma[2] < 0.8
    # Between two lenses, and where many are lit, one place alone.
    for place in ((0.04, 0.02, 0.4), (0.0, 0.0, 1.1)):
        sigma, ambiguous = with_others(view, place, 3e5, noise)
        assert not ambiguous
        np.testing.assert_allclose(sigma[:3], SURE_MM)


def test_errors_cover_the_lens_that_holds_all_of_the_light(view: View) -> None:
    # The other end of where it may be lies 0.03 mm off.
    for axis, place in enumerate(((0.015, 0.0, 0.0), (0.0, 0.015, 0.0))):
        sigma, _ = with_others(view, place, 2e4, np.zeros(view.camera.rows * view.camera.columns))
        assert 0.03 < 1.96 * sigma[axis] < 0.06


def test_errors_next_to_focus_cover_that_one_may_be_two(view: View, rng: np.random.Generator) -> None:
    far = np.column_stack([rng.uniform(-1.0, 1.0, (40, 2)), np.full(40, 2.0), TYPICAL * rng.lognormal(0.0, 0.2, 40)])
    light = TYPICAL * np.array([1.0, 1.2, 1.9, 2.2, 2.2])
    asked = np.column_stack([np.zeros((5, 2)), [0.1, 0.1, 0.1, -0.4, 2.0], light])
    particles, known = np.concatenate([far, asked]), np.ones(45, np.bool_)
    sigma = np.sqrt(np.diagonal(stated.of_two(view, particles, known), axis1=1, axis2=2)) / (0.03, 0.03, 0.53, 1.0)
    # The third part of a lens, and half the depth over which light spreads by one.
    np.testing.assert_allclose(sigma[42:44, :3], 1.0, rtol=0.01)
    assert not sigma[40:42].any()
    # Where many lenses are lit one is no two, and nothing is known of what few tracers' light scatters by.
    assert not sigma[:40].any()
    assert not sigma[44].any()
    assert not stated.of_two(view, asked, known[:5]).any()


@pytest.mark.thorough
def test_errors_do_not_grow_for_tracers_lost_elsewhere(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    true = np.array([[-0.6, 0.0, 1.5, 5e5], [0.6, 0.0, 1.5, 5e5]])
    task = task_with(table2, water, true, rng)
    covariance = []
    for shown in (true, true[:1]):
        state = replace(search.rebuilt(task, blank(task), shown), noise=search.noise_with(task, 5e5))
        covariance.append(stated.result(task, state).covariance_mm2[0])
    # Left alone 0.7 of the light is.
    np.testing.assert_allclose(np.diag(covariance[1]), np.diag(covariance[0]), rtol=0.1)


def test_changes_are_those_of_independent_errors(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    # In place of light: what the squares of size and diffusion are.
    scene = view.scale.lens_mm

    def with_diffusion(sized: View, diffusion_px: float) -> View:
        return sized._replace(diffusion_px=diffusion_px)

    def add_all(sized: View, _: object, sign: float, image: Floats, depths: object) -> None:
        image += sign * (3.0 * (2.0 * sized.particle_radius_mm / scene) ** 2 + 5.0 * sized.diffusion_px**2)

    monkeypatch.setattr(stated, "with_diffusion", with_diffusion)
    monkeypatch.setattr(stated, "add_all", add_all)
    covariance = np.array([[4e-4, -1e-4], [-1e-4, 2e-4]])
    for diameter in (0.5, 0.01):
        sized = view._replace(particle_radius_mm=0.5 * diameter * scene, diffusion_px=0.3)
        changes = stated.changes_of_light(sized, np.zeros((0, 4)), covariance, (0.0, 1.0))[:, 0]
        slopes = np.array([3.0, 5.0])
        assert changes @ changes == pytest.approx(slopes @ covariance @ slopes)


DEPTHS = (-3.0, 3.0)
READ_COUNTS = 6.0
# Standard errors of a particle in many lenses.
SURE_MM = (1e-4, 1e-4, 5e-3)


@pytest.fixture
def small_camera(table2: Camera) -> Camera:
    return replace(table2, columns=300, rows=280)


def focus_told(
    small_camera: Camera, water: Media, times: float, count: int, rng: np.random.Generator
) -> FocalLength | None:
    """Return what tracers tell whose images are of so many times the focal length that is said."""
    particles = rng.uniform((-0.5, -0.5, -2.5, 4e5), (0.5, 0.5, 2.5, 6e5), (count, 4))
    other = replace(small_camera, microlens_focal_length_mm=times * small_camera.microlens_focal_length_mm)
    view, seen = (raw_view(each, water, 0.025) for each in (small_camera, other))
    image = light_on(seen, particles, DEPTHS)
    variance = READ_COUNTS**2 + 2.0 * image
    image += rng.normal(0.0, np.sqrt(variance))
    return focal_length_of(view, particles, image - light_on(view, particles, DEPTHS), 1.0 / variance)


def test_many_tracers_show_the_focal_length(small_camera: Camera, water: Media, rng: np.random.Generator) -> None:
    found = focus_told(small_camera, water, 0.98, 15, rng)
    assert found is not None
    # One step from 2 % away falls short of it by what the light is not linear in, a tenth.
    assert found.off == pytest.approx(-0.02, rel=0.15)
    assert abs(found.off) > 10.0 * found.sigma
    found = focus_told(small_camera, water, 1.0, 15, rng)
    assert found is not None
    assert abs(found.off) < 4.0 * found.sigma < 0.004
    assert focus_told(small_camera, water, 1.0, 9, rng) is None


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """What images of a small rig share: 20 x 23 microlenses on the sensor, 10 planes of 0.1 mm."""
    small = ("columns: 600, rows: 448", "columns: 420, rows: 380"), ("[30, 22, 40]", "[16, 14, 10]"), AT_FOCUS
    rig = sample_rig(tmp_path_factory.mktemp("rig"), *small, ("centre_mm: [0, 0, 0]", "centre_mm: [0, 0, 1.9]"))
    content: WeightsFile = lf.build_weights(lf.load_rig(rig))
    return bench_of(content, carried_config(content.provenance, "weights"), None, None)


def image_of(bench: Bench, number: float, seed: int) -> np.ndarray:
    """Return an image of so many tracers for each microlens, also around the volume."""
    content, rng = bench.content, np.random.default_rng(seed)
    low, high = np.array([-1.2, -1.1, 1.4]), np.array([1.2, 1.1, 2.4])
    count = rng.poisson(number * 2.4 * 2.2 / 0.1**2)
    view = raw_view(content.camera, bench.settings.media_model(), 0.025)
    places = content.camera.to_image_axes(rng.uniform(low, high, (count, 3)))
    image = rng.normal(100.0, 6.0, content.camera.rows * content.camera.columns)
    particles = np.column_stack([places, rng.uniform(3e5, 7e5, count)])
    add_all(view, particles, 1.0, image, content.weights.grid.bounds_mm(2))
    return image.reshape(content.image_shape).astype(np.float32)


def test_tracers_are_fitted_behind_the_vignetting_of_the_white_image(bench: Bench) -> None:
    vignetting = np.zeros((5, 5))
    vignetting[0, 0], vignetting[0, 2], vignetting[2, 0] = 1.0, -0.2, -0.3
    image, content = image_of(bench, 0.1, 0), replace(bench.content, vignetting=vignetting)
    frame = frame_of(bench, image, image)
    view, plain = (task_for(replace(bench, content=each), frame).view for each in (content, bench.content))
    lit = [light_on(each, np.array([[0.6, -0.5, 1.8, 1e5]]), (1.4, 2.4)) for each in (view, plain)]
    surface = vignetting_surface(vignetting, content.image_shape).ravel()
    np.testing.assert_allclose(lit[0], surface * lit[1], atol=1e-6 * lit[1].max())
    assert surface[lit[1] > 0.0].max() < 0.95


@pytest.mark.thorough
@pytest.mark.parametrize("number", [0.3, 3.0])
def test_few_and_crowded_tracers_are_counted(bench: Bench, number: float) -> None:
    counts = [tracers_per_lens(bench, frame_of(bench, *[image_of(bench, number, seed)] * 2)) for seed in range(3)]
    # Some 200 microlenses, some five of which share a tracer's light, tell the variance of one image to a fifth.
    assert np.mean(counts) == pytest.approx(number, rel=0.2)


@pytest.mark.parametrize("depth", [0.1, 1.6, 2.4])
def test_a_single_faint_tracer_is_no_crowd(bench: Bench, depth: float) -> None:
    # The dark pixels' own noise, as light that all microlenses share, made it 10 to 40 for each of them.
    image, content = np.random.default_rng(0).normal(0.0, 6.0, bench.content.image_shape), bench.content
    tracer = np.array([[0.05, -0.03, depth, 1e4]])
    add_all(raw_view(content.camera, bench.settings.media_model(), 0.025), tracer, 1.0, image.ravel(), (0.0, 2.5))
    image = image.astype(np.float32)
    counted = tracers_per_lens(bench, frame_of(bench, image, image))
    assert counted is not None
    assert counted < 0.2


@pytest.mark.thorough
def test_tracers_are_counted_few_or_crowded_and_light_that_does_not_tell_is_not(bench: Bench) -> None:
    image = image_of(bench, 0.5, 0)
    masked = np.full_like(image, np.nan)
    masked[:100, :100] = image[:100, :100]
    assert tracers_per_lens(bench, frame_of(bench, masked, np.nan_to_num(masked))) is None
    assert tracers_per_lens(bench, frame_of(bench, *[np.zeros_like(image)] * 2)) is None
    # Tracers that cannot be told apart are counted.
    image = image_of(bench, 12.0, 0) - np.float32(100.0)
    frame = frame_of(bench, image, image)
    points = points_of(bench, frame, find(bench, frame), TracerSize(0.05), {})
    # Most of what they light is explained, by particles that are not there.
    model, crowded = light_notices(points, "crowded")
    assert (model.code, crowded.code) == ("light-model", "particles-crowded")
    # Two standard errors of what one image of so few microlenses tells.
    assert crowded.measured == pytest.approx(12.0, rel=0.4)
    # What noise alone leaves is no light of tracers: where none was found it made 40 for each microlens.
    noise = np.random.default_rng(0).normal(100.0, 16.0, image.shape).astype(np.float32)
    frame = frame_of(bench, noise, noise - np.float32(100.0))
    left = points_of(bench, frame, find(bench, frame), TracerSize(0.05), {}).attributes
    assert left["residual"] > 0.1
    assert "tracers_per_lens" not in left


def test_crowded_tracers_are_not_taken_for_noise(bench: Bench) -> None:
    # No pixel is as dark as without light, and most lie far from the median.
    crowd = image_of(bench, 12.0, 0)
    noise = np.random.default_rng(0).normal(0.0, 6.0, crowd.shape).astype(np.float32)
    for image, reported in ((crowd, False), (noise, True), (noise + np.float32(100.0), True)):
        assert ("frame-dark" in {each.code for each in frame_notices(bench, image, image, "a")}) == reported
