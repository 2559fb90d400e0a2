"""The compiled loops of separated weights; `operators` and `strips` hold their readable twins.

Every step is one form, some lines as sums of many (`simd`). The volume is cut into blocks, some neighbouring lines of
voxels in some planes, with two factors each: all lines where the weights factorise as a whole, `STRIP` lines behind
curved faces. The lit column cells are cut into tiles. Where a tile and a block meet is a visit, and it goes through
both steps, along the columns and along the rows, while it is in the cache. Registers hold neighbouring cells of the
columns in the sums over the rows, and neighbouring voxels of the rows in the sums over the columns: so neither has
terms that are zero; what is between them is turned. Each output element is one sum in a fixed order, so the result does
not depend on the number of threads, nor on how many numbers a register holds.

Along the lines weights may change with a line's place in its strip: such have `COEFFICIENTS`, others one number.

Arrays: float32. Volumes are turned (planes, voxels along the columns, lines), the lines filled up to a multiple of
`LANES`; `by_cell` is (tiles, row lines, TILE).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Integers, Singles
from lfpiv_cli.kernels import njit
from lfpiv_cli.simd import (
    COEFFICIENTS,
    GROUP,
    LANES,
    TILE,
    VECTORS,
    combine_line,
    combine_long,
    combine_turned,
    combine_turned_varying,
    combine_varying,
    combine_vector,
    turn,
)
from lfpiv_cli.threads import share_out

# Lines of a strip: those that a register holds, or two hold. And planes: what a block has of a tile stays in the cache.
STRIP, SLAB = 16, 8
# Where each line lies in its strip, from -1 to 1.
PLACES = np.linspace(-1.0, 1.0, STRIP).astype(np.float32)
# Numbers in a line of the cache.
CACHE_LINE = 16


class Blocks(NamedTuple):
    """Where each block lies.

    Attributes
    ----------
    plane, planes, line : (blocks,) int64, its first plane, how many it has, and its first line
    """

    plane: Integers
    planes: Integers
    line: Integers


class BlockShape(NamedTuple):
    """How many planes a block has at most, a multiple of `GROUP`, and how many lines, a multiple of `LANES`."""

    planes: int
    lines: int


class Terms(NamedTuple):
    """Sums of lines, some of them sharing their terms.

    Attributes
    ----------
    start : (sums + 1,) int64, the first term of each sum
    line : (terms,) int32, the line that each term takes
    share : (terms, sums that share it) float32, its share in each
    """

    start: Integers
    line: NDArray[np.int32]
    share: Singles


class VisitsForward(NamedTuple):
    """The weights along the lines for `LANES` column cells at once.

    Attributes
    ----------
    of_tile : (tiles + 1,) int64, the first visit of each tile
    block : (visits,) int64
    start : (visits * planes of a block * VECTORS + 1,) int64, the first row of each plane and vector
    voxel : (visits * planes of a block * TILE,) int32, the first voxel of each cell
    share : (rows, coefficients, LANES) float32, row by row those of the next voxel
    """

    of_tile: Integers
    block: Integers
    start: Integers
    voxel: NDArray[np.int32]
    share: Singles


class RowSums(NamedTuple):
    """The weights across the lines, for `GROUP` row cells at once.

    Attributes
    ----------
    of_block : (blocks + 1,) int64, the first sum of each block
    group : (sums,) int64, the group of row cells
    terms : of each sum; line p * lines of a block + k is line k in the block's plane p
    """

    of_block: Integers
    group: Integers
    terms: Terms


class VisitsBack(NamedTuple):
    """The weights along the lines for the voxels that a tile lights.

    Attributes
    ----------
    of_tile : (tiles * slabs + 1,) int64, the first visit of each tile and slab, as many planes as a block may have
    block : (visits,) int64
    owned : (visits * planes of a block + 1,) int64, the first sum of each plane of each visit
    voxel : (visits * planes of a block,) int32, the voxel of this sum; the others follow one by one
    start, line, share : the first term of each sum, and cell and coefficients (terms, coefficients) of each
    """

    of_tile: Integers
    block: Integers
    owned: Integers
    voxel: NDArray[np.int32]
    start: Integers
    line: NDArray[np.int32]
    share: Singles


class LitRows(NamedTuple):
    """The lit row cells in the order of their pixels.

    Attributes
    ----------
    start : (rows + 1,) int64, the first cell of each pixel
    cell : (lit cells,) int64
    line : (lit cells,) int64, the line of `by_cell` that each has
    """

    start: Integers
    cell: Integers
    line: Integers


@njit(cache=True)
def room_for(size: int) -> Singles:
    """Return room for numbers that begins with a line of the cache: a load across two of these takes twice as long."""
    room = np.empty(size + CACHE_LINE, np.float32)
    skipped = -(room.ctypes.data // room.itemsize) % CACHE_LINE
    return room[skipped : skipped + size]


def turned(volume: Singles, shape: tuple[int, int]) -> Singles:
    """Return a volume (planes, rows, columns) as (planes, columns, rows), cut or filled up with zeros to `shape`."""
    found = np.zeros((volume.shape[0], *shape), np.float32)
    share_out(_turn_planes, len(volume), volume, found)
    return found


@njit(cache=True, nogil=True)
def _turn_planes(part: tuple[int, int], volume: Singles, found: Singles) -> None:
    """Write what a part of the planes are when turned."""
    columns, rows = min(found.shape[1], volume.shape[2]), min(found.shape[2], volume.shape[1])
    for plane in range(part[0], part[1]):
        for column in range(columns):
            for row in range(rows):
                found[plane, column, row] = volume[plane, row, column]


@njit(cache=True, nogil=True)
def project_tiles(
    part: tuple[int, int],
    volume: Singles,
    blocks: Blocks,
    shape: BlockShape,
    columns: VisitsForward,
    rows: RowSums,
    groups: int,
    places: Singles,
    flat_cell: Singles,
) -> None:
    """Write a part of the tiles of a turned volume's light by cells, flat (tiles, groups * GROUP, TILE)."""
    width, height = volume.shape[1:]
    coefficients = columns.share.shape[1]
    flat_volume, share = volume.reshape(-1), columns.share.reshape(-1)
    row_start, row_line, row_share = rows.terms.start, rows.terms.line, rows.terms.share.reshape(-1)
    start, voxel = columns.start, columns.voxel
    lines = room_for(shape.planes * shape.lines * TILE)
    for tile in range(part[0], part[1]):
        flat_cell[tile * groups * GROUP * TILE : (tile + 1) * groups * GROUP * TILE] = 0.0
        for visit in range(columns.of_tile[tile], columns.of_tile[tile + 1]):
            block = columns.block[visit]
            for p in range(blocks.planes[block]):
                source = (blocks.plane[block] + p) * width * height + blocks.line[block]
                for v in range(VECTORS):
                    at = (visit * shape.planes + p) * VECTORS + v
                    shares = start[at] * coefficients * LANES
                    for y in range(0, shape.lines, LANES):
                        to = ((p * shape.lines + y) * TILE + v * LANES, TILE)
                        terms = (source + y, height, at * LANES, start[at + 1] - start[at])
                        if coefficients == COEFFICIENTS:
                            combine_turned_varying(lines, to, flat_volume, voxel, terms, share, shares, places, y)
                        else:
                            combine_turned(lines, to, flat_volume, voxel, terms, share, shares)
            for n in range(rows.of_block[block], rows.of_block[block + 1]):
                to_cell = ((tile * groups + rows.group[n]) * GROUP * TILE, TILE, 1)
                row_terms = (0, TILE, row_start[n], row_start[n + 1] - row_start[n])
                combine_long(
                    flat_cell, to_cell, lines, row_line, row_terms, row_share, (row_start[n] * GROUP, GROUP, 1)
                )


@njit(cache=True, nogil=True)
def back_project_slabs(
    part: tuple[int, int],
    by_cell: Singles,
    volume: Singles,
    blocks: Blocks,
    shape: BlockShape,
    rows: Terms,
    columns: VisitsBack,
    places: Singles,
) -> None:
    """Add what light by cells (tiles, row cells, TILE) is spread back to, in a part of a turned volume.

    The part counts slabs of planes. Each block has for each of its lines planes / GROUP sums in `rows`, whose terms are
    lines of `by_cell`.
    """
    width, height = volume.shape[1:]
    tiles, size = by_cell.shape[0], by_cell.shape[1] * TILE
    slabs = (columns.of_tile.size - 1) // max(tiles, 1)
    coefficients = columns.share.shape[1]
    flat_cell, flat_volume = by_cell.reshape(-1), volume.reshape(-1)
    row_start, row_line, row_share = rows.start, rows.line, rows.share.reshape(-1)
    start, line, share = columns.start, columns.line, columns.share.reshape(-1)
    pairs, whole = shape.planes // GROUP, shape.lines // TILE * TILE
    lines, cells = room_for(shape.planes * shape.lines * TILE), room_for(TILE * shape.lines)
    for tile in range(tiles):
        for visit in range(columns.of_tile[tile * slabs + part[0]], columns.of_tile[tile * slabs + part[1]]):
            block = columns.block[visit]
            # One line through all planes: these see the same cells, which stay in the fastest cache.
            for k in range(shape.lines):
                for pair in range(pairs):
                    at = (block * shape.lines + k) * pairs + pair
                    to = ((pair * GROUP * shape.lines + k) * TILE, shape.lines * TILE, 0)
                    terms = (tile * size, TILE, row_start[at], row_start[at + 1] - row_start[at])
                    combine_long(lines, to, flat_cell, row_line, terms, row_share, (row_start[at] * GROUP, GROUP, 1))
            for p in range(blocks.planes[block]):
                for y in range(0, shape.lines, LANES):
                    for v in range(0, TILE, LANES):
                        turn(cells, (v * shape.lines + y, shape.lines), lines, ((p * shape.lines + y) * TILE + v, TILE))
                owner = visit * shape.planes + p
                to_voxel = ((blocks.plane[block] + p) * width + columns.voxel[owner]) * height + blocks.line[block]
                for n in range(columns.owned[owner], columns.owned[owner + 1]):
                    first, count = start[n], start[n + 1] - start[n]
                    if coefficients == COEFFICIENTS:
                        for y in range(0, shape.lines, LANES):
                            sums = (y, shape.lines, first, count)
                            shares = first * COEFFICIENTS
                            combine_varying(flat_volume, to_voxel + y, cells, line, sums, share, shares, places, y)
                    else:
                        for y in range(0, whole, TILE):
                            sums = (y, shape.lines, first, count)
                            combine_line(flat_volume, (to_voxel + y, 0, 1), cells, line, sums, share, (first, 1, 0))
                        for y in range(whole, shape.lines, LANES):
                            sums = (y, shape.lines, first, count)
                            combine_vector(flat_volume, (to_voxel + y, 0, 1), cells, line, sums, share, (first, 1, 0))
                    to_voxel += height


@njit(cache=True, nogil=True)
def fold_rows(
    part: tuple[int, int], by_cell: Singles, mask: Singles, runs: Integers, rows: LitRows, image: Singles
) -> None:
    """Write a part of the rows of the image: C times the light of each lit cell, added up by pixel.

    `runs` (runs, 5) are neighbouring column cells of a tile, and of a lens: the first one's number among all cells and
    its place among the lit, its pixel, how many they are, and whether the others follow (1) or come before (-1).
    """
    for row in range(part[0], part[1]):
        target = image[row]
        target[:] = 0.0
        for at in range(rows.start[row], rows.start[row + 1]):
            weight, line = mask[rows.cell[at]], rows.line[at]
            for run in range(runs.shape[0]):
                cell, lit, pixel, count, step = runs[run]
                source, k = by_cell[lit // TILE, line], lit % TILE
                if step > 0:
                    for n in range(count):
                        target[pixel + n] += weight[cell + n] * source[k + n]
                else:
                    for n in range(count):
                        target[pixel + n] += weight[cell + n] * source[k - n]


@njit(cache=True, nogil=True)
def unfold_lines(
    part: tuple[int, int],
    image: Singles,
    mask: Singles,
    pixel: NDArray[np.int32],
    row_pixel: NDArray[np.int32],
    first: int,
    by_cell: Singles,
) -> None:
    """Write C times the pixel that each lit cell belongs to, a part of the lit row cells of (tiles, row cells, TILE).

    `mask` (row cells, cells) and `pixel` are those of the lit column cells in their order; the first lit row cell is
    row cell `first`, and `row_pixel` has the pixels of the lit ones.
    """
    for line in range(part[0], part[1]):
        source, weight = image[row_pixel[line]], mask[first + line]
        for begin in range(0, pixel.size, TILE):
            target = by_cell[begin // TILE, line]
            for k in range(min(TILE, pixel.size - begin)):
                target[k] = weight[begin + k] * source[pixel[begin + k]]
