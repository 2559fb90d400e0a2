"""Velocities at scattered points with all that is known of their errors, and how unlike those at two places are.

The model of the structure function, of vectors, is isotropic:
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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dposv

from lfpiv_cli.arrays import Flags, Floats, Integers

# Of the middle of two places with independent errors, whose difference is the displacement.
OF_MIDDLES = 0.25


@dataclass(frozen=True, eq=False)
class Samples:
    """Displacements at points, of tracks or of interrogation windows.

    Attributes
    ----------
    points_mm : (n, 3) where
    value_mm : (n, 3) displacement from one frame to the next
    covariance_mm2 : (n, 3, 3) of its error
    probability : (n,) that it belongs to the flow at all, as of a link
    place_share : (n,) or for all: the covariance of the points themselves, as a share; a quarter for the middle of two
        places whose difference is the displacement, 0 for windows
    """

    points_mm: Floats
    value_mm: Floats
    covariance_mm2: Floats
    probability: Floats
    place_share: Floats | float = OF_MIDDLES

    def __len__(self) -> int:
        return len(self.points_mm)

    def subset(self, which: Flags | Integers) -> Samples:
        """Return some of them."""
        return replace(
            self,
            points_mm=self.points_mm[which],
            value_mm=self.value_mm[which],
            covariance_mm2=self.covariance_mm2[which],
            probability=self.probability[which],
            place_share=self.place_share if np.ndim(self.place_share) == 0 else np.asarray(self.place_share)[which],
        )


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several sources."""
    shares = [np.broadcast_to(part.place_share, len(part)) for part in parts]
    return Samples(
        np.concatenate([part.points_mm for part in parts]),
        np.concatenate([part.value_mm for part in parts]),
        np.concatenate([part.covariance_mm2 for part in parts]),
        np.concatenate([part.probability for part in parts]),
        np.concatenate(shares),
    )


def with_places(samples: Samples, gradient: Floats) -> Samples:
    """Return the samples with the errors that follow from those of their places.

    `gradient` : (n, 3, 3) of the displacement, the component, then the direction
    """
    of_places = np.reshape(samples.place_share, (-1, 1, 1)) * samples.covariance_mm2
    through = np.einsum("nij,njk,nlk->nil", gradient, of_places, gradient)
    return replace(samples, covariance_mm2=samples.covariance_mm2 + through)


# How far samples lie off a field, and with which probability each belongs to it.

# Stated probabilities are not believed beyond these: a wrong link may look like a sure one, a doubtful one be right.
LEAST_PROBABLE, MOST_PROBABLE = 0.3, 0.98


def error_covariance(samples: Samples, scale: float, unresolved_mm: float) -> Floats:
    """Return the covariances (n, 3, 3) of samples about a field that leaves something unresolved."""
    return np.asarray(scale**2 * samples.covariance_mm2 + unresolved_mm**2 * np.eye(samples.value_mm.shape[1]))


def inverse_covariances(covariance: Floats, probability: Floats) -> Floats:
    """Return the weights (n, 3, 3) of samples that belong to a field with a probability (n,)."""
    return np.asarray(probability[:, np.newaxis, np.newaxis] * np.linalg.inv(covariance))


def squares(error_mm: Floats, covariance: Floats) -> Floats:
    """Return the squared Mahalanobis distances (n,) of errors (n, 3) by their covariances (n, 3, 3)."""
    return np.asarray(np.einsum("ni,nij,nj->n", error_mm, np.linalg.inv(covariance), error_mm))


def without_itself(error_mm: Floats, field: Floats, weight: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return how far each sample lies off the field that the others alone make, and the covariance of that.

    Parameters
    ----------
    error_mm : (n, 3) off the field of all
    field : (n, 3, 3) covariance of the field of all at the samples
    weight : (n, 3, 3) with which each has taken part
    covariance : (n, 3, 3) of the sample's own error
    """
    left = np.eye(error_mm.shape[1]) - np.einsum("nij,njk->nik", field, weight)
    alone = np.linalg.solve(left, np.concatenate([error_mm[..., np.newaxis], field], axis=2))
    of_field = 0.5 * (alone[..., 1:] + alone[..., 1:].swapaxes(1, 2))
    return alone[..., 0], covariance + of_field


def belonging(samples: Samples, error_mm: Floats, covariance: Floats, spread_mm: float) -> Floats:
    """Return the probability (n,) of each sample to belong to the field, by Bayes' rule.

    One that does not belong may be anything that displacements are: Gaussian of their spread about the field.
    """
    prior = np.clip(samples.probability, LEAST_PROBABLE, MOST_PROBABLE)
    size = error_mm.shape[1]
    near = squares(error_mm, covariance) + np.linalg.slogdet(covariance)[1]
    wide = covariance + spread_mm**2 * np.eye(size)
    far = squares(error_mm, wide) + np.linalg.slogdet(wide)[1]
    odds = np.log(prior) - np.log1p(-prior) + 0.5 * (far - near)
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0))))


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
    at: Floats, near: Integers, samples: Samples, structure: VectorStructure, unknown: float
) -> tuple[Floats, Floats]:
    """Return the estimates (b, 3) at places (b, 3) from the samples `near` (b, k), and their errors' covariances (b, 3,
    3).
    """
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
    return usual + (about @ weights)[:, 0], 0.5 * (missed + missed.swapaxes(1, 2))


def estimated_slopes(
    at: Floats, near: Integers, samples: Samples, structure: VectorStructure, unknown: float
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
