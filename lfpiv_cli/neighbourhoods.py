"""The largest and the smallest value around each pixel, by OpenCV: a few comparisons, however large the square is.

Pixels beyond the image's edges take no part. A square of even size reaches one pixel further towards the first row and
column than towards the last.
"""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", np.uint8, np.float32, np.float64)


def largest_around(image: NDArray[Value], size: int) -> NDArray[Value]:
    """Return the largest value (rows, columns) in a square of `size` pixels around each pixel."""
    return np.asarray(cv2.dilate(image, _square(size)))


def smallest_around(image: NDArray[Value], size: int) -> NDArray[Value]:
    """Return the smallest value (rows, columns) in a square of `size` pixels around each pixel."""
    return np.asarray(cv2.erode(image, _square(size)))


def opened(image: NDArray[Value], size: int) -> NDArray[Value]:
    """Return the grey opening (rows, columns) by a square of `size` pixels: what is bright and narrower is gone."""
    # back by the mirrored square, which differs where the size is even
    back = ((size - 1) // 2, (size - 1) // 2)
    return np.asarray(cv2.dilate(smallest_around(image, size), _square(size), anchor=back))


def with_neighbours(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels (rows, columns) of a mask and the eight neighbours of each."""
    return largest_around(mask.view(np.uint8), 3).view(np.bool_)


def _square(size: int) -> NDArray[np.uint8]:
    return np.ones((size, size), np.uint8)
