"""The weights along one axis, integrated instead of counted.

Over a square aperture the two axes of Eq. 1 separate. Along one of them, a point x of a voxel and a crossing X of the
main lens give x_m = alpha X - x s_i/s_o on the array and, through lens n centred at s,

    x_s = s + (x_m - s)(1 - s_mu/f_m) + s_mu (x_m - X)/s_i

on the sensor. All are linear in (x, X), so the rays of a voxel that strike one pixel through one lens fill a convex
polygon of the rectangle voxel x aperture; its area is the weight (Eq. 13 with the count replaced by its limit). The
depth of the voxel is integrated by Gauss-Legendre nodes.

The weights are kept by cell (`axis_cells`); pixels add up their cells.

Axes: one image axis at a time (columns or rows), in mm about the optical axis; z as everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.optics.object_space import slope_ratio
from lfpiv_cli.weights.axis_cells import AxisOptics, Cells, micro_image_cells

# Along z the weights are smooth except where an edge of a lens or pixel passes; three nodes resolve voxels up to the
# depth in which a ray at the rim moves by a third of a lens.
DEPTH_NODES = 3
# A cell that gets less than this share of a voxel's light is left out: below float32 rounding of the column's sum.
SMALLEST_SHARE = 1e-7


@dataclass(frozen=True, eq=False)
class Bending:
    """How rays from the planes of a volume are bent on their way to the array, along one axis.

    Attributes
    ----------
    nodes, factors : (planes, depth nodes, k) of `object_space.slope_ratio` at the depth nodes of each plane
    focal_length_mm : F_m
    beside_mm2 : mean square of the voxels' distance from the optical axis along the other axis
    strips : straight pieces in which the aperture is worked on; 1 where rays are straight in front of the lens
    """

    nodes: NDArray[np.float64]
    factors: NDArray[np.float64]
    focal_length_mm: float
    beside_mm2: float = 0.0
    strips: int = 1


@dataclass(frozen=True, eq=False)
class FittedBending:
    """How rays from the planes of a volume meet the array, along one axis, as polynomials.

    Attributes
    ----------
    coefficients_mm : (planes, depth nodes, degree + 1, degree + 1) of the place on the array by the powers of x and X
    scale_mm : (2,) what x and X are divided by
    strips : straight pieces in which the aperture is worked on
    """

    coefficients_mm: NDArray[np.float64]
    scale_mm: NDArray[np.float64]
    strips: int


@dataclass(frozen=True, eq=False)
class AxisWeights:
    """Per-axis weights in compressed rows; row `z * voxels + k` holds the cells of voxel k in plane z.

    Attributes
    ----------
    planes, voxels, pixels : sizes
    cells : the cells of the axis
    start : (planes * voxels + 1,) int64
    cell : int32, ascending within a row
    share : float32, the share of the voxel's light through the square aperture that falls on the cell
    """

    planes: int
    voxels: int
    pixels: int
    cells: Cells
    start: NDArray[np.int64]
    cell: NDArray[np.int32]
    share: NDArray[np.float32]

    def row(self, plane: int, voxel: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the cells of one voxel and their shares."""
        part = slice(*self.start[plane * self.voxels + voxel : plane * self.voxels + voxel + 2])
        return self.cell[part], self.share[part]

    def matrix(self, plane: int) -> NDArray[np.float32]:
        """Return the dense (cells, voxels) matrix of one plane."""
        dense = np.zeros((self.cells.pixel.size, self.voxels), np.float32)
        for voxel in range(self.voxels):
            cell, share = self.row(plane, voxel)
            dense[cell, voxel] = share
        return dense


def axis_weights(
    optics: AxisOptics, centres_mm: NDArray[np.float64], width_mm: float, bending: Bending | FittedBending
) -> AxisWeights:
    """Integrate the weights of all voxels along one axis.

    Parameters
    ----------
    centres_mm : (n,) voxel centres along the axis
    width_mm : their width
    bending : of the rays in front of the array
    """
    if isinstance(bending, FittedBending):
        fitted, scale = bending.coefficients_mm, bending.scale_mm
        slopes = np.zeros((*fitted.shape[:2], 1))
        traced = Bending(slopes, slopes, 1.0)
    else:
        fitted, scale, traced = np.zeros((*bending.nodes.shape[:2], 0, 0)), np.ones(2), bending
    planes, nodes = fitted.shape[:2]
    node_share = np.polynomial.legendre.leggauss(nodes)[1] / 2.0
    camera = np.array(
        [
            optics.image_distance_mm,
            optics.microlens_distance_mm,
            optics.microlens_focal_length_mm,
            optics.aperture_radius_mm,
            optics.lens_origin_mm,
            optics.lens_pitch_mm,
            optics.lens_width_mm,
            optics.pixel_mm,
            traced.focal_length_mm,
            traced.beside_mm2,
        ]
    )
    cells = micro_image_cells(optics)
    layout = (cells.first_lens, cells.start, cells.pixel)
    bent = (traced.nodes, traced.factors, fitted, scale, bending.strips)
    scene = (camera, optics.pixels, *layout, centres_mm, width_mm, *bent, node_share)
    counts = np.zeros(planes * centres_mm.size, np.int64)
    _integrate(*scene, np.zeros(0, np.int64), counts, np.zeros(0, np.int32), np.zeros(0, np.float32))
    start = np.concatenate([[0], np.cumsum(counts)])
    cell, share = np.empty(start[-1], np.int32), np.empty(start[-1], np.float32)
    _integrate(*scene, start, counts, cell, share)
    return AxisWeights(planes, centres_mm.size, optics.pixels, cells, start, cell, share)


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
    cell_pixel: NDArray[np.int32],
    scale: float,
    scratch: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> None:
    """Spread the polygon's area over the cells of its lens: the pixels that a x + b X + offset falls on."""
    edge = (cell_pixel[0] - 0.5 * pixels) * pixel_mm
    below = _area(scratch, _clip(polygon, corners, a, b, edge - offset, scratch))
    for k in range(cell_pixel.size):
        edge = (cell_pixel[k] + 1 - 0.5 * pixels) * pixel_mm
        upto = _area(scratch, _clip(polygon, corners, a, b, edge - offset, scratch))
        shares[k] += scale * (upto - below)
        below = upto


@njit(cache=True)
def _array_place(
    crossing: float,
    centre: float,
    camera: NDArray[np.float64],
    nodes: NDArray[np.float64],
    factors: NDArray[np.float64],
    fitted: NDArray[np.float64],
    scale: NDArray[np.float64],
) -> tuple[float, float]:
    """Return where on the array the ray from `centre` through X = `crossing` arrives, and how much -x moves that.

    Where rays are traced, the other axis enters by its mean square distance: of a disc's chord at X, a third of its
    half length squared, and of the voxels.
    """
    if fitted.shape[0] > 0:
        x, across = centre / scale[0], crossing / scale[1]
        place, slope = 0.0, 0.0
        for a in range(fitted.shape[0] - 1, -1, -1):
            part = 0.0
            for b in range(fitted.shape[1] - 1, -1, -1):
                part = part * across + fitted[a, b]
            slope = slope * x + place
            place = place * x + part
        return place, -slope / scale[0]
    s_i, radius, focal_length, beside = camera[0], camera[3], camera[8], camera[9]
    lateral = crossing - centre
    chord = max(radius * radius - crossing * crossing, 0.0) / 3.0
    ratio = slope_ratio(lateral * lateral + chord + beside, nodes, factors)
    return crossing + s_i * (ratio * lateral - crossing / focal_length), s_i * ratio


@njit(cache=True)
def _voxel_shares(
    camera: NDArray[np.float64],
    pixels: int,
    first_lens: int,
    cell_start: NDArray[np.int64],
    cell_pixel: NDArray[np.int32],
    centre: float,
    width: float,
    nodes: NDArray[np.float64],
    factors: NDArray[np.float64],
    fitted: NDArray[np.float64],
    scale: NDArray[np.float64],
    strips: int,
    node_share: NDArray[np.float64],
    work: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> tuple[int, int]:
    """Add one voxel's shares to `shares` (cells,); return the first cell touched and the one after the last.

    In each strip of X the ray's place on the array is linear, x_m = alpha X - scale x + offset, right at both ends.
    """
    s_i, s_mu, f_m, radius, lens_origin, lens_pitch, lens_width, pixel_mm = camera[:8]
    rectangle, upper, lens, scratch = work
    bend = 1.0 - s_mu / f_m
    begin, end = cell_pixel.size, 0
    side = 2.0 * radius / strips
    for task in range(node_share.size * strips):
        node, strip = task // strips, task % strips
        low, high = strip * side - radius, (strip + 1) * side - radius
        _set_rectangle(rectangle, centre - 0.5 * width, centre + 0.5 * width, low, high)
        place_low, scale_low = _array_place(low, centre, camera, nodes[node], factors[node], fitted[node], scale)
        place_high, scale_high = _array_place(high, centre, camera, nodes[node], factors[node], fitted[node], scale)
        alpha, beta = (place_high - place_low) / side, -0.5 * (scale_low + scale_high)
        offset = place_low - alpha * low - beta * centre
        reach = abs(beta) * 0.5 * width
        first = int(np.floor((min(place_low, place_high) - reach - lens_origin) / lens_pitch + 0.5))
        last = int(np.floor((max(place_low, place_high) + reach - lens_origin) / lens_pitch + 0.5))
        a = beta * bend + s_mu * beta / s_i
        b = alpha * bend + s_mu * (alpha - 1.0) / s_i
        for n in range(max(first, first_lens), min(last, first_lens + cell_start.size - 2) + 1):
            at, stop = cell_start[n - first_lens], cell_start[n - first_lens + 1]
            s = lens_origin + n * lens_pitch
            corners = _clip(rectangle, 4, beta, alpha, s + 0.5 * lens_width - offset, upper)
            corners = _clip(upper, corners, -beta, -alpha, -(s - 0.5 * lens_width - offset), lens)
            if corners < 3 or at == stop:
                continue
            share = node_share[node] / (2.0 * radius * width)
            seen, own = cell_pixel[at:stop], shares[at:stop]
            shift = s * (1.0 - bend) + offset * (bend + s_mu / s_i)
            _add_lens(lens, corners, a, b, shift, pixel_mm, pixels, seen, share, scratch, own)
            begin, end = min(begin, at), max(end, stop)
    return begin, end


@njit(cache=True)
def _set_rectangle(rectangle: NDArray[np.float64], left: float, right: float, low: float, high: float) -> None:
    """Set the corners (x, X) of a rectangle, in order."""
    for k, (x, y) in enumerate(((left, low), (right, low), (right, high), (left, high))):
        rectangle[k, 0] = x
        rectangle[k, 1] = y


@njit(cache=True, parallel=True)
def _integrate(
    camera: NDArray[np.float64],
    pixels: int,
    first_lens: int,
    cell_start: NDArray[np.int64],
    cell_pixel: NDArray[np.int32],
    centres: NDArray[np.float64],
    width: float,
    nodes: NDArray[np.float64],
    factors: NDArray[np.float64],
    fitted: NDArray[np.float64],
    scale: NDArray[np.float64],
    strips: int,
    node_share: NDArray[np.float64],
    start: NDArray[np.int64],
    counts: NDArray[np.int64],
    cell: NDArray[np.int32],
    share: NDArray[np.float32],
) -> None:
    """Fill `counts` (when `start` is empty) or `cell` and `share`, one plane after the other."""
    for plane in prange(fitted.shape[0]):
        shares = np.zeros(cell_pixel.size)
        work = np.empty((4, 12, 2))
        layout = (first_lens, cell_start, cell_pixel)
        for k in range(centres.size):
            slopes = (nodes[plane], factors[plane], fitted[plane], scale, strips)
            scene = (centres[k], width, *slopes, node_share, work, shares)
            begin, end = _voxel_shares(camera, pixels, *layout, *scene)
            row = plane * centres.size + k
            found = 0
            for at in range(begin, end):
                if shares[at] > SMALLEST_SHARE:
                    if start.size:
                        cell[start[row] + found] = at
                        share[start[row] + found] = shares[at]
                    found += 1
                shares[at] = 0.0
            counts[row] = found
