"""White images: whether they can serve, and which of several shows what."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.errors import InputError

# More saturated pixels than this and the lens images have lost their brightness, which the transmission needs.
SATURATED_SHARE = 0.05
# The difference of two dark frames reaches 3.3 times the noise of one in its brightest hundredth; light reaches more.
DARK_SIGMAS = 5.0
# Cameras of these depths store their counts as they are or shifted to the top of 16 bits.
CAMERA_BITS = (8, 10, 12, 14, 16)
# Brightness of a full lens image: above it lie hot pixels, half of it is the rim.
FULL_PERCENTILE = 99.0


def checked_white(white: ArrayLike, dark: ArrayLike | None, saturation: float | None) -> NDArray[np.float64]:
    """Return white minus dark, or say why it cannot be used."""
    raw = np.asarray(white)
    image = raw.astype(np.float64)
    if image.ndim != 2:
        raise InputError(f"the white image has {image.ndim} axes, expected one grey image of rows and columns")
    if not np.isfinite(image).all():
        raise InputError("the white image holds values that are not numbers; export it again without them")
    if saturation is None:
        saturation = saturation_level(raw)
    clipped = float(np.mean(image >= saturation))
    if image.max() > image.min() and clipped > SATURATED_SHARE:
        raise InputError(
            f"{100 * clipped:.0f} % of the white image is saturated (at {saturation:g}), at most "
            f"{100 * SATURATED_SHARE:.0f} % may be; take it with less light or a shorter exposure"
        )
    if dark is not None:
        darkness = np.asarray(dark, dtype=np.float64)
        if darkness.shape != image.shape:
            raise InputError(f"the dark frame is {darkness.shape} and the white image {image.shape} (rows, columns)")
        image = image - darkness
        if np.percentile(image, 99.0) <= DARK_SIGMAS * float(darkness.std()):
            raise InputError(
                "the white image is no brighter than the dark frame; take it with more light or a longer exposure"
            )
    if image.max() <= image.min():
        raise InputError(f"the white image has one value everywhere ({raw.flat[0]}); it shows no lens images")
    return image


def saturation_level(raw: NDArray[Any]) -> float:
    """Return the level at which the camera saturates: its brightest value if some camera's counts end there.

    Otherwise nothing is saturated below the largest value that the integer type holds; floats end at their brightest.
    """
    brightest = float(raw.max())
    if raw.dtype.kind not in "iu":
        return brightest
    ends = {2**bits - 1 for bits in CAMERA_BITS} | {(2**bits - 1) << (16 - bits) for bits in CAMERA_BITS}
    return brightest if brightest in ends else float(np.iinfo(raw.dtype).max)


def lit_share(white: ArrayLike, dark: ArrayLike | None = None) -> float:
    """Return the share of the pixels that are at least half as bright as a full lens image."""
    image = np.asarray(white, dtype=np.float64) - (0.0 if dark is None else np.asarray(dark, dtype=np.float64))
    low, high = np.percentile(image, [1.0, FULL_PERCENTILE])
    return float(np.mean(image > 0.5 * (low + high)))


def by_aperture(whites: Sequence[ArrayLike], dark: ArrayLike | None = None) -> list[int]:
    """Return the order of white images from the smallest aperture, best for centres, to the widest, for vignetting."""
    return list(np.argsort([lit_share(white, dark) for white in whites], kind="stable"))
