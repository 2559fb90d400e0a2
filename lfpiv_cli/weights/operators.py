"""The three verbs of the weights: forward, adjoint, column.

Factorised form: w_ij = C_i a_ix(j) b_iy(j) with the per-axis weights a (columns) and b (rows) of each z plane and the
mask C of the aperture, so that an image is

    I = C * sum_z B_z V_z A_z^T          and its adjoint          V_z = B_z^T (C * I) A_z,

all by cells (see `axis`); pixels add up their cells at the end.

Axes: volumes [z, y, x], images [row, column]; where the sensor's columns follow world y the two lateral axes of the
volume are exchanged on the way in and out.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.simd import GROUP, LANES, TILE
from lfpiv_cli.threads import ensure_own_threads
from lfpiv_cli.weights import kernels
from lfpiv_cli.weights.axis import AxisWeights
from lfpiv_cli.weights.kernels import PLANES_BACK, PLANES_FORWARD, CellBlocks, LitRows, Terms, VoxelSums
from lfpiv_cli.weights.lens_cells import Cells

# What the weights' verbs are given, checked before compiled loops read it: these know no bounds.


def real_array(given: object, shape: tuple[int, ...], what: str) -> NDArray[Any]:
    """Return an array of real numbers of a shape, as it is given.

    Raises
    ------
    InputError : it has another shape, to which nothing is stretched or cut, or holds no real numbers
    """
    array = np.asarray(given)
    if array.dtype.kind not in "fiub":
        raise InputError(f"{what} of {array.dtype}: expected real numbers")
    if array.shape != shape:
        raise InputError(f"{what} of the shape {array.shape} does not fit weights made for {shape}")
    return array


def voxel_index(index: tuple[Any, ...], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the indices of a voxel; none is counted from the end.

    Raises
    ------
    IndexError : it lies outside the volume
    TypeError : it is no whole number
    """
    whole = tuple(operator.index(number) for number in index)
    if not all(0 <= number < count for number, count in zip(whole, shape, strict=True)):
        raise IndexError(f"voxel {whole} lies outside a volume of the shape {shape}")
    return whole


# Pixel rows, pixel columns and weights of one voxel.
Column = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]


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
        ensure_own_threads()
        volume = real_array(volume, self.shape, "a volume")
        first, last = self._lit_columns
        tiles = filled(last - first, TILE) // TILE
        _, height, width = self.shape
        turned = kernels.turned(volume, (width, filled(height, LANES)))
        by_cell = kernels.project(turned, self._columns_forward, self._rows_forward, tiles)
        return kernels.fold(by_cell, self.mask, self._runs, self._lines_of_rows, self.image_shape)

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the volume [plane, row voxel, column voxel] that an image is spread back to."""
        ensure_own_threads()
        image = real_array(image, self.image_shape, "an image")
        by_cell = kernels.unfold(image, self.mask, self._runs, self._lit_rows, self.rows.cells.pixel)
        planes, height, width = self.shape
        turned = (planes, width, filled(height, LANES))
        volume = kernels.back_project(by_cell, turned, self._rows_back, self._columns_back, get_num_threads())
        return kernels.turned(volume, (height, width))

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        """Return the rows, columns (int64) and weights (float32) of the pixels that one voxel lights."""
        plane, row_voxel, column_voxel = voxel_index((plane, row_voxel, column_voxel), self.shape)
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
    def _lit_rows(self) -> tuple[int, int]:
        """Range of row cells that any voxel reaches."""
        return lit_range(self.rows.cell)

    @cached_property
    def _lit_columns(self) -> tuple[int, int]:
        """Range of column cells that any voxel reaches."""
        return lit_range(self.columns.cell)

    @cached_property
    def _runs(self) -> NDArray[np.int64]:
        return runs_of_cells(self.columns.cells, *self._lit_columns)

    @cached_property
    def _lines_of_rows(self) -> LitRows:
        return rows_of_pixels(self.rows, *self._lit_rows)

    @cached_property
    def _columns_forward(self) -> CellBlocks:
        return blocks_of_cells(self.columns, *self._lit_columns)

    @cached_property
    def _columns_back(self) -> VoxelSums:
        return sums_of_voxels(self.columns, *self._lit_columns)

    @cached_property
    def _rows_forward(self) -> Terms:
        return row_terms_of_cells(self.rows, *self._lit_rows)

    @cached_property
    def _rows_back(self) -> Terms:
        return row_terms_of_voxels(self.rows, self._lit_rows[0])


@dataclass(frozen=True, eq=False)
class BrickOperator:
    """The weights of an array whose rows of lenses are moved against each other, every second one alike.

    Attributes
    ----------
    even, odd : the weights through the lenses of every second row
    """

    even: FactorisedOperator
    odd: FactorisedOperator

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a volume: (planes, voxels along the rows, voxels along the columns)."""
        return self.even.shape

    @property
    def image_shape(self) -> tuple[int, int]:
        """Shape of an image."""
        return self.even.image_shape

    def forward(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image (rows, columns) of a volume [plane, row voxel, column voxel]."""
        return self.even.forward(volume) + self.odd.forward(volume)

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the volume [plane, row voxel, column voxel] that an image is spread back to."""
        return self.even.adjoint(image) + self.odd.adjoint(image)

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        """Return the rows, columns (int64) and weights (float32) of the pixels that one voxel lights."""
        both = [each.column(plane, row_voxel, column_voxel) for each in (self.even, self.odd)]
        row, column, weight = (np.concatenate(parts) for parts in zip(*both, strict=True))
        width = self.image_shape[1]
        pixel, place = np.unique(row * width + column, return_inverse=True)
        total = np.bincount(place, weight, pixel.size).astype(np.float32)
        return pixel // width, pixel % width, total


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


def runs_of_cells(cells: Cells, first: int, last: int) -> NDArray[np.int64]:
    """Return the runs (runs, 4) of lit cells (from `first` to `last`) that share a tile and a lens; see `fold`."""
    cell = np.arange(first, last)
    begins = np.isin(cell, cells.start) | ((cell - first) % TILE == 0)
    begin = cell[begins]
    return np.stack([begin, begin - first, cells.pixel[begin], np.diff(begin, append=last)], axis=1).astype(np.int64)


def blocks_of_cells(columns: AxisWeights, first: int, last: int) -> CellBlocks:
    """Return the columns' weights as blocks of `LANES` lit cells (from `first` to `last`), each with its voxels."""
    pieces = filled(last - first, TILE) // LANES
    plane, voxel = np.divmod(line_of(columns), columns.voxels)
    tile, cell = np.divmod(columns.cell.astype(np.int64) - first, TILE)
    at = (tile * columns.planes + plane) * TILE + cell
    low, span = spans(at, voxel, columns.planes * pieces * LANES)
    most = span.reshape(-1, LANES).max(axis=1)
    start = np.concatenate([[0], np.cumsum(most)]).astype(np.int64)
    block, lane = np.divmod(at, LANES)
    low = np.minimum(low, columns.voxels - np.repeat(most, LANES))
    share = np.zeros((start[-1], LANES), np.float32)
    share[start[block] + voxel - low[at], lane] = columns.share
    return CellBlocks(start, low.astype(np.int32), share)


def sums_of_voxels(columns: AxisWeights, first: int, last: int) -> VoxelSums:
    """Return the columns' weights as sums over the cells of each tile of lit cells (from `first` to `last`)."""
    tiles = filled(last - first, TILE) // TILE
    plane, voxel = np.divmod(line_of(columns), columns.voxels)
    tile, cell = np.divmod(columns.cell.astype(np.int64) - first, TILE)
    owner = tile * columns.planes + plane
    low, span = spans(owner, voxel, columns.planes * tiles)
    owned = np.concatenate([[0], np.cumsum(span)]).astype(np.int64)
    number = owned[owner] + voxel - low[owner]
    terms = packed(number, cell, np.zeros_like(cell), columns.share, (int(owned[-1]), 1))
    return VoxelSums(owned, low.astype(np.int32), *terms)


def spans(
    owner: NDArray[np.int64], place: NDArray[np.int64], owners: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lowest place of each owner and how far it is to the highest, one included; 0, 0 where it has none."""
    low, high = np.full(owners, np.iinfo(np.int64).max), np.full(owners, -1)
    np.minimum.at(low, owner, place)
    np.maximum.at(high, owner, place)
    low[high < 0] = 0
    return low, high - low + 1


def lens_lines(rows: AxisWeights, first: int, last: int) -> NDArray[np.int64]:
    """Return the line of each lit cell in the sum: no group spans two lenses, whose voxels differ."""
    cell = np.arange(first, last)
    lens = np.searchsorted(rows.cells.start, cell, side="right") - 1
    begin = np.maximum(rows.cells.start[lens], first)
    lenses, which = np.unique(lens, return_inverse=True)
    start = np.concatenate([[0], np.cumsum(filled(np.bincount(which, minlength=lenses.size), GROUP))])
    return start[which] + cell - begin


def rows_of_pixels(rows: AxisWeights, first: int, last: int) -> LitRows:
    """Return the lit row cells (from `first` to `last`) in the order of their pixels."""
    pixel = rows.cells.pixel[first:last]
    order = np.argsort(pixel, kind="stable")
    start = np.searchsorted(pixel[order], np.arange(rows.pixels + 1)).astype(np.int64)
    return LitRows(start, first + order, lens_lines(rows, first, last)[order])


def row_terms_of_cells(rows: AxisWeights, first: int, last: int) -> Terms:
    """Return, for each `GROUP` row cells of a lens, the lines of the volume that reach any of them, and the shares.

    `first` and `last` bound the lit cells; a line is plane * filled height + voxel, with the planes of each
    `PLANES_FORWARD` counted on their own, whose terms follow each other.
    """
    line_of_cell = lens_lines(rows, first, last)
    group, member = np.divmod(line_of_cell[rows.cell - first], GROUP)
    groups = int(line_of_cell[-1]) // GROUP + 1
    plane, voxel = np.divmod(line_of(rows), rows.voxels)
    chunk, plane = np.divmod(plane, PLANES_FORWARD)
    line = plane * filled(rows.voxels, LANES) + voxel
    return packed(chunk * groups + group, line, member, rows.share, (_chunks(rows, PLANES_FORWARD) * groups, GROUP))


def row_terms_of_voxels(rows: AxisWeights, first: int) -> Terms:
    """Return, for each voxel of each `GROUP` planes, the lit row cells it reaches (from `first` on) and the shares."""
    plane, voxel = np.divmod(line_of(rows), rows.voxels)
    chunk, plane = np.divmod(plane, PLANES_BACK)
    height, pairs = filled(rows.voxels, LANES), PLANES_BACK // GROUP
    cell = rows.cell.astype(np.int64) - first
    group = (chunk * height + voxel) * pairs + plane // GROUP
    return packed(group, cell, plane % GROUP, rows.share, (_chunks(rows, PLANES_BACK) * height * pairs, GROUP))


def packed(
    group: NDArray[np.int64],
    line: NDArray[np.int64],
    member: NDArray[np.int64],
    share: NDArray[np.float32],
    shape: tuple[int, int],
) -> Terms:
    """Gather the shares of each (group, line) into one term; `shape` counts groups and the members of each."""
    lines = int(line.max(initial=0)) + 1
    keys, term = np.unique(group * lines + line, return_inverse=True)
    start = np.searchsorted(keys, lines * np.arange(shape[0] + 1)).astype(np.int64)
    packed = np.zeros((keys.size, shape[1]), np.float32)
    packed[term, member] = share
    return Terms(start, (keys % lines).astype(np.int32), packed)


def _chunks(axis: AxisWeights, planes: int) -> int:
    """Return how many times so many planes there are, the last time perhaps fewer."""
    return filled(axis.planes, planes) // planes


def filled(size: Any, multiple: int) -> Any:
    """Return a size, or an array of them, filled up to a multiple."""
    return -(-size // multiple) * multiple


def line_of(axis: AxisWeights) -> NDArray[np.int64]:
    """Return the row plane * voxels + voxel of each entry of a table."""
    return np.repeat(np.arange(axis.start.size - 1), np.diff(axis.start))


def lit_range(cell: NDArray[np.int32]) -> tuple[int, int]:
    """Return the first of the cells that any voxel reaches, and the one behind the last."""
    return (int(cell.min()), int(cell.max()) + 1) if cell.size else (0, 0)
