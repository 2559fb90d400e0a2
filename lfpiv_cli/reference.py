"""The origin of coordinates along the optical axis, and the two conversions between it and the focal point.

Wherever light is followed (optics, weights, particles while they are looked for, the truth of simulations) z counts
from the nominal focal point in the fluid. The coordinates of volumes, vectors and points in files count from a
reference on the optical axis, which lies at `z_mm` from the focal point, positive away from the camera:

    z from the focal point = z from the reference + z_mm

x and y are the same in both. Example: a channel's mid plane that lies 0.4 mm in front of the focal point has z_mm =
-0.4; a tracer in the mid plane has z = 0 in files and z = -0.4 from the focal point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.names import ReferenceName, names_in


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
