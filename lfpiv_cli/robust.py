"""Medians and percentiles in place of what a few strays would spoil: means, deviations, brightness."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from lfpiv_cli.arrays import Floats

# Of a normal distribution: the standard deviation over the median of |x|, and that median in standard deviations.
MAD_TO_SIGMA = 1.4826
HALF_NORMAL_MEDIAN = 0.6745
# Standard error of a median over that of a mean.
MEDIAN_TO_MEAN = 1.25
# Values whose scatter is a smaller share of their stated errors do not err independently: in faint haze 35 peaks of it
# agreed on tracers' diameter to a seventh of these, 20 standard errors from that of the other image's tracers.
LEAST_SCATTER = 0.5
# Bright pixels are as bright as this percentile of all; single ones may be brighter for any reason.
BRIGHTEST_PERCENTILE = 99.9
# Of noise of a count and more a larger share of what is below zero is further below than one count.
FEW_FURTHER = 0.2
# A pixel counts as lit above this share of the image's bright ones.
LIT_SHARE = 0.02


def of_half_the_sum(values: NDArray[Any]) -> float:
    """Return the value from which on values make up half of the sum of all; they must not be negative.

    What most light comes from: neither a few values that are far too large nor many small ones move it far.
    """
    falling = np.sort(values, axis=None)[::-1].astype(np.float64)
    return float(falling[np.searchsorted(np.cumsum(falling), 0.5 * falling.sum())])


def weighted_median(values: Floats, sigma: Floats) -> tuple[float, float]:
    """Return the median of values (n,), those of smaller standard errors (n,) counting for more, and its own error.

    From the values' scatter, or from their standard errors where these say more.
    """
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))
    weight = 1.0 / (sigma**2 + scatter**2)
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weight[order]) - 0.5 * weight[order]
    middle = float(np.interp(0.5 * weight.sum(), below, values[order]))
    scattered = MEDIAN_TO_MEAN * scatter / np.sqrt(values.size)
    # Independent errors scatter as they are stated; those that scatter less are of one thing, and as many do not help.
    each = 1.0 / np.sqrt(np.mean(1.0 / sigma**2))
    common = scatter < LEAST_SCATTER * each
    return middle, float(max(scattered, each if common else each / np.sqrt(values.size)))


def number_below(values: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Return the edges between whole counts (k + 1,), ascending, and how many of values (n,) are below each.

    Whole counts are what was rounded to them: of little noise their percentiles are steps, and a normal distribution
    has as many below the edges between them. Below the lowest edge none was seen: half of one.
    """
    counts, number = np.unique(values.astype(np.float64), return_counts=True)
    step = float(np.diff(counts).min()) if counts.size > 1 else 0.0
    edges = np.append(counts[0] - 0.5 * step, counts + 0.5 * step)
    return edges, np.concatenate([[0.5], np.cumsum(number)])


def spread_below_zero(values: NDArray[np.floating]) -> float:
    """Return the standard deviation of noise about zero by the values (n,) below it, where no light hides it.

    By where those below the last edge between counts that is below zero are halved, and with what rounding adds; 0
    where there are none. Where nearly all of them are one count below, what is left of whole counts less others has no
    normal distribution: by their squares, with as many of those at zero as belong to them.
    """
    dark = values[values <= 0.0]
    edges, below = number_below(dark) if dark.size else (np.zeros(1), np.zeros(1))
    last = int(np.searchsorted(edges, 0.0, side="right")) - 1
    half = int(np.searchsorted(below, 0.5 * below[last], side="right")) - 1
    if last < 1 or edges[half] == edges[last]:
        return 0.0
    near, far, share = float(edges[last]), float(edges[half]), float(below[half] / below[last])
    if half == last - 1 and share < FEW_FURTHER:
        return float(np.sqrt(np.sum(dark**2) / (0.5 * (below[last] + dark.size))))
    spread = brentq(lambda sigma: ndtr(far / sigma) / ndtr(near / sigma) - share, -0.05 * far, -2.0 * far)
    return float(np.hypot(spread, (edges[1] - edges[0]) / np.sqrt(12.0)))
