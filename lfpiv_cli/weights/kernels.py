"""The compiled loops of the factorised operators; `operators` holds their readable twins.

Every step is one form, four lines of 16 numbers as a sum of many (`microkernel.combine`). The lit column cells are cut
into tiles of 16, and a tile goes through both steps, along the columns and along the rows, while it is in the cache.
Each output element is one sum in a fixed order, so the result does not depend on the number of threads.

Arrays: float32. `height` and `width` count the voxels along the sensor's rows and columns, planes and height filled up
to a multiple of four where said; `by_cell` is (tiles, row lines, 16).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.simd.combine import GROUP, TILE, combine, combine_onto

Floats = NDArray[np.float32]
Index = NDArray[np.int64]


# Forward, tiles are dealt out in chunks, so that each thread makes its room for a tile's lines but once.
CHUNKS = 16
# Back, this many groups of four planes go through all tiles together: few enough to share among many cores, enough
# that the image is read from beyond the second-level cache only so many times.
GROUPS_AT_ONCE = 2


@njit(cache=True, parallel=True)
def project(
    volume: Floats,
    start: Index,
    first_voxel: NDArray[np.int32],
    share: Floats,
    group_start: Index,
    group_line: NDArray[np.int32],
    group_share: Floats,
    tiles: int,
) -> Floats:
    """Return sum_z B_z V_z A_z^T by cells, (tiles, 4 groups, 16), of a volume (planes, filled height, width).

    Block `plane * tiles + tile` is rows start[...] to start[... + 1] of `share` (rows, 16), a voxel each from
    `first_voxel` on; group g of row cells is entries group_start[g] to group_start[g + 1]: lines plane * height + voxel
    and their shares (entries, 4).
    """
    planes, height, width = volume.shape
    groups = group_start.size - 1
    by_cell = np.empty((tiles, GROUP * groups, TILE), np.float32)
    flat_volume, flat_share, flat_cell = volume.reshape(-1), share.reshape(-1), by_cell.reshape(-1)
    flat_group = group_share.reshape(-1)
    in_turn = np.arange(width + 1).astype(np.int32)
    for chunk in prange(CHUNKS):
        lines = np.empty(planes * height * TILE, np.float32)
        for tile in range(chunk * tiles // CHUNKS, (chunk + 1) * tiles // CHUNKS):
            for plane in range(planes):
                block = plane * tiles + tile
                terms, source = start[block + 1] - start[block], start[block] * TILE
                for j in range(0, height, GROUP):
                    at = (plane * height + j) * TILE
                    voxel = (plane * height + j) * width + first_voxel[block]
                    combine(lines, at, TILE, flat_share, source, in_turn, 0, terms, flat_volume, voxel, 1, width)
            for g in range(groups):
                at, first = (tile * groups + g) * GROUP * TILE, group_start[g]
                terms = group_start[g + 1] - first
                combine(flat_cell, at, TILE, lines, 0, group_line, first, terms, flat_group, first * GROUP, GROUP, 1)
    return by_cell


@njit(cache=True, parallel=True)
def back_project(
    by_cell: Floats,
    shape: tuple[int, int, int],
    group_start: Index,
    group_line: NDArray[np.int32],
    group_share: Floats,
    start: Index,
    first_voxel: NDArray[np.int32],
    share: Floats,
) -> Floats:
    """Return B_z^T I A_z as a volume (planes, height, width + 16), its spare voxels meaningless.

    `shape` is (planes, height, width), planes and height filled up. Group (plane / 4) * height + voxel is entries
    group_start[...] on: lines of `by_cell` and their shares (entries, 4). Block b is `share` (blocks, 16 cells, 16
    voxels), from `first_voxel` on; plane * tiles + tile has blocks start[...] to start[... + 1].
    """
    planes, height, width = shape
    tiles, size, groups = by_cell.shape[0], by_cell.shape[1] * TILE, planes // GROUP
    volume = np.zeros((planes, height, width + TILE), np.float32)
    flat_volume, flat_share, flat_cell = volume.reshape(-1), share.reshape(-1), by_cell.reshape(-1)
    flat_group = group_share.reshape(-1)
    in_turn = np.arange(TILE).astype(np.int32)
    step, across = width + TILE, height * TILE
    for task in prange(-(-groups // GROUPS_AT_ONCE)):
        lines = np.empty(GROUP * height * TILE, np.float32)
        for tile in range(tiles):
            for four in range(task * GROUPS_AT_ONCE, min((task + 1) * GROUPS_AT_ONCE, groups)):
                for voxel in range(height):
                    g = four * height + voxel
                    first, terms = group_start[g], group_start[g + 1] - group_start[g]
                    at, source, weight = voxel * TILE, tile * size, first * GROUP
                    combine(
                        lines, at, across, flat_cell, source, group_line, first, terms, flat_group, weight, GROUP, 1
                    )
                for member in range(GROUP):
                    plane = four * GROUP + member
                    for b in range(start[plane * tiles + tile], start[plane * tiles + tile + 1]):
                        for j in range(0, height, GROUP):
                            at = (plane * height + j) * step + first_voxel[b]
                            source, weight = b * TILE * TILE, (member * height + j) * TILE
                            combine_onto(
                                flat_volume, at, step, flat_share, source, in_turn, 0, TILE, lines, weight, 1, TILE
                            )
    return volume


@njit(cache=True, parallel=True)
def fold(
    by_cell: Floats,
    mask: Floats,
    first_column: int,
    last_column: int,
    column_pixel: NDArray[np.int32],
    row_cell: Index,
    row_line: Index,
    row_start: Index,
    columns: int,
) -> Floats:
    """Return the image (rows, columns): C times the light of each lit cell, added up by pixel.

    `row_cell` holds the lit row cells in the order of their pixels, `row_line` their lines, `row_start` (rows + 1,)
    where each pixel's begin.
    """
    image = np.zeros((row_start.size - 1, columns), np.float32)
    for row in prange(row_start.size - 1):
        for at in range(row_start[row], row_start[row + 1]):
            weight = mask[row_cell[at]]
            for tile in range(by_cell.shape[0]):
                source = by_cell[tile, row_line[at]]
                first = first_column + tile * TILE
                for k in range(min(TILE, last_column - first)):
                    image[row, column_pixel[first + k]] += weight[first + k] * source[k]
    return image


@njit(cache=True, parallel=True)
def unfold(
    image: Floats,
    mask: Floats,
    rows: tuple[int, int],
    columns: tuple[int, int],
    row_pixel: NDArray[np.int32],
    column_pixel: NDArray[np.int32],
) -> Floats:
    """Return C times the pixel that each lit cell belongs to, (tiles, lit row cells, 16)."""
    first_row, last_row = rows
    first_column, last_column = columns
    by_cell = np.zeros((-(-(last_column - first_column) // TILE), last_row - first_row, TILE), np.float32)
    for cell in prange(first_row, last_row):
        source, weight = image[row_pixel[cell]], mask[cell, first_column:last_column]
        for k in range(weight.size):
            by_cell[k // TILE, cell - first_row, k % TILE] = weight[k] * source[column_pixel[first_column + k]]
    return by_cell
