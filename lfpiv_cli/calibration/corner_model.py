"""What a corner of a chessboard looks like on the sensor, and the corner that explains given pixels best.

A pixel's light is the share of the polygon that its microlens is, seen in the scene (see `dot_model`), that lies in two
opposite quadrants about the corner, exactly. With sgn u sgn v the quadrants' sign, the integral of it over a polygon is
that of |u| sgn v dv along its edges (Green's theorem), which is summed over the parts of an edge in one quadrant.

Axes: image axes (x along the columns, y along the rows), mm, z away from the camera from the focal plane; (u, v) along
the edges that meet in the corner.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.calibration.dot_model import (
    BLURRED_SAMPLES,
    SHARP_SHARE,
    PixelRays,
    fit_steps,
    scene_points,
    scene_shares,
)
from lfpiv_cli.calibration.near_pixels import NearPixels
from lfpiv_cli.calibration.shape_fit import ShapeFit, SharesAndSlopes, fit_shape
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media

# Steps of the fit are measured in this share of a square.
STEP_SHARE = 0.25


def fit_corner(
    pixels: NearPixels,
    start_mm: NDArray[np.float64],
    edges_mm: NDArray[np.float64],
    camera: Camera,
    media: Media,
) -> ShapeFit:
    """Fit a corner to pixels by least squares: x, y, z, brightness and a sloping background are free.

    Parameters
    ----------
    start_mm : (3,) first guess, in image axes, within about half a microlens
    edges_mm : (2, 2) rows: the squares' sides that meet in the corner, x and y
    """
    size = step_mm(edges_mm)

    def shares_at(position: NDArray[np.float64]) -> SharesAndSlopes:
        return corner_shares(pixels.rays, position, edges_mm, camera, media)

    beside = scene_points(pixels.rays, camera, media, float(start_mm[2])) - start_mm[:2]
    return fit_shape(pixels.signal, pixels.passed, beside, start_mm, fit_steps(size, camera, media), shares_at)


def step_mm(edges_mm: NDArray[np.float64]) -> float:
    """Return in what steps a fit moves a corner, by the squares' sides (2, 2)."""
    return STEP_SHARE * float(np.hypot(edges_mm[:, 0], edges_mm[:, 1]).mean())


def corner_shares(
    rays: PixelRays, position_mm: NDArray[np.float64], edges_mm: NDArray[np.float64], camera: Camera, media: Media
) -> SharesAndSlopes:
    """Return for each pixel the share (n,) of what it sees at depth z in two opposite quadrants, and its slopes.

    `position_mm` is (x, y, z) in image axes; the slopes (n, 3) are the share's derivatives by it, per mm.
    """
    to_edges = np.linalg.inv(edges_mm)
    sharp = SHARP_SHARE * 0.5 * float(np.hypot(edges_mm[:, 0], edges_mm[:, 1]).min())

    def covered(middle: NDArray[np.float64], cell: NDArray[np.float64], width: float) -> SharesAndSlopes:
        return quadrant_shares(middle, cell, to_edges, width, 1 if width < sharp else BLURRED_SAMPLES)

    return scene_shares(rays, position_mm, camera, media, covered)


@njit(cache=True)
def quadrant_shares(
    middle: NDArray[np.float64], cell: NDArray[np.float64], to_edges: NDArray[np.float64], width: float, samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean share of `cell`, moved to `middle` and over a square of `width` around it, where u v > 0.

    The slopes (n, 4) are its derivatives by the middle's x and y, the logarithm of the cell's size, and the width.
    """
    edged = cell @ to_edges
    shares, slopes = np.zeros(middle.shape[0]), np.zeros((middle.shape[0], 4))
    sums = np.empty(5)
    weight = 0.5 / (samples * samples)
    for n in range(middle.shape[0]):
        for a in range(samples):
            for b in range(samples):
                off_x, off_y = (a + 0.5) / samples - 0.5, (b + 0.5) / samples - 0.5
                x, y = middle[n, 0] + width * off_x, middle[n, 1] + width * off_y
                u = x * to_edges[0, 0] + y * to_edges[1, 0]
                v = x * to_edges[0, 1] + y * to_edges[1, 1]
                quadrant_sums(u, v, edged, sums)
                mean, by_u, by_v = sums[0] / sums[4], weight * sums[1] / sums[4], weight * sums[2] / sums[4]
                by_x = by_u * to_edges[0, 0] + by_v * to_edges[0, 1]
                by_y = by_u * to_edges[1, 0] + by_v * to_edges[1, 1]
                shares[n] += weight * (1.0 + mean)
                slopes[n, 0] += by_x
                slopes[n, 1] += by_y
                slopes[n, 2] += weight * (sums[3] / sums[4] - 2.0 * mean)
                slopes[n, 3] += by_x * off_x + by_y * off_y
    return shares, slopes


@njit(cache=True)
def quadrant_sums(u: float, v: float, cell: NDArray[np.float64], sums: NDArray[np.float64]) -> None:
    """Write the integral of sgn u sgn v over a polygon `cell` moved to (u, v), its slopes, and the polygon's area.

    The slopes are by u, by v and by the logarithm of the cell's size: every part of an edge sweeps an area.
    """
    sums[:] = 0.0
    cuts = np.empty(4)
    for k in range(cell.shape[0]):
        following = (k + 1) % cell.shape[0]
        u_0, v_0 = u + cell[k, 0], v + cell[k, 1]
        du, dv = cell[following, 0] - cell[k, 0], cell[following, 1] - cell[k, 1]
        cuts[0], cuts[3] = 0.0, 1.0
        first = min(max(-u_0 / du, 0.0), 1.0) if du != 0.0 else 0.0
        second = min(max(-v_0 / dv, 0.0), 1.0) if dv != 0.0 else 0.0
        cuts[1], cuts[2] = min(first, second), max(first, second)
        sums[4] += 0.5 * (u_0 * dv - v_0 * du)
        swept = cell[k, 0] * dv - cell[k, 1] * du
        for part in range(3):
            length = cuts[part + 1] - cuts[part]
            half_way = 0.5 * (cuts[part] + cuts[part + 1])
            at_u, at_v = u_0 + half_way * du, v_0 + half_way * dv
            sign = length if at_u * at_v > 0.0 else -length
            sums[0] += sign * at_u * dv
            sums[1] += sign * dv
            sums[2] -= sign * du
            sums[3] += sign * swept
