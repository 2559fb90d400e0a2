"""Which particle of one frame may be which of the next: pairs within reach, and what their light says of them.

Axes: points (n, 3) in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy import special
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.grid import Scale

# What the light of two particles says of their being one.
#
# The light of one tracer hardly changes from a frame to the next, that of different tracers does. By how much is
# taken from the pairs themselves: among the logarithms of the ratios of light of all pairs within reach, those of
# true partners stand out as a peak above what chance makes of pairs. The peak is wider for pairs whose light is known
# worse: its variance is one number for all, for light that changes, and another one times the variance that the fits
# state, which near the focal plane and among neighbours is a thousand times that of others.

# Of the histogram of logarithms of ratios, and how many classes of stated errors it has.
RATIO_BINS, CLASSES = 4001, 16
# Widths from which the peak is sought, and how often it is improved.
FIRST_WIDTHS = (0.01, 0.03, 0.1, 0.3)
PEAK_ROUNDS = 60
# The histogram of chance pairs is smoothed by this share of its own spread.
SMOOTHING = 0.1
# A share of true partners is off by so many times what it should be, at most.
TAIL_SHARE, TAIL_WIDTH = 0.1, 4.0
# Light of true partners that the peak does not hold: overlapping neighbours, particles at the rim of the view.
ASTRAY = 0.03
# A light that is known no better than this, in its logarithm, is not known.
LARGEST_ERROR = 1.0
# No logarithm is known better than this, squared: a thousandth.
SMALLEST_VARIANCE = 1e-6
# Fewer particles than this show no peak.
FEWEST_LIGHTS = 30
# A peak that holds less than this share of the particles, is wider than this share of what chance gives, or explains
# the histogram by less than so many units of the logarithm of the likelihood better than no peak, is none.
LEAST_SHARE, WIDEST_SHARE, LEAST_GAIN = 0.2, 0.5, 25.0


class Light(NamedTuple):
    """The light of the particles of a frame.

    Attributes
    ----------
    value : (n,) positive, in any unit
    sigma : (n,) standard errors; None: not known
    """

    value: Floats
    sigma: Floats | None = None

    def log_variance(self) -> Floats:
        """Return the variances (n,) of the logarithms, 0 where no error is known."""
        if self.sigma is None:
            return np.zeros(len(self.value))
        return np.asarray(np.fmin(self.sigma / self.value, LARGEST_ERROR) ** 2)


class Peak(NamedTuple):
    """How the logarithm of the ratio of light of true partners is distributed.

    Attributes
    ----------
    centre : of all, as illumination may differ from frame to frame
    own, stated : the variance is `own`, and so many times what the fits state
    """

    centre: float
    own: float
    stated: float

    def variance(self, stated: Floats) -> Floats:
        """Return the variances where the fits state so much."""
        return self.own + self.stated * stated

    def density(self, ratio: Floats, stated: Floats) -> Floats:
        """Return how dense ratios are, by what the fits state of their variances."""
        variance = self.variance(stated)
        near, far = (_normal(ratio - self.centre, each) for each in (variance, TAIL_WIDTH**2 * variance))
        return (1.0 - TAIL_SHARE) * near + TAIL_SHARE * far


def light_ratio(first: Light | None, second: Light | None, owner: Integers, target: Integers) -> Floats:
    """Return for pairs (c,) how much more likely their light is if they are one; 1 where light tells nothing.

    Parameters
    ----------
    first, second : light of the frames' particles; None: not known
    owner, target : (c,) numbers of the pairs' particles in the two frames
    """
    nothing = np.ones(len(owner))
    if first is None or second is None or min(len(first.value), len(second.value)) < FEWEST_LIGHTS or not len(owner):
        return nothing
    if min(first.value.min(), second.value.min()) <= 0.0:
        return nothing
    log_a, log_b = np.log(first.value), np.log(second.value)
    ratio, stated = log_b[target] - log_a[owner], first.log_variance()[owner] + second.log_variance()[target]
    others = log_b
    if len(log_a) * len(log_b) >= 10**6:
        # A hundred particles of the second frame, evenly through all.
        others = np.sort(log_b)[np.linspace(0, len(log_b) - 1, 100).astype(np.int64)]
    every = (others - log_a[:, np.newaxis]).ravel()
    reach = max(float(np.abs(every).max()), float(np.abs(ratio).max()))
    if reach <= 0.0:
        return nothing
    edges = np.linspace(-reach, reach, RATIO_BINS + 1)
    middle, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    by_chance = gaussian_filter1d(
        np.histogram(every, edges)[0].astype(np.float64), max(SMOOTHING * every.std() / width, 1.0)
    )
    by_chance = (by_chance + 1.0) / np.sum(by_chance + 1.0) / width
    # The ratios counted by classes of the stated variance, and the mean variance of each.
    number = np.searchsorted(np.quantile(stated, np.arange(1, CLASSES) / CLASSES), stated)
    size = np.bincount(number, minlength=CLASSES)
    of_class = (np.bincount(number, stated, CLASSES) / np.maximum(size, 1))[size > 0]
    bins = np.clip(np.searchsorted(edges, ratio, side="right") - 1, 0, RATIO_BINS - 1)
    counts = np.bincount(number * RATIO_BINS + bins, minlength=CLASSES * RATIO_BINS).reshape(CLASSES, -1)[size > 0]
    peak, held, gain = _peak(middle, by_chance, counts.astype(np.float64), of_class, len(first.value))
    usual = float(np.median(np.sqrt(peak.variance(stated))))
    if held < LEAST_SHARE * min(len(log_a), len(log_b)) or usual > WIDEST_SHARE * every.std() or gain < LEAST_GAIN:
        return nothing
    likely = peak.density(ratio, stated) / np.interp(ratio, middle, by_chance)
    return np.asarray((1.0 - ASTRAY) * likely + ASTRAY)


def _peak(
    middle: Floats, by_chance: Floats, counts: Floats, of_class: Floats, particles: int
) -> tuple[Peak, float, float]:
    """Return the peak above a histogram's background, how many pairs it holds, and how much it explains.

    By expectation maximisation; what it explains is the gain in the logarithm of the likelihood. Where a ratio's
    deviation has two sources, what each has of it is of what all have: a variance v_1 of v leaves v_1 (1 - v_1 / v) in
    doubt and takes the share v_1 / v of the deviation.
    """
    width, total, whole = middle[1] - middle[0], counts.sum(), counts.sum(axis=0)
    row, column = np.nonzero(counts)
    count, ratio, stated, chance = counts[row, column], middle[column], of_class[row], by_chance[column]
    without = float(count @ np.log(chance))
    best = (-np.inf, Peak(0.0, 1.0, 0.0), 0.0)
    for first_width in FIRST_WIDTHS:
        share = 0.5 * min(particles / total, 1.0)
        # the strongest accumulation begins the search: illumination may differ from frame to frame
        smooth = gaussian_filter1d(whole / (by_chance * width * total), max(first_width / width, 1.0))
        centre = float(middle[np.argmax(np.where(whole > 0.0, smooth * np.sqrt(by_chance), 0.0))])
        peak = Peak(centre, first_width**2, first_width**2 / max(float(np.median(of_class)), SMALLEST_VARIANCE))
        for _ in range(PEAK_ROUNDS):
            variance = peak.variance(stated)
            near = share * (1.0 - TAIL_SHARE) * _normal(ratio - peak.centre, variance)
            far = share * TAIL_SHARE * _normal(ratio - peak.centre, TAIL_WIDTH**2 * variance)
            of_all = count / (near + far + (1.0 - share) * chance)
            near, far = near * of_all, far * of_all
            content, weight = max(float(np.sum(near + far)), 1e-9), near + far / TAIL_WIDTH**2
            share = min(content / total, 1.0 - 1e-9)
            centre = float(weight @ (ratio / variance)) / max(float(np.sum(weight / variance)), 1e-9)
            excess = (weight * (ratio - centre) ** 2 / variance - near - far) / variance
            own = peak.own * (1.0 + peak.own * float(excess.sum()) / content)
            factor = peak.stated * (1.0 + peak.stated * float(excess @ stated) / content)
            peak = Peak(centre, max(own, width**2), factor)
        likelihood = float(count @ np.log(share * peak.density(ratio, stated) + (1.0 - share) * chance))
        if likelihood > best[0]:
            best = (likelihood, peak, share * total)
    return best[1], best[2], best[0] - without


def _normal(off: Floats, variance: Floats | float) -> Floats:
    return np.asarray(np.exp(-0.5 * off**2 / variance) / np.sqrt(2.0 * np.pi * variance))


@dataclass(frozen=True, eq=False)
class Seen:
    """The particles of a frame.

    Attributes
    ----------
    position_mm : (n, 3)
    covariance_mm2 : (n, 6) of the places as xx, yy, zz, xy, yz, xz; None: not known
    light : of each; None: not known
    """

    position_mm: Floats
    covariance_mm2: Floats | None = None
    light: Light | None = None

    def __len__(self) -> int:
        """Return how many particles there are."""
        return len(self.position_mm)

    def light_value(self) -> Floats:
        """Return the light of each, 1 where it is not known."""
        return np.ones(len(self)) if self.light is None else self.light.value

    def covariance(self) -> Floats:
        """Return the covariances of the places, 0 where they are not known."""
        return np.zeros((len(self), 6)) if self.covariance_mm2 is None else np.nan_to_num(self.covariance_mm2)

    def covariances(self) -> Floats:
        """Return the covariances (n, 3, 3) of the places, 0 where they are not known."""
        return self.covariance()[:, [0, 3, 5, 3, 1, 4, 5, 4, 2]].reshape(-1, 3, 3)

    def sigma_mm(self) -> Floats:
        """Return the standard errors (n, 3) of the places, NaN where they are not known."""
        if self.covariance_mm2 is None:
            return np.full(self.position_mm.shape, np.nan)
        return np.asarray(np.sqrt(self.covariance_mm2[:, :3]))


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs of particles that may be one, in the order of the first frame's.

    Attributes
    ----------
    first, second : (c,) numbers of the particles in the two frames
    displacement_mm : (c, 3)
    light_ratio : (c,) how much more likely their light is if they are one than if they are any two
    """

    first: Integers
    second: Integers
    displacement_mm: Floats
    light_ratio: Floats

    def part(self, chosen: Flags) -> Candidates:
        """Return some of the pairs."""
        return Candidates(
            self.first[chosen], self.second[chosen], self.displacement_mm[chosen], self.light_ratio[chosen]
        )


def candidates_of(first: Seen, second: Seen, middle_mm: Floats, share: Floats, reach_mm: Floats) -> Candidates:
    """Return the pairs whose displacement lies in an ellipsoid about `middle_mm` (n, 3).

    Its half axes are `reach_mm` (3,), of which each particle of the first frame takes a share (n,).
    """
    at = (first.position_mm + middle_mm) / reach_mm
    near = KDTree(second.position_mm / reach_mm).query_ball_point(at, share, return_sorted=True)
    owner = np.repeat(np.arange(len(first)), [len(each) for each in near])
    target = np.array([k for each in near for k in each], dtype=np.int64)
    displacement = second.position_mm[target] - first.position_mm[owner]
    return Candidates(owner, target, displacement, light_ratio(first.light, second.light, owner, target))


# How far the particles of a region have moved together: where the displacements of all pairs crowd.
#
# The pairs of a region's particles with all of the second frame's that are within reach are counted by their
# displacements. True partners crowd about what they have in common, all other pairs spread as the two clouds overlap:
# what stands out of its surroundings is the region's displacement.

# A region holds half as many particles to this many: of more the displacements differ, fewer do not stand out.
REGION = 250
# Displacements are looked at up to this, in microlenses in the scene, and no less far in depth units along the axis.
FURTHEST_LENSES, FURTHEST_DEPTHS = 25.0, 1.5
# They are counted in cells of this size, laterally in microlenses and in depth units, and summed by Gaussians whose
# standard deviations are these: displacements of a region differ, and depths have errors. Their surroundings are summed
# by Gaussians so many times as wide.
CELL_LENSES, CELL_DEPTHS = 1.5, 0.15
SUMMED_LENSES, SUMMED_DEPTHS, SURROUNDINGS = (0.7, 1.4, 2.8), 0.1, 2.5
# What stands out explains its pairs by so many units of the logarithm of the likelihood better than chance, which made
# 11 at most between clouds that have nothing in common, and holds this share of the region.
LEAST_LIKELIER, LEAST_TOGETHER = 12.0, 0.1
# With less overlap chance is not known, nor with fewer pairs; a Gaussian narrower than this, in cells, is one cell.
LEAST_OVERLAP, LEAST_PAIRS, LEAST_CELLS = 0.01, 1e-3, 0.4


def common_displacements(first_mm: Floats, second_mm: Floats, scale: Scale) -> Floats:
    """Return the displacement (n, 3) of each particle's region, mm; NaN where none stands out.

    Parameters
    ----------
    first_mm, second_mm : (n, 3) and (m, 3) places in two frames
    """
    found, unit = np.full(first_mm.shape, np.nan), scale.box_mm(1.0, 1.0)
    cell = np.maximum(CELL_LENSES * unit[0], (0.0, 0.0, CELL_DEPTHS * unit[2]))
    furthest = np.maximum(FURTHEST_LENSES * unit[0], (0.0, 0.0, FURTHEST_DEPTHS * unit[2]))
    half = np.ceil(furthest / cell).astype(np.int64)
    low, high = second_mm.min(axis=0), second_mm.max(axis=0)
    regions = [np.arange(len(first_mm))]
    while regions:
        region = regions.pop()
        at = first_mm[region]
        if len(region) > REGION:
            # Halves across the longest side, as errors of places have it.
            order = region[np.argsort(at[:, np.argmax(np.ptp(at, axis=0) / cell)], kind="stable")]
            regions += np.array_split(order, 2)
            continue
        begin, end = at.min(axis=0) - half * cell, at.max(axis=0) + half * cell
        others = second_mm[np.all((second_mm > begin) & (second_mm < end), axis=1)]
        number = np.rint((others - at[:, np.newaxis]) / cell).astype(np.int64).reshape(-1, 3) + half
        number = number[np.all((number >= 0) & (number <= 2 * half), axis=1)]
        pairs = np.zeros(2 * half + 1, np.float32)
        np.add.at(pairs, tuple(number.T), 1.0)
        # The share of the region's particles that a displacement leaves in the second frame's box.
        moved = [at[:, k, np.newaxis] + cell[k] * np.arange(-half[k], half[k] + 1) for k in range(3)]
        stay = [np.mean((each >= low[k]) & (each <= high[k]), axis=0) for k, each in enumerate(moved)]
        overlap = np.einsum("i,j,k->ijk", *stay).astype(np.float32)
        best = LEAST_LIKELIER
        for lenses in SUMMED_LENSES:
            sigma = np.hypot(lenses * unit[0], (0.0, 0.0, SUMMED_DEPTHS * unit[2])) / cell
            sums, room = (gaussian_filter(each, sigma, mode="constant") for each in (pairs, overlap))
            around = [gaussian_filter(each, SURROUNDINGS * sigma, mode="constant") for each in (pairs, overlap)]
            by_chance = around[0] / np.maximum(around[1], LEAST_OVERLAP) * room
            # Pairs that a sum of weights w counts as: the sum of w over the sum of w^2.
            cells = np.prod(2.0 * np.sqrt(np.pi) * np.maximum(sigma, LEAST_CELLS))
            chance = np.maximum(cells * by_chance, LEAST_PAIRS)
            likelier = special.xlogy(cells * sums, cells * sums / chance) - (cells * sums - chance)
            # Pairs that share particles come together.
            likelier /= 1.0 + chance / len(region)
            place = int(np.argmax(np.where(sums > by_chance, likelier, 0.0)))
            held = float((sums - by_chance).flat[place]) * np.prod(np.sqrt(2.0 * np.pi) * sigma)
            if likelier.flat[place] > best and held > LEAST_TOGETHER * len(region):
                best = float(likelier.flat[place])
                found[region] = (np.array(np.unravel_index(place, likelier.shape)) - half) * cell
    return found


# Which particles of a sequence belong together, and where the tracks so made have been.

NO_TRACK = NO_PARTICLE = -1


class Frames(Protocol):
    """Particles of frames by their numbers; those that are not asked for need not be there."""

    def __getitem__(self, number: int, /) -> Seen:
        """Return the particles of a frame."""


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Which particles of a sequence belong together.

    Attributes
    ----------
    labels : for each frame (n,) the number of each particle's track, `NO_TRACK` for none
    count : of tracks
    probability : for each frame (n,) that of the link by which a track has come to each particle; NaN where it begins
    """

    labels: tuple[Integers, ...]
    count: int
    probability: tuple[Floats, ...]

    def particles(self, frame: int, tracks: Integers) -> Integers:
        """Return the numbers of the particles in a frame that tracks have there, `NO_PARTICLE` for none."""
        labels = self.labels[frame]
        place = np.full(self.count, NO_PARTICLE)
        place[labels[labels != NO_TRACK]] = np.flatnonzero(labels != NO_TRACK)
        return np.asarray(place[tracks])

    def lengths(self) -> Integers:
        """Return how many places each track has."""
        counts = np.zeros(self.count, dtype=np.int64)
        for labels in self.labels:
            counts += np.bincount(labels[labels != NO_TRACK], minlength=self.count)
        return counts

    def expected_wrong_links(self) -> float:
        """Return how many links are wrong, by their probabilities."""
        wrong = np.empty(int(self.lengths().sum()))
        end = 0
        for labels, probability in zip(self.labels, self.probability, strict=True):
            tracked = np.flatnonzero(labels != NO_TRACK)
            end += len(tracked)
            # By track in each frame: the last bits of a sum are of the order.
            wrong[end - len(tracked) : end] = 1.0 - probability[tracked[np.argsort(labels[tracked])]]
        wrong[np.isnan(wrong)] = 0.0
        return float(np.sum(wrong))


def tracks_in(found: Trajectories, window: Sequence[int]) -> Integers:
    """Return the numbers of the tracks that pass some frames."""
    numbers = np.unique(np.concatenate([found.labels[k] for k in window]))
    return numbers[numbers != NO_TRACK]


def places(found: Trajectories, frames: Frames, window: Sequence[int], tracks: Integers) -> tuple[Floats, Floats]:
    """Return places and standard errors (n, m, 3) of tracks in the frames of a window; NaN where there are none."""
    position, sigma = (np.full((len(tracks), len(window), 3), np.nan) for _ in range(2))
    for column, frame in enumerate(window):
        place = found.particles(frame, tracks)
        there = place >= 0
        position[there, column] = frames[frame].position_mm[place[there]]
        sigma[there, column] = frames[frame].sigma_mm()[place[there]]
    return position, sigma


def long_ones(found: Trajectories, shortest: int) -> Trajectories:
    """Return the tracks with so many places at least, numbered anew in the order of their first frames."""
    is_long = found.lengths() >= shortest
    number = np.where(is_long, np.cumsum(is_long) - 1, NO_TRACK)
    number = np.append(number, NO_TRACK)
    labels = tuple(np.where(old == NO_TRACK, NO_TRACK, number[old]) for old in found.labels)
    probability = tuple(
        np.where(label == NO_TRACK, np.nan, each) for label, each in zip(labels, found.probability, strict=True)
    )
    return Trajectories(labels, int(is_long.sum()), probability)
