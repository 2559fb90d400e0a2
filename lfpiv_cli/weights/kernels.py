"""The compiled loops of the factorised operators; `operators` holds their readable twins.

Every step is one form, some lines as sums of many (`simd.combine`). The lit column cells are cut into tiles, and a tile
goes through both steps, along the columns and along the rows, some planes at a time, while these are in the cache.
Each output element is one sum in a fixed order, so the result does not depend on the number of threads, nor on how many
numbers a register holds.

Arrays: float32. `height` and `width` count the voxels along the sensor's rows and columns, the height filled up to a
multiple of `ROWS`; `by_cell` is (tiles, row lines, TILE). The steps along one axis have their tables: `RowTerms` and
`ColumnBlocks`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.simd.combine import GROUP, ROWS, TILE, VECTORS, combine_long, combine_short
from lfpiv_cli.simd.vectors import LANES

Floats = NDArray[np.float32]
Index = NDArray[np.int64]

# Planes that go through both steps together, one number forward and one back: what they hold of a tile stays in the
# second-level cache, what the neighbouring sums share of it in the first, and yet the sums over them are long.
PLANES_FORWARD, PLANES_BACK = 8, 16
# Numbers in a line of the cache.
CACHE_LINE = 16


class RowTerms(NamedTuple):
    """Sums along the rows, two lines each.

    Attributes
    ----------
    start : (sums + 1,) int64, the first term of each sum
    line : (terms,) int32, the line that each term takes
    share : (terms, GROUP) float32, its share in either line
    """

    start: NDArray[np.int64]
    line: NDArray[np.int32]
    share: NDArray[np.float32]


class ColumnBlocks(NamedTuple):
    """The weights along the columns as dense blocks of `LANES` columns, cells or voxels.

    Attributes
    ----------
    start : (blocks + 1,) int64, the first row of each block
    first : (blocks, 2) int32, the first voxel of each block, and its first cell in the tile
    share : (rows, LANES) float32
    """

    start: NDArray[np.int64]
    first: NDArray[np.int32]
    share: NDArray[np.float32]


@njit(cache=True)
def room_for(size: int) -> Floats:
    """Return room for numbers that begins with a line of the cache: a load across two of these takes twice as long."""
    room = np.empty(size + CACHE_LINE, np.float32)
    skipped = -(room.ctypes.data // room.itemsize) % CACHE_LINE
    return room[skipped : skipped + size]


@njit(cache=True, parallel=True)
def turned(volume: Floats) -> Floats:
    """Return a volume (planes, height, width) as (planes, width, height), the height filled up with zeros."""
    planes, height, width = volume.shape
    found = np.zeros((planes, width, -(-height // ROWS) * ROWS), np.float32)
    for plane in prange(planes):
        for j in range(height):
            for x in range(width):
                found[plane, x, j] = volume[plane, j, x]
    return found


@njit(cache=True, parallel=True)
def project(volume: Floats, columns: ColumnBlocks, rows: RowTerms, tiles: int) -> Floats:
    """Return sum_z B_z V_z A_z^T by cells of a volume (planes, width, filled height).

    Block (plane * tiles + tile) * VECTORS + v of `columns` has a row of `LANES` cells for each voxel. Sum g of each
    `PLANES_FORWARD` planes in `rows` gives lines g * GROUP on of `by_cell`; its terms are lines plane * height + voxel,
    planes counted from the first of these.
    """
    planes, width, height = volume.shape
    chunks = -(-planes // PLANES_FORWARD)
    sums = (rows.start.size - 1) // chunks
    flat_cell, flat_volume = room_for(tiles * GROUP * sums * TILE), volume.reshape(-1)
    block_start, block_first, block_share = columns.start, columns.first, columns.share.reshape(-1)
    start, line, share = rows.start, rows.line, rows.share.reshape(-1)
    in_turn = np.arange(width + 1).astype(np.int32)
    for tile in prange(tiles):
        lines = room_for(PLANES_FORWARD * height * TILE)
        for chunk in range(chunks):
            first = chunk * PLANES_FORWARD
            for plane in range(first, min(first + PLANES_FORWARD, planes)):
                for v in range(VECTORS):
                    block = (plane * tiles + tile) * VECTORS + v
                    terms = (block_start[block] * LANES, 0, block_start[block + 1] - block_start[block])
                    to, voxels = (plane - first) * height * TILE + v * LANES, plane * width + block_first[block, 0]
                    for j in range(0, height, ROWS):
                        shares = (voxels * height + j, height, 1)
                        combine_short(lines, (to + j * TILE, TILE, 0), block_share, in_turn, terms, flat_volume, shares)
            for g in range(sums):
                at = chunk * sums + g
                to = (tile * sums + g) * GROUP * TILE
                terms = (0, start[at], start[at + 1] - start[at])
                combine_long(flat_cell, (to, TILE, chunk), lines, line, terms, share, (start[at] * GROUP, GROUP, 1))
    return flat_cell.reshape(tiles, GROUP * sums, TILE)


@njit(cache=True, parallel=True)
def back_project(
    by_cell: Floats, shape: tuple[int, int, int], rows: RowTerms, columns: ColumnBlocks, owned: Index
) -> Floats:
    """Return B_z^T I A_z as a volume of `shape` (planes, filled height, width of at least `LANES`).

    Each `PLANES_BACK` planes have for each voxel PLANES_BACK / GROUP sums in `rows`, whose terms are lines of
    `by_cell`. Block b of `columns` has a row of `LANES` voxels for each cell; plane * tiles + tile owns blocks
    owned[...] to owned[... + 1].
    """
    planes, height, width = shape
    tiles, size = by_cell.shape[0], by_cell.shape[1] * TILE
    volume = np.zeros(shape, np.float32)
    flat_cell, flat_volume = by_cell.reshape(-1), volume.reshape(-1)
    block_start, block_first, block_share = columns.start, columns.first, columns.share.reshape(-1)
    start, line, share = rows.start, rows.line, rows.share.reshape(-1)
    in_turn = np.arange(TILE).astype(np.int32)
    pairs = PLANES_BACK // GROUP
    for chunk in prange(-(-planes // PLANES_BACK)):
        first = chunk * PLANES_BACK
        lines = room_for(PLANES_BACK * height * TILE)
        for tile in range(tiles):
            # One voxel through all planes: these see the same cells, which stay in the fastest cache.
            for voxel in range(height):
                for pair in range(pairs):
                    at = (chunk * height + voxel) * pairs + pair
                    to = ((pair * GROUP * height + voxel) * TILE, height * TILE, 0)
                    terms = (tile * size, start[at], start[at + 1] - start[at])
                    combine_long(lines, to, flat_cell, line, terms, share, (start[at] * GROUP, GROUP, 1))
            for plane in range(first, min(first + PLANES_BACK, planes)):
                for b in range(owned[plane * tiles + tile], owned[plane * tiles + tile + 1]):
                    terms = (block_start[b] * LANES, 0, block_start[b + 1] - block_start[b])
                    to, cells = plane * height * width + block_first[b, 0], (plane - first) * height * TILE
                    for j in range(0, height, ROWS):
                        shares = (cells + j * TILE + block_first[b, 1], 1, TILE)
                        onto = (to + j * width, width, 1)
                        combine_short(flat_volume, onto, block_share, in_turn, terms, lines, shares)
    return volume


@njit(cache=True, parallel=True)
def fold(
    by_cell: Floats,
    mask: Floats,
    columns: tuple[int, int],
    column_pixel: NDArray[np.int32],
    row_cell: Index,
    row_line: Index,
    row_start: Index,
    image: Floats,
) -> None:
    """Add to an image (rows, columns): C times the light of each lit cell, added up by pixel.

    `columns` bounds the lit column cells. `row_cell` holds the lit row cells in the order of their pixels, `row_line`
    their lines, `row_start` (rows + 1,) where each pixel's begin.
    """
    for row in prange(row_start.size - 1):
        target = image[row]
        for at in range(row_start[row], row_start[row + 1]):
            weight, line = mask[row_cell[at]], row_line[at]
            for tile in range(by_cell.shape[0]):
                source = by_cell[tile, line]
                first = columns[0] + tile * TILE
                for k in range(min(TILE, columns[1] - first)):
                    target[column_pixel[first + k]] += weight[first + k] * source[k]


@njit(cache=True, parallel=True)
def unfold(
    image: Floats,
    mask: Floats,
    rows: tuple[int, int],
    columns: tuple[int, int],
    row_pixel: NDArray[np.int32],
    column_pixel: NDArray[np.int32],
) -> Floats:
    """Return C times the pixel that each lit cell belongs to, (tiles, lit row cells, TILE)."""
    tiles = -(-(columns[1] - columns[0]) // TILE)
    lines = rows[1] - rows[0]
    by_cell = room_for(tiles * lines * TILE).reshape(tiles, lines, TILE)
    for line in prange(lines):
        source, weight = image[row_pixel[rows[0] + line]], mask[rows[0] + line]
        for tile in range(tiles):
            target = by_cell[tile, line]
            first = columns[0] + tile * TILE
            lit = min(TILE, columns[1] - first)
            for k in range(lit):
                target[k] = weight[first + k] * source[column_pixel[first + k]]
            target[lit:] = 0.0
    return by_cell
