"""Constants by which medians and percentiles stand for what a few strays would spoil: deviations, brightness."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Of a normal distribution: the standard deviation over the median of |x|, and that median in standard deviations.
MAD_TO_SIGMA = 1.4826
HALF_NORMAL_MEDIAN = 0.6745
# Bright pixels are as bright as this percentile of all; single ones may be brighter for any reason.
BRIGHTEST_PERCENTILE = 99.9
# A pixel counts as lit above this share of the image's bright ones.
LIT_SHARE = 0.02


def of_half_the_sum(values: NDArray[Any]) -> float:
    """Return the value from which on values make up half of the sum of all; they must not be negative.

    What most light comes from: neither a few values that are far too large nor many small ones move it far.
    """
    falling = np.sort(values, axis=None)[::-1].astype(np.float64)
    return float(falling[np.searchsorted(np.cumsum(falling), 0.5 * falling.sum())])
