"""Symmetric matrices of a spline field, kept by each coefficient's neighbours.

A row belongs to the coefficient of one component of one spline, and has entries for the splines that overlap with it:
an array (nx, c, ny, nz, 7, c, 7, 7), whose last four axes are offset along x, other component, offset along y, along z;
c is 3 for velocities and 1 for a scalar. Planes of x come first, so that the rows of neighbouring planes make blocks.
"""

from __future__ import annotations

from functools import lru_cache
from math import factorial

import numba
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.fields.lattice import DEGREE, NEIGHBOURS, SUPPORT, Lattice
from lfpiv_cli.threads import share_out

Stencil = NDArray[np.float64]


def empty(lattice: Lattice, components: int = 3) -> Stencil:
    """Return the matrix of zeros."""
    nx, ny, nz = lattice.shape
    return np.zeros((nx, components, ny, nz, NEIGHBOURS, components, NEIGHBOURS, NEIGHBOURS))


def add_scalar(matrix: Stencil, factor: float, integrals: NDArray[np.float64]) -> None:
    """Add `factor` times what is alike for all components: (nx, ny, nz, 7, 7, 7) of one of them."""
    for component in range(matrix.shape[1]):
        matrix[:, component, :, :, :, component] += factor * integrals


def smoothness(lattice: Lattice, order: int) -> NDArray[np.float64]:
    """Return the integral of the square of all derivatives of one order, of one component: (nx, ny, nz, 7, 7, 7)."""
    total = np.zeros((*lattice.shape, NEIGHBOURS, NEIGHBOURS, NEIGHBOURS))
    along = [[lattice.integrals(axis, each, each) for each in range(order + 1)] for axis in range(3)]
    for i in range(order + 1):
        for j in range(order + 1 - i):
            k = order - i - j
            times = factorial(order) / (factorial(i) * factorial(j) * factorial(k))
            total += times * _product(along[0][i], along[1][j], along[2][k])
    return total


def divergence(lattice: Lattice) -> Stencil:
    """Return the integral of the squared divergence."""
    matrix = empty(lattice)
    for one in range(3):
        for other in range(3):
            orders = [(int(axis == one), int(axis == other)) for axis in range(3)]
            along = [lattice.integrals(axis, *orders[axis]) for axis in range(3)]
            matrix[:, one, :, :, :, other] = _product(*along)
    return matrix


def _product(x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the products (nx, ny, nz, 7, 7, 7) of integrals (n, 7) along three axes."""
    return np.asarray(
        x[:, None, None, :, None, None] * y[None, :, None, None, :, None] * z[None, None, :, None, None, :]
    )


def add_samples(matrix: Stencil, lattice: Lattice, points_mm: NDArray[np.float64], weight: NDArray[np.float64]) -> None:
    """Add the normal equations' matrix of samples at points (n, 3) with weights (n, 3, 3), inverse covariances."""
    first, (x, y, z) = lattice.splines_at(points_mm)
    share_out(_add_samples, len(matrix), matrix, first, x, y, z, np.ascontiguousarray(weight))


@numba.njit(cache=True, nogil=True)
def _add_samples(part, matrix, first, x, y, z, weight):  # type: ignore[no-untyped-def]  # numba
    """Add samples to the rows of some planes of x."""
    components = matrix.shape[1]
    for sample in range(len(first)):
        iy, iz = first[sample, 1], first[sample, 2]
        for a in range(SUPPORT):
            ix = first[sample, 0] + a
            if ix < part[0] or ix >= part[1]:
                continue
            for one in range(components):
                for b in range(SUPPORT):
                    for c in range(SUPPORT):
                        left = x[sample, a] * y[sample, b] * z[sample, c]
                        row = matrix[ix, one, iy + b, iz + c]
                        for d in range(SUPPORT):
                            for other in range(components):
                                plane = left * x[sample, d] * weight[sample, one, other]
                                for e in range(SUPPORT):
                                    line = plane * y[sample, e]
                                    for f in range(SUPPORT):
                                        row[d - a + DEGREE, other, e - b + DEGREE, f - c + DEGREE] += (
                                            line * z[sample, f]
                                        )


def right_hand_side(
    lattice: Lattice, points_mm: NDArray[np.float64], weighted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the normal equations' right-hand side (nx, 3, ny, nz) of weighted values (n, 3)."""
    columns, values = rows_of(lattice, points_mm)
    size = int(np.prod(lattice.shape))
    found = np.empty((3, *lattice.shape))
    for component in range(3):
        parts = (values * weighted[:, component, np.newaxis]).ravel()
        found[component] = np.bincount(columns.ravel(), parts, minlength=size).reshape(lattice.shape)
    return np.ascontiguousarray(found.transpose(1, 0, 2, 3))


def rows_of(
    lattice: Lattice, points_mm: NDArray[np.float64], along: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return numbers and values (n, 64) of the splines that reach each point, in C order of (nx, ny, nz)."""
    first, (x, y, z) = lattice.splines_at(points_mm, along)
    _, ny, nz = lattice.shape
    each = np.arange(SUPPORT)
    columns = (
        ((first[:, 0, None] + each)[:, :, None] * ny + (first[:, 1, None] + each)[:, None, :])[..., None] * nz
        + (first[:, 2, None] + each)[:, None, None, :]
    )  # fmt: skip
    values = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
    return columns.reshape(len(first), -1), values.reshape(len(first), -1)


@lru_cache(maxsize=4)
def _pattern(components: int, ny: int, nz: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the rows and columns of a plane's block that have entries, and which of the stencil's these are."""
    one, y, z, other, j, k = np.indices((components, ny, nz, components, NEIGHBOURS, NEIGHBOURS))
    to_y, to_z = y + j - DEGREE, z + k - DEGREE
    inside = (to_y >= 0) & (to_y < ny) & (to_z >= 0) & (to_z < nz)
    rows, columns = (one * ny + y) * nz + z, (other * ny + to_y) * nz + to_z
    return rows[inside], columns[inside], inside


def plane_block(matrix: Stencil, row: int, column: int) -> NDArray[np.float64]:
    """Return the dense block of the rows of one plane of x and the columns of another, at most three planes off."""
    _, components, ny, nz, *_ = matrix.shape
    rows, columns, inside = _pattern(components, ny, nz)
    size = components * ny * nz
    block = np.zeros((size, size))
    block[rows, columns] = matrix[row, :, :, :, column - row + DEGREE][inside]
    return block


def dense(matrix: Stencil) -> NDArray[np.float64]:
    """Return the whole matrix; for small ones."""
    planes = matrix.shape[0]
    size = matrix.shape[1] * matrix.shape[2] * matrix.shape[3]
    whole = np.zeros((planes, size, planes, size))
    for row in range(planes):
        for column in range(max(0, row - DEGREE), min(planes, row + DEGREE + 1)):
            whole[row, :, column] = plane_block(matrix, row, column)
    return whole.reshape(planes * size, planes * size)
