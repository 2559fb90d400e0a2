"""The response of a particle against rays, finite differences, its twin by pixels: in air, behind walls, in pipes."""

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.names import Layout
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media, Window, exact_lateral_mm
from lfpiv_cli.optics.surfaces import Plane
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points, trace
from lfpiv_cli.particles.cells import cell_shares, covered_share, level_at, share_at
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import observation_of
from lfpiv_cli.particles.noise import Noise, pixel_weights
from lfpiv_cli.particles.pencil import MEAN_SQUARE, NODES, WEIGHTS, cubic_at, room_for_pencil, set_pencil
from lfpiv_cli.particles.refraction import on_line_of_sight, paraxial_shift, places_by_snell
from lfpiv_cli.particles.view import View, footprint_radius_mm, on_array_mm, raw_view, tile_side_mm, with_radius
from lfpiv_cli.synthetic.render import Balls, render_points
from tests.known_rays import image_of, tube_of
from tests.particle_images import fit_moved, light_on, rows_image, rows_of
from tests.particle_twin import twin_image

RADIUS_MM = 0.025
# In, near and out of focus, on both sides, off the axis; light goes through 1 to 50 lenses.
PLACES = [(0.31, -0.2, 3.0), (0.53, 0.21, 0.02), (-0.62, 0.4, 0.4), (0.2, 0.3, -4.0)]


@pytest.fixture(scope="module", params=["square", "hexagonal", "turned far"])
def small(table2: Camera, request: pytest.FixtureRequest) -> Camera:
    """The paper's camera with a small sensor and an array that is turned, shifted and seen through distortion."""
    layout: Layout = "hexagonal" if request.param == "hexagonal" else "square"
    turned = np.deg2rad(1.0 if request.param == "turned far" else 0.12)
    lattice = Lattice.regular(0.1, layout, turned, (0.013, -0.02))
    return replace(table2, lattice=lattice, columns=400, rows=360, distortion_per_mm2=2e-4)


@pytest.fixture(scope="module")
def view(small: Camera, water: Media) -> View:
    """What the small camera sees: its tables for hexagons take longer than the tests."""
    return raw_view(small, water, RADIUS_MM)


def assert_rays_make(response: Floats, traced: Floats, rays: int, moved_mm: Floats | float) -> None:
    """A response (pixels, 4) is the light that so many rays make, and a fit to it would move by no more."""
    assert response[:, 0].sum() == pytest.approx(1.0, abs=1e-3)
    # The rays' own noise is 0.8 sqrt(f/n) a pixel, summed over the pixels; the model may add half of a per cent.
    noise = 0.8 * np.sqrt(traced / rays).sum()
    assert np.abs(response[:, 0] - traced).sum() < noise + 0.005
    assert np.all(fit_moved(response, traced) < moved_mm)


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_response_is_what_rays_make(small: Camera, view: View, water: Media, place: tuple[float, float, float]) -> None:
    rays, space, ball = 1_000_000, ObjectSpace(water, None, "paraxial"), Balls([place], 1.0, 2 * RADIUS_MM)
    traced = render_points(small, space, ball, np.random.default_rng(1), rays=rays).ravel()
    # A thousandth of a voxel's width, and three hundredths in depth; near focus all light passes one lens, whichever
    # way the particle moves within it: no position to compare.
    moved = np.array([3e-4, 3e-4, 3e-3]) if abs(place[2]) >= 0.1 else np.inf
    light = twin_image(view, place)
    assert_rays_make(light, traced, rays, moved)
    # These rays fill the aperture evenly, and leave 0.002 to 0.0075; of an array that is turned by a degree upright
    # cells leave 0.011 to 0.02.
    assert np.abs(light[:, 0] - traced).sum() < 0.01


@pytest.mark.thorough
@pytest.mark.parametrize("depth_mm", [-4.6, 4.6])
@pytest.mark.parametrize(("layout", "most"), [("square", 0.004), ("hexagonal", 0.012)])
def test_small_balls_far_from_focus_are_what_rays_make(
    table2: Camera, water: Media, layout: Layout, most: float, depth_mm: float
) -> None:
    camera, radius_mm = replace(table2, lattice=Lattice.regular(0.1, layout), columns=320, rows=320), 0.005
    place, space = (0.03, 0.02, depth_mm), ObjectSpace(water, None, "paraxial")
    ball = Balls([place], 1.0, 2 * radius_mm)
    traced = render_points(camera, space, ball, np.random.default_rng(1), rays=4_000_000).ravel()
    light = rows_image(raw_view(camera, water, radius_mm), place)[:, 0]
    # 0.002 is left, behind hexagons 0.010; a pixel's patch is five times as wide as the ball's radius, and as one part
    # of square cells it left 0.02.
    assert np.abs(light - traced).sum() < most


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_derivatives_are_finite_differences(
    small: Camera, view: View, place: tuple[float, float, float], axis: int
) -> None:
    hexagonal = small.lattice.layout == "hexagonal"
    # Smaller steps would see where entries of the hexagons' table meet.
    step = np.zeros(3)
    step[axis] = (1e-3 if axis < 2 else 1e-2) if hexagonal else 1e-4
    ahead, behind = (twin_image(view, np.array(place) + sign * step)[:, 0] for sign in (1, -1))
    difference = (ahead - behind) / (2.0 * step[axis])
    analytic = twin_image(view, place)[:, 1 + axis]
    # The first moments' own slopes are left out: a hundredth of all, seen where a particle in focus hardly changes.
    # Hexagonal cells take a patch's mean slope for the slope of its middle: another hundredth.
    share = 0.02 if hexagonal else 0.01
    assert np.abs(analytic - difference).sum() < share * np.abs(difference).sum() + 0.005


def test_distortion_moves_the_light_and_each_lens_has_its_own_centre(view: View) -> None:
    place = (0.6, -0.5, 2.0)
    straight = view._replace(camera=view.camera._replace(distortion_per_mm2=0.0))
    with_it, without = (twin_image(v, place)[:, 0] for v in (view, straight))
    # k1 r^3 = 1e-4 mm of a lens of 0.1 mm: about 2e-3 of the light changes lenses.
    assert 1e-4 < np.abs(with_it - without).sum() < 1e-2
    moved = view._replace(centres_mm=view.centres_mm + np.array([0.004, 0.0]))
    place = (0.3, 0.1, 3.0)
    before, after = twin_image(view, place)[:, 0], twin_image(moved, place)[:, 0]
    columns = np.arange(before.size) % view.camera.columns
    shift_px = (after @ columns) / after.sum() - (before @ columns) / before.sum()
    # The light's centre stays (the same rays), moved by the little that the micro-images shift beneath it.
    assert abs(shift_px) < 1.0
    assert np.abs(before - after).sum() > 0.1


def test_rim_shares_are_areas() -> None:
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-13.0, 13.0, (30, 2)):
        u, v = np.meshgrid(*[(np.arange(200) + 0.5) / 100 - 1.0] * 2)
        covered = np.hypot(x + u * 0.6875, y + v * 0.6875) <= 12.5
        share, mean_x, mean_y, *_ = covered_share(x, y, 1.375, 12.5)
        assert share == pytest.approx(covered.mean(), abs=7e-3)
        assert (mean_x, mean_y) == pytest.approx(((u * covered).mean(), (v * covered).mean()), abs=6e-3)
    for at in (12.1, 12.3, 12.5, 12.8):
        share, _, _, slope, _ = covered_share(at, 0.0, 1.2, 12.5)
        # The rim is 0.005 of a patch lower at its ends; patches of the table's own width would be off by up to 0.04.
        assert share == pytest.approx(0.5 + (12.5 - at) / 1.2, abs=0.01)
        assert slope == pytest.approx(-1.0 / 1.2, rel=0.05)


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_depths_before_a_slow_lens_are_true(layout: Layout) -> None:
    # At f/14 and M = -0.38 one lens more spreads the rays by a fortieth: rays that strike one place on the sensor
    # crossed the main lens at places that depend on where in the ball they come from.
    lattice = Lattice.regular(0.11, layout)
    camera = Camera(-0.383, 60.0, 4.25, 1.9, 1.9, lattice, 0.0074, 200, 200)
    media, rng = Media(), np.random.default_rng(5)
    view = raw_view(camera, media, 0.07)
    for depths in (-0.8, 1.5, 2.0):
        true = np.array([[0.3, 0.2, depths * view.scale.depth_mm, 1e6]])
        image = render_points(camera, ObjectSpace(media), Balls(true[:, :3], true[:, 3], 0.14), rng, rays=2_000_000)
        found, residual, limits = true.copy(), image.ravel().copy(), (-60.0, 60.0)
        add_all(view, found, -1.0, residual, limits)
        for _ in range(4):
            refine(observation_of(view, residual, 1.0 / (image.ravel() + 100.0), limits), found)
        # Noise of so many rays: 5e-4 of a depth. With all of the ball taken for its middle the error is 0.02, and 0.01
        # with hexagons, where what is seen of the ball is taken from the slopes of P.
        within = 2e-3 if layout == "square" else 4e-3
        assert abs(found[0, 2] - true[0, 2]) < within * view.scale.depth_mm
        assert np.abs(found[0, :2] - true[0, :2]).max() < 2e-3 * view.scale.lens_mm


@pytest.mark.thorough
def test_hexagonal_cells_share_out_all_light() -> None:
    lattice = Lattice.regular(0.1, "hexagonal", np.deg2rad(0.7))
    table, side2, step, radius = cell_shares(lattice, RADIUS_MM)
    assert radius == RADIUS_MM
    i, j = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    lenses = lattice.points(np.stack([i.ravel(), j.ravel()], axis=1))
    for side in (0.0, 0.02, 0.07, 0.1):
        level, blend = level_at(side * side, side2)
        for place in np.random.default_rng(4).uniform(-0.1, 0.1, (20, 2)):
            shares = [share_at(*(place - lens), table[level], table[level + 1], blend, step) for lens in lenses]
            # Second-order terms between entries leave a quarter of (1/16)^3, chords 1e-4 of each of three cells.
            assert sum(share[0] for share in shares) == pytest.approx(1.0, abs=5e-4)


# In, near and out of focus, on both sides, off the axis, and over the sensor's edge; one on the corner of four lenses.
ALL_PLACES = [(0.31, -0.2, 3.0), (0.53, 0.21, 0.02), (-0.063, 0.07, 0.2), (0.2, 0.3, -4.0), (1.08, 0.2, 1.0)]


@pytest.fixture(
    scope="module",
    params=["square", "turned", "turned far", "hexagonal", "behind a wall", "overlapping", "wide balls"],
)
def any_view(table2: Camera, water: Media, request: pytest.FixtureRequest) -> View:
    layout: Layout = "hexagonal" if request.param == "hexagonal" else "square"
    turned = {"square": 0.0, "turned far": -0.9}.get(request.param, 0.12)
    lattice = Lattice.regular(0.1, layout, np.deg2rad(turned), (0.013, -0.02))
    camera = replace(table2, lattice=lattice, columns=400, rows=360, distortion_per_mm2=2e-4)
    wall = Window(camera.focus_distance_mm - 60.0, 5.0)
    space = ObjectSpace(water, wall, "exact") if request.param == "behind a wall" else None
    # Micro-images that overlap by two fifths of their distance: of one pixel's light up to four lenses have a part.
    if request.param in ("overlapping", "wide balls"):
        camera = replace(camera, aperture_mm=1.4 * camera.aperture_mm)
    return raw_view(camera, water, 0.08 if request.param == "wide balls" else 0.025, space=space)


@pytest.mark.thorough
@pytest.mark.parametrize("place", ALL_PLACES)
def test_rows_are_the_pixels_one_by_one(any_view: View, place: tuple[float, float, float]) -> None:
    slowly, quickly, (named, rows) = twin_image(any_view, place), rows_image(any_view, place), rows_of(any_view, place)
    # Rows are in single precision. Lenses of a turned array share profiles: those that are not in line at second order,
    # all of a thousandth of the light, and none of where a ball's edge begins to be seen.
    shared = any_view.cell_table.size == 0 and bool(np.ptp(any_view.centres_mm[:, 0, 0]) > 0.0)
    within = np.array([3e-4, 0.02, 0.02, 0.02]) if shared else np.full(4, 1e-4)
    assert np.all(np.abs(quickly - slowly).sum(axis=0) < within * np.abs(slowly).sum(axis=0))
    # A fit would move by this: a hundredth of what it does where all is known but light's own noise.
    assert np.all(fit_moved(slowly, quickly[:, 0]) < (1e-5, 1e-5, 2e-4))
    # In chi-squared light is squared: each pixel has all of it in one entry.
    # What rounding leaves beside the ball is none.
    lit = rows[:, 0] > 1e-6 * slowly[:, 0].max()
    assert np.unique(named[lit]).size == np.count_nonzero(lit)
    # It is the first that names the pixel, by which pixels that two particles light are found.
    assert np.isin(np.flatnonzero(lit), np.unique(named, return_index=True)[1]).all()


def test_weights_of_pixels_are_those_of_the_noise(rng: np.random.Generator) -> None:
    noise = Noise(5.0, 0.7, 0.03, 20.0)
    image, residual = rng.normal(100.0, 90.0, 500), rng.normal(0.0, 60.0, 500)
    usable = rng.random(500) < 0.9
    found = pixel_weights(noise, image, residual, usable, 0.1)
    expected = np.where(usable, noise.weights(image - residual, residual, 0.1), 0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-14)


DEPTHS = (-4.5, 4.5)


def behind(camera: Camera, media: Media, fluid_mm: float, wall_mm: float) -> ObjectSpace:
    """Return a wall and so much fluid before the focal point."""
    distance = camera.focus_distance_mm - fluid_mm * media.depth_ratio - wall_mm / media.window
    return ObjectSpace(media, Window(distance, wall_mm), "exact")


@pytest.mark.thorough
@pytest.mark.parametrize("fluid_mm", [5.0, 100.0])
def test_particles_are_fitted_with_refracted_rays(
    table2: Camera, water: Media, rng: np.random.Generator, fluid_mm: float
) -> None:
    camera = replace(table2, columns=900, rows=600)
    space = behind(camera, water, fluid_mm, 5.0)
    true = np.array([(-1.2, 0.3, 2.5), (0.4, -0.8, 3.1), (1.5, 0.6, -2.2), (-0.3, 1.1, -3.0), (1.6, 0.0, 1.2)])
    image = render_points(camera, space, Balls(true, np.full(5, 4e5), 0.05), rng, rays=100_000).ravel()
    view = raw_view(camera, water, 0.025, space=space)
    found = np.column_stack([true, np.full(5, 4e5)])
    residual = image.copy()
    add_all(view, found, -1.0, residual, DEPTHS)
    for _ in range(5):
        refine(observation_of(view, residual, 1.0 / (image + 36.0), DEPTHS), found)
    error = found[:, :3] - true
    # What the noise of so many rays moves a depth by; straight rays put the particles up to 0.1 mm too near.
    assert np.abs(error[:, 2]).max() < 0.003
    assert np.abs(error[:, :2]).max() < 3e-4


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
@pytest.mark.parametrize("place", [(0.31, -0.2, 3.0), (0.33, 0.21, 0.3), (-0.2, 0.1, -0.3)])
def test_light_bent_far_is_what_rays_make(
    table2: Camera, water: Media, layout: Layout, place: tuple[float, float, float]
) -> None:
    """Behind 30 cm of water at f/3 Snell's law moves light at the rim by a third of a lens, twice a ball's width."""
    lattice = Lattice.regular(0.1, layout, np.deg2rad(0.12), (0.013, -0.02))
    camera = replace(table2, aperture_mm=33.0, lattice=lattice, columns=400, rows=360)
    space, radius = behind(camera, water, 300.0, 5.0), 0.01
    rays = render_points(camera, space, Balls([place], 1.0, 2 * radius), np.random.default_rng(1), rays=1_000_000)
    view = with_radius(raw_view(camera, water, 3.0 * radius, space=space), radius)
    light = twin_image(view, place)[:, 0]
    assert light.sum() == pytest.approx(1.0, abs=1e-3)
    # What so many rays leave is 0.005 to 0.008; with this displacement as a small change to profiles 0.03 and more.
    assert np.abs(light - rays.ravel()).sum() < 0.0085


@pytest.mark.thorough
def test_shift_is_that_of_the_best_focus_and_that_of_the_wall(table2: Camera, water: Media) -> None:
    space = behind(table2, water, 60.0, 5.0)
    view = raw_view(table2, water, 0.025, space=space)
    shift = paraxial_shift(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), view)
    # On the axis a ray at height h seems to come from nearer by c h^2; by least squares over a disc that is 2/3 c R^2.
    for z, found in zip((-1.0, 1.0), shift, strict=True):
        layers, indices = space.layers(table2)
        layers = layers + (0.0, 0.0, z)
        slope = table2.aperture_radius_mm / float(space.distance(table2, z))
        height = float(exact_lateral_mm(slope, layers, indices, 1.0))
        at_rim = (table2.aperture_radius_mm - height) / slope / water.depth_ratio
        assert found[2] == pytest.approx(-2.0 / 3.0 * at_rim, rel=0.02)
        assert np.abs(found[:2]).max() < 1e-12
    assert shift[1, 2] < shift[0, 2] < -0.03
    points = np.array([[1.0, -2.0, -5.3], [0.5, 0.5, 2.0]])
    in_air = raw_view(table2, water.in_air(), 0.025, space=ObjectSpace(water.in_air()))
    np.testing.assert_array_equal(places_by_snell(points, in_air), points)
    # A point in the window has the window's own shift, not an error.
    shift = paraxial_shift(points, raw_view(table2, water, 0.025, space=behind(table2, water, 5.0, 5.0)))
    assert np.all(shift[:, 2] < -0.002)


# On the axis of the pipe, in focus along it and across it; at its sides, near both depths; close to the wall.
IN_PIPE = [(0.3, 0.1, 3.0), (0.3, 0.1, -1.2), (-0.5, 3.0, 1.0), (-0.5, 3.0, -2.0)]
IN_PIPE += [(0.4, 4.5, 0.5), (0.4, -4.5, -1.2), (0.4, -4.3, -2.0)]


@pytest.fixture(scope="module")
def pipe_camera(table2: Camera) -> Camera:
    """The paper's camera, its sensor tall enough for a pipe, the array turned, shifted and a little distorted."""
    lattice = Lattice.regular(0.1, "square", np.deg2rad(0.12), (0.013, -0.02))
    return replace(table2, lattice=lattice, columns=500, rows=2700, distortion_per_mm2=1e-5)


@pytest.fixture(scope="module")
def pipe_view(pipe_camera: Camera, water: Media) -> View:
    return raw_view(pipe_camera, water, RADIUS_MM, space=tube_of(water))


def counted(camera: Camera, space: CurvedSpace, point: tuple[float, float, float], rays: int) -> Floats:
    """Return the share of the rays of a glowing ball that strike each pixel, traced one by one."""
    rng = np.random.default_rng(1)
    away = rng.normal(size=(rays, 3))
    away *= (RADIUS_MM * rng.random(rays) ** (1.0 / 3.0) / np.linalg.norm(away, axis=1))[:, np.newaxis]
    crossing = disc_points(rays, camera.aperture_radius_mm, rng)
    slopes, there = space.slopes(camera, np.array(point) + away, crossing)
    assert there.all()
    return image_of(camera, trace(camera, crossing, slopes).sensor_mm, 1.0 / rays).ravel()


@pytest.mark.thorough
@pytest.mark.parametrize("place", IN_PIPE)
@pytest.mark.parametrize("turned", [False, True], ids=["along x", "along y"])
def test_response_is_what_rays_through_the_pipe_make(
    pipe_camera: Camera, water: Media, place: tuple[float, float, float], turned: bool
) -> None:
    space = tube_of(water)
    if turned:
        pipe_camera = replace(pipe_camera, columns=pipe_camera.rows, rows=pipe_camera.columns)
        place = (place[1], place[0], place[2])
        space = tube_of(water, (0.0, 1.0, 0.0))
    view = raw_view(pipe_camera, water, RADIUS_MM, space=space)
    # Of one lens's width next to nothing tells the place from the depth.
    is_wide = footprint_radius_mm(view, np.array([place]))[0] >= 2.0 * view.half_x_mm
    traced, moved = counted(pipe_camera, space, place, 500_000), np.array([5e-4, 5e-4, 4e-3]) if is_wide else np.inf
    assert_rays_make(rows_image(view, place), traced, 500_000, moved)


@pytest.mark.thorough
@pytest.mark.parametrize("place", IN_PIPE)
def test_derivatives_by_true_coordinates_are_finite_differences(
    pipe_view: View, place: tuple[float, float, float]
) -> None:
    analytic = rows_image(pipe_view, place)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-4
        ahead, behind = (rows_image(pipe_view, np.array(place) + sign * step)[:, 0] for sign in (1.0, -1.0))
        difference = (ahead - behind) / 2e-4
        # Behind planes a hundredth. Here slopes are those of the light before what moves it by up to 9 um, a third of
        # the ball's radius: along x close to the wall, where the light hardly depends on it, a tenth.
        assert np.abs(analytic[:, 1 + axis] - difference).sum() < 0.13 * np.abs(difference).sum()
        # Of all that is wrong none is along another axis, as it would be with a place in air for the true one.
        along = analytic[:, 1 + axis] @ difference / (difference @ difference)
        assert along == pytest.approx(1.0, abs=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize("place", IN_PIPE)
def test_rows_in_a_pipe_are_the_pixels_one_by_one(pipe_view: View, place: tuple[float, float, float]) -> None:
    slowly, quickly = twin_image(pipe_view, place), rows_image(pipe_view, place)
    assert slowly.any()
    # Rows are in single precision. Where cells lean slopes' own derivatives are left out.
    assert np.all(np.abs(quickly - slowly) < np.array([1e-4, 2e-3, 2e-3, 2e-3]) * np.abs(slowly).max(axis=0))


@pytest.mark.thorough
def test_faces_that_are_plane_are_the_layers(table2: Camera, water: Media) -> None:
    camera = replace(table2, columns=400, rows=360)
    distance = camera.focus_distance_mm - 5.0 / 1.33 - 5.0 / 1.49
    layers = ObjectSpace(water, Window(distance, 5.0), "exact")
    faces = CurvedSpace(water, (Face(Plane(-10.0), 1.49), Face(Plane(-5.0), 1.33)))
    for place in ((0.31, -0.2, 3.0), (0.2, 0.3, -4.0)):
        by_layers, by_faces = (rows_image(raw_view(camera, water, RADIUS_MM, space=s), place) for s in (layers, faces))
        # Layers take the slope's line from two places, faces from the disc: both differ from the rays by far less.
        assert np.abs(by_layers[:, 0] - by_faces[:, 0]).sum() < 1e-3
        for axis in (1, 2, 3):
            assert np.abs(by_layers[:, axis] - by_faces[:, axis]).sum() < 1e-2 * np.abs(by_layers[:, axis]).sum()


def test_the_line_is_closest_to_the_slopes(pipe_camera: Camera, water: Media) -> None:
    np.testing.assert_allclose(WEIGHTS.sum(), 1.0, rtol=1e-14)
    np.testing.assert_allclose(WEIGHTS @ NODES**2, MEAN_SQUARE, rtol=1e-14)
    # Mean of u^6 over the disc: 5/64.
    np.testing.assert_allclose(WEIGHTS @ NODES**6, 5.0 / 64.0, rtol=1e-14)
    space, radius = tube_of(water), pipe_camera.aperture_radius_mm
    crossing = disc_points(2000, radius, np.random.default_rng(2))

    def pencil_of(place):
        pencil = room_for_pencil()
        set_pencil(space.for_kernels(pipe_camera), radius, *place, pencil)
        return pencil

    for place in ((0.4, 3.0, 1.0), (-0.3, -4.8, 0.0)):
        pencil = pencil_of(place)
        slopes, _ = space.slopes(pipe_camera, np.tile(place, (len(crossing), 1)), crossing)
        straight = (crossing - pencil.line[:, 0]) / pencil.line[:, 1]
        cubic = np.array([[cubic_at(pencil.cubic[k], *each) for k in range(2)] for each in crossing])
        moved_um = 1e3 * pipe_camera.image_distance_mm * np.abs(slopes - straight)
        left_um = 1e3 * pipe_camera.image_distance_mm * np.abs(slopes - straight - cubic)
        assert moved_um.max() < 10.0
        assert left_um.max() < (0.3 if abs(place[1]) < 4.0 else 0.6)
        # The two points in air are a millimetre and more apart at y = 3, and swap towards the wall.
        assert abs(np.diff(pencil.line[:, 1])[0]) > 0.5
        # Moves of the line are its differences.
        for axis in range(3):
            step = 1e-4 * np.eye(3)[axis]
            ahead, behind = (pencil_of(np.array(place) + sign * step).line for sign in (1, -1))
            np.testing.assert_allclose(pencil.line_moves[:, :, axis], (ahead - behind) / 2e-4, atol=1e-3)


def test_what_the_wall_hides_has_no_light_and_footprints_hold_the_rest(pipe_view: View, pipe_camera: Camera) -> None:
    for place in ((0.1, 4.9, 3.0), (0.0, 5.5, 0.0), (0.0, 0.0, -6.0)):
        assert not rows_image(pipe_view, place).any()
    points = np.array([(0.1, 4.9, 3.0), (0.1, 3.0, 1.0)])
    assert np.isfinite(on_array_mm(pipe_view, points)).all()
    assert np.isfinite(footprint_radius_mm(pipe_view, points)).all()
    np.testing.assert_array_equal(places_by_snell(points, pipe_view), points)
    # From the middle of the pipe no line of sight reaches a depth outside it.
    assert on_line_of_sight(pipe_view, 0.1, 0.2, 0.0, 6.0) == (0.1, 0.2)
    columns = np.arange(pipe_view.camera.rows * pipe_view.camera.columns)
    for place in IN_PIPE:
        lit = np.flatnonzero(rows_image(pipe_view, place)[:, 0])
        row, column = np.divmod(columns[lit], pipe_view.camera.columns)
        point = np.array([place])
        on_array = pipe_camera.px_to_mm(np.column_stack([column, row])) - on_array_mm(pipe_view, point)
        # A lens's cell is lit as a whole, wherever in it light falls.
        reach = footprint_radius_mm(pipe_view, point)[0] + 4.0 * max(pipe_view.half_x_mm, pipe_view.half_y_mm)
        assert np.abs(on_array).max() < reach
        assert reach < tile_side_mm(pipe_view, *DEPTHS)


@pytest.mark.thorough
def test_lines_of_sight_are_rays(pipe_camera: Camera, water: Media, pipe_view: View) -> None:
    x, y = on_line_of_sight(pipe_view, 0.4, 4.0, 0.5, -1.5)
    ends = np.array([(0.4, 4.0, 0.5), (x, y, -1.5)])
    slopes, _ = tube_of(water).slopes(pipe_camera, ends, np.zeros((2, 2)))
    np.testing.assert_allclose(slopes[0], slopes[1], atol=1e-9)


# Its fits take half a minute to compile.
@pytest.mark.thorough
def test_fits_return_to_the_truth_and_scatter_as_stated(pipe_camera: Camera, water: Media) -> None:
    rng = np.random.default_rng(8)
    view = raw_view(replace(pipe_camera, columns=260), water, RADIUS_MM, space=tube_of(water))
    for place in ((0.1, 0.2, 2.5), (-0.1, 3.0, 1.5), (0.1, 4.3, 1.2)):
        true = np.array([[*place, 4e4]])
        model = light_on(view, true, DEPTHS)
        sigma = np.sqrt(model + 36.0)
        values = rows_image(view, place)
        slopes = np.column_stack([4e4 * values[:, 1:], values[:, 0]])
        stated = np.linalg.inv(slopes.T @ (slopes / sigma[:, np.newaxis] ** 2))
        errors = []
        for _ in range(120):
            start = true + rng.normal(0.0, 1.0, (1, 4)) * (0.02, 0.02, 0.1, 4e3)
            image = model + rng.normal(0.0, sigma)
            add_all(view, start, -1.0, image, DEPTHS)
            for _ in range(3):
                refine(observation_of(view, image, 1.0 / sigma**2, DEPTHS), start)
            errors.append(start[0] - true[0])
        error = np.array(errors) / np.sqrt(np.diag(stated))
        # 120 fits: their scatter is known to 6.5 %, their mean to 0.09 of it; slopes are right to some per cent.
        np.testing.assert_allclose(error.std(axis=0), 1.0, atol=0.25)
        assert np.abs(error.mean(axis=0)).max() < 0.35
        # Chi-squared of four unknowns, correlated as stated.
        whole = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(stated), errors)
        assert whole.mean() == pytest.approx(4.0, abs=1.2)


def test_hexagonal_arrays_are_refused(table2: Camera, water: Media) -> None:
    hexagonal = replace(table2, lattice=Lattice.regular(0.1, "hexagonal"))
    with pytest.raises(ConfigError, match="square microlenses alone; these are hexagonal"):
        raw_view(hexagonal, water, RADIUS_MM, space=tube_of(water))
