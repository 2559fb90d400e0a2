"""Where the rays of small glowing balls start and cross the lens: one evenly spread sequence, shifted for each ball."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Additive recurrence in four dimensions (aperture and ball): powers of the inverse of the root of x^5 = x + 1, whose
# multiples fill the unit cube more evenly than random points do.
SEQUENCE_ROOT = 1.1673039782614187
SEQUENCE = SEQUENCE_ROOT ** -np.arange(1.0, 5.0)


@njit(cache=True)
def ray_places(shifts: NDArray[np.float64], i: int, k: int) -> tuple[float, float, float, float]:
    """Return ray k of ball i as `on_disc` and `in_ball` take it, the first two numbers and the last ones."""
    return (
        shifts[i, 0] + k * SEQUENCE[0],
        shifts[i, 1] + k * SEQUENCE[1],
        shifts[i, 2] + k * SEQUENCE[2],
        shifts[i, 3] + k * SEQUENCE[3],
    )


@njit(cache=True)
def on_disc(radius: float, radial: float, turn: float) -> tuple[float, float]:
    """Return the point of an evenly filled disc for two numbers, evenly spread between any integers."""
    r = radius * np.sqrt(radial % 1.0)
    return r * np.cos(2.0 * np.pi * turn), r * np.sin(2.0 * np.pi * turn)


@njit(cache=True)
def in_ball(radius: float, radial: float, turn: float) -> tuple[float, float]:
    """Return a point of an evenly filled ball, seen along the axis: the share 1 - (1 - r^2/R^2)^(3/2) lies within r."""
    r = radius * np.sqrt(1.0 - (radial % 1.0) ** (2.0 / 3.0))
    return r * np.cos(2.0 * np.pi * turn), r * np.sin(2.0 * np.pi * turn)
