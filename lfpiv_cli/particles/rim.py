"""How a pixel's patch of the main lens meets the round aperture: its covered share and where that share lies.

A patch that straddles the rim is lit only in part, and from one side; without the second fact, the first moments, all
depths shrink by half a per cent.

Axes: (X, Y) on the main lens, in mm about the axis; xi and eta run from -1 to 1 across a patch.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.threads import COUNT_NO_REFERENCES
from lfpiv_cli.weights.aperture import disc_area_below

# Of the table: distances from the rim, from patches that are whole to dark ones, and directions of a quadrant. Linear
# between them, the share is right to 4e-3 where the rim enters a patch by its corner, to 5e-4 on average. A finer table
# does not stay in the first-level cache.
DISTANCES, DIRECTIONS = 33, 17
# Columns of an entry, the last of them empty: two entries are one register.
ENTRY = 4
# Of lengths that divide, mm.
TINY = 1e-12
# Strips per patch for the first moments: their own width adds 1/12 of (2/32)^2 to a moment's square.
STRIPS = 32


def rim_table(radius_mm: float, patch_mm: float) -> tuple[NDArray[np.float64], float]:
    """Return C, mean of xi and mean of eta over covered points of a patch, for patches centred in the first quadrant.

    Returns
    -------
    table : (DIRECTIONS, DISTANCES, ENTRY), index [|Y|/(|X| + |Y|), distance from the rim] in even steps; the means are
        per whole patch, not per covered part
    reach : distances are from -reach to reach, in widths of a patch: beyond, patches are whole or dark
    """
    # The rim is lower at a patch's sides than in its middle.
    reach = float(np.sqrt(0.5) + patch_mm / (8.0 * radius_mm))
    return _table(radius_mm, patch_mm, reach), reach


@njit(cache=True)
def _covered(x0: float, x1: float, y0: float, y1: float, radius: float) -> float:
    """Return the area of a rectangle inside the disc."""
    return (
        disc_area_below(x1, y1, radius)
        - disc_area_below(x0, y1, radius)
        - disc_area_below(x1, y0, radius)
        + disc_area_below(x0, y0, radius)
    )


@njit(cache=True)
def _table(radius: float, patch: float, reach: float) -> NDArray[np.float64]:
    table = np.zeros((DIRECTIONS, DISTANCES, ENTRY))
    half, strip = 0.5 * patch, patch / STRIPS
    for direction in range(DIRECTIONS):
        down = direction / (DIRECTIONS - 1.0)
        length = np.hypot(1.0 - down, down)
        for distance in range(DISTANCES):
            away = radius + reach * (2.0 * distance / (DISTANCES - 1.0) - 1.0) * patch
            low_x, low_y = away * (1.0 - down) / length - half, away * down / length - half
            entry = table[direction, distance]
            for k in range(STRIPS):
                middle = (2.0 * k + 1.0) / STRIPS - 1.0
                upright = _covered(low_x + k * strip, low_x + (k + 1) * strip, low_y, low_y + patch, radius)
                level = _covered(low_x, low_x + patch, low_y + k * strip, low_y + (k + 1) * strip, radius)
                entry[0] += upright / patch**2
                entry[1] += middle * upright / patch**2
                entry[2] += middle * level / patch**2
    return table


@njit(cache=True, **COUNT_NO_REFERENCES)
def covered_share(
    x: float, y: float, width: float, radius: float, table: NDArray[np.float64], reach: float
) -> tuple[float, float, float, float, float]:
    """Return C, the means of xi and eta, and the slopes of C along X and Y (per mm) of the patch centred at (x, y).

    Patches are a few per cent wider or narrower than the table's, by the particle's depth: what counts is how many of
    their widths they are from the rim.
    """
    right, down = abs(x), abs(y)
    away, around = max(np.sqrt(x * x + y * y), TINY), max(right + down, TINY)
    per_distance, per_direction = 0.5 * (DISTANCES - 1.0) / (reach * width), DIRECTIONS - 1.0
    p = min(max((away - radius) * per_distance + 0.5 * (DISTANCES - 1.0), 0.0), DISTANCES - 1.001)
    q = min(down / around * per_direction, DIRECTIONS - 1.001)
    column, row = int(p), int(q)
    p, q = p - column, q - row
    a, b = table[row, column], table[row, column + 1]
    c, d = table[row + 1, column], table[row + 1, column + 1]
    ka, kb, kc, kd = (1.0 - p) * (1.0 - q), p * (1.0 - q), (1.0 - p) * q, p * q
    share = ka * a[0] + kb * b[0] + kc * c[0] + kd * d[0]
    mean_x = ka * a[1] + kb * b[1] + kc * c[1] + kd * d[1]
    mean_y = ka * a[2] + kb * b[2] + kc * c[2] + kd * d[2]
    outwards = ((1.0 - q) * (b[0] - a[0]) + q * (d[0] - c[0])) * per_distance / away
    turning = ((1.0 - p) * (c[0] - a[0]) + p * (d[0] - b[0])) * per_direction / (around * around)
    sign_x, sign_y = 1.0 if x >= 0.0 else -1.0, 1.0 if y >= 0.0 else -1.0
    slope_x, slope_y = outwards * right - turning * down, outwards * down + turning * right
    return share, sign_x * mean_x, sign_y * mean_y, sign_x * slope_x, sign_y * slope_y
