"""What falls on one microlens, for any lattice: areas shared by a rectangle and the region nearest to a lens.

Axes: image axes on the array, mm.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.microlenses import Lattice

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
    now[0, 0], now[0, 1], now[1, 0], now[1, 1] = left, bottom, right, bottom
    now[2, 0], now[2, 1], now[3, 0], now[3, 1] = right, top, left, top
    corners = 4
    for k in range(steps.shape[0]):
        a, b = steps[k, 0], steps[k, 1]
        limit = 0.5 * (a * a + b * b)
        if max(a * left, a * right) + max(b * bottom, b * top) <= limit:
            continue
        if min(a * left, a * right) + min(b * bottom, b * top) >= limit:
            return 0.0, 0.0, 0.0, 0.0, 0.0
        kept = 0
        for m in range(corners):
            x0, y0 = now[m, 0], now[m, 1]
            following = m + 1 if m + 1 < corners else 0
            x1, y1 = now[following, 0], now[following, 1]
            over0, over1 = a * x0 + b * y0 - limit, a * x1 + b * y1 - limit
            if over0 <= 0.0:
                after[kept, 0], after[kept, 1] = x0, y0
                kept += 1
            if (over0 < 0.0 < over1) or (over1 < 0.0 < over0):
                t = over0 / (over0 - over1)
                after[kept, 0], after[kept, 1] = x0 + t * (x1 - x0), y0 + t * (y1 - y0)
                kept += 1
        now, after = after, now
        corners = kept
        if corners < 3:
            return 0.0, 0.0, 0.0, 0.0, 0.0
    return polygon_moments(now, corners, centre_x, centre_y)


@njit(cache=True)
def polygon_moments(
    polygon: NDArray[np.float64], corners: int, offset_x: float, offset_y: float
) -> tuple[float, float, float, float, float]:
    """Return area, centroid (moved by the offset) and widths of a convex polygon."""
    twice, sum_x, sum_y = 0.0, 0.0, 0.0
    x0, y0 = polygon[0, 0], polygon[0, 1]
    left, right, bottom, top = x0, x0, y0, y0
    for k in range(1, corners):
        x1, y1 = polygon[k, 0], polygon[k, 1]
        left, right, bottom, top = min(left, x1), max(right, x1), min(bottom, y1), max(top, y1)
        if k + 1 < corners:
            x2, y2 = polygon[k + 1, 0], polygon[k + 1, 1]
            area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
            twice += area
            sum_x += area * (x0 + x1 + x2) / 3.0
            sum_y += area * (y0 + y1 + y2) / 3.0
    if twice <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return 0.5 * twice, sum_x / twice + offset_x, sum_y / twice + offset_y, right - left, top - bottom
