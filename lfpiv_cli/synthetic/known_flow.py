"""What is known of a flow: its velocities, their gradients and, where it has a closed form, its pressure.

Axes: world (x, y, z), z away from the camera. Points in mm, velocities in m/s, gradients per second, pressures in Pa.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Flow = Callable[[Floats], Floats]
"""Velocities in m/s, (n, 3), at points in mm, (n, 3)."""

Pressure = Callable[[Floats, float], Floats]
"""Pressures in Pa, (n,), up to a constant, at points in mm, (n, 3), of a fluid of a density in kg/m^3."""

Axis = Literal["x", "y", "z"]

MM_PER_M = 1000.0

ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class KnownFlow:
    """A steady flow, called like its velocities.

    Attributes
    ----------
    velocity : (n, 3) in m/s at points (n, 3) in mm
    gradient : (n, 3, 3) in 1/s, of component i along axis j
    pressure : that of an inviscid fluid, whose gradient is what accelerates this one; None where it has no closed form
    """

    velocity: Flow
    gradient: Callable[[Floats], Floats]
    pressure: Pressure | None = None

    def __call__(self, points_mm: Floats) -> Floats:
        """Return the velocities (n, 3) in m/s at points (n, 3) in mm."""
        return self.velocity(points_mm)


def axis_index(axis: Axis) -> int:
    """Return 0, 1 or 2."""
    return "xyz".index(axis)


def dynamic_pressure(velocity_m_s: Floats, density_kg_m3: float) -> Floats:
    """Return rho |v|^2 / 2, (n,) in Pa, of velocities (n, 3)."""
    return np.asarray(0.5 * density_kg_m3 * np.sum(velocity_m_s**2, axis=1))
