"""A velocity field of cubic B-splines, fitted to all samples at once.

Each sample counts by its full covariance, penalties on derivatives and on the divergence by the weights that make the
samples most probable. Samples that do not belong to the field, as wrong links, lose their weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.fields import stencils
from lfpiv_cli.fields.evidence import FREE_DIVERGENCE, divergence_weight, first_expectation, most_probable
from lfpiv_cli.fields.structure import Samples, belonging, error_covariance, inverse_covariances, squares, with_places

# Knots are so many times the samples' mean distance apart: a third as many knots as samples. Among factors of 1.2 to
# 1.8, less adds noise where samples are few, and more holds divergence and values of small vortices further off.
KNOTS_OF_DISTANCE = 1.4
# Rounds of weighing samples; the last change of their probabilities that matters, on the average.
ROUNDS, LAST_CHANGE = 4, 0.002
POINTS_AT_ONCE = 500
# So many samples for each unknown tell such a field.
ENOUGH_OF_UNKNOWNS = 1
# Penalties have taken something where what is put back varies by more than this share of the fit's variance: it is
# at most 0.13 where stated errors cover the truth, and 0.2 to 0.8 where they cover 0.66 to 0.9 of it. Twice what is put
# back is the error that may be left: they cover 0.88 to 1 then.
TAKEN, LEFT = 0.15, 2.0
# Walls hold the field to 0 within this share of the samples' spread at each of their points.
STILL_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class SplineField:
    """A fitted field.

    Attributes
    ----------
    lattice : of the knots
    coefficients : (nx, 3, ny, nz) mm
    covariance : blocks of the coefficients' covariance: on the diagonal, and below it
    mean_mm : displacement that is added everywhere
    expected : the penalties' weights and the errors' scales
    probability : (n,) of each sample to belong to the field
    reduced_chi2 : mean square of the samples' errors over that of the stated ones
    put_back : (nx, 3, ny, nz) mm, what of the coefficients penalties had taken
    """

    lattice: stencils.Lattice
    coefficients: Floats
    covariance: tuple[list[stencils.Block], list[stencils.Block]]
    mean_mm: Floats
    expected: stencils.Expectation
    probability: Floats
    reduced_chi2: float
    put_back: Floats

    def value_at(self, points_mm: Floats) -> Floats:
        """Return displacements (m, 3) at points."""
        return self.mean_mm + _field_at(points_mm, self.lattice, self.coefficients)

    def gradient_at(self, points_mm: Floats) -> Floats:
        """Return the gradients (m, 3, 3) per mm: the component, then the direction."""
        parts = [_field_at(points_mm, self.lattice, self.coefficients, axis) for axis in range(3)]
        return np.stack(parts, axis=2)

    def estimate_at(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Return displacements and their variances (m, 3)."""
        return self.value_at(points_mm), self.variance_at(points_mm)

    def reported(self) -> dict[str, Any]:
        """Return how the field was fitted: figures with their units in their names."""
        return {
            "method": "splines",
            "knots_mm": list(self.lattice.cell_mm),
            "knots": list(self.lattice.shape),
            "penalty_weights": dict(self.expected.weights),
            "error_scale": self.expected.scale,
            "unresolved_mm": self.expected.unresolved_mm,
            "reduced_chi2": self.reduced_chi2,
            "put_back_mm": np.sqrt(np.mean(self.put_back**2, axis=(0, 2, 3))).tolist(),
            "belonging": float(np.sum(self.probability)),
        }

    def variance_at(self, points_mm: Floats) -> Floats:
        """Return the variances (m, 3), with those of what the splines leave unresolved and what penalties may take."""
        found = np.empty(points_mm.shape)
        for start in range(0, len(points_mm), POINTS_AT_ONCE):
            part = slice(start, start + POINTS_AT_ONCE)
            found[part] = self._variance(points_mm[part])
        taken = LEFT * _field_at(points_mm, self.lattice, self.put_back) if self.put_back.any() else 0.0
        return found + self.expected.unresolved_mm**2 + taken**2

    def _variance(self, points_mm: Floats) -> Floats:
        columns, values = stencils.rows_of(self.lattice, points_mm)
        plane = int(np.prod(self.lattice.shape[1:]))
        planes, within = columns // plane, columns % plane
        diagonal, below = self.covariance
        length, each = len(diagonal[0]) // (3 * plane), columns.shape[1] // 4
        found = np.zeros(points_mm.shape)
        for first in np.unique(planes[:, 0]).tolist():
            # Points whose splines begin in one plane of x.
            which = np.flatnonzero(planes[:, 0] == first)
            for one, other in zip(*np.tril_indices(4), strict=True):
                up, low = first + one, first + other
                block = diagonal[up // length] if up // length == low // length else below[low // length]
                left, right = slice(one * each, (one + 1) * each), slice(other * each, (other + 1) * each)
                for axis in range(3):
                    row = (up % length * 3 + axis) * plane + within[which, left]
                    column = (low % length * 3 + axis) * plane + within[which, right]
                    part = block[row[:, :, np.newaxis], column[:, np.newaxis]]
                    term = np.einsum("ni,nij,nj->n", values[which, left], part, values[which, right])
                    found[which, axis] += term if one == other else 2.0 * term
        return found


def lattice_for(samples: int, low_mm: Floats, high_mm: Floats) -> stencils.Lattice:
    """Return the knots for so many samples in a box."""
    distance = float(np.prod(np.subtract(high_mm, low_mm)) / max(samples, 1)) ** (1.0 / 3.0)
    return stencils.Lattice.affordable(low_mm, high_mm, KNOTS_OF_DISTANCE * distance)


def spline_field(
    samples: Samples, lattice: stencils.Lattice, divergence: str, rng: np.random.Generator, still_mm: Floats
) -> SplineField:
    """Fit a field.

    Parameters
    ----------
    samples : what is known, without gross outliers
    lattice : the knots, over all samples
    divergence : "penalised", "free" or "off"
    rng : draws the boxes that tell the penalties' weights
    still_mm : (k, 3) points where the displacement is 0: on walls
    """
    mean = np.median(samples.value_mm, axis=0) if not len(still_mm) else np.zeros(3)
    about = replace(samples, value_mm=samples.value_mm - mean)
    penalties = stencils.SMOOTHNESS if divergence == "off" else (*stencils.SMOOTHNESS, stencils.DIVERGENCE)
    expected = first_expectation(about, lattice, penalties)
    # The gradients of a field of wide knots tell what errors of places add.
    wide = lattice.wide()
    few = np.sort(rng.choice(len(about), min(len(about), ENOUGH_OF_UNKNOWNS * wide.unknowns), replace=False))
    part = about.subset(few)
    covariance = error_covariance(part, 1.0, expected.unresolved_mm)
    _, coefficients = _solved(part, wide, _before(wide, expected, still_mm), covariance, part.probability)
    gradient = [_field_at(about.points_mm, wide, coefficients, axis) for axis in range(3)]
    about = with_places(about, np.stack(gradient, axis=2))
    # With `by_others`, the covariance of the field at a sample that takes no part, one left out may return.
    expected, by_others = most_probable(about, lattice, expected, rng)
    if divergence == "free":
        weights = {**expected.weights, stencils.DIVERGENCE: divergence_weight(expected, lattice, FREE_DIVERGENCE)}
        expected = replace(expected, weights=weights)
    before, probability = _before(lattice, expected, still_mm), about.probability
    covariance = error_covariance(about, expected.scale, expected.unresolved_mm)
    for _ in range(ROUNDS):
        factor, coefficients = _solved(about, lattice, before, covariance, probability)
        error = about.value_mm - _field_at(about.points_mm, lattice, coefficients)
        last, probability = probability, belonging(about, error, covariance + by_others, expected.spread_mm)
        if np.mean(np.abs(probability - last)) < LAST_CHANGE:
            break
    chi2 = squares(error, about.covariance_mm2)
    field = SplineField(
        lattice,
        coefficients,
        factor.inverse(),
        mean,
        expected,
        probability,
        float(np.sum(probability * chi2) / (3.0 * np.sum(probability))),
        np.zeros_like(coefficients),
    )
    return _with_put_back(field, factor, about, inverse_covariances(covariance, probability), error)


def _with_put_back(
    field: SplineField, factor: stencils.Factor, about: Samples, weight: Floats, error: Floats
) -> SplineField:
    """Return the field with what penalties have taken of components that have fewer waves than penalties allow for.

    The penalties' weights are the most probable of flows with as much of each wave as they allow for. Where noise is as
    large as a flow of few waves, these are damped. A fit to the errors that are left tells (twicing: Tukey, Exploratory
    Data Analysis, 1977, section 16): where the weights are right it varies by less than the fit's own variance P, by
    P (K + R)^-1 P with K before the samples and R their noise.

    Parameters
    ----------
    factor : of the normal equations
    about, weight : the samples and their weights (n, 3, 3)
    error : (n, 3) of the samples
    """
    right = _right_hand_side(about, field.lattice, weight, error)
    put_back = factor.solve(right.ravel()).reshape(right.shape)
    some = about.points_mm[:: max(len(about) // POINTS_AT_ONCE, 1)]
    share = np.mean(_field_at(some, field.lattice, put_back) ** 2 / field.variance_at(some), axis=0)
    taken = np.where(share[:, np.newaxis, np.newaxis] > TAKEN, put_back, 0.0)
    return replace(field, coefficients=field.coefficients + taken, put_back=taken)


def _right_hand_side(samples: Samples, lattice: stencils.Lattice, weight: Floats, value_mm: Floats) -> Floats:
    """Return the normal equations' right-hand side (nx, 3, ny, nz) of values (n, 3) at the samples' points."""
    return stencils.right_hand_side(lattice, samples.points_mm, np.einsum("nij,nj->ni", weight, value_mm))


def _solved(
    samples: Samples, lattice: stencils.Lattice, before: stencils.Stencil, covariance: Floats, probability: Floats
) -> tuple[stencils.Factor, Floats]:
    """Return the factor of the normal equations and the coefficients (nx, 3, ny, nz)."""
    weight = inverse_covariances(covariance, probability)
    matrix = before.copy()
    stencils.add_samples(matrix, lattice, samples.points_mm, weight)
    right = _right_hand_side(samples, lattice, weight, samples.value_mm)
    factor = stencils.factorised(matrix)
    return factor, factor.solve(right.ravel()).reshape(right.shape)


def _field_at(points_mm: Floats, lattice: stencils.Lattice, coefficients: Floats, along: int | None = None) -> Floats:
    """Return the sum of splines (n, 3) at points, or its derivative along an axis."""
    columns, values = stencils.rows_of(lattice, points_mm, along)
    by_component = coefficients.transpose(1, 0, 2, 3).reshape(3, -1)
    return np.stack([np.sum(values * part[columns], axis=1) for part in by_component], axis=1)


def _before(lattice: stencils.Lattice, expected: stencils.Expectation, still_mm: Floats) -> stencils.Stencil:
    """Return the inverse covariance of the field before any sample, 0 at points that are still."""
    before = stencils.expected_inverse(lattice, expected)
    if len(still_mm):
        weight = np.eye(3) / (STILL_SHARE * expected.spread_mm) ** 2
        stencils.add_samples(before, lattice, still_mm, np.broadcast_to(weight, (len(still_mm), 3, 3)))
    return before


# The covariances of a spline field's gradients, from the blocks of its coefficients' covariance.
#
# Axes: a gradient's elements (component, direction) in C order.

COMPONENTS = 3


def gradient_covariance_at(field: SplineField, points_mm: Floats) -> Floats:
    """Return the covariances (m, 9, 9) of a field's gradients at points, per mm^2 of squared displacements."""
    columns, slopes = stencils.gradient_rows(field.lattice, points_mm)
    diagonal, below = field.covariance
    plane, length = int(np.prod(field.lattice.shape[1:])), len(diagonal[0])
    found = np.empty((len(points_mm), COMPONENTS, 3, COMPONENTS, 3))
    firsts = columns[:, 0] // plane
    for first in np.unique(firsts):
        # The covariance of the coefficients of four planes of x, which lie in one block or in two.
        start, size = int(first) * COMPONENTS * plane, stencils.SUPPORT * COMPONENTS * plane
        block = start // length
        if start + size <= block * length + len(diagonal[block]):
            whole = diagonal[block]
        else:
            whole = np.block([[diagonal[block], below[block].T], [below[block], diagonal[block + 1]]])
        inside = slice(start - block * length, start - block * length + size)
        whole = whole[inside, inside]
        here = np.flatnonzero(firsts == first)
        cells, which = np.unique(columns[here], axis=0, return_inverse=True)
        for number, cell in enumerate(cells):
            at = here[which.ravel() == number]
            within = cell - first * plane
            rows = (within // plane * COMPONENTS + np.arange(COMPONENTS)[:, np.newaxis]) * plane + within % plane
            of_cell = whole[rows[:, :, np.newaxis, np.newaxis], rows]
            found[at] = np.einsum("mdk,ckbl,mel->mcdbe", slopes[at], of_cell, slopes[at], optimize=True)
    return found.reshape(len(points_mm), COMPONENTS * 3, COMPONENTS * 3)
