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

import numpy as np
from numba import njit

from lfpiv_cli.arrays import Floats
from lfpiv_cli.flow.sums import MOMENTS, PRODUCTS, UNKNOWNS
from lfpiv_cli.flow.windows import Triple, WindowLayout, cells_of, triple
from lfpiv_cli.threads import share_out

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
