"""A velocity field of cubic B-splines, fitted to all samples at once.

Each sample counts by its full covariance, penalties on derivatives and on the divergence by the weights that make the
samples most probable (their evidence). Samples that do not belong to the field, as wrong links, lose their weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lfpiv_cli.arrays import Floats
from lfpiv_cli.fields import stencils
from lfpiv_cli.fields.stencils import DIVERGENCE, ORDERS, SMOOTHNESS, Expectation, Lattice, bound, inverse_of, penalty
from lfpiv_cli.fields.structure import (
    Samples,
    belonging,
    error_covariance,
    inverse_covariances,
    squares,
    with_places,
    without_itself,
)
from lfpiv_cli.threads import in_threads

# Cells of a box along each axis: some thousand unknowns.
BOX_CELLS = 4
BOXES = 3
# Samples of a box, of which more do not tell more about weights.
MOST_SAMPLES = 800
# A box with fewer samples for each cell tells nothing.
FEWEST_SAMPLES = 20
ROUNDS = 16
# An update changes a weight by this factor at most, goes on by such a share of a step in the same direction as the one
# before, and ends where logarithms of weights change by less than the last: rms errors change by a percent then.
LARGEST_STEP, ONWARD, LAST_STEP = np.exp(3.0), 1.0, 0.3
# What a field leaves unresolved at first, as a share of the samples' spread; errors' scales are at least these.
FIRST_UNRESOLVED = 0.1
SMALLEST_SCALE, SMALLEST_UNRESOLVED = 0.5, 1e-5
# Degrees of freedom cannot be told from none below this share.
SMALLEST_SHARE = 1e-9
# Where nothing asks for less, as in a linear field, weights grow up to so many times the first guess: what they then
# let pass is less than a hundredth of the samples' spread, and the equations keep their digits.
STRONGEST = 1e5
# By what smoothness expects of waves of two cells, their divergence may be expected to be a tenth of gradients and no
# less: splines cannot be free of it everywhere, and stronger weights make depths of waves that they hardly follow wrong
# by more than is stated. In a field that is to be free of it, a hundredth: beyond, the equations lose digits.
STRONGEST_DIVERGENCE, FREE_DIVERGENCE = 1e2, 1e4


@dataclass(frozen=True, eq=False)
class Box:
    """A part of the samples, and the splines of one component at them, (n, k).

    `components` : of the field; `integrals` : how often samples are integrated along a length to give the field
    """

    lattice: Lattice
    samples: Samples
    splines: Floats
    components: ClassVar[int] = 3
    integrals: ClassVar[int] = 0

    @classmethod
    def around(cls, lattice: Lattice, samples: Samples) -> Self:
        """Return the box of a lattice and the samples in it."""
        columns, values = stencils.rows_of(lattice, samples.points_mm)
        splines = np.zeros((len(samples), int(np.prod(lattice.shape))))
        np.put_along_axis(splines, columns, values, axis=1)
        return cls(lattice, samples, splines)

    def normal(self, weight: Floats) -> tuple[Floats, Floats]:
        """Return the normal equations of samples with weights (n, 3, 3), components one after the other."""
        weighted = np.einsum("nij,nj->ni", weight, self.samples.value_mm)
        parts = [
            [self.splines.T @ (self.splines * weight[:, one, other, np.newaxis]) for other in range(3)]
            for one in range(3)
        ]
        return np.block(parts), (weighted.T @ self.splines).ravel()

    def field(self, coefficients: Floats) -> Floats:
        """Return the field (n, 3) at the samples."""
        return np.asarray(self.splines @ coefficients.reshape(3, -1).T)

    def covariance(self, inverse: Floats) -> Floats:
        """Return the covariances (n, 3, 3) of the field at the samples."""
        count = self.splines.shape[1]
        parts = inverse.reshape(3, count, 3, count)
        found = np.empty((len(self.samples), 3, 3))
        for one in range(3):
            for other in range(3):
                found[:, one, other] = np.sum((self.splines @ parts[one, :, other]) * self.splines, axis=1)
        return found


def by_component(matrix: stencils.Stencil) -> Floats:
    """Return a small matrix whole, components one after the other."""
    nx, count, ny, nz = matrix.shape[:4]
    whole = stencils.dense(matrix).reshape(nx, count, ny * nz, nx, count, ny * nz)
    return np.asarray(whole.transpose(1, 0, 2, 4, 3, 5).reshape(count * nx * ny * nz, -1))


def boxes_in(samples: Samples, lattice: Lattice, rng: np.random.Generator, kind: type[Box] = Box) -> list[Box]:
    """Return boxes of equal size about samples that are drawn, those with most samples first."""
    cells = tuple(min(BOX_CELLS, count) for count in lattice.cells)
    cell = np.asarray(lattice.cell_mm)
    if cells == lattice.cells:
        places = [np.zeros(3, dtype=np.int64)]
    else:
        drawn = samples.points_mm[rng.choice(len(samples), 4 * BOXES)]
        first = np.floor((drawn - lattice.low_mm) / cell).astype(np.int64) - np.asarray(cells) // 2
        places = list(np.unique(np.clip(first, 0, np.subtract(lattice.cells, cells)), axis=0))
        places = [places[number] for number in rng.permutation(len(places))]
    found = []
    for place in places:
        low = np.asarray(lattice.low_mm) + place * cell
        box = Lattice((float(low[0]), float(low[1]), float(low[2])), lattice.cell_mm, (cells[0], cells[1], cells[2]))
        inside = np.flatnonzero(np.all((samples.points_mm >= low) & (samples.points_mm <= low + cells * cell), axis=1))
        if len(inside) > MOST_SAMPLES:
            inside = np.sort(rng.choice(inside, MOST_SAMPLES, replace=False))
        part = samples.subset(inside)
        found.append(kind.around(box, part))
    found.sort(key=lambda box: -len(box.samples))
    return [box for box in found[:BOXES] if len(box.samples) >= FEWEST_SAMPLES] or found[:1]


def first_expectation(samples: Samples, lattice: Lattice, names: Sequence[str], kind: type[Box] = Box) -> Expectation:
    """Return what lets any field pass that varies by the samples' spread within a few cells."""
    # By how much samples differ: 1.48 times the median distance from their median.
    off = np.abs(samples.value_mm - np.median(samples.value_mm, axis=0))
    spread = max(float(1.4826 * np.median(off.max(axis=1))), np.finfo(np.float64).tiny)
    size = BOX_CELLS * float(np.min(lattice.cell_mm))
    reach = spread * size**kind.integrals
    powers = {name: 2 if name == DIVERGENCE else 2 * ORDERS[name] for name in names}
    weights = {name: size**power / (reach**2 * size**3) for name, power in powers.items()}
    return Expectation(weights, spread, 1.0, FIRST_UNRESOLVED * spread)


def most_probable(
    samples: Samples, lattice: Lattice, expected: Expectation, rng: np.random.Generator, kind: type[Box] = Box
) -> tuple[Expectation, Floats]:
    """Return the weights and scales that make the samples most probable, from a first guess.

    Also the median covariance (3, 3) of the field that a sample's neighbours make without it.
    """
    boxes = boxes_in(samples, lattice, rng, kind)
    shape, names = boxes[0].lattice, list(expected.weights)
    parts = {name: by_component(penalty(shape, name, kind.components)) for name in names}
    reach = expected.spread_mm * shape.smallest_mm**kind.integrals
    bounded = by_component(bound(shape, reach, kind.components))
    beliefs, first = [box.samples.probability for box in boxes], expected
    last = np.zeros(len(names))
    for _ in range(ROUNDS):
        before = bounded + sum(weight * parts[name] for name, weight in expected.weights.items())
        tell = partial(_told, expected, parts, before, _inverse(before)[0])
        reported = in_threads(tell, list(zip(boxes, beliefs, strict=True)))
        had, decided = (np.sum([each[number] for each in reported], axis=0) for number in range(2))
        beliefs = [each[2] for each in reported]
        change = np.maximum(decided, SMALLEST_SHARE * had) / np.maximum(had, np.finfo(np.float64).tiny)
        change[: len(names)] = np.clip(change[: len(names)], 1.0 / LARGEST_STEP, LARGEST_STEP)
        scales = np.sqrt(np.clip(1.0 / change[len(names) :], 1.0 / LARGEST_STEP, LARGEST_STEP))
        updated = Expectation(
            {name: expected.weights[name] * float(change[number]) for number, name in enumerate(names)},
            expected.spread_mm,
            max(expected.scale * float(scales[0]), SMALLEST_SCALE),
            max(expected.unresolved_mm * float(scales[1]), SMALLEST_UNRESOLVED * expected.spread_mm),
        )
        step = np.array([np.log(updated.weights[name] / expected.weights[name]) for name in names])
        further = np.where(step * last > 0.0, ONWARD * step, 0.0)
        weights = {name: updated.weights[name] * float(np.exp(more)) for name, more in zip(names, further, strict=True)}
        weights = {
            name: weight if name == DIVERGENCE else min(weight, STRONGEST * first.weights[name])
            for name, weight in weights.items()
        }
        for lateral, in_depth in zip(SMOOTHNESS[:2], SMOOTHNESS[2:], strict=True):
            if in_depth in weights:
                weights[in_depth] = min(weights[in_depth], weights[lateral])
        onward = replace(updated, weights=weights)
        if DIVERGENCE in names:
            # Not too large.
            most = divergence_weight(onward, shape, STRONGEST_DIVERGENCE)
            onward = replace(updated, weights={**weights, DIVERGENCE: min(weights[DIVERGENCE], most)})
        changes = [np.log(onward.weights[name] / expected.weights[name]) for name in names]
        changes += [np.log(updated.scale / expected.scale), np.log(updated.unresolved_mm / expected.unresolved_mm)]
        settled = float(np.abs(changes).max()) < LAST_STEP
        expected, last = onward, step
        if settled:
            break
    return expected, np.median(np.concatenate([each[3] for each in reported]), axis=0)


def divergence_weight(expected: Expectation, lattice: Lattice, times: float) -> float:
    """Return the weight of the divergence that counts so many times what smoothness does, for waves of two cells."""
    wave = np.pi / float(np.max(lattice.cell_mm))
    smooth = [
        sum(expected.weights.get(name, 0.0) * wave ** (2 * ORDERS[name] - 2) for name in names)
        for names in (SMOOTHNESS[:2], SMOOTHNESS[2:])
    ]
    return float(times * max(smooth))


def _told(
    expected: Expectation, parts: dict[str, Floats], before: Floats, before_inverse: Floats, of_box: tuple[Box, Floats]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return what a box, with its samples' probabilities, tells: of penalties, stated errors and what is unresolved.

    Returns
    -------
    had : what the field and the errors have of each
    decided : how many degrees of freedom each decides
    belief : (n,) the samples' probabilities to belong to the field
    by_others : (n, 3, 3) covariances of the field that each sample's neighbours make without it
    """
    box, belief = of_box
    covariance = error_covariance(box.samples, expected.scale, expected.unresolved_mm)
    weight = inverse_covariances(covariance, belief)
    matrix, right = box.normal(weight)
    inverse, factor = _inverse(matrix + before)
    coefficients, by_data = cho_solve(factor, right), before_inverse - inverse
    had = [expected.weights[name] * float(coefficients @ (part @ coefficients)) for name, part in parts.items()]
    decided = [expected.weights[name] * float(np.vdot(by_data, part)) for name, part in parts.items()]
    error, field = box.samples.value_mm - box.field(coefficients), box.covariance(inverse)
    # What the errors have of the stated ones and of the unresolved, and what they would be expected to have.
    weighted, shares = np.einsum("nij,nj->ni", weight, error), np.maximum(belief, np.finfo(np.float64).tiny)
    unresolved = np.broadcast_to(expected.unresolved_mm**2 * np.eye(3), weight.shape)
    for kind in (expected.scale**2 * box.samples.covariance_mm2, unresolved):
        had.append(float(np.sum(np.einsum("ni,nij,nj->n", weighted, kind, weighted) / shares)))
        through = np.einsum("nij,njk,nkl->nil", weight, kind, weight) / shares[:, np.newaxis, np.newaxis]
        decided.append(float(np.einsum("nij,nji->", weight, kind) - np.einsum("nij,nji->", through, field)))
    alone = without_itself(error, field, weight, covariance)
    belief = belonging(box.samples, *alone, expected.spread_mm)
    return np.array(had), np.array(decided), belief, alone[1] - covariance


def _inverse(matrix: Floats) -> tuple[Floats, tuple[Floats, bool]]:
    """Return the inverse of a symmetric positive definite matrix and its factor."""
    factor = cho_factor(matrix, lower=True, check_finite=False)
    return inverse_of(factor[0]), factor


# Rounds of weighing samples; the last change of their probabilities that matters, on the average.
ROUNDS, LAST_CHANGE = 4, 0.002
POINTS_AT_ONCE = 500
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
    # The gradients of a field of wide knots show what errors of places add; one sample for each unknown is enough.
    wide = lattice.wide()
    few = np.sort(rng.choice(len(about), min(len(about), wide.unknowns), replace=False))
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
