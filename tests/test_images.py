"""What is taken off a raw image and which of its pixels are not believed."""

import numpy as np
import pytest
from scipy import ndimage

from lfpiv_cli.errors import InputError
from lfpiv_cli.reconstruction import images
from lfpiv_cli.reconstruction.images import as_if_lit, defects, filled, light, noise_residual, saturated, touched


def test_light_takes_off_dark_or_background_and_survives_broken_pixels():
    image = np.array([[10.0, np.nan], [7.0, 3.0]], np.float32)
    dark = np.full((2, 2), 4.0, np.float32)
    np.testing.assert_array_equal(light(image, dark), [[6.0, 0.0], [3.0, -1.0]])
    np.testing.assert_array_equal(light(image, dark, dark + 1), [[5.0, 0.0], [2.0, -2.0]])
    with pytest.raises(InputError, match="does not fit"):
        light(image, dark[:1])


@pytest.mark.parametrize(
    ("background", "expected"), [(images.minimum_background, [1.0, 3.0]), (images.mean_background, [2.0, 4.0])]
)
def test_a_background_needs_two_images_of_one_shape(background, expected):
    a, b = np.array([[1.0, 5.0]]), np.array([[3.0, 3.0]])
    np.testing.assert_array_equal(background([a, b]), [expected])
    with pytest.raises(InputError, match="at least two"):
        background([a])
    with pytest.raises(InputError, match="differ in shape"):
        background([a, b.T])


def test_saturated_pixels_are_at_the_end_of_a_scale_and_defects_stand_out_of_the_noise(rng):
    image = np.array([[4095.0, 4094.0, np.nan, np.inf]], np.float32)
    np.testing.assert_array_equal(saturated(image), [[True, False, True, True]])
    assert not saturated(np.array([[4090.0, 4090.0]], np.float32)).any()
    np.testing.assert_array_equal(saturated(image, 4094.0), [[True, True, True, True]])
    dark = np.rint(rng.normal(96.0, 6.0, (300, 300))).astype(np.float32)
    assert not defects(dark).any()
    dark[40, 50], dark[120, 0] = 300.0, 0.0
    np.testing.assert_array_equal(np.argwhere(defects(dark)), [[40, 50], [120, 0]])
    assert not defects(np.full((4, 4), 96.0, np.float32)).any()


def test_unusable_pixels_are_filled_and_excluded_ones_may_be_lit():
    image = np.arange(25.0, dtype=np.float32).reshape(5, 5)
    unusable = np.zeros((5, 5), bool)
    unusable[1, 1] = True
    assert filled(np.where(unusable, np.float32(9e9), image), unusable)[1, 1] == 6.0  # of 0 1 2 5 7 10 11 12
    np.testing.assert_array_equal(filled(image, unusable)[~unusable], image[~unusable])
    assert not filled(image, np.ones((5, 5), bool)).any()
    image = np.array([[1.0, 9.0, 5.0, 7.0]], np.float32)
    excluded = np.array([[True, False, False, False]])
    np.testing.assert_allclose(as_if_lit(image, excluded), [[9.0, 9.0, 5.0, 7.0]], rtol=1e-3)
    assert not as_if_lit(image, np.ones((1, 4), bool)).any()


def test_pixels_touched_by_unusable_ones_in_another_frame():
    def half_a_pixel_on(image):
        return ndimage.shift(image, (0.0, 0.5), order=3, mode="nearest")

    mask = np.zeros((5, 9), bool)
    mask[2, 4] = True
    np.testing.assert_array_equal(np.argwhere(touched(mask, half_a_pixel_on)), [[2, 3], [2, 4], [2, 5], [2, 6]])
    np.testing.assert_array_equal(touched(mask, lambda image: image), mask)


def test_noise_alone_leaves_this_residual(rng):
    light = np.where(rng.random((400, 400)) < 0.3, 2000.0, 0.0)
    recorded = rng.poisson(light * 0.5) / 0.5 + rng.normal(0.0, 6.0, light.shape)
    left = np.linalg.norm(recorded - light) / np.linalg.norm(recorded)
    assert noise_residual(recorded.astype(np.float32), 0.5) == pytest.approx(left, rel=0.02)
    # without the photons of a count only the read noise is known
    assert noise_residual(recorded.astype(np.float32)) == pytest.approx(6.0 * 400 / np.linalg.norm(recorded), rel=0.02)
    assert noise_residual(np.zeros((3, 3), np.float32)) == 0.0
