"""Gauss-Newton steps from moments of two deformed volumes, with their uncertainty.

With M = (A + B) / 2, a rest displacement d and a gain c between the volumes, to first order B - A = -d . grad M + c M.
Least squares over a window need only the moments of (grad M, M) and B - A, which are summed over cells once and over
windows from these. Along a particle image that is long and smooth this is far less noisy than the top of a correlation
peak, where neighbouring shifts hardly differ; along a short one the peak is more robust against lost particles.

The uncertainty is that of the sandwich estimator: how much the groups of cells in a window disagree on the solution,
whatever the reason. Where the volumes differ, a step is too short: a predictor that is moved by one changes it only by
the response sum(dA/dx dB/dx) / sum(dM/dx dM/dx), as differences have slopes as well. Passes make up for that, and what
they converge to errs by as much more than one step.

Axes: cells and windows are ordered (z, y, x); vectors hold (u, v, w) along (x, y, z).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.flow.sums import WeightedVoxels, weight_matrices, weighted_sums
from lfpiv_cli.flow.windows import Starts, Triple, WindowLayout, cells_of, triple
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.threads import share_out

# Three components and the gain. Moments are those of their derivatives, and those of these with B - A.
UNKNOWNS = 4
PRODUCTS = UNKNOWNS * (UNKNOWNS + 1) // 2
# And the squares of the slopes of their difference.
MOMENTS = PRODUCTS + UNKNOWNS + 3
# A group is at least this many standard deviations of a particle image long: smaller ones share their particles, and
# the spread of what they say is then too small.
GROUP_SIGMAS = 2.0
# With fewer independent groups than this their spread says nothing. A window of 16 x 16 x 8 that overhangs at a corner
# has 3 x 3 x 1 groups left, 3.2 of them independent.
FEWEST_GROUPS = 3
# A pivot below this share of its diagonal element is rounding: the window does not determine that unknown.
SMALLEST_PIVOT = 1e-6
# With a smaller response the volumes' slopes have next to nothing in common: errors stated are then large enough.
SMALLEST_RESPONSE = 0.25

Row = Singles


def pair_moments(a: Singles, b: Singles, valid: NDArray[np.uint8], layout: WindowLayout, before: Triple) -> Floats:
    """Return the moments of all cells of two deformed volumes; of several pairs these add up.

    Parameters
    ----------
    a, b, valid : of `deform_pair`, with a margin of at least 1 around all windows
    layout : windows, in voxels of the volume without margins
    before : the margins before the volume, (z, y, x)
    """
    cells = cells_of(layout)
    first = triple(low + margin for low, margin in zip(layout.first[::-1], before, strict=True))
    count = tuple(starts.size for starts in cells.start)
    if not layout.is_weighted:
        found = np.empty((*count, MOMENTS))
        share_out(sum_cells, count[0] * count[1], (a, b), valid, first, cells.start, cells.size, found)
        return found
    weights = weight_matrices(layout, cells)
    here, steps = WeightedVoxels(first, weights), ((0, 0, 1), (0, 1, 0), (1, 0, 0))

    def moments_of(z: int) -> Iterator[Singles]:
        """The terms of `sum_cells`, in its order."""
        mean, difference = 0.5 * (here.of(a, z) + here.of(b, z)), here.of(b, z) - here.of(a, z)
        kept, of_mean, of_difference = here.of(valid, z).astype(np.float32), [], []
        for dz, dy, dx in steps:
            a_before, b_before = (here.of(volume, z - dz, -dy, -dx) for volume in (a, b))
            a_after, b_after = (here.of(volume, z + dz, dy, dx) for volume in (a, b))
            of_mean.append(0.25 * ((a_after + b_after) - (a_before + b_before)))
            of_difference.append(0.25 * ((b_after - a_after) - (b_before - a_before)))
            kept = kept * here.of(valid, z - dz, -dy, -dx) * here.of(valid, z + dz, dy, dx)
        of_mean.append(mean)
        yield from (kept * one * other for number, one in enumerate(of_mean) for other in of_mean[number:])
        yield from (kept * one * difference for one in of_mean)
        yield from (kept * one**2 for one in of_difference)

    return weighted_sums(MOMENTS, moments_of, weights).transpose(0, 2, 3, 1).astype(np.float64, order="C")


@njit(cache=True, nogil=True)
def sum_cells(
    part: tuple[int, int],
    pair: tuple[Singles, Singles],
    valid: NDArray[np.uint8],
    first: Triple,
    start: Starts,
    size: Starts,
    found: Floats,
) -> None:
    """Write the moments of cells, rows `part` of (cells z, y, x, MOMENTS), of windows that begin at the voxel `first`.

    The upper triangle of the products of (dM/dx, dM/dy, dM/dz, M), row by row, those of each with B - A, and the
    squares of the slopes of (B - A) / 2. Voxels with a neighbour that is not valid are left out: their gradient would
    be that of the rim.
    """
    a, b = pair
    count = found.shape[:3]
    row, plane = a.shape[2], a.shape[1] * a.shape[2]
    flat_a, flat_b, flat_valid = a.reshape(a.size), b.reshape(b.size), valid.reshape(valid.size)
    length = start[2][-1] + size[2][-1]
    room = np.empty((MOMENTS + UNKNOWNS + 5, length), dtype=np.float32)
    columns, rest, kept = room[:MOMENTS], room[-2], room[-1]
    known, slopes = room[MOMENTS : MOMENTS + UNKNOWNS], room[MOMENTS + UNKNOWNS : -2]
    for job in range(part[0], part[1]):
        cz, cy = job // count[1], job % count[1]
        begin = (first[0] + start[0][cz]) * plane + (first[1] + start[1][cy]) * row + first[2]
        # Summed over the planes and rows of the cells first, many columns at once; float32 serves for so few.
        columns[:] = 0.0
        for z in range(size[0][cz]):
            for y in range(size[1][cy]):
                here = begin + z * plane + y * row
                write_voxels(flat_a[here:], flat_b[here:], flat_valid[here:], known[3], rest, kept)
                for axis in range(3):
                    step = 1 if axis == 0 else row if axis == 1 else plane
                    before, after = here - step, here + step
                    write_slopes(
                        (flat_a[before:], flat_a[after:]),
                        (flat_b[before:], flat_b[after:]),
                        (flat_valid[before:], flat_valid[after:]),
                        (known[axis], slopes[axis], kept),
                    )
                moment = 0
                for i in range(UNKNOWNS):
                    multiply(known[i], kept)
                for i in range(UNKNOWNS):
                    for j in range(i, UNKNOWNS):
                        add_product(columns[moment], known[i], known[j])
                        moment += 1
                for i in range(UNKNOWNS):
                    add_product(columns[PRODUCTS + i], known[i], rest)
                for i in range(3):
                    multiply(slopes[i], kept)
                    add_product(columns[PRODUCTS + UNKNOWNS + i], slopes[i], slopes[i])
        for cx in range(count[2]):
            for moment in range(MOMENTS):
                total = 0.0
                for x in range(start[2][cx], start[2][cx] + size[2][cx]):
                    total += columns[moment, x]
                found[cz, cy, cx, moment] = total


@njit(cache=True, **COUNT_NO_REFERENCES)
def write_voxels(a: Row, b: Row, valid: NDArray[np.uint8], mean: Row, rest: Row, kept: Row) -> None:
    """Write the mean of two rows, their difference and which voxels are valid."""
    for x in range(kept.size):
        mean[x] = np.float32(0.5) * (a[x] + b[x])
        rest[x] = b[x] - a[x]
        kept[x] = np.float32(valid[x])


@njit(cache=True, **COUNT_NO_REFERENCES)
def write_slopes(
    a: tuple[Row, Row],
    b: tuple[Row, Row],
    valid: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    out: tuple[Row, Row, Row],
) -> None:
    """Write the central differences of the mean and of half the difference, from the rows before and after each.

    Voxels with a neighbour that is not valid are struck out of the last of `out`.
    """
    a_before, a_after = a
    b_before, b_after = b
    valid_before, valid_after = valid
    of_mean, of_difference, kept = out
    for x in range(kept.size):
        rise_a, rise_b = a_after[x] - a_before[x], b_after[x] - b_before[x]
        of_mean[x] = np.float32(0.25) * (rise_a + rise_b)
        of_difference[x] = np.float32(0.25) * (rise_b - rise_a)
    for x in range(kept.size):
        kept[x] *= np.float32(valid_before[x] & valid_after[x])


@njit(cache=True, **COUNT_NO_REFERENCES)
def multiply(target: Row, factor: Row) -> None:
    """Multiply a row by another."""
    for x in range(target.size):
        target[x] *= factor[x]


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def add_product(target: Row, one: Row, other: Row) -> None:
    """Add the product of two rows to a row."""
    for x in range(target.size):
        target[x] += one[x] * other[x]


def gauss_newton(moments: Floats, layout: WindowLayout, particle_sigma: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the rest displacements, their standard deviations and the response to a predictor, (nz, ny, nx, 3) each.

    NaN where a window does not determine them, and for the standard deviation where its groups are too few.

    Parameters
    ----------
    moments : of `pair_moments`, or a sum of such
    layout : windows, in voxels of the volume without margins
    particle_sigma : (3,) standard deviation of a particle image along x, y, z, voxels
    """
    cells = cells_of(layout)
    grouped = []
    for per_window, length, sigma in zip(cells.per_window, layout.size[::-1], particle_sigma[::-1], strict=True):
        # The fewest cells, a divisor of those of a window, that are `GROUP_SIGMAS` long; or all.
        long_enough = (
            number
            for number in range(1, per_window)
            if per_window % number == 0 and number * length >= GROUP_SIGMAS * sigma * per_window
        )
        grouped.append(next(long_enough, per_window))
    count = layout.count[::-1]
    solved = np.full((3, *count, 3), np.nan)
    share_out(solve_windows, count[0] * count[1], moments, cells.per_window, cells.hop, triple(grouped), solved)
    return solved[0], solved[1], solved[2]


@njit(cache=True)
def unpack(moments: Floats, matrix: Floats, vector: Floats) -> None:
    """Write the moments as a symmetric matrix (4, 4) and the vector (4,) of the products with B - A."""
    place = 0
    for i in range(UNKNOWNS):
        for j in range(i, UNKNOWNS):
            matrix[i, j] = moments[place]
            matrix[j, i] = moments[place]
            place += 1
        vector[i] = moments[PRODUCTS + i]


@njit(cache=True)
def invert(matrix: Floats, inverse: Floats) -> bool:
    """Write the inverse of a symmetric positive definite matrix (n, n) and tell whether it has one."""
    n = matrix.shape[0]
    rest = matrix.copy()
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
    # Element by element: an expression of whole rows would allocate each time.
    for k in range(n):
        if not rest[k, k] > SMALLEST_PIVOT * matrix[k, k]:
            return False
        scale = 1.0 / rest[k, k]
        for j in range(n):
            rest[k, j] *= scale
            inverse[k, j] *= scale
        for i in range(n):
            factor = rest[i, k]
            if i != k:
                for j in range(n):
                    rest[i, j] -= factor * rest[k, j]
                    inverse[i, j] -= factor * inverse[k, j]
    return True


@njit(cache=True, nogil=True)
def solve_windows(
    part: tuple[int, int], moments: Floats, per_window: Triple, hop: Triple, grouped: Triple, solved: Floats
) -> None:
    """Write step, deviation and response of windows, rows `part` of (3, nz, ny, nx, 3), from their cells' moments.

    `grouped` is how many cells along (z, y, x) make one group of the sandwich estimator. Windows that their moments do
    not determine are left as they are.
    """
    count = solved.shape[1:4]
    step, deviation, response = solved[0], solved[1], solved[2]
    groups = (per_window[0] // grouped[0], per_window[1] // grouped[1], per_window[2] // grouped[2])
    for job in range(part[0], part[1]):
        kz, ky = job // count[1], job % count[1]
        matrix, vector = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
        inverse, solution = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
        for kx in range(count[2]):
            sums = np.zeros((groups[0], groups[1], groups[2], MOMENTS))
            for z in range(per_window[0]):
                for y in range(per_window[1]):
                    for x in range(per_window[2]):
                        cell = moments[kz * hop[0] + z, ky * hop[1] + y, kx * hop[2] + x]
                        group = sums[z // grouped[0], y // grouped[1], x // grouped[2]]
                        for m in range(MOMENTS):
                            group[m] += cell[m]
            flat = sums.reshape(-1, MOMENTS)
            total = np.zeros(MOMENTS)
            for g in range(flat.shape[0]):
                for m in range(MOMENTS):
                    total[m] += flat[g, m]
            unpack(total, matrix, vector)
            if not invert(matrix, inverse):
                continue
            for i in range(UNKNOWNS):
                solution[i] = 0.0
                for j in range(UNKNOWNS):
                    solution[i] += inverse[i, j] * vector[j]
            for i in range(3):
                step[kz, ky, kx, i] = -solution[i]
            write_deviation(sums, inverse, solution, deviation[kz, ky, kx])
            for i in range(3):
                common = 1.0 - total[PRODUCTS + UNKNOWNS + i] / matrix[i, i]
                response[kz, ky, kx, i] = max(common, SMALLEST_RESPONSE)


@njit(cache=True)
def write_deviation(groups: Floats, inverse: Floats, solution: Floats, deviation: Floats) -> None:
    """Write the standard deviations (3,) of a solution from what each group (z, y, x, MOMENTS) leaves of its equations.

    Summed over all blocks of up to two neighbouring groups along each axis before squaring, as particles at the rim of
    a group are partly in the next one. That the remainders sum to zero is made up for by the share of a block.
    """
    matrix, vector = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    nz, ny, nx = groups.shape[:3]
    # One empty group beyond each face: blocks may overhang.
    rest = np.zeros((nz + 2, ny + 2, nx + 2, 3))
    used = 0
    # How many layers of groups along each axis hold anything: a window that overhangs has fewer.
    seen_z, seen_y, seen_x = np.zeros(nz), np.zeros(ny), np.zeros(nx)
    for z in range(nz):
        for y in range(ny):
            for x in range(nx):
                unpack(groups[z, y, x], matrix, vector)
                if matrix[UNKNOWNS - 1, UNKNOWNS - 1] == 0.0:
                    continue
                used += 1
                seen_z[z] = seen_y[y] = seen_x[x] = 1.0
                for j in range(UNKNOWNS):
                    left = vector[j]
                    for k in range(UNKNOWNS):
                        left -= matrix[j, k] * solution[k]
                    for i in range(3):
                        rest[z + 1, y + 1, x + 1, i] += inverse[i, j] * left
    # A kernel of 1/2, 1, 1/2 along each axis with more than one group: the mean share that a block has in the whole.
    dependent = 1.0
    for layers in (seen_z.sum(), seen_y.sum(), seen_x.sum()):
        if layers > 1.0:
            dependent *= 2.0 - 1.0 / layers
    if used < FEWEST_GROUPS * dependent:
        return
    # Of each place and the next along z, y and x, in place; the last ones along each axis are left half done.
    for stride in (rest[0].size, rest[0, 0].size, rest[0, 0, 0].size):
        flat = rest.reshape(rest.size)
        here, after = flat[: flat.size - stride], flat[stride:]
        for i in range(here.size):
            here[i] += after[i]
    for i in range(3):
        variance = 0.0
        for z in range(nz + 1):
            for y in range(ny + 1):
                for x in range(nx + 1):
                    variance += rest[z, y, x, i] * rest[z, y, x, i]
        # Each group is in two blocks along each axis.
        deviation[i] = np.sqrt(variance / 8.0 / (1.0 - dependent / used))
