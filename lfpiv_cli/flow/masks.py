"""Where vectors can be measured: between the walls of a channel that lie across the optical axis.

Axes: arrays [z, y, x]; z in mm from the channel's mid plane.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid


def between_walls(grid: Grid, width_mm: float) -> NDArray[np.bool_]:
    """Return the voxels (nz, ny, nx) whose centres lie between walls across z, half the width from z = 0."""
    return _on_planes(grid, np.abs(grid.axis_mm(2)) <= 0.5 * width_mm)


def share_between_walls(grid: Grid, width_mm: float, window_mm: float) -> NDArray[np.float64]:
    """Return the share (nz, ny, nx) of the depth of windows, centred on `grid`, that lies between such walls."""
    wall, half = 0.5 * width_mm, 0.5 * window_mm
    z = grid.axis_mm(2)
    return _on_planes(grid, np.clip(np.minimum(z + half, wall) - np.maximum(z - half, -wall), 0.0, None) / window_mm)


def _on_planes(grid: Grid, values: NDArray[Any]) -> NDArray[Any]:
    """Return an array (nz, ny, nx) with one value (nz,) for each plane."""
    return np.broadcast_to(values[:, np.newaxis, np.newaxis], grid.shape_zyx).copy()
