"""What the light of two particles says of their being one.

The light of one tracer hardly changes from a frame to the next, that of different tracers does. By how much is taken
from the pairs themselves: among the logarithms of the ratios of light of all pairs within reach, those of true partners
stand out as a peak above what chance makes of pairs. The peak is wider for pairs whose light is known worse: its
variance is one number for all, for light that changes, and another one times the variance that the fits state, which
near the focal plane and among neighbours is a thousand times that of others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

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

    value: NDArray[np.float64]
    sigma: NDArray[np.float64] | None = None

    def log_variance(self) -> NDArray[np.float64]:
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

    def variance(self, stated: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variances where the fits state so much."""
        return self.own + self.stated * stated

    def density(self, ratio: NDArray[np.float64], stated: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how dense ratios are, by what the fits state of their variances."""
        variance = self.variance(stated)
        near, far = (_normal(ratio - self.centre, each) for each in (variance, TAIL_WIDTH**2 * variance))
        return (1.0 - TAIL_SHARE) * near + TAIL_SHARE * far


def light_ratio(
    first: Light | None, second: Light | None, owner: NDArray[np.int64], target: NDArray[np.int64]
) -> NDArray[np.float64]:
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
    every = (log_b - log_a[:, np.newaxis]).ravel() if len(log_a) * len(log_b) < 10**6 else _some(log_a, log_b)
    reach = max(float(np.abs(every).max()), float(np.abs(ratio).max()))
    if reach <= 0.0:
        return nothing
    edges = np.linspace(-reach, reach, RATIO_BINS + 1)
    middle, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    by_chance = gaussian_filter1d(
        np.histogram(every, edges)[0].astype(np.float64), max(SMOOTHING * every.std() / width, 1.0)
    )
    by_chance = (by_chance + 1.0) / np.sum(by_chance + 1.0) / width
    peak, held, gain = _peak(middle, by_chance, *_histogram(ratio, stated, edges), len(first.value))
    usual = float(np.median(np.sqrt(peak.variance(stated))))
    if held < LEAST_SHARE * min(len(log_a), len(log_b)) or usual > WIDEST_SHARE * every.std() or gain < LEAST_GAIN:
        return nothing
    likely = peak.density(ratio, stated) / np.interp(ratio, middle, by_chance)
    return np.asarray((1.0 - ASTRAY) * likely + ASTRAY)


def _some(log_a: NDArray[np.float64], log_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ratios of a hundred particles of the second frame with each of the first, evenly through both."""
    steps = np.linspace(0, len(log_b) - 1, 100).astype(np.int64)
    return np.asarray((np.sort(log_b)[steps] - log_a[:, np.newaxis]).ravel())


def _histogram(
    ratio: NDArray[np.float64], stated: NDArray[np.float64], edges: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ratios counted by classes of the stated variance (classes, bins), and the mean variance of each."""
    number = np.searchsorted(np.quantile(stated, np.arange(1, CLASSES) / CLASSES), stated)
    size = np.bincount(number, minlength=CLASSES)
    of_class = np.bincount(number, stated, CLASSES) / np.maximum(size, 1)
    bins = np.clip(np.searchsorted(edges, ratio, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(number * (len(edges) - 1) + bins, minlength=CLASSES * (len(edges) - 1))
    return count.reshape(CLASSES, -1)[size > 0].astype(np.float64), of_class[size > 0]


def _peak(
    middle: NDArray[np.float64],
    by_chance: NDArray[np.float64],
    counts: NDArray[np.float64],
    of_class: NDArray[np.float64],
    particles: int,
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


def _normal(off: NDArray[np.float64], variance: NDArray[np.float64] | float) -> NDArray[np.float64]:
    return np.asarray(np.exp(-0.5 * off**2 / variance) / np.sqrt(2.0 * np.pi * variance))
