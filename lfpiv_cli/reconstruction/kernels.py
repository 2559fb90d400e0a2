"""What solvers do with whole images, in one pass over the pixels each.

An image has more pixels than a small volume has voxels; array by array these passes cost more than its weights.

Axes: images [row, column], float32. Pixels whose inverse row sum is 0 take no part.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.threads import share_out

Image = NDArray[np.float32]


def correction(image: Image, projection: Image, inverse_row_sum: Image) -> Image:
    """Return (I - W E) / sum_n w_in, the correction of Eq. 12."""
    result = np.empty(image.shape, np.float32)
    share_out(_correct, image.shape[0], image, projection, inverse_row_sum, result)
    return result


@njit(cache=True, nogil=True)
def _correct(part: tuple[int, int], image: Image, projection: Image, inverse_row_sum: Image, result: Image) -> None:
    """Write rows `part` of `correction`."""
    for row in range(part[0], part[1]):
        for column in range(image.shape[1]):
            difference = image[row, column] - projection[row, column]
            result[row, column] = difference * inverse_row_sum[row, column]


def ratio(image: Image, projection: Image, inverse_row_sum: Image) -> Image:
    """Return I / W E, 0 where the volume does not light a pixel or it takes no part."""
    result = np.empty(image.shape, np.float32)
    share_out(_divide, image.shape[0], image, projection, inverse_row_sum, result)
    return result


@njit(cache=True, nogil=True)
def _divide(part: tuple[int, int], image: Image, projection: Image, inverse_row_sum: Image, result: Image) -> None:
    """Write rows `part` of `ratio`."""
    for row in range(part[0], part[1]):
        for column in range(image.shape[1]):
            seen = projection[row, column] > 0.0 and inverse_row_sum[row, column] > 0.0
            result[row, column] = image[row, column] / projection[row, column] if seen else np.float32(0.0)


def square_differences(image: Image, projection: Image, inverse_row_sum: Image) -> NDArray[np.float64]:
    """Return the sum of (I - W E)^2 of each row (rows,), so that their sum has the same bits for any threads."""
    result = np.empty(image.shape[0], np.float64)
    share_out(_sum_squares, image.shape[0], image, projection, inverse_row_sum, result)
    return result


@njit(cache=True, nogil=True)
def _sum_squares(
    part: tuple[int, int], image: Image, projection: Image, inverse_row_sum: Image, result: NDArray[np.float64]
) -> None:
    """Write rows `part` of `square_differences`."""
    for row in range(part[0], part[1]):
        total = 0.0
        for column in range(image.shape[1]):
            if inverse_row_sum[row, column] > 0.0:
                difference = np.float64(image[row, column] - projection[row, column])
                total += difference * difference
        result[row] = total
