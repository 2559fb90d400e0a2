"""Cholesky's factorisation of block tridiagonal matrices, and those blocks of the inverse that variances need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dpotri

from lfpiv_cli.fields.lattice import DEGREE
from lfpiv_cli.fields.stencils import Stencil, plane_block

Block = NDArray[np.float64]


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

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
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
        diagonal, below = [_inverse(self.diagonal[-1])], []
        for factor, under in zip(reversed(self.diagonal[:-1]), reversed(self.below), strict=True):
            across = solve_triangular(factor, under.T, lower=True, trans="T").T
            minus = -diagonal[-1] @ across
            below.append(minus)
            diagonal.append(_inverse(factor) - across.T @ minus)
        return diagonal[::-1], below[::-1]


def _inverse(factor: Block) -> Block:
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
    size = matrix.shape[1] * matrix.shape[2] * matrix.shape[3]
    block = np.zeros((len(rows), size, len(columns), size))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            if abs(row - column) <= DEGREE:
                block[i, :, j] = plane_block(matrix, row, column)
    return block.reshape(len(rows) * size, len(columns) * size)
