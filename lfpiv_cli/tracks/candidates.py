"""Which particle of one frame may be which of the next: pairs within reach, and what their light says of them.

The light of one tracer hardly changes from a frame to the next, that of different tracers does. By how much is taken
from the pairs themselves: among the logarithms of the ratios of light of all pairs within reach, those of true partners
stand out as a narrow peak above what chance makes of pairs.

Axes: points (n, 3) in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

# Of the histogram of logarithms of ratios; the peak of partners is seldom narrower than two percent.
RATIO_BINS = 4001
# Widths from which the peak is sought, and how often it is improved.
FIRST_WIDTHS = (0.01, 0.03, 0.1, 0.3)
PEAK_ROUNDS = 60
# The histogram of chance pairs is smoothed by this share of its own spread.
SMOOTHING = 0.1
# Light of true partners that the peak does not hold: overlapping neighbours, particles at the rim of the view.
ASTRAY = 0.03
# Fewer particles than this show no peak.
FEWEST_LIGHTS = 30
# A peak that holds less than this share of the particles, is wider than this share of what chance gives, or explains
# the histogram by less than so many units of the logarithm of the likelihood better than no peak, is none.
LEAST_SHARE, WIDEST_SHARE, LEAST_GAIN = 0.2, 0.5, 25.0


@dataclass(frozen=True, eq=False)
class Seen:
    """The particles of a frame.

    Attributes
    ----------
    position_mm : (n, 3)
    covariance_mm2 : (n, 6) of the places as xx, yy, zz, xy, yz, xz; None: not known
    light : (n,) positive, in any unit; None: not known
    """

    position_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64] | None = None
    light: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        """Return how many particles there are."""
        return len(self.position_mm)

    def covariance(self) -> NDArray[np.float64]:
        """Return the covariances of the places, 0 where they are not known."""
        return np.zeros((len(self), 6)) if self.covariance_mm2 is None else np.nan_to_num(self.covariance_mm2)

    def sigma_mm(self) -> NDArray[np.float64]:
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

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    displacement_mm: NDArray[np.float64]
    light_ratio: NDArray[np.float64]

    def part(self, chosen: NDArray[np.bool_]) -> Candidates:
        """Return some of the pairs."""
        return Candidates(
            self.first[chosen], self.second[chosen], self.displacement_mm[chosen], self.light_ratio[chosen]
        )


def candidates_of(
    first: Seen, second: Seen, middle_mm: NDArray[np.float64], reach_mm: NDArray[np.float64]
) -> Candidates:
    """Return the pairs whose displacement is within `reach_mm` (n,) along each axis of `middle_mm` (n, 3)."""
    at = first.position_mm + middle_mm
    near = KDTree(second.position_mm).query_ball_point(at, reach_mm, p=np.inf, return_sorted=True)
    owner = np.repeat(np.arange(len(first)), [len(each) for each in near])
    target = np.array([k for each in near for k in each], dtype=np.int64)
    displacement = second.position_mm[target] - first.position_mm[owner]
    return Candidates(owner, target, displacement, light_ratio(first.light, second.light, owner, target))


def light_ratio(
    first: NDArray[np.float64] | None,
    second: NDArray[np.float64] | None,
    owner: NDArray[np.int64],
    target: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return for pairs (c,) how much more likely their light is if they are one; 1 where light tells nothing.

    Parameters
    ----------
    first, second : (n,), (m,) light of the particles
    """
    nothing = np.ones(len(owner))
    if first is None or second is None or min(len(first), len(second)) < FEWEST_LIGHTS or not len(owner):
        return nothing
    if min(first.min(), second.min()) <= 0.0:
        return nothing
    log_a, log_b = np.log(first), np.log(second)
    ratio = log_b[target] - log_a[owner]
    every = (log_b - log_a[:, np.newaxis]).ravel() if len(log_a) * len(log_b) < 10**6 else _some(log_a, log_b)
    reach = max(float(np.abs(every).max()), float(np.abs(ratio).max()))
    if reach <= 0.0:
        return nothing
    edges = np.linspace(-reach, reach, RATIO_BINS + 1)
    middle, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    count = np.histogram(ratio, edges)[0].astype(np.float64)
    by_chance = gaussian_filter1d(
        np.histogram(every, edges)[0].astype(np.float64), max(SMOOTHING * every.std() / width, 1.0)
    )
    by_chance = (by_chance + 1.0) / np.sum(by_chance + 1.0) / width
    centre, sigma, held, gain = _peak(middle, count, by_chance, len(first))
    if held < LEAST_SHARE * min(len(first), len(second)) or sigma > WIDEST_SHARE * every.std() or gain < LEAST_GAIN:
        return nothing
    likely = _normal(ratio - centre, sigma) / np.interp(ratio, middle, by_chance)
    return np.asarray((1.0 - ASTRAY) * likely + ASTRAY)


def _some(log_a: NDArray[np.float64], log_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ratios of a hundred particles of the second frame with each of the first, evenly through both."""
    steps = np.linspace(0, len(log_b) - 1, 100).astype(np.int64)
    return np.asarray((np.sort(log_b)[steps] - log_a[:, np.newaxis]).ravel())


def _peak(
    middle: NDArray[np.float64], count: NDArray[np.float64], by_chance: NDArray[np.float64], particles: int
) -> tuple[float, float, float, float]:
    """Return centre, width and content of the peak above a histogram's background, and how much it explains.

    By expectation maximisation; what it explains is the gain in the logarithm of the likelihood.
    """
    width, total = middle[1] - middle[0], count.sum()
    without = float(count @ np.log(by_chance))
    best = (-np.inf, 0.0, 1.0, 0.0)
    for first_width in FIRST_WIDTHS:
        sigma, share = first_width, 0.5 * min(particles / total, 1.0)
        # the strongest accumulation begins the search: illumination may differ from frame to frame
        smooth = gaussian_filter1d(count / (by_chance * width * total), max(first_width / width, 1.0))
        centre = float(middle[np.argmax(np.where(count > 0.0, smooth * np.sqrt(by_chance), 0.0))])
        for _ in range(PEAK_ROUNDS):
            peak = share * _normal(middle - centre, sigma)
            of_peak = count * peak / (peak + (1.0 - share) * by_chance)
            content = max(float(of_peak.sum()), 1e-9)
            share = min(content / total, 1.0 - 1e-9)
            centre = float(of_peak @ middle) / content
            sigma = max(float(np.sqrt(of_peak @ (middle - centre) ** 2 / content)), width)
        likelihood = float(count @ np.log(share * _normal(middle - centre, sigma) + (1.0 - share) * by_chance))
        best = max(best, (likelihood, centre, sigma, share * total))
    return best[1], best[2], best[3], best[0] - without


def _normal(off: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    return np.asarray(np.exp(-0.5 * (off / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi)))
