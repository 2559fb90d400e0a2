"""Table 2's camera, its lattice and origin; plane layers and rays to its sensor: by hand, and kernels as twins."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage
from scipy.optimize import brentq

from lfpiv_cli.grid import FOCAL_POINT, Grid, Reference
from lfpiv_cli.neighbourhoods import largest_around, opened, smallest_around, with_neighbours
from lfpiv_cli.optics import media as of_media
from lfpiv_cli.optics.camera import Lattice, nearest_on_grid, nearest_point
from lfpiv_cli.optics.media import Media, Window, equivalent_object_distance, exact_lateral_mm, fluid_path_to_focus
from lfpiv_cli.optics.tracing import disc_points, exact_slope, trace, trace_ray
from tests.known_rays import slopes_equivalent, slopes_exact

FOCUS = 200.0  # F_m (M - 1)/M of Table 2: 100 * (-2)/(-1)


def test_eq10_a_ray_keeps_its_lateral_position_and_eqs3_6_9_by_hand(water, window):
    assert equivalent_object_distance(0.0, FOCUS, Media(1.0, 1.49, 1.33)) == FOCUS
    # 8 mm of water behind the focal point look like 8/1.33 = 6.01504 mm of air
    distance = equivalent_object_distance([-8.0, 8.0], FOCUS, Media(1.0, 1.49, 1.33))
    assert distance == pytest.approx([200.0 - 6.0150376, 200.0 + 6.0150376], abs=1e-6)
    # left behind d1 = 98 mm and the 2 mm window: 200 - 98 - 2/1.49 = 100.657718 in air; in water 1.33 times: 133.874765
    assert fluid_path_to_focus(window, FOCUS, water) == pytest.approx(133.874765, abs=1e-6)
    assert water.in_air() == Media(1.0, 1.0, 1.0)
    assert water.depth_ratio == pytest.approx(1 / 1.33)
    # A ray parallel to the axis meets the lens at the point's own x: the equivalent point keeps it.
    assert of_media.object_space_matrix(4.0, window, FOCUS, water)[:, 0] == pytest.approx([1.0, 0.0])


@pytest.mark.parametrize("window", [Window(98.0, 2.0), Window(192.5, 5.0), Window(10.0, 0.0)])
@pytest.mark.parametrize("z", [-5.0, -2.0, 0.0, 3.0, 8.0])
def test_eqs14_15_direct_tracing_equals_equivalent_points_to_rounding(window, z, media):
    """The object-space matrix of the layers is that of the equivalent distance in air, its angle turned by n_w/n_a."""
    matrix = of_media.object_space_matrix(z, window, FOCUS, media)
    distance = equivalent_object_distance(z, FOCUS, media)
    ratio = media.fluid / media.air
    expected = np.array([[1.0, distance], [0.0, 1.0]]) @ np.diag([1.0, ratio])
    assert matrix == pytest.approx(expected, rel=1e-13, abs=1e-13)


LAYERS = [
    (np.array([98.0, 2.0, 133.87]), np.array([1.0, 1.49, 1.33])),
    (np.array([192.5, 5.0, 5.0]), np.array([1.0, 1.49, 1.33])),
    (np.array([50.0]), np.array([1.0])),
    (np.array([1.0, 10.0]), np.array([1.6, 1.2])),
    (np.array([30.0, 0.0, 10.0]), np.array([1.0, 1.5, 1.33])),
]


def lateral(invariant, thicknesses, indices):
    return np.sum(thicknesses * np.tan(np.arcsin(invariant / indices)))


@pytest.mark.parametrize("layers", LAYERS)
@pytest.mark.parametrize("share", [1e-6, 0.01, 0.0625, 0.5, 3.0])
def test_eq4_exact_snell_against_bisection(layers, share):
    """n_i sin(angle_i) is the same in all layers and the layers' t_i tan(angle_i) add up to the lateral distance."""
    thicknesses, indices = layers
    distance = share * thicknesses.sum()
    top = np.nextafter(indices.min(), 0.0)
    found = brentq(lambda s: lateral(s, thicknesses, indices) - distance, 0.0, top * (1 - 1e-12), xtol=1e-15)
    assert of_media.snell_invariant(distance, thicknesses, indices) == pytest.approx(found, rel=1e-11)


def test_exact_snell_tends_to_the_paraxial_ray(water, window):
    """Lateral distance over slope tends to the equivalent distance; the difference falls with the slope squared."""
    z = 3.0
    depth = fluid_path_to_focus(window, FOCUS, water) + z
    layers, indices = [window.distance_mm, window.thickness_mm, depth], [1.0, 1.49, 1.33]
    equivalent = equivalent_object_distance(z, FOCUS, water)
    slopes = np.array([1e-2, 1e-3, 1e-4])
    difference = exact_lateral_mm(slopes, layers, indices, 1.0) / slopes - equivalent
    # t (1 - 1/n^2)/(2 n) slope^2 for each layer, from the series of tan(asin(s/n))
    leading = sum(t * (1 / n**2 - 1) / (2 * n) for t, n in zip(layers, indices, strict=True))
    assert difference[:2] == pytest.approx(leading * slopes[:2] ** 2, rel=1e-3)
    assert abs(difference[2]) < 1e-6


def test_aberration_at_the_edge_of_the_lens_through_the_paper_s_water_wherever_the_window_is(water, window):
    # About 0.085 mm of apparent depth at f/4, in the 133.9 mm of water of the paper's simulation.
    path = fluid_path_to_focus(window, FOCUS, water)
    assert path == pytest.approx(134.0, abs=0.2)
    layers, indices = np.array([98.0, 2.0, path]), np.array([1.0, 1.49, 1.33])
    invariant = of_media.snell_invariant(12.5, layers, indices)
    slope = invariant / np.sqrt(1.0 - invariant**2)
    # the outer ray, drawn on straight, crosses the axis this much nearer than the paraxial 200 mm
    assert FOCUS - 12.5 / slope == pytest.approx(0.085, abs=0.002)
    # Air in front of the window adds 1 mm of apparent distance to each mm, at all angles.
    near = exact_lateral_mm(0.06, [50.0, 2.0, 100.0], [1.0, 1.49, 1.33], 1.0)
    far = exact_lateral_mm(0.06, [90.0, 2.0, 100.0], [1.0, 1.49, 1.33], 1.0)
    assert far - near == pytest.approx(0.06 * 40.0, rel=1e-12)


def strewn(rng, camera, n=200):
    """Return points within the volume of Table 1 and crossings of the aperture."""
    points = rng.uniform((-4, -4, -8), (4, 4, 8), (n, 3))
    return points, disc_points(n, camera.aperture_radius_mm, rng)


def travel(distance):
    return np.array([[1.0, distance], [0.0, 1.0]])


def lens_matrix(focal_length):
    return np.array([[1.0, 0.0], [-1.0 / focal_length, 1.0]])


@pytest.mark.parametrize("microlens_distance", [0.8, 0.75])
def test_eq1_against_matrices_multiplied_explicitly(camera, media, rng, microlens_distance):
    camera = replace(camera, microlens_distance_mm=microlens_distance, magnification=-0.9)
    points, lens = strewn(rng, camera)
    hits = trace(camera, lens, slopes_equivalent(points, lens, camera, media))
    s_i, s_mu, f_m = camera.image_distance_mm, camera.microlens_distance_mm, camera.microlens_focal_length_mm
    ends = zip(points, lens, hits.array_mm, hits.sensor_mm, hits.lens_mm, strict=True)
    for point, crossing, array, sensor, centre in ends:
        s_o = equivalent_object_distance(point[2], camera.focus_distance_mm, media)
        for axis in (0, 1):
            theta = (crossing[axis] - point[axis]) / s_o
            main = travel(s_i) @ lens_matrix(camera.focal_length_mm) @ travel(s_o)
            ray = travel(s_mu) @ lens_matrix(f_m) @ main @ [point[axis], theta]
            ray += travel(s_mu) @ [0.0, centre[axis] / f_m]
            # lengths of up to 10 mm, some twenty roundings
            assert sensor[axis] == pytest.approx(ray[0], abs=1e-12)
            assert array[axis] == pytest.approx((main @ [point[axis], theta])[0], abs=1e-12)
    assert hits.lens_mm == pytest.approx(camera.lattice.points(camera.lattice.nearest(hits.array_mm)))
    # no point is further from its lens than the corner of a square cell, or of a hexagon
    corner = {"square": np.sqrt(0.5), "hexagonal": np.sqrt(1 / 3)}[camera.lattice.layout]
    assert np.hypot(*(hits.array_mm - hits.lens_mm).T).max() <= corner * 0.1 * (1 + 1e-12)


def test_rays_by_hand(table2, rng):
    # Point (1.03, -0.52, 0) in air, through the lens's point (5, 0), M = -1.
    #
    # slope x = (5 - 1.03)/200 = 0.01985, behind the lens 0.01985 - 5/100 = -0.03015; at the array
    # 5 - 0.03015 * 200 = -1.03: M x, whatever X. Nearest lens -1.0;
    # sensor -1.03 + 0.8 (-0.03015 - (-1.03 + 1.0)/0.8) = -1.02412.
    # slope y = 0.52/200 = 0.0026, at the array +0.52, nearest 0.5, sensor 0.52 + 0.8 (0.0026 - 0.02/0.8) = 0.50208.
    points, lens = np.array([[1.03, -0.52, 0.0]]), np.array([[5.0, 0.0]])
    hits = trace(table2, lens, slopes_equivalent(points, lens, table2, Media()))
    assert hits.array_mm[0] == pytest.approx([-1.03, 0.52], abs=1e-12)
    assert hits.sensor_mm[0] == pytest.approx([-1.02412, 0.50208], abs=1e-12)
    # World (0.3, 1.0): with columns along y the image lies at column -1.0 mm and row -0.3 mm.
    camera = replace(table2, column_axis="y")
    points = camera.to_image_axes([[0.3, 1.0, 0.0]])
    array = trace(camera, [[2.0, 1.0]], slopes_equivalent(points, np.array([[2.0, 1.0]]), camera, Media())).array_mm
    assert array[0] == pytest.approx([-1.0, -0.3], abs=1e-12)
    # at r = 5 mm, k1 = 2e-5: 5 (1 + 2e-5 * 25) = 5.0025; the direction is left alone, so only x and the lens change
    camera = replace(table2, distortion_per_mm2=2e-5)
    lens, slopes = np.array([[0.0, 0.0]]), np.array([[0.015, 0.020]])  # meets the array at (3, 4)
    hits = trace(camera, lens, slopes)
    assert hits.array_mm[0] == pytest.approx([3.0015, 4.002], abs=1e-12)
    # f_m = s_mu: the sensor point is the lens's centre plus the direction times s_mu, 3.0 + 0.012 and 4.0 + 0.016
    assert hits.sensor_mm[0] == pytest.approx([3.012, 4.016], abs=1e-12)
    hits = trace(table2, [[12.4, 0.0], [12.6, 0.0], [9.0, 9.0]], np.zeros((3, 2)))
    assert hits.valid.tolist() == [True, False, False]
    assert exact_slope(0.0, 0.0, np.array([98.0, 2.0, 130.0]), np.array([1.0, 1.49, 1.33])) == (0.0, 0.0)


@pytest.mark.parametrize("magnification", [-0.5, -1.0, -2.0])
def test_a_point_at_plus_x_lights_m_x(table2, media, rng, magnification):
    camera = replace(table2, magnification=magnification)
    lens = disc_points(50, camera.aperture_radius_mm, rng)
    points = np.tile([0.7, -0.4, 0.0], (50, 1))
    array = trace(camera, lens, slopes_equivalent(points, lens, camera, media)).array_mm
    assert array == pytest.approx(magnification * points[:, :2], abs=1e-12)


def test_micro_images_are_centred_behind_the_aperture_s_centre(camera, rng):
    """Rays through the lens's centre and a microlens's centre meet the sensor at s_u (1 + s_mu/s_i)."""
    centre = camera.lattice.points(rng.integers(-30, 30, (20, 2)))
    crossing = np.zeros((20, 2))
    # in front of the main lens the ray through its centre has the slope it has behind it
    hits = trace(camera, crossing, centre / camera.image_distance_mm)
    assert hits.sensor_mm == pytest.approx(centre * 1.004, abs=1e-12)
    assert camera.mm_to_px(hits.sensor_mm) == pytest.approx(
        camera.micro_image_lattice_px().points(camera.lattice.nearest(centre)), abs=1e-9
    )


def test_exact_slopes_meet_the_point(camera, water, window, rng):
    """Forward and reverse: the ray with that slope, bent by sines at each face, arrives at the point it came from."""
    points, lens = strewn(rng, camera, 30)
    path = 133.8747651  # in the fluid to the focal point, see the media
    for point, crossing, slope in zip(points, lens, slopes_exact(points, lens, camera, water, window), strict=True):
        direction = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope @ slope)
        place = np.array([crossing[0], crossing[1], 0.0])
        for index_before, index, thickness in [(1, 1, 98.0), (1, 1.49, 2.0), (1.49, 1.33, path + point[2])]:
            sideways = direction[:2] * index_before / index
            direction = np.array([*sideways, np.sqrt(1 - sideways @ sideways)])
            place = place + direction * thickness / direction[2]
        assert place[:2] == pytest.approx(point[:2], abs=1e-8)


def test_kernel_traces_as_its_twin(camera, water, rng):
    camera = replace(
        camera,
        lattice=Lattice.regular(0.1, camera.lattice.layout, 0.002, (0.019, -0.012)),
        distortion_per_mm2=2e-5,
        microlens_distance_mm=0.78,
    )
    points, lens = strewn(rng, camera)
    slopes = slopes_equivalent(points, lens, camera, water)
    expected = trace(camera, lens, slopes).sensor_mm
    found = np.array([trace_ray(camera.for_kernels(), *x, *s) for x, s in zip(lens, slopes, strict=True)])
    assert found == pytest.approx(expected, abs=1e-12)


def test_disc_points_fill_the_disc_evenly(rng):
    points = disc_points(20000, 12.5, rng)
    r = np.hypot(*points.T)
    assert r.max() <= 12.5
    # half of them within R/sqrt(2), a quarter in each quadrant: 4 standard deviations of 20,000 trials
    assert np.mean(r < 12.5 / np.sqrt(2)) == pytest.approx(0.5, abs=0.015)
    assert np.mean((points[:, 0] > 0) & (points[:, 1] > 0)) == pytest.approx(0.25, abs=0.013)


def test_table2_lengths_and_defocus(table2):
    # S_i = F_m (1 - M) = 200, F_m (M - 1)/M = 200 at M = -1; at M = -0.5: 150 and 300
    assert (table2.image_distance_mm, table2.focus_distance_mm) == (200.0, 200.0)
    for magnification in (-0.5, -1.0, -3.0):
        camera = replace(table2, magnification=magnification)
        assert camera.defocus(camera.focus_distance_mm) == pytest.approx(0.0, abs=1e-14)
    half = replace(table2, magnification=-0.5)
    assert (half.image_distance_mm, half.focus_distance_mm) == (150.0, 300.0)
    # alpha = 1 + 200/190 - 200/100 = 0.0526316: nearer than the focal point spreads with X
    assert table2.defocus(190.0) == pytest.approx(0.0526316, abs=1e-7)


def test_micro_image_pitch_is_not_the_array_s(camera):
    # 0.1 mm * (1 + 0.8/200)/0.0055 mm = 18.254545 px
    assert camera.micro_image_lattice_px().pitch == pytest.approx([18.2545, 18.2545], abs=1e-4)
    moved = Lattice.regular(18.3, camera.lattice.layout, 0.01, (1180.0, 880.0))
    found = camera.with_micro_images(moved).micro_image_lattice_px()
    assert found.origin == pytest.approx(moved.origin)
    assert found.basis == pytest.approx(moved.basis)


def test_axis_meets_the_sensor_between_the_middle_pixels(table2, rng):
    assert table2.sensor_centre_px == pytest.approx([1175.5, 883.5])
    assert table2.mm_to_px((0.0, 0.0)) == pytest.approx([1175.5, 883.5])
    # pixel 1176 is centred half a pixel, 0.00275 mm, along +x of the axis
    assert table2.px_to_mm((1176, 883)) == pytest.approx([0.00275, -0.00275])
    px = rng.uniform(0, 2000, (20, 2))
    assert table2.mm_to_px(table2.px_to_mm(px)) == pytest.approx(px)


def test_column_axis_y_exchanges_x_and_y(table2):
    points = np.array([(1.0, 2.0, 3.0)])
    assert table2.to_image_axes(points).tolist() == [[1.0, 2.0, 3.0]]
    assert replace(table2, column_axis="y").to_image_axes(points).tolist() == [[2.0, 1.0, 3.0]]
    assert points.tolist() == [[1.0, 2.0, 3.0]]  # the caller's array is left alone


def lattice_of(layout, rotation_rad=0.02, origin=(0.013, -0.027)):
    return Lattice.regular(0.1, layout, rotation_rad, origin)


def test_basis_lengths_angle_and_rotation_from_the_columns_towards_the_rows(layout):
    lattice = lattice_of(layout)
    assert lattice.pitch == pytest.approx([0.1, 0.1])
    cosine = lattice.basis[0] @ lattice.basis[1] / 0.01
    assert cosine == pytest.approx({"square": 0.0, "hexagonal": 0.5}[layout], abs=1e-12)
    # 0.12 degrees turn (1, 0) into (cos, sin): ten lenses along the columns rise by 1.0 mm * 0.0020944 along the rows
    lattice = Lattice.regular(0.1, layout, np.deg2rad(0.12))
    assert lattice.points((10, 0)) == pytest.approx([0.9999978, 0.0020944], abs=1e-7)
    assert np.rad2deg(lattice.rotation_rad) == pytest.approx(0.12, rel=1e-12)


def test_nearest_by_brute_force_and_by_the_kernel(layout, rng):
    lattice, steps = lattice_of(layout), np.arange(-12, 13)
    points = rng.uniform(-0.5, 0.5, (2000, 2))
    indices = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(lattice.points(indices)[np.newaxis] - points[:, np.newaxis], axis=2)
    assert np.array_equal(lattice.nearest(points), indices[np.argmin(distance, axis=1)])
    found = np.array([nearest_point(x, y, lattice.origin, lattice.basis) for x, y in points[:500]])
    assert found == pytest.approx(lattice.points(lattice.nearest(points[:500])), abs=1e-15)
    x, y = points[:30, 0], points[:20, 1]
    on_grid = nearest_on_grid(x.copy(), y.copy(), lattice.origin, lattice.basis)
    assert np.array_equal(np.moveaxis(on_grid, 0, -1), lattice.nearest(np.stack(np.meshgrid(x, y), axis=-1)))


def test_coordinates_invert_points_that_transformed_and_scaled_lattices_move(layout, rng):
    lattice = lattice_of(layout)
    indices = rng.integers(-50, 50, (20, 2))
    assert lattice.coordinates(lattice.points(indices)) == pytest.approx(indices, abs=1e-10)
    matrix, shift = np.array([[0.9, 0.2], [-0.1, 1.1]]), np.array([3.0, -4.0])
    assert lattice.transformed(matrix, shift).points(indices) == pytest.approx(
        lattice.points(indices) @ matrix.T + shift
    )
    assert lattice.scaled(2.5).points(indices) == pytest.approx(2.5 * lattice.points(indices))


# Binary fractions, so that sums and differences are exact.
MID_PLANE = Reference("mid_plane", -0.375)


def test_what_lies_in_the_mid_plane_has_depth_zero_in_files_and_grids_move_as_their_cells() -> None:
    # A mid plane in front of the focal point: nearer to the camera, where z is negative.
    tracer = np.array([[1.0, 2.0, -0.375]])
    np.testing.assert_array_equal(MID_PLANE.points_from_focal_point(tracer), [[1.0, 2.0, 0.0]])
    assert MID_PLANE.depth_to_focal_point(0.0) == -0.375
    # What lies further from the camera than the mid plane is behind it: positive.
    assert MID_PLANE.points_from_focal_point(np.zeros((1, 3)))[0, 2] == 0.375
    grid = Grid((3, 2, 4), (0.5, 0.25, 1.0), (1.0, 2.0, -3.0))
    moved = MID_PLANE.grid_from_focal_point(grid)
    cells = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 3.0]])
    expected = MID_PLANE.points_from_focal_point(grid.voxel_to_mm(cells))
    np.testing.assert_array_equal(moved.voxel_to_mm(cells), expected)
    assert (moved.shape_xyz, moved.spacing_mm) == (grid.shape_xyz, grid.spacing_mm)


def test_conversions_undo_each_other_and_move_depths_alone(rng: np.random.Generator) -> None:
    points = rng.integers(-8, 8, (5, 4, 3)) / 8.0
    there = MID_PLANE.points_to_focal_point(points)
    np.testing.assert_array_equal(MID_PLANE.points_from_focal_point(there), points)
    np.testing.assert_array_equal(there[..., :2], points[..., :2])
    np.testing.assert_array_equal(there[..., 2], np.vectorize(MID_PLANE.depth_to_focal_point)(points[..., 2]))
    points = rng.random((5, 3))
    np.testing.assert_array_equal(FOCAL_POINT.points_to_focal_point(points), points)
    np.testing.assert_array_equal(FOCAL_POINT.points_from_focal_point(points), points)


def test_attributes_bring_it_back_but_for_one_that_cannot_be() -> None:
    assert Reference.from_attributes(MID_PLANE.attributes() | {"residual": 1.0}) == MID_PLANE
    for wrong in ({"reference": "focus"}, {"reference_z_mm": np.nan}, {"reference_z_mm": "far"}):
        with pytest.raises(ValueError):
            Reference.from_attributes(MID_PLANE.attributes() | wrong)


@pytest.fixture(params=[1, 4])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(request.param)
    yield request.param
    cv2.setNumThreads(before)


@pytest.mark.parametrize("size", [1, 2, 3, 6, 7])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_same_bits_as_scipy(threads: int, size: int, kind: type, rng: np.random.Generator) -> None:
    image = rng.normal(size=(37, 29)).astype(kind)
    np.testing.assert_array_equal(largest_around(image, size), ndimage.maximum_filter(image, size, mode="nearest"))
    np.testing.assert_array_equal(smallest_around(image, size), ndimage.minimum_filter(image, size, mode="nearest"))
    np.testing.assert_array_equal(opened(image, size), ndimage.grey_opening(image, (size, size)))


def test_a_mask_grows_by_the_eight_neighbours(threads: int) -> None:
    mask = np.zeros((5, 6), np.bool_)
    mask[0, 0] = mask[3, 4] = True
    expected = np.zeros_like(mask)
    expected[:2, :2] = expected[2:5, 3:6] = True
    np.testing.assert_array_equal(with_neighbours(mask), expected)
