"""A rigid motion of bodies on the bench: turned about a point, then shifted.

Axes: world axes, z away from the camera from the nominal focal point, mm and rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lfpiv_cli.optics.shapes import Vector


@dataclass(frozen=True)
class RigidMotion:
    """A turn about a point, and a shift.

    Attributes
    ----------
    shift_mm : along the world axes
    turn_rad : vector along the axis of the turn, as long as its angle, right-handed
    pivot_mm : the point that only the shift moves
    """

    shift_mm: Vector = (0.0, 0.0, 0.0)
    turn_rad: Vector = (0.0, 0.0, 0.0)
    pivot_mm: Vector = (0.0, 0.0, 0.0)

    @property
    def turns(self) -> bool:
        """Whether it is more than a shift."""
        return any(self.turn_rad)

    def points(self, points_mm: ArrayLike) -> NDArray[np.float64]:
        """Return where points (..., 3) are moved to."""
        pivot = np.asarray(self.pivot_mm)
        return self.directions(np.asarray(points_mm, dtype=np.float64) - pivot) + pivot + np.asarray(self.shift_mm)

    def directions(self, directions: ArrayLike) -> NDArray[np.float64]:
        """Return how directions (..., 3) are turned."""
        return np.asarray(np.asarray(directions, dtype=np.float64) @ self._rotation.as_matrix().T)

    def point(self, point_mm: Sequence[float]) -> Vector:
        """Return where one point is moved to."""
        x, y, z = self.points(point_mm).tolist()
        return x, y, z

    def direction(self, direction: Sequence[float]) -> Vector:
        """Return how one direction is turned."""
        x, y, z = self.directions(direction).tolist()
        return x, y, z

    def then(self, later: RigidMotion) -> RigidMotion:
        """Return this motion followed by another, about this one's pivot."""
        turn = (later._rotation * self._rotation).as_rotvec().tolist()
        shift = (later.points(self.points(self.pivot_mm)) - np.asarray(self.pivot_mm)).tolist()
        return RigidMotion((shift[0], shift[1], shift[2]), (turn[0], turn[1], turn[2]), self.pivot_mm)

    @property
    def _rotation(self) -> Rotation:
        return Rotation.from_rotvec(np.asarray(self.turn_rad, dtype=np.float64))
