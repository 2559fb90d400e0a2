"""The origin of the coordinates, and comparisons around each pixel."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from scipy import ndimage

from lfpiv_cli.grid import FOCAL_POINT, Grid, Reference
from lfpiv_cli.neighbourhoods import largest_around, opened, smallest_around, with_neighbours

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
