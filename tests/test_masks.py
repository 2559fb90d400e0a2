"""The channel's mask, and the places of a grid's cells."""

from __future__ import annotations

import numpy as np

from lfpiv_cli.flow.masks import between_walls, share_between_walls
from lfpiv_cli.grid import Grid


def test_centres_are_those_of_the_axes() -> None:
    grid = Grid((2, 3, 4), (0.1, 0.2, 0.5), (1.0, -2.0, 3.0))
    centres = grid.centres_mm()
    assert centres.shape == (4, 3, 2, 3)
    np.testing.assert_allclose(centres[3, 2, 1], [1.1, -1.6, 4.5])
    np.testing.assert_allclose(centres[0, 2, 0], [1.0, -1.6, 3.0])


def test_voxels_beyond_the_walls_are_masked() -> None:
    grid = Grid.centred((1, 2, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    inside = between_walls(grid, width_mm=3.0)
    assert inside.shape == grid.shape_zyx
    # centres at -2, -1, 0, 1, 2; walls at -1.5 and 1.5
    np.testing.assert_array_equal(inside[:, 0, 0], [False, True, True, True, False])
    np.testing.assert_array_equal(inside[:, 1, 0], inside[:, 0, 0])


def test_windows_count_as_far_as_they_lie_between_the_walls() -> None:
    grid = Grid.centred((1, 1, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    share = share_between_walls(grid, width_mm=3.0, window_mm=2.0)[:, 0, 0]
    # a window from -3 to -1 has a quarter of its depth behind the wall at -1.5, one from -2 to 0 three quarters
    np.testing.assert_allclose(share, [0.25, 0.75, 1.0, 0.75, 0.25])
