"""Convex polygons as corners in order (n, 2), in kernels: cut by half planes, and their areas."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def cut(polygon: NDArray[np.float64], a: float, b: float, limit: float, out: NDArray[np.float64]) -> int:
    """Write the part of a polygon where a x + b y <= limit to `out`; return its number of corners."""
    kept, corners = 0, len(polygon)
    for k in range(corners):
        x0, y0 = polygon[k, 0], polygon[k, 1]
        after = k + 1 if k + 1 < corners else 0
        x1, y1 = polygon[after, 0], polygon[after, 1]
        over0 = a * x0 + b * y0 - limit
        over1 = a * x1 + b * y1 - limit
        if over0 <= 0.0:
            out[kept, 0] = x0
            out[kept, 1] = y0
            kept += 1
        if (over0 < 0.0 < over1) or (over1 < 0.0 < over0):
            t = over0 / (over0 - over1)
            out[kept, 0] = x0 + t * (x1 - x0)
            out[kept, 1] = y0 + t * (y1 - y0)
            kept += 1
    return kept


@njit(cache=True)
def set_rectangle(out: NDArray[np.float64], left: float, right: float, bottom: float, top: float) -> None:
    """Write the four corners of a rectangle to `out`."""
    for k, (x, y) in enumerate(((left, bottom), (right, bottom), (right, top), (left, top))):
        out[k, 0] = x
        out[k, 1] = y


@njit(cache=True)
def polygon_area(polygon: NDArray[np.float64]) -> float:
    """Return the area of a polygon."""
    twice = 0.0
    for k in range(1, len(polygon) - 1):
        ax, ay = polygon[k, 0] - polygon[0, 0], polygon[k, 1] - polygon[0, 1]
        bx, by = polygon[k + 1, 0] - polygon[0, 0], polygon[k + 1, 1] - polygon[0, 1]
        twice += ax * by - ay * bx
    return 0.5 * abs(twice)


@njit(cache=True)
def polygon_moments(
    polygon: NDArray[np.float64], offset_x: float, offset_y: float
) -> tuple[float, float, float, float, float]:
    """Return area, centroid (moved by the offset) and widths of a polygon."""
    twice, sum_x, sum_y = 0.0, 0.0, 0.0
    x0, y0 = polygon[0, 0], polygon[0, 1]
    left, right, bottom, top = x0, x0, y0, y0
    for k in range(1, len(polygon)):
        x1, y1 = polygon[k, 0], polygon[k, 1]
        left, right, bottom, top = min(left, x1), max(right, x1), min(bottom, y1), max(top, y1)
        if k + 1 < len(polygon):
            x2, y2 = polygon[k + 1, 0], polygon[k + 1, 1]
            area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
            twice += area
            sum_x += area * (x0 + x1 + x2) / 3.0
            sum_y += area * (y0 + y1 + y2) / 3.0
    if twice <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return 0.5 * twice, sum_x / twice + offset_x, sum_y / twice + offset_y, right - left, top - bottom
