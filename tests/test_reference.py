"""The origin of coordinates: two conversions that undo each other, and their sign."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import FOCAL_POINT, Reference

# Binary fractions, so that sums and differences are exact.
MID_PLANE = Reference("mid_plane", -0.375)


def test_what_lies_in_the_mid_plane_has_depth_zero_in_files() -> None:
    """A mid plane in front of the focal point: nearer to the camera, where z is negative."""
    tracer = np.array([[1.0, 2.0, -0.375]])
    np.testing.assert_array_equal(MID_PLANE.points_from_focal_point(tracer), [[1.0, 2.0, 0.0]])
    assert MID_PLANE.depth_to_focal_point(0.0) == -0.375
    # What lies further from the camera than the mid plane is behind it: positive.
    assert MID_PLANE.points_from_focal_point(np.zeros((1, 3)))[0, 2] == 0.375


def test_conversions_undo_each_other_and_move_depths_alone(rng: np.random.Generator) -> None:
    points = rng.integers(-8, 8, (5, 4, 3)) / 8.0
    there = MID_PLANE.points_to_focal_point(points)
    np.testing.assert_array_equal(MID_PLANE.points_from_focal_point(there), points)
    np.testing.assert_array_equal(there[..., :2], points[..., :2])
    np.testing.assert_array_equal(there[..., 2], np.vectorize(MID_PLANE.depth_to_focal_point)(points[..., 2]))


def test_a_grid_moves_as_its_cells_do() -> None:
    grid = Grid((3, 2, 4), (0.5, 0.25, 1.0), (1.0, 2.0, -3.0))
    moved = MID_PLANE.grid_from_focal_point(grid)
    cells = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 3.0]])
    expected = MID_PLANE.points_from_focal_point(grid.voxel_to_mm(cells))
    np.testing.assert_array_equal(moved.voxel_to_mm(cells), expected)
    assert (moved.shape_xyz, moved.spacing_mm) == (grid.shape_xyz, grid.spacing_mm)


def test_the_focal_point_moves_nothing(rng: np.random.Generator) -> None:
    points = rng.random((5, 3))
    np.testing.assert_array_equal(FOCAL_POINT.points_to_focal_point(points), points)
    np.testing.assert_array_equal(FOCAL_POINT.points_from_focal_point(points), points)


def test_attributes_bring_it_back() -> None:
    assert Reference.from_attributes(MID_PLANE.attributes() | {"residual": 1.0}) == MID_PLANE


@pytest.mark.parametrize("wrong", [{"reference": "focus"}, {"reference_z_mm": np.nan}, {"reference_z_mm": "far"}])
def test_a_reference_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        Reference.from_attributes(MID_PLANE.attributes() | wrong)
