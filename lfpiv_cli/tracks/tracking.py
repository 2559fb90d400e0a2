"""Two-frame particle tracking velocimetry (PTV): which particle of one frame is which of the next, and how surely.

Neighbours move alike, more or less, and a tracer's light hardly changes. The first guess is voted for by neighbours;
then each particle's displacement is expected from those of its neighbours, with the uncertainty that the flow's own
structure function gives, and each pair within reach is weighed by its place and its light against chance. A particle
has one partner at most; the probability of each link follows, and links that are more likely than not are kept. In a
sequence, what a particle's own past forecasts joins what its neighbours let expect.

Axes: points (n, 3) in mm. Depth is known worse than the lateral place, so distances in depth count for less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.grid import Scale
from lfpiv_cli.kernels import njit
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.threads import share_out
from lfpiv_cli.tracks.candidates import Candidates, Seen, candidates_of, common_displacements
from lfpiv_cli.tracks.gridding import kriged, structure_of

# The first guess of links: neighbours vote for displacements that resemble their own.
#
# A displacement that takes a particle to one of the next frame takes many of its neighbours to others there, more or
# less: how far neighbours' displacements differ is not known at first, so likenesses of several widths count
# together.

NEIGHBOURS = 14
# Standard deviations of the differences between neighbours' displacements, laterally, in microlenses in the scene.
WIDTHS_LENSES = (0.4, 0.8, 1.6)
# Differences beyond so many of the widest one are none of a neighbour's.
REACH = 3.0
# The share of neighbours without a partner, or that move in ways of their own.
ALONE = 0.1
# Pairs whose light speaks against them more than this take no part.
LEAST_LIGHT_RATIO = 0.02


def votes(points: Floats, candidates: Candidates, density_per_mm3: float, scale: Scale) -> Floats:
    """Return the logarithm (c,) of how much more likely each pair is than chance; -inf where light excludes it.

    Parameters
    ----------
    points : (n, 3) of the first frame
    candidates : in the order of these
    density_per_mm3 : of the particles of the second frame
    """
    taken, equal = np.flatnonzero(candidates.light_ratio > LEAST_LIGHT_RATIO), of_equal_errors(scale)
    ratio = candidates.light_ratio[taken]
    begin = np.searchsorted(candidates.first[taken], np.arange(len(points) + 1))
    count = min(NEIGHBOURS + 1, len(points))
    neighbours = KDTree(points).query(points, k=np.arange(1, count + 1))[1][:, 1:]
    widths = np.array(WIDTHS_LENSES) * scale.lens_mm
    heights = 1.0 / ((2.0 * np.pi) ** 1.5 * widths**3 * np.prod(equal) * len(widths) * density_per_mm3)
    support = np.empty(len(taken))
    share_out(
        _support,
        len(points),
        begin,
        candidates.displacement_mm[taken] / equal,
        ratio,
        np.ascontiguousarray(neighbours),
        (widths, heights),
        support,
    )
    score = np.full(len(candidates.first), -np.inf)
    score[taken] = support + np.log(ratio)
    return score


@njit(cache=True, nogil=True)
def _support(
    part: tuple[int, int],
    begin: Integers,
    displacement: Floats,
    ratio: Floats,
    neighbours: Integers,
    kernels: tuple[Floats, Floats],
    support: Floats,
) -> None:
    """Write the sum over a particle's neighbours of how well one of their pairs resembles each of its own.

    `kernels` are Gaussians' widths and heights.
    """
    widths, heights = kernels
    furthest2 = (REACH * widths[-1]) ** 2
    for n in range(part[0], part[1]):
        for c in range(begin[n], begin[n + 1]):
            total = 0.0
            for k in range(neighbours.shape[1]):
                beside = neighbours[n, k]
                alike = 0.0
                for other in range(begin[beside], begin[beside + 1]):
                    x = displacement[other, 0] - displacement[c, 0]
                    y = displacement[other, 1] - displacement[c, 1]
                    z = displacement[other, 2] - displacement[c, 2]
                    off2 = x * x + y * y + z * z
                    if off2 < furthest2:
                        for w in range(widths.size):
                            alike += ratio[other] * heights[w] * np.exp(-0.5 * off2 / (widths[w] * widths[w]))
                total += np.log(ALONE + (1.0 - ALONE) * alike)
            support[c] = total


# The probability of each link where a particle has one partner at most: exclusive choices, by belief propagation.
#
# After Williams and Lau, *Approximate evaluation of marginal association probabilities with belief propagation*, IEEE
# Trans. Aerosp. Electron. Syst. 50 (2014): messages between the particles of two frames along the pairs that are
# possible, exact where these form no loops and near it where they do.

# Messages settle in some ten rounds; a change of this size is none.
MOST_ROUNDS = 200
SETTLED = 1e-6


def marginals(first: Integers, second: Integers, odds: Floats, sizes: tuple[int, int]) -> Floats:
    """Return the probability of each pair (c,).

    Parameters
    ----------
    first, second : (c,) numbers of the particles in the two frames
    odds : (c,) of the pair being one against both having no partner
    sizes : how many particles the frames have
    """
    back = np.ones(len(odds))
    for _ in range(MOST_ROUNDS):
        offered = odds * back
        forth = odds / (1.0 + np.bincount(first, offered, sizes[0])[first] - offered)
        earlier, back = back, 1.0 / (1.0 + np.bincount(second, forth, sizes[1])[second] - forth)
        if not len(odds) or np.abs(back - earlier).max() < SETTLED:
            break
    offered = odds * back
    return np.asarray(offered / (1.0 + np.bincount(first, offered, sizes[0])[first]))


# Lengths are in the camera's own units: L, a microlens in the scene (Table 2: 0.1 mm), and D, the depth over which
# light spreads by one lens (1.064 mm).
# Standard error of a depth beside that of a lateral place, in D/L: 4 in Table 2.
DEPTH_RATIO = 4.0 / 10.64
# Displacements are sought this far from where they are expected, in L across and in D along the optical axis, along
# which errors of depths come on top (Table 2: 0.75 mm); no less far along it than across, as flows may go anywhere.
REACH_LENSES, REACH_DEPTHS = 7.5, 7.5 / 10.64
# It is shorter where particles are so dense that one has more candidates than this: 30,000 particles with 120 each take
# some 0.5 GB, and their votes a minute.
MOST_CANDIDATES = 120.0
# Around a forecast, particles are sought up to so many standard errors of it and of both places, and no less than this,
# in L. How badly a partner's place is known is not known before; nineteen in twenty are known better.
FORECAST_SIGMAS, FORECAST_LENSES, PARTNERS_SIGMA = 6.0, 1.2, 0.95
# No displacement is expected better than this, laterally, in L: fits have errors that they do not know of.
SMALLEST_SIGMA_LENSES = 0.02
# Particles have moved further than they were sought where fewer than this share of those around them are linked, or in
# ways that nobody can tell; so many of them are usual where a third of the tracers is lost. A displacement is sought
# where links let expect it to this share of the reach.
LINKED_AROUND, FEW_ALONE, SURE_REACH = 0.3, 0.03, 0.5
# Links are cut off where more than so many lie beyond this share of the reach, if half of all lie far out, too, or if
# fewer than this share of the particles around them are linked, of those around the others.
OUTER, FEW_OUTER, FAR, OUTER_LINKED = 0.85, 0.03, 0.5, 0.85
# How much further the next search goes that does not otherwise add this share of the particles; how many there are.
WIDER, LEAST_GAIN, MOST_SEARCHES = 1.4, 0.01, 12
# With fewer links than this their differences do not show how unlike displacements are; a share of the search, over the
# root of their number, is added to what they let expect.
FEWEST_OF_FIT = 6
FEW_SHARE = 0.5
# What neighbours let expect is taken from the links, and these from it, until fewer than this share of them change: a
# few in ten thousand go to and fro.
ROUNDS, SETTLED_SHARE = 6, 1e-3
# A tenth of all displacements is off by three times as much as expected.
TAIL_SHARE, TAIL_WIDTH = 0.1, 3.0
# How many particles have a partner, at first and within which limits.
PARTNERED, LEAST_PARTNERED, MOST_PARTNERED = 0.9, 0.02, 0.98
# Residuals may be smaller than expected, not by more than this.
SMALLEST_FACTOR = 0.5
# Pairs further off than so many standard errors are none.
FURTHEST_SIGMAS = 12.0
# A link that is wrong although it was kept is off by as much, laterally, in L: the partner was near what was expected.
WRONG_LENSES = 0.3
# A link is kept that is more likely than all its alternatives together.
LEAST_PROBABILITY = 0.5
# Links are of one motion where the logarithms of their odds against chance, each by what the others predict, sum up
# to the first, or come to the second for each of the links of more than half of the particles. In unrelated images they
# came to 53 at most, and to 2.5.
SURE_ODDS, SURE_ODDS_EACH = 60.0, 2.7
# A link that no other bears out is kept where fewer particles than this are as near by chance.
MOST_BY_CHANCE = 0.1


@dataclass(frozen=True, eq=False)
class Tracks:
    """Links of two frames.

    Attributes
    ----------
    first, second : (n,) numbers of the particles in the two frames
    probability : (n,) of the links, from the alternatives
    log_odds : sum of the logarithms of the links' odds against chance, each by what the others predict
    """

    first: Integers
    second: Integers
    probability: Floats
    log_odds: float = 0.0


NO_TRACKS = Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Known:
    """Displacements that are known of some of the particles.

    Attributes
    ----------
    number : (k,) of the particles
    displacement_mm, variance_mm2 : (k, 3)
    """

    number: Integers
    displacement_mm: Floats
    variance_mm2: Floats


class Expected(NamedTuple):
    """Displacements (n, 3) that are expected of particles, and the variances (n, 3) of what is missed, mm, mm^2."""

    displacement_mm: Floats
    variance_mm2: Floats


@dataclass(frozen=True, eq=False)
class Forecast:
    """Displacements (n, 3) that particles' own pasts let expect and their standard errors, mm; NaN without a past."""

    displacement_mm: Floats
    sigma_mm: Floats


def track(
    first: Seen, second: Seen, scale: Scale, search_mm: float | None = None, forecast: Forecast | None = None
) -> Tracks:
    """Link two frames' particles, whose displacements are at most `search_mm` unless forecast; None: any length.

    Any number of particles will do; one alone is linked where there is one candidate. Where neither is given, links are
    kept that are of one motion beyond chance, or so short that chance makes few.
    """
    if not len(first) or not len(second):
        return NO_TRACKS
    reach = reach_of(scale, search_mm)
    reach *= min(1.0, MOST_CANDIDATES / _candidates_each(first, second, reach)) ** (1.0 / 3.0)
    links = _linked_about(np.zeros(first.position_mm.shape), first, second, reach, scale, forecast)
    if search_mm is not None or forecast is not None:
        return links
    if len(first) > NEIGHBOURS:
        links = _sought_further(links, first, second, reach, scale)
    if _of_one_motion(links, first, second):
        return links
    shown = np.nan_to_num(common_displacements(first.position_mm, second.position_mm, scale))
    far = _linked_about(shown, first, second, SURE_REACH * reach, scale)
    if _of_one_motion(far, first, second):
        return far
    # Those that are so short, beside the reach, that chance makes few.
    off = (second.position_mm[links.second] - first.position_mm[links.first]) / reach
    by_chance = np.linalg.norm(off, axis=1) ** 3 * _candidates_each(first, second, reach)
    kept = by_chance < MOST_BY_CHANCE
    return Tracks(links.first[kept], links.second[kept], (links.probability * np.exp(-by_chance))[kept])


def _of_one_motion(links: Tracks, first: Seen, second: Seen) -> bool:
    """Return whether links agree better than chance makes them."""
    count, most = len(links.first), min(len(first), len(second))
    return links.log_odds > min(SURE_ODDS, SURE_ODDS_EACH * count if 2 * count > most else SURE_ODDS)


def reach_of(scale: Scale, search_mm: float | None = None) -> Floats:
    """Return how far from where they are expected displacements are sought: half axes (3,) of an ellipsoid, mm.

    Parameters
    ----------
    search_mm : largest displacement, to which errors of depths come; None: not given
    """
    lenses, _, depths = scale.box_mm(REACH_LENSES, REACH_DEPTHS)
    across = lenses if search_mm is None else search_mm
    return np.array([across, across, max(across, depths)])


def _sought_further(links: Tracks, first: Seen, second: Seen, reach: Floats, scale: Scale) -> Tracks:
    """Return these links, or more where they leave neighbourhoods without any, or end where the search does.

    Displacements are sought again about those that the links around a particle let expect, and at first about the one
    that its region shows. Where that adds no links the reach (3,) grows, until that adds none either.
    """
    at, low, high = first.position_mm, second.position_mm.min(axis=0), second.position_mm.max(axis=0)
    near = KDTree(at).query(at, k=np.arange(2, NEIGHBOURS + 2))[1]
    middle, tried, shown = np.zeros(at.shape), reach, None
    for _ in range(MOST_SEARCHES):
        linked = np.zeros(len(at))
        linked[links.first] = links.probability
        around = linked[near].mean(axis=1)
        alone = around < LINKED_AROUND
        known = known_of(first, second, links.first, links.second, scale)
        off = (known.displacement_mm - middle[links.first]) / reach
        is_cut_off = len(off) > 0 and _cut_off(np.linalg.norm(off, axis=1), around[links.first])
        if np.mean(alone) <= FEW_ALONE and not is_cut_off:
            break
        sure = ~alone[links.first]
        known = Known(links.first[sure], known.displacement_mm[sure], known.variance_mm2[sure])
        expected, variance = expected_of(at, known, reach, scale)
        ahead = np.where(np.all(variance < (SURE_REACH * reach) ** 2, axis=1, keepdims=True), expected, middle)
        if shown is None:
            shown = common_displacements(first.position_mm, second.position_mm, scale)
            ahead = np.where(np.isfinite(shown), shown, ahead)
        # Particles that leave the view have no partner there.
        leave = np.any((at + ahead < low) | (at + ahead > high), axis=1)
        if np.mean(alone & ~leave) <= FEW_ALONE and not is_cut_off:
            break
        found = _linked_about(ahead, first, second, tried, scale)
        gained = float(found.probability.sum() - links.probability.sum())
        is_wider = tried[0] > reach[0]
        if gained > 0.0:
            links, middle, reach = found, ahead, tried
        if gained > LEAST_GAIN * len(at):
            tried = reach
        elif is_wider or _candidates_each(first, second, WIDER * reach) > MOST_CANDIDATES:
            break
        else:
            tried = WIDER * reach
    return links


def _cut_off(off: Floats, around: Floats) -> bool:
    """Return whether links end where the search does, beyond which others are missing.

    Parameters
    ----------
    off : (n,) how far their displacements are from where they were sought, 1 at the end
    around : (n,) the share of particles around each that are linked
    """
    outer = off > OUTER
    if not FEW_OUTER < np.mean(outer) < 1.0:
        return bool(outer.all())
    return bool(np.median(off) > FAR or np.mean(around[outer]) < OUTER_LINKED * np.mean(around[~outer]))


def _candidates_each(first: Seen, second: Seen, reach: Floats) -> float:
    """Return how many candidates a particle has within a reach (3,), mm."""
    return 4.0 / 3.0 * np.pi * float(np.prod(reach)) * density_per_mm3(first, second, reach)


def _linked_about(
    middle_mm: Floats, first: Seen, second: Seen, reach: Floats, scale: Scale, forecast: Forecast | None = None
) -> Tracks:
    """Link two frames' particles, whose displacements are sought about `middle_mm` (n, 3) unless forecast."""
    middle, reached = _sought(middle_mm, first, second, reach, scale, forecast)
    candidates = candidates_of(first, second, middle, reached, reach)
    density = density_per_mm3(first, second, reach)
    score = votes(first.position_mm, candidates, density, scale)
    # Those near the middle, where nobody votes.
    off = candidates.displacement_mm - middle[candidates.first]
    score = score + -0.5 * np.sum((off / reach) ** 2, axis=1)
    # Each first particle's best pair, and of those that share a second one the best.
    order = np.lexsort((-score, candidates.first))
    best = order[np.unique(candidates.first[order], return_index=True)[1]]
    best = best[np.isfinite(score[best])]
    order = best[np.argsort(-score[best], kind="stable")]
    links, share = np.sort(order[np.unique(candidates.second[order], return_index=True)[1]]), PARTNERED
    for _ in range(ROUNDS):
        known = known_of(first, second, candidates.first[links], candidates.second[links], scale)
        expected = expected_of(first.position_mm, known, reach, scale, forecast)
        expected = _calibrated(expected, known)
        probability, odds = probability_of(candidates, expected, first, second, share, density)
        share = float(np.clip(probability.sum() / len(first), LEAST_PARTNERED, MOST_PARTNERED))
        before, links = links, np.flatnonzero(probability > LEAST_PROBABILITY)
        if len(np.setxor1d(before, links)) <= SETTLED_SHARE * len(links):
            break
    log_odds = float(np.log(odds[links]).sum())
    return Tracks(candidates.first[links], candidates.second[links], probability[links], log_odds)


def link_some(
    first: tuple[Seen, Flags],
    second: tuple[Seen, Flags],
    known: Known,
    reach: Floats,
    scale: Scale,
    forecast: Forecast,
) -> Tracks:
    """Link those particles of two frames that are chosen (n,), where the displacements of others are known already."""
    (start, some), (end, free) = first, second
    if not len(start) or not len(end):
        return NO_TRACKS
    middle, reached = _sought(np.zeros(start.position_mm.shape), start, end, reach, scale, forecast)
    candidates = candidates_of(start, end, middle, reached, reach)
    candidates = candidates.part(some[candidates.first] & free[candidates.second])
    expected = _calibrated(expected_of(start.position_mm, known, reach, scale, forecast), known)
    density = density_per_mm3(start, end, reach)
    probability = probability_of(candidates, expected, start, end, PARTNERED, density)[0]
    links = np.flatnonzero(probability > LEAST_PROBABILITY)
    return Tracks(candidates.first[links], candidates.second[links], probability[links])


def known_of(first: Seen, second: Seen, at_first: Integers, at_second: Integers, scale: Scale) -> Known:
    """Return the displacements of linked particles."""
    noise = first.covariance()[at_first, :3] + second.covariance()[at_second, :3]
    displacement = second.position_mm[at_second] - first.position_mm[at_first]
    return Known(at_first, displacement, noise + _variance_of(SMALLEST_SIGMA_LENSES, scale))


def expected_of(
    points: Floats, known: Known, reach: Floats, scale: Scale, forecast: Forecast | None = None
) -> Expected:
    """Return what the known displacements of the neighbours, and a particle's own past, let expect at points (n, 3).

    A particle's own displacement takes no part in what is expected of it. The variance includes that of the place.
    Where nothing is known, any displacement within the reach (3,) is expected.
    """
    count = len(known.number)
    value, variance = np.zeros(points.shape), np.tile(reach**2 / 3.0, (len(points), 1))
    if count > 1:
        own = np.full(len(points), -1)
        own[known.number] = np.arange(count)
        at = points[known.number]
        structure = structure_of(at, known.displacement_mm, known.variance_mm2)
        value, variance = kriged(points, own, at, known.displacement_mm, known.variance_mm2, structure)
        if count < FEWEST_OF_FIT:
            variance = variance + (FEW_SHARE * reach) ** 2 / count
        # The place where a displacement ends is known as badly as the places of the neighbours' are.
        variance = variance + np.median(known.variance_mm2, axis=0) + 0.5 * structure.nugget
    if forecast is None:
        return Expected(value, variance)
    past2 = forecast.sigma_mm**2 + _variance_of(SMALLEST_SIGMA_LENSES, scale)
    weight = variance / (variance + past2)
    has_past = np.isfinite(weight) & np.isfinite(forecast.displacement_mm)
    return Expected(
        np.where(has_past, value + weight * (forecast.displacement_mm - value), value),
        np.where(has_past, weight * past2, variance),
    )


def probability_of(
    candidates: Candidates, expected: Expected, first: Seen, second: Seen, share: float, density: float
) -> tuple[Floats, Floats]:
    """Return the probability (c,) that pairs are one particle, and their odds (c,) against chance.

    Parameters
    ----------
    share : of the particles that have a partner
    density : of the second frame's particles, per mm^3
    """
    matrix = first.covariances()[candidates.first] + second.covariances()[candidates.second]
    matrix[:, [0, 1, 2], [0, 1, 2]] += expected.variance_mm2[candidates.first]
    off = candidates.displacement_mm - expected.displacement_mm[candidates.first]
    near = np.flatnonzero(np.sum(off**2 / np.diagonal(matrix, axis1=1, axis2=2), axis=1) < FURTHEST_SIGMAS**2)
    distance2 = np.einsum("ci,cij,cj->c", off[near], np.linalg.inv(matrix[near]), off[near])
    height = 1.0 / np.sqrt((2.0 * np.pi) ** 3 * np.linalg.det(matrix[near]))
    likely = height * (
        (1.0 - TAIL_SHARE) * np.exp(-0.5 * distance2)
        + TAIL_SHARE * np.exp(-0.5 * distance2 / TAIL_WIDTH**2) / TAIL_WIDTH**3
    )
    probability, odds = np.zeros(len(off)), np.zeros(len(off))
    odds[near] = likely * candidates.light_ratio[near] / density
    sizes, all_odds = (len(first), len(second)), share / (1.0 - share) * odds[near]
    probability[near] = marginals(candidates.first[near], candidates.second[near], all_odds, sizes)
    return probability, odds


def density_per_mm3(first: Seen, second: Seen, reach: Floats) -> float:
    """Return the density of the second frame's particles in the box that holds both frames', no smaller than sought."""
    both = np.concatenate([first.position_mm, second.position_mm])
    return len(second) / float(np.prod(np.maximum(np.ptp(both, axis=0), 2.0 * reach)))


def wrong_link_variance(probability: Floats, scale: Scale) -> Floats:
    """Return what is added to the variance (n, 3) of displacements, mm^2, for links being wrong by chance."""
    return (1.0 - probability)[:, np.newaxis] * _variance_of(WRONG_LENSES, scale)


def of_equal_errors(scale: Scale) -> Floats:
    """Return what distances (x, y, z) are divided by: as much more in depth as depths are known worse."""
    return np.array([1.0, 1.0, DEPTH_RATIO * scale.depth_ratio])


def _variance_of(lenses: float, scale: Scale) -> Floats:
    """Return the variances (3,) of errors of so many L laterally, mm^2, and as much more in depth."""
    return np.asarray((lenses * scale.lens_mm * of_equal_errors(scale)) ** 2)


def _sought(
    middle_mm: Floats, first: Seen, second: Seen, reach: Floats, scale: Scale, forecast: Forecast | None
) -> tuple[Floats, Floats]:
    """Return around which displacements (n, 3) partners are sought, and within which share (n,) of the reach (3,)."""
    middle, share = middle_mm.copy(), np.ones(len(first))
    if forecast is None:
        return middle, share
    has_past = np.isfinite(forecast.sigma_mm).all(axis=1) & np.isfinite(forecast.displacement_mm).all(axis=1)
    moved = forecast.displacement_mm[has_past]
    if has_past.any():
        # A particle without a past moves as the nearest one that has one.
        middle = moved[KDTree(first.position_mm[has_past]).query(first.position_mm)[1]]
    partner = np.quantile(np.sqrt(second.covariance()[:, :3]), PARTNERS_SIGMA, axis=0)
    variance = forecast.sigma_mm[has_past] ** 2 + first.covariance()[has_past, :3] + partner**2
    wide = FORECAST_SIGMAS * np.max(np.sqrt(variance) / reach, axis=1)
    least = FORECAST_LENSES * scale.lens_mm / reach[0]
    share[has_past] = np.clip(wide, least, max(least, 1.0))
    return middle, share


def _calibrated(expected: Expected, known: Known) -> Expected:
    """Return what is expected with variances that the residuals of the known displacements bear out."""
    if len(known.number) < FEWEST_OF_FIT:
        return expected
    displacement, variance = expected
    off = known.displacement_mm - displacement[known.number]
    ratio = np.abs(off) / np.sqrt(variance[known.number])
    factor = np.maximum(MAD_TO_SIGMA * np.median(ratio, axis=0), SMALLEST_FACTOR)
    return Expected(displacement, variance * factor**2)
