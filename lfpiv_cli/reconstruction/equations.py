"""The equations sum_j w_ij E_j = I_i (Eq. 11) of one image, and who takes part in them.

A pixel is left out by a row sum of zero, a voxel by a column sum of zero: saturated pixels, those behind a reflection,
voxels that no light can have come from. Solvers then give what they would give with those rows and columns deleted.

Axes: volumes [z, y, x], images [row, column], float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lfpiv_cli.arrays import Flags, Singles
from lfpiv_cli.neighbourhoods import with_neighbours
from lfpiv_cli.robust import BRIGHTEST_PERCENTILE, LIT_SHARE

Volume = Singles
Image = Singles

# Row and column sums below this share of the largest one belong to pixels or voxels that are all but unseen (a sliver
# of the sensor or of the aperture's rim); they stay out of the equations instead of being divided by.
SMALLEST_SUM = 1e-4


class Operator(Protocol):
    """What a solver needs of the weights."""

    @property
    def shape(self) -> tuple[int, int, int]: ...

    def forward(self, volume: Volume) -> Image: ...

    def adjoint(self, image: Image) -> Volume: ...


@dataclass(frozen=True, eq=False)
class Normalisers:
    """Guarded inverses of the row and column sums, the denominators of Eq. 12.

    Attributes
    ----------
    inverse_row_sum : (rows, columns) 1 / sum_n w_in over the voxels that take part, 0 for pixels that take no part
    inverse_column_sum : (z, y, x) 1 / sum_i w_ij over the pixels that take part, 0 for voxels that take no part
    """

    inverse_row_sum: Image
    inverse_column_sum: Volume

    def without(self, operator: Operator, excluded: Flags) -> Normalisers:
        """Return the sums with more pixels (rows, columns) left out."""
        inverse_row_sum = np.where(excluded, np.float32(0.0), self.inverse_row_sum)
        return _with_columns(operator, inverse_row_sum, self.inverse_column_sum > 0.0)

    def within(self, operator: Operator, support: Flags) -> Normalisers:
        """Return the sums with only the voxels of a support (z, y, x), and with the pixels that these reach."""
        support = support & (self.inverse_column_sum > 0.0)
        inverse_row_sum = _guarded_inverse(operator.forward(support.astype(np.float32)))
        inverse_row_sum[self.inverse_row_sum == 0.0] = 0.0
        return _with_columns(operator, inverse_row_sum, support)


@dataclass(frozen=True, eq=False)
class Problem:
    """The equations of one image.

    Attributes
    ----------
    operator : the weights
    image : (rows, columns) >= 0, in the weights' frame; 0 where a pixel takes no part
    sums : who takes part
    """

    operator: Operator
    image: Image
    sums: Normalisers

    @classmethod
    def of(cls, operator: Operator, image: Image, sums: Normalisers) -> Problem:
        """Return the problem of an image whose noise may be negative and whose pixels may not all take part."""
        taking_part = sums.inverse_row_sum > 0.0
        return cls(operator, np.where(taking_part, np.maximum(image, 0.0), 0.0).astype(np.float32), sums)


def normalisers(operator: Operator, excluded: Flags | None = None) -> Normalisers:
    """Return the sums of the weights, without the pixels (rows, columns) that are excluded."""
    inverse_row_sum = _guarded_inverse(operator.forward(np.ones(operator.shape, np.float32)))
    if excluded is not None:
        inverse_row_sum[excluded] = 0.0
    return _with_columns(operator, inverse_row_sum, np.ones(operator.shape, np.bool_))


def _with_columns(operator: Operator, inverse_row_sum: Image, voxels: Flags) -> Normalisers:
    """Return the sums for pixels that take part as `inverse_row_sum` says, and for voxels (z, y, x) that may."""
    column_sum = operator.adjoint((inverse_row_sum > 0.0).astype(np.float32))
    return Normalisers(inverse_row_sum, np.where(voxels, _guarded_inverse(column_sum), np.float32(0.0)))


def _guarded_inverse(sums: Singles) -> Singles:
    """Return 1 / sums, 0 where a sum is negligible beside the largest."""
    limit = SMALLEST_SUM * float(sums.max(initial=0.0))
    return np.divide(np.float32(1.0), sums, out=np.zeros_like(sums), where=sums > limit)


# Volumes to start from: uniform, or what the lines of sight allow.
#
# Axes: volumes [z, y, x], images [row, column], float32.


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


def lit_support(operator: Operator, image: Image, sums: Normalisers) -> Flags:
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
