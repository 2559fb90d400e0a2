"""The compiled loops of the factorised operators; `operators` holds their readable twins.

Every step is one form, some lines as sums of many (`simd.combine`). The lit column cells are cut into tiles, and a tile
goes through both steps, along the columns and along the rows, some planes at a time, while these are in the cache.
Registers hold neighbouring cells of the columns in the sums over the rows, and neighbouring voxels of the rows in the
sums over the columns: so neither has terms that are zero; what is between them is turned.
Each output element is one sum in a fixed order, so the result does not depend on the number of threads, nor on how many
numbers a register holds.

Arrays: float32. `height` and `width` count the voxels along the sensor's rows and columns, the height filled up to a
multiple of `LANES`; `by_cell` is (tiles, row lines, TILE). The steps along one axis have their tables: `Terms` along
the rows, `CellBlocks` and `VoxelSums` along the columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.simd import (
    GROUP,
    LANES,
    TILE,
    VECTORS,
    combine_line,
    combine_long,
    combine_turned,
    combine_vector,
    turn,
)
from lfpiv_cli.threads import in_threads, share_out

Floats = NDArray[np.float32]
Index = NDArray[np.int64]

# Planes that go through both steps together, one number forward and one back: what they hold of a tile stays in the
# second-level cache, what the neighbouring sums share of it in the first, and yet the sums over them are long.
PLANES_FORWARD, PLANES_BACK = 8, 16
# Numbers in a line of the cache.
CACHE_LINE = 16


class Terms(NamedTuple):
    """Sums of lines, some of them sharing their terms.

    Attributes
    ----------
    start : (sums + 1,) int64, the first term of each sum
    line : (terms,) int32, the line that each term takes
    share : (terms, sums that share it) float32, its share in each
    """

    start: NDArray[np.int64]
    line: NDArray[np.int32]
    share: NDArray[np.float32]


class CellBlocks(NamedTuple):
    """The weights along the columns for `LANES` cells at once: as many neighbouring voxels for each.

    Attributes
    ----------
    start : (blocks + 1,) int64, the first row of each block
    voxel : (blocks * LANES,) int32, the first voxel of each cell
    share : (rows, LANES) float32, row by row that of the next voxel
    """

    start: NDArray[np.int64]
    voxel: NDArray[np.int32]
    share: NDArray[np.float32]


class LitRows(NamedTuple):
    """The lit row cells in the order of their pixels.

    Attributes
    ----------
    start : (rows + 1,) int64, the first cell of each pixel
    cell : (lit cells,) int64
    line : (lit cells,) int64, the line of `by_cell` that each has
    """

    start: Index
    cell: Index
    line: Index


class VoxelSums(NamedTuple):
    """The weights along the columns for the voxels that a tile of cells lights in a plane, its lines being cells.

    Attributes
    ----------
    owned : (tiles * planes + 1,) int64, the first sum of each tile and plane
    voxel : (tiles * planes,) int32, the voxel of this sum; the others follow one by one
    start, line, share : of `Terms`, one share a term
    """

    owned: NDArray[np.int64]
    voxel: NDArray[np.int32]
    start: NDArray[np.int64]
    line: NDArray[np.int32]
    share: NDArray[np.float32]


@njit(cache=True)
def room_for(size: int) -> Floats:
    """Return room for numbers that begins with a line of the cache: a load across two of these takes twice as long."""
    room = np.empty(size + CACHE_LINE, np.float32)
    skipped = -(room.ctypes.data // room.itemsize) % CACHE_LINE
    return room[skipped : skipped + size]


def turned(volume: Floats, shape: tuple[int, int]) -> Floats:
    """Return a volume (planes, rows, columns) as (planes, columns, rows), cut or filled up with zeros to `shape`."""
    found = np.zeros((volume.shape[0], *shape), np.float32)
    share_out(_turn_planes, len(volume), volume, found)
    return found


@njit(cache=True, nogil=True)
def _turn_planes(part: tuple[int, int], volume: Floats, found: Floats) -> None:
    """Write what a part of the planes are when turned."""
    columns, rows = min(found.shape[1], volume.shape[2]), min(found.shape[2], volume.shape[1])
    for plane in range(part[0], part[1]):
        for column in range(columns):
            for row in range(rows):
                found[plane, column, row] = volume[plane, row, column]


def project(volume: Floats, columns: CellBlocks, rows: Terms, tiles: int) -> Floats:
    """Return sum_z B_z V_z A_z^T by cells of a volume (planes, width, filled height).

    Block (tile * planes + plane) * VECTORS + v of `columns` has the cells of vector v. Sum g of each `PLANES_FORWARD`
    planes in `rows` gives lines g * GROUP on of `by_cell`; its terms are lines plane * height + voxel, planes counted
    from the first of these.
    """
    sums = (rows.start.size - 1) // -(-volume.shape[0] // PLANES_FORWARD)
    flat_cell = room_for(tiles * GROUP * sums * TILE)
    share_out(_project_tiles, tiles, volume, columns, rows, flat_cell)
    return flat_cell.reshape(tiles, GROUP * sums, TILE)


@njit(cache=True, nogil=True)
def _project_tiles(part: tuple[int, int], volume: Floats, columns: CellBlocks, rows: Terms, flat_cell: Floats) -> None:
    """Write a part of the tiles of `project`."""
    planes, width, height = volume.shape
    chunks = -(-planes // PLANES_FORWARD)
    sums = (rows.start.size - 1) // chunks
    flat_volume = volume.reshape(-1)
    block_start, block_voxel, block_share = columns.start, columns.voxel, columns.share.reshape(-1)
    start, line, share = rows.start, rows.line, rows.share.reshape(-1)
    lines = room_for(PLANES_FORWARD * height * TILE)
    for tile in range(part[0], part[1]):
        lit_chunks = 0
        for chunk in range(chunks):
            first = chunk * PLANES_FORWARD
            last = min(first + PLANES_FORWARD, planes)
            if block_start[(tile * planes + first) * VECTORS] == block_start[(tile * planes + last) * VECTORS]:
                continue
            for plane in range(first, last):
                for v in range(VECTORS):
                    block = (tile * planes + plane) * VECTORS + v
                    count = block_start[block + 1] - block_start[block]
                    for y in range(0, height, LANES):
                        to = (((plane - first) * height + y) * TILE + v * LANES, TILE)
                        terms = (plane * width * height + y, height, block * LANES, count)
                        shares = block_start[block] * LANES
                        combine_turned(lines, to, flat_volume, block_voxel, terms, block_share, shares)
            for g in range(sums):
                at = chunk * sums + g
                if lit_chunks > 0 and start[at] == start[at + 1]:
                    continue
                to = (tile * sums + g) * GROUP * TILE
                terms = (0, TILE, start[at], start[at + 1] - start[at])
                combine_long(
                    flat_cell, (to, TILE, lit_chunks), lines, line, terms, share, (start[at] * GROUP, GROUP, 1)
                )
            lit_chunks += 1
        if lit_chunks == 0:
            flat_cell[tile * sums * GROUP * TILE : (tile + 1) * sums * GROUP * TILE] = 0.0


def back_project(by_cell: Floats, shape: tuple[int, int, int], rows: Terms, columns: VoxelSums, threads: int) -> Floats:
    """Return B_z^T I A_z as a volume of `shape` (planes, width, filled height).

    Each `PLANES_BACK` planes have for each voxel PLANES_BACK / GROUP sums in `rows`, whose terms are lines of
    `by_cell`. Tile * planes + plane owns sums in `columns`.
    """
    volume = np.zeros(shape, np.float32)
    chunks = -(-shape[0] // PLANES_BACK)
    # A thread takes a tile through all of its planes, so that the cells come into its cache once.
    in_threads(
        lambda part: _back_project_planes(part, by_cell, volume, rows, columns),
        [(thread * chunks // threads, (thread + 1) * chunks // threads) for thread in range(threads)],
    )
    return volume


@njit(cache=True, nogil=True)
def _back_project_planes(
    part: tuple[int, int], by_cell: Floats, volume: Floats, rows: Terms, columns: VoxelSums
) -> None:
    """Write a part of the volume of `back_project`, counted in `PLANES_BACK` planes."""
    planes, width, height = volume.shape
    tiles, size = by_cell.shape[0], by_cell.shape[1] * TILE
    flat_cell, flat_volume = by_cell.reshape(-1), volume.reshape(-1)
    start, line, share = rows.start, rows.line, rows.share.reshape(-1)
    pairs = PLANES_BACK // GROUP
    lines, cells = room_for(PLANES_BACK * height * TILE), room_for(TILE * height)
    for tile in range(tiles):
        for chunk in range(part[0], part[1]):
            first = chunk * PLANES_BACK
            last = min(first + PLANES_BACK, planes)
            if columns.owned[tile * planes + first] == columns.owned[tile * planes + last]:
                continue
            # One voxel through all planes: these see the same cells, which stay in the fastest cache.
            for voxel in range(height):
                for pair in range(pairs):
                    at = (chunk * height + voxel) * pairs + pair
                    to = ((pair * GROUP * height + voxel) * TILE, height * TILE, 0)
                    terms = (tile * size, TILE, start[at], start[at + 1] - start[at])
                    combine_long(lines, to, flat_cell, line, terms, share, (start[at] * GROUP, GROUP, 1))
            for plane in range(first, last):
                for y in range(0, height, LANES):
                    for v in range(0, TILE, LANES):
                        source = (((plane - first) * height + y) * TILE + v, TILE)
                        turn(cells, (v * height + y, height), lines, source)
                owner = tile * planes + plane
                to_voxel = (plane * width + columns.voxel[owner]) * height
                _add_voxels(flat_volume, to_voxel, cells, height, columns, owner)


@njit(cache=True)
def _add_voxels(volume: Floats, at: int, cells: Floats, height: int, columns: VoxelSums, owner: int) -> None:
    """Add to lines of `height` voxels, from place `at` in the flat volume on, the sums over cells that `owner` has."""
    start, line, share = columns.start, columns.line, columns.share.reshape(-1)
    whole = height // TILE * TILE
    for n in range(columns.owned[owner], columns.owned[owner + 1]):
        first, count = start[n], start[n + 1] - start[n]
        for y in range(0, whole, TILE):
            combine_line(volume, (at + y, 0, 1), cells, line, (y, height, first, count), share, (first, 1, 0))
        for y in range(whole, height, LANES):
            combine_vector(volume, (at + y, 0, 1), cells, line, (y, height, first, count), share, (first, 1, 0))
        at += height


def fold(by_cell: Floats, mask: Floats, runs: Index, rows: LitRows, shape: tuple[int, int]) -> Floats:
    """Return the image (rows, columns) of `shape`: C times the light of each lit cell, added up by pixel.

    `runs` (runs, 4) are neighbouring column cells of a tile, and of a lens: the first one's number among all cells and
    among the lit, its pixel, and how many they are.
    """
    image = np.empty(shape, np.float32)
    share_out(_fold_rows, shape[0], by_cell, mask, runs, rows, image)
    return image


@njit(cache=True, nogil=True)
def _fold_rows(part: tuple[int, int], by_cell: Floats, mask: Floats, runs: Index, rows: LitRows, image: Floats) -> None:
    """Write a part of the image rows of `fold`."""
    for row in range(part[0], part[1]):
        target = image[row]
        target[:] = 0.0
        for at in range(rows.start[row], rows.start[row + 1]):
            weight, line = mask[rows.cell[at]], rows.line[at]
            for run in range(runs.shape[0]):
                cell, lit, pixel, count = runs[run]
                source, k = by_cell[lit // TILE, line], lit % TILE
                for n in range(count):
                    target[pixel + n] += weight[cell + n] * source[k + n]


def unfold(image: Floats, mask: Floats, runs: Index, rows: tuple[int, int], row_pixel: NDArray[np.int32]) -> Floats:
    """Return C times the pixel that each lit cell belongs to, (tiles, lit row cells, TILE); `runs` as in `fold`."""
    tiles, lines = -(-int(runs[:, 3].sum()) // TILE), rows[1] - rows[0]
    by_cell = room_for(tiles * lines * TILE).reshape(tiles, lines, TILE)
    share_out(_unfold_lines, lines, image, mask, runs, row_pixel[rows[0] : rows[1]], rows[0], by_cell)
    return by_cell


@njit(cache=True, nogil=True)
def _unfold_lines(
    part: tuple[int, int],
    image: Floats,
    mask: Floats,
    runs: Index,
    row_pixel: NDArray[np.int32],
    first: int,
    by_cell: Floats,
) -> None:
    """Write a part of the lit row cells of `unfold`, the first of which is row cell `first`."""
    for line in range(part[0], part[1]):
        source, weight = image[row_pixel[line]], mask[first + line]
        by_cell[-1:, line] = 0.0
        for run in range(runs.shape[0]):
            cell, lit, pixel, count = runs[run]
            target, k = by_cell[lit // TILE, line], lit % TILE
            for n in range(count):
                target[k + n] = weight[cell + n] * source[pixel + n]
