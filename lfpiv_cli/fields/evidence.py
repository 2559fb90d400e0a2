"""The weights of a spline field's penalties, chosen from the samples: where these are the most probable.

The probability of the samples, whatever the field (the marginal likelihood), is made as large as it can be by the
updates of Fellner and Schall as Wood and Fasiolo generalised them (Biometrics 73, 1071, 2017): a penalty's weight is
multiplied by the number of degrees of freedom that the penalty decides over what the field has of it. Errors' scales
follow likewise. Some boxes of a few cells tell it: their matrices are small enough to be inverted, and the weights,
being those of integrals, are the same for the whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lfpiv_cli.arrays import Floats
from lfpiv_cli.fields import stencils
from lfpiv_cli.fields.stencils import DIVERGENCE, ORDERS, SMOOTHNESS, Expectation, Lattice, bound, inverse_of, penalty
from lfpiv_cli.fields.structure import Samples, belonging, error_covariance, inverse_covariances, without_itself
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
