"""The weights along one axis, integrated instead of counted.

Over a square aperture the two axes of Eq. 1 separate. Along one of them, a point x of a voxel and a crossing X of the
main lens give x_m = alpha X - x s_i/s_o on the array and, through lens n centred at s,

    x_s = s + (x_m - s)(1 - s_mu/f_m) + s_mu (x_m - X)/s_i

on the sensor. All are linear in (x, X), so the rays of a voxel that strike one pixel through one lens fill a convex
polygon of the rectangle voxel x aperture; its area is the weight (Eq. 13 with the count replaced by its limit). The
depth of the voxel is integrated by Gauss-Legendre nodes.

Axes: one image axis at a time (columns or rows), in mm about the optical axis; z as everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

# Along z the weights are smooth except where an edge of a lens or pixel passes; three nodes resolve voxels up to the
# depth in which a ray at the rim moves by a third of a lens.
DEPTH_NODES = 3
# A pixel that gets less than this share of a voxel's light is left out: below float32 rounding of the column's sum.
SMALLEST_SHARE = 1e-7


@dataclass(frozen=True)
class AxisOptics:
    """One axis of the camera.

    Attributes
    ----------
    image_distance_mm, microlens_distance_mm, microlens_focal_length_mm : s_i, s_mu, f_m
    aperture_radius_mm : half the side of the square aperture
    lens_origin_mm, lens_pitch_mm : a lens centre on the array and the pitch along this axis
    pixel_mm, pixels : pixel pitch and count
    """

    image_distance_mm: float
    microlens_distance_mm: float
    microlens_focal_length_mm: float
    aperture_radius_mm: float
    lens_origin_mm: float
    lens_pitch_mm: float
    pixel_mm: float
    pixels: int


@dataclass(frozen=True, eq=False)
class AxisWeights:
    """Per-axis weights in compressed rows; row `z * voxels + k` holds the pixels of voxel k in plane z.

    Attributes
    ----------
    planes, voxels, pixels : sizes
    start : (planes * voxels + 1,) int64
    pixel : int32, ascending within a row
    share : float32, the share of the voxel's light through the square aperture that falls on the pixel
    """

    planes: int
    voxels: int
    pixels: int
    start: NDArray[np.int64]
    pixel: NDArray[np.int32]
    share: NDArray[np.float32]

    def row(self, plane: int, voxel: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the pixels of one voxel and their shares."""
        part = slice(*self.start[plane * self.voxels + voxel : plane * self.voxels + voxel + 2])
        return self.pixel[part], self.share[part]

    def matrix(self, plane: int) -> NDArray[np.float32]:
        """Return the dense (pixels, voxels) matrix of one plane."""
        dense = np.zeros((self.pixels, self.voxels), np.float32)
        for voxel in range(self.voxels):
            pixel, share = self.row(plane, voxel)
            dense[pixel, voxel] = share
        return dense


def axis_weights(
    optics: AxisOptics,
    centres_mm: NDArray[np.float64],
    width_mm: float,
    spread: NDArray[np.float64],
    scale: NDArray[np.float64],
) -> AxisWeights:
    """Integrate the weights of all voxels along one axis.

    Parameters
    ----------
    centres_mm : (n,) voxel centres along the axis
    width_mm : their width
    spread, scale : (planes, nodes) alpha and s_i/s_o at the depth nodes of each plane
    """
    planes, nodes = spread.shape
    node_share = np.polynomial.legendre.leggauss(nodes)[1] / 2.0
    camera = np.array(
        [
            optics.image_distance_mm,
            optics.microlens_distance_mm,
            optics.microlens_focal_length_mm,
            optics.aperture_radius_mm,
            optics.lens_origin_mm,
            optics.lens_pitch_mm,
            optics.pixel_mm,
        ]
    )
    scene = (camera, optics.pixels, centres_mm, width_mm, spread, scale, node_share)
    counts = np.zeros(planes * centres_mm.size, np.int64)
    _integrate(*scene, np.zeros(0, np.int64), counts, np.zeros(0, np.int32), np.zeros(0, np.float32))
    start = np.concatenate([[0], np.cumsum(counts)])
    pixel, share = np.empty(start[-1], np.int32), np.empty(start[-1], np.float32)
    _integrate(*scene, start, counts, pixel, share)
    return AxisWeights(planes, centres_mm.size, optics.pixels, start, pixel, share)


def depth_nodes(z_mm: NDArray[np.float64], depth_mm: float) -> NDArray[np.float64]:
    """Return the depths (planes, nodes) at which voxels of `depth_mm` are integrated along z (Gauss-Legendre)."""
    nodes, _ = np.polynomial.legendre.leggauss(DEPTH_NODES)
    return z_mm[:, np.newaxis] + 0.5 * depth_mm * nodes


@njit(cache=True)
def _clip(
    polygon: NDArray[np.float64], corners: int, a: float, b: float, limit: float, out: NDArray[np.float64]
) -> int:
    """Cut a convex polygon of (x, X) corners to a x + b X <= limit; return the number of corners left."""
    kept = 0
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
def _area(polygon: NDArray[np.float64], corners: int) -> float:
    """Return the area of a convex polygon."""
    twice = 0.0
    for k in range(1, corners - 1):
        ax, ay = polygon[k, 0] - polygon[0, 0], polygon[k, 1] - polygon[0, 1]
        bx, by = polygon[k + 1, 0] - polygon[0, 0], polygon[k + 1, 1] - polygon[0, 1]
        twice += ax * by - ay * bx
    return 0.5 * abs(twice)


@njit(cache=True)
def _add_lens(
    polygon: NDArray[np.float64],
    corners: int,
    a: float,
    b: float,
    offset: float,
    pixel_mm: float,
    pixels: int,
    scale: float,
    scratch: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> tuple[int, int]:
    """Spread the polygon's area over the pixels that a x + b X + offset falls on; return the range touched."""
    lowest, highest = np.inf, -np.inf
    for k in range(corners):
        at = a * polygon[k, 0] + b * polygon[k, 1] + offset
        lowest, highest = min(lowest, at), max(highest, at)
    half = 0.5 * pixels
    first = max(int(np.floor(lowest / pixel_mm + half)), 0)
    last = min(int(np.floor(highest / pixel_mm + half)), pixels - 1)
    below = 0.0
    if first <= last:
        edge = (first - half) * pixel_mm
        below = _area(scratch, _clip(polygon, corners, a, b, edge - offset, scratch)) if lowest < edge else 0.0
    for pixel in range(first, last + 1):
        edge = (pixel + 1 - half) * pixel_mm
        upto = _area(scratch, _clip(polygon, corners, a, b, edge - offset, scratch))
        shares[pixel] += scale * (upto - below)
        below = upto
    return first, last


@njit(cache=True)
def _voxel_shares(
    camera: NDArray[np.float64],
    pixels: int,
    centre: float,
    width: float,
    spread: NDArray[np.float64],
    scale: NDArray[np.float64],
    node_share: NDArray[np.float64],
    work: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> tuple[int, int]:
    """Add one voxel's shares to `shares` (pixels,); return the first and last pixel touched."""
    s_i, s_mu, f_m, radius, lens_origin, lens_pitch, pixel_mm = camera
    rectangle, upper, lens, scratch = work
    for k, (x, y) in enumerate(((-0.5, -1.0), (0.5, -1.0), (0.5, 1.0), (-0.5, 1.0))):
        rectangle[k, 0] = centre + x * width
        rectangle[k, 1] = y * radius
    bend = 1.0 - s_mu / f_m
    begin, end = pixels, -1
    for node in range(spread.size):
        alpha, beta = spread[node], -scale[node]
        middle, reach = beta * centre, abs(alpha) * radius + abs(beta) * 0.5 * width
        first = int(np.floor((middle - reach - lens_origin) / lens_pitch + 0.5))
        last = int(np.floor((middle + reach - lens_origin) / lens_pitch + 0.5))
        a = beta * bend + s_mu * beta / s_i
        b = alpha * bend + s_mu * (alpha - 1.0) / s_i
        for n in range(first, last + 1):
            s = lens_origin + n * lens_pitch
            corners = _clip(rectangle, 4, beta, alpha, s + 0.5 * lens_pitch, upper)
            corners = _clip(upper, corners, -beta, -alpha, -(s - 0.5 * lens_pitch), lens)
            if corners < 3:
                continue
            share = node_share[node] / (2.0 * radius * width)
            low, high = _add_lens(lens, corners, a, b, s * (1.0 - bend), pixel_mm, pixels, share, scratch, shares)
            begin, end = min(begin, low), max(end, high)
    return begin, end


@njit(cache=True, parallel=True)
def _integrate(
    camera: NDArray[np.float64],
    pixels: int,
    centres: NDArray[np.float64],
    width: float,
    spread: NDArray[np.float64],
    scale: NDArray[np.float64],
    node_share: NDArray[np.float64],
    start: NDArray[np.int64],
    counts: NDArray[np.int64],
    pixel: NDArray[np.int32],
    share: NDArray[np.float32],
) -> None:
    """Fill `counts` (when `start` is empty) or `pixel` and `share`, one plane after the other."""
    for plane in prange(spread.shape[0]):
        shares = np.zeros(pixels)
        work = np.empty((4, 12, 2))
        for k in range(centres.size):
            begin, end = _voxel_shares(
                camera, pixels, centres[k], width, spread[plane], scale[plane], node_share, work, shares
            )
            row = plane * centres.size + k
            found = 0
            for at in range(begin, end + 1):
                if shares[at] > SMALLEST_SHARE:
                    if start.size:
                        pixel[start[row] + found] = at
                        share[start[row] + found] = shares[at]
                    found += 1
                shares[at] = 0.0
            counts[row] = found
