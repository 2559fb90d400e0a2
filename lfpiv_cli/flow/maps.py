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
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.flow.windows import Triple, WindowLayout
from lfpiv_cli.robust import of_half_the_sum
from lfpiv_cli.threads import COUNT_NO_REFERENCES, share_out

# Blocks narrower than this cost more in sums of sums than the products they save.
SMALLEST_BLOCK = 4
# Columns whose products are summed for all shifts before the next ones': their voxels stay in the fastest cache. And
# shifts along x that share what is read: with five a radius of 2 takes one pass over a row.
COLUMNS = 64
FEW_SHIFTS, MANY_SHIFTS = 3, 5
# A window whose energy is below this share of the brightest one's is empty: what the splines carry into empty space
# reaches amplitudes of 1e-5.
SMALLEST_ENERGY = 1e-9
# A window whose amplitude is below this share of the typical one holds no tracers: one of two hundred would reach it.
# What noise, ghosts and the tails of long particles leave in a region without tracers stays below.
SMALLEST_AMPLITUDE = 0.07


@dataclass(frozen=True)
class Blocks:
    """How the windows of one layout are made of blocks, along (z, y, x); along x each is a block of its own.

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
    axes = [_blocks_along(layout.size[axis], layout.step[axis], layout.count[axis]) for axis in (2, 1)]
    axes.append((layout.size[0], layout.step[0], layout.count[0], 1, 1))
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


@dataclass(frozen=True, eq=False)
class MapSums:
    """What a correlation is made of, over all shifts; of several pairs of volumes these add up.

    Attributes
    ----------
    products : sum A(x) B(x + s) + A(x - s) B(x) over blocks along z and y, (blocks z, blocks y, windows x, 2r + 1,
        2r + 1, 2r + 1)
    energies_a, energies_b : sums of squares over the shifted windows, of `energies_of`
    blocks : how windows are made of blocks
    """

    products: Floats
    energies_a: NDArray[np.float32]
    energies_b: NDArray[np.float32]
    blocks: Blocks

    def __add__(self, other: MapSums) -> MapSums:
        """Return the sums over two sets of pairs."""
        return MapSums(
            self.products + other.products,
            self.energies_a + other.energies_a,
            self.energies_b + other.energies_b,
            self.blocks,
        )

    def amplitude(self) -> Floats:
        """Return the root of the sum of squares over each window where it stands, the mean of both volumes' in logs."""
        middle = self.energies_a.shape[1] // 2
        energy_a, energy_b = (e[:, middle, :, middle, :, middle] for e in (self.energies_a, self.energies_b))
        return np.asarray((energy_a.astype(np.float64) * energy_b).transpose(0, 2, 1) ** 0.25)

    def correlation(self) -> Floats:
        """Return R, (nz, ny, nx, 2r + 1, 2r + 1, 2r + 1), zero where a window holds no tracers."""
        energies, per_window, hop = (self.energies_a, self.energies_b), self.blocks.per_window[:2], self.blocks.hop[:2]
        # The brackets of R hold two windows each.
        brightest = 4.0 * float(np.max(self.energies_a)) * float(np.max(self.energies_b))
        nz, shifts, nx, _, ny, _ = self.energies_a.shape
        blocks = self.products.reshape(*self.products.shape[:2], nx, shifts**3)
        maps = np.empty((nz, ny, nx, shifts**3))
        share_out(write_maps, nz * ny, blocks, energies, per_window, hop, SMALLEST_ENERGY**2 * brightest, maps)
        maps = maps.reshape(nz, ny, nx, shifts, shifts, shifts)
        # The other windows are what most of the light comes from.
        amplitude = self.amplitude()
        maps[amplitude < SMALLEST_AMPLITUDE * of_half_the_sum(amplitude)] = 0.0
        return maps


def map_sums(
    a: NDArray[np.float32], b: NDArray[np.float32], layout: WindowLayout, before: Triple, radius: int
) -> MapSums:
    """Return the sums that R is made of for all shifts up to `radius`, those along z, y, x last.

    For one row of blocks the products are first summed over its planes and rows, many columns and several shifts at
    once, and only then over the columns of each window. These sums are float32: the maps are wanted to 1e-5.

    Parameters
    ----------
    a, b : volumes with `margins` of zeros around them
    layout : windows, in voxels of the volume without margins
    before : the margins before the volume, (z, y, x)
    """
    blocks = blocks_of(layout)
    first = (blocks.first[0] + before[0], blocks.first[1] + before[1], blocks.first[2] + before[2])
    shifts = 2 * radius + 1
    found = np.empty((*blocks.count, shifts, shifts, shifts))
    share_out(sum_products, blocks.count[0] * blocks.count[1], (a, b), first, blocks.size, blocks.stride, found)
    energies_a, energies_b = (energies_of(volume, layout, before, radius) for volume in (a, b))
    return MapSums(found, energies_a, energies_b, blocks)


def energies_of(
    volume: NDArray[np.float32], layout: WindowLayout, before: Triple, radius: int = 0
) -> NDArray[np.float32]:
    """Return the sums of squares over shifted windows: (windows z, shifts z, windows x, shifts x, windows y, shifts y).

    One axis after the other. Differences of running sums would take less, but an empty window next to bright ones must
    be exactly zero.
    """
    size, step, count, low = (triple[::-1] for triple in (layout.size, layout.step, layout.count, layout.first))
    first = (low[0] + before[0], low[1] + before[1], low[2] + before[2])
    shifts = 2 * radius + 1
    nz, ny, nx = count
    planes = (nz - 1) * step[0] + size[0] + 2 * radius
    lateral = np.empty((planes, nx * shifts, ny * shifts), dtype=np.float32)
    share_out(sum_laterally, planes, volume, first, size, step, radius, lateral)
    rows = lateral.reshape(planes, nx * shifts * ny * shifts)
    found = np.empty((nz, shifts, rows.shape[1]), dtype=np.float32)
    share_out(sum_planes, nz, rows, size[0], step[0], radius, found)
    return found.reshape(nz, shifts, nx, shifts, ny, shifts)


def valid_shares(valid: NDArray[np.uint8], layout: WindowLayout, before: Triple) -> Floats:
    """Return the share of each window's voxels that are valid, (nz, ny, nx), from their flags 0 or 1."""
    # The squares of 0 and 1 are themselves; float32, for which the sums are compiled anyway.
    seen = energies_of(valid.astype(np.float32), layout, before)[:, 0, :, 0, :, 0].transpose(0, 2, 1)
    return seen / np.prod(layout.size, dtype=np.float64)


@njit(cache=True, nogil=True)
def sum_laterally(
    part: tuple[int, int],
    volume: NDArray[np.float32],
    first: Triple,
    size: Triple,
    step: Triple,
    radius: int,
    lateral: NDArray[np.float32],
) -> None:
    """Write the sums of squares over the rows and columns of windows, planes `part` of (z, columns, rows)."""
    shifts, lowest = 2 * radius + 1, first[0] - radius
    nx, ny = lateral.shape[1] // shifts, lateral.shape[2] // shifts
    for z in range(part[0], part[1]):
        squares = np.empty(volume.shape[1:], dtype=np.float32)
        for y in range(volume.shape[1]):
            square_row(volume[lowest + z, y], squares[y])
        along_y = np.empty((ny * shifts, volume.shape[2]), dtype=np.float32)
        for k in range(ny):
            sum_rows(squares, first[1] + k * step[1], size[1], radius, along_y[k * shifts : (k + 1) * shifts])
        turned = along_y.T.copy()
        for k in range(nx):
            sum_rows(turned, first[2] + k * step[2], size[2], radius, lateral[z, k * shifts : (k + 1) * shifts])


@njit(cache=True, nogil=True)
def sum_planes(
    part: tuple[int, int], planes: NDArray[np.float32], size: int, step: int, radius: int, sums: NDArray[np.float32]
) -> None:
    """Write the sums of flat planes (z, n) over the windows `part` of (windows z, shifts z, n)."""
    for k in range(part[0], part[1]):
        sum_rows(planes, k * step + radius, size, radius, sums[k])


@njit(cache=True)
def sum_ahead(values: NDArray[np.float32], spare: NDArray[np.float32], size: int, sums: NDArray[np.float32]) -> None:
    """Write the sum of the `size` values from each place on to `sums`; nothing of use near the end.

    By sums of one, two, four ... values. All are flat and equally long; `values` and `spare` are overwritten.
    """
    sums[:] = 0.0
    length, done = 1, 0
    while True:
        if size & length:
            add_row(sums, values[done:])
            done += length
        if 2 * length > size:
            return
        write_sum(spare, values, values[length:])
        values, spare = spare, values
        length *= 2


@njit(cache=True)
def sum_rows(rows: NDArray[np.float32], first: int, size: int, radius: int, sums: NDArray[np.float32]) -> None:
    """Write sums of `size` rows of (rows, columns), those from first + shift on for each shift up to `radius`.

    The rows that all shifts share are summed once.
    """
    lowest = first - radius
    begin = lowest + 2 * radius
    end = max(begin, lowest + size)
    shared = sums[0]
    shared[:] = 0.0
    for row in range(begin, end):
        add_row(shared, rows[row])
    # The first one last: it holds what is shared.
    for shift in range(2 * radius, -1, -1):
        target = sums[shift]
        if shift > 0:
            # Element by element: an assignment of whole arrays takes seconds to compile, for the words of its error.
            for i in range(shared.size):
                target[i] = shared[i]
        for row in range(lowest + shift, min(begin, lowest + shift + size)):
            add_row(target, rows[row])
        for row in range(end, lowest + shift + size):
            add_row(target, rows[row])


@njit(cache=True)
def write_sum(target: NDArray[np.float32], one: NDArray[np.float32], other: NDArray[np.float32]) -> None:
    """Write the sum of two rows, as far as the second one goes."""
    for i in range(other.size):
        target[i] = one[i] + other[i]


@njit(cache=True)
def square_row(row: NDArray[np.float32], squares: NDArray[np.float32]) -> None:
    """Write the squares of a row."""
    for x in range(row.size):
        squares[x] = row[x] * row[x]


@njit(cache=True, nogil=True)
def write_maps(
    part: tuple[int, int],
    blocks: Floats,
    energies: tuple[NDArray[np.float32], NDArray[np.float32]],
    per_window: tuple[int, int],
    hop: tuple[int, int],
    least: float,
    maps: Floats,
) -> None:
    """Write R of the rows of windows `part`, each flat: (nz, ny, nx, shifts cubed), as are the blocks."""
    energies_a, energies_b = energies
    shifts, (ny, nx) = energies_a.shape[1], maps.shape[1:3]
    radius, last = shifts // 2, shifts - 1
    for job in range(part[0], part[1]):
        kz, ky = job // ny, job % ny
        scale = np.empty(shifts**3)
        for kx in range(nx):
            whole_a = np.float64(energies_a[kz, radius, kx, radius, ky, radius])
            whole_b = np.float64(energies_b[kz, radius, kx, radius, ky, radius])
            at = 0
            for sz in range(shifts):
                for sy in range(shifts):
                    for sx in range(shifts):
                        # E_A(W - s), E_B(W + s)
                        moved_a = energies_a[kz, last - sz, kx, last - sx, ky, last - sy]
                        scale[at] = (whole_a + moved_a) * (whole_b + energies_b[kz, sz, kx, sx, ky, sy])
                        at += 1
            window = maps[kz, ky, kx]
            window[:] = 0.0
            for bz in range(kz * hop[0], kz * hop[0] + per_window[0]):
                for by in range(ky * hop[1], ky * hop[1] + per_window[1]):
                    block = blocks[bz, by, kx]
                    for at in range(shifts**3):
                        window[at] += block[at]
            for at in range(shifts**3):
                window[at] *= 1.0 / np.sqrt(scale[at]) if scale[at] > least else 0.0


@njit(cache=True)
def add_row(target: NDArray[np.float32], row: NDArray[np.float32]) -> None:
    """Add a row to another, as far as it goes."""
    for i in range(row.size):
        target[i] += row[i]


@njit(cache=True, nogil=True)
def sum_products(
    part: tuple[int, int],
    pair: tuple[NDArray[np.float32], NDArray[np.float32]],
    first: Triple,
    size: Triple,
    stride: Triple,
    found: Floats,
) -> None:
    """Write the products of `MapSums` for the rows of blocks `part`."""
    a, b = pair
    count, shifts = found.shape[:3], found.shape[3]
    radius = shifts // 2
    row, plane = a.shape[2], a.shape[1] * a.shape[2]
    flat_a, flat_b = a.reshape(a.size), b.reshape(b.size)
    length = (count[2] - 1) * stride[2] + size[2]
    together = MANY_SHIFTS if shifts >= MANY_SHIFTS else FEW_SHIFTS
    summed = np.empty((MANY_SHIFTS, COLUMNS), dtype=np.float32)
    target = summed.reshape(summed.size)
    for job in range(part[0], part[1]):
        bz, by = job // count[1], job % count[1]
        begin = (first[0] + bz * stride[0]) * plane + (first[1] + by * stride[1]) * row + first[2]
        room = np.empty((3, shifts**3 * length), dtype=np.float32)
        flat, spare, sums = room[0], room[1], room[2]
        for x in range(0, length, COLUMNS):
            columns = min(COLUMNS, length - x)
            for group in range(0, shifts**3, shifts):
                sz, sy = group // shifts // shifts, group // shifts % shifts
                for start in range(0, shifts, together):
                    # The last shifts begin early enough to end with the others.
                    sx = min(start, shifts - together)
                    shift = (sz - radius) * plane + (sy - radius) * row + sx - radius
                    summed[:] = 0.0
                    for z in range(size[0]):
                        for y in range(size[1]):
                            here = begin + z * plane + y * row + x
                            a_here, b_here, b_there = flat_a[here:], flat_b[here:], flat_b[here + shift :]
                            a_back = flat_a[here - shift - together + 1 :]
                            # Numbers of shifts that the compiler knows: it then writes out their loop.
                            if together == MANY_SHIFTS:
                                add_products(target, a_here, b_here, b_there, a_back, columns, MANY_SHIFTS)
                            else:
                                add_products(target, a_here, b_here, b_there, a_back, columns, FEW_SHIFTS)
                    for m in range(together):
                        line, found_line = flat[(group + sx + m) * length + x :], summed[m]
                        for k in range(columns):
                            line[k] = found_line[k]
        sum_ahead(flat, spare, size[2], sums)
        lines = sums.reshape(-1, length)
        for kx in range(count[2]):
            window = found[bz, by, kx].reshape(lines.shape[0])
            for shift in range(window.size):
                window[shift] = lines[shift, kx * stride[2]]


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def add_products(
    target: NDArray[np.float32],
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    b_there: NDArray[np.float32],
    a_back: NDArray[np.float32],
    columns: int,
    shifts: int,
) -> None:
    """Add a(x) b(x + s) + a(x - s) b(x) of one row for shifts that follow each other, `COLUMNS` apart in `target`.

    `b_there` begins at the first shift, `a_back` at the last.
    """
    for x in range(columns):
        a_here, b_here = a[x], b[x]
        for m in range(shifts):
            target[m * COLUMNS + x] += a_here * b_there[x + m] + a_back[x + shifts - 1 - m] * b_here
