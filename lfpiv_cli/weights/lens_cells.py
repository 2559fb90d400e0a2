"""What falls on one microlens, for any lattice: areas shared by a rectangle and the region nearest to a lens.

Axes: image axes on the array, mm.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.microlenses import Lattice
from lfpiv_cli.weights.polygons import cut, polygon_moments, set_rectangle

# A rectangle cut by eight half planes has at most twelve corners.
MOST_CORNERS = 16


def neighbours(lattice: Lattice) -> NDArray[np.float64]:
    """Return the steps (8, 2) to the surrounding lattice points; half-way to them ends a lens's region."""
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    return np.array(steps, dtype=np.float64) @ lattice.basis


def cell_radius(lattice: Lattice) -> float:
    """Return how far from its lens the lens's region reaches at most: half the basis cell's long diagonal."""
    first, second = lattice.basis
    return 0.5 * float(max(np.hypot(*(first + second)), np.hypot(*(first - second))))


@njit(cache=True)
def shared_rectangle(
    low: tuple[float, float],
    high: tuple[float, float],
    centre_x: float,
    centre_y: float,
    steps: NDArray[np.float64],
    work: NDArray[np.float64],
) -> tuple[float, float, float, float, float]:
    """Return the area that a rectangle shares with the region of a lens, its centroid (x, y) and its widths (x, y).

    Parameters
    ----------
    low, high : (2,) corners of the rectangle
    centre_x, centre_y : the lens
    steps : from `neighbours`
    work : (2, MOST_CORNERS, 2) scratch
    """
    now, after = work[0], work[1]
    left, right = low[0] - centre_x, high[0] - centre_x
    bottom, top = low[1] - centre_y, high[1] - centre_y
    set_rectangle(now, left, right, bottom, top)
    corners = 4
    for k in range(steps.shape[0]):
        a, b = steps[k, 0], steps[k, 1]
        limit = 0.5 * (a * a + b * b)
        if max(a * left, a * right) + max(b * bottom, b * top) <= limit:
            continue
        if min(a * left, a * right) + min(b * bottom, b * top) >= limit:
            return 0.0, 0.0, 0.0, 0.0, 0.0
        corners = cut(now[:corners], a, b, limit, after)
        now, after = after, now
        if corners < 3:
            return 0.0, 0.0, 0.0, 0.0, 0.0
    return polygon_moments(now[:corners], centre_x, centre_y)
