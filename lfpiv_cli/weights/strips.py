"""Weights of a volume in strips of neighbouring lines of voxels, behind curved faces.

Behind a curved window rays do not separate into two axes over the whole volume: along a tube the apparent depth changes
with the distance from its axis. Each voxel has a product of two factors even so, w = C a b:

- a, along the strip, of the pixel's column, changes with the line within a strip as a polynomial of the second degree;
- b, across the strips, of the pixel's row, is each line's own. Where faces run a little aslant, so that the light of a
  line drifts across the strip, it is mixed linearly from those of two places along the strip, one on either side.

Where the two axes know too much of each other, the light through different parts of the aperture has factors of its
own. What has one pair of factors is a block: up to `SLAB` planes of a strip, a range of voxels along it, or the share
that one place has in them, and the light through a rectangle of the aperture, told by which cells its factors have.

Axes: volumes [plane, row voxel, column voxel] in the order of the sensor's axes, images [row, column].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from lfpiv_cli.simd import COEFFICIENTS, GROUP, LANES, TILE
from lfpiv_cli.threads import ensure_own_threads
from lfpiv_cli.weights import kernels, strip_kernels
from lfpiv_cli.weights.axis import AxisWeights
from lfpiv_cli.weights.kernels import Index, LitRows, Terms
from lfpiv_cli.weights.lens_cells import Cells
from lfpiv_cli.weights.operators import (
    Column,
    filled,
    lens_lines,
    line_of,
    lit_range,
    packed,
    real_array,
    rows_of_pixels,
    spans,
    voxel_index,
)
from lfpiv_cli.weights.strip_kernels import PLACES, SLAB, STRIP, Blocks, RowSums, SortedCells, VisitsBack, VisitsForward

# The tables of weights in strips as the compiled loops want them, from the weights along each axis.
#
# Column cells are sorted by which part of the aperture they see, so that those of a tile see the same: light through
# one part then comes from some of the tiles only.


# Parts of the aperture, side by side: by those along the strips column cells are sorted, and blocks have some
# neighbouring ones of those across.
PARTS, FINE_PARTS = 6, 12


def part_of_cells(cells: Cells, radius_mm: float, parts: int) -> Index:
    """Return which of so many equal parts of the aperture each cell sees; that of two that share their sums is one."""
    middle = cells.patch_mm.mean(axis=1)
    lens = np.searchsorted(cells.start, np.arange(middle.size), side="right") - 1
    pair = cells.start[lens] + (np.arange(middle.size) - cells.start[lens]) // GROUP * GROUP
    other = np.minimum(pair + GROUP - 1, cells.start[lens + 1] - 1)
    middle = 0.5 * (middle[pair] + middle[other])
    return np.clip((middle + radius_mm) * parts / (2.0 * radius_mm), 0, parts - 1).astype(np.int64)


def sorted_cells(cells: Cells, lenses: tuple[int, int], radius_mm: float) -> NDArray[np.int32]:
    """Return the cells of some lenses, the first and the last by number, by what part of the aperture they see.

    To and fro along the axis, so that neighbours are of neighbouring lenses.
    """
    first, last = (int(np.clip(n - cells.first_lens, 0, cells.start.size - 1)) for n in (lenses[0], lenses[1] + 1))
    cell = np.arange(cells.start[first], cells.start[last])
    part = part_of_cells(cells, radius_mm, PARTS)[cell]
    return cell[np.lexsort((np.where(part % 2, -cell, cell), part))].astype(np.int32)


def cells_in_order(cells: Cells, order: NDArray[np.int32]) -> SortedCells:
    """Return the sorted cells as the loops over an image's rows want them."""
    ends = (int(order.min()), int(order.max()) + 1) if order.size else (0, 0)
    first = np.unique(np.clip(cells.start, *ends))
    lenses = np.stack([first[:-1], cells.pixel[first[:-1]], np.diff(first)], axis=1).astype(np.int64)
    return SortedCells(order, cells.pixel[order], lenses)


class _Visits:
    """Which tiles and blocks meet, and where each entry of the weights along the lines belongs.

    Attributes
    ----------
    tile, block : (visits,) int64, sorted by both, or by tile and slab
    of_entry : (entries,) int64, its visit
    plane, voxel, cell : (entries,) int64; plane in the block, cell in the tile
    """

    def __init__(self, columns: AxisWeights, order: NDArray[np.int32], blocks: Blocks, slabs: int) -> None:
        first = np.concatenate([[0], np.cumsum(blocks.planes)])
        plane, self.voxel = np.divmod(line_of(columns), columns.voxels)
        block = np.searchsorted(first, plane, side="right") - 1
        self.plane = plane - first[block]
        rank = np.zeros(columns.cells.pixel.size, np.int64)
        rank[order] = np.arange(order.size)
        tile, self.cell = np.divmod(rank[columns.cell], TILE)
        tiles, count = filled(order.size, TILE) // TILE, blocks.plane.size
        slab = blocks.plane // SLAB if slabs > 1 else np.zeros(count, np.int64)
        keys, self.of_entry = np.unique((tile * slabs + slab[block]) * count + block, return_inverse=True)
        self.block = keys % count
        self.of_tile = np.searchsorted(keys, count * np.arange(tiles * slabs + 1)).astype(np.int64)


def visits_forward(columns: AxisWeights, order: NDArray[np.int32], blocks: Blocks) -> VisitsForward:
    """Return the weights along the lines as blocks of `LANES` column cells, each with its voxels."""
    visits = _Visits(columns, order, blocks, 1)
    at = (visits.of_entry * SLAB + visits.plane) * TILE + visits.cell
    low, span = spans(at, visits.voxel, visits.block.size * SLAB * TILE)
    most = span.reshape(-1, LANES).max(axis=1)
    start = np.concatenate([[0], np.cumsum(most)]).astype(np.int64)
    block, lane = np.divmod(at, LANES)
    low = np.minimum(low, columns.voxels - np.repeat(most, LANES))
    share = np.zeros((start[-1], COEFFICIENTS, LANES), np.float32)
    share[start[block] + visits.voxel - low[at], :, lane] = columns.share
    return VisitsForward(visits.of_tile, visits.block, start, low.astype(np.int32), share)


def visits_back(columns: AxisWeights, order: NDArray[np.int32], blocks: Blocks, planes: int) -> VisitsBack:
    """Return the weights along the lines as sums over the cells of each tile."""
    visits = _Visits(columns, order, blocks, filled(planes, SLAB) // SLAB)
    owner = visits.of_entry * SLAB + visits.plane
    low, span = spans(owner, visits.voxel, visits.block.size * SLAB)
    owned = np.concatenate([[0], np.cumsum(span)]).astype(np.int64)
    number = owned[owner] + visits.voxel - low[owner]
    by_sum = np.argsort(number * TILE + visits.cell, kind="stable")
    start = np.searchsorted(number[by_sum], np.arange(owned[-1] + 1)).astype(np.int64)
    line, share = visits.cell[by_sum].astype(np.int32), np.ascontiguousarray(columns.share[by_sum])
    return VisitsBack(visits.of_tile, visits.block, owned, low.astype(np.int32), start, line, share)


def row_sums(rows: AxisWeights, blocks: Blocks, lit: tuple[int, int]) -> RowSums:
    """Return, for each `GROUP` row cells of a lens, the lines of each block that reach any of them, and the shares."""
    line_of_cell = lens_lines(rows, *lit)
    group, member = np.divmod(line_of_cell[rows.cell - lit[0]], GROUP)
    groups = int(line_of_cell[-1]) // GROUP + 1
    block, line = _block_lines(rows, blocks)
    terms = packed(block * groups + group, line, member, rows.share, (blocks.plane.size * groups, GROUP))
    some = np.flatnonzero(np.diff(terms.start))
    start = np.append(terms.start[some], terms.start[-1])
    of_block = np.searchsorted(some, groups * np.arange(blocks.plane.size + 1)).astype(np.int64)
    return RowSums(of_block, some % groups, terms._replace(start=start))


def row_terms_back(rows: AxisWeights, blocks: Blocks, first: int) -> Terms:
    """Return, for each line of a block and `GROUP` planes, the lit row cells it reaches (from `first`), and shares."""
    block, line = _block_lines(rows, blocks)
    plane, line = np.divmod(line, STRIP)
    pairs = SLAB // GROUP
    group = (block * STRIP + line) * pairs + plane // GROUP
    cell = rows.cell.astype(np.int64) - first
    return packed(group, cell, plane % GROUP, rows.share, (blocks.plane.size * STRIP * pairs, GROUP))


def _block_lines(rows: AxisWeights, blocks: Blocks) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the block of each entry of the weights across the strips, and its line, plane by plane of the block."""
    first = np.concatenate([[0], np.cumsum(blocks.planes)])
    plane, line = np.divmod(line_of(rows), STRIP)
    block = np.searchsorted(first, plane, side="right") - 1
    return block, (plane - first[block]) * STRIP + line


Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False)
class StripOperator:
    """Weights in strips.

    Attributes
    ----------
    columns : a, of the planes of one block after the other; share (entries, COEFFICIENTS) by the powers of `PLACES`
    rows : b, of the `STRIP` lines of each of these planes
    blocks : where they lie; none crosses a multiple of `SLAB` planes
    mask : (row cells, column cells) float32, C and whatever else scales the light
    order : of the lit column cells, int32: a block may have those of some tiles only
    lit : (planes, row voxels, column voxels) which voxels have light: not those outside the fluid
    turned : the strips are of columns of voxels, and rows and columns of image and volume are exchanged but in `lit`
    misfit_l1 : (samples,) how far columns of a sample of voxels are from those of traced rays, in L1
    """

    columns: AxisWeights
    rows: AxisWeights
    blocks: Blocks
    mask: NDArray[np.float32]
    order: NDArray[np.int32]
    lit: NDArray[np.bool_]
    turned: bool
    misfit_l1: NDArray[np.float64]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a volume: (planes, voxels along the rows, voxels along the columns)."""
        planes, rows, columns = self.lit.shape
        return planes, rows, columns

    @property
    def image_shape(self) -> tuple[int, int]:
        """Shape of an image."""
        rows, columns = self.rows.pixels, self.columns.pixels
        return (columns, rows) if self.turned else (rows, columns)

    def forward(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image (rows, columns) of a volume."""
        ensure_own_threads()
        lines = self._as_lines(real_array(volume, self.shape, "a volume") * self.lit)
        turned = kernels.turned(lines, (lines.shape[2], self._height))
        by_cell = strip_kernels.project(turned, self.blocks, self._columns_forward, self._rows_forward, self._groups)
        shape = self.rows.pixels, self.columns.pixels
        image = strip_kernels.fold(by_cell, self.mask, self._cells, self._lines_of_rows, shape)
        return np.ascontiguousarray(image.T) if self.turned else image

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the volume that an image is spread back to."""
        ensure_own_threads()
        image = real_array(image, self.image_shape, "an image")
        seen = np.ascontiguousarray(image.T) if self.turned else image
        by_cell = strip_kernels.unfold(seen, self._sorted_mask, self._cells, self._lit_rows, self.rows.cells.pixel)
        lines, along = self._as_lines(self.lit).shape[1:]
        shape = len(self.lit), along, self._height
        volume = strip_kernels.back_project(
            by_cell, shape, self.blocks, self._rows_back, self._columns_back, get_num_threads()
        )
        return np.ascontiguousarray(self._as_lines(kernels.turned(volume, (lines, along)))) * self.lit

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        """Return the rows, columns (int64) and weights (float32) of the pixels that one voxel lights."""
        plane, row_voxel, column_voxel = voxel_index((plane, row_voxel, column_voxel), self.shape)
        image = np.zeros(self.image_shape, np.float32)
        seen = image.T if self.turned else image
        line, along = (column_voxel, row_voxel) if self.turned else (row_voxel, column_voxel)
        if self.lit[plane, row_voxel, column_voxel]:
            for virtual, within in self._planes_of(plane, line):
                row, across = self.rows.row(virtual, within)
                column, share = self.columns.row(virtual, along)
                by_cell = np.outer(across, shares_of(share, within)) * self.mask[np.ix_(row, column)]
                pixels = np.ix_(self.rows.cells.pixel[row], self.columns.cells.pixel[column])
                np.add.at(seen, pixels, by_cell)
        lit = np.nonzero(image)
        return lit[0].astype(np.int64), lit[1].astype(np.int64), image[lit]

    def _planes_of(self, plane: int, line: int) -> list[tuple[int, int]]:
        """Return the planes of blocks that a line of voxels has, and which of their lines it is."""
        blocks, first = self.blocks, np.concatenate([[0], np.cumsum(self.blocks.planes)])
        own = (blocks.plane <= plane) & (plane < blocks.plane + blocks.planes)
        own &= (blocks.line <= line) & (line < blocks.line + STRIP)
        return [(int(first[b] + plane - blocks.plane[b]), int(line - blocks.line[b])) for b in np.flatnonzero(own)]

    def _as_lines(self, volume: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return a view of a volume whose second axis runs across the strips; its own inverse."""
        return volume.swapaxes(1, 2) if self.turned else volume

    @cached_property
    def _height(self) -> int:
        """Lines with those that the last strip has beyond the volume."""
        return int(max(self.blocks.line.max(initial=0) + STRIP, self._as_lines(self.lit).shape[1]))

    @cached_property
    def _lit_rows(self) -> tuple[int, int]:
        return lit_range(self.rows.cell)

    @cached_property
    def _cells(self) -> SortedCells:
        return cells_in_order(self.columns.cells, self.order)

    @cached_property
    def _sorted_mask(self) -> NDArray[np.float32]:
        return np.ascontiguousarray(self.mask[:, self.order])

    @cached_property
    def _lines_of_rows(self) -> LitRows:
        return rows_of_pixels(self.rows, *self._lit_rows)

    @cached_property
    def _groups(self) -> int:
        return int(self._lines_of_rows.line.max(initial=-1)) // GROUP + 1

    @cached_property
    def _columns_forward(self) -> VisitsForward:
        return visits_forward(self.columns, self.order, self.blocks)

    @cached_property
    def _columns_back(self) -> VisitsBack:
        return visits_back(self.columns, self.order, self.blocks, len(self.lit))

    @cached_property
    def _rows_forward(self) -> RowSums:
        return row_sums(self.rows, self.blocks, self._lit_rows)

    @cached_property
    def _rows_back(self) -> Terms:
        return row_terms_back(self.rows, self.blocks, self._lit_rows[0])


def shares_of(coefficients: NDArray[np.float32], line: int) -> NDArray[np.float32]:
    """Return the shares (n,) that one line of a strip has, of coefficients (n, COEFFICIENTS)."""
    t = PLACES[line]
    return np.asarray(np.maximum(coefficients[:, 0] + t * (coefficients[:, 1] + t * coefficients[:, 2]), 0.0))
