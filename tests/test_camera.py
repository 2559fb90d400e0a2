"""The camera of Table 2, by hand; the lattice of its lenses, by brute force; the origin of coordinates; neighbours."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from lfpiv_cli.grid import FOCAL_POINT, Grid, Reference
from lfpiv_cli.neighbourhoods import largest_around, opened, smallest_around, with_neighbours
from lfpiv_cli.optics.camera import Lattice, nearest_point


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
