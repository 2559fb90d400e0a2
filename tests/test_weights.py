"""Weights: quadrature and integrals against rays, operators against dense matrices, adjointness, conservation."""

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.calibration.white import fit_vignetting, relative_transmission, vignetting_surface
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.tracing import ObjectSpace, PolynomialRays, complete_exponents
from lfpiv_cli.synthetic.render import render_white
from lfpiv_cli.weights.build import blur_radius_mm, default_padding, factorise, factorise_through
from lfpiv_cli.weights.columns import OnDemandOperator
from lfpiv_cli.weights.lens_cells import MOST_CORNERS, axis_optics, disc_area_below, neighbours, shared_rectangle
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.operators import adjoint_reference, forward_reference
from lfpiv_cli.weights.quadrature import TILES, RayCount, count_rays, integrate_columns, sampling_error
from lfpiv_cli.weights.scene import aperture_tiles, kernel_scene, on_array, rays_from
from tests.known_rays import assert_adjoint, points_counted

RAYS = 400_000


@pytest.fixture
def small(table2: Camera) -> Camera:
    """Table 2 with a sensor of 380 x 260 pixels and an array that is off the axis by an odd amount."""
    return replace(table2, columns=380, rows=260, lattice=Lattice.regular(0.1, origin=(0.013, -0.021)))


def weights_of(camera: Camera, media: Media, grid: Grid, padding: tuple[int, int, int] = (0, 0, 0)) -> Weights:
    return Weights(grid, padding, factorise(camera, media, grid.padded(padding)), camera.column_axis)


def ray_count(
    camera: Camera, media: Media, grid: Grid, voxel_xyz: tuple[int, int, int], rng: np.random.Generator
) -> np.ndarray:
    """Return Eq. 13 by counting: the share of the rays of one voxel that strike each pixel."""
    points = grid.voxel_to_mm(np.asarray(voxel_xyz) + rng.random((RAYS, 3)) - 0.5)
    return points_counted(camera.to_image_axes(points), camera, media, rng) / RAYS


@pytest.mark.thorough
@pytest.mark.parametrize("z_mm", [-4.0, -1.0, 0.0, 3.0])
@pytest.mark.parametrize("spacing", [(0.1, 0.1, 0.1), (0.05, 0.05, 0.2)])
def test_column_agrees_with_counted_rays_eq_13(small, water, rng, z_mm, spacing):
    grid = Grid.centred((3, 3, 1), spacing, (0.31, -0.22, z_mm))
    counted = ray_count(small, water, grid, (2, 0, 0), rng)
    rows, columns, weight = weights_of(small, water, grid).column(0, 0, 2)
    exact = np.zeros_like(counted)
    exact[rows, columns] = weight
    # The count itself errs by sum sqrt(2 w / (pi n)); the factorised rim adds up to 0.027 (the worst voxel measured).
    sampling = np.sum(np.sqrt(2.0 * exact / (np.pi * RAYS)))
    assert np.abs(exact - counted).sum() < 0.027 + sampling


@pytest.mark.thorough
def test_column_axis_y_exchanges_the_lateral_axes(small, water, rng):
    camera = replace(small, column_axis="y")
    grid = Grid.centred((2, 4, 1), (0.1, 0.1, 0.1), (0.4, -0.5, 2.0))
    counted = ray_count(camera, water, grid, (1, 3, 0), rng)
    rows, columns, weight = weights_of(camera, water, grid).column(0, 3, 1)
    at = [np.sum(counted * axis) for axis in np.indices(counted.shape)]
    # A micro-image is 18 pixels wide: centroids agree to a small part of a pixel only on the right side of the image.
    assert np.allclose(at, [np.sum(weight * rows) / weight.sum(), np.sum(weight * columns) / weight.sum()], atol=0.2)


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
@pytest.mark.parametrize("padding", [(0, 0, 0), (2, 1, 1)])
def test_forward_and_adjoint_are_adjoint(small, media, rng, column_axis, padding):
    camera = replace(small, column_axis=column_axis)
    weights = weights_of(camera, media, Grid.centred((7, 5, 6), (0.1, 0.12, 0.4), (0.1, 0.2, 0.3)), padding)
    assert_adjoint(weights, rng)


@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_a_part_is_what_the_whole_does_there(small, water, rng, column_axis):
    grid = Grid.centred((9, 7, 4), (0.1, 0.12, 0.4), (0.1, 0.2, 0.3))
    whole = weights_of(replace(small, column_axis=column_axis), water, grid, (1, 2, 0))
    middle, reach = np.array([0.35, 0.05]), 0.21
    part = whole.around(middle, reach)
    centres = part.grid.centres_mm()
    assert np.all(centres[..., :2].min(axis=(0, 1, 2)) <= middle - reach)
    assert np.all(centres[..., :2].max(axis=(0, 1, 2)) >= middle + reach)
    grid = whole.padded.grid
    low = np.rint(grid.mm_to_voxel(centres[0, 0, 0])).astype(int)
    within = tuple(slice(first, first + size) for first, size in zip(low[::-1], part.shape, strict=True))
    np.testing.assert_allclose(centres, grid.centres_mm()[within], atol=1e-12)
    assert np.prod(part.shape) < 0.5 * np.prod(whole.padded.shape)
    volume, image = np.zeros(whole.padded.shape, np.float32), rng.random(whole.image_shape, dtype=np.float32)
    volume[within] = rng.random(part.shape, dtype=np.float32)
    projection = part.forward(volume[within])
    np.testing.assert_allclose(projection, whole.padded.forward(volume), atol=1e-6)
    np.testing.assert_allclose(part.adjoint(image), whole.padded.adjoint(image)[within], atol=1e-6)
    outside = np.ones(whole.image_shape, bool)
    outside[part.window] = False
    assert outside.any()
    assert not projection[outside].any()


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 4), (6, 9, 7)])
def test_kernels_equal_dense_products(small, water, rng, shape):
    operator = factorise(small, water, Grid.centred(shape, (0.1, 0.1, 0.3), (0.0, 0.1, 1.0)))
    volume = rng.random(operator.shape, dtype=np.float32)
    image = rng.random(operator.image_shape, dtype=np.float32)
    np.testing.assert_allclose(operator.forward(volume), forward_reference(operator, volume), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(operator.adjoint(image), adjoint_reference(operator, image), rtol=1e-5, atol=1e-6)


def test_a_voxel_lights_its_column_and_shares_are_whole(small: Camera, water: Media) -> None:
    weights = weights_of(small, water, Grid.centred((4, 3, 2), (0.1, 0.1, 0.1), (0.0, 0.0, -2.0)), (1, 2, 1))
    volume = np.zeros(weights.shape, np.float32)
    volume[1, 2, 3] = 1.0
    image = np.zeros(weights.image_shape, np.float32)
    rows, columns, weight = weights.column(1, 2, 3)
    image[rows, columns] = weight
    np.testing.assert_allclose(weights.forward(volume), image, atol=1e-9)
    operator = factorise(small, water, Grid.centred((3, 3, 5), (0.1, 0.1, 1.0), (0.0, 0.0, 0.0)))
    for axis in (operator.columns, operator.rows):
        sums = np.add.reduceat(axis.share, axis.start[:-1])
        np.testing.assert_allclose(sums, 1.0, rtol=1e-6)  # float32 shares


@pytest.mark.thorough
def test_a_point_at_plus_x_lights_the_sensor_at_minus_x_and_one_pitch_moves_it_by_one_micro_image(table2, water):
    weights = weights_of(table2, water, Grid.centred((1, 1, 1), (0.1, 0.1, 0.1), (2.0, 1.0, 0.0)))
    rows, columns, weight = weights.column(0, 0, 0)
    # By hand: x_m = -2 mm, micro-image at -2 (1.004) mm, /5.5 um = -365.1 px from column 1175.5; rows at -182.5 of
    # 883.5.
    assert np.sum(weight * columns) / weight.sum() == pytest.approx(1175.5 - 365.1, abs=0.1)
    assert np.sum(weight * rows) / weight.sum() == pytest.approx(883.5 - 182.5, abs=0.1)
    # Table 2: 0.1 mm (1 + 0.8/200) / 5.5 um = 18.2545 px; M = -1 turns the direction round.
    grid = Grid.centred((3, 1, 1), (0.1, 0.1, 0.1), (0.05, 0.0, 0.0))
    weights = weights_of(table2, water, grid)
    centroids = []
    for ix in (0, 1, 2):
        _, columns, weight = weights.column(0, 0, ix)
        centroids.append(np.sum(weight * columns) / np.sum(weight))
    np.testing.assert_allclose(np.diff(centroids), -18.2545, atol=0.02)


def test_what_weights_are_made_of(table2, water, small):
    grid = Grid.centred((10, 10, 100), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    radius = blur_radius_mm(table2, water, grid)
    # At z = 5 mm: s_o = 203.76, alpha = -0.0184; 0.231 + 0.05 mm on the array, back to the flow by 1.0188.
    assert radius == pytest.approx(0.286, abs=0.002)
    assert default_padding(table2, water, grid) == (3, 3, 0)
    grid = Grid.centred((2, 2, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    for lattice in (Lattice.regular(0.1, "hexagonal"), Lattice.regular(0.1, rotation_rad=1e-3)):
        with pytest.raises(ConfigError, match="does not separate"):
            factorise(replace(table2, lattice=lattice), water, grid)
    columns, rows = axis_optics(small)
    assert (columns.pixels, rows.pixels) == (380, 260)
    assert (columns.lens_origin_mm, rows.lens_origin_mm) == (0.013, -0.021)
    n = 2000
    x, y = np.meshgrid((np.arange(n) + 0.5) / n * 2 - 1, (np.arange(n) + 0.5) / n * 2 - 1)
    inside = np.hypot(x, y) <= 1.0
    for a, b in [(0.3, -0.5), (-0.8, 0.3), (0.9, 0.9), (-0.5, -0.5), (0.95, -0.2), (0.2, 2.0), (-1.1, 0.0)]:
        counted = np.sum(inside & (x <= a) & (y <= b)) * 4.0 / n**2
        assert disc_area_below(a, b, 1.0) == pytest.approx(counted, abs=4.0 / n)  # one line of cells at each edge


@pytest.mark.parametrize("z_mm", [-2.0, 3.0])
def test_exact_refraction_comes_closer_to_exact_rays(small, water, window, z_mm):
    # 134 mm of water: the paraxial columns are off by 0.05 in L1, the separable exact ones by 0.02.
    grid = Grid.centred((1, 1, 1), (0.1, 0.1, 0.1), (0.31, -0.22, z_mm))
    exact = ObjectSpace(water, window, "exact")
    truth = integrate_columns(small, exact, [(0.31, -0.22, z_mm)], grid.spacing_mm, 96).image(0, (260, 380))
    errors = []
    for space in (exact, replace(exact, refraction="paraxial")):
        rows, columns, weight = factorise_through(small, space, grid).column(0, 0, 0)
        image = np.zeros_like(truth)
        image[rows, columns] = weight
        errors.append(np.abs(image - truth).sum())
    assert errors[0] < 0.03
    assert errors[0] < 0.6 * errors[1]


VOXEL = (0.1, 0.1, 0.1)
SMALL = (260, 380)


def small_camera(layout: str, rotation_rad: float = 0.0, focal_length_mm: float = 0.8) -> Camera:
    lattice = Lattice.regular(0.1, layout, rotation_rad, (0.013, -0.021))
    return Camera(-1.0, 100.0, 25.0, focal_length_mm, 0.8, lattice, 0.0055, SMALL[1], SMALL[0], "x", 1e-4)


def quadrature_image(camera, source, centre, voxel=VOXEL, tiles=128):
    return integrate_columns(camera, source, [centre], voxel, tiles, 5).image(0, SMALL)


@pytest.mark.thorough
@pytest.mark.parametrize("focal_length_mm", [0.8, 0.7])
@pytest.mark.parametrize("refraction", ["paraxial", "exact"])
@pytest.mark.parametrize("rotation_rad", [0.0, 0.02])
def test_quadrature_agrees_with_counted_rays_eq_13(
    layout, rotation_rad, refraction, focal_length_mm, water, window, rng
):
    camera = small_camera(layout, rotation_rad, focal_length_mm)
    space = ObjectSpace(water, window, refraction)
    for centre, voxel in [((0.31, -0.22, 3.0), VOXEL), ((-0.2, 0.1, -4.5), (0.05, 0.05, 0.2))]:
        exact = quadrature_image(camera, space, centre, voxel)
        counted = count_rays(camera, space, centre, voxel, rng, RayCount(100_000, 5))
        # A sum over hundreds of pixels stays within some per cent of its mean; the 5 rays of a point add to it.
        assert np.abs(exact - counted).sum() < 1.3 * sampling_error(exact, 500_000)


def test_halving_the_tiles_converges_in_second_order_and_no_light_is_lost(layout, water, window):
    camera = small_camera(layout)
    paraxial = ObjectSpace(water, None, "paraxial")
    images = [quadrature_image(camera, paraxial, (0.2, 0.1, 2.0), tiles=n) for n in (32, 64, 128)]
    coarse, fine = (np.abs(a - b).sum() for a, b in zip(images, images[1:], strict=False))
    assert fine < 0.4 * coarse
    assert fine < 0.005
    for space in (ObjectSpace(water, window, "exact"), ObjectSpace(water, window, "paraxial", "drt")):
        image = quadrature_image(small_camera(layout), space, (0.0, 0.1, 1.0), tiles=TILES)
        assert image.sum() == pytest.approx(1.0, abs=1e-4)  # shares below 1e-7 are left out


def test_voxels_that_have_no_column_and_counted_rays_that_repeat(table2, water):
    with pytest.raises(ConfigError, match="needs a window"):
        ObjectSpace(water, None, "paraxial", "drt").distance(table2, 0.0)
    space = ObjectSpace(water, Window(198.0, 2.0))
    with pytest.raises(ConfigError, match="in front of the fluid"):
        integrate_columns(table2, space, [(0.0, 0.0, -5.0)], VOXEL)
    camera, space = small_camera("square"), ObjectSpace(water, None, "paraxial")
    assert integrate_columns(camera, space, [(9.0, 0.0, 0.0)], VOXEL).share.size == 0
    count = (camera, ObjectSpace(Media()), (0.1, 0.0, 1.0), VOXEL)
    images = [count_rays(*count, np.random.default_rng(3), RayCount(50, 40)) for _ in range(2)]
    assert np.array_equal(*images)
    assert images[0].sum() == pytest.approx(1.0)
    turned = (camera, replace(camera, column_axis="y"))
    assert np.array_equal(*(quadrature_image(each, space, (0.2, -0.1, 1.0), tiles=16) for each in turned))


def test_tiles_fill_the_disc_and_polynomials_are_their_array_twins(water, rng):
    tiles = aperture_tiles(12.5, 9)
    assert tiles.share.sum() == pytest.approx(1.0, rel=1e-12)
    assert np.hypot(*tiles.middle_mm.T).max() < 12.5
    # The mean square distance from the axis of a disc is R^2 / 2, of a square about its middle side^2 / 6.
    spread = np.sum(tiles.share * np.sum(tiles.middle_mm**2, axis=1)) + tiles.side_mm**2 / 6.0
    assert spread == pytest.approx(12.5**2 / 2.0, rel=5e-3)
    exponents = complete_exponents(3)
    fitted = PolynomialRays(np.array([4.0, 3.0, 8.0, 12.0, 11.0]), exponents, rng.normal(size=(len(exponents), 2)))
    points, crossings = rng.uniform(-4.0, 4.0, (50, 3)), rng.uniform(-12.0, 12.0, (50, 2))
    scene = kernel_scene(small_camera("square"), fitted, points, np.array(VOXEL), 4, 1)
    pairs = zip(points, crossings, strict=True)
    kernel = [on_array(scene, point, rays_from(scene, point, 0, 0), *crossing) for point, crossing in pairs]
    np.testing.assert_allclose(kernel, fitted.on_array(points, crossings), rtol=1e-12, atol=1e-12)
    assert fit_vignetting(np.zeros((60, 60), np.float32), Lattice.regular(18.0)) is None


def test_lens_regions_share_out_a_rectangle(layout, rng):
    lattice = Lattice.regular(0.1, layout, 0.1)
    low, high = np.array([-0.13, 0.02]), np.array([0.11, 0.09])
    work = np.empty((2, MOST_CORNERS, 2))
    centres = lattice.points([(i, j) for i in range(-4, 5) for j in range(-4, 5)])
    parts = [shared_rectangle(tuple(low), tuple(high), x, y, neighbours(lattice), work) for x, y in centres]
    area = float(np.prod(high - low))
    assert sum(part[0] for part in parts) == pytest.approx(area, rel=1e-12)
    points = low + rng.random((20_000, 2)) * (high - low)
    nearest = lattice.points(lattice.nearest(points))
    for centre, part in zip(centres, parts, strict=True):
        inside = np.all(np.abs(nearest - centre) < 1e-9, axis=1)
        assert part[0] / area == pytest.approx(inside.mean(), abs=0.015)  # four standard errors
        if inside.sum() > 1000:
            np.testing.assert_allclose(part[1:3], points[inside].mean(axis=0), atol=0.003)


@pytest.mark.parametrize("z_mm", [0.5, 3.0])
def test_fitted_rays_give_the_columns_of_traced_ones(layout, water, z_mm):
    # At one depth paraxial rays are linear: x_m = alpha X - x s_i/s_o; a flat voxel sees no other depth.
    camera = replace(small_camera(layout), distortion_per_mm2=0.0)
    space = ObjectSpace(water, None, "paraxial")
    distance = float(space.distance(camera, z_mm))
    alpha, scale = float(camera.defocus(distance)), camera.image_distance_mm / distance
    exponents = np.array([(1, 0, 0, 0, 0), (0, 0, 0, 1, 0), (0, 1, 0, 0, 0), (0, 0, 0, 0, 1)], np.int64)
    units = np.array([2.0, 3.0, 5.0, 10.0, 12.5])
    along = np.array([-scale * units[0], alpha * units[3], 0.0, 0.0])
    across = np.array([0.0, 0.0, -scale * units[1], alpha * units[4]])
    fitted = PolynomialRays(units, exponents, np.stack([along, across], axis=1))
    images = [quadrature_image(camera, each, (0.2, -0.1, z_mm), (0.1, 0.1, 1e-9), 24) for each in (space, fitted)]
    np.testing.assert_allclose(*images, atol=1e-9)
    assert images[0].sum() == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(("degree", "terms"), [(2, 21), (3, 56)])
def test_complete_polynomials_have_the_terms_of_hall_et_al(degree, terms):
    exponents = complete_exponents(degree)
    assert exponents.shape == (terms, 5)
    assert len(np.unique(exponents, axis=0)) == terms


SHAPE = (520, 760)


@pytest.fixture
def wide_camera(table2, layout):
    return replace(table2, rows=SHAPE[0], columns=SHAPE[1], lattice=Lattice.regular(0.1, layout))


def shading() -> np.ndarray:
    """cos^4 of a steep lens, 0.6 in the corners."""
    y, x = np.meshgrid(*((np.arange(n) - n / 2) / (n / 2) for n in SHAPE), indexing="ij")
    return 1.0 / (1.0 + 0.145 * (x**2 + y**2)) ** 2


@pytest.mark.thorough
def test_vignetting_is_found_under_the_rims_of_the_lens_images(wide_camera):
    white = render_white(wide_camera, 1000.0) * shading()
    lattice = wide_camera.micro_image_lattice_px()
    coefficients = fit_vignetting(relative_transmission(white.astype(np.float32), lattice), lattice)
    surface = vignetting_surface(coefficients, SHAPE)
    np.testing.assert_allclose(surface, shading(), atol=0.01)


@pytest.mark.parametrize("pitch_mm", [0.055, 0.1])
def test_even_light_on_a_small_sensor_stays_even_up_to_its_border(pitch_mm, table2, layout, rng):
    camera = replace(table2, rows=180, columns=210, lattice=Lattice.regular(pitch_mm, layout))
    lattice = camera.micro_image_lattice_px()
    white = rng.poisson(render_white(camera, 400.0)).astype(np.float32)
    coefficients = fit_vignetting(relative_transmission(white, lattice), lattice)
    # Medians of some twenty pixels with a twentieth of noise each, and some six times their error in the corners.
    np.testing.assert_allclose(vignetting_surface(coefficients, (180, 210)), 1.0, atol=0.09)


@pytest.mark.thorough
def test_weights_behind_a_transmission_scale_their_pixels(table2, water, rng):
    camera = replace(table2, rows=260, columns=380)
    grid = Grid.centred((3, 3, 2), (0.1, 0.1, 0.5), (0.1, 0.0, 1.0))
    transmission = rng.random((260, 380), dtype=np.float32)
    on_demand = OnDemandOperator(camera, ObjectSpace(water, None, "paraxial"), grid)
    volume = rng.random(grid.shape_zyx, dtype=np.float32)
    for operator in (factorise(camera, water, grid), on_demand, on_demand.restricted(np.ones((260, 380), np.float32))):
        dimmed = operator.behind(transmission)
        np.testing.assert_allclose(dimmed.forward(volume), operator.forward(volume) * transmission, atol=1e-6)
        image = rng.random((260, 380), dtype=np.float32)
        np.testing.assert_allclose(dimmed.adjoint(image), operator.adjoint(image * transmission), rtol=1e-5)
