"""The tables of weights in strips as the compiled loops want them, from the weights along each axis.

Column cells are sorted by which part of the aperture they see, so that those of a tile see the same: light through one
part then comes from some of the tiles only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.simd.combine import GROUP, TILE
from lfpiv_cli.simd.combine_varying import COEFFICIENTS
from lfpiv_cli.simd.vectors import LANES
from lfpiv_cli.weights.axis import AxisWeights
from lfpiv_cli.weights.axis_cells import Cells
from lfpiv_cli.weights.kernels import Index, Terms
from lfpiv_cli.weights.operators import filled, lens_lines, line_of, packed, spans
from lfpiv_cli.weights.strip_kernels import SLAB, STRIP, Blocks, RowSums, SortedCells, VisitsBack, VisitsForward

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
