"""The weights along one axis, integrated instead of counted.

Over a square aperture the two axes of Eq. 1 separate. Along one of them, a point x of a voxel and a crossing X of the
main lens give x_m = alpha X - x s_i/s_o on the array and, through lens n centred at s,

    x_s = s + (x_m - s)(1 - s_mu/f_m) + s_mu (x_m - X)/s_i

on the sensor. All are linear in (x, X), so the rays of a voxel that strike one pixel through one lens fill a convex
polygon of the rectangle voxel x aperture; its area is the weight (Eq. 13 with the count replaced by its limit). The
depth of the voxel is integrated by Gauss-Legendre nodes.

The weights are kept by cell (`lens_cells`); pixels add up their cells.

Axes: one image axis at a time (columns or rows), in mm about the optical axis; z as everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Integers, Singles
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.tracing import slope_ratio
from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.lens_cells import AxisOptics, Cells, cut, micro_image_cells, polygon_area, set_rectangle

# Along z the weights are smooth except where an edge of a lens or pixel passes; three nodes resolve voxels up to the
# depth in which a ray at the rim moves by a third of a lens.
DEPTH_NODES = 3
# A cell that gets less than this share of a voxel's light is left out: below float32 rounding of the column's sum.
SMALLEST_SHARE = 1e-7
# A rectangle cut by three half planes has at most seven corners; where rounding bends an edge, a few more.
MOST_CORNERS = 12


class Bending(NamedTuple):
    """How rays from the planes of a volume are bent on their way to the array, along one axis: traced, or fitted.

    Attributes
    ----------
    strips : straight pieces in which the aperture is worked on; 1 where rays are straight in front of the lens
    nodes, factors : (planes, depth nodes, k) of `tracing.slope_ratio` at the depth nodes of each plane where traced
    beside_mm2 : mean square of the voxels' distance from the optical axis along the other axis where traced
    coefficients_mm : (planes, depth nodes, degree + 1, degree + 1) of the place on the array by the powers of x and X
        where fitted; without powers where traced
    scale_mm : (2,) what x and X are divided by
    """

    strips: int
    nodes: Floats
    factors: Floats
    beside_mm2: float
    coefficients_mm: Floats
    scale_mm: Floats

    @classmethod
    def traced(cls, nodes: Floats, factors: Floats, beside_mm2: float, strips: int) -> Bending:
        """Return how traced rays are bent."""
        return cls(strips, nodes, factors, beside_mm2, np.zeros((*nodes.shape[:2], 0, 0)), np.ones(2))

    @classmethod
    def fitted(cls, coefficients_mm: Floats, scale_mm: Floats, strips: int) -> Bending:
        """Return how fitted rays are bent."""
        none = np.zeros((*coefficients_mm.shape[:2], 1))
        return cls(strips, none, none, 0.0, coefficients_mm, scale_mm)


class AxisScene(NamedTuple):
    """Voxels, rays and cells of one axis as the kernels take them.

    Attributes
    ----------
    optics, cells : of the axis
    centres_mm, width_mm : (n,) of the voxels along the axis
    node_share : (nodes,) share of a voxel's light from each depth node
    bending : of the rays
    """

    optics: AxisOptics
    cells: Cells
    centres_mm: Floats
    width_mm: float
    node_share: Floats
    bending: Bending


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
    start: Integers
    cell: NDArray[np.int32]
    share: Singles

    def row(self, plane: int, voxel: int) -> tuple[NDArray[np.int32], Singles]:
        """Return the cells of one voxel and their shares."""
        part = slice(*self.start[plane * self.voxels + voxel : plane * self.voxels + voxel + 2])
        return self.cell[part], self.share[part]

    def part(self, voxels: slice) -> AxisWeights:
        """Return the weights of some of the voxels, in all planes."""
        row = np.arange(self.planes * self.voxels).reshape(self.planes, self.voxels)[:, voxels].ravel()
        counts = self.start[row + 1] - self.start[row]
        start = np.concatenate([[0], np.cumsum(counts)])
        taken = np.arange(start[-1]) + np.repeat(self.start[row] - start[:-1], counts)
        return replace(
            self, voxels=row.size // self.planes, start=start, cell=self.cell[taken], share=self.share[taken]
        )

    def matrix(self, plane: int) -> Singles:
        """Return the dense (cells, voxels) matrix of one plane."""
        dense = np.zeros((self.cells.pixel.size, self.voxels), np.float32)
        for voxel in range(self.voxels):
            cell, share = self.row(plane, voxel)
            dense[cell, voxel] = share
        return dense


def axis_weights(optics: AxisOptics, centres_mm: Floats, width_mm: float, bending: Bending) -> AxisWeights:
    """Integrate the weights of all voxels along one axis.

    Parameters
    ----------
    centres_mm : (n,) voxel centres along the axis
    width_mm : their width
    bending : of the rays in front of the array
    """
    planes, nodes = bending.nodes.shape[:2]
    cells = micro_image_cells(optics)
    node_share = np.polynomial.legendre.leggauss(nodes)[1] / 2.0
    scene = AxisScene(optics, cells, centres_mm, width_mm, node_share, bending)
    counts = np.zeros(planes * centres_mm.size, np.int64)
    nothing = (np.zeros(0, np.int64), counts, np.zeros(0, np.int32), np.zeros(0, np.float32))
    share_out(_integrate, planes, scene, *nothing)
    start = np.concatenate([[0], np.cumsum(counts)])
    cell, share = np.empty(start[-1], np.int32), np.empty(start[-1], np.float32)
    share_out(_integrate, planes, scene, start, counts, cell, share)
    return AxisWeights(planes, centres_mm.size, optics.pixels, cells, start, cell, share)


def depth_nodes(z_mm: Floats, depth_mm: float) -> Floats:
    """Return the depths (planes, nodes) at which voxels of `depth_mm` are integrated along z (Gauss-Legendre)."""
    nodes, _ = np.polynomial.legendre.leggauss(DEPTH_NODES)
    return z_mm[:, np.newaxis] + 0.5 * depth_mm * nodes


@njit(cache=True, nogil=True)
def _integrate(
    part: tuple[int, int],
    scene: AxisScene,
    start_of_row: Integers,
    counts: Integers,
    cell: NDArray[np.int32],
    share_of_cell: Singles,
) -> None:
    """Fill `counts` (when `start_of_row` is empty) or also `cell` and its share, one plane of `part` after the other.

    All are those of `AxisWeights`.
    """
    voxels = scene.centres_mm.size
    optics, camera, width = scene.optics, scene.optics.camera, scene.width_mm
    cells, bending = scene.cells, scene.bending
    s_i, s_mu = camera.image_distance_mm, camera.microlens_distance_mm
    bend, radius = camera.bend, camera.aperture_radius_mm
    side = 2.0 * radius / bending.strips
    shares = np.zeros(cells.pixel.size)
    work = np.empty((4, MOST_CORNERS, 2))
    rectangle, upper, lens, scratch = work[0], work[1], work[2], work[3]
    for row in range(part[0] * voxels, part[1] * voxels):
        plane, centre = row // voxels, scene.centres_mm[row % voxels]
        # The first cell touched and the one behind the last.
        begin, end = cells.pixel.size, 0
        for task in range(scene.node_share.size * bending.strips):
            # In each strip of X the ray's place on the array is linear, x_m = alpha X - scale x + offset, right at both
            # ends.
            node, strip = task // bending.strips, task % bending.strips
            low, high = strip * side - radius, (strip + 1) * side - radius
            set_rectangle(rectangle, centre - 0.5 * width, centre + 0.5 * width, low, high)
            place_low, scale_low = _array_place(scene, plane, node, centre, low)
            place_high, scale_high = _array_place(scene, plane, node, centre, high)
            alpha, beta = (place_high - place_low) / side, -0.5 * (scale_low + scale_high)
            offset = place_low - alpha * low - beta * centre
            reach = abs(beta) * 0.5 * width
            lowest, highest = min(place_low, place_high) - reach, max(place_low, place_high) + reach
            first = int(np.floor((lowest - optics.lens_origin_mm) / optics.lens_pitch_mm + 0.5))
            last = int(np.floor((highest - optics.lens_origin_mm) / optics.lens_pitch_mm + 0.5))
            a = beta * bend + s_mu * beta / s_i
            b = alpha * bend + s_mu * (alpha - 1.0) / s_i
            for n in range(max(first, cells.first_lens), min(last, cells.first_lens + cells.start.size - 2) + 1):
                at, stop = cells.start[n - cells.first_lens], cells.start[n - cells.first_lens + 1]
                s = optics.lens_origin_mm + n * optics.lens_pitch_mm
                corners = cut(rectangle[:4], beta, alpha, s + 0.5 * optics.lens_width_mm - offset, upper)
                corners = cut(upper[:corners], -beta, -alpha, -(s - 0.5 * optics.lens_width_mm - offset), lens)
                if corners < 3 or at == stop:
                    continue
                share = scene.node_share[node] / (2.0 * radius * width)
                shift = s * (1.0 - bend) + offset * (bend + s_mu / s_i)
                pixels = cells.pixel[at:stop]
                _add_lens(optics, lens[:corners], (a, b, shift), pixels, share, scratch, shares[at:stop])
                begin, end = min(begin, at), max(end, stop)
        found = 0
        for at in range(begin, end):
            if shares[at] > SMALLEST_SHARE:
                if start_of_row.size:
                    cell[start_of_row[row] + found] = at
                    share_of_cell[start_of_row[row] + found] = shares[at]
                found += 1
            shares[at] = 0.0
        counts[row] = found


@njit(cache=True)
def _array_place(scene: AxisScene, plane: int, node: int, centre: float, crossing: float) -> tuple[float, float]:
    """Return where on the array the ray from `centre` through X = `crossing` arrives, and how much -x moves that.

    Where rays are traced, the other axis enters by its mean square distance: of a disc's chord at X, a third of its
    half length squared, and of the voxels.
    """
    bending = scene.bending
    fitted = bending.coefficients_mm[plane, node]
    if fitted.shape[0] > 0:
        x, across = centre / bending.scale_mm[0], crossing / bending.scale_mm[1]
        place, slope = 0.0, 0.0
        for a in range(fitted.shape[0] - 1, -1, -1):
            part = 0.0
            for b in range(fitted.shape[1] - 1, -1, -1):
                part = part * across + fitted[a, b]
            slope = slope * x + place
            place = place * x + part
        return place, -slope / bending.scale_mm[0]
    camera = scene.optics.camera
    s_i, radius = camera.image_distance_mm, camera.aperture_radius_mm
    lateral = crossing - centre
    chord = max(radius * radius - crossing * crossing, 0.0) / 3.0
    lateral2 = lateral * lateral + chord + bending.beside_mm2
    ratio = slope_ratio(lateral2, bending.nodes[plane, node], bending.factors[plane, node])
    return crossing + s_i * (ratio * lateral - crossing / camera.focal_length_mm), s_i * ratio


@njit(cache=True)
def _add_lens(
    optics: AxisOptics,
    polygon: Floats,
    line: tuple[float, float, float],
    cell_pixel: NDArray[np.int32],
    scale: float,
    scratch: Floats,
    shares: Floats,
) -> None:
    """Spread the polygon's area over the cells of its lens: the pixels that a x + b X + offset falls on.

    Parameters
    ----------
    polygon : (n, 2) corners (x, X)
    line : a, b and the offset
    cell_pixel, shares : (cells,) of the lens; the shares grow by `scale` times the areas
    """
    a, b, offset = line
    edge = (cell_pixel[0] - 0.5 * optics.pixels) * optics.camera.pixel_mm
    below = polygon_area(scratch[: cut(polygon, a, b, edge - offset, scratch)])
    for k in range(cell_pixel.size):
        edge = (cell_pixel[k] + 1 - 0.5 * optics.pixels) * optics.camera.pixel_mm
        upto = polygon_area(scratch[: cut(polygon, a, b, edge - offset, scratch)])
        shares[k] += scale * (upto - below)
        below = upto
