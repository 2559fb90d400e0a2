"""Cubic B-splines on a box: a lattice of knots, the four splines along each axis that reach a point, their integrals.

Axes: points (n, 3) in mm; knots are numbered along x, y, z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

DEGREE = 3
# Splines that are not zero within one cell, along one axis.
SUPPORT = DEGREE + 1
# Splines that overlap with one spline, along one axis.
NEIGHBOURS = 2 * DEGREE + 1
# Gauss points in a cell: exact for products of two cubic pieces.
GAUSS_POINTS = 4
# A box that is a whole number of cells long but for rounding has this number.
ROUNDING = 1e-9


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

    @property
    def high_mm(self) -> NDArray[np.float64]:
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
    def volume_mm3(self) -> float:
        """The box' volume."""
        return float(np.prod(np.multiply(self.cells, self.cell_mm)))

    @property
    def smallest_mm(self) -> float:
        """The box' smallest length."""
        return float(np.min(np.multiply(self.cells, self.cell_mm)))

    def splines_at(
        self, points_mm: NDArray[np.float64], along: int | None = None
    ) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
        """Return the first spline (n, 3) that reaches each point, and the values (n, 4) of the four, axis by axis.

        A point outside of the box is taken by its nearest cell's polynomials. `along` an axis: the derivative, per mm.
        """
        place = (points_mm - np.asarray(self.low_mm)) / np.asarray(self.cell_mm)
        first = np.clip(np.floor(place).astype(np.int64), 0, np.asarray(self.cells) - 1)
        inside = place - first
        values = [
            _slopes(inside[:, axis]) / self.cell_mm[axis] if axis == along else _values(inside[:, axis])
            for axis in range(3)
        ]
        return first, values

    def integrals(self, axis: int, first: int, second: int) -> NDArray[np.float64]:
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


def _values(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the four splines (n, 4) at places u of a unit cell."""
    rest = 1.0 - u
    terms = [rest**3, 3.0 * u**3 - 6.0 * u**2 + 4.0, 3.0 * rest**3 - 6.0 * rest**2 + 4.0, u**3]
    return np.stack(terms, axis=1) / 6.0


def _slopes(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of the four splines (n, 4) at places u of a unit cell."""
    rest = 1.0 - u
    terms = [-(rest**2), 3.0 * u**2 - 4.0 * u, -3.0 * rest**2 + 4.0 * rest, u**2]
    return 0.5 * np.stack(terms, axis=1)
