"""Volumes to start from: uniform, or what the lines of sight allow.

Axes: volumes [z, y, x], images [row, column], float32.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.neighbourhoods import with_neighbours
from lfpiv_cli.reconstruction.equations import Image, Normalisers, Operator, Problem, Volume
from lfpiv_cli.robust import BRIGHTEST_PERCENTILE, LIT_SHARE

# A voxel can be lit when this share of its weights lies on lit pixels or their neighbours. Noise and a voxel's width
# cost some: of nine tenths, voxels as wide as a microlens keep so few that a twentieth more of the image is left
# unexplained.
SEEN_SHARE = 0.8


def uniform_start(problem: Problem) -> Volume:
    """Return the constant volume (z, y, x) that has the image's light, 0 for voxels that take no part."""
    return scaled_to_light(problem, (problem.sums.inverse_column_sum > 0.0).astype(np.float32))


def line_of_sight_start(problem: Problem) -> Volume:
    """Return the geometric mean of what a voxel's pixels allow it (z, y, x), with the image's light.

    What pixel i allows is I_i over its row sum; dark pixels count as lit by `LIT_SHARE` of the brightest, or a single
    one of noise would put out every voxel that it sees.
    """
    level = problem.image * problem.sums.inverse_row_sum
    floor = np.float32(LIT_SHARE * _brightest(level, problem.sums))
    if floor <= 0.0:
        return np.zeros(problem.operator.shape, np.float32)
    exponent = np.where(problem.sums.inverse_row_sum > 0.0, np.log(np.maximum(level / floor, 1.0)), np.float32(0.0))
    mean = problem.operator.adjoint(exponent) * problem.sums.inverse_column_sum
    return scaled_to_light(problem, np.where(problem.sums.inverse_column_sum > 0.0, np.exp(mean), np.float32(0.0)))


def lit_support(operator: Operator, image: Image, sums: Normalisers) -> NDArray[np.bool_]:
    """Return which voxels (z, y, x) have nearly all of their weight on lit pixels or their neighbours."""
    taking_part = sums.inverse_row_sum > 0.0
    lit = taking_part & with_neighbours(image > LIT_SHARE * _brightest(image, sums))
    return np.asarray(operator.adjoint(lit.astype(np.float32)) * sums.inverse_column_sum >= SEEN_SHARE)


def scaled_to_light(problem: Problem, volume: Volume) -> Volume:
    """Return a volume (z, y, x) scaled so that it sends as much light to the pixels that take part as they show."""
    seen = problem.sums.inverse_column_sum > 0.0
    sent = np.sum(volume[seen] / problem.sums.inverse_column_sum[seen], dtype=np.float64)
    factor = np.sum(problem.image, dtype=np.float64) / sent if sent > 0.0 else 0.0
    return volume * np.float32(factor)


def _brightest(image: Image, sums: Normalisers) -> float:
    """Return the brightness of the brightest pixels that take part, 0 where there are none."""
    values = image[sums.inverse_row_sum > 0.0]
    return float(np.percentile(values, BRIGHTEST_PERCENTILE)) if values.size else 0.0
