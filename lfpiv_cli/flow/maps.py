"""Symmetric normalised direct correlation of two volumes, window by window.

For a window W and a shift s of whole voxels,

    R(s) = [sum_W A(x) B(x + s) + sum_W A(x - s) B(x)] / sqrt{[E_A(W) + E_A(W - s)] [E_B(W + s) + E_B(W)]}

with E the sum of squares over a window: A is carried forward into B and B backward into A, which cancels the
first-order error of a window whose particles leave it. R is at most 1 (Cauchy-Schwarz). A peak at s > 0 means motion
towards +.

Windows that overlap share their products: where the step and the size have a large common divisor, products are summed
over blocks of that size once, and blocks into windows. Axes: everything here is ordered (z, y, x).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import gcd

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.flow.lanes import FEW_SHIFTS, LANES, MANY_SHIFTS, few_products, many_products
from lfpiv_cli.flow.windows import Triple, WindowLayout

# Blocks narrower than this cost more in sums of sums than the products they save.
SMALLEST_BLOCK = 4
# A window whose energy is below this share of the brightest one's is empty: what the splines carry into empty space
# reaches amplitudes of 1e-5.
SMALLEST_ENERGY = 1e-9

# Columns that are summed at a time: their sums stay in the fastest cache.
SUM_TILE = 2048


@dataclass(frozen=True)
class Blocks:
    """How the windows of one layout are made of blocks, along (z, y, x).

    Block k along an axis covers voxels first + k stride ... + size - 1; window k is the sum of blocks k hop ... k hop +
    per_window - 1.
    """

    first: Triple
    size: Triple
    stride: Triple
    count: Triple
    per_window: Triple
    hop: Triple


def blocks_of(layout: WindowLayout) -> Blocks:
    """Return the blocks that make up the windows, axis by axis; one block a window where sharing does not pay."""
    axes = [_blocks_along(layout.size[axis], layout.step[axis], layout.count[axis]) for axis in (2, 1, 0)]
    size, stride, count, per_window, hop = ((a[0], a[1], a[2]) for a in zip(*axes, strict=True))
    first = (layout.first[2], layout.first[1], layout.first[0])
    return Blocks(first, size, stride, count, per_window, hop)


def _blocks_along(size: int, step: int, count: int) -> tuple[int, int, int, int, int]:
    """Return size, stride, count, blocks per window and hop along one axis."""
    block = gcd(size, step)
    if block < SMALLEST_BLOCK or step >= size:
        return size, step, count, 1, 1
    hop, per_window = step // block, size // block
    return block, block, (count - 1) * hop + per_window, per_window, hop


def margins(layout: WindowLayout, shape_zyx: Triple, radius: int) -> tuple[Triple, Triple]:
    """Return how many voxels of zeros windows shifted by `radius` need before and after the volume, (z, y, x).

    Along x there are at least `LANES` voxels from the first window's on, which are multiplied at once.
    """
    before, after = [], []
    for axis, voxels in zip((2, 1, 0), shape_zyx, strict=True):
        last = layout.first[axis] + (layout.count[axis] - 1) * layout.step[axis] + layout.size[axis]
        if axis == 0:
            last = max(last, layout.first[axis] + LANES)
        before.append(max(0, radius - layout.first[axis]))
        after.append(max(0, last + radius - voxels))
    return (before[0], before[1], before[2]), (after[0], after[1], after[2])


@dataclass(frozen=True, eq=False)
class MapSums:
    """What a correlation is made of, over all windows and shifts; of several pairs of volumes these add up.

    Attributes
    ----------
    products : sum_W A(x) B(x + s) + A(x - s) B(x), (nz, ny, nx, 2r + 1, 2r + 1, 2r + 1)
    energies_a, energies_b : the two brackets of R, of the same shape
    """

    products: NDArray[np.float64]
    energies_a: NDArray[np.float64]
    energies_b: NDArray[np.float64]

    def __add__(self, other: MapSums) -> MapSums:
        """Return the sums over two sets of pairs."""
        return MapSums(
            self.products + other.products, self.energies_a + other.energies_a, self.energies_b + other.energies_b
        )

    def correlation(self) -> NDArray[np.float64]:
        """Return R, zero where a window holds nothing."""
        energies = self.energies_a * self.energies_b
        filled = energies > SMALLEST_ENERGY**2 * np.max(energies)
        return np.divide(self.products, np.sqrt(energies), out=np.zeros(energies.shape), where=filled)


def map_sums(
    a: NDArray[np.float32], b: NDArray[np.float32], layout: WindowLayout, before: Triple, radius: int
) -> MapSums:
    """Return the sums that R is made of for all shifts up to `radius`, those along z, y, x last.

    Parameters
    ----------
    a, b : volumes with `margins` of zeros around them
    layout : windows, in voxels of the volume without margins
    before : the margins before the volume, (z, y, x)
    """
    blocks = blocks_of(layout)
    first = (blocks.first[0] + before[0], blocks.first[1] + before[1], blocks.first[2] + before[2])
    products = block_products(a, b, first, blocks.size, blocks.stride, blocks.count, radius)
    for axis in range(3):
        products = _sum_blocks(products, axis, layout.count_zyx[axis], blocks.per_window[axis], blocks.hop[axis])
    energies_a, energies_b = (window_sums(np.square(volume), layout, before, radius) for volume in (a, b))
    return MapSums(products, _pair_energies(energies_a, -1), _pair_energies(energies_b, 1))


def window_sums(volume: NDArray, layout: WindowLayout, before: Triple, radius: int = 0) -> NDArray[np.float32]:
    """Return the sums over all windows at all shifts: (nz, ny, nx, 2r + 1, 2r + 1, 2r + 1), the shifts last."""
    sums = volume.astype(np.float32, copy=False)
    for axis, xyz in enumerate((2, 1, 0)):
        # The axis to sum along comes first, so that whole stretches of memory are added.
        rows = np.ascontiguousarray(np.moveaxis(sums.reshape(-1, *volume.shape[axis:]), 1, 0))
        first = layout.first[xyz] + before[axis]
        flat = rows.reshape(rows.shape[0], -1)
        summed = axis_sums(flat, first, layout.size[xyz], layout.step[xyz], layout.count[xyz], radius)
        sums = np.moveaxis(summed.reshape(-1, *rows.shape[1:]), 0, 1)
    shifts = 2 * radius + 1
    nz, ny, nx = layout.count_zyx
    return sums.reshape(nz, shifts, ny, shifts, nx, shifts).transpose(0, 2, 4, 1, 3, 5)


def _pair_energies(energies: NDArray[np.float32], sign: int) -> NDArray[np.float64]:
    """Return E(W) + E(W + sign s) for every shift s."""
    whole = energies.astype(np.float64)
    radius = whole.shape[-1] // 2
    shifted = whole if sign > 0 else whole[..., ::-1, ::-1, ::-1]
    return shifted + whole[..., radius, radius, radius][..., np.newaxis, np.newaxis, np.newaxis]


def _sum_blocks(products: NDArray[np.float64], axis: int, count: int, per_window: int, hop: int) -> NDArray[np.float64]:
    """Return the sums of `per_window` neighbouring blocks, every `hop` blocks, along one axis."""
    if per_window == 1 and hop == 1:
        return products
    moved = np.moveaxis(products, axis, 0)
    total = moved[: (count - 1) * hop + 1 : hop].copy()
    for k in range(1, per_window):
        total += moved[k : k + (count - 1) * hop + 1 : hop]
    return np.moveaxis(total, 0, axis)


@njit(cache=True, parallel=True)
def axis_sums(
    rows: NDArray[np.float32], first: int, size: int, step: int, count: int, radius: int
) -> NDArray[np.float32]:
    """Return sums over `size` rows of (rows, columns), those from first + k step + shift on: (count x shifts, columns).

    The rows that all shifts of a window share are summed once. Differences of running sums would take less, but an
    empty window next to bright ones must be exactly zero.
    """
    shifts = 2 * radius + 1
    columns = rows.shape[1]
    sums = np.empty((count * shifts, columns), dtype=np.float32)
    tiles = -(-columns // SUM_TILE)
    for job in prange(count * tiles):
        k, left = job // tiles, (job % tiles) * SUM_TILE
        right = min(left + SUM_TILE, columns)
        lowest = first + k * step - radius
        begin = lowest + shifts - 1
        end = max(begin, lowest + size)
        shared = np.zeros(right - left, dtype=np.float32)
        for row in range(begin, end):
            add_row(shared, rows[row, left:right])
        for shift in range(shifts):
            target = sums[k * shifts + shift, left:right]
            target[:] = shared
            for row in range(lowest + shift, min(begin, lowest + shift + size)):
                add_row(target, rows[row, left:right])
            for row in range(end, lowest + shift + size):
                add_row(target, rows[row, left:right])
    return sums


@njit(cache=True)
def add_row(target: NDArray[np.float32], row: NDArray[np.float32]) -> None:
    """Add a row to another."""
    for i in range(target.size):
        target[i] += row[i]


@njit(cache=True, parallel=True)
def block_products(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    first: Triple,
    size: Triple,
    stride: Triple,
    count: Triple,
    radius: int,
) -> NDArray[np.float64]:
    """Return sum A(x) B(x + s) + A(x - s) B(x) over blocks: (blocks z, y, x, shifts z, y, x).

    For one row of blocks the products are first summed over its planes and rows, many columns and several shifts at
    once, and only then over the columns of each block. The first sums are float32: the maps are wanted to 1e-5.
    """
    shifts = 2 * radius + 1
    row, plane = a.shape[2], a.shape[1] * a.shape[2]
    flat_a, flat_b = a.reshape(a.size), b.reshape(b.size)
    products = np.empty((count[0], count[1], count[2], shifts, shifts, shifts))
    length = max(LANES, (count[2] - 1) * stride[2] + size[2])
    together = MANY_SHIFTS if shifts >= MANY_SHIFTS else FEW_SHIFTS
    for job in prange(count[0] * count[1]):
        bz, by = job // count[1], job % count[1]
        begin = (first[0] + bz * stride[0]) * plane + (first[1] + by * stride[1]) * row + first[2]
        # All shifts of a few columns before the next ones: their voxels then stay in the fastest cache.
        columns = np.empty((shifts, shifts, shifts, length), dtype=np.float32)
        flat = columns.reshape(columns.size)
        for start in range(0, length, LANES):
            # The last lanes, and the last shifts below, begin early enough to end with the others.
            x = min(start, length - LANES)
            for sz in range(shifts):
                for sy in range(shifts):
                    for group in range(0, shifts, together):
                        sx = min(group, shifts - together)
                        shift = (sz - radius) * plane + (sy - radius) * row + sx - radius
                        at, here = ((sz * shifts + sy) * shifts + sx) * length + x, begin + x
                        if together == MANY_SHIFTS:
                            many_products(flat, at, length, flat_a, flat_b, here, shift, plane, row, size[0], size[1])
                        else:
                            few_products(flat, at, length, flat_a, flat_b, here, shift, plane, row, size[0], size[1])
        lines = columns.reshape(-1, length)
        for bx in range(count[2]):
            sums = products[bz, by, bx].reshape(lines.shape[0])
            for shift in range(lines.shape[0]):
                total = 0.0
                for x in range(bx * stride[2], bx * stride[2] + size[2]):
                    total += lines[shift, x]
                sums[shift] = total
    return products
