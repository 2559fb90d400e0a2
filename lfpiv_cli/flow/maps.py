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

from lfpiv_cli.flow.windows import Triple, WindowLayout

# Blocks narrower than this cost more in sums of sums than the products they save.
SMALLEST_BLOCK = 4
# A window whose energy is below this share of the brightest one's is empty: what the splines carry into empty space
# reaches amplitudes of 1e-5.
SMALLEST_ENERGY = 1e-9


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
    """Return how many voxels of zeros windows shifted by `radius` need before and after the volume, (z, y, x)."""
    before, after = [], []
    for axis, voxels in zip((2, 1, 0), shape_zyx, strict=True):
        last = layout.first[axis] + (layout.count[axis] - 1) * layout.step[axis] + layout.size[axis]
        before.append(max(0, radius - layout.first[axis]))
        after.append(max(0, last + radius - voxels))
    return (before[0], before[1], before[2]), (after[0], after[1], after[2])


def correlation_maps(
    a: NDArray[np.float32], b: NDArray[np.float32], layout: WindowLayout, before: Triple, radius: int
) -> NDArray[np.float64]:
    """Return R for all shifts up to `radius`: (nz, ny, nx, 2r + 1, 2r + 1, 2r + 1), the shifts along z, y, x last.

    Zero where a window holds nothing.

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
    energies = _pair_energies(shifted_energies(a, layout, first, radius), -1)
    energies *= _pair_energies(shifted_energies(b, layout, first, radius), 1)
    filled = energies > SMALLEST_ENERGY**2 * np.max(energies)
    return np.divide(products, np.sqrt(energies), out=np.zeros_like(products), where=filled)


def window_sums(volume: NDArray, layout: WindowLayout, before: Triple, radius: int = 0) -> NDArray[np.float64]:
    """Return the sums over all windows at all shifts: (nz, 2r + 1, ny, 2r + 1, nx, 2r + 1)."""
    sums = volume
    for axis, xyz in enumerate((2, 1, 0)):
        outer = int(np.prod(sums.shape[:axis]))
        inner = int(np.prod(sums.shape[axis + 1 :]))
        rows = sums.reshape(outer, sums.shape[axis], inner)
        first = layout.first[xyz] + before[axis]
        summed = axis_sums(rows, first, layout.size[xyz], layout.step[xyz], layout.count[xyz], radius)
        sums = summed.reshape(*sums.shape[:axis], summed.shape[1], *sums.shape[axis + 1 :])
    shifts = 2 * radius + 1
    nz, ny, nx = layout.count_zyx
    return sums.reshape(nz, shifts, ny, shifts, nx, shifts)


def shifted_energies(volume: NDArray[np.float32], layout: WindowLayout, first: Triple, radius: int) -> NDArray:
    """Return the sums of squares over all windows at all shifts, (nz, ny, nx, 2r + 1, 2r + 1, 2r + 1)."""
    before = (first[0] - layout.first[2], first[1] - layout.first[1], first[2] - layout.first[0])
    return window_sums(np.square(volume), layout, before, radius).transpose(0, 2, 4, 1, 3, 5)


def _pair_energies(energies: NDArray[np.float64], sign: int) -> NDArray[np.float64]:
    """Return E(W) + E(W + sign s) for every shift s."""
    radius = energies.shape[-1] // 2
    shifted = energies if sign > 0 else energies[..., ::-1, ::-1, ::-1]
    return shifted + energies[..., radius, radius, radius][..., np.newaxis, np.newaxis, np.newaxis]


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
def axis_sums(rows: NDArray, first: int, size: int, step: int, count: int, radius: int) -> NDArray[np.float64]:
    """Return sums over `size` cells of the middle axis of (outer, cells, inner), at first + k step + shift.

    Sums are taken afresh for every window rather than as differences of running sums: an empty window next to bright
    ones must be exactly zero.
    """
    shifts = 2 * radius + 1
    outer, _, inner = rows.shape
    sums = np.zeros((outer, count * shifts, inner))
    for job in prange(outer * count):
        o, k = job // count, job % count
        for shift in range(shifts):
            target = sums[o, k * shifts + shift]
            start = first + k * step + shift - radius
            for cell in range(start, start + size):
                source = rows[o, cell]
                for i in range(inner):
                    target[i] += source[i]
    return sums


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

    For one row of blocks and one shift, the products of a slab of whole rows are added plane by plane into a buffer
    that stays in the cache, which the compiler vectorises without reordering a sum; only then is the buffer split into
    blocks. The buffer is float32: it adds at most the few planes of a block, and the maps are wanted to 1e-5.
    """
    shifts = 2 * radius + 1
    rows, columns = a.shape[1], a.shape[2]
    flat_a = a.reshape(a.size)
    flat_b = b.reshape(b.size)
    products = np.zeros((count[0], count[1], count[2], shifts, shifts, shifts))
    # Each slab starts `radius` after its first row begins and ends as much earlier: shifts never leave the volume.
    length = size[1] * columns - 2 * radius
    for job in prange(count[0] * count[1]):
        bz, by = job // count[1], job % count[1]
        slab = np.empty(size[1] * columns, dtype=np.float32)
        line = np.empty(columns)
        for sz in range(-radius, radius + 1):
            for sy in range(-radius, radius + 1):
                for sx in range(-radius, radius + 1):
                    shift = (sz * rows + sy) * columns + sx
                    slab[:] = np.float32(0.0)
                    for z in range(size[0]):
                        start = ((first[0] + bz * stride[0] + z) * rows + first[1] + by * stride[1]) * columns + radius
                        target = slab[radius : radius + length]
                        a_here = flat_a[start : start + length]
                        b_here = flat_b[start : start + length]
                        a_before = flat_a[start - shift : start - shift + length]
                        b_after = flat_b[start + shift : start + shift + length]
                        for i in range(length):
                            target[i] += a_here[i] * b_after[i] + a_before[i] * b_here[i]
                    line[:] = 0.0
                    for y in range(size[1]):
                        row = slab[y * columns : (y + 1) * columns]
                        for i in range(columns):
                            line[i] += row[i]
                    for bx in range(count[2]):
                        total = 0.0
                        for i in range(first[2] + bx * stride[2], first[2] + bx * stride[2] + size[2]):
                            total += line[i]
                        products[bz, by, bx, sz + radius, sy + radius, sx + radius] = total
    return products
