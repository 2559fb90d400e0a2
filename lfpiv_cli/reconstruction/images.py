"""What is taken off a raw image before its light is shared out among the voxels.

Order: dark, then background; the way into the weights' frame comes after. Images [row, column], in counts.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError

Image = NDArray[np.float32]


def light(image: Image, dark: Image | None = None, background: Image | None = None) -> Image:
    """Return the tracers' light of a raw image: dark and background subtracted.

    Parameters
    ----------
    dark : image with the cap on
    background : raw image without tracers, its own dark level included; takes the place of `dark` where both are given

    Notes
    -----
    Negative values are kept: noise about zero must stay about zero until the solver decides. Values that are not finite
    count as dark.

    Raises
    ------
    InputError : the images differ in shape.
    """
    level = background if background is not None else dark
    finite = np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if level is None:
        return finite
    if level.shape != image.shape:
        raise InputError(f"dark or background of {level.shape} pixels does not fit an image of {image.shape}")
    return np.where(np.isfinite(image), finite - level, np.float32(0.0)).astype(np.float32)


def minimum_background(images: Iterable[Image]) -> Image:
    """Return the pixel-wise minimum over a sequence: what does not move, and no tracer.

    Raises
    ------
    InputError : there are fewer than two images, or they differ in shape.
    """
    lowest: Image | None = None
    count = 0
    for image in images:
        if lowest is not None and image.shape != lowest.shape:
            raise InputError(f"images of a sequence differ in shape: {lowest.shape} and {image.shape}")
        lowest = image.astype(np.float32) if lowest is None else np.fmin(lowest, image)
        count += 1
    if lowest is None or count < 2:
        raise InputError(f"a minimum background needs at least two images, found {count}")
    return lowest
