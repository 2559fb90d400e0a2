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

# Standard error of a depth beside that of a lateral place: distances are measured with depth divided by this.
DEPTH_RATIO = 4.0
# Displacements are sought up to this many voxels along each axis unless told otherwise.
SEARCH_VOXEL = 6.0
NEIGHBOURS = 14
# How far two displacements of neighbours may differ to count as alike, first and after a fit, in mm laterally.
ALIKE_MM = 0.04
# A local linear fit through as many tracks as seven for each of its unknowns.
FIT_TRACKS = 28
ROUNDS = 4
# A match stays within so many robust standard deviations of the fit around it.
OUTLIER_SIGMAS = 5.0
# The spread below which no match is dropped, mm: particles are not known better.
SMALLEST_SPREAD_MM = 0.004


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
    forecast: Forecast | None = None,
) -> Tracks:
    """Match two frames' particles, whose displacements are at most `search_mm` along each axis unless forecast."""
    empty = np.zeros(0, dtype=np.int64)
    none = Tracks(empty, empty, np.zeros((0, 3)))
    if len(points_a) < FIT_TRACKS or len(points_b) < FIT_TRACKS:
        return none
    if forecast is None or np.count_nonzero(np.isfinite(forecast.sigma_mm[:, 0])) < FIT_TRACKS:
        displacement = vote(points_a, points_b, search_mm)
    else:
        displacement = forecast.displacement_mm
    for _ in range(ROUNDS):
        if np.count_nonzero(np.isfinite(displacement[:, 0])) < FIT_TRACKS:
            return none
        expected = expected_displacement(points_a, displacement, forecast)
        first, second = mutual(points_a + expected, points_b, gate_mm(displacement - expected))
        displacement = np.full(points_a.shape, np.nan)
        displacement[first] = points_b[second] - points_a[first]
        if len(first) < FIT_TRACKS:
            return none
        residual = displacement - expected_displacement(points_a, displacement, forecast)
        outlier = _outliers(residual[first])
        displacement[first[outlier]] = np.nan
    if np.count_nonzero(~outlier) < FIT_TRACKS:
        return none
    return Tracks(first[~outlier], second[~outlier], residual[first[~outlier]])


def vote(points_a: NDArray[np.float64], points_b: NDArray[np.float64], search_mm: float) -> NDArray[np.float64]:
    """Return for each particle of the first frame the displacement (n, 3) that most neighbours share; NaN for none."""
    scale = np.array([1.0, 1.0, 1.0 / DEPTH_RATIO])
    tree = KDTree(points_b * scale)
    count = min(NEIGHBOURS + 1, len(points_a))
    _, neighbours = KDTree(points_a).query(points_a, k=count)
    chosen = KDTree(points_b).query_ball_point(points_a, search_mm, p=np.inf, return_sorted=True)
    owner = np.repeat(np.arange(len(points_a)), [len(c) for c in chosen])
    target = np.array([k for c in chosen for k in c], dtype=np.int64)
    result = np.full(points_a.shape, np.nan)
    if not target.size:
        return result
    candidate = points_b[target] - points_a[owner]
    votes = np.zeros(len(owner))
    for k in range(1, count):
        at = (points_a[neighbours[owner, k]] + candidate) * scale
        distance, _ = tree.query(at, distance_upper_bound=3.0 * ALIKE_MM)
        votes += np.exp(-0.5 * (distance / ALIKE_MM) ** 2)
    order = np.lexsort((-votes, owner))
    best = order[np.unique(owner[order], return_index=True)[1]]
    result[owner[best]] = candidate[best]
    return result


def expected_displacement(
    points: NDArray[np.float64], displacement: NDArray[np.float64], forecast: Forecast | None
) -> NDArray[np.float64]:
    """Return the displacements (n, 3) that the known ones of the neighbours, and a particle's own past, let expect."""
    by_neighbours = _by_neighbours(points, displacement)
    if forecast is None:
        return by_neighbours
    off = displacement - by_neighbours
    spread = _spread(off[np.isfinite(off[:, 0])])
    weight = spread**2 / (spread**2 + forecast.sigma_mm**2)
    past = np.isfinite(weight)
    return np.where(past, by_neighbours + weight * (forecast.displacement_mm - by_neighbours), by_neighbours)


def _by_neighbours(points: NDArray[np.float64], displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return at each point the displacement that a robust local linear fit through the known ones gives.

    A particle's own displacement takes no part in what is expected of it.
    """
    known = np.flatnonzero(np.isfinite(displacement[:, 0]))
    count = min(FIT_TRACKS + 1, len(known))
    distance, near = KDTree(points[known]).query(points, k=count)
    near = known[near]
    own = near == np.arange(len(points))[:, np.newaxis]
    offset = points[near] - points[:, np.newaxis]
    design = np.concatenate([np.ones((*near.shape, 1)), offset], axis=2)
    values = displacement[near]
    middle = np.median(values, axis=1, keepdims=True)
    weight = np.where(own, 0.0, 1.0)
    for _ in range(3):
        off = np.linalg.norm((values - middle) / (1.0, 1.0, DEPTH_RATIO), axis=2)
        spread = np.maximum(MAD_TO_SIGMA * np.median(off, axis=1, keepdims=True), SMALLEST_SPREAD_MM)
        weight = np.where(own, 0.0, 1.0 / (1.0 + (off / spread) ** 2) ** 2)
        weighted = (design * weight[..., np.newaxis]).swapaxes(1, 2)
        matrix = weighted @ design
        # A share of the trace on the slopes' diagonal: neighbours in a plane do not determine the slope across it.
        ridge = 1e-3 * np.mean(distance**2, axis=1)[:, np.newaxis] * weight.sum(axis=1, keepdims=True)
        matrix[:, [1, 2, 3], [1, 2, 3]] += ridge
        fitted = np.linalg.solve(matrix, weighted @ values)
        middle = design @ fitted
    return fitted[:, 0]


def gate_mm(residual: NDArray[np.float64]) -> float:
    """Return how far from its expected place a particle is sought: some robust deviations of the last round's."""
    known = residual[np.isfinite(residual[:, 0])]
    distance = np.linalg.norm(known / (1.0, 1.0, DEPTH_RATIO), axis=1)
    spread = MAD_TO_SIGMA * float(np.median(distance)) if distance.size else 0.0
    return min(max(OUTLIER_SIGMAS * spread, 2.0 * SMALLEST_SPREAD_MM), 3.0 * ALIKE_MM)


def mutual(
    expected: NDArray[np.float64], points: NDArray[np.float64], gate_mm: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs that are nearest to each other, within the gate."""
    scale = np.array([1.0, 1.0, 1.0 / DEPTH_RATIO])
    forward, to = KDTree(points * scale).query(expected * scale)
    _, back = KDTree(expected * scale).query(points * scale)
    first = np.flatnonzero((back[to] == np.arange(len(expected))) & (forward <= gate_mm))
    return first, to[first]


def _outliers(residual: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which residuals (n, 3) lie far outside the others', component by component."""
    return np.any(np.abs(residual) > OUTLIER_SIGMAS * _spread(residual), axis=1)


def _spread(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the robust standard deviation (3,) of residuals (n, 3), no smaller than particles are known."""
    return np.maximum(MAD_TO_SIGMA * np.median(np.abs(residual), axis=0), SMALLEST_SPREAD_MM)
