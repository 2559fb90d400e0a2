"""How unlike the velocities at two places are, as vectors: an isotropic model of the structure function.

D_ij(r) = <(u_i(x + r) - u_i(x)) (u_j(x + r) - u_j(x))> = A(s) delta_ij + B(s) r_i r_j of s = r^2. One function g(s)
makes both: of the solenoidal part it is the longitudinal structure function, and incompressibility gives the
transverse one, g + s g'; of the potential part it is the transverse one, and that the curl is zero gives the
longitudinal one, g + 2 s g'. A share k of potential flow then has A = g + (1 - k) s g', B = (3 k - 1) g': with
k = 1/3 the components are independent of each other.

g(s) = a s (1 + s/l^2)^(p/2 - 1) (1 + s/L^2)^(-p/2): smooth at no distance, with the power p of r between l and L,
level beyond. It is a complete Bernstein function of s, so that the model is a valid one in space whatever a, l, L > 0
and 0 < p < 2 are.

Axes: offsets (..., 3) in mm, displacements in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from lfpiv_cli.arrays import Floats
from lfpiv_cli.fields.samples import Samples

# The share of potential flow with which components are independent.
INDEPENDENT = 1.0 / 3.0


@dataclass(frozen=True)
class VectorStructure:
    """A structure function, and what the stated errors of the samples leave to add.

    Attributes
    ----------
    factor : a of g, without unit: mm^2 over mm^2
    power : p, between the two lengths
    inner_mm, outer_mm : l and L
    nugget_mm2 : variance of each component of each sample that neither the flow nor the stated errors explain
    error_factor : how large the samples' variances are over the stated ones
    potential_share : k
    """

    factor: float
    power: float
    inner_mm: float
    outer_mm: float
    nugget_mm2: float
    error_factor: float
    potential_share: float

    def parts(self, square: Floats) -> tuple[Floats, Floats]:
        """Return A and B at squared distances, mm^2 and without unit."""
        over, share = self._over_square(square)
        slope = over * share
        kappa = self.potential_share
        return square * (over + (1.0 - kappa) * slope), (3.0 * kappa - 1.0) * slope

    def slopes(self, square: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of A and B with the squared distance."""
        over, share = self._over_square(square)
        inner, outer = self.inner_mm**2, self.outer_mm**2
        first, second = self._exponents()
        curved = over * (
            -(first / (inner + square) + second / (outer + square)) * share
            - first * inner / (inner + square) ** 2
            - second * outer / (outer + square) ** 2
        )
        slope, kappa = over * share, self.potential_share
        return slope + (1.0 - kappa) * (slope + square * curved), (3.0 * kappa - 1.0) * curved

    def steepness(self, distance_mm: float) -> float:
        """Return the power of the distance with which g grows at one."""
        return float(2.0 * self._over_square(np.array(distance_mm**2))[1])

    def mean_at(self, distance_mm: float) -> float:
        """Return the mean square difference of a component over a distance, all directions alike, mm^2."""
        square = np.array(distance_mm**2)
        level, along = self.parts(square)
        return float(level + along * square / 3.0)

    def _exponents(self) -> tuple[float, float]:
        return 1.0 - 0.5 * self.power, 0.5 * self.power

    def _over_square(self, square: Floats) -> tuple[Floats, Floats]:
        """Return g / s and s g' / g."""
        inner, outer = self.inner_mm**2, self.outer_mm**2
        first, second = self._exponents()
        over = self.factor * np.exp(-first * np.log1p(square / inner) - second * np.log1p(square / outer))
        return over, 1.0 - square * (first / (inner + square) + second / (outer + square))


# The equations of kriging vectors from the nearest samples: the best linear unbiased estimate, and how far it is off.
#
# In each neighbourhood the displacement at its middle o is an unknown constant, of large variance V, from which the
# flow differs as the structure function D says: the covariance of u(x) and u(y) is V + (D(x - o) + D(y - o) - D(x -
# y)) / 2, which is positive definite whatever the structure function is. Matrices are ordered by component, then by
# sample.
#
# Axes: b places, k samples around each, nearest first; points and displacements in mm.


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

    value_mm: Floats
    covariance_mm2: Floats


def unknown_variance(samples: Samples) -> float:
    """Return the variance of the constant of each neighbourhood, mm^2."""
    spread = float(np.var(samples.value_mm, axis=0).max())
    stated = float(np.einsum("nii->n", samples.covariance_mm2).mean())
    return UNKNOWN_TIMES * (spread + stated)


def between(points: Floats, errors: Floats, structure: VectorStructure, unknown: float) -> Floats:
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


def _halves(offset: Floats, structure: VectorStructure) -> Floats:
    """Return half the structure function (b, 3, k, 3) at offsets (b, k, 3)."""
    level, along = structure.parts(np.einsum("bki,bki->bk", offset, offset))
    halves = 0.5 * np.einsum("bk,bki,bkj->bikj", along, offset, offset)
    for i in range(3):
        halves[:, i, :, i] += 0.5 * level
    return halves


def _half_slopes(offset: Floats, structure: VectorStructure) -> Floats:
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


def weights_of(matrices: Floats, rights: Floats) -> Floats:
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


def log_likelihood(matrices: Floats, values: Floats) -> float:
    """Return the sum of the log-likelihoods of neighbourhoods' values (b, 3k); minus infinity where a matrix is bad."""
    total = 0.0
    for matrix, value in zip(matrices, values, strict=True):
        factor, solved, fault = dposv(matrix.T, value, lower=0, overwrite_a=1)
        if fault:
            return -np.inf
        total -= 0.5 * float(value @ solved) + float(np.log(np.diagonal(factor)).sum())
    return total


def estimated(
    at: Floats, near: NDArray[np.int64], samples: Samples, structure: VectorStructure, unknown: float
) -> Estimates:
    """Return the estimates at places (b, 3) from the samples `near` (b, k)."""
    points, values = samples.points_mm[near], samples.value_mm[near]
    middle, usual = points.mean(axis=1, keepdims=True), values.mean(axis=1)
    matrices = between(points, samples.covariance_mm2[near], structure, unknown)
    # The covariances (b, 3k, 3) of the samples with what is at the places, and of that.
    own = _halves(at[:, np.newaxis] - middle, structure)
    aim = _halves(points - middle, structure) - _halves(points - at[:, np.newaxis], structure) + own
    aim += unknown * np.eye(3)[:, np.newaxis]
    aim = aim.reshape(len(at), -1, 3)
    weights = weights_of(matrices, aim)
    about = (values - usual[:, np.newaxis]).swapaxes(1, 2).reshape(len(at), 1, -1)
    missed = 2.0 * own[:, :, 0] + unknown * np.eye(3) - aim.swapaxes(1, 2) @ weights
    return Estimates(usual + (about @ weights)[:, 0], 0.5 * (missed + missed.swapaxes(1, 2)))


def estimated_slopes(
    at: Floats, near: NDArray[np.int64], samples: Samples, structure: VectorStructure, unknown: float
) -> Floats:
    """Return the gradients (b, 3, 3) per mm [component, direction] of the estimates, neighbourhoods held fixed."""
    points, values = samples.points_mm[near], samples.value_mm[near]
    about = (values - values.mean(axis=1, keepdims=True)).swapaxes(1, 2).reshape(len(at), -1, 1)
    potentials = weights_of(between(points, samples.covariance_mm2[near], structure, unknown), about)
    # Those of the covariances with the samples, last axis the direction into which the place moves.
    place = at[:, np.newaxis]
    slopes = _half_slopes(place - points.mean(axis=1, keepdims=True), structure) - _half_slopes(
        place - points, structure
    )
    return np.asarray(np.einsum("bn,bnjl->bjl", potentials[..., 0], slopes.reshape(len(at), -1, 3, 3)))
