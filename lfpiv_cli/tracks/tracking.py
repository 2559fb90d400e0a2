"""Two-frame particle tracking velocimetry (PTV) without a predictor: which particle of one frame is which of the next.

Neighbours move alike: a displacement that takes a particle to one of the next frame takes many of its neighbours to
others there. The displacement with most votes starts the match; then each particle is sought where a local linear fit
through its neighbours' displacements expects it, and matches that deviate from such a fit are dropped. In a sequence,
what a particle's own past forecasts takes the place of the votes, and joins what its neighbours let expect.

Axes: points (n, 3) in mm. Depth is known worse than the lateral place, so distances in depth count for less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.scale import Scale

# Lengths are in the camera's own units: L, a microlens in the scene (Table 2: 0.1 mm), and D, the depth over which
# light spreads by one lens (1.064 mm).
# Standard error of a depth beside that of a lateral place, in D/L: 4 in Table 2.
DEPTH_RATIO = 4.0 / 10.64
# Displacements are sought up to this along each axis by default, in L.
SEARCH_LENSES = 6.0
NEIGHBOURS = 14
# How far two displacements of neighbours may differ to count as alike, first and after a fit, laterally, in L.
ALIKE_LENSES = 0.4
# A local linear fit through as many tracks as seven for each of its unknowns, or through all others where these are
# fewer; with fewer than this its four unknowns are noise, and neighbours let expect their mean.
FIT_TRACKS = 28
FEWEST_OF_FIT = 6
ROUNDS = 4
# A match stays within so many robust standard deviations of the fit around it.
OUTLIER_SIGMAS = 5.0
# The spread below which no match is dropped, in L: particles are not known better.
SMALLEST_SPREAD_LENSES = 0.04


@dataclass(frozen=True, eq=False)
class Tracks:
    """Matches of two frames.

    Attributes
    ----------
    first, second : (n,) numbers of the particles in the two frames
    residual_mm : (n, 3) displacement less that of the fit around it
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    residual_mm: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Forecast:
    """Displacements (n, 3) that particles' own pasts let expect and their standard errors, mm; NaN without a past."""

    displacement_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]


def track(
    points_a: NDArray[np.float64],
    points_b: NDArray[np.float64],
    search_mm: float,
    scale: Scale,
    forecast: Forecast | None = None,
) -> Tracks:
    """Match two frames' particles, whose displacements are at most `search_mm` along each axis unless forecast.

    Any number of particles will do. One or two that have nobody to vote for them are matched with their nearest.
    """
    none = np.zeros(0, dtype=np.int64)
    tracks = Tracks(none, none, np.zeros((0, 3)))
    if not len(points_a) or not len(points_b):
        return tracks
    displacement = _first_guess(points_a, points_b, search_mm, scale, forecast)
    for _ in range(ROUNDS):
        if not np.isfinite(displacement[:, 0]).any():
            return Tracks(none, none, np.zeros((0, 3)))
        expected = expected_displacement(points_a, displacement, scale, forecast)
        gate = gate_mm(displacement - expected, search_mm, scale)
        first, second = mutual(points_a + expected, points_b, gate, scale)
        displacement = np.full(points_a.shape, np.nan)
        displacement[first] = points_b[second] - points_a[first]
        if not len(first):
            return Tracks(none, none, np.zeros((0, 3)))
        residual = (displacement - expected_displacement(points_a, displacement, scale, forecast))[first]
        outlier = _outliers(residual, scale)
        displacement[first[outlier]] = np.nan
        tracks = Tracks(first[~outlier], second[~outlier], residual[~outlier])
    return tracks


def _first_guess(
    points_a: NDArray[np.float64],
    points_b: NDArray[np.float64],
    search_mm: float,
    scale: Scale,
    forecast: Forecast | None,
) -> NDArray[np.float64]:
    """Return the displacements (n, 3) to begin with: forecast ones where these suffice, voted ones besides."""
    if forecast is None:
        return vote(points_a, points_b, search_mm, scale)
    if np.count_nonzero(np.isfinite(forecast.sigma_mm[:, 0])) >= FIT_TRACKS:
        return forecast.displacement_mm
    voted = vote(points_a, points_b, search_mm, scale)
    return np.where(np.isfinite(forecast.displacement_mm), forecast.displacement_mm, voted)


def vote(
    points_a: NDArray[np.float64], points_b: NDArray[np.float64], search_mm: float, scale: Scale
) -> NDArray[np.float64]:
    """Return for each particle of the first frame the displacement (n, 3) that most neighbours share; NaN for none.

    Of displacements that nobody shares it is the shortest.
    """
    equal = _of_equal_errors(scale)
    alike = ALIKE_LENSES * scale.lens_mm
    tree = KDTree(points_b / equal)
    count = min(NEIGHBOURS + 1, len(points_a))
    _, neighbours = KDTree(points_a).query(points_a, k=np.arange(1, count + 1))
    chosen = KDTree(points_b).query_ball_point(points_a, search_mm, p=np.inf, return_sorted=True)
    owner = np.repeat(np.arange(len(points_a)), [len(c) for c in chosen])
    target = np.array([k for c in chosen for k in c], dtype=np.int64)
    result = np.full(points_a.shape, np.nan)
    if not target.size:
        return result
    candidate = points_b[target] - points_a[owner]
    votes = np.zeros(len(owner))
    for k in range(1, count):
        at = (points_a[neighbours[owner, k]] + candidate) / equal
        distance, _ = tree.query(at, distance_upper_bound=3.0 * alike)
        votes += np.exp(-0.5 * (distance / alike) ** 2)
    order = np.lexsort((np.linalg.norm(candidate / equal, axis=1), -votes, owner))
    best = order[np.unique(owner[order], return_index=True)[1]]
    result[owner[best]] = candidate[best]
    return result


def _of_equal_errors(scale: Scale) -> NDArray[np.float64]:
    """Return what distances (x, y, z) are divided by: as much more in depth as depths are known worse."""
    return np.array([1.0, 1.0, DEPTH_RATIO * scale.depth_ratio])


def expected_displacement(
    points: NDArray[np.float64], displacement: NDArray[np.float64], scale: Scale, forecast: Forecast | None
) -> NDArray[np.float64]:
    """Return the displacements (n, 3) that the known ones of the neighbours, and a particle's own past, let expect.

    Where no other one is known, it is the particle's own: from its past, or else as it is.
    """
    by_neighbours = _by_neighbours(points, displacement, scale)
    alone = np.isnan(by_neighbours)
    if forecast is None:
        return np.where(alone, displacement, by_neighbours)
    off = displacement - by_neighbours
    spread = _spread(off[np.isfinite(off[:, 0])], scale)
    weight = spread**2 / (spread**2 + forecast.sigma_mm**2)
    past = np.isfinite(weight)
    expected = np.where(past, by_neighbours + weight * (forecast.displacement_mm - by_neighbours), by_neighbours)
    return np.where(alone, np.where(past, forecast.displacement_mm, displacement), expected)


def _by_neighbours(points: NDArray[np.float64], displacement: NDArray[np.float64], scale: Scale) -> NDArray[np.float64]:
    """Return at each point the displacement that a robust local fit through the known ones gives; NaN for none.

    A particle's own displacement takes no part in what is expected of it. The fit is linear, a mean where fewer than
    `FEWEST_OF_FIT` others are known.
    """
    known = np.flatnonzero(np.isfinite(displacement[:, 0]))
    if not known.size:
        return np.full(points.shape, np.nan)
    count = min(FIT_TRACKS + 1, len(known))
    distance, near = KDTree(points[known]).query(points, k=np.arange(1, count + 1))
    near = known[near]
    own = near == np.arange(len(points))[:, np.newaxis]
    alone = own.all(axis=1)
    # A line through one's own displacement alone is what it takes to go on; it is dropped at the end.
    own[alone] = False
    offset = points[near] - points[:, np.newaxis]
    design = np.concatenate([np.ones((*near.shape, 1)), offset], axis=2)
    if count <= FEWEST_OF_FIT:
        design[..., 1:] = 0.0
    values = displacement[near]
    middle = np.median(values, axis=1, keepdims=True)
    for _ in range(3):
        off = np.linalg.norm((values - middle) / _of_equal_errors(scale), axis=2)
        spread = np.maximum(MAD_TO_SIGMA * np.median(off, axis=1, keepdims=True), _smallest_spread_mm(scale))
        weight = np.where(own, 0.0, 1.0 / (1.0 + (off / spread) ** 2) ** 2)
        weighted = (design * weight[..., np.newaxis]).swapaxes(1, 2)
        matrix = weighted @ design
        # A share of the trace on the slopes' diagonal: neighbours in a plane do not determine the slope across it.
        ridge = 1e-3 * np.mean(distance**2, axis=1)[:, np.newaxis] * weight.sum(axis=1, keepdims=True)
        matrix[:, [1, 2, 3], [1, 2, 3]] += np.where(ridge > 0.0, ridge, 1.0)
        fitted = np.linalg.solve(matrix, weighted @ values)
        middle = design @ fitted
    return np.where(alone[:, np.newaxis], np.nan, fitted[:, 0])


def gate_mm(residual: NDArray[np.float64], search_mm: float, scale: Scale) -> float:
    """Return how far from its expected place a particle is sought: some robust deviations of the last round's.

    The mean of few neighbours misses what distinguishes their motions, which may be all that is sought; and few do not
    show how far they deviate.
    """
    known, wide = residual[np.isfinite(residual[:, 0])], 3.0 * ALIKE_LENSES * scale.lens_mm
    if not len(known):
        return wide
    least, most = 2.0 * _smallest_spread_mm(scale), wide
    if len(known) <= FEWEST_OF_FIT:
        least, most = wide, max(wide, search_mm)
    spread = MAD_TO_SIGMA * float(np.median(np.linalg.norm(known / _of_equal_errors(scale), axis=1)))
    return min(max(OUTLIER_SIGMAS * spread, least), most)


def mutual(
    expected: NDArray[np.float64], points: NDArray[np.float64], gate_mm: float, scale: Scale
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs that are nearest to each other, within the gate; particles with NaN expect to be nowhere."""
    equal, expecting = _of_equal_errors(scale), np.flatnonzero(np.isfinite(expected[:, 0]))
    if not expecting.size:
        return expecting, expecting
    forward, to = KDTree(points / equal).query(expected[expecting] / equal)
    _, back = KDTree(expected[expecting] / equal).query(points / equal)
    first = np.flatnonzero((back[to] == np.arange(len(expecting))) & (forward <= gate_mm))
    return expecting[first], to[first]


def _outliers(residual: NDArray[np.float64], scale: Scale) -> NDArray[np.bool_]:
    """Return which residuals (n, 3) lie far outside the others', component by component."""
    return np.any(np.abs(residual) > OUTLIER_SIGMAS * _spread(residual, scale), axis=1)


def _spread(residual: NDArray[np.float64], scale: Scale) -> NDArray[np.float64]:
    """Return the robust standard deviation (3,) of residuals (n, 3), no smaller than particles are known."""
    if not len(residual):
        return np.full(3, _smallest_spread_mm(scale))
    return np.maximum(MAD_TO_SIGMA * np.median(np.abs(residual), axis=0), _smallest_spread_mm(scale))


def _smallest_spread_mm(scale: Scale) -> float:
    return SMALLEST_SPREAD_LENSES * scale.lens_mm
