"""The three verbs of the weights: forward, adjoint, column.

Factorised form: w_ij = C_i a_ix(j) b_iy(j) with the per-axis weights a (columns) and b (rows) of each z plane and the
mask C of the aperture, so that an image is

    I = C * sum_z B_z V_z A_z^T          and its adjoint          V_z = B_z^T (C * I) A_z,

all by cells (see `axis`); pixels add up their cells at the end.

Axes: volumes [z, y, x], images [row, column]; where the sensor's columns follow world y the two lateral axes of the
volume are exchanged on the way in and out.

The kernels do the row step, nine tenths of the work, on four rows (forward) or four planes (adjoint) at once and four
terms at a time, along contiguous columns: every number that is loaded is used four times. All sums are made per output
element in a fixed order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.weights.axis import AxisWeights

# Pixel rows, pixel columns and weights of one voxel.
Column = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]
# Start of each group (groups + 1,), the line of each entry and its `GROUP` shares.
Groups = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]

# Rows (or planes) that share the loads of one pass, and terms per pass.
GROUP = 4
# Columns per tile: 4 accumulators and 4 operands of 1 kB stay in the first-level cache.
TILE = 256


@dataclass(frozen=True, eq=False)
class FactorisedOperator:
    """Weights in factorised form.

    Attributes
    ----------
    columns, rows : the per-axis weights along the sensor's columns and rows
    mask : (row cells, column cells) float32, C and whatever else scales the light
    """

    columns: AxisWeights
    rows: AxisWeights
    mask: NDArray[np.float32]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a volume: (planes, voxels along the rows, voxels along the columns)."""
        return self.columns.planes, self.rows.voxels, self.columns.voxels

    @property
    def image_shape(self) -> tuple[int, int]:
        """Shape of an image."""
        return self.rows.pixels, self.columns.pixels

    def forward(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image (rows, columns) of a volume [plane, row voxel, column voxel]."""
        first, last = self._lit_columns
        spread = _spread_columns(volume, first, last, self.columns.start, self.columns.cell, self.columns.share)
        by_cell = _sum_rows(spread, self.rows.cells.pixel.size, *self._row_groups)
        return _fold(by_cell, self.mask, first, self.columns.cells.pixel, *self._cells_of_rows, self.columns.pixels)

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the volume [plane, row voxel, column voxel] that an image is spread back to."""
        first, last = self._lit_columns
        by_cell = _unfold(image, self.mask, self.rows.cells.pixel, self.columns.cells.pixel, first, last)
        gathered = _gather_rows(by_cell, self.shape[0], self.shape[1], *self._plane_groups)
        return _gather_columns(
            gathered, first, self.columns.voxels, self.columns.start, self.columns.cell, self.columns.share
        )

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        """Return the rows, columns (int64) and weights (float32) of the pixels that one voxel lights."""
        row, along_rows = self.rows.row(plane, row_voxel)
        column, along_columns = self.columns.row(plane, column_voxel)
        by_cell = np.outer(along_rows, along_columns) * self.mask[np.ix_(row, column)]
        rows, row_of = np.unique(self.rows.cells.pixel[row], return_inverse=True)
        columns, column_of = np.unique(self.columns.cells.pixel[column], return_inverse=True)
        weight = np.zeros((rows.size, columns.size), np.float32)
        np.add.at(weight, (row_of[:, np.newaxis], column_of), by_cell)
        lit = np.nonzero(weight)
        return rows[lit[0]].astype(np.int64), columns[lit[1]].astype(np.int64), weight[lit]

    @cached_property
    def _lit_columns(self) -> tuple[int, int]:
        """Range of column cells that any voxel reaches."""
        cell = self.columns.cell
        return (int(cell.min()), int(cell.max()) + 1) if cell.size else (0, 0)

    @cached_property
    def _cells_of_rows(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row cells in the order of their pixels, and where each pixel's begin (rows + 1,)."""
        pixel = self.rows.cells.pixel
        start = np.searchsorted(np.sort(pixel), np.arange(self.rows.pixels + 1)).astype(np.int64)
        return np.argsort(pixel, kind="stable"), start

    @cached_property
    def _row_groups(self) -> Groups:
        return group_terms_by_row(self.rows)

    @cached_property
    def _plane_groups(self) -> Groups:
        return group_terms_by_plane(self.rows)


def forward_reference(operator: FactorisedOperator, volume: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the image of a volume as dense matrix products: the readable twin of `FactorisedOperator.forward`."""
    by_cell = np.zeros(operator.mask.shape)
    for plane in range(operator.shape[0]):
        by_cell += operator.rows.matrix(plane) @ volume[plane].astype(np.float64) @ operator.columns.matrix(plane).T
    image = np.zeros(operator.image_shape)
    np.add.at(image, np.ix_(operator.rows.cells.pixel, operator.columns.cells.pixel), by_cell * operator.mask)
    return image


def adjoint_reference(operator: FactorisedOperator, image: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the adjoint as dense matrix products: the readable twin of `FactorisedOperator.adjoint`."""
    pixels = np.ix_(operator.rows.cells.pixel, operator.columns.cells.pixel)
    by_cell = image.astype(np.float64)[pixels] * operator.mask
    planes = range(operator.shape[0])
    return np.stack([operator.rows.matrix(k).T @ by_cell @ operator.columns.matrix(k) for k in planes])


def group_terms_by_row(rows: AxisWeights) -> Groups:
    """Return for each four row cells the (plane, voxel) lines that reach any of them, and the four shares of each.

    Returns
    -------
    start : (groups + 1,), line : index plane * voxels + voxel, share : (lines, 4); each group is filled up with lines
    of share 0 to a multiple of four.
    """
    line_of = np.repeat(np.arange(rows.start.size - 1), np.diff(rows.start))
    return _pack(rows.cell // GROUP, line_of, rows.cell % GROUP, rows.share, -(-rows.cells.pixel.size // GROUP))


def group_terms_by_plane(rows: AxisWeights) -> Groups:
    """Return for each voxel of each four planes the row cells it reaches, and the four shares of each; see above."""
    line_of = np.repeat(np.arange(rows.start.size - 1), np.diff(rows.start))
    plane, voxel = np.divmod(line_of, rows.voxels)
    groups = -(-rows.planes // GROUP) * rows.voxels
    return _pack(plane // GROUP * rows.voxels + voxel, rows.cell.astype(np.int64), plane % GROUP, rows.share, groups)


def _pack(
    group: NDArray[np.integer],
    line: NDArray[np.int64],
    member: NDArray[np.integer],
    share: NDArray[np.float32],
    groups: int,
) -> Groups:
    """Gather the shares of each (group, line) into one entry of `GROUP` members, groups of a multiple of `GROUP`."""
    keys, entry = np.unique(group.astype(np.int64) * (int(line.max(initial=0)) + 1) + line, return_inverse=True)
    entry_group = keys // (int(line.max(initial=0)) + 1)
    counts = np.bincount(entry_group, minlength=groups)
    start = np.concatenate([[0], np.cumsum(-(-counts // GROUP) * GROUP)]).astype(np.int64)
    begin = np.concatenate([[0], np.cumsum(counts)])
    place = start[entry_group] + np.arange(keys.size) - begin[entry_group]
    lines = np.zeros(start[-1], np.int32)
    shares = np.zeros((start[-1], GROUP), np.float32)
    lines[place] = keys % (int(line.max(initial=0)) + 1)
    shares[place[entry], member] = share
    return start, lines, shares


@njit(cache=True, parallel=True, fastmath={"contract"})
def _spread_columns(
    volume: NDArray[np.float32],
    first: int,
    last: int,
    start: NDArray[np.int64],
    cell: NDArray[np.int32],
    share: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return V_z A_z^T for every plane: (planes * row voxels, last - first)."""
    planes, height, width = volume.shape
    out = np.empty((planes * height, last - first), np.float32)
    for plane in prange(planes):
        turned = np.ascontiguousarray(volume[plane].T)
        lines = np.zeros((last - first, height), np.float32)
        for k in range(width):
            source = turned[k]
            for at in range(start[plane * width + k], start[plane * width + k + 1]):
                weight = share[at]
                target = lines[cell[at] - first]
                for j in range(height):
                    target[j] += weight * source[j]
        for j in range(height):
            for c in range(last - first):
                out[plane * height + j, c] = lines[c, j]
    return out


@njit(cache=True, parallel=True, fastmath={"contract"})
def _sum_rows(
    spread: NDArray[np.float32],
    cells: int,
    start: NDArray[np.int64],
    line: NDArray[np.int32],
    share: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return sum_z B_z T_z: (row cells, columns)."""
    columns = spread.shape[1]
    image = np.empty((GROUP * (start.size - 1), columns), np.float32)
    for group in prange(start.size - 1):
        _combine(spread, line, share, start[group], start[group + 1], image[GROUP * group : GROUP * (group + 1)])
    return image[:cells]


@njit(cache=True, parallel=True, fastmath={"contract"})
def _gather_rows(
    image: NDArray[np.float32],
    planes: int,
    height: int,
    start: NDArray[np.int64],
    line: NDArray[np.int32],
    share: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return B_z^T I for every plane: (planes, row voxels, columns)."""
    columns = image.shape[1]
    groups = -(-planes // GROUP)
    out = np.empty((groups, height, GROUP, columns), np.float32)
    for task in prange(groups * height):
        _combine(image, line, share, start[task], start[task + 1], out[task // height, task % height])
    return out


@njit(cache=True, fastmath={"contract"})
def _combine(
    source: NDArray[np.float32],
    line: NDArray[np.int32],
    share: NDArray[np.float32],
    begin: int,
    end: int,
    out: NDArray[np.float32],
) -> None:
    """Set four rows of `out` to sums of lines of `source`, out[m] = sum_k share[k, m] source[line[k]]."""
    columns = source.shape[1]
    for tile in range(0, columns, TILE):
        stop = min(tile + TILE, columns)
        out0, out1, out2, out3 = out[0, tile:stop], out[1, tile:stop], out[2, tile:stop], out[3, tile:stop]
        out[:, tile:stop] = 0.0
        for k in range(begin, end, 4):
            a, b, c, d = share[k], share[k + 1], share[k + 2], share[k + 3]
            a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
            b0, b1, b2, b3 = b[0], b[1], b[2], b[3]
            c0, c1, c2, c3 = c[0], c[1], c[2], c[3]
            d0, d1, d2, d3 = d[0], d[1], d[2], d[3]
            in0, in1 = source[line[k], tile:stop], source[line[k + 1], tile:stop]
            in2, in3 = source[line[k + 2], tile:stop], source[line[k + 3], tile:stop]
            for j in range(stop - tile):
                p, q, r, s = in0[j], in1[j], in2[j], in3[j]
                out0[j] += a0 * p + b0 * q + c0 * r + d0 * s
                out1[j] += a1 * p + b1 * q + c1 * r + d1 * s
                out2[j] += a2 * p + b2 * q + c2 * r + d2 * s
                out3[j] += a3 * p + b3 * q + c3 * r + d3 * s


@njit(cache=True, parallel=True, fastmath={"contract"})
def _gather_columns(
    gathered: NDArray[np.float32],
    first: int,
    width: int,
    start: NDArray[np.int64],
    cell: NDArray[np.int32],
    share: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return T_z A_z for every plane: (planes, row voxels, column voxels)."""
    height, columns = gathered.shape[1], gathered.shape[3]
    planes = (start.size - 1) // width
    volume = np.empty((planes, height, width), np.float32)
    for plane in prange(planes):
        lines = np.empty((columns, height), np.float32)
        for j in range(height):
            source = gathered[plane // GROUP, j, plane % GROUP]
            for c in range(columns):
                lines[c, j] = source[c]
        for k in range(width):
            total = np.zeros(height, np.float32)
            for at in range(start[plane * width + k], start[plane * width + k + 1]):
                weight = share[at]
                source = lines[cell[at] - first]
                for j in range(height):
                    total[j] += weight * source[j]
            volume[plane, :, k] = total
    return volume


@njit(cache=True, parallel=True)
def _fold(
    by_cell: NDArray[np.float32],
    mask: NDArray[np.float32],
    first: int,
    column_pixel: NDArray[np.int32],
    row_cell: NDArray[np.int64],
    row_start: NDArray[np.int64],
    columns: int,
) -> NDArray[np.float32]:
    """Return the image (rows, columns): C times the light of each cell, added up by pixel."""
    image = np.zeros((row_start.size - 1, columns), np.float32)
    for row in prange(row_start.size - 1):
        for at in range(row_start[row], row_start[row + 1]):
            cell = row_cell[at]
            for k in range(by_cell.shape[1]):
                image[row, column_pixel[first + k]] += mask[cell, first + k] * by_cell[cell, k]
    return image


@njit(cache=True, parallel=True)
def _unfold(
    image: NDArray[np.float32],
    mask: NDArray[np.float32],
    row_pixel: NDArray[np.int32],
    column_pixel: NDArray[np.int32],
    first: int,
    last: int,
) -> NDArray[np.float32]:
    """Return C times the pixel that each cell belongs to, (row cells, last - first)."""
    by_cell = np.empty((row_pixel.size, last - first), np.float32)
    for cell in prange(row_pixel.size):
        line = image[row_pixel[cell]]
        for k in range(last - first):
            by_cell[cell, k] = mask[cell, first + k] * line[column_pixel[first + k]]
    return by_cell
