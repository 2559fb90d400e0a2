"""Gradients of a scalar as samples: what each spline has of them, and their part of the normal equations.

Axes: a gradient's components (x, y, z), per mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numba
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.fields import stencils
from lfpiv_cli.fields.evidence import Box
from lfpiv_cli.fields.lattice import DEGREE, SUPPORT, Lattice
from lfpiv_cli.fields.samples import Samples

Floats = NDArray[np.float64]


def rows_of(lattice: Lattice, points_mm: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return numbers (n, 64) and gradients (n, 3, 64) of the splines that reach each point."""
    parts = [stencils.rows_of(lattice, points_mm, axis) for axis in range(3)]
    return parts[0][0], np.stack([values for _, values in parts], axis=1)


def gradient_at(points_mm: Floats, lattice: Lattice, coefficients: Floats) -> Floats:
    """Return the gradients (n, 3) of the scalar with coefficients (nx, ny, nz)."""
    columns, rows = rows_of(lattice, points_mm)
    return np.asarray(np.einsum("nik,nk->ni", rows, coefficients.ravel()[columns]))


@dataclass(frozen=True, eq=False)
class GradientBox(Box):
    """A part of the samples, which are gradients, and those of the splines at them, (n, 3, k)."""

    components: ClassVar[int] = 1
    integrals: ClassVar[int] = 1

    @classmethod
    def around(cls, lattice: Lattice, samples: Samples) -> Self:
        """Return the box of a lattice and the samples in it."""
        columns, values = rows_of(lattice, samples.points_mm)
        splines = np.zeros((len(samples), 3, int(np.prod(lattice.shape))))
        np.put_along_axis(splines, columns[:, np.newaxis], values, axis=2)
        return cls(lattice, samples, splines)

    def normal(self, weight: Floats) -> tuple[Floats, Floats]:
        """Return the normal equations of samples with weights (n, 3, 3)."""
        count = self.splines.shape[2]
        rows, weighted = self.splines.reshape(-1, count), (weight @ self.splines).reshape(-1, count)
        return rows.T @ weighted, self.samples.value_mm.ravel() @ weighted

    def field(self, coefficients: Floats) -> Floats:
        """Return the gradients (n, 3) at the samples."""
        return np.asarray(self.splines @ coefficients)

    def covariance(self, inverse: Floats) -> Floats:
        """Return the covariances (n, 3, 3) of the gradients at the samples."""
        return np.asarray(np.einsum("nik,njk->nij", self.splines @ inverse, self.splines, optimize=True))


def add_gradients(matrix: stencils.Stencil, lattice: Lattice, points_mm: Floats, weight: Floats) -> None:
    """Add the normal equations' matrix of gradients at points (n, 3) with weights (n, 3, 3), inverse covariances."""
    _, rows = rows_of(lattice, points_mm)
    first, _ = lattice.splines_at(points_mm)
    _add_rows(matrix, first, np.linalg.cholesky(weight).swapaxes(1, 2) @ rows)


def right_hand_side(lattice: Lattice, points_mm: Floats, weighted: Floats) -> Floats:
    """Return the normal equations' right-hand side (nx ny nz,) of weighted gradients (n, 3)."""
    columns, rows = rows_of(lattice, points_mm)
    parts = np.einsum("nik,ni->nk", rows, weighted)
    size = int(np.prod(lattice.shape))
    return np.asarray(np.bincount(columns.ravel(), parts.ravel(), minlength=size), dtype=np.float64)


@numba.njit(cache=True, nogil=True)
def _add_rows(matrix, first, rows):  # type: ignore[no-untyped-def]  # numba
    """Add the squares of rows (n, m, 64), m of each sample, to the matrix of a scalar."""
    size = SUPPORT * SUPPORT * SUPPORT
    for sample in range(len(first)):
        for p in range(size):
            a, b, c = p // SUPPORT**2, p // SUPPORT % SUPPORT, p % SUPPORT
            row = matrix[first[sample, 0] + a, 0, first[sample, 1] + b, first[sample, 2] + c]
            for q in range(size):
                d, e, f = q // SUPPORT**2, q // SUPPORT % SUPPORT, q % SUPPORT
                total = 0.0
                for each in range(rows.shape[1]):
                    total += rows[sample, each, p] * rows[sample, each, q]
                row[d - a + DEGREE, 0, e - b + DEGREE, f - c + DEGREE] += total
