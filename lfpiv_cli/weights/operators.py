"""The three verbs of the weights: forward, adjoint, column.

Factorised form: w_ij = C_i a_ix(j) b_iy(j) with the per-axis weights a (columns) and b (rows) of each z plane and the
mask C of the aperture, so that an image is

    I = C * sum_z B_z V_z A_z^T          and its adjoint          V_z = B_z^T (C * I) A_z,

all by cells (see `axis`); pixels add up their cells at the end.

Axes: volumes [plane, row voxel, column voxel] in the order of the sensor's axes, images [row, column].
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Integers, Singles
from lfpiv_cli.errors import InputError
from lfpiv_cli.simd import GROUP, LANES, TILE
from lfpiv_cli.threads import ensure_own_threads, in_threads, share_out
from lfpiv_cli.weights import kernels
from lfpiv_cli.weights.axis import AxisWeights
from lfpiv_cli.weights.kernels import PLACES, Blocks, BlockShape, LitRows, RowSums, Terms, VisitsBack, VisitsForward

# Planes that go through both steps together, one number forward and one back: what they hold of a tile stays in the
# second-level cache, what the neighbouring sums share of it in the first, and yet the sums over them are long.
PLANES_FORWARD, PLANES_BACK = 8, 16

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
Column = tuple[Integers, Integers, Singles]


class WeightsOperator(ABC):
    """The weights of a volume and what is done with them."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """Shape of a volume: (planes, voxels along the rows, voxels along the columns)."""

    @property
    @abstractmethod
    def image_shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of an image."""

    @abstractmethod
    def forward(self, volume: Singles) -> Singles:
        """Return the image (rows, columns) of a volume [plane, row voxel, column voxel]."""

    @abstractmethod
    def adjoint(self, image: Singles) -> Singles:
        """Return the volume [plane, row voxel, column voxel] that an image is spread back to."""

    @abstractmethod
    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        """Return the rows, columns (int64) and weights (float32) of the pixels that one voxel lights."""

    @abstractmethod
    def behind(self, transmission: Singles) -> WeightsOperator:
        """Return the weights of pixels that pass a share (rows, columns) of the light."""


class Visits(NamedTuple):
    """Which tiles and blocks meet, and where each entry of the weights along the columns belongs.

    Attributes
    ----------
    of_tile : (tiles * slabs + 1,) int64, the first visit of each
    block : (visits,) int64
    of_entry : (entries,) int64, its visit
    plane, voxel, cell : (entries,) int64; plane in the block, cell in the tile
    """

    of_tile: Integers
    block: Integers
    of_entry: Integers
    plane: Integers
    voxel: Integers
    cell: Integers


@dataclass(frozen=True, eq=False)
class SeparatedOperator(WeightsOperator):
    """Weights of two factors in blocks, and the tables that their products take, made when they are first needed.

    Attributes
    ----------
    columns, rows : the weights along the columns and the rows, of the planes of one block after the other
    mask : (row cells, column cells) float32, C and whatever else scales the light
    """

    columns: AxisWeights
    rows: AxisWeights
    mask: Singles

    @property
    @abstractmethod
    def lit_cells(self) -> NDArray[np.int32]:
        """The lit column cells in an order: a block may have those of some tiles only."""

    @property
    @abstractmethod
    def forward_blocks(self) -> tuple[Blocks, BlockShape]:
        """Where the blocks of `forward` lie, and how large they are."""

    @property
    @abstractmethod
    def back_blocks(self) -> tuple[Blocks, BlockShape]:
        """Where the blocks of `adjoint` lie, and how large they are; none crosses a multiple of its planes."""

    @property
    def image_shape(self) -> tuple[int, int]:
        return self.rows.pixels, self.columns.pixels

    def behind(self, transmission: Singles) -> Self:
        cells = np.ix_(self.rows.cells.pixel, self.columns.cells.pixel)
        return replace(self, mask=self.mask * transmission[cells])

    def project(self, volume: Singles) -> Singles:
        """Return the image (rows, columns) of a turned volume (planes, voxels along the columns, lines)."""
        columns, (blocks, shape) = self._columns_forward, self.forward_blocks
        tiles, groups = columns.of_tile.size - 1, self._groups
        flat_cell = kernels.room_for(tiles * groups * GROUP * TILE)
        tables = blocks, shape, columns, self._rows_forward, groups, PLACES
        share_out(kernels.project_tiles, tiles, volume, *tables, flat_cell)
        by_cell = flat_cell.reshape(tiles, groups * GROUP, TILE)
        image = np.empty((self.rows.pixels, self.columns.pixels), np.float32)
        share_out(kernels.fold_rows, len(image), by_cell, self.mask, self._runs, self._lines_of_rows, image)
        return image

    def back_project(self, image: Singles, shape: tuple[int, int, int]) -> Singles:
        """Return the turned volume of a shape that an image is spread back to."""
        tiles, (first, last) = filled(self.lit_cells.size, TILE) // TILE, self._lit_rows
        pixel, row_pixel = self.columns.cells.pixel[self.lit_cells], self.rows.cells.pixel[first:last]
        by_cell = kernels.room_for(tiles * (last - first) * TILE).reshape(tiles, last - first, TILE)
        by_cell[-1:] = 0.0
        share_out(kernels.unfold_lines, last - first, image, self._sorted_mask, pixel, row_pixel, first, by_cell)

        columns, threads, volume = self._columns_back, get_num_threads(), np.zeros(shape, np.float32)
        slabs = (columns.of_tile.size - 1) // max(tiles, 1)
        visits = np.diff(columns.of_tile).reshape(tiles, slabs).sum(axis=0)
        # A thread takes a tile through all of its planes, so that the cells come into its cache once.
        ends = np.searchsorted(np.cumsum(visits), visits.sum() * np.arange(1, threads) / threads)
        edges = [0, *ends.tolist(), slabs]
        tables = *self.back_blocks, self._rows_back, columns, PLACES
        in_threads(
            lambda part: kernels.back_project_slabs(part, by_cell, volume, *tables),
            list(zip(edges, edges[1:], strict=False)),
        )
        return volume

    @cached_property
    def _lit_rows(self) -> tuple[int, int]:
        """Range of row cells that any voxel reaches."""
        return lit_range(self.rows.cell)

    @cached_property
    def _sorted_mask(self) -> Singles:
        return np.ascontiguousarray(self.mask[:, self.lit_cells])

    @cached_property
    def _line_of_cell(self) -> Integers:
        """The line of each lit row cell in the sum: no group spans two lenses, whose voxels differ."""
        first, last = self._lit_rows
        cell, starts = np.arange(first, last), self.rows.cells.start
        lens = np.searchsorted(starts, cell, side="right") - 1
        lenses, which = np.unique(lens, return_inverse=True)
        start = np.concatenate([[0], np.cumsum(filled(np.bincount(which, minlength=lenses.size), GROUP))])
        return start[which] + cell - np.maximum(starts[lens], first)

    @cached_property
    def _groups(self) -> int:
        return int(self._line_of_cell.max(initial=-1)) // GROUP + 1

    @cached_property
    def _lines_of_rows(self) -> LitRows:
        """The lit row cells in the order of their pixels."""
        first, last = self._lit_rows
        pixel = self.rows.cells.pixel[first:last]
        order = np.argsort(pixel, kind="stable")
        start = np.searchsorted(pixel[order], np.arange(self.rows.pixels + 1)).astype(np.int64)
        return LitRows(start, first + order, self._line_of_cell[order])

    @cached_property
    def _runs(self) -> Integers:
        """The runs (runs, 5) of lit column cells side by side in a tile and a lens; see `kernels.fold_rows`."""
        place = np.argsort(self.lit_cells)
        cell = self.lit_cells[place].astype(np.int64)
        step, tile = np.diff(place), place // TILE
        beside = (np.diff(cell) == 1) & (np.abs(step) == 1) & (np.diff(tile) == 0)
        beside &= ~np.isin(cell[1:], self.columns.cells.start)
        beside[1:] &= ~beside[:-1] | (step[1:] == step[:-1])
        begins = np.flatnonzero(np.append(True, ~beside)[: cell.size])
        steps = np.append(np.where(beside, step, 1), 1)[begins]
        pixel, counts = self.columns.cells.pixel[cell[begins]], np.diff(begins, append=cell.size)
        return np.stack([cell[begins], place[begins], pixel, counts, steps], axis=1).astype(np.int64)

    def _visits(self, blocks: Blocks, slab_of_block: Integers, slabs: int) -> Visits:
        """Return the visits of some blocks, those of a tile and a slab together."""
        first = np.concatenate([[0], np.cumsum(blocks.planes)])
        plane, voxel = np.divmod(line_of(self.columns), self.columns.voxels)
        block = np.searchsorted(first, plane, side="right") - 1
        rank = np.zeros(self.columns.cells.pixel.size, np.int64)
        rank[self.lit_cells] = np.arange(self.lit_cells.size)
        tile, cell = np.divmod(rank[self.columns.cell], TILE)
        tiles, count = filled(self.lit_cells.size, TILE) // TILE, blocks.plane.size
        keys, of_entry = np.unique((tile * slabs + slab_of_block[block]) * count + block, return_inverse=True)
        of_tile = np.searchsorted(keys, count * np.arange(tiles * slabs + 1)).astype(np.int64)
        return Visits(of_tile, keys % count, of_entry, plane - first[block], voxel, cell)

    @cached_property
    def _columns_forward(self) -> VisitsForward:
        blocks, shape = self.forward_blocks
        visits = self._visits(blocks, np.zeros(blocks.plane.size, np.int64), 1)
        at = (visits.of_entry * shape.planes + visits.plane) * TILE + visits.cell
        low, span = spans(at, visits.voxel, visits.block.size * shape.planes * TILE)
        most = span.reshape(-1, LANES).max(axis=1)
        start = np.concatenate([[0], np.cumsum(most)]).astype(np.int64)
        block, lane = np.divmod(at, LANES)
        low = np.minimum(low, self.columns.voxels - np.repeat(most, LANES))
        shares = self.columns.share.reshape(at.size, -1)
        share = np.zeros((start[-1], shares.shape[1], LANES), np.float32)
        share[start[block] + visits.voxel - low[at], :, lane] = shares
        return VisitsForward(visits.of_tile, visits.block, start, low.astype(np.int32), share)

    @cached_property
    def _columns_back(self) -> VisitsBack:
        """The weights along the columns as sums over the cells of each tile."""
        blocks, shape = self.back_blocks
        slab = blocks.plane // shape.planes
        visits = self._visits(blocks, slab, int(slab.max(initial=-1)) + 1)
        owner = visits.of_entry * shape.planes + visits.plane
        low, span = spans(owner, visits.voxel, visits.block.size * shape.planes)
        owned = np.concatenate([[0], np.cumsum(span)]).astype(np.int64)
        number = owned[owner] + visits.voxel - low[owner]
        by_sum = np.argsort(number * TILE + visits.cell, kind="stable")
        start = np.searchsorted(number[by_sum], np.arange(owned[-1] + 1)).astype(np.int64)
        line = visits.cell[by_sum].astype(np.int32)
        share = np.ascontiguousarray(self.columns.share.reshape(by_sum.size, -1)[by_sum])
        return VisitsBack(visits.of_tile, visits.block, owned, low.astype(np.int32), start, line, share)

    @cached_property
    def _rows_forward(self) -> RowSums:
        """For each `GROUP` row cells of a lens the lines of each block that reach any of them, and the shares."""
        blocks, shape = self.forward_blocks
        group, member = np.divmod(self._line_of_cell[self.rows.cell - self._lit_rows[0]], GROUP)
        groups = self._groups
        block, plane, line = self._block_lines(blocks)
        line += plane * shape.lines
        terms = packed(block * groups + group, line, member, self.rows.share, (blocks.plane.size * groups, GROUP))
        some = np.flatnonzero(np.diff(terms.start))
        start = np.append(terms.start[some], terms.start[-1])
        of_block = np.searchsorted(some, groups * np.arange(blocks.plane.size + 1)).astype(np.int64)
        return RowSums(of_block, some % max(groups, 1), terms._replace(start=start))

    @cached_property
    def _rows_back(self) -> Terms:
        """For each line of a block and `GROUP` planes the lit row cells that it reaches, and the shares."""
        blocks, shape = self.back_blocks
        block, plane, line = self._block_lines(blocks)
        pairs = shape.planes // GROUP
        group = (block * shape.lines + line) * pairs + plane // GROUP
        cell = self.rows.cell.astype(np.int64) - self._lit_rows[0]
        sums = blocks.plane.size * shape.lines * pairs
        return packed(group, cell, plane % GROUP, self.rows.share, (sums, GROUP))

    def _block_lines(self, blocks: Blocks) -> tuple[Integers, Integers, Integers]:
        """Return the block of each entry of the weights along the rows, its plane in the block, and its line."""
        first = np.concatenate([[0], np.cumsum(blocks.planes)])
        plane, line = np.divmod(line_of(self.rows), self.rows.voxels)
        block = np.searchsorted(first, plane, side="right") - 1
        return block, plane - first[block], line


class FactorisedOperator(SeparatedOperator):
    """Weights that are two factors as a whole: those of each plane, of all voxels along the columns and the rows."""

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.columns.planes, self.rows.voxels, self.columns.voxels

    @cached_property
    def lit_cells(self) -> NDArray[np.int32]:
        """All from the first to the last."""
        return np.arange(*lit_range(self.columns.cell), dtype=np.int32)

    @property
    def forward_blocks(self) -> tuple[Blocks, BlockShape]:
        """Some planes each."""
        return self._blocks(PLANES_FORWARD)

    @property
    def back_blocks(self) -> tuple[Blocks, BlockShape]:
        """Some planes each."""
        return self._blocks(PLANES_BACK)

    def _blocks(self, most: int) -> tuple[Blocks, BlockShape]:
        planes, height, _ = self.shape
        first = np.arange(0, planes, most)
        where = Blocks(first, np.minimum(planes - first, most), np.zeros_like(first))
        return where, BlockShape(most, filled(height, LANES))

    @property
    def window(self) -> tuple[slice, slice]:
        """The rows and columns of the rectangle of pixels that any voxel lights."""
        rows, columns = (each.cells.pixel[slice(*lit_range(each.cell))] for each in (self.rows, self.columns))
        return slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)

    def part(self, row_voxels: slice, column_voxels: slice) -> FactorisedOperator:
        """Return the weights of some voxels, through all planes."""
        return replace(self, columns=self.columns.part(column_voxels), rows=self.rows.part(row_voxels))

    def forward(self, volume: Singles) -> Singles:
        ensure_own_threads()
        volume = real_array(volume, self.shape, "a volume")
        _, height, width = self.shape
        return self.project(kernels.turned(volume, (width, filled(height, LANES))))

    def adjoint(self, image: Singles) -> Singles:
        ensure_own_threads()
        image = real_array(image, self.image_shape, "an image")
        planes, height, width = self.shape
        return kernels.turned(self.back_project(image, (planes, width, filled(height, LANES))), (height, width))

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
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


@dataclass(frozen=True, eq=False)
class BrickOperator(WeightsOperator):
    """The weights of an array whose rows of lenses are moved against each other: of every second row, and the others'.

    Attributes
    ----------
    even, odd : the weights through the lenses of every second row
    """

    even: FactorisedOperator
    odd: FactorisedOperator

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.even.shape

    @property
    def image_shape(self) -> tuple[int, int]:
        return self.even.image_shape

    def behind(self, transmission: Singles) -> BrickOperator:
        return BrickOperator(self.even.behind(transmission), self.odd.behind(transmission))

    def forward(self, volume: Singles) -> Singles:
        return self.even.forward(volume) + self.odd.forward(volume)

    def adjoint(self, image: Singles) -> Singles:
        return self.even.adjoint(image) + self.odd.adjoint(image)

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        both = [each.column(plane, row_voxel, column_voxel) for each in (self.even, self.odd)]
        row, column, weight = (np.concatenate(parts) for parts in zip(*both, strict=True))
        width = self.image_shape[1]
        pixel, place = np.unique(row * width + column, return_inverse=True)
        total = np.bincount(place, weight, pixel.size).astype(np.float32)
        return pixel // width, pixel % width, total


def forward_reference(operator: FactorisedOperator, volume: Singles) -> Floats:
    """Return the image of a volume as dense matrix products: the readable twin of `FactorisedOperator.forward`."""
    by_cell = np.zeros(operator.mask.shape)
    for plane in range(operator.shape[0]):
        by_cell += operator.rows.matrix(plane) @ volume[plane].astype(np.float64) @ operator.columns.matrix(plane).T
    image = np.zeros(operator.image_shape)
    np.add.at(image, np.ix_(operator.rows.cells.pixel, operator.columns.cells.pixel), by_cell * operator.mask)
    return image


def adjoint_reference(operator: FactorisedOperator, image: Singles) -> Floats:
    """Return the adjoint as dense matrix products: the readable twin of `FactorisedOperator.adjoint`."""
    pixels = np.ix_(operator.rows.cells.pixel, operator.columns.cells.pixel)
    by_cell = image.astype(np.float64)[pixels] * operator.mask
    planes = range(operator.shape[0])
    return np.stack([operator.rows.matrix(k).T @ by_cell @ operator.columns.matrix(k) for k in planes])


def spans(owner: Integers, place: Integers, owners: int) -> tuple[Integers, Integers]:
    """Return the lowest place of each owner and how far it is to the highest, one included; 0, 0 where it has none."""
    low, high = np.full(owners, np.iinfo(np.int64).max), np.full(owners, -1)
    np.minimum.at(low, owner, place)
    np.maximum.at(high, owner, place)
    low[high < 0] = 0
    return low, high - low + 1


def packed(group: Integers, line: Integers, member: Integers, share: Singles, shape: tuple[int, int]) -> Terms:
    """Gather the shares of each (group, line) into one term; `shape` counts groups and the members of each."""
    lines = int(line.max(initial=0)) + 1
    keys, term = np.unique(group * lines + line, return_inverse=True)
    start = np.searchsorted(keys, lines * np.arange(shape[0] + 1)).astype(np.int64)
    packed = np.zeros((keys.size, shape[1]), np.float32)
    packed[term, member] = share
    return Terms(start, (keys % lines).astype(np.int32), packed)


def filled(size: Any, multiple: int) -> Any:
    """Return a size, or an array of them, filled up to a multiple."""
    return -(-size // multiple) * multiple


def line_of(axis: AxisWeights) -> Integers:
    """Return the row plane * voxels + voxel of each entry of a table."""
    return np.repeat(np.arange(axis.start.size - 1), np.diff(axis.start))


def lit_range(cell: NDArray[np.int32]) -> tuple[int, int]:
    """Return the first of the cells that any voxel reaches, and the one behind the last."""
    return (int(cell.min()), int(cell.max()) + 1) if cell.size else (0, 0)
