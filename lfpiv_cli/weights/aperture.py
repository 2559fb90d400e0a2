"""The round aperture seen through the pixels.

Every cell (a pixel under a microlens) sees its own patch of the main lens, pixel * s_i/s_mu wide. Where a patch
straddles the rim of the aperture, the cell gets only the share of it that lies inside; divided by the disc's share of
its square (pi/4), these shares turn the weights of the square aperture into those of the disc.

Axes: patches are intervals of X (columns) and Y (rows) on the main lens, in mm about the axis.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.axis_cells import Cells

DISC_SHARE_OF_SQUARE = np.pi / 4.0


def aperture_mask(columns: Cells, rows: Cells, radius_mm: float) -> NDArray[np.float32]:
    """Return C (row cells, column cells): the share of each cell's patch inside the disc, over the square's share."""
    mask = np.empty((len(rows.patch_mm), len(columns.patch_mm)), np.float32)
    share_out(_write_mask, len(mask), columns.patch_mm, rows.patch_mm, radius_mm, mask)
    return mask


@njit(cache=True)
def _chord_integral(a: float, b: float, radius: float) -> float:
    """Return the integral of sqrt(R^2 - x^2) from a to b, both clipped to the disc."""
    a = min(max(a, -radius), radius)
    b = min(max(b, -radius), radius)
    upper = b * np.sqrt(radius * radius - b * b) + radius * radius * np.arcsin(b / radius)
    lower = a * np.sqrt(radius * radius - a * a) + radius * radius * np.arcsin(a / radius)
    return 0.5 * (upper - lower)


@njit(cache=True)
def disc_area_below(x: float, y: float, radius: float) -> float:
    """Return the area of the part of a disc about 0 that lies at X <= x and Y <= y."""
    if x <= -radius or y <= -radius:
        return 0.0
    x = min(x, radius)
    if y >= radius:
        return 2.0 * _chord_integral(-radius, x, radius)
    flat = np.sqrt(radius * radius - y * y)
    inner = min(x, flat)
    area = 0.0
    if inner > -flat:
        area += _chord_integral(-flat, inner, radius) + y * (inner + flat)
    if y > 0.0:
        area += 2.0 * _chord_integral(-radius, min(x, -flat), radius)
        if x > flat:
            area += 2.0 * _chord_integral(flat, x, radius)
    return area


@njit(cache=True, nogil=True)
def _write_mask(
    part: tuple[int, int],
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    radius: float,
    mask: NDArray[np.float32],
) -> None:
    """Write rows `part` of `aperture_mask`, from the patches (n, 2) of columns and rows."""
    for r in range(part[0], part[1]):
        y0, y1 = rows[r]
        for c in range(columns.shape[0]):
            x0, x1 = columns[c]
            inside = (
                disc_area_below(x1, y1, radius)
                - disc_area_below(x0, y1, radius)
                - disc_area_below(x1, y0, radius)
                + disc_area_below(x0, y0, radius)
            )
            mask[r, c] = max(inside, 0.0) / ((x1 - x0) * (y1 - y0)) / DISC_SHARE_OF_SQUARE
