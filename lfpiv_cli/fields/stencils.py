"""Symmetric matrices of a spline field, kept by each coefficient's neighbours.

A row belongs to the coefficient of one component of one spline, and has entries for the splines that overlap with it:
an array (nx, c, ny, nz, 7, c, 7, 7), whose last four axes are offset along x, other component, offset along y, along z;
c is 3 for velocities and 1 for a scalar. Planes of x come first, so that the rows of neighbouring planes make blocks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import factorial

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dpotri

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.kernels import njit
from lfpiv_cli.threads import share_out

# Cubic B-splines on a box: a lattice of knots, the four splines along each axis that reach a point, their integrals.
#
# Axes: points (n, 3) in mm; knots are numbered along x, y, z.

DEGREE = 3
# Splines that are not zero within one cell, along one axis.
SUPPORT = DEGREE + 1
# Splines that overlap with one spline, along one axis.
NEIGHBOURS = 2 * DEGREE + 1
# Gauss points in a cell: exact for products of two cubic pieces.
GAUSS_POINTS = 4
# A box that is a whole number of cells long but for rounding has this number.
ROUNDING = 1e-9
# A factorisation of three components of so many splines, and what is needed of its inverse, takes seconds and 600 MB.
MOST_SPLINES = 3000
# Knots that are too many are set apart by this factor until they are not; those that a first field has, by this one.
COARSER, WIDE = 1.05, 1.6


@dataclass(frozen=True)
class Lattice:
    """A box in equal cells, with cubic B-splines whose knots are the cells' corners.

    Attributes
    ----------
    low_mm : the box' corner with the smallest x, y, z
    cell_mm : size of a cell along x, y, z
    cells : number of cells along x, y, z
    """

    low_mm: tuple[float, float, float]
    cell_mm: tuple[float, float, float]
    cells: tuple[int, int, int]

    @classmethod
    def over(cls, low_mm: ArrayLike, high_mm: ArrayLike, knot_mm: float) -> Lattice:
        """Return the lattice over a box whose knots are at most so far apart."""
        low = np.asarray(low_mm, dtype=np.float64)
        size = np.asarray(high_mm, dtype=np.float64) - low
        cells = np.maximum(np.ceil(size / knot_mm - ROUNDING).astype(np.int64), 1)
        x, y, z = low.tolist()
        dx, dy, dz = (size / cells).tolist()
        nx, ny, nz = cells.tolist()
        return cls((x, y, z), (dx, dy, dz), (nx, ny, nz))

    @classmethod
    def affordable(cls, low_mm: ArrayLike, high_mm: ArrayLike, knot_mm: float) -> Lattice:
        """Return the lattice over a box, with knots further apart where splines would be too many."""
        while int(np.prod((lattice := cls.over(low_mm, high_mm, knot_mm)).shape)) > MOST_SPLINES:
            knot_mm *= COARSER
        return lattice

    def wide(self) -> Lattice:
        """Return one over the same box whose knots are further apart: no single sample bends a field of such knots."""
        return Lattice.over(self.low_mm, self.high_mm, WIDE * max(self.cell_mm))

    @property
    def high_mm(self) -> Floats:
        """The box' corner with the largest x, y, z."""
        return np.asarray(np.add(self.low_mm, np.multiply(self.cells, self.cell_mm)))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of splines along x, y, z."""
        nx, ny, nz = self.cells
        return nx + DEGREE, ny + DEGREE, nz + DEGREE

    @property
    def unknowns(self) -> int:
        """Number of coefficients of a field of three components."""
        return 3 * int(np.prod(self.shape))

    @property
    def smallest_mm(self) -> float:
        """The box' smallest length."""
        return float(np.min(np.multiply(self.cells, self.cell_mm)))

    def splines_at(self, points_mm: Floats, along: int | None = None) -> tuple[Integers, list[Floats]]:
        """Return the first spline (n, 3) that reaches each point, and the values (n, 4) of the four, axis by axis.

        A point outside of the box is taken by its nearest cell's polynomials. `along` an axis: the derivative, per mm.
        """
        place = (points_mm - np.asarray(self.low_mm)) / np.asarray(self.cell_mm)
        first = np.clip(np.floor(place).astype(np.int64), 0, np.asarray(self.cells) - 1)
        found = []
        for axis, u in enumerate((place - first).T):
            # At places u of a unit cell.
            rest = 1.0 - u
            if axis == along:
                slopes = [-(rest**2), 3.0 * u**2 - 4.0 * u, -3.0 * rest**2 + 4.0 * rest, u**2]
                found.append(0.5 * np.stack(slopes, axis=1) / self.cell_mm[axis])
            else:
                values = [rest**3, 3.0 * u**3 - 6.0 * u**2 + 4.0, 3.0 * rest**3 - 6.0 * rest**2 + 4.0, u**3]
                found.append(np.stack(values, axis=1) / 6.0)
        return first, found

    def integrals(self, axis: int, first: int, second: int) -> Floats:
        """Return the integrals (n, 7) of derivatives of splines i and i + k - 3 along an axis over the box, 0 beyond.

        `first`, `second` : order of the derivative of the one and of the other
        """
        cells, cell = self.cells[axis], self.cell_mm[axis]
        count = cells + DEGREE
        splines = BSpline(np.arange(-DEGREE, count + 1) * cell, np.eye(count), DEGREE)
        nodes, weights = np.polynomial.legendre.leggauss(GAUSS_POINTS)
        at = ((np.arange(cells)[:, np.newaxis] + 0.5 + 0.5 * nodes) * cell).ravel()
        left, right = (splines.derivative(order)(at) if order else splines(at) for order in (first, second))
        product = left.T @ (np.tile(0.5 * cell * weights, cells)[:, np.newaxis] * right)
        banded = np.zeros((count, NEIGHBOURS))
        for k in range(NEIGHBOURS):
            shift = k - DEGREE
            rows = np.arange(max(0, -shift), min(count, count - shift))
            banded[rows, k] = product[rows, rows + shift]
        return banded


Stencil = Floats


def empty(lattice: Lattice, components: int = 3) -> Stencil:
    """Return the matrix of zeros."""
    nx, ny, nz = lattice.shape
    return np.zeros((nx, components, ny, nz, NEIGHBOURS, components, NEIGHBOURS, NEIGHBOURS))


def add_scalar(matrix: Stencil, factor: float, integrals: Floats, components: slice = slice(None)) -> None:
    """Add `factor` times what is alike for some components, or all: (nx, ny, nz, 7, 7, 7) of one of them."""
    for component in range(matrix.shape[1])[components]:
        matrix[:, component, :, :, :, component] += factor * integrals


def smoothness(lattice: Lattice, order: int) -> Floats:
    """Return the integral of the square of all derivatives of one order, of one component: (nx, ny, nz, 7, 7, 7)."""
    total = np.zeros((*lattice.shape, NEIGHBOURS, NEIGHBOURS, NEIGHBOURS))
    along = [[lattice.integrals(axis, each, each) for each in range(order + 1)] for axis in range(3)]
    for i in range(order + 1):
        for j in range(order + 1 - i):
            k = order - i - j
            times = factorial(order) / (factorial(i) * factorial(j) * factorial(k))
            total += times * _product(along[0][i], along[1][j], along[2][k])
    return total


def _product(x: Floats, y: Floats, z: Floats) -> Floats:
    """Return the products (nx, ny, nz, 7, 7, 7) of integrals (n, 7) along three axes."""
    return np.asarray(
        x[:, None, None, :, None, None] * y[None, :, None, None, :, None] * z[None, None, :, None, None, :]
    )


def add_samples(matrix: Stencil, lattice: Lattice, points_mm: Floats, weight: Floats) -> None:
    """Add the normal equations' matrix of samples at points (n, 3) with weights (n, 3, 3), inverse covariances."""
    first, (x, y, z) = lattice.splines_at(points_mm)
    share_out(_add_samples, len(matrix), matrix, first, x, y, z, np.ascontiguousarray(weight))


@njit(cache=True, nogil=True)
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


def right_hand_side(lattice: Lattice, points_mm: Floats, weighted: Floats) -> Floats:
    """Return the normal equations' right-hand side (nx, 3, ny, nz) of weighted values (n, 3)."""
    columns, values = rows_of(lattice, points_mm)
    size = int(np.prod(lattice.shape))
    found = np.empty((3, *lattice.shape))
    for component in range(3):
        parts = (values * weighted[:, component, np.newaxis]).ravel()
        found[component] = np.bincount(columns.ravel(), parts, minlength=size).reshape(lattice.shape)
    return np.ascontiguousarray(found.transpose(1, 0, 2, 3))


def rows_of(lattice: Lattice, points_mm: Floats, along: int | None = None) -> tuple[Integers, Floats]:
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


def gradient_rows(lattice: Lattice, points_mm: Floats) -> tuple[Integers, Floats]:
    """Return numbers (n, 64) and gradients (n, 3, 64) of the splines that reach each point."""
    parts = [rows_of(lattice, points_mm, axis) for axis in range(3)]
    return parts[0][0], np.stack([values for _, values in parts], axis=1)


@lru_cache(maxsize=4)
def _pattern(components: int, ny: int, nz: int) -> tuple[Integers, Integers, Flags]:
    """Return the rows and columns of a plane's block that have entries, and which of the stencil's these are."""
    one, y, z, other, j, k = np.indices((components, ny, nz, components, NEIGHBOURS, NEIGHBOURS))
    to_y, to_z = y + j - DEGREE, z + k - DEGREE
    inside = (to_y >= 0) & (to_y < ny) & (to_z >= 0) & (to_z < nz)
    rows, columns = (one * ny + y) * nz + z, (other * ny + to_y) * nz + to_z
    return rows[inside], columns[inside], inside


def dense(matrix: Stencil) -> Floats:
    """Return the whole matrix; for small ones."""
    planes = range(matrix.shape[0])
    return _block(matrix, planes, planes)


# What a spline field is expected to be before any sample is seen: smooth, and of little divergence.
#
# The field is thought of as Gaussian, with the inverse covariance: weight times integral of squared second
# derivatives, plus the same of third ones, plus the same of the divergence. Second derivatives alone make the
# spectrum k^-2 of turbulence nearly (k^-5/3), third ones that of smooth flows, k^-4; the weights say how much of each
# there is: of the lateral components, and of the one in depth, whose samples are known so much worse that it would be
# smoothed by what the others show to be missing in waves that it cannot tell from noise.

SECOND, THIRD, DIVERGENCE = "second", "third", "divergence"
SECOND_IN_DEPTH, THIRD_IN_DEPTH = "second_in_depth", "third_in_depth"
ORDERS = {SECOND: 2, THIRD: 3, SECOND_IN_DEPTH: 2, THIRD_IN_DEPTH: 3}
LATERAL, IN_DEPTH = slice(0, 2), slice(2, 3)
SMOOTHNESS = (SECOND, THIRD, SECOND_IN_DEPTH, THIRD_IN_DEPTH)
# Constants and linear fields are not penalised by derivatives; they are expected up to ten times the samples' spread.
SPREADS = 10.0


@dataclass(frozen=True)
class Expectation:
    """The weights of the penalties, and what is known of the samples' errors.

    Attributes
    ----------
    weights : of the integrals, by the penalty's name: mm^(2 order - 3) mm^-2 of squared displacements
    spread_mm : of the samples' values
    scale : by which stated standard errors are multiplied
    unresolved_mm : standard deviation, along each axis, of what the field does within less than a cell
    """

    weights: Mapping[str, float]
    spread_mm: float
    scale: float
    unresolved_mm: float


def penalty(lattice: Lattice, name: str, components: int = 3) -> Stencil:
    """Return the integral over the box of the squared divergence, or of the squared derivatives of an order."""
    matrix = empty(lattice, components)
    if name == DIVERGENCE:
        for one in range(3):
            for other in range(3):
                orders = [(int(axis == one), int(axis == other)) for axis in range(3)]
                along = [lattice.integrals(axis, *orders[axis]) for axis in range(3)]
                matrix[:, one, :, :, :, other] = _product(*along)
        return matrix
    of = IN_DEPTH if name in (SECOND_IN_DEPTH, THIRD_IN_DEPTH) else LATERAL
    add_scalar(matrix, 1.0, smoothness(lattice, ORDERS[name]), of)
    return matrix


def bound(lattice: Lattice, spread_mm: float, components: int = 3) -> Stencil:
    """Return what keeps fields bounded that no other penalty sees."""
    matrix = empty(lattice, components)
    factor = 1.0 / ((SPREADS * spread_mm) ** 2 * float(np.prod(np.multiply(lattice.cells, lattice.cell_mm))))
    add_scalar(matrix, factor, smoothness(lattice, 0))
    return matrix


def expected_inverse(lattice: Lattice, expected: Expectation, components: int = 3) -> Stencil:
    """Return the inverse covariance of a field before any sample."""
    matrix = bound(lattice, expected.spread_mm, components)
    for name, weight in expected.weights.items():
        matrix += weight * penalty(lattice, name, components)
    return matrix


# Cholesky's factorisation of block tridiagonal matrices, and those blocks of the inverse that variances need.

Block = Floats


@dataclass(frozen=True, eq=False)
class Factor:
    """A symmetric positive definite matrix A = F F^T.

    Attributes
    ----------
    diagonal : lower triangular blocks of F
    below : blocks of F below each diagonal one but the last
    """

    diagonal: Sequence[Block]
    below: Sequence[Block]

    def solve(self, right: Floats) -> Floats:
        """Return x of A x = right, (n,)."""
        edges = np.cumsum([len(block) for block in self.diagonal])[:-1]
        parts = np.split(right, edges)
        for i, block in enumerate(self.diagonal):
            if i:
                parts[i] = parts[i] - self.below[i - 1] @ parts[i - 1]
            parts[i] = solve_triangular(block, parts[i], lower=True)
        for i in reversed(range(len(parts))):
            if i + 1 < len(parts):
                parts[i] = parts[i] - self.below[i].T @ parts[i + 1]
            parts[i] = solve_triangular(self.diagonal[i], parts[i], lower=True, trans="T")
        return np.concatenate(parts)

    def inverse(self) -> tuple[list[Block], list[Block]]:
        """Return the diagonal blocks of the inverse of A and those below them (Takahashi's recursion by blocks)."""
        diagonal, below = [inverse_of(self.diagonal[-1])], []
        for factor, under in zip(reversed(self.diagonal[:-1]), reversed(self.below), strict=True):
            across = solve_triangular(factor, under.T, lower=True, trans="T").T
            minus = -diagonal[-1] @ across
            below.append(minus)
            diagonal.append(inverse_of(factor) - across.T @ minus)
        return diagonal[::-1], below[::-1]


def inverse_of(factor: Block) -> Block:
    """Return the inverse of the matrix whose lower triangular factor is given."""
    lower = np.tril(dpotri(factor, lower=1)[0])
    return lower + np.tril(lower, -1).T


def factorised(matrix: Stencil) -> Factor:
    """Factorise the matrix of a spline field.

    Raises
    ------
    numpy.linalg.LinAlgError
        It is not positive definite.
    """
    planes = matrix.shape[0]
    starts = list(range(0, planes, DEGREE))
    parts = [range(start, min(start + DEGREE, planes)) for start in starts]
    diagonal: list[Block] = []
    below: list[Block] = []
    for number, rows in enumerate(parts):
        block = _block(matrix, rows, rows)
        if number:
            under = _block(matrix, rows, parts[number - 1])
            under = solve_triangular(diagonal[-1], under.T, lower=True, overwrite_b=True).T
            block -= under @ under.T
            below.append(under)
        diagonal.append(cholesky(block, lower=True, overwrite_a=True, check_finite=False))
    return Factor(diagonal, below)


def _block(matrix: Stencil, rows: range, columns: range) -> Block:
    """Return the dense block of some planes' rows and others' columns."""
    _, components, ny, nz, *_ = matrix.shape
    size = components * ny * nz
    block = np.zeros((len(rows), size, len(columns), size))
    one, other, inside = _pattern(components, ny, nz)
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            # Those of planes of x that are further apart are 0.
            if abs(row - column) <= DEGREE:
                block[i, one, j, other] = matrix[row, :, :, :, column - row + DEGREE][inside]
    return block.reshape(len(rows) * size, len(columns) * size)
