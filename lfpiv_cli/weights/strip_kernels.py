"""The compiled loops of weights in strips; `strips` holds their readable twins, `kernels` says how the loops are built.

A strip is `STRIP` neighbouring lines of voxels, worked on together, in up to `SLAB` planes: a block. Along the lines
the weights change with a line's place in the strip, across them each line and plane has its own. A block may have the
light through a part of the aperture only. Where a tile of column cells and a block meet is a visit.

Arrays: float32. Volumes are turned (planes, voxels along, lines), `by_cell` is (tiles, row lines, TILE).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.simd import (
    COEFFICIENTS,
    GROUP,
    LANES,
    TILE,
    VECTORS,
    combine_long,
    combine_turned_varying,
    combine_varying,
    turn,
)
from lfpiv_cli.threads import in_threads, share_out
from lfpiv_cli.weights.kernels import Floats, Index, LitRows, Terms, room_for

# Lines of a strip: those that a register holds, or two hold. And planes: what a block has of a tile stays in the cache.
STRIP, SLAB = 16, 8
# Where each line lies in its strip, from -1 to 1.
PLACES = np.linspace(-1.0, 1.0, STRIP).astype(np.float32)


class Blocks(NamedTuple):
    """Where each block lies.

    Attributes
    ----------
    plane, planes, line : (blocks,) int64, its first plane, how many it has, and its first line
    """

    plane: Index
    planes: Index
    line: Index


class VisitsForward(NamedTuple):
    """The weights along the lines for `LANES` column cells at once.

    Attributes
    ----------
    of_tile : (tiles + 1,) int64, the first visit of each tile
    block : (visits,) int64
    start : (visits * SLAB * VECTORS + 1,) int64, the first row of each plane and vector
    voxel : (visits * SLAB * TILE,) int32, the first voxel of each cell
    share : (rows, COEFFICIENTS, LANES) float32, row by row those of the next voxel
    """

    of_tile: Index
    block: Index
    start: Index
    voxel: NDArray[np.int32]
    share: Floats


class RowSums(NamedTuple):
    """The weights across the strips, for `GROUP` row cells at once.

    Attributes
    ----------
    of_block : (blocks + 1,) int64, the first sum of each block
    group : (sums,) int64, the group of row cells
    terms : of each sum; line p STRIP + k is line k of the strip in the block's plane p
    """

    of_block: Index
    group: Index
    terms: Terms


class VisitsBack(NamedTuple):
    """The weights along the lines for the voxels that a tile lights.

    Attributes
    ----------
    of_tile : (tiles * slabs + 1,) int64, the first visit of each tile and slab of planes
    block : (visits,) int64
    owned : (visits * SLAB + 1,) int64, the first sum of each plane of each visit
    voxel : (visits * SLAB,) int32, the voxel of this sum; the others follow one by one
    start, line, share : the first term of each sum, and cell and coefficients (terms, COEFFICIENTS) of each
    """

    of_tile: Index
    block: Index
    owned: Index
    voxel: NDArray[np.int32]
    start: Index
    line: NDArray[np.int32]
    share: Floats


class SortedCells(NamedTuple):
    """The lit column cells in the order in which `by_cell` has them.

    Attributes
    ----------
    order : (cells,) int32, which cell each is
    pixel : (cells,) int32, its pixel
    lenses : (lenses, 3) int64, of each lens the first cell that may be lit, its pixel, and how many follow
    """

    order: NDArray[np.int32]
    pixel: NDArray[np.int32]
    lenses: Index


def project(volume: Floats, blocks: Blocks, columns: VisitsForward, rows: RowSums, groups: int) -> Floats:
    """Return the light by cells (tiles, groups * GROUP, TILE) of a turned volume."""
    tiles = columns.of_tile.size - 1
    flat_cell = room_for(tiles * groups * GROUP * TILE)
    share_out(_project_tiles, tiles, volume, blocks, columns, rows, groups, PLACES, flat_cell)
    return flat_cell.reshape(tiles, groups * GROUP, TILE)


@njit(cache=True, nogil=True)
def _project_tiles(
    part: tuple[int, int],
    volume: Floats,
    blocks: Blocks,
    columns: VisitsForward,
    rows: RowSums,
    groups: int,
    places: Floats,
    flat_cell: Floats,
) -> None:
    """Write a part of the tiles of `project`."""
    width, height = volume.shape[1:]
    flat_volume, share = volume.reshape(-1), columns.share.reshape(-1)
    row_start, row_line, row_share = rows.terms.start, rows.terms.line, rows.terms.share.reshape(-1)
    start, voxel = columns.start, columns.voxel
    lines = room_for(SLAB * STRIP * TILE)
    for tile in range(part[0], part[1]):
        flat_cell[tile * groups * GROUP * TILE : (tile + 1) * groups * GROUP * TILE] = 0.0
        for visit in range(columns.of_tile[tile], columns.of_tile[tile + 1]):
            block = columns.block[visit]
            for p in range(blocks.planes[block]):
                source = (blocks.plane[block] + p) * width * height + blocks.line[block]
                for v in range(VECTORS):
                    at = (visit * SLAB + p) * VECTORS + v
                    for y in range(0, STRIP, LANES):
                        to = ((p * STRIP + y) * TILE + v * LANES, TILE)
                        terms = (source + y, height, at * LANES, start[at + 1] - start[at])
                        shares = start[at] * COEFFICIENTS * LANES
                        combine_turned_varying(lines, to, flat_volume, voxel, terms, share, shares, places, y)
            for n in range(rows.of_block[block], rows.of_block[block + 1]):
                to_cell = ((tile * groups + rows.group[n]) * GROUP * TILE, TILE, 1)
                row_terms = (0, TILE, row_start[n], row_start[n + 1] - row_start[n])
                combine_long(
                    flat_cell, to_cell, lines, row_line, row_terms, row_share, (row_start[n] * GROUP, GROUP, 1)
                )


def back_project(
    by_cell: Floats, shape: tuple[int, int, int], blocks: Blocks, rows: Terms, columns: VisitsBack, threads: int
) -> Floats:
    """Return the turned volume of `shape` that light by cells (tiles, row cells, TILE) is spread back to.

    Each block has for each line of the strip SLAB / GROUP sums in `rows`, whose terms are lines of `by_cell`.
    """
    volume = np.zeros(shape, np.float32)
    tiles = by_cell.shape[0]
    slabs = (columns.of_tile.size - 1) // tiles
    visits = np.diff(columns.of_tile).reshape(tiles, slabs).sum(axis=0)
    # A thread takes a tile through all of its planes, so that the cells come into its cache once.
    ends = np.searchsorted(np.cumsum(visits), visits.sum() * np.arange(1, threads) / threads)
    edges = [0, *ends.tolist(), slabs]
    in_threads(
        lambda part: _back_project_slabs(part, by_cell, volume, blocks, rows, columns, PLACES),
        list(zip(edges, edges[1:], strict=False)),
    )
    return volume


@njit(cache=True, nogil=True)
def _back_project_slabs(
    part: tuple[int, int],
    by_cell: Floats,
    volume: Floats,
    blocks: Blocks,
    rows: Terms,
    columns: VisitsBack,
    places: Floats,
) -> None:
    """Write a part of the volume of `back_project`, counted in slabs of planes."""
    width, height = volume.shape[1:]
    tiles, size = by_cell.shape[0], by_cell.shape[1] * TILE
    slabs = (columns.of_tile.size - 1) // tiles
    flat_cell, flat_volume = by_cell.reshape(-1), volume.reshape(-1)
    row_start, row_line, row_share = rows.start, rows.line, rows.share.reshape(-1)
    start, line, share = columns.start, columns.line, columns.share.reshape(-1)
    pairs = SLAB // GROUP
    lines, cells = room_for(SLAB * STRIP * TILE), room_for(TILE * STRIP)
    for tile in range(tiles):
        for visit in range(columns.of_tile[tile * slabs + part[0]], columns.of_tile[tile * slabs + part[1]]):
            block = columns.block[visit]
            for k in range(STRIP):
                for pair in range(pairs):
                    at = (block * STRIP + k) * pairs + pair
                    to = ((pair * GROUP * STRIP + k) * TILE, STRIP * TILE, 0)
                    terms = (tile * size, TILE, row_start[at], row_start[at + 1] - row_start[at])
                    combine_long(lines, to, flat_cell, row_line, terms, row_share, (row_start[at] * GROUP, GROUP, 1))
            for p in range(blocks.planes[block]):
                for y in range(0, STRIP, LANES):
                    for v in range(0, TILE, LANES):
                        turn(cells, (v * STRIP + y, STRIP), lines, ((p * STRIP + y) * TILE + v, TILE))
                owner = visit * SLAB + p
                to_voxel = ((blocks.plane[block] + p) * width + columns.voxel[owner]) * height + blocks.line[block]
                for n in range(columns.owned[owner], columns.owned[owner + 1]):
                    shares = start[n] * COEFFICIENTS
                    for y in range(0, STRIP, LANES):
                        sums = (y, STRIP, start[n], start[n + 1] - start[n])
                        combine_varying(flat_volume, to_voxel + y, cells, line, sums, share, shares, places, y)
                    to_voxel += height


def fold(by_cell: Floats, mask: Floats, cells: SortedCells, rows: LitRows, shape: tuple[int, int]) -> Floats:
    """Return the image (rows, columns) of `shape`: C times the light of each lit cell, added up by pixel."""
    image = np.empty(shape, np.float32)
    share_out(_fold_rows, shape[0], by_cell, mask, cells, rows, image)
    return image


@njit(cache=True, nogil=True)
def _fold_rows(
    part: tuple[int, int], by_cell: Floats, mask: Floats, cells: SortedCells, rows: LitRows, image: Floats
) -> None:
    """Write a part of the image rows of `fold`: the cells back in their own order, then lens by lens."""
    ordered, order, lenses = np.zeros(mask.shape[1], np.float32), cells.order, cells.lenses
    for row in range(part[0], part[1]):
        target = image[row]
        target[:] = 0.0
        for at in range(rows.start[row], rows.start[row + 1]):
            weight, line = mask[rows.cell[at]], rows.line[at]
            for first in range(0, order.size, TILE):
                source = by_cell[first // TILE, line]
                for k in range(min(TILE, order.size - first)):
                    ordered[order[first + k]] = source[k]
            for lens in range(lenses.shape[0]):
                cell, pixel, count = lenses[lens]
                for k in range(count):
                    target[pixel + k] += weight[cell + k] * ordered[cell + k]


def unfold(
    image: Floats, mask: Floats, cells: SortedCells, rows: tuple[int, int], row_pixel: NDArray[np.int32]
) -> Floats:
    """Return C times the pixel that each lit cell belongs to, (tiles, lit row cells, TILE).

    `mask` (row cells, cells) is that of the sorted column cells.
    """
    tiles, lines = -(-cells.order.size // TILE), rows[1] - rows[0]
    by_cell = room_for(tiles * lines * TILE).reshape(tiles, lines, TILE)
    by_cell[-1:] = 0.0
    share_out(_unfold_lines, lines, image, mask, cells.pixel, row_pixel[rows[0] : rows[1]], rows[0], by_cell)
    return by_cell


@njit(cache=True, nogil=True)
def _unfold_lines(
    part: tuple[int, int],
    image: Floats,
    mask: Floats,
    pixel: NDArray[np.int32],
    row_pixel: NDArray[np.int32],
    first: int,
    by_cell: Floats,
) -> None:
    """Write a part of the lit row cells of `unfold`, the first of which is row cell `first`."""
    for line in range(part[0], part[1]):
        source, weight = image[row_pixel[line]], mask[first + line]
        for begin in range(0, pixel.size, TILE):
            target = by_cell[begin // TILE, line]
            for k in range(min(TILE, pixel.size - begin)):
                target[k] = weight[begin + k] * source[pixel[begin + k]]
