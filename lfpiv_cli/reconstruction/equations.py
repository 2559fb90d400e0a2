"""The equations sum_j w_ij E_j = I_i (Eq. 11) of one image, and who takes part in them.

A pixel is left out by a row sum of zero, a voxel by a column sum of zero: saturated pixels, those behind a reflection,
voxels that no light can have come from. Solvers then give what they would give with those rows and columns deleted.

Axes: volumes [z, y, x], images [row, column], float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Volume = NDArray[np.float32]
Image = NDArray[np.float32]

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

    def without(self, operator: Operator, excluded: NDArray[np.bool_]) -> Normalisers:
        """Return the sums with more pixels (rows, columns) left out."""
        inverse_row_sum = np.where(excluded, np.float32(0.0), self.inverse_row_sum)
        return _with_columns(operator, inverse_row_sum, self.inverse_column_sum > 0.0)

    def within(self, operator: Operator, support: NDArray[np.bool_]) -> Normalisers:
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


def normalisers(operator: Operator, excluded: NDArray[np.bool_] | None = None) -> Normalisers:
    """Return the sums of the weights, without the pixels (rows, columns) that are excluded."""
    inverse_row_sum = _guarded_inverse(operator.forward(np.ones(operator.shape, np.float32)))
    if excluded is not None:
        inverse_row_sum[excluded] = 0.0
    return _with_columns(operator, inverse_row_sum, np.ones(operator.shape, np.bool_))


def _with_columns(operator: Operator, inverse_row_sum: Image, voxels: NDArray[np.bool_]) -> Normalisers:
    """Return the sums for pixels that take part as `inverse_row_sum` says, and for voxels (z, y, x) that may."""
    column_sum = operator.adjoint((inverse_row_sum > 0.0).astype(np.float32))
    return Normalisers(inverse_row_sum, np.where(voxels, _guarded_inverse(column_sum), np.float32(0.0)))


def _guarded_inverse(sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return 1 / sums, 0 where a sum is negligible beside the largest."""
    limit = SMALLEST_SUM * float(sums.max(initial=0.0))
    return np.divide(np.float32(1.0), sums, out=np.zeros_like(sums), where=sums > limit)
