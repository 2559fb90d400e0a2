"""What is taken off a raw image, and which of its pixels are not believed, before its light is shared out.

Order: dark or background, unusable pixels filled in, then the way into the weights' frame, in which every pixel that
took more than a little from an unusable one is left out of the equations. Images [row, column], in counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import cv2
import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.errors import InputError
from lfpiv_cli.robust import BRIGHTEST_PERCENTILE, MAD_TO_SIGMA, spread_below_zero

Image = Singles
Mask = Flags

# A brightest pixel that stands at one of these is where the sensor or its converter ends: 8 to 16 bits, the odd ones
# either in the low bits or shifted up to fill sixteen.
FULL_SCALES = (255.0, 1023.0, 4095.0, 16383.0, 65472.0, 65520.0, 65532.0, 65535.0)
# A hot or dead pixel stands out of its neighbours in the dark image, above or below, by this many standard deviations
# of such differences: of four million pixels of mere noise none does.
DEFECT_SIGMAS = 8.0
# Still light is this many times as bright as what the frames differ by in all but a thousandth of the pixels: of a pair
# of the paper's channel without bubbles, whose tracers hardly move beside the walls, no pixel is from 1.5 times on. A
# bubble is many times as bright.
STILL_RATIO = 1.5
DIFFERENT_PERCENTILE = 99.9
# Of more than this share of the pixels, tracers that do not move have been taken for bubbles.
LARGEST_STILL = 0.3
# Resampling: a pixel with more than this share of its light from unusable ones is unusable, too.
TOUCHED_SHARE = 0.1


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
    return _over_sequence(images, lambda lowest, image: np.fmin(lowest, image))[0].astype(np.float32)


def mean_background(images: Iterable[Image]) -> Image:
    """Return the pixel-wise mean over a sequence, the mean light of the tracers included.

    Raises
    ------
    InputError : there are fewer than two images, or they differ in shape.
    """
    total, count = _over_sequence(images, lambda total, image: total + image)
    return (total / count).astype(np.float32)


def _over_sequence(images: Iterable[Image], combine: Callable[[Floats, Image], Floats]) -> tuple[Floats, int]:
    """Return what a combination of all images, one after the other, comes to, and their number."""
    result: Floats | None = None
    count = 0
    for image in images:
        if result is not None and image.shape != result.shape:
            raise InputError(f"images of a sequence differ in shape: {result.shape} and {image.shape}")
        result = image.astype(np.float64) if result is None else combine(result, image)
        count += 1
    if result is None or count < 2:
        raise InputError(f"a background over a sequence needs at least two images, found {count}")
    return result, count


def still_light(images: Iterable[Image], margin_px: float) -> Mask:
    """Return which pixels (rows, columns) of a sequence hold light that does not move and outshines all that does.

    Bubbles on a wall, reflections: in every image they are brighter than what the images differ by.

    Parameters
    ----------
    margin_px : how far beside such pixels others are left out as well: from one lens to the next, as a lens that sees
        only the dim rim of a bubble has an image that is no brighter than tracers

    Raises
    ------
    InputError : there are fewer than two images, they differ in shape, or hardly at all in what they show.
    """
    lowest, highest = _over_sequence((np.stack([image, -image]) for image in images), np.fmin)[0] * [[[1.0]], [[-1.0]]]
    moving = np.percentile(highest - lowest, DIFFERENT_PERCENTILE)
    dark = np.median(lowest)
    still = lowest - dark > STILL_RATIO * moving
    if np.mean(still) > LARGEST_STILL:
        raise InputError(
            f"{np.mean(still):.0%} of the light stands still, at most {LARGEST_STILL:.0%} can be left out: the images "
            "hardly differ"
        )
    side = 2 * math.ceil(margin_px) + 1
    return np.asarray(cv2.dilate(still.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def saturated(image: Image, level_counts: float | None = None) -> Mask:
    """Return which pixels (rows, columns) of a raw image are as bright as they can be, or not finite.

    Parameters
    ----------
    level_counts : counts at which the sensor saturates; None: the image's largest value, where that is one of
        `FULL_SCALES`
    """
    finite = np.isfinite(image)
    if level_counts is None:
        largest = float(image[finite].max(initial=0.0))
        level_counts = largest if largest in FULL_SCALES else np.inf
    return np.asarray(~finite | (image >= level_counts))


def defects(dark: Image) -> Mask:
    """Return which pixels (rows, columns) of a dark image stand out of their neighbours: hot or dead ones."""
    difference = dark - cv2.medianBlur(dark, 3)
    varying = np.abs(difference[difference != 0.0])
    if not varying.size:
        return np.zeros(dark.shape, np.bool_)
    return np.asarray(np.abs(difference) > DEFECT_SIGMAS * MAD_TO_SIGMA * np.median(varying))


def filled(image: Image, unusable: Mask) -> Image:
    """Return an image with unusable pixels replaced by the median of their usable neighbours, 0 where there is none.

    What stands there takes no part; but it must not ring through the splines that carry the image into another frame.
    """
    rows, columns = np.nonzero(unusable)
    padded = np.pad(np.where(unusable, np.nan, image).astype(np.float64), 1, constant_values=np.nan)
    around = np.stack([padded[rows + dy, columns + dx] for dy in range(3) for dx in range(3)], axis=1)
    known = np.isfinite(around).any(axis=1)
    values = np.zeros(rows.size, np.float32)
    values[known] = np.nanmedian(around[known], axis=1)
    result = image.astype(np.float32)
    result[rows, columns] = values
    return result


def touched(mask: Mask, prepare: Callable[[Image], Image]) -> Mask:
    """Return which pixels of the frame that `prepare` carries an image into take light from masked ones."""
    return np.asarray(np.abs(prepare(mask.astype(np.float32))) > TOUCHED_SHARE)


def as_if_lit(image: Image, excluded: Mask) -> Image:
    """Return an image whose excluded pixels are as bright as its bright ones: a line of sight may end on them."""
    usable = image[~excluded]
    bright = np.percentile(usable, BRIGHTEST_PERCENTILE) if usable.size else 0.0
    return np.where(excluded, np.float32(bright), image)


def noise_residual(image: Image, photons_per_count: float | None = None) -> float:
    """Return the relative residual ||noise|| / ||image|| that noise alone would leave of a tracers' image, 0 if dark.

    Read noise is the spread below zero, where no light hides it; light's own noise needs the photons of a count.
    """
    lit = np.maximum(image, 0.0).astype(np.float64)
    norm = float(np.sqrt(np.sum(lit**2)))
    read = spread_below_zero(image)
    shot = float(np.sum(lit)) / photons_per_count if photons_per_count is not None else 0.0
    return float(np.sqrt(read**2 * image.size + shot)) / norm if norm > 0.0 else 0.0
