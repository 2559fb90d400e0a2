"""OpenCV's comparisons around each pixel against scipy's, bit for bit, with one thread and several."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from scipy import ndimage

from lfpiv_cli.neighbourhoods import largest_around, opened, smallest_around, with_neighbours


@pytest.fixture(params=[1, 4])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(request.param)
    yield request.param
    cv2.setNumThreads(before)


@pytest.mark.parametrize("size", [1, 2, 3, 6, 7])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_same_bits_as_scipy(threads: int, size: int, kind: type, rng: np.random.Generator) -> None:
    image = rng.normal(size=(37, 29)).astype(kind)
    np.testing.assert_array_equal(largest_around(image, size), ndimage.maximum_filter(image, size, mode="nearest"))
    np.testing.assert_array_equal(smallest_around(image, size), ndimage.minimum_filter(image, size, mode="nearest"))
    np.testing.assert_array_equal(opened(image, size), ndimage.grey_opening(image, (size, size)))


def test_a_mask_grows_by_the_eight_neighbours(threads: int) -> None:
    mask = np.zeros((5, 6), np.bool_)
    mask[0, 0] = mask[3, 4] = True
    expected = np.zeros_like(mask)
    expected[:2, :2] = expected[2:5, 3:6] = True
    np.testing.assert_array_equal(with_neighbours(mask), expected)
