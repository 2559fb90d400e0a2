"""A velocity field from samples: by splines where many tell a smooth flow, by kriging elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.spatial import KDTree
from scipy.special import gammaincinv
from threadpoolctl import threadpool_limits

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.fields import structure as structures
from lfpiv_cli.fields.spline_field import SplineField, spline_field
from lfpiv_cli.fields.stencils import Lattice
from lfpiv_cli.fields.structure import INDEPENDENT, Samples, VectorStructure
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.tracks.gridding import FEWEST_OF_STRUCTURE, ROUGH_EXPONENT, spacing_of, spread_around, without_own

# A velocity field kriged from samples as vectors: the best linear unbiased estimate where the flow is rough.
#
# In turbulence the velocity differs between neighbouring tracks by more than a spline on any affordable lattice
# follows. How much it differs, and that what differs is free of divergence, the tracks themselves tell: the structure
# function under which they are likeliest. The estimate at a place is the best combination of the nearest samples, all
# components of all of them together, by their full covariances: what is known of u and v tells of w.
#
# Samples further off what the others let expect than they should be are outliers; wrong links are.
#
# Axes: points (m, 3) and displacements in mm.

# The structure function under which the samples are likeliest: what a field is kriged with.
#
# The likelihood is that of some neighbourhoods spread over the samples, each with all its covariances about an
# unknown constant: a few hundred samples, which know both what neighbours differ by and how much of it is error.
# First guesses with wide standard deviations keep what few samples cannot tell where it is likely to be.

# So many neighbourhoods of so many samples, more of which change the estimates by less than their errors; and what
# is enough to tell outliers.
NEIGHBOURHOODS, FEW_NEIGHBOURHOODS = (20, 40), (12, 25)
# Shares of potential flow to choose from, and by how much the logarithm of the likelihood must grow for one that is
# not zero: twice that is exceeded by chi-squared of one degree of freedom once in seventy times.
POTENTIAL_SHARES = (0.0, 0.03, 0.1, INDEPENDENT, 0.7)
NEEDED_GROWTH = 3.0
# First guesses: the power of turbulence, between lengths of so many times the distance of neighbours; the mean square
# difference of neighbours and the nugget as shares of the variance; and the standard deviations of the logarithms (of
# the logit of half the power).
POWER, INNER_SPACINGS, OUTER_SPACINGS, DIFFERENCE_SHARE, NUGGET_SHARE = 2.0 / 3.0, 0.3, 10.0, 0.5, 1e-3
DEVIATIONS = np.array([3.0, 1.5, 1.0, 1.0, 3.0, 0.5])
# No parameter is further from its first guess, in these deviations: a search that went on would leave what is a number.
FARTHEST = 10.0
STEPS, ENOUGH = 25, 1e-5
# What stands for a likelihood of none.
IMPOSSIBLE = 1e12


def likeliest_structure(
    samples: Samples, shares: Sequence[float], size: tuple[int, int] = NEIGHBOURHOODS
) -> VectorStructure:
    """Return the likeliest structure function.

    Parameters
    ----------
    samples : without outliers
    shares : of potential flow, to choose from: the first, unless another is clearly likelier
    size : number of neighbourhoods and of samples in each
    """
    # Neighbourhoods whose middles lie as far from each other as they can.
    places, count = samples.points_mm, min(size[1], len(samples))
    middles = [int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(places - places[middles[0]], axis=1)
    while len(middles) < min(size[0], max(1, 2 * len(places) // count)):
        middles.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(places - places[middles[-1]], axis=1))
    near = KDTree(places).query(places[middles], k=np.arange(1, count + 1))[1]
    points, errors, values = places[near], samples.covariance_mm2[near], samples.value_mm[near]
    about = (values - values.mean(axis=1, keepdims=True)).swapaxes(1, 2).reshape(len(near), -1)
    unknown, spacing = structures.unknown_variance(samples), spacing_of(places)
    variance = max(float(np.var(samples.value_mm, axis=0).mean()), np.finfo(np.float64).tiny)
    first = np.log([DIFFERENCE_SHARE * variance, NUGGET_SHARE * variance])
    lengths = np.log([INNER_SPACINGS * spacing, OUTER_SPACINGS * spacing])
    guess = np.array([first[0], np.log(POWER / (2.0 - POWER)), *lengths, first[1], 0.0])

    def cost(parameters: Floats, share: float) -> float:
        """Return minus the logarithm of the likelihood."""
        found = structures.log_likelihood(
            structures.between(points, errors, _structure(parameters, spacing, share), unknown), about
        )
        unlikely = 0.5 * float(np.sum(((parameters - guess) / DEVIATIONS) ** 2))
        return unlikely - found if np.isfinite(found) else IMPOSSIBLE

    bounds = list(zip(guess - FARTHEST * DEVIATIONS, guess + FARTHEST * DEVIATIONS, strict=True))
    search = partial(minimize, cost, method="L-BFGS-B", bounds=bounds, options={"maxiter": STEPS, "ftol": ENOUGH})
    found = search(guess, args=(shares[0],)).x
    # what else is likeliest differs little from share to share
    other = min(shares, key=lambda share: cost(found, share))
    if other != shares[0]:
        better = search(found, args=(other,)).x
        if cost(better, other) < cost(found, shares[0]) - NEEDED_GROWTH:
            return _structure(better, spacing, other)
    return _structure(found, spacing, shares[0])


def _structure(parameters: Floats, spacing: float, share: float) -> VectorStructure:
    """Return the structure function of: ln D between neighbours, logit p/2, ln l, ln L, ln nugget, ln error factor."""
    difference, power, inner, outer, nugget, error = parameters.tolist()
    inner, outer, nugget, error = (math.exp(value) for value in (inner, outer, nugget, error))
    unit = VectorStructure(1.0, 2.0 / (1.0 + math.exp(-power)), inner, outer, nugget, error, share)
    return replace(unit, factor=math.exp(difference) / unit.mean_at(spacing))


# Samples that an estimate is made of, and those that show whether one of them is an outlier. With twice as many the
# errors are 1 to 6 % smaller, and it takes four times as long.
USED, USED_FOR_OUTLIERS = 60, 12
# What is worked on at a time bounds the memory to some 100 MB.
PLACES_AT_ONCE = 100
# Rounds in which samples that the outliers left alone come back.
OUTLIER_ROUNDS = 2
# However certain a link is said to be: one in a hundred is wrong.
LARGEST_PROBABILITY = 0.99
# Neighbours in all directions are so many times as far away as the nearest one.
SPACINGS_APART = 2.0
# The median of chi-squared of three degrees of freedom.
CHI_SQUARED_MEDIAN = 2.0 * float(gammaincinv(1.5, 0.5))
# The shares of potential flow to choose from.
SHARES = {"free": (0.0,), "penalised": POTENTIAL_SHARES, "off": (INDEPENDENT,)}


@dataclass(frozen=True, eq=False)
class KrigedField:
    """A velocity field that is kriged from samples.

    Attributes
    ----------
    samples : those that are no outliers
    structure : of the flow
    off_by : (n, 3) how far each sample is off what the others let expect, in its expected standard deviations
    kept : (n,) which of all samples these are
    """

    samples: Samples
    structure: VectorStructure
    off_by: Floats
    kept: Flags

    @property
    def probability(self) -> Floats:
        """The probability (n,) of each sample to belong to the field: 1, or 0 of outliers."""
        return self.kept.astype(np.float64)

    def value_at(self, points_mm: Floats) -> Floats:
        """Return displacements (m, 3) in mm."""
        return self.estimates_at(points_mm)[0]

    def variance_at(self, points_mm: Floats) -> Floats:
        """Return the variances (m, 3) in mm^2 of what the displacements are off by."""
        return self.estimate_at(points_mm)[1]

    def estimates_at(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Return displacements and their covariances at once, in the time that either takes."""
        unknown = structures.unknown_variance(self.samples)
        parts = [
            structures.estimated(points_mm[part], near, self.samples, self.structure, unknown)
            for part, near in _nearest(self.samples.points_mm, points_mm, USED)
        ]
        value, covariance = (np.concatenate(each) for each in zip(*parts, strict=True))
        # How large errors are around places over what the equations say.
        everywhere = MAD_TO_SIGMA * np.median(self.off_by, axis=0)
        factor = np.maximum(everywhere, spread_around(points_mm, self.samples.points_mm, self.off_by))
        scaled = covariance * factor[:, :, np.newaxis] * factor[:, np.newaxis]
        return value, scaled

    def estimate_at(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Return displacements and their variances (m, 3)."""
        value, covariance = self.estimates_at(points_mm)
        return value, np.asarray(np.einsum("mii->mi", covariance))

    def gradient_at(self, points_mm: Floats) -> Floats:
        """Return the gradient (m, 3, 3) per mm [component, direction], each of its nearest samples held fixed."""
        unknown = structures.unknown_variance(self.samples)
        parts = [
            structures.estimated_slopes(points_mm[part], near, self.samples, self.structure, unknown)
            for part, near in _nearest(self.samples.points_mm, points_mm, USED)
        ]
        return np.concatenate(parts)

    def reported(self) -> dict[str, Any]:
        """Return how the field was fitted: figures with their units in their names."""
        return {
            "method": "kriging",
            "belonging": float(np.sum(self.kept)),
            "reduced_chi2": float(np.mean(self.off_by**2)),
            "power": self.structure.power,
            "inner_length_mm": self.structure.inner_mm,
            "outer_length_mm": self.structure.outer_mm,
            "nugget_mm": float(np.sqrt(self.structure.nugget_mm2)),
            "error_over_stated": float(np.sqrt(self.structure.error_factor)),
            "potential_share": self.structure.potential_share,
        }


def is_rough(samples: Samples) -> bool:
    """Tell whether the flow differs so much between neighbouring samples that kriging is to be used, not splines.

    The mean square difference grows with less than nearly the square of the distance there, and is more than errors.
    The samples are without outliers.
    """
    if len(samples) < FEWEST_OF_STRUCTURE:
        return False
    structure = likeliest_structure(samples, SHARES["free"], FEW_NEIGHBOURHOODS)
    apart = SPACINGS_APART * spacing_of(samples.points_mm)
    stated = np.median(np.einsum("nii->ni", samples.covariance_mm2), axis=0).min()
    by_errors = 2.0 * (structure.error_factor * float(stated) + structure.nugget_mm2)
    return structure.steepness(apart) < ROUGH_EXPONENT and structure.mean_at(apart) > by_errors


def kriged_field(samples: Samples, divergence: str) -> KrigedField:
    """Return the field that samples tell, two at least.

    Parameters
    ----------
    samples : with outliers among them
    divergence : "free": none; "penalised": as much as makes the samples clearly likelier; "off": components apart
    """
    structure, kept, off_by = _told(samples, SHARES[divergence], NEIGHBOURHOODS)
    return KrigedField(samples.subset(kept), structure, off_by, kept)


def _told(samples: Samples, shares: Sequence[float], size: tuple[int, int]) -> tuple[VectorStructure, Flags, Floats]:
    """Return the structure function that samples tell, which (n,) are no outliers, and how far off these are.

    Outliers make a first structure function too rough: by it the far ones go. Shares and size are those of
    `likeliest_structure`.
    """
    rough = likeliest_structure(samples, shares[:1], FEW_NEIGHBOURHOODS)
    kept, _ = _without_outliers(samples, rough, np.ones(len(samples), dtype=bool), rounds=1)
    structure = likeliest_structure(samples.subset(kept), shares, size)
    return structure, *_without_outliers(samples, structure, kept, OUTLIER_ROUNDS)


def _without_outliers(samples: Samples, structure: VectorStructure, kept: Flags, rounds: int) -> tuple[Flags, Floats]:
    """Return which samples (n,) belong to the flow, and how far off (kept, 3) these are in standard deviations.

    Of each it is the `kept` ones, and in later rounds those of the round before, that let expect something.
    """
    own = structure.error_factor * samples.covariance_mm2 + structure.nugget_mm2 * np.eye(3)
    spacing = spacing_of(samples.points_mm)
    probability = np.clip(samples.probability, 1.0 - LARGEST_PROBABILITY, LARGEST_PROBABILITY)
    for _ in range(rounds):
        # What each sample is off the nearest kept others by, and the covariances expected.
        others = samples.subset(kept)
        unknown = structures.unknown_variance(others)
        number = np.where(kept, np.cumsum(kept) - 1, -1)
        count = min(USED_FOR_OUTLIERS, len(others) - 1)
        off, covariance = np.empty((len(samples), 3)), np.empty((len(samples), 3, 3))
        for part, near in _nearest(others.points_mm, samples.points_mm, count + 1):
            near = without_own(near, number[part])
            expected, missed = structures.estimated(samples.points_mm[part], near, others, structure, unknown)
            off[part], covariance[part] = samples.value_mm[part] - expected, missed + own[part]
        # Which belong to the flow rather than being off by the order of their neighbours' distance.
        of_flow = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., np.newaxis])[..., 0])
        times = max(float(np.median(of_flow)) / CHI_SQUARED_MEDIAN, 1.0)
        wide = covariance * times + spacing**2 * np.eye(3)
        of_wrong = np.einsum("ni,ni->n", off, np.linalg.solve(wide, off[..., np.newaxis])[..., 0])
        log_density_ratio = 0.5 * (
            np.linalg.slogdet(wide)[1] - np.linalg.slogdet(covariance * times)[1] + of_wrong - of_flow / times
        )
        kept = log_density_ratio + np.log(probability / (1.0 - probability)) > 0.0
    return kept, np.abs(off[kept]) / np.sqrt(np.einsum("nii->ni", covariance[kept]))


def _nearest(points: Floats, places: Floats, count: int) -> list[tuple[slice, Integers]]:
    """Return slices of the places, and the numbers (b, k) of the points nearest to each of them."""
    near = KDTree(points).query(places, k=np.arange(1, min(count, len(points)) + 1))[1]
    parts = [slice(start, start + PLACES_AT_ONCE) for start in range(0, len(places), PLACES_AT_ONCE)]
    return [(part, near[part]) for part in parts]


# The weights are told by boxes that are drawn: always the same ones.
SEED = 0
NO_POINTS = np.zeros((0, 3))
# Knots are so many times the samples' mean distance apart: a third as many knots as samples. Among factors of 1.2 to
# 1.8, less adds noise where samples are few, and more holds divergence and values of small vortices further off.
KNOTS_OF_DISTANCE = 1.4
# Splines that leave more of the samples than this, over their stated errors, are too wide for the flow's small parts:
# vortices of 3 mm that 9,000 unknowns could not follow left 20 to 100, flows that they followed 0.3 to 1.6.
UNRESOLVED_CHI2 = 3.0
# Fewer samples are kriged. Of 500 in smooth flows, kriging is a fifth nearer in u and v, equal in w, and free of
# divergence, of which the splines' wide knots leave up to 4 % of the gradients; of 1,000, splines are nearer in w.
FEW_SAMPLES = 600

# A velocity field that is known everywhere in a box, as displacements from one frame to the next.
Field = SplineField | KrigedField


def fit_field(
    samples: Samples, low_mm: ArrayLike, high_mm: ArrayLike, divergence: str = "penalised", still_mm: Floats = NO_POINTS
) -> Field:
    """Fit a field: splines, or kriging where samples are few, or the flow is rough or too fine for splines.

    Walls, and a flow that is held free of divergence, are for splines alone.

    Parameters
    ----------
    samples : what is known of it
    low_mm, high_mm : corners (3,) of the box in which the field is asked for; it is enlarged to hold the samples
    divergence : "penalised": as far as the samples ask for; "free": there is none; "off": nothing is known of it
    still_mm : (k, 3) points of walls, where the displacement is 0
    """
    # The same bits on every machine, and boxes that are worked on at once do not take more threads than there are.
    with threadpool_limits(limits=1, user_api="blas"):
        # What is told of each by a dozen others can be bent by one or two of them, not by what is wrong elsewhere.
        _, kept, _ = _told(samples, SHARES["free"], FEW_NEIGHBOURHOODS)
        inside = samples.subset(kept)
        splines_alone = divergence == "free" or len(still_mm) > 0
        if not splines_alone and (len(inside) < FEW_SAMPLES or is_rough(inside)):
            return kriged_field(samples, divergence)
        places = np.concatenate([inside.points_mm, still_mm, np.atleast_2d(low_mm), np.atleast_2d(high_mm)])
        low, high = places.min(axis=0), places.max(axis=0)
        distance = float(np.prod(high - low) / max(len(inside), 1)) ** (1.0 / 3.0)
        lattice = Lattice.affordable(low, high, KNOTS_OF_DISTANCE * distance)
        splines = spline_field(inside, lattice, divergence, np.random.default_rng(SEED), still_mm)
        if not splines_alone and splines.reduced_chi2 >= UNRESOLVED_CHI2:
            return kriged_field(samples, divergence)
        probability = np.zeros(len(samples))
        probability[kept] = splines.probability
        return replace(splines, probability=probability)
