"""The channel's mask, and the places of a grid's cells."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.flow.windows import ParallelWalls, RoundWall, inside
from lfpiv_cli.grid import Grid


def test_centres_are_those_of_the_axes() -> None:
    grid = Grid((2, 3, 4), (0.1, 0.2, 0.5), (1.0, -2.0, 3.0))
    centres = grid.centres_mm()
    assert centres.shape == (4, 3, 2, 3)
    np.testing.assert_allclose(centres[3, 2, 1], [1.1, -1.6, 4.5])
    np.testing.assert_allclose(centres[0, 2, 0], [1.0, -1.6, 3.0])


def test_voxels_beyond_the_walls_are_masked() -> None:
    grid = Grid.centred((1, 2, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    found = inside(grid, ParallelWalls(3.0))
    assert found.shape == grid.shape_zyx
    # centres at -2, -1, 0, 1, 2; walls at -1.5 and 1.5
    np.testing.assert_array_equal(found[:, 0, 0], [False, True, True, True, False])
    np.testing.assert_array_equal(found[:, 1, 0], found[:, 0, 0])


def test_windows_count_as_far_as_they_lie_between_the_walls() -> None:
    grid = Grid.centred((1, 1, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    share = ParallelWalls(3.0).shares(grid.centres_mm(), np.array([1.0, 1.0, 2.0]))[:, 0, 0]
    # a window from -3 to -1 has a quarter of its depth behind the wall at -1.5, one from -2 to 0 three quarters
    np.testing.assert_allclose(share, [0.25, 0.75, 1.0, 0.75, 0.25])


def test_a_slice_of_a_box_in_a_pipe_is_what_lies_in_both(rng: np.random.Generator) -> None:
    low = rng.uniform(-1.5, 1.0, (40, 2))
    high = low + rng.uniform(0.0, 2.0, (40, 2))
    slices = np.insert(low, 0, 0.0, axis=1), np.insert(high, 0, 1.0, axis=1)
    area = RoundWall(1.0).volumes_mm3(*slices)
    # cells of 1/200 of a side: of those that the circle cuts half count too much and half too little
    share = (np.arange(200) + 0.5) / 200
    x, y = (low[:, axis, np.newaxis] + share * (high - low)[:, axis, np.newaxis] for axis in range(2))
    counted = np.mean(x[:, :, np.newaxis] ** 2 + y[:, np.newaxis] ** 2 <= 1.0, axis=(1, 2)) * np.prod(
        high - low, axis=1
    )
    np.testing.assert_allclose(area, counted, atol=4e-3)
    assert RoundWall(1.0).volumes_mm3(np.array([0.0, -2.0, -1.0]), np.array([1.0, 2.0, 3.0])) == np.float64(np.pi)


PIPE = RoundWall(1.3, (0.4, -0.2, 0.3), "x")


def test_boxes_that_fill_a_pipe_hold_all_of_it() -> None:
    grid = Grid.centred((3, 9, 11), (0.5, 0.4, 0.3), (0.0, 0.0, 0.0))
    sides = np.array(grid.spacing_mm)
    share = PIPE.shares(grid.centres_mm(), sides)
    assert share.min() == 0.0
    np.testing.assert_allclose(share.max(), 1.0, rtol=1e-12)
    np.testing.assert_allclose(share.sum() * np.prod(sides), np.pi * 1.3**2 * 1.5, rtol=1e-12)
    nothing = np.array([[0.0, 0.0, 0.0]]), np.array([[1.0, -0.1, 1.0]])
    assert PIPE.volumes_mm3(*nothing) == 0.0


def test_a_pipe_along_y_is_one_along_x_with_axes_exchanged(rng: np.random.Generator) -> None:
    other = RoundWall(1.3, (-0.2, 0.4, 0.3), "y")
    points = rng.uniform(-2.0, 2.0, (300, 3))
    turned = points[:, [1, 0, 2]]
    contained = PIPE.contain(points)
    assert 0 < contained.sum() < 300
    np.testing.assert_array_equal(contained, other.contain(turned))
    sides = np.array([0.3, 0.7, 0.5])
    np.testing.assert_allclose(PIPE.shares(points, sides), other.shares(turned, sides[[1, 0, 2]]))


def test_a_tilted_pipe_is_a_round_one_about_its_axis(rng: np.random.Generator) -> None:
    tilted = RoundWall(1.3, (0.4, -0.2, 0.3), (1.0, 0.03, -0.04))
    assert (tilted.along, tilted.tilt_deg) == (0, pytest.approx(np.rad2deg(np.arctan(0.05))))
    at = rng.uniform(-2.0, 2.0, 50)
    on_axis = np.array(tilted.centre_mm) + at[:, np.newaxis] * np.array(tilted.axis)
    np.testing.assert_allclose(tilted.distances_mm(on_axis), 0.0, atol=1e-12)
    # halves of boxes are as full as the points in them say: 40,000 leave 0.003 of chance
    grid = Grid.centred((3, 4, 4), (1.0, 0.7, 0.7), (0.0, 0.0, 0.0))
    sides, centres = np.array(grid.spacing_mm), grid.centres_mm().reshape(-1, 3)
    points = centres[:, np.newaxis] + sides * rng.uniform(-0.5, 0.5, (len(centres), 40_000, 3))
    np.testing.assert_allclose(tilted.shares(centres, sides), tilted.contain(points).mean(axis=1), atol=0.012)
    low, high = np.array([-1.0, -1.0, -2.0]), np.array([1.0, 2.0, 2.0])
    wall = tilted.points(low, high, np.array([0.5, 0.2, 0.3]))
    # rings stand across x: they are off by the tilt's square
    np.testing.assert_allclose(tilted.distances_mm(wall), 1.3, rtol=2e-3)
    assert len(wall) > 100
    assert np.all((wall >= low) & (wall <= high))


def test_voxels_of_a_pipe_are_those_whose_centres_it_contains() -> None:
    grid = Grid.centred((2, 12, 13), (0.3, 0.3, 0.3), (0.4, 0.0, 0.2))
    np.testing.assert_array_equal(inside(grid, PIPE), PIPE.contain(grid.centres_mm()))


def test_points_on_a_pipes_wall_leave_no_gaps() -> None:
    low, high = np.array([-1.0, -1.0, -2.0]), np.array([1.0, 2.0, 2.0])
    found = PIPE.points(low, high, np.array([0.5, 0.2, 0.3]))
    np.testing.assert_allclose(PIPE.distances_mm(found), 1.3)
    assert np.all((found >= low) & (found <= high))
    # the box cuts the wall at y = -1: cos of the angle from the axis is -0.8 / 1.3 there, on both sides
    angles = np.unique(np.round(np.arctan2(found[:, 2] - 0.3, found[:, 1] + 0.2), 9))
    assert np.abs(angles).max() <= np.arccos(-0.8 / 1.3)
    assert np.diff(angles).max() * 1.3 <= 0.2 + 1e-9
    assert np.diff(np.unique(found[:, 0])).max() <= 0.5
    np.testing.assert_allclose([found[:, 0].min(), found[:, 0].max()], [-1.0, 1.0])


def test_points_on_parallel_walls_are_on_those_that_the_box_holds() -> None:
    low, high = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 2.0])
    found = ParallelWalls(3.0).points(low, high, np.array([0.5, 1.0, 1.0]))
    assert found.shape == (15, 3)
    np.testing.assert_array_equal(found[:, 2], 1.5)
