"""What scattered displacements let expect at other places, and how well: kriging with the flow's structure function.

How unlike the displacements of two particles are depends on their distance: in turbulence their mean square difference
grows with its power of 2/3, in smooth flows with its square. The exponent, the factor and what is left at no distance
are taken from the displacements themselves; the best linear combination of neighbours about a linear trend, and the
variance of what it misses, follow.

Axes: points (n, 3) and displacements in mm; each component for itself, distances alike in all directions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.threads import blocks, in_threads

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
    at: Floats, own: NDArray[np.int64], points: Floats, displacement: Floats, noise2: Floats, structure: Structure
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
            weight = np.linalg.solve(matrix, right[..., np.newaxis])[:, :count, 0]
            value[part, axis] = np.sum(weight * displacement[near, axis], axis=1)
            missed = 2.0 * np.sum(weight * to, axis=1) - np.einsum("mi,mij,mj->m", weight, between, weight)
            variance[part, axis] = np.maximum(missed, 0.0) + np.sum(weight**2 * noise, axis=1)

    in_threads(work, blocks(len(at), PLACES_AT_ONCE))
    return value, variance


def without_own(near: NDArray[np.int64], own: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return all but one of the numbers of each row: its own, or else the last."""
    is_own = near == own[:, np.newaxis]
    drop = np.where(is_own.any(axis=1), is_own.argmax(axis=1), near.shape[1] - 1)
    kept = np.arange(near.shape[1]) != drop[:, np.newaxis]
    return near[kept].reshape(len(near), -1)
