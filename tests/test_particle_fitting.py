"""Fitting, splitting and tiles: the spread that theory allows, two for one; and the camera that an image tells of."""

from contextlib import nullcontext
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.signal import lfilter

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.covariance import joint_covariance
from lfpiv_cli.particles.fitting import Least, accept, claimed_share, judge, refine
from lfpiv_cli.particles.least_squares import (
    Effort,
    Observation,
    fit,
    normal_equations,
    observation_of,
    respond_all,
    room_for,
)
from lfpiv_cli.particles.noise import (
    ROUNDING_COUNTS,
    WHITE,
    Correlation,
    Noise,
    error_correlation,
    mean_whole,
    measured_noise,
    read_noise,
)
from lfpiv_cli.particles.suspects import split, try_other_depths
from lfpiv_cli.particles.view import (
    Light,
    View,
    entry_capacity,
    footprint_px,
    lens_numbers,
    raw_view,
    tiles_of,
    with_radius,
)
from lfpiv_cli.self_calibration.nuisances import Nuisances, fit_nuisances
from tests.particle_images import light_on
from tests.particle_twin import respond_once, twin_image

DEPTHS = (-4.0, 4.0)


@pytest.fixture
def view(table2: Camera, water: Media) -> View:
    lattice = Lattice.regular(0.1, "square", np.deg2rad(0.12), (0.013, -0.02))
    return raw_view(replace(table2, lattice=lattice, columns=700, rows=600), water, 0.025)


def image_of(view: View, particles: Floats) -> Floats:
    return light_on(view, particles, DEPTHS)


def observed(view: View, residual: Floats, weight: Floats) -> Observation:
    return observation_of(view, residual, weight, DEPTHS)


def stated(view: View, particles: Floats, alike: Correlation = WHITE, worse: float = 1.0, *shared: object) -> Floats:
    """Return covariances of particles in an image of their own light."""
    weight = 1.0 / (image_of(view, particles) + 36.0)
    blind = observed(view, np.zeros_like(weight), weight)
    return joint_covariance(blind, particles, alike, np.full(len(particles), worse), *shared)


def slopes_of(view: View, particles: Floats) -> Floats:
    """Return the image's changes by all unknowns, one after the other, by differences."""
    slopes = []
    for number, unknown in np.ndindex(particles.shape):
        step = np.zeros_like(particles)
        step[number, unknown] = (1e-4, 1e-4, 1e-4, 1.0)[unknown]
        slopes.append((image_of(view, particles + step) - image_of(view, particles - step)) / 2.0 / step.max())
    return np.array(slopes)


def scattered(count: int, rng: np.random.Generator) -> Floats:
    low, high = (-1.4, -1.2, -3.5, 4e5), (1.4, 1.2, 3.5, 6e5)
    return rng.uniform(low, high, (count, 4))


@pytest.mark.thorough
def test_spread_is_the_least_possible(view: View, rng: np.random.Generator) -> None:
    particle = np.array([[0.21, -0.13, 2.3, 2.5e5]])
    clean = image_of(view, particle)
    weight = 1.0 / (clean + 36.0)
    sigma = np.sqrt(np.diagonal(stated(view, particle)[0]))
    errors = []
    for _ in range(60):
        start = particle + rng.normal(0.0, (0.01, 0.01, 0.1, 1e4))
        residual = clean + rng.normal(0.0, 1.0, clean.size) / np.sqrt(weight) - image_of(view, start)
        for _ in range(3):
            refine(observed(view, residual, weight), start)
        errors.append((start - particle)[0])
    # Of 60 fits the spread is known to 9 %; four standard errors are allowed. No bias beyond its own error.
    assert np.std(errors, axis=0) == pytest.approx(sigma, rel=0.37)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4.0 * sigma / np.sqrt(60))
    # A hundredth of a voxel sideways, a tenth in depth: what makes particles worth fitting.
    assert np.all(sigma[:3] < (1e-3, 1e-3, 1e-2))


@pytest.mark.thorough
def test_image_and_what_is_expected_count_by_their_errors(view: View, rng: np.random.Generator) -> None:
    """As for two measurements of one thing: each by the inverse of its covariance."""
    particle = np.array([[0.21, -0.13, 2.3, 2.5e5]])
    clean = image_of(view, particle)
    weight = 1.0 / (clean + 36.0)
    inverse = np.linalg.inv(stated(view, particle)[0])
    noise = rng.normal(0.0, 1.0, clean.size) / np.sqrt(weight)
    sigma = np.array([6e-4, 3e-4, 4e-3, np.inf])
    prior = np.concatenate([particle[0] + np.array([1e-3, -5e-4, 8e-3, 0.0]), 1.0 / sigma**2])[np.newaxis]

    def fitted(prior: Floats | None) -> Floats:
        at, residual = particle.copy(), noise.copy()
        for _ in range(3):
            refine(observed(view, residual, weight), at, 1e-6, prior=prior)
        return at[0]

    by_image = fitted(None)
    both = np.linalg.solve(inverse + np.diag(prior[0, 4:]), inverse @ by_image + np.diag(prior[0, 4:]) @ prior[0, :4])
    # The response is not linear; over the two standard errors between both the difference is a percent of them.
    error = np.sqrt(np.diagonal(np.linalg.inv(inverse)))
    assert np.all(np.abs(both - by_image)[:3] > 0.3 * error[:3])
    np.testing.assert_allclose((fitted(prior) - both) / error, 0.0, atol=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize("depth", [-0.1, 0.2, 2.0])
def test_a_pixel_between_micro_images_counts_once(view: View, rng: np.random.Generator, depth: float) -> None:
    # On the corner of four lenses, where near the focal plane many pixels are lit through two of them.
    particle = np.array([[-0.063 / 0.9995, 0.07, depth, 5e5]])
    residual = rng.normal(0.0, 50.0, view.camera.rows * view.camera.columns)
    weight = rng.uniform(0.5, 1.5, residual.size)
    capacity = entry_capacity(view, *DEPTHS)
    pixels, values = np.empty(capacity, np.int32), np.empty((capacity, 4))
    count = respond_once(view, *particle[0, :3], pixels, values)
    assert np.unique(pixels[:count]).size == count
    rows, picked = np.ascontiguousarray(values[:count].T), np.empty((2, count))
    observation = observed(view, residual, weight)
    change = normal_equations(pixels[:count], rows, 5e5, observation, picked, np.empty((4, 4)), np.empty(4))
    image = 5e5 * twin_image(view, particle[0, :3])[:, 0]
    assert change == pytest.approx(np.sum(weight * ((residual - image) ** 2 - residual**2)), rel=1e-9)


@pytest.mark.thorough
def test_neighbours_are_found_without_noise(view: View, rng: np.random.Generator) -> None:
    particles = scattered(25, rng)
    image = image_of(view, particles)
    found = particles + rng.normal(0.0, (0.01, 0.01, 0.05, 2e4), particles.shape)
    residual = image - image_of(view, found)
    before = np.sum(residual**2)
    for _ in range(15):
        refine(observed(view, residual, np.ones_like(image)), found)
    # Block coordinates creep where two particles all but coincide, so the last per cent takes long.
    assert np.sum(residual**2) < 0.03 * before
    np.testing.assert_allclose(residual, image - image_of(view, found), atol=1e-6)
    assert np.all(np.median(np.abs(found - particles), axis=0) < (3e-4, 3e-4, 3e-3, 3e3))


@pytest.mark.thorough
def test_a_ghost_is_not_accepted_nor_what_hardly_meets_the_sensor(view: View, rng: np.random.Generator) -> None:
    particles = scattered(2, rng)
    residual = image_of(view, particles)
    ghost = np.array([[1.0, 1.0, 0.0, 5e5]]) * np.sign(-particles[:1])
    candidates = np.concatenate([particles + (0.01, 0.01, 0.1, 0.0), ghost])
    taken = accept(observed(view, residual, np.ones_like(residual)), candidates, Least(1e5, 0.8, 0.1, 50.0))
    assert taken.tolist() == [True, True, False]
    np.testing.assert_allclose(candidates[:2, :3], particles[:, :3], atol=2e-3)
    candidate = np.array([[2.02, 0.3, 2.0, 1e6]])
    residual = image_of(view, candidate)
    weight = np.full_like(residual, 1.0 / 36.0)
    *_, seen = judge(observed(view, residual, weight), candidate)
    assert 0.0 < seen[0] < 0.1
    for least, taken in ((0.0, True), (0.1, False)):
        observation = observed(view, residual.copy(), weight)
        assert accept(observation, candidate.copy(), Least(1e5, 0.5, least, 50.0)).tolist() == [taken]


@pytest.mark.thorough
def test_a_claim_is_worth_the_light_that_is_there_and_none_where_pixels_have_no_weight(view: View) -> None:
    pixels, values = np.arange(10, dtype=np.int32), np.full((4, 10), 0.1)
    residual = np.full(10, 100.0)
    weight = np.ones_like(residual)
    assert claimed_share(pixels, values, 1000.0, residual, weight, 0.0) == 1.0
    residual[:4] = -50.0
    assert claimed_share(pixels, values, 1000.0, residual, weight, 0.0) == pytest.approx(0.6)
    assert claimed_share(pixels, values, 2000.0, residual, weight, 0.0) == pytest.approx(0.6 * 100.0 / 140.0)
    particle = np.array([[0.21, -0.13, 2.3, 2.5e5]])
    clean = image_of(view, particle)
    weight = np.where(np.arange(clean.size) % view.camera.columns < 330, 1.0, 0.0)
    residual = np.where(weight > 0.0, 0.0, -1e6)  # what stands there must not matter
    chi2, share, brightest, seen = judge(observed(view, residual, weight), particle)
    assert chi2[0] == 0.0
    assert share[0] == 1.0
    assert brightest[0] == pytest.approx(clean[weight > 0.0].max())
    assert seen[0] == pytest.approx(clean[weight > 0.0].sum() / 2.5e5)
    assert 0.1 < seen[0] < 0.9


@pytest.mark.thorough
def test_neighbours_that_are_free_widen_the_errors_and_all_have_some(view: View) -> None:
    particles = np.array([[0.2, 0.1, 2.0, 5e5], [0.23, 0.09, 2.2, 4e5], [0.26, 0.17, 1.5, 4e5], [-1.0, 0.9, 1.0, 4e5]])
    weight = 1.0 / (image_of(view, particles) + 36.0)
    found, jacobian = stated(view, particles), slopes_of(view, particles)
    whole = np.linalg.inv((jacobian * weight) @ jacobian.T)
    for number in range(4):
        part = slice(4 * number, 4 * number + 4)
        # Slopes of a turned array's lenses, which share profiles, are off by up to a hundredth.
        np.testing.assert_allclose(np.sqrt(np.diag(found[number])), np.sqrt(np.diag(whole[part, part])), rtol=5e-3)
    blind = observed(view, np.zeros_like(weight), weight)
    assert found[0, 2, 2] > 1.1 * joint_covariance(blind, particles[[0]], WHITE, np.ones(1))[0, 2, 2]
    # Near the focal plane many pixels are lit through two lenses, and count once all the same.
    near = np.array([[0.2295, 0.0436, 0.1066, 5e5], [0.2168, 0.0374, 0.1087, 5e5]])
    assert np.all(np.diagonal(stated(view, near), axis1=1, axis2=2) > 0.0)


@pytest.mark.thorough
def test_light_that_may_be_another_s_takes_a_place_along(view: View) -> None:
    particles = np.array([[0.2, 0.1, 2.0, 4e3], [0.22, 0.1, 2.1, 3e3]])
    found, jacobian = stated(view, particles), slopes_of(view, particles)
    whole = np.linalg.inv((jacobian / (image_of(view, particles) + 36.0)) @ jacobian.T)
    shared = np.outer(particles[1, :3] - particles[0, :3], particles[1, :3] - particles[0, :3])
    more = (whole[3, 7] / particles[0, 3] ** 2) ** 2 * shared
    assert np.sqrt(more[2, 2]) > 0.02
    np.testing.assert_allclose(found[0, :3, :3] - whole[:3, :3], more, rtol=0.1, atol=0.02 * more[2, 2])


@pytest.mark.thorough
def test_what_all_particles_share_moves_them_as_a_fit_would(view: View) -> None:
    particles = np.array([[0.20, 0.10, 2.0, 5e5], [0.23, 0.09, 2.2, 4e5], [-1.0, 0.9, 1.0, 4e5]])
    clean = image_of(view, particles)
    # A hundredth of their radius.
    change = image_of(with_radius(view, 0.02525), particles) - clean
    added = stated(view, particles, WHITE, 1.0, change[np.newaxis]) - stated(view, particles)
    # Those that overlap together: one by one they would exchange their light in steps too small for single precision.
    fitted = particles.copy()
    for part in (slice(0, 2), slice(2, 3)):
        members = fitted[part]
        observation = observed(view, change + image_of(view, members), 1.0 / (clean + 36.0))
        places = footprint_px(view, *DEPTHS) * view.camera.columns
        responses = room_for(len(members), observation.capacity, places)
        respond_all(view, members, responses)
        fit(observation, members, np.zeros((len(members), 8)), responses, Effort(50, 1e-10))
    moved = fitted - particles
    assert np.abs(moved[:, 2]).max() > 1e-3
    # Fits are not quite linear in the change.
    np.testing.assert_allclose(np.sqrt(added[:, 2, 2]), np.abs(moved[:, 2]), rtol=0.1)
    np.testing.assert_allclose(np.sqrt(added[:, 3, 3]), np.abs(moved[:, 3]), rtol=0.1, atol=10.0)


@pytest.mark.thorough
def test_overlapping_particles_are_separated_and_a_single_one_is_not_split(view: View) -> None:
    pair = np.array([[0.20, 0.10, 2.0, 5e5], [0.25, 0.08, 2.2, 4e5]])
    image = image_of(view, pair)
    one = np.array([[0.225, 0.09, 2.1, 9e5]])
    residual = image - image_of(view, one)
    partners = split(observed(view, residual, 1.0 / (image + 36.0)), one, np.array([True]), 1e5, np.array([100.0]))
    found = np.concatenate([one, partners])
    found = found[np.argsort(found[:, 0])]
    np.testing.assert_allclose(found[:, :2], pair[:, :2], atol=1e-3)
    np.testing.assert_allclose(found[:, 2], pair[:, 2], atol=1e-2)
    np.testing.assert_allclose(residual, image - image_of(view, found), atol=1e-6)
    one = np.array([[0.2, 0.1, 2.0, 9e5]])
    residual = np.zeros(view.camera.rows * view.camera.columns)
    partners = split(observed(view, residual, np.ones_like(residual)), one, np.array([True]), 1e5, np.array([1.0]))
    assert not partners.any()
    np.testing.assert_allclose(residual, 0.0, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("wrong", [-0.5, -1.5])
def test_a_particle_at_a_wrong_depth_finds_its_own(view: View, wrong: float) -> None:
    true = np.array([[0.21, 0.13, 0.5, 5e5], [-0.9, 0.6, 1.5, 5e5]])
    image = image_of(view, true)
    found = true.copy()
    found[0, 2] = wrong
    residual = image - image_of(view, found)
    observation = observed(view, residual, 1.0 / (image + 36.0))
    moved = try_other_depths(observation, found, np.array([True, True]), 1e5, 10.0)
    assert moved.tolist() == [True, False]
    np.testing.assert_allclose(found[:, :3], true[:, :3], atol=2e-3)
    np.testing.assert_allclose(residual, image - image_of(view, found), atol=1e-6)


@pytest.mark.thorough
def test_tiles_share_no_pixel_whatever_the_threads(view: View, rng: np.random.Generator, one_thread) -> None:
    particles = scattered(80, rng)
    tiles, after = tiles_of(view, particles, DEPTHS)
    assert sorted(np.concatenate(tiles).tolist()) == list(range(80))
    assert len(tiles) > 4
    lit = [image_of(view, particles[numbers]) > 0.0 for numbers in tiles]
    for one, other in combinations(range(len(tiles)), 2):
        assert one in after[other] or not np.any(lit[one] & lit[other])
    assert all(before < number for number, each in enumerate(after) for before in each)
    particles = scattered(60, rng)
    image = image_of(view, particles)
    start = particles + rng.normal(0.0, (0.01, 0.01, 0.05, 2e4), particles.shape)
    results = []
    for threads in (one_thread(), nullcontext()):
        with threads:
            found = start.copy()
            residual = image - image_of(view, found)
            refine(observed(view, residual, np.ones_like(image)), found)
            results.append((found, residual))
    np.testing.assert_array_equal(results[1][0], results[0][0])
    np.testing.assert_array_equal(results[1][1], results[0][1])


@pytest.mark.thorough
def test_errors_that_are_alike_widen_a_particles(view: View) -> None:
    particle = np.array([[0.20, 0.10, 1.5, 5e5]])
    weight, jacobian = 1.0 / (image_of(view, particle) + 36.0), slopes_of(view, particle)
    lit = np.flatnonzero(jacobian.any(axis=0))
    row, column = np.divmod(lit, view.camera.columns)
    distance = np.abs(row[:, np.newaxis] - row) + np.abs(column[:, np.newaxis] - column)
    alike = np.where(distance == 0, 1.0, 0.2 * 0.8**distance)
    whitened = jacobian[:, lit] * np.sqrt(weight[lit])
    moved_by = np.linalg.inv(whitened @ whitened.T) @ whitened
    # What chi-squared exceeds 1 by is alike throughout.
    for worse, law in ((1.0, alike), (1.5, alike + 0.5 * 0.8**distance)):
        found = stated(view, particle, Correlation(0.2, 0.8), worse)[0]
        np.testing.assert_allclose(np.diag(found), np.diag(moved_by @ law @ moved_by.T), rtol=5e-3)
        assert found[2, 2] > 1.5 * np.linalg.inv(whitened @ whitened.T)[2, 2]


@pytest.mark.thorough
def test_errors_are_those_that_lenses_show(view: View, rng: np.random.Generator) -> None:
    particles = np.array([[0.20, 0.10, 2.5, 5e5], [0.22, 0.11, 2.7, 4e5]])
    clean, jacobian, lens = image_of(view, particles), slopes_of(view, particles), lens_numbers(view).ravel()
    weight = 1.0 / (clean + 36.0)
    residual = clean * rng.normal(0.0, 0.05, lens.max() + 1)[lens]
    inverse = np.linalg.inv((jacobian * weight) @ jacobian.T)
    moved_by = inverse[:4] @ (jacobian * np.sqrt(weight))
    expected = np.zeros(4)
    for number in np.unique(lens[jacobian.any(axis=0)]):
        inside = lens == number
        moves, slopes = moved_by[:, inside], (jacobian * np.sqrt(weight))[:, inside]
        tie = moves @ slopes.T
        taken = np.einsum("ai,ij,aj->a", tie, inverse, tie) / np.sum(moves**2, axis=1)
        expected += (moves @ (residual * np.sqrt(weight))[inside] / np.maximum(1.0 - taken, 0.25)) ** 2
    growth = np.mean((expected / np.diag(inverse)[:4])[:3])
    assert growth > 5.0
    found = joint_covariance(observed(view, residual, weight), particles, WHITE, np.ones(2))
    # Slopes of lenses that share profiles are off by up to a hundredth, and its neighbour's own pixels do not count.
    np.testing.assert_allclose(np.diag(found[0]), growth * np.diag(inverse)[:4], rtol=0.05)


@pytest.mark.thorough
@pytest.mark.parametrize("uneven", [0.0, 0.05])
def test_stated_errors_cover_what_is_alike_within_a_lens(view: View, rng: np.random.Generator, uneven: float) -> None:
    true, lens = scattered(60, rng) * (1.0, 1.0, 0.5, 1.0) + (0.0, 0.0, 2.2, 0.0), lens_numbers(view).ravel()
    covered, blind = [], []
    for particle in true[:, np.newaxis]:
        clean = image_of(view, particle)
        weight = 1.0 / (clean + 36.0)
        wrong = clean * rng.normal(0.0, uneven, lens.max() + 1)[lens]
        residual = wrong + rng.normal(0.0, 1.0, clean.size) / np.sqrt(weight)
        found = particle.copy()
        for _ in range(3):
            refine(observed(view, residual, weight), found)
        covariance = joint_covariance(observed(view, residual, weight), found, WHITE, np.ones(1))
        error = (found - particle)[0]
        covered.append(np.abs(error) < 1.96 * np.sqrt(np.diagonal(covariance[0])))
        blind.append(np.abs(error) < 1.96 * np.sqrt(np.diagonal(stated(view, particle)[0])))
    # Of many errors 0.92 are covered, 0.97 of noise alone; two standard errors of the share of 180 are allowed.
    assert 0.88 <= np.mean(np.array(covered)[:, :3]) <= 0.99
    if uneven:
        assert np.mean(np.array(blind)[:, :3]) < 0.8


@pytest.mark.thorough
def test_correlation_is_read_off_what_is_left(rng: np.random.Generator) -> None:
    carried = rng.normal(size=(340, 340))
    for axis in (0, 1):
        carried = lfilter([np.sqrt(1.0 - 0.8**2)], [1.0, -0.8], carried, axis=axis)
    error = np.sqrt(0.7) * rng.normal(size=(300, 300)) + np.sqrt(0.3) * carried[40:, 40:]
    lit, noise = np.full(error.shape, 100.0), Noise(6.0, 2.0)
    found = error_correlation(lit, 9.0 * error, np.full(error.shape, 0.01), noise)
    # Some 90,000 / 80 patches that are alike tell a correlation to 3 % of the share.
    assert found == pytest.approx((0.3, 0.8), abs=0.03)
    white = error_correlation(lit, rng.normal(size=error.shape), np.ones(error.shape), noise)
    assert white.share < 0.02
    assert error_correlation(lit, 9.0 * error, np.zeros(error.shape), noise) == WHITE


@pytest.mark.parametrize("spread", [0.4, 0.7, 2.0, 6.3])
def test_read_noise_of_whole_counts_is_that_of_what_was_rounded(rng: np.random.Generator, spread: float) -> None:
    counts = rng.normal(0.0, spread, 50_000)
    true = float(np.std(np.rint(counts)))
    counts[::2] += rng.exponential(20.0 * spread, 25_000)
    assert read_noise(np.rint(counts)) == pytest.approx(true, rel=0.06)


@pytest.mark.parametrize(("spread", "level"), [(0.2, 100.3), (0.3, 100.0), (0.5, 100.5)])
def test_read_noise_below_a_count_less_a_dark_image_of_whole_counts(
    rng: np.random.Generator, spread: float, level: float
) -> None:
    """One rounded image less another one has no normal distribution: half or double of its noise was found."""
    image, dark = np.rint(level + spread * rng.normal(size=(2, 50_000)))
    less_dark = image - dark
    true = float(np.std(less_dark))
    less_dark[::4] += np.rint(rng.exponential(20.0, 12_500))
    assert read_noise(less_dark) == pytest.approx(true, rel=0.04)


def test_noise_of_light_is_found_of_whole_counts(rng: np.random.Generator) -> None:
    """The median of what one or two steps are apart is one of these: no noise at all was found of it."""
    model = 1.0 + rng.exponential(4.0, 20_000)
    left = np.rint(model + rng.normal(size=model.size) * np.sqrt(0.06 * model)) - model
    found = measured_noise(model, left, np.ones(model.size, np.bool_), Noise(ROUNDING_COUNTS, 1.0))
    for light in (4.0, 12.0):
        weight = found.weights(np.full(1, light), np.zeros(1), 0.0)
        assert 1.0 / weight == pytest.approx(0.06 * light + ROUNDING_COUNTS**2, rel=0.3)


def test_edges_are_wrong_by_as_much_where_they_are_dim(rng: np.random.Generator) -> None:
    """At the rim of lens images the model is off by a share of the light beside, however little a pixel has."""
    model = rng.uniform(1.0, 16.0, 60_000)
    true = Noise(ROUNDING_COUNTS, 0.01, 0.0, 0.4)
    left = rng.normal(size=model.size) / np.sqrt(true.weights(model, np.zeros_like(model), 0.0))
    found = measured_noise(model, left, np.ones(model.size, np.bool_), Noise(ROUNDING_COUNTS, 1.0), rims=True)
    for light in (2.0, 12.0):
        expected, measured = (each.weights(np.full(1, light), np.zeros(1), 0.0) for each in (true, found))
        assert measured == pytest.approx(expected, rel=0.15)
    # Dark pixels are as noisy as they were, and faint light is not wrong by more than it is.
    assert found.weights(np.zeros(1), np.zeros(1), 0.0) == pytest.approx(ROUNDING_COUNTS**-2)
    assert found.weights(np.full(1, 0.1), np.zeros(1), 0.0) > 1.0 / (ROUNDING_COUNTS**2 + 0.1**2 + 0.01)


def test_mean_of_whole_counts_is_that_of_many(rng: np.random.Generator) -> None:
    counts = rng.uniform(-1.0, 9.0, 40)
    for sigma in (0.0, 0.1, 0.4, 0.9):
        many = np.rint(counts + sigma * rng.normal(size=(20_000, 40))).mean(axis=0)
        assert mean_whole(counts, np.full(40, sigma)) == pytest.approx(many, abs=0.03)


@pytest.mark.thorough
def test_noise_is_what_a_fit_leaves_and_rounding_does_not_tell_it(rng: np.random.Generator) -> None:
    model = rng.uniform(0.0, 2000.0, 100_000)
    true = Noise(6.0, 5.0, 0.05)
    residual = rng.normal(size=model.size) / np.sqrt(true.weights(model, np.zeros_like(model), 0.0))
    # A tenth of the pixels hold light that was not found, or are not usable.
    residual[::20] += 5e3
    usable = np.ones(model.size, np.bool_)
    usable[1::20], residual[1::20] = False, 1e6
    found = measured_noise(model, residual, usable, Noise(6.0, 2.0))
    # Of some 3,000 pixels a median of squares is known to 4 %; the strays widen it by a tenth.
    assert found.read_counts == 6.0
    assert found.gain_counts == pytest.approx(5.0, rel=0.2)
    assert found.model_error == pytest.approx(0.05, rel=0.2)
    # One tracer's pixels tell the noise of all their light to a third.
    single = measured_noise(model[:400], residual[:400], usable[:400], Noise(6.0, 2.0))
    dim, bright = (np.full(1, counts) for counts in (300.0, 1500.0))
    for counts in (dim, bright):
        expected, measured = (each.weights(counts, np.zeros(1), 0.0) for each in (true, single))
        assert measured == pytest.approx(expected, rel=0.5)
    assert measured_noise(model[:100], residual[:100], usable[:100], Noise(6.0, 2.0)) == Noise(6.0, 2.0)
    # Light that fills micro-images makes many pixels alike: rounding must not tell in which class they are.
    model = np.repeat(rng.uniform(50.0, 500.0, 60), 90)
    residual = rng.normal(size=model.size) * np.sqrt(36.0 + 2.0 * model)
    noises = [
        measured_noise(light, residual, np.ones(model.size, np.bool_), Noise(6.0, 1.0))
        for light in (model, model * (1.0 + 1e-13 * rng.normal(size=model.size)))
    ]
    assert noises[1].gain_counts == pytest.approx(noises[0].gain_counts, rel=1e-9)
    assert noises[1].model_error == pytest.approx(noises[0].model_error, rel=1e-9, abs=1e-12)


# Half a pixel and a third; a hundredth of the aperture; a fifth of the radius; 2e-4 of stretch at the corner.
TRUE = Nuisances(2.7e-3, -1.8e-3, -0.12, 5e-3, 3e-5)
NOISE = Noise(6.0, 2.0)


@pytest.fixture
def small_view(table2: Camera, water: Media) -> View:
    return raw_view(replace(table2, columns=460, rows=420), water, 0.025)


def picture(view: View, particles: Floats, rng: np.random.Generator) -> Floats:
    """The light of particles with the noise that is stated for it."""
    image = image_of(view, particles)
    return image + rng.normal(0.0, np.sqrt(NOISE.read_counts**2 + NOISE.gain_counts * image))


@pytest.mark.thorough
def test_what_the_camera_lacks_is_found_and_one_that_is_right_is_left_as_it_is(
    small_view: View, rng: np.random.Generator
) -> None:
    true = rng.uniform((-1.0, -0.9, -3.5, 4e5), (1.0, 0.9, 3.5, 6e5), (60, 4))
    image = picture(TRUE.applied(small_view), true, rng)
    start = true + rng.normal(0.0, (2e-3, 2e-3, 0.03, 1e4), true.shape)
    fit = fit_nuisances(image, small_view, start, NOISE, DEPTHS)
    off, sigma = fit.found.whole[:5] - TRUE.whole[:5], fit.sigma.whole[:5]
    assert np.all(np.abs(off) < 4.0 * sigma)
    # All but the distortion, which so small a sensor does not show, are far outside their errors before.
    assert np.all(np.abs(TRUE.whole[:5][:4]) > 8.0 * sigma[:4])
    np.testing.assert_allclose(fit.view.centres_mm, TRUE.applied(small_view).centres_mm, atol=4.0 * sigma[0])
    assert np.median(np.abs(fit.particles[:, 2] - true[:, 2])) < 0.01
    fit = fit_nuisances(picture(small_view, true[:30], rng), small_view, true[:30], NOISE, DEPTHS)
    assert np.all(np.abs(fit.found.whole[:5]) < 4.0 * fit.sigma.whole[:5])


@pytest.mark.thorough
def test_by_waves_the_aperture_is_believed(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    """All else is found, by the light and the derivatives of line responses."""
    small, depths = replace(table2, columns=300, rows=280), (1.0, 1.6)
    small_view = raw_view(small, water, 0.025, light=Light(532e-6, 0.3, depths))
    true = rng.uniform((-0.6, -0.5, 1.1, 4e5), (0.6, 0.5, 1.5, 6e5), (20, 4))
    # So near focus four rounds do not settle what half a pixel and a fifth of the radius spoil.
    planted = Nuisances(9e-4, -6e-4, 0.0, 3e-3)
    image = picture(planted.applied(small_view), true, rng)
    start = true + rng.normal(0.0, (2e-3, 2e-3, 0.03, 1e4), true.shape)
    fit = fit_nuisances(image, small_view, start, NOISE, depths)
    off, sigma = fit.found.whole[:5] - planted.whole[:5], fit.sigma.whole[:5]
    assert fit.found.aperture_radius_mm == 0.0
    assert np.isnan(sigma[2])
    assert np.all(np.abs(off[[0, 1, 3]]) < 4.0 * sigma[[0, 1, 3]])
    assert np.all(np.abs(planted.whole[:5][[0, 1, 3]]) > 8.0 * sigma[[0, 1, 3]])
