"""The regular grid that a volume or a vector field lives on.

Axes: arrays are indexed `[z, y, x]`; everything that is a triple of lengths or a point is ordered (x, y, z), in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Grid:
    """A regular grid of cells, square to the optical axis.

    Attributes
    ----------
    shape_xyz : number of cells along x, y, z
    spacing_mm : distance of neighbouring cell centres along x, y, z
    origin_mm : centre of the first cell, (x, y, z)
    """

    shape_xyz: tuple[int, int, int]
    spacing_mm: tuple[float, float, float]
    origin_mm: tuple[float, float, float]

    @classmethod
    def centred(
        cls,
        shape_xyz: tuple[int, int, int],
        spacing_mm: tuple[float, float, float],
        centre_mm: tuple[float, float, float],
    ) -> Grid:
        """Return the grid whose middle lies at `centre_mm`: cell k is centred at centre + (k - (n - 1)/2) spacing."""
        origin = tuple(c - (n - 1) / 2 * d for n, d, c in zip(shape_xyz, spacing_mm, centre_mm, strict=True))
        return cls(shape_xyz, spacing_mm, (origin[0], origin[1], origin[2]))

    @property
    def shape_zyx(self) -> tuple[int, int, int]:
        """Shape of an array on this grid."""
        nx, ny, nz = self.shape_xyz
        return nz, ny, nx

    def axis_mm(self, axis: int) -> NDArray[np.float64]:
        """Return the cell centres along axis 0 (x), 1 (y) or 2 (z), in mm."""
        return self.origin_mm[axis] + self.spacing_mm[axis] * np.arange(self.shape_xyz[axis], dtype=np.float64)

    def centres_mm(self) -> NDArray[np.float64]:
        """Return the cell centres (nz, ny, nx, 3), (x, y, z) in mm."""
        z, y, x = np.meshgrid(*(self.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
        return np.stack([x, y, z], axis=-1)

    def bounds_mm(self, axis: int) -> tuple[float, float]:
        """Return the outer faces of the first and last cell along an axis, in mm."""
        half = 0.5 * self.spacing_mm[axis]
        first = self.origin_mm[axis]
        return first - half, first + self.spacing_mm[axis] * (self.shape_xyz[axis] - 1) + half

    def voxel_to_mm(self, index_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (fractional) cell indices, shape (..., 3) in x, y, z order, to mm."""
        return np.asarray(self.origin_mm) + np.asarray(index_xyz, dtype=np.float64) * np.asarray(self.spacing_mm)

    def mm_to_voxel(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert points in mm, shape (..., 3) in x, y, z order, to (fractional) cell indices."""
        return (np.asarray(points_mm, dtype=np.float64) - np.asarray(self.origin_mm)) / np.asarray(self.spacing_mm)

    def padded(self, cells_xyz: tuple[int, int, int]) -> Grid:
        """Return the grid with `cells_xyz` more cells on both sides of each axis."""
        shape = tuple(n + 2 * p for n, p in zip(self.shape_xyz, cells_xyz, strict=True))
        origin = tuple(o - p * d for o, p, d in zip(self.origin_mm, cells_xyz, self.spacing_mm, strict=True))
        return Grid((shape[0], shape[1], shape[2]), self.spacing_mm, (origin[0], origin[1], origin[2]))
