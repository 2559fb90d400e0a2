"""What is summed over windows: the symmetric normalised direct correlation of two volumes.

For a window W and a shift s of whole voxels,

    R(s) = [sum_W A(x) B(x + s) + sum_W A(x - s) B(x)] / sqrt{[E_A(W) + E_A(W - s)] [E_B(W + s) + E_B(W)]}

with E the sum of squares over a window: A is carried forward into B and B backward into A, which cancels the
first-order error of a window whose particles leave it. R is at most 1 (Cauchy-Schwarz). A peak at s > 0 means motion
towards +.

Windows that overlap share their products: where the step and the size have a large common divisor, products are summed
over blocks of that size once, and blocks into windows. In weighted windows every sum, of energies and moments too,
counts a voxel by its weight, and neighbours share nothing. Axes: everything here is ordered (z, y, x).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.flow.windows import Cells, Starts, Triple, WindowLayout, cells_of, triple
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.robust import of_half_the_sum
from lfpiv_cli.threads import in_threads, share_out

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

WindowWeights = tuple[Singles, Singles, Singles]


def margins(layout: WindowLayout, shape_zyx: Triple, radius: int) -> tuple[Triple, Triple]:
    """Return how many voxels of zeros windows shifted by `radius` need before and after the volume, (z, y, x)."""
    before, after = [], []
    for axis, voxels in zip((2, 1, 0), shape_zyx, strict=True):
        last = layout.first[axis] + (layout.count[axis] - 1) * layout.step[axis] + layout.size[axis]
        before.append(max(0, radius - layout.first[axis]))
        after.append(max(0, last + radius - voxels))
    return triple(before), triple(after)


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
    energies_a: Singles
    energies_b: Singles
    blocks: Cells

    def __add__(self, other: MapSums) -> MapSums:
        """Return the sums over two sets of pairs."""
        return MapSums(
            self.products + other.products,
            self.energies_a + other.energies_a,
            self.energies_b + other.energies_b,
            self.blocks,
        )

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
        amplitude = self.amplitude()
        # The other windows are what most of the light comes from.
        maps[amplitude < SMALLEST_AMPLITUDE * of_half_the_sum(amplitude)] = 0.0
        return maps

    def amplitude(self) -> Floats:
        """Return the root of the sum of squares over each window (nz, ny, nx), the mean of both volumes' in logs."""
        middle = self.energies_a.shape[1] // 2
        energy_a, energy_b = (e[:, middle, :, middle, :, middle] for e in (self.energies_a, self.energies_b))
        return np.asarray((energy_a.astype(np.float64) * energy_b).transpose(0, 2, 1) ** 0.25)


def map_sums(a: Singles, b: Singles, layout: WindowLayout, before: Triple, radius: int) -> MapSums:
    """Return the sums that R is made of for all shifts up to `radius`, those along z, y, x last.

    For one row of blocks the products are first summed over its planes and rows, many columns and several shifts at
    once, and only then over the columns of each window. These sums are float32: the maps are wanted to 1e-5.

    Parameters
    ----------
    a, b : volumes with `margins` of zeros around them
    layout : windows, in voxels of the volume without margins
    before : the margins before the volume, (z, y, x)
    """
    blocks = cells_of(layout, 1, alone=(2,))
    first = triple(low + margin for low, margin in zip(layout.first[::-1], before, strict=True))
    shifts = 2 * radius + 1
    count = triple(starts.size for starts in blocks.start)
    energies_a, energies_b = (energies_of(volume, layout, before, radius) for volume in (a, b))
    if not layout.is_weighted:
        found = np.empty((*count, shifts, shifts, shifts))
        share_out(sum_products, count[0] * count[1], (a, b), first, blocks.start, blocks.size, found)
        return MapSums(found, energies_a, energies_b, blocks)
    weights = weight_matrices(layout, blocks)
    here = WeightedVoxels(first, weights)

    def products_of(z: int) -> Iterator[Singles]:
        still_a, still_b = here.of(a, z), here.of(b, z)
        for shift in np.ndindex(shifts, shifts, shifts):
            dz, dy, dx = (each - radius for each in shift)
            yield still_a * here.of(b, z + dz, dy, dx) + here.of(a, z - dz, -dy, -dx) * still_b

    products = weighted_sums(shifts**3, products_of, weights).transpose(0, 2, 3, 1).astype(np.float64, order="C")
    return MapSums(products.reshape(*count, shifts, shifts, shifts), energies_a, energies_b, blocks)


class WeightedVoxels(NamedTuple):
    """The voxels that weighted windows cover: the first one (z, y, x), and the weights, of whose widths it is."""

    first: Triple
    weights: WindowWeights

    def of(self, volume: NDArray[Any], z: int, dy: int = 0, dx: int = 0) -> NDArray[Any]:
        """Return a plane of the region in a volume with margins, moved by so many rows and columns."""
        (z0, y0, x0), (_, rows, columns) = self.first, (weights.shape[1] for weights in self.weights)
        return volume[z0 + z, y0 + dy : y0 + dy + rows, x0 + dx : x0 + dx + columns]


def weight_matrices(layout: WindowLayout, cells: Cells, radius: int = 0) -> WindowWeights:
    """Return the weights (sums, voxels) along z, y, x with which voxels count in cells of weighted windows.

    Voxels begin `radius` before the first window; each cell has a sum for each shift, from -radius to radius.
    """
    matrices = []
    for axis in range(3):
        start, size, weights = cells.start[axis], cells.size[axis], layout.weights(2 - axis)
        matrix = np.zeros((start.size, 2 * radius + 1, start[-1] + size[-1] + 2 * radius), dtype=np.float32)
        for cell, (begin, length) in enumerate(zip(start, size, strict=True)):
            # The place in its own window.
            place = begin - cell // cells.per_window[axis] * layout.step[2 - axis]
            for shift in range(2 * radius + 1):
                matrix[cell, shift, begin + shift : begin + shift + length] = weights[place : place + length]
        matrices.append(matrix.reshape(-1, matrix.shape[2]))
    return matrices[0], matrices[1], matrices[2]


def weighted_sums(fields: int, plane: Callable[[int], Iterable[Singles]], weights: WindowWeights) -> Singles:
    """Return sums (z, fields, y, x) over weighted windows of fields that are made plane by plane, (rows, columns)."""
    along_z, along_y, along_x = weights
    lateral = np.empty((along_z.shape[1], fields, len(along_y), len(along_x)), dtype=np.float32)

    def work(z: int) -> None:
        for number, field in enumerate(plane(z)):
            lateral[z, number] = along_y @ field @ along_x.T

    in_threads(work, range(len(lateral)))
    return np.tensordot(along_z, lateral, axes=1)


def energies_of(volume: Singles, layout: WindowLayout, before: Triple, radius: int = 0) -> Singles:
    """Return the sums of squares over shifted windows: (windows z, shifts z, windows x, shifts x, windows y, shifts y).

    One axis after the other. Differences of running sums would take less, but an empty window next to bright ones must
    be exactly zero.
    """
    size, step, count, low = (each[::-1] for each in (layout.size, layout.step, layout.count, layout.first))
    first = triple(begin + margin for begin, margin in zip(low, before, strict=True))
    shifts = 2 * radius + 1
    nz, ny, nx = count
    if layout.is_weighted:
        weights = weight_matrices(layout, cells_of(layout, 1), radius)
        whole = WeightedVoxels(triple(begin - radius for begin in first), weights)
        sums = weighted_sums(1, lambda z: [whole.of(volume, z) ** 2], weights)
        return sums.reshape(nz, shifts, ny, shifts, nx, shifts).transpose(0, 1, 4, 5, 2, 3).copy()
    planes = (nz - 1) * step[0] + size[0] + 2 * radius
    lateral = np.empty((planes, nx * shifts, ny * shifts), dtype=np.float32)
    share_out(sum_laterally, planes, volume, first, size, step, radius, lateral)
    rows = lateral.reshape(planes, nx * shifts * ny * shifts)
    found = np.empty((nz, shifts, rows.shape[1]), dtype=np.float32)
    in_threads(lambda k: sum_rows(rows, k * step[0] + radius, size[0], radius, found[k]), range(nz))
    return found.reshape(nz, shifts, nx, shifts, ny, shifts)


def valid_shares(valid: NDArray[np.uint8], layout: WindowLayout, before: Triple) -> Floats:
    """Return the share of each window's voxels that are valid, (nz, ny, nx), from their flags 0 or 1."""
    # The squares of 0 and 1 are themselves; float32, for which the sums are compiled anyway. Each counts alike.
    counted = replace(layout, weighting="uniform")
    seen = energies_of(valid.astype(np.float32), counted, before)[:, 0, :, 0, :, 0].transpose(0, 2, 1)
    return seen / np.prod(layout.size, dtype=np.float64)


@njit(cache=True, nogil=True)
def sum_laterally(
    part: tuple[int, int], volume: Singles, first: Triple, size: Triple, step: Triple, radius: int, lateral: Singles
) -> None:
    """Write the sums of squares over the rows and columns of windows, planes `part` of (z, columns, rows)."""
    shifts, lowest = 2 * radius + 1, first[0] - radius
    nx, ny = lateral.shape[1] // shifts, lateral.shape[2] // shifts
    for z in range(part[0], part[1]):
        squares = np.empty(volume.shape[1:], dtype=np.float32)
        for y in range(volume.shape[1]):
            row, squared = volume[lowest + z, y], squares[y]
            for x in range(row.size):
                squared[x] = row[x] * row[x]
        along_y = np.empty((ny * shifts, volume.shape[2]), dtype=np.float32)
        for k in range(ny):
            sum_rows(squares, first[1] + k * step[1], size[1], radius, along_y[k * shifts : (k + 1) * shifts])
        turned = along_y.T.copy()
        for k in range(nx):
            sum_rows(turned, first[2] + k * step[2], size[2], radius, lateral[z, k * shifts : (k + 1) * shifts])


@njit(cache=True)
def sum_ahead(values: Singles, spare: Singles, size: int, sums: Singles) -> None:
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
        later = values[length:]
        for i in range(later.size):
            spare[i] = values[i] + later[i]
        values, spare = spare, values
        length *= 2


@njit(cache=True, nogil=True)
def sum_rows(rows: Singles, first: int, size: int, radius: int, sums: Singles) -> None:
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


@njit(cache=True, nogil=True)
def write_maps(
    part: tuple[int, int],
    blocks: Floats,
    energies: tuple[Singles, Singles],
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
def add_row(target: Singles, row: Singles) -> None:
    """Add a row to another, as far as it goes."""
    for i in range(row.size):
        target[i] += row[i]


@njit(cache=True, nogil=True)
def sum_products(
    part: tuple[int, int], pair: tuple[Singles, Singles], first: Triple, start: Starts, size: Starts, found: Floats
) -> None:
    """Write the products of `MapSums` for the rows of blocks `part`."""
    a, b = pair
    count, shifts = found.shape[:3], found.shape[3]
    radius = shifts // 2
    row, plane = a.shape[2], a.shape[1] * a.shape[2]
    flat_a, flat_b = a.reshape(a.size), b.reshape(b.size)
    length = start[2][-1] + size[2][-1]
    together = MANY_SHIFTS if shifts >= MANY_SHIFTS else FEW_SHIFTS
    summed = np.empty((MANY_SHIFTS, COLUMNS), dtype=np.float32)
    target = summed.reshape(summed.size)
    for job in range(part[0], part[1]):
        bz, by = job // count[1], job % count[1]
        begin = (first[0] + start[0][bz]) * plane + (first[1] + start[1][by]) * row + first[2]
        room = np.empty((3, shifts**3 * length), dtype=np.float32)
        flat, spare, sums = room[0], room[1], room[2]
        for x in range(0, length, COLUMNS):
            columns = min(COLUMNS, length - x)
            for group in range(0, shifts**3, shifts):
                sz, sy = group // shifts // shifts, group // shifts % shifts
                for column in range(0, shifts, together):
                    # The last shifts begin early enough to end with the others.
                    sx = min(column, shifts - together)
                    shift = (sz - radius) * plane + (sy - radius) * row + sx - radius
                    summed[:] = 0.0
                    for z in range(size[0][bz]):
                        for y in range(size[1][by]):
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
        sum_ahead(flat, spare, size[2][0], sums)
        lines = sums.reshape(-1, length)
        for kx in range(count[2]):
            window = found[bz, by, kx].reshape(lines.shape[0])
            for shift in range(window.size):
                window[shift] = lines[shift, start[2][kx]]


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def add_products(
    target: Singles, a: Singles, b: Singles, b_there: Singles, a_back: Singles, columns: int, shifts: int
) -> None:
    """Add a(x) b(x + s) + a(x - s) b(x) of one row for shifts that follow each other, `COLUMNS` apart in `target`.

    `b_there` begins at the first shift, `a_back` at the last.
    """
    for x in range(columns):
        a_here, b_here = a[x], b[x]
        for m in range(shifts):
            target[m * COLUMNS + x] += a_here * b_there[x + m] + a_back[x + shifts - 1 - m] * b_here
