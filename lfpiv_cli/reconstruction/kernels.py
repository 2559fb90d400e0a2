"""What solvers do with whole images, in one pass over the pixels each.

An image has more pixels than a small volume has voxels; array by array these passes cost more than its weights.

Axes: images [row, column], float32. Pixels whose inverse row sum is 0 take no part.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Image = NDArray[np.float32]


@njit(cache=True, parallel=True)
def correction(image: Image, projection: Image, inverse_row_sum: Image) -> Image:
    """Return (I - W E) / sum_n w_in, the correction of Eq. 12."""
    result = np.empty(image.shape, np.float32)
    for row in prange(image.shape[0]):
        for column in range(image.shape[1]):
            difference = image[row, column] - projection[row, column]
            result[row, column] = difference * inverse_row_sum[row, column]
    return result


@njit(cache=True, parallel=True)
def ratio(image: Image, projection: Image, inverse_row_sum: Image) -> Image:
    """Return I / W E, 0 where the volume does not light a pixel or it takes no part."""
    result = np.zeros(image.shape, np.float32)
    for row in prange(image.shape[0]):
        for column in range(image.shape[1]):
            if projection[row, column] > 0.0 and inverse_row_sum[row, column] > 0.0:
                result[row, column] = image[row, column] / projection[row, column]
    return result


@njit(cache=True, parallel=True)
def square_differences(image: Image, projection: Image, inverse_row_sum: Image) -> NDArray[np.float64]:
    """Return the sum of (I - W E)^2 of each row (rows,), so that their sum has the same bits for any threads."""
    result = np.zeros(image.shape[0], np.float64)
    for row in prange(image.shape[0]):
        total = 0.0
        for column in range(image.shape[1]):
            if inverse_row_sum[row, column] > 0.0:
                difference = np.float64(image[row, column] - projection[row, column])
                total += difference * difference
        result[row] = total
    return result
