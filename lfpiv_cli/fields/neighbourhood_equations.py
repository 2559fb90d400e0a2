"""The equations of kriging vectors from the nearest samples: the best linear unbiased estimate, and how far it is off.

In each neighbourhood the displacement at its middle o is an unknown constant, of large variance V, from which the flow
differs as the structure function D says: the covariance of u(x) and u(y) is V + (D(x - o) + D(y - o) - D(x - y)) / 2,
which is positive definite whatever the structure function is. Matrices are ordered by component, then by sample.

Axes: b places, k samples around each, nearest first; points and displacements in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from lfpiv_cli.fields.samples import Samples
from lfpiv_cli.fields.structure import VectorStructure

# The unknown constant has so many times the variance of the samples.
UNKNOWN_TIMES = 100.0
# No error is smaller than this share of it: it keeps the equations solvable.
SMALLEST_SHARE = 1e-12


@dataclass(frozen=True, eq=False)
class Estimates:
    """What the samples say at m places.

    Attributes
    ----------
    value_mm : (m, 3)
    covariance_mm2 : (m, 3, 3) of what the value is off by
    """

    value_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64]


def unknown_variance(samples: Samples) -> float:
    """Return the variance of the constant of each neighbourhood, mm^2."""
    spread = float(np.var(samples.value_mm, axis=0).max())
    stated = float(np.einsum("nii->n", samples.covariance_mm2).mean())
    return UNKNOWN_TIMES * (spread + stated)


def between(
    points: NDArray[np.float64], errors: NDArray[np.float64], structure: VectorStructure, unknown: float
) -> NDArray[np.float64]:
    """Return the covariances (b, 3k, 3k) of samples at points (b, k, 3) with errors (b, k, 3, 3).

    Only the part that Cholesky's factorisation reads is there: components (i, j) with i >= j.
    """
    places, count, _ = points.shape
    apart = np.moveaxis(points[:, :, np.newaxis] - points[:, np.newaxis], -1, 0)
    square = np.einsum("cbij,cbij->bij", apart, apart)
    level, along = structure.parts(square)
    level *= -0.5
    along *= -0.5
    from_middle = _halves(points - points.mean(axis=1, keepdims=True), structure)
    matrix = np.zeros((places, 3, count, 3, count))
    each = np.arange(count)
    for i in range(3):
        scaled = along * apart[i]
        for j in range(i + 1):
            block = matrix[:, i, :, j]
            np.multiply(scaled, apart[j], out=block)
            block += from_middle[:, i, :, j, np.newaxis]
            block += from_middle[:, i, np.newaxis, :, j]
            block[:, each, each] += structure.error_factor * errors[..., i, j]
            if i == j:
                block += level + unknown
                block[:, each, each] += structure.nugget_mm2 + SMALLEST_SHARE * unknown
    return matrix.reshape(places, 3 * count, 3 * count)


def towards(
    at: NDArray[np.float64], points: NDArray[np.float64], structure: VectorStructure, unknown: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the covariances (b, 3k, 3) of samples at points (b, k, 3) with what is at places (b, 3), and of that."""
    middle = points.mean(axis=1, keepdims=True)
    own = _halves(at[:, np.newaxis] - middle, structure)
    aim = _halves(points - middle, structure) - _halves(points - at[:, np.newaxis], structure) + own
    aim += unknown * np.eye(3)[:, np.newaxis]
    return aim.reshape(len(at), -1, 3), 2.0 * own[:, :, 0] + unknown * np.eye(3)


def towards_slopes(
    at: NDArray[np.float64], points: NDArray[np.float64], structure: VectorStructure
) -> NDArray[np.float64]:
    """Return the derivatives (b, 3k, 3, 3) of `towards`, last axis the direction into which the place moves."""
    place = at[:, np.newaxis]
    slopes = _half_slopes(place - points.mean(axis=1, keepdims=True), structure)
    return (slopes - _half_slopes(place - points, structure)).reshape(len(at), -1, 3, 3)


def _halves(offset: NDArray[np.float64], structure: VectorStructure) -> NDArray[np.float64]:
    """Return half the structure function (b, 3, k, 3) at offsets (b, k, 3)."""
    level, along = structure.parts(np.einsum("bki,bki->bk", offset, offset))
    halves = 0.5 * np.einsum("bk,bki,bkj->bikj", along, offset, offset)
    for i in range(3):
        halves[:, i, :, i] += 0.5 * level
    return halves


def _half_slopes(offset: NDArray[np.float64], structure: VectorStructure) -> NDArray[np.float64]:
    """Return the derivatives (b, 3, k, 3, 3) of `_halves`, last axis their direction."""
    square = np.einsum("bki,bki->bk", offset, offset)
    half = 0.5 * structure.parts(square)[1][..., np.newaxis] * offset
    level_slope, along_slope = structure.slopes(square)
    slopes = np.einsum("bk,bki,bkj,bkl->bikjl", along_slope, offset, offset, offset)
    for i in range(3):
        slopes[:, i, :, i] += level_slope[..., np.newaxis] * offset
        slopes[:, i, :, :, i] += half
        slopes[:, :, :, i, i] += half.swapaxes(1, 2)
    return np.asarray(slopes)


def weights_of(matrices: NDArray[np.float64], rights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the solutions (b, 3k, c) of symmetric positive definite equations; the matrices are used up.

    Raises
    ------
    numpy.linalg.LinAlgError
        A matrix is not positive definite.
    """
    solved = np.empty_like(rights)
    for place, (matrix, right) in enumerate(zip(matrices, rights, strict=True)):
        # the transposed matrix is in the order of columns, whose upper triangle is the lower one here
        _, solved[place], fault = dposv(matrix.T, right, lower=0, overwrite_a=1)
        if fault:
            raise np.linalg.LinAlgError("the covariances of neighbouring samples are not positive definite")
    return solved


def log_likelihood(matrices: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """Return the sum of the log-likelihoods of neighbourhoods' values (b, 3k); minus infinity where a matrix is bad."""
    total = 0.0
    for matrix, value in zip(matrices, values, strict=True):
        factor, solved, fault = dposv(matrix.T, value, lower=0, overwrite_a=1)
        if fault:
            return -np.inf
        total -= 0.5 * float(value @ solved) + float(np.log(np.diagonal(factor)).sum())
    return total


def estimated(
    at: NDArray[np.float64],
    near: NDArray[np.int64],
    samples: Samples,
    structure: VectorStructure,
    unknown: float,
) -> Estimates:
    """Return the estimates at places (b, 3) from the samples `near` (b, k)."""
    points, values = samples.points_mm[near], samples.value_mm[near]
    middle = values.mean(axis=1)
    matrices = between(points, samples.covariance_mm2[near], structure, unknown)
    aim, own = towards(at, points, structure, unknown)
    weights = weights_of(matrices, aim)
    about = (values - middle[:, np.newaxis]).swapaxes(1, 2).reshape(len(at), 1, -1)
    value = middle + (about @ weights)[:, 0]
    missed = own - aim.swapaxes(1, 2) @ weights
    return Estimates(value, 0.5 * (missed + missed.swapaxes(1, 2)))


def estimated_slopes(
    at: NDArray[np.float64],
    near: NDArray[np.int64],
    samples: Samples,
    structure: VectorStructure,
    unknown: float,
) -> NDArray[np.float64]:
    """Return the gradients (b, 3, 3) per mm [component, direction] of the estimates, neighbourhoods held fixed."""
    points, values = samples.points_mm[near], samples.value_mm[near]
    about = (values - values.mean(axis=1, keepdims=True)).swapaxes(1, 2).reshape(len(at), -1, 1)
    potentials = weights_of(between(points, samples.covariance_mm2[near], structure, unknown), about)
    slopes = towards_slopes(at, points, structure)
    return np.asarray(np.einsum("bn,bnjl->bjl", potentials[..., 0], slopes))
