"""The whole search on a small image: particles are found where they were put, and their errors are as stated."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import Grid, Scale
from lfpiv_cli.names import ColumnAxis, Layout
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.particles.joining import boxes_of, explain_rest, find_peaks
from lfpiv_cli.particles.rounds import ROUNDS, find_particles, first_pass, first_typical_light
from lfpiv_cli.particles.search import noise_with
from lfpiv_cli.particles.view import Light, lens_pixels, raw_view
from lfpiv_cli.reconstruction.solvers import Problem, normalisers
from lfpiv_cli.synthetic.render import Balls, render_points
from lfpiv_cli.validation.volume import particle_figures
from lfpiv_cli.weights.model import Weights
from tests.commands import WATER
from tests.particle_images import found as is_found
from tests.particle_images import light_on, seen_by, task_for


def grid_of(shape_xyz: tuple[int, int, int], z_mm: float, spacing_mm: tuple[float, float, float] = (0.1,) * 3) -> Grid:
    """Return the grid of a volume about a depth, of voxels of 0.1 mm where nothing else is said."""
    return Grid.centred(shape_xyz, spacing_mm, (0.0, 0.0, z_mm))


def corners_mm(grid: Grid) -> Floats:
    """Return the lowest and the highest corner of a volume (2, 3)."""
    return np.array([grid.bounds_mm(axis) for axis in range(3)]).T


def by_rays(camera: Camera, true: Floats, light: ArrayLike, rng: np.random.Generator, **how: Any) -> Floats:
    """Return the image that rays, or waves, make of tracers in water."""
    balls = Balls(true, light, 0.05)
    return render_points(camera, ObjectSpace(WATER, None, "paraxial"), balls, rng, **({"rays": 100_000} | how))


@pytest.mark.thorough
@pytest.mark.parametrize(("column_axis", "layout"), [("x", "square"), ("y", "square"), ("y", "hexagonal")])
def test_particles_are_found_where_they_are(
    table2: Camera, water: Media, rng: np.random.Generator, column_axis: ColumnAxis, layout: Layout
) -> None:
    lattice = Lattice.regular(0.1, layout)
    camera = replace(table2, columns=420, rows=360, column_axis=column_axis, lattice=lattice)
    size = (18, 15, 16) if column_axis == "x" else (15, 18, 16)
    grid, over_sigma = grid_of(size, 1.9), []
    for _ in range(2):
        true, light = rng.uniform(*corners_mm(grid), (30, 3)), rng.uniform(3e5, 6e5, 30)
        expected = by_rays(camera, true, light, rng)
        image = rng.poisson(expected).astype(np.float32) + rng.normal(0.0, 6.0, expected.shape).astype(np.float32)
        found = find_particles(task_for(image, camera, water, grid))
        scale = np.array([0.05, 0.05, 0.2])
        distance, nearest = KDTree(found.position_mm / scale).query(true / scale)
        matched = distance < 1.0
        assert matched.sum() >= 27
        assert len(found.position_mm) <= 32
        error = found.position_mm[nearest[matched]] - true[matched]
        assert np.median(np.abs(error[:, :2])) < 1e-3
        assert np.median(np.abs(error[:, 2])) < 0.02
        assert np.median(np.abs(found.light_counts[nearest[matched]] / light[matched] - 1.0)) < 0.02
        over_sigma.append(error / np.sqrt(np.diagonal(found.covariance_mm2, axis1=1, axis2=2))[nearest[matched]])
    # The rays' own noise adds to the sensor's; a factor of two either way is what two images can hold to: the median of
    # 27 particles has a standard error of a quarter.
    typical = np.median(np.abs(np.concatenate(over_sigma)), axis=0)
    assert np.all(typical < 2.0 * 0.6745)
    assert np.all(typical > 0.5 * 0.6745)


def scaled(camera: Camera, factor: float) -> Camera:
    """Return the camera with all lengths multiplied."""
    return replace(
        camera,
        focal_length_mm=factor * camera.focal_length_mm,
        aperture_mm=factor * camera.aperture_mm,
        microlens_focal_length_mm=factor * camera.microlens_focal_length_mm,
        microlens_distance_mm=factor * camera.microlens_distance_mm,
        lattice=camera.lattice.scaled(factor),
        pixel_mm=factor * camera.pixel_mm,
    )


@pytest.mark.thorough
def test_a_larger_world_shows_the_same(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    camera = replace(table2, columns=200, rows=180)
    # Some overlap, some lie near the focal plane: candidates, splitting, other depths and merging all take part.
    true = rng.uniform((-0.4, -0.35, -0.6, 3e5), (0.4, 0.35, 1.3, 6e5), (12, 4))
    image, found = seen_by(camera, water, true, (-1.0, 2.0)), []
    image += rng.normal(0.0, 6.0, image.size)
    # Powers of two leave every digit as it is: a length that does not scale is all that can make a difference.
    for factor in (1.0, 4.0, 0.25):
        grid = grid_of((8, 7, 19), factor * 0.35, (factor * 0.1,) * 3)
        state = first_pass(task_for(image, scaled(camera, factor), water, grid, factor * 0.025), ROUNDS[2:4])
        found.append(state.particles / (factor, factor, factor, 1.0))
    assert len(found[0]) > 8
    for others in found[1:]:
        np.testing.assert_allclose(others, found[0], rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, 1])
def test_a_single_tracer_is_found_in_a_volume_partly_out_of_view(table2: Camera, water: Media, seed: int) -> None:
    """Where a voxel is hardly seen, noise is explained by more light than any tracer has."""
    rng = np.random.default_rng(seed)
    camera, true = replace(table2, columns=160, rows=160), np.array([[0.05, -0.1, 1.8, 5e5]])
    image = np.rint(with_noise(seen_by(camera, water, true, (1.0, 3.0)), rng))
    state = first_pass(task_for(image, camera, water, grid_of((24, 24, 7), 1.9)), ROUNDS[:1])
    np.testing.assert_allclose(state.particles, true, rtol=0.02, atol=2e-3)


def test_light_that_may_be_haze_is_no_particle(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    camera, true = replace(table2, columns=160, rows=160), np.array([[0.05, -0.1, 1.8, 5e5], [-0.2, 0.15, 1.5, 2.5e5]])
    image = with_noise(seen_by(camera, water, true, (1.0, 3.0)), rng)
    task = task_for(image, camera, water, grid_of((10, 10, 7), 1.9))
    for share, found in ((0.0, 2), (0.4, 2), (0.6, 1)):
        # In pixels of the fainter one, which is as bright as 2 standard errors are of half a one.
        error = np.full(image.size, share * 2.5e5 / lens_pixels(task.view))
        assert len(first_pass(replace(task, haze_error=error), ROUNDS[:1]).particles) == found


@pytest.mark.thorough
def test_steps_of_light_that_is_rounded_are_no_particles(
    table2: Camera, water: Media, rng: np.random.Generator
) -> None:
    """Of haze of half a count, which a sensor with hardly any noise records as none or one."""
    camera = replace(table2, columns=160, rows=160)
    crowd = np.column_stack([rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 2.8), (20_000, 3)), np.ones(20_000)])
    haze = seen_by(camera, water, crowd, (1.0, 3.0))
    image = np.rint(0.5 * haze / haze.max() + 0.3 + rng.normal(0.0, 0.1, haze.size))
    state = first_pass(task_for(image, camera, water, grid_of((10, 10, 7), 1.9)), ROUNDS)
    assert len(state.particles) == 0


def with_noise(light: Floats, rng: np.random.Generator) -> Floats:
    return rng.poisson(0.5 * light) / 0.5 + rng.normal(0.0, 6.0, light.shape)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("counts", "recorded"),
    [
        (0.0, "noisy"),  # nothing but noise
        (3e3, "noisy"),  # as bright as the noise of a pixel
        (5e4, "thresholded"),
        (5e5, "without noise"),
        (2e7, "noisy"),
    ],
)
def test_any_brightness_will_do(
    table2: Camera, water: Media, rng: np.random.Generator, counts: float, recorded: str
) -> None:
    camera, axis = replace(table2, columns=240, rows=240), np.array([-0.42, 0.0, 0.42])
    true = np.stack(np.meshgrid(axis, axis, [1.9], [counts], indexing="ij"), axis=-1).reshape(-1, 4)
    true[:, :3] += rng.uniform((-0.05, -0.05, -0.3), (0.05, 0.05, 0.3), (9, 3))
    image = seen_by(camera, water, true, (1.0, 3.0))
    if recorded != "without noise":
        image = with_noise(image, rng)
    if recorded == "thresholded":
        image[image < 25.0] = 0.0
    found = find_particles(task_for(np.rint(image), camera, water, grid_of((12, 12, 12), 1.9)), ROUNDS[::5])
    if counts == 0.0:
        assert not len(found.position_mm)
        return
    assert len(found.position_mm) == len(true)
    distance, nearest = KDTree(true[:, :3] / (0.03, 0.03, 0.3)).query(found.position_mm / (0.03, 0.03, 0.3))
    assert np.all(distance < 1.0)
    assert len(np.unique(nearest)) == len(true)


@pytest.mark.thorough
def test_pixels_that_are_left_out_do_not_matter(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    camera, grid = replace(table2, columns=360, rows=300), grid_of((14, 11, 10), 1.9)
    true = rng.uniform(*corners_mm(grid), (12, 3))
    image = by_rays(camera, true, 4e5, rng, rays=50_000)
    image += rng.normal(0.0, 6.0, image.shape)
    left_out = np.zeros(image.shape, np.bool_)
    left_out[100:140, 150:200] = True
    spoilt = (np.where(left_out, reflection, image) for reflection in (0.0, 5e4))
    found = [find_particles(task_for(each, camera, water, grid, excluded=left_out)) for each in spoilt]
    np.testing.assert_array_equal(found[1].position_mm, found[0].position_mm)
    np.testing.assert_array_equal(found[1].covariance_mm2, found[0].covariance_mm2)
    distance, _ = KDTree(found[0].position_mm / (0.05, 0.05, 0.2)).query(true / (0.05, 0.05, 0.2))
    assert np.sum(distance < 1.0) >= 10
    assert len(found[0].position_mm) <= 13


def test_photons_count_as_the_camera_has_them(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    camera = replace(table2, columns=120, rows=120)
    image = rng.normal(0.0, 6.0, (120, 120))
    # 2.5e5 photons a particle where they are not known.
    for known, gain in (({"photons_per_count": 0.25}, 4.0), ({}, 2.0)):
        assert noise_with(task_for(image, camera, water, grid_of((4, 4, 3), 1.9), **known), 5e5).gain_counts == gain


@pytest.mark.thorough
def test_an_empty_image_has_no_particles(table2: Camera, water: Media) -> None:
    camera, image = replace(table2, columns=200, rows=200), np.zeros((200, 200))
    found = find_particles(task_for(image, camera, water, grid_of((6, 6, 4), 2.0)))
    assert found.position_mm.shape == (0, 3)
    np.testing.assert_array_equal(found.residual, image)


def test_what_is_explained_gives_no_candidate(table2: Camera, water: Media) -> None:
    camera = replace(table2, columns=300, rows=300)
    weights = Weights.factorised(camera, water, grid_of((10, 10, 5), 2.0, (0.1, 0.1, 0.2)))
    volume = np.zeros(weights.shape, np.float32)
    volume[2, 2, 2] = volume[2, 7, 7] = 1e5
    one = np.zeros_like(volume)
    one[2, 2, 2] = 1e5
    image, background = weights.forward(volume), weights.forward(one)
    rest = explain_rest(Problem.of(weights.padded, image, normalisers(weights.padded)), background, 10)
    index, light = find_peaks(rest, boxes_of(camera.scale(water), weights.grid.spacing_mm))
    px, py, pz = weights.padding_xyz
    np.testing.assert_allclose(index[0], (7 + px, 7 + py, 2 + pz), atol=0.3)
    assert light[0] > 0.8e5
    assert np.all(light[np.abs(index - (2 + px, 2 + py, 2 + pz)).max(axis=1) < 2.0] < 0.05e5)


def test_typical_light_is_not_the_noise_s_and_peaks_have_light() -> None:
    noise = np.linspace(0.5, 9.0, 400)
    # Where nothing stands out all peaks are tried, and none is accepted that noise makes.
    assert first_typical_light(noise, 1.0) == np.percentile(noise, 90.0)
    assert first_typical_light(np.zeros(0), 1.0) == 0.0
    # One tracer, which the volume shows as a bright peak and two faint ones beside it.
    assert first_typical_light(np.append(noise, [5000.0, 900.0, 300.0]), 1.0) == 5000.0
    many = np.linspace(500.0, 1500.0, 101)
    assert first_typical_light(np.append(noise[:20], many), 1.0) == pytest.approx(1380.0, abs=5.0)
    # Behind a bright plane, running sums leave traces of it where there is none.
    volume = np.zeros((12, 7, 7), np.float32)
    volume[2:5, 3, 3] = 1e5, 0.1, 3e4
    with np.errstate(all="raise"):
        centres, light = find_peaks(volume, boxes_of(Scale(0.1, 1.064), (0.1, 0.1, 0.1)))
    assert np.all(light > 0.0)
    assert np.isfinite(centres).all()
    assert len(light) == 1


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("per_lens", "seed", "least"), [(1.5, 0, 0.92), (1.5, 1, 0.92), (1.5, 5, 0.92), (2.2, 7, 0.93)]
)
def test_crowded_tracers_are_told_apart_and_their_errors_are_covered(
    table2: Camera, water: Media, per_lens: float, seed: int, least: float
) -> None:
    # Within 1.9 mm many have one peak, and the image's own noise alone tells them apart.
    rng, camera = np.random.default_rng(seed), replace(table2, columns=500, rows=420)
    low, high = np.array([-1.0, -0.8, 0.95]), np.array([1.0, 0.8, 2.85])
    true = rng.uniform((-1.3, -1.1, 0.95, 3e5), (1.3, 1.1, 2.85, 7e5), (int(572 * per_lens), 4))
    image = with_noise(seen_by(camera, water, true, (low[2], high[2])), rng)
    task = task_for(image, camera, water, grid_of((20, 16, 20), 1.9))
    found = find_particles(task)
    sigma = np.sqrt(np.diagonal(found.covariance_mm2, axis1=1, axis2=2))
    places = task.camera.to_image_axes(true[:, :3])
    figures = particle_figures(found.position_mm, places, low, high, 0.1, sigma)
    # With the noise taken for all that is left, and what fits badly for what fits worse than good ones, 0.92 of 1.5 for
    # each microlens were found, of 2.2 less than 0.8, and of their errors 0.78 were covered.
    assert figures["recall"] > least
    # Light of 2.2 that is larger by 1e-7 to 1e-5 ends with 0.917 to 0.949, four other seeds with 0.915 to 0.954.
    assert figures["precision"] > 0.91
    assert min(figures[f"coverage_{axis}"] for axis in "xyz") > 0.88


@pytest.mark.thorough
def test_where_the_model_of_light_is_wrong_tracers_are_not_split(table2: Camera, water: Media) -> None:
    # One for each microlens in light as waves, fitted by rays: as long as more than noise is left 1.55 times as many.
    rng, camera, grid = np.random.default_rng(1), replace(table2, columns=500, rows=420), grid_of((20, 16, 60), 0.0)
    true = rng.uniform((-1.3, -1.1, -3.0, 3e5), (1.3, 1.1, 3.0, 7e5), (572, 4))
    waves = raw_view(camera, water, 0.025, light=Light(532e-6, 0.3, (-4.7, 4.7)))
    image = with_noise(light_on(waves, true, grid.bounds_mm(2)), rng)
    assert len(find_particles(task_for(image, camera, water, grid)).position_mm) < 1.25 * len(true)


@pytest.mark.thorough
def test_tracers_that_shine_from_two_sides_are_hardly_split(table2: Camera, water: Media) -> None:
    # As balls with two glints, 0.4 for each microlens. What such light leaves is alike in pixels side by side, as noise
    # is not: where the noise alone decides 353 are found.
    rng, camera, grid = np.random.default_rng(1), replace(table2, columns=500, rows=420), grid_of((20, 16, 60), 0.0)
    true = rng.uniform((-1.3, -1.1, -3.0, 3e5), (1.3, 1.1, 3.0, 7e5), (230, 4))
    sides = [Balls(true[:, :3] + (side, 0.0, 0.0), 0.5 * true[:, 3], 0.02) for side in (-0.018, 0.018)]
    space = ObjectSpace(WATER, None, "paraxial")
    image = with_noise(sum(render_points(camera, space, side, rng) for side in sides), rng)
    found = find_particles(task_for(image, camera, water, grid)).position_mm
    assert 0.95 * len(true) < len(found) < 1.05 * len(true)


@pytest.mark.thorough
def test_tracers_beyond_the_volume_are_found_there(table2: Camera, water: Media) -> None:
    # Two thirds lie up to 1 mm outside. Held within 0.3 mm of it, 22 ended there, and depths of those inside were seven
    # times as far off.
    rng = np.random.default_rng(3)
    camera, grid = replace(table2, columns=320, rows=280), grid_of((18, 15, 9), 1.9)
    true = rng.uniform((-0.8, -0.7, 0.5, 3e5), (0.8, 0.7, 3.3, 6e5), (60, 4))
    image = np.rint(with_noise(seen_by(camera, water, true, (0.0, 4.0)), rng))
    found = find_particles(task_for(image, camera, water, grid))
    sigma = np.sqrt(np.diagonal(found.covariance_mm2, axis1=1, axis2=2))
    figures = particle_figures(found.position_mm, camera.to_image_axes(true[:, :3]), *corners_mm(grid), 0.1, sigma)
    assert found.beyond.sum() <= 1
    assert min(figures["recall"], figures["precision"]) > 0.95
    assert figures["rms_z_voxel"] < 0.05


@pytest.mark.thorough
@pytest.mark.parametrize("waves", [None, Waves(532e-6)])
def test_what_another_physics_leaves_is_alike(table2: Camera, water: Media, waves: Waves | None) -> None:
    # By waves 0.065 to 0.11 of the light near the focal plane, 0.6 of its depths covered; by rays up to 0.05.
    rng, camera = np.random.default_rng(0), replace(table2, columns=240, rows=220)
    true, light = rng.uniform((-0.45, -0.4, -0.75), (0.45, 0.4, 0.75), (10, 3)), rng.uniform(3e5, 6e5, 10)
    image = with_noise(by_rays(camera, true, light, rng, waves=waves), rng)
    found = find_particles(task_for(np.rint(image), camera, water, grid_of((10, 9, 16), 0.0)))
    left = np.linalg.norm(found.residual) / np.linalg.norm(image)
    assert (left * np.sqrt(found.alike) > 0.06) == (waves is not None)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("waves", "light", "least"),
    [
        (None, 2e4, 0.8),
        # Of another physics than is fitted: 0.45 of the depths were covered.
        (Waves(532e-6), 1e5, 0.5),
    ],
)
def test_errors_of_single_tracers_near_the_focal_plane_are_covered(
    table2: Camera, water: Media, waves: Waves | None, light: float, least: float
) -> None:
    camera, over_sigma = replace(table2, columns=150, rows=150), []
    grid = grid_of((5, 5, 50), 0.0, (0.1, 0.1, 0.2))
    for seed in range(100, 124):
        rng = np.random.default_rng(seed)
        true = rng.uniform((-0.1, -0.1, -0.8), (0.1, 0.1, 0.8), (1, 3))
        image = with_noise(by_rays(camera, true, light, rng, waves=waves), rng)
        found = find_particles(task_for(np.rint(image), camera, water, grid))
        assert len(found.position_mm) >= 1
        over_sigma.append((found.position_mm[0] - true[0]) / np.sqrt(np.diagonal(found.covariance_mm2[0])))
    # Of 24 within two binomial standard errors of what many show: 0.97, and 0.77 by waves.
    assert np.all(np.mean(np.abs(over_sigma) < 1.96, axis=0) >= least)
    # Nor are errors stated that are much too large: three to five times they were.
    assert np.all(np.median(np.abs(over_sigma), axis=0) > 0.3)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1, 4, 6, 9])
def test_small_tracers_of_which_a_lens_or_two_are_lit_are_all_found(table2: Camera, water: Media, seed: int) -> None:
    # Alone, half a millimetre from each other, as bright as any: only its own part of a lens leads a fit to a tracer.
    rng = np.random.default_rng(seed)
    camera, grid = replace(table2, columns=500, rows=420), grid_of((24, 20, 36), 0.0)
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-2, 3) * 0.5, np.arange(-1, 2) * 0.5))
    depth = rng.uniform(0.4, 1.7, x.size) * rng.choice([-1.0, 1.0], x.size)
    beside = rng.uniform(-0.1, 0.1, (2, x.size))
    true = np.column_stack([x + beside[0], y + beside[1], depth, rng.uniform(3e5, 7e5, x.size)])
    light = light_on(raw_view(camera, water, 0.01), true, grid.bounds_mm(2))
    image = light + np.sqrt(36.0 + 2.0 * light) * rng.normal(size=light.size)
    particles = find_particles(task_for(image, camera, water, grid, 0.01)).position_mm
    np.testing.assert_array_equal(is_found(particles, true), True)


@pytest.mark.thorough
def test_depths_behind_few_pixels_for_each_lens_are_covered(table2: Camera, water: Media) -> None:
    camera, over_sigma = replace(table2, pixel_mm=0.0125, columns=120, rows=120), []
    grid, space = grid_of((5, 5, 40), 3.2, (0.1, 0.1, 0.1)), ObjectSpace(water, None, "paraxial")
    for seed in range(16):
        rng = np.random.default_rng(seed)
        true = rng.uniform((-0.1, -0.1, 2.7), (0.1, 0.1, 3.7), (1, 3))
        image = render_points(camera, space, Balls(true, 2e6, 0.02), rng, rays=400_000).ravel()
        found = find_particles(task_for(np.rint(with_noise(image, rng)), camera, water, grid, 0.01))
        over_sigma.append((found.position_mm[0] - true[0])[2] / np.sqrt(found.covariance_mm2[0, 2, 2]))
    # Of 16 all but two: errors that knew of noise alone covered a fourth of them, and the worst was eleven of them off.
    assert np.mean(np.abs(over_sigma) < 1.96) >= 14 / 16
    assert np.median(np.abs(over_sigma)) > 0.3
