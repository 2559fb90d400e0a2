"""Where things are: the regular grid that volumes and vector fields live on, where coordinates begin, what units suit.

Axes: arrays are indexed `[z, y, x]`; everything that is a triple of lengths or a point is ordered (x, y, z), in mm.

Wherever light is followed (optics, weights, particles while they are looked for, the truth of simulations) z counts
from the nominal focal point in the fluid. The coordinates of volumes, vectors and points in files count from a
reference on the optical axis, which lies at `z_mm` from the focal point, positive away from the camera:

    z from the focal point = z from the reference + z_mm

x and y are the same in both. Example: a channel's mid plane that lies 0.4 mm in front of the focal point has z_mm =
-0.4; a tracer in the mid plane has z = 0 in files and z = -0.4 from the focal point.

What tracers are sought and followed by counts in two lengths of the camera (`Scale`): one in millimetres that suits one
camera is wrong for the next. What limits how near two tracers may be, how well they are known and how far a fit may err
is the microlens as the main lens shows it in the scene, and the depth over which a point's light spreads by one lens.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.names import ReferenceName, names_in


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


@dataclass(frozen=True)
class Reference:
    """Where the coordinates of a file begin.

    Attributes
    ----------
    name : the nominal focal point, or the channel's mid plane
    z_mm : its place on the optical axis, from the nominal focal point, positive away from the camera
    """

    name: ReferenceName
    z_mm: float

    def depth_to_focal_point(self, z_mm: float) -> float:
        """Return a depth from the reference as one from the focal point."""
        return z_mm + self.z_mm

    def points_to_focal_point(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (..., 3), z from the reference, with z from the focal point."""
        return points_mm + np.array([0.0, 0.0, self.z_mm])

    def points_from_focal_point(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (..., 3), z from the focal point, with z from the reference."""
        return points_mm - np.array([0.0, 0.0, self.z_mm])

    def grid_from_focal_point(self, grid: Grid) -> Grid:
        """Return a grid, z from the focal point, with z from the reference."""
        x, y, z = grid.origin_mm
        return replace(grid, origin_mm=(x, y, z - self.z_mm))

    def attributes(self) -> dict[str, Any]:
        """Return what a file says of it."""
        return {"reference": self.name, "reference_z_mm": self.z_mm}

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any]) -> Reference:
        """Return the reference that a file's attributes name.

        Raises
        ------
        KeyError, ValueError : they name none, or one that cannot be
        """
        name, z_mm = attributes["reference"], float(attributes["reference_z_mm"])
        if name not in names_in(ReferenceName) or not math.isfinite(z_mm):
            raise ValueError(f"its coordinates begin at {name!r}, {z_mm} mm")
        return cls(name, z_mm)


FOCAL_POINT = Reference("focal_point", 0.0)


class Scale(NamedTuple):
    """A camera's lengths in the scene. Table 2's: 0.1 mm and 1.064 mm.

    Attributes
    ----------
    lens_mm : a microlens in the scene, p_l / |M|
    depth_mm : the depth in the fluid over which a point's light spreads by one lens, (n_w / n_a) p_l N / M^2 with
        N = s_i / p_m of the main lens
    """

    lens_mm: float
    depth_mm: float

    @property
    def depth_ratio(self) -> float:
        """Depth over lateral length, 10.64 in Table 2."""
        return self.depth_mm / self.lens_mm

    def box_mm(self, lenses: float, depths: float) -> NDArray[np.float64]:
        """Return lengths (3,) along x, y and z: so many microlenses laterally, so many depths of one lens."""
        return np.array([lenses * self.lens_mm, lenses * self.lens_mm, depths * self.depth_mm])
