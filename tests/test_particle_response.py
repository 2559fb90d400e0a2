"""The response of one particle against rays, finite differences, its twin by pixels and rays bent by Snell's law."""

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.names import Layout
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window, exact_lateral_mm
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.cells import cell_shares, covered_share, level_at, share_at
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import observation_of
from lfpiv_cli.particles.noise import Noise, pixel_weights
from lfpiv_cli.particles.refraction import paraxial_shift, places_by_snell
from lfpiv_cli.particles.view import View, raw_view
from lfpiv_cli.synthetic.render import Balls, render_points
from tests.particle_images import fit_moved, rows_image, rows_of
from tests.particle_twin import twin_image

RADIUS_MM = 0.025
# In, near and out of focus, on both sides, off the axis; light goes through 1 to 50 lenses.
PLACES = [(0.31, -0.2, 3.0), (0.53, 0.21, 0.02), (-0.62, 0.4, 0.4), (0.2, 0.3, -4.0)]


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def small(table2: Camera, request: pytest.FixtureRequest) -> Camera:
    """The paper's camera with a small sensor and an array that is turned, shifted and seen through distortion."""
    lattice = Lattice.regular(0.1, request.param, np.deg2rad(0.12), (0.013, -0.02))
    return replace(table2, lattice=lattice, columns=400, rows=360, distortion_per_mm2=2e-4)


@pytest.fixture(scope="module")
def view(small: Camera, water: Media) -> View:
    """What the small camera sees: its tables for hexagons take longer than the tests."""
    return raw_view(small, water, RADIUS_MM)


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_response_is_what_rays_make(small: Camera, view: View, water: Media, place: tuple[float, float, float]) -> None:
    response = twin_image(view, place)
    rays = 1_000_000
    space = ObjectSpace(water, None, "paraxial")
    traced = render_points(
        small, space, Balls([place], 1.0, 2 * RADIUS_MM), np.random.default_rng(1), rays=rays
    ).ravel()
    assert response[:, 0].sum() == pytest.approx(1.0, abs=1e-3)
    # The rays' own noise is 0.8 sqrt(f/n) a pixel, summed over the pixels; the model may add half of a per cent.
    noise = 0.8 * np.sqrt(traced / rays).sum()
    assert np.abs(response[:, 0] - traced).sum() < noise + 0.005
    if abs(place[2]) < 0.1:
        return  # all light passes one lens, whichever way the particle moves within it: no position to compare
    bias = fit_moved(response, traced)
    # A fit to the rays would move by this: a thousandth of a voxel's width, and three hundredths in depth.
    assert np.all(bias < (3e-4, 3e-4, 3e-3))


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


@pytest.fixture(scope="module", params=["square", "turned", "hexagonal", "behind a wall"])
def any_view(table2: Camera, water: Media, request: pytest.FixtureRequest) -> View:
    layout = "hexagonal" if request.param == "hexagonal" else "square"
    lattice = Lattice.regular(0.1, layout, np.deg2rad(0.0 if request.param == "square" else 0.12), (0.013, -0.02))
    camera = replace(table2, lattice=lattice, columns=400, rows=360, distortion_per_mm2=2e-4)
    wall = Window(camera.focus_distance_mm - 60.0, 5.0)
    space = ObjectSpace(water, wall, "exact") if request.param == "behind a wall" else None
    return raw_view(camera, water, 0.025, space=space)


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
    noise = Noise(5.0, 0.7, 0.03)
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
