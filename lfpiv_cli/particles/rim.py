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

# The share is linear between entries: at sixteen entries per patch it is right to 1e-3 on the rim.
ENTRIES_PER_PATCH = 16
# Strips per patch for the first moments: their own width adds 1/12 of (2/8)^2, half a per cent of a moment.
STRIPS = 8


def rim_table(radius_mm: float, patch_mm: float) -> tuple[NDArray[np.float64], float]:
    """Return C, mean of xi and mean of eta over covered points of a patch, for patches centred in the first quadrant.

    Returns
    -------
    table : (n, n, 3), index [|Y|, |X|] in steps of the second value; the means are per whole patch, not per covered
        part
    step_mm : distance of entries
    """
    step = patch_mm / ENTRIES_PER_PATCH
    count = int(np.ceil((radius_mm + patch_mm) / step)) + 2
    return _table(count, step, radius_mm, patch_mm), step


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
def _table(count: int, step: float, radius: float, patch: float) -> NDArray[np.float64]:
    table = np.zeros((count, count, 3))
    half, strip = 0.5 * patch, patch / STRIPS
    for row in range(count):
        for column in range(row + 1):
            low_x, low_y = column * step - half, row * step - half
            for k in range(STRIPS):
                middle = (2.0 * k + 1.0) / STRIPS - 1.0
                upright = _covered(low_x + k * strip, low_x + (k + 1) * strip, low_y, low_y + patch, radius)
                level = _covered(low_x, low_x + patch, low_y + k * strip, low_y + (k + 1) * strip, radius)
                table[row, column, 0] += upright / patch**2
                table[row, column, 1] += middle * upright / patch**2
                table[row, column, 2] += middle * level / patch**2
            table[column, row, 0] = table[row, column, 0]
            table[column, row, 1] = table[row, column, 2]
            table[column, row, 2] = table[row, column, 1]
    return table


@njit(cache=True, **COUNT_NO_REFERENCES)
def covered_share(
    x: float, y: float, width: float, radius: float, table: NDArray[np.float64], step: float
) -> tuple[float, float, float, float, float]:
    """Return C, the means of xi and eta, and the slopes of C along X and Y (per mm) of the patch centred at (x, y).

    Patches are a few per cent wider or narrower than the table's, by the particle's depth: what counts is how many of
    their widths they are from the rim.
    """
    per_width = ENTRIES_PER_PATCH * step / width
    away = np.sqrt(x * x + y * y)
    place = (radius + (away - radius) * per_width) / (away * step) if away > 0.0 else 0.0
    sign_x = 1.0 if x >= 0.0 else -1.0
    sign_y = 1.0 if y >= 0.0 else -1.0
    at_x, at_y = abs(x) * place, abs(y) * place
    column, row = int(at_x), int(at_y)
    if column >= table.shape[1] - 1 or row >= table.shape[0] - 1:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    p, q = at_x - column, at_y - row
    a, b = table[row, column], table[row, column + 1]
    c, d = table[row + 1, column], table[row + 1, column + 1]
    ka, kb, kc, kd = (1.0 - p) * (1.0 - q), p * (1.0 - q), (1.0 - p) * q, p * q
    share = ka * a[0] + kb * b[0] + kc * c[0] + kd * d[0]
    mean_x = sign_x * (ka * a[1] + kb * b[1] + kc * c[1] + kd * d[1])
    mean_y = sign_y * (ka * a[2] + kb * b[2] + kc * c[2] + kd * d[2])
    slope_x = sign_x * ((1.0 - q) * (b[0] - a[0]) + q * (d[0] - c[0])) * per_width / step
    slope_y = sign_y * ((1.0 - p) * (c[0] - a[0]) + p * (d[0] - b[0])) * per_width / step
    return share, mean_x, mean_y, slope_x, slope_y
