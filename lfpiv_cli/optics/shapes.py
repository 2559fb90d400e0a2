"""What surfaces are made of: vectors in space, and a surface near the point where the optical axis meets it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.threads import COUNT_NO_REFERENCES

Vector = tuple[float, float, float]

NO_AXIS: Vector = (0.0, 0.0, 0.0)


class Relief(NamedTuple):
    """Heights z over x and y as a bicubic spline, see `height_map`.

    Attributes
    ----------
    first_mm, step_mm : (2,) x and y of the first node, and from one node to the next
    coefficients : (ny - 1, nx - 1, 4, 4) of each cell: powers 0 to 3 of y, then of x, from its first node, in steps
    """

    first_mm: NDArray[np.float64]
    step_mm: NDArray[np.float64]
    coefficients: NDArray[np.float64]


class Shape(NamedTuple):
    """A surface near the optical axis, world axes.

    Attributes
    ----------
    vertex_mm : v, where the optical axis meets it
    normal : n there, unit, away from the camera
    axis : a, unit along a cylinder's axis, else 0
    curvature_per_mm : k, negative where the surface bulges towards the camera
    relief : where the surface is given by its heights, these, and they stand in place of the curvature
    """

    vertex_mm: Vector
    normal: Vector
    axis: Vector
    curvature_per_mm: float
    relief: Relief | None = None


def unit(direction: Sequence[float], name: str) -> Vector:
    """Return a direction with length 1.

    Raises
    ------
    ConfigError : it has none
    """
    length = float(np.linalg.norm(direction))
    if not length > 0.0:
        raise ConfigError(f"{name} is {list(direction)}, expected a direction")
    return direction[0] / length, direction[1] / length, direction[2] / length


@njit(cache=True, **COUNT_NO_REFERENCES)
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, **COUNT_NO_REFERENCES)
def plus(a: Vector, factor: float, b: Vector) -> Vector:
    """Return a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@njit(cache=True, **COUNT_NO_REFERENCES)
def scaled(factor: float, a: Vector) -> Vector:
    """Return factor a."""
    return factor * a[0], factor * a[1], factor * a[2]


@njit(cache=True, **COUNT_NO_REFERENCES)
def row(rows: NDArray[np.float64], k: int) -> Vector:
    """Return row k of an array (n, 3)."""
    return rows[k, 0], rows[k, 1], rows[k, 2]
