"""Where the correlation windows lie in a volume.

Axes: triples are ordered (x, y, z). Positions are voxel indices; voxel k covers k - 0.5 to k + 0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid

Triple = tuple[int, int, int]

# A quotient of lengths that should be a whole number may fall short of it by this.
ROUNDING = 1e-9


@dataclass(frozen=True)
class WindowLayout:
    """A regular arrangement of equal windows; window k along an axis covers voxels first + k step ... + size - 1.

    Windows may overhang the volume: `first` is then negative.
    """

    size: Triple
    step: Triple
    count: Triple
    first: Triple

    @property
    def count_zyx(self) -> Triple:
        """Shape of an array with one element per window."""
        nx, ny, nz = self.count
        return nz, ny, nx

    def centres_voxel(self, axis: int) -> NDArray[np.float64]:
        """Return the window centres along axis 0 (x), 1 (y) or 2 (z) as (fractional) voxel indices."""
        first_centre = self.first[axis] + 0.5 * (self.size[axis] - 1)
        return first_centre + self.step[axis] * np.arange(self.count[axis], dtype=np.float64)

    def grid(self, volume: Grid) -> Grid:
        """Return the grid of the window centres, in mm, for windows in a volume on the grid `volume`."""
        spacing = tuple(s * d for s, d in zip(self.step, volume.spacing_mm, strict=True))
        origin = volume.voxel_to_mm(np.array([self.centres_voxel(axis)[0] for axis in range(3)]))
        return Grid(
            self.count,
            (spacing[0], spacing[1], spacing[2]),
            (float(origin[0]), float(origin[1]), float(origin[2])),
        )


def layout_windows(shape_xyz: Triple, size_xyz: Triple, overlap: tuple[float, float, float]) -> WindowLayout:
    """Return the windows that fill a volume: floor(N / [size (1 - overlap)]) an axis, the remainder split evenly.

    Each window sits in the middle of a cell of `step` voxels, and the cells fill the volume as far as whole cells can.
    The windows therefore overhang the volume where they are larger than their cell.

    Parameters
    ----------
    shape_xyz : voxels of the volume
    size_xyz : voxels of a window
    overlap : share of a window that it has in common with the next one, 0 <= overlap < 1; the step is then rounded to
        whole voxels, or rounded down where so many windows would not fit
    """
    axes = [_layout_axis(n, w, o) for n, w, o in zip(shape_xyz, size_xyz, overlap, strict=True)]
    (sx, nx, fx), (sy, ny, fy), (sz, nz, fz) = axes
    return WindowLayout(size_xyz, (sx, sy, sz), (nx, ny, nz), (fx, fy, fz))


def _layout_axis(voxels: int, size: int, overlap: float) -> Triple:
    """Return step, count and first voxel along one axis."""
    exact = size * (1.0 - overlap)
    count = max(1, math.floor(voxels / exact + ROUNDING))
    # Of whole voxels, and no more than leave all windows' cells inside the volume.
    step = max(1, min(math.floor(exact + 0.5), voxels // count))
    # Doubled, to stay in whole numbers; an odd remainder leaves its last voxel at the far end.
    twice_first = (voxels - count * step) + step - size
    return step, count, twice_first // 2
