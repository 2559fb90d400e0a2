"""Scattered tracks interpolated to vectors on a grid: by local polynomials in smooth flows, by kriging in rough ones.

A wide fit has little noise and misses what the flow does within its reach; a narrow one is the other way round. Which
is better depends on the tracks' density and errors and on the flow, and differs from component to component: depth is
noise, the streamwise component shear. The noise of a fit is known from its tracks. What it misses is seen in the
differences of fits, less the noise of these: among parabolas it grows with the cube of the radius, and a line misses
what distinguishes it from a parabola. Each component of a node takes the fit whose error, of both kinds, is the
smallest, and states it.

In turbulence neighbours' displacements differ by more than any polynomial through them could tell. Where the structure
function of the tracks shows that, kriging gives the best linear combination of the nearest ones, and what it misses.

Axes: points (n, 3) and displacements in mm, at the middle of each track.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import KDTree
from scipy.special import chdtr, gammaincinv

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.threads import blocks, in_threads

# What scattered displacements let expect at other places, and how well: kriging with the flow's structure function.
#
# How unlike the displacements of two particles are depends on their distance: in turbulence their mean square
# difference grows with its power of 2/3, in smooth flows with its square. The exponent, the factor and what is left at
# no distance are taken from the displacements themselves; the best linear combination of neighbours about a linear
# trend, and the variance of what it misses, follow. Each component is for itself, distances alike in all directions.

# Neighbours whose differences show the structure function, and that let expect a displacement.
PAIRED, USED = 12, 16
# Distances are sorted into so many groups at most, of so many pairs at least.
GROUPS, PAIRS_OF_GROUP = 8, 40
# The largest first: where several fit alike, the flow is taken for smooth.
EXPONENTS = np.arange(19, 3, -1) / 10.0
# Where groups are too few to show an exponent.
PLAIN_EXPONENT = 1.0
# A linear trend takes four unknowns; with fewer neighbours than this they would be noise.
FEWEST_OF_TREND = 12
# The structure function is no smaller than this share of the noise: it keeps the equations solvable.
SMALLEST_SHARE = 1e-6
# Places that each thread works on at a time: its equations stay in the second-level cache, nearly.
PLACES_AT_ONCE = 500


class Structure(NamedTuple):
    """Mean square difference of displacements over the distance r: nugget + factor r^exponent, mm^2.

    Attributes
    ----------
    nugget, factor : (3,) of each component
    exponent : common to all
    """

    nugget: Floats
    factor: Floats
    exponent: float

    def at(self, distance_mm: float) -> Floats:
        """Return the mean square difference (3,) that the flow makes over a distance, without what is left at none."""
        return np.asarray(self.factor * distance_mm**self.exponent)


def structure_of(points: Floats, displacement: Floats, noise2: Floats) -> Structure:
    """Return the structure function of displacements (n, 3), two at least, whose variances are `noise2` (n, 3)."""
    count = min(PAIRED, len(points) - 1)
    distance, near = KDTree(points).query(points, k=np.arange(2, count + 2))
    difference = (displacement[near] - displacement[:, np.newaxis]).reshape(-1, 3)
    noise = (noise2[near] + noise2[:, np.newaxis]).reshape(-1, 3)
    order = np.argsort(distance, axis=None, kind="stable")
    groups = np.array_split(order, max(min(GROUPS, len(order) // PAIRS_OF_GROUP), 1))
    apart = np.array([np.median(distance.ravel()[group]) for group in groups])
    spread2 = np.array([(MAD_TO_SIGMA * np.median(np.abs(difference[group]), axis=0)) ** 2 for group in groups])
    stated = np.array([np.median(noise[group], axis=0) for group in groups])
    square = np.maximum(spread2 - stated, SMALLEST_SHARE * np.maximum(stated, np.finfo(np.float64).tiny))
    if len(groups) < 3:
        nearest = max(float(apart.mean()), np.finfo(np.float64).tiny)
        return Structure(np.zeros(3), np.asarray(square.mean(axis=0) / nearest**PLAIN_EXPONENT), PLAIN_EXPONENT)
    fits = []
    for exponent in EXPONENTS:
        # By relative errors.
        terms = np.stack([np.ones_like(apart), apart**exponent], axis=1)
        found = [nnls(terms / values[:, np.newaxis], np.ones(len(values))) for values in square.T]
        nugget, factor = np.array([solution for solution, _ in found]).T
        fits.append((float(sum(misfit for _, misfit in found)), Structure(nugget, factor, float(exponent))))
    return min(fits, key=lambda fit: fit[0])[1]


def kriged(
    at: Floats, own: Integers, points: Floats, displacement: Floats, noise2: Floats, structure: Structure
) -> tuple[Floats, Floats]:
    """Return the displacements (m, 3) that neighbours let expect, and the variance (m, 3) of what they miss.

    Parameters
    ----------
    at : (m, 3) places
    own : (m,) which point is at a place and takes no part in what is expected there; -1: none
    points, displacement, noise2 : (n, 3), two at least
    """
    count = min(USED, len(points) - 1)
    tree = KDTree(points)
    value, variance = np.empty(at.shape), np.empty(at.shape)

    def work(part: slice) -> None:
        """Solve the equations of universal kriging."""
        here, each = at[part], np.arange(count)
        near = without_own(tree.query(here, k=np.arange(1, count + 2))[1], own[part])
        offset = points[near] - here[:, np.newaxis]
        distance = np.linalg.norm(offset, axis=2)
        apart = np.linalg.norm(offset[:, :, np.newaxis] - offset[:, np.newaxis], axis=3)
        furthest = np.maximum(distance[:, -1:], np.finfo(np.float64).tiny)[..., np.newaxis]
        trend = np.ones((*near.shape, 1))
        if count >= FEWEST_OF_TREND:
            trend = np.concatenate([trend, offset / furthest], axis=2)
        terms = trend.shape[2]
        apart, distance = apart**structure.exponent, distance**structure.exponent
        for axis in range(3):
            half = 0.5 * structure.factor[axis]
            between, to = half * apart, half * distance
            noise = noise2[near, axis] + 0.5 * structure.nugget[axis]
            matrix = np.zeros((len(here), count + terms, count + terms))
            matrix[:, :count, :count] = -between
            matrix[:, each, each] += noise
            matrix[:, :count, count:] = trend
            matrix[:, count:, :count] = trend.swapaxes(1, 2)
            right = np.concatenate([-to, np.ones((len(here), 1)), np.zeros((len(here), terms - 1))], axis=1)
            try:
                solved = np.linalg.solve(matrix, right[..., np.newaxis])
            except np.linalg.LinAlgError:
                # Neighbours in one plane, as at the end of a volume, tell no trend across it: the least one.
                solved = np.linalg.pinv(matrix, hermitian=True) @ right[..., np.newaxis]
            weight = solved[:, :count, 0]
            value[part, axis] = np.sum(weight * displacement[near, axis], axis=1)
            missed = 2.0 * np.sum(weight * to, axis=1) - np.einsum("mi,mij,mj->m", weight, between, weight)
            variance[part, axis] = np.maximum(missed, 0.0) + np.sum(weight**2 * noise, axis=1)

    in_threads(work, blocks(len(at), PLACES_AT_ONCE))
    return value, variance


def spacing_of(points: Floats) -> float:
    """Return the median distance of a point's nearest neighbour, mm."""
    return float(np.median(KDTree(points).query(points, k=[2])[0]))


def spread_around(at: Floats, points: Floats, off: Floats) -> Floats:
    """Return how far (m, 3) the points around places are usually off, as standard deviations."""
    near = KDTree(points).query(at, k=np.arange(1, min(TRACKS_AROUND, len(points)) + 1))[1]
    return np.asarray(MAD_TO_SIGMA * np.median(off[near], axis=1))


def without_own(near: Integers, own: Integers) -> Integers:
    """Return all but one of the numbers of each row: its own, or else the last."""
    is_own = near == own[:, np.newaxis]
    drop = np.where(is_own.any(axis=1), is_own.argmax(axis=1), near.shape[1] - 1)
    kept = np.arange(near.shape[1]) != drop[:, np.newaxis]
    return near[kept].reshape(len(near), -1)


# Robust polynomials through the tracks around many places at once.
#
# Each component is fitted for itself. A fit is linear in the displacements once outliers are weighed down, so that
# its noise, and that of the difference of two fits, follow from the tracks' stated errors.
#
# Axes: m places, k tracks around each, nearest first; points and displacements in mm.

# The furthest track of a fit still counts for a quarter: a Gaussian whose deviation is this share of the radius.
KERNEL_WIDTH = 0.6
# First rounds that no outlier can mislead (Cauchy's weights never vanish), then Tukey's biweight, which drops outliers.
CAUCHY_ROUNDS, TUKEY_ROUNDS = 3, 5
TUKEY = 4.685
# The biweight takes its weighted mean square from the middle of a normal distribution: this share of the variance.
TUKEY_VARIANCE = 0.827
# A share of the mean of the diagonal that keeps the equations of tracks in one plane solvable.
RIDGE = 1e-10
# No particle is known better than this share of the distance of those around it; guards against a standard error of
# zero, and a fit that leaves nothing.
SMALLEST_SIGMA_SHARE = 1e-6
SMALLEST_SPREAD = 1e-12


def fit_around(offset_mm: Floats, values: Floats, sigma: Floats, degree: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit polynomials of degree 1 or 2 through the k nearest tracks of m places.

    Parameters
    ----------
    offset_mm : (m, k, 3) from a place to its tracks, nearest first
    values, sigma : (m, k, 3) their displacements and stated standard errors, mm

    Returns
    -------
    value : (m, 3) at the places, mm
    weights : (m, 3, k) what a stated standard error of each track adds to the value, mm
    scatter2 : (m, 3) mean square of the tracks' residuals over that of their stated errors
    radius_mm : (m,) distance of the furthest track
    """
    distance = np.linalg.norm(offset_mm, axis=2)
    radius = np.where(distance[:, -1:] > 0.0, distance[:, -1:], 1.0)
    # The monomials, the constant first.
    x, y, z = np.moveaxis(offset_mm / radius[..., np.newaxis], -1, 0)
    monomials = [np.ones_like(x), x, y, z]
    if degree == 2:
        monomials += [x * x, y * y, z * z, x * y, x * z, y * z]
    terms = np.stack(monomials, axis=-1)
    kernel = np.exp(-0.5 * (distance / (KERNEL_WIDTH * radius)) ** 2)
    value, weights, scatter2 = [], [], []
    for axis in range(3):
        wanted, error = values[..., axis], np.maximum(sigma[..., axis], SMALLEST_SIGMA_SHARE * radius)
        robust = np.ones_like(wanted)
        for number in range(CAUCHY_ROUNDS + TUKEY_ROUNDS):
            weighted, matrix = _equations(terms, kernel * robust / error**2)
            coefficients = np.linalg.solve(matrix, weighted @ wanted[..., np.newaxis])
            off = np.abs(wanted - (terms @ coefficients)[..., 0]) / error
            spread = np.maximum(MAD_TO_SIGMA * np.median(off, axis=1, keepdims=True), SMALLEST_SPREAD)
            if number < CAUCHY_ROUNDS:
                robust = 1.0 / (1.0 + (off / spread) ** 2)
            else:
                robust = np.clip(1.0 - (off / (TUKEY * spread)) ** 2, 0.0, None) ** 2
        weighted, matrix = _equations(terms, kernel * robust / error**2)
        inverse = np.linalg.inv(matrix)
        # The share of each track's variance that a fit leaves in its residual: the kernel lets the tracks next to a
        # place draw the polynomial to them, where their number alone says little.
        solved = terms @ inverse
        own = np.einsum("mkp,mpk->mk", solved, weighted)
        noise = (weighted * error[:, np.newaxis] ** 2) @ weighted.swapaxes(1, 2)
        from_all = np.einsum("mkp,mkp->mk", solved @ noise, solved) / error**2
        left = TUKEY_VARIANCE * (1.0 - 2.0 * own + from_all)
        expected = np.maximum(np.sum(kernel * robust * left, axis=1), SMALLEST_SPREAD)
        scatter2.append(np.sum(kernel * robust * off**2, axis=1) / expected)
        weights.append((inverse[:, :1] @ weighted)[:, 0] * error)
        value.append(coefficients[:, 0, 0])
    return np.stack(value, axis=1), np.stack(weights, axis=1), np.stack(scatter2, axis=1), radius[:, 0]


def _equations(terms: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the weighted terms (m, p, k) and the matrix (m, p, p) of the normal equations."""
    weighted = (terms * weight[..., np.newaxis]).swapaxes(1, 2)
    matrix = weighted @ terms
    diagonal = np.arange(matrix.shape[1])
    matrix[:, diagonal, diagonal] += RIDGE * np.trace(matrix, axis1=1, axis2=2)[:, np.newaxis] / len(diagonal)
    return weighted, matrix


# Degrees and numbers of tracks to choose from: three to ten tracks for each of ten unknowns, five to fifteen for each
# of four. The first one, whose noise and what it misses are both moderate, is what the others are compared with.
CHOICES = ((2, 45), (2, 30), (2, 70), (2, 100), (1, 20), (1, 30), (1, 60))
REFERENCE, WIDER = 0, 2
# What a parabola misses is of third order in its radius.
MISSED_ORDER = 3
# Tracks that a node needs within reach, three for each unknown of a linear fit.
NEEDED_TRACKS = 12
# One difference of two fits says little; so many nodes together show how large such differences are there.
NODES_TOGETHER = 27
# Of these the share with the largest is left out: an outlier at the rim must not speak for all.
TRIMMED = 0.15
# A fit further from the middle one of all than so many of its errors is an outlier, whatever it states.
LARGEST_DEVIATION = 4.0
# The structure function of a smooth flow goes with the square of the distance. One that goes with less than this power,
# and by which neighbours' displacements differ more than by their errors, is that of a rough flow.
ROUGH_EXPONENT = 1.75
# Tracks further off what the others let expect are outliers.
OUTLIER_SIGMAS, OUTLIER_ROUNDS = 4.0, 3
# So many tracks around a place show how large errors are there.
TRACKS_AROUND = 40
# Tracks that show a structure function.
FEWEST_OF_STRUCTURE = 100
# Nodes that are worked on at a time, which bounds the memory: some 100 MB.
NODES_AT_ONCE = 2000


class Choices(NamedTuple):
    """What c fits say at m nodes.

    Attributes
    ----------
    value : (c, m, 3) mm
    variance : (c, m, 3) of the noise, if the tracks' errors are as stated
    difference_variance : (c, m, 3) variance of the difference from the reference, likewise
    radius_mm : (c, m)
    scatter2 : (m, 3) how large the tracks' variances are over the stated ones
    """

    value: Floats
    variance: Floats
    difference_variance: Floats
    radius_mm: Floats
    scatter2: Floats


def on_grid(
    middle_mm: Floats, displacement_mm: Floats, sigma_mm: Floats, nodes_mm: Floats, reach_mm: float
) -> tuple[Floats, Floats]:
    """Return displacements (m, 3) at nodes and their standard errors (m, 3), mm; NaN where too few tracks are near.

    Parameters
    ----------
    middle_mm, displacement_mm, sigma_mm : (n, 3) the tracks and their standard errors
    nodes_mm : (m, 3)
    reach_mm : a node whose twelfth track lies further away gets no vector
    """
    value, error = (np.full(nodes_mm.shape, np.nan) for _ in range(2))
    if len(middle_mm) < NEEDED_TRACKS:
        return value, error
    tree = KDTree(middle_mm)
    reached = np.flatnonzero(tree.query(nodes_mm, k=[NEEDED_TRACKS])[0][:, 0] <= reach_mm)
    if not reached.size:
        return value, error
    rough = _by_kriging(middle_mm, displacement_mm, sigma_mm, nodes_mm[reached])
    if rough is not None:
        value[reached], error[reached] = rough
        return value, error
    choices = [(degree, count) for degree, count in CHOICES if count <= len(middle_mm)]
    if len(middle_mm) < CHOICES[WIDER][1]:
        # Too few for two fits to differ: all of them in one.
        choices = [(2 if len(middle_mm) >= CHOICES[REFERENCE][1] else 1, len(middle_mm))]
    parts = []
    for start in range(0, len(reached), NODES_AT_ONCE):
        nodes = nodes_mm[reached[start : start + NODES_AT_ONCE]]
        near = tree.query(nodes, k=np.arange(1, max(count for _, count in choices) + 1))[1]
        offset = middle_mm[near] - nodes[:, np.newaxis]
        parts.append(_candidates(offset, displacement_mm[near], sigma_mm[near], choices))
    *arrays, scatter2 = zip(*parts, strict=True)
    found = Choices(*[*(np.concatenate(each, axis=1) for each in arrays), np.concatenate(scatter2)])
    value[reached], error[reached] = _best(found, nodes_mm[reached], choices)
    return value, error


def _by_kriging(
    middle_mm: Floats, displacement_mm: Floats, sigma_mm: Floats, nodes_mm: Floats
) -> tuple[Floats, Floats] | None:
    """Return displacements and standard errors (m, 3) at nodes; None in a smooth flow."""
    if len(middle_mm) < FEWEST_OF_STRUCTURE:
        return None
    smallest = SMALLEST_SIGMA_SHARE * float(np.ptp(middle_mm, axis=0).max())
    noise2 = np.maximum(sigma_mm, smallest) ** 2
    structure = structure_of(middle_mm, displacement_mm, noise2)
    apart = spacing_of(middle_mm)
    by_errors = structure.nugget + 2.0 * np.median(noise2, axis=0)
    if structure.exponent >= ROUGH_EXPONENT or np.all(structure.at(apart) < by_errors):
        return None
    # each track against what the others let expect of it: which are outliers, and how large errors then really are
    kept = np.arange(len(middle_mm))
    for _ in range(OUTLIER_ROUNDS):
        tracks = middle_mm[kept], displacement_mm[kept], noise2[kept]
        expected, missed = kriged(tracks[0], np.arange(len(kept)), *tracks, structure)
        off = np.abs(tracks[1] - expected) / np.sqrt(missed + tracks[2] + 0.5 * structure.nugget)
        factor = np.maximum(MAD_TO_SIGMA * np.median(off, axis=0), 1.0)
        inside = np.all(off <= OUTLIER_SIGMAS * factor, axis=1)
        kept, off = kept[inside], off[inside]
    value, variance = kriged(
        nodes_mm, np.full(len(nodes_mm), -1), middle_mm[kept], displacement_mm[kept], noise2[kept], structure
    )
    # depths are known worse in some planes than in others, whatever is stated
    here = np.maximum(spread_around(nodes_mm, middle_mm[kept], off), 1.0)
    return value, np.maximum(factor, here) * np.sqrt(variance)


def _candidates(offset_mm: Floats, values: Floats, sigma: Floats, choices: list[tuple[int, int]]) -> Choices:
    """Return what the choices say at nodes whose nearest tracks (m, k, 3) are given."""
    fits = [fit_around(offset_mm[:, :k], values[:, :k], sigma[:, :k], degree) for degree, k in choices]
    value, all_weights, scatter2, radius = zip(*fits, strict=True)
    reference, of_differences = all_weights[REFERENCE], []
    for weights in all_weights:
        # The two share their nearest tracks.
        common = min(weights.shape[2], reference.shape[2])
        difference = weights[..., :common] - reference[..., :common]
        rest = [np.sum(each[..., common:] ** 2, axis=2) for each in (weights, reference)]
        of_differences.append(np.sum(difference**2, axis=2) + rest[0] + rest[1])
    return Choices(
        value=np.stack(value),
        variance=np.stack([np.sum(weights**2, axis=2) for weights in all_weights]),
        difference_variance=np.stack(of_differences),
        radius_mm=np.stack(radius),
        scatter2=scatter2[REFERENCE],
    )


def _best(found: Choices, nodes_mm: Floats, choices: list[tuple[int, int]]) -> tuple[Floats, Floats]:
    """Return each node's value with the smallest error, component by component, and that error, (m, 3)."""
    together = KDTree(nodes_mm).query(nodes_mm, k=np.arange(1, min(NODES_TOGETHER, len(nodes_mm)) + 1))[1]
    scatter2 = np.median(found.scatter2[together], axis=1)
    error2 = found.variance * scatter2
    if len(choices) > 1:
        # The mean square of what each fit misses of the flow around a node.
        excess = np.stack(
            [
                _excess(value - found.value[REFERENCE], variance * scatter2, together)
                for value, variance in zip(found.value, found.difference_variance, strict=True)
            ]
        )
        missed = found.radius_mm[..., np.newaxis] ** MISSED_ORDER
        growth = np.maximum(missed[WIDER] - missed[REFERENCE], np.finfo(np.float64).tiny)
        of_parabolas = excess[WIDER] * (missed / growth) ** 2
        is_parabola = np.array([degree == 2 for degree, _ in choices])[:, np.newaxis, np.newaxis]
        error2 = error2 + np.where(is_parabola, of_parabolas, of_parabolas[REFERENCE] + excess)
        off = np.abs(found.value - np.median(found.value, axis=0))
        outlier = off > LARGEST_DEVIATION * np.sqrt(error2)
        error2 = np.where(outlier & ~outlier.all(axis=0), np.inf, error2)
    best = np.argmin(error2, axis=0)[np.newaxis]
    value, smallest = (np.take_along_axis(array, best, axis=0)[0] for array in (found.value, error2))
    return value, np.sqrt(smallest)


def _excess(difference: Floats, noise2: Floats, together: Integers) -> Floats:
    """Return by how much the mean square of differences (m, 3), over nodes that go together, exceeds their noise."""
    dropped = int(TRIMMED * together.shape[1])
    kept = np.sort((difference**2)[together], axis=1)[:, : together.shape[1] - dropped].mean(axis=1)
    # What the mean of the kept ones is of that of all, if the differences are normal: chi-squared up to its quantile.
    share = 1.0 - dropped / together.shape[1]
    kept_share = float(chdtr(3, 2.0 * gammaincinv(0.5, share))) / share
    return np.asarray(np.maximum(kept / kept_share - noise2[together].mean(axis=1), 0.0))
