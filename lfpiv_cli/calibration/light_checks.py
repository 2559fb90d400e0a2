"""What a picture's light says against the calibration, or against the picture: lens images that have moved, and more.

The shift of the lens images that matters is a share of their pitch, as it moves the image of the aperture by that share
of its diameter: what lies before or behind the focal plane moves sideways with its depth, and light at the rims of lens
images is given to other lenses. At 0.8 % of the pitch a displacement is off sideways by 0.1 % of its part in depth; at
16 %, 3 of 18 px, a board's depth was off by 0.05 mm where it is known to 0.003.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.lens_light import LensImages
from lfpiv_cli.calibration.white_checks import LARGEST_DIFFERENCE, neighbours_difference
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.robust import MAD_TO_SIGMA

# Lens images that have moved by less do no harm: a share of the pitch, and what pixels themselves make of small ones.
LARGEST_SHIFT_SHARE, LARGEST_SHIFT_PX = 0.008, 0.15
# In so many standard errors, of as many places and pictures as people have.
CERTAIN_SIGMAS = 5.0
# Of a picture's light at least so much follows the lens images: haze, tracers and boards do wholly, hot pixels do not.
LEAST_FOLLOWING = 0.7
# Where less than this follows for certain, what seems to have moved may be chance.
LEAST_CERTAIN_FOLLOWING = 0.3
# Of what stands out of a dark image's noise, hot pixels, most lies on the lens images where these are seen in it.
LEAST_DARK_FOLLOWING = 0.5
# Between lens images it is dark, but for what is spread there: a share of the mean light that uniform light does not
# reach, and the noise, by three standard deviations of which the minimum over a hundred images lies below it.
LARGEST_OFFSET_SHARE, LARGEST_OFFSET_SIGMAS = 0.05, 3.0
# So many pixels between the lens images tell how bright it is there.
FEWEST_BETWEEN = 200
# A pixel is lit so many standard deviations of the noise above the background: of a million dark ones two hundred.
LIT_SIGMAS = 3.5
# Shares of the lit pixels that are saturated and therefore left out. The sample's vectors err as before with a quarter
# of them, and those of particles by half more in depth with 46 %, where a third of the light is not explained.
GOOD_SATURATED, MOST_SATURATED = 0.01, 0.33


def position_notices(images: LensImages, picture: NDArray[np.floating], name: str, remedy: str) -> list[Notice]:
    """Return what is said where a picture's light lies beside the lens images, or does not follow them at all.

    Parameters
    ----------
    picture : (rows, columns) raw, less the dark image; unusable pixels are NaN
    name : of the picture
    remedy : against lens images that have moved
    """
    found = images.beside(picture)
    if not found.lit:
        return []
    if found.following + CERTAIN_SIGMAS * found.following_sigma < LEAST_FOLLOWING:
        return [
            Notice(
                "light-off-lens-images",
                name,
                f"{max(found.following, 0.0):.0%} of its light follows the lens images of the calibration, at "
                f"least {LEAST_FOLLOWING:.0%} of a good picture's",
                "is it of the calibrated camera, neither scaled, turned nor mirrored? a --dark takes bright pixels off",
                found.following,
                f"at least {LEAST_FOLLOWING:g}",
            )
        ]
    largest = max(LARGEST_SHIFT_SHARE * float(images.lattice_px.pitch.mean()), LARGEST_SHIFT_PX)
    certain = [
        (float(np.hypot(*place.shift_px)), place)
        for place in found.places
        if np.hypot(*place.shift_px) > max(largest, CERTAIN_SIGMAS * place.sigma_px)
    ]
    follows = found.following - CERTAIN_SIGMAS * found.following_sigma > LEAST_CERTAIN_FOLLOWING
    if not certain or not follows:
        return []
    size, place = max(certain, key=lambda each: each[0])
    return [
        Notice(
            "lens-images-moved",
            name,
            f"its lens images lie up to {size:.2f} +- {place.sigma_px:.2f} px beside those of the calibration "
            f"({place.shift_px[0]:+z.2f} columns, {place.shift_px[1]:+z.2f} rows), at most {largest:.2f} do no harm",
            remedy,
            size,
            f"at most {written(largest, 2)} px",
        )
    ]


def level_notices(images: LensImages, picture: NDArray[np.floating], name: str) -> list[Notice]:
    """Return what is said where a raw picture (rows, columns) less its dark image is not dark between lens images."""
    between = picture.ravel()[images.between]
    between = between[np.isfinite(between)]
    if between.size < FEWEST_BETWEEN:
        return []
    level = float(np.median(between))
    noise = MAD_TO_SIGMA * float(np.median(np.abs(between - level)))
    spread = LARGEST_OFFSET_SHARE * abs(float(np.nanmean(picture))) if level > 0.0 else 0.0
    largest = max(LARGEST_OFFSET_SIGMAS * noise, spread)
    if abs(level) <= largest:
        return []
    return [
        Notice(
            "dark-level",
            name,
            f"where no light falls, between the lens images, it is {written(abs(level))} counts "
            f"{'brighter' if level > 0.0 else 'darker'} than without light, at most {written(largest, 2)} may be",
            "give a --dark with the exposure, the gain and the bits of the images",
            level,
            f"within {written(largest, 2)} counts",
        )
    ]


def saturated_share(
    picture: NDArray[np.floating], too_bright: NDArray[np.bool_], background: tuple[float, float]
) -> float:
    """Return which share of the lit pixels of a picture (rows, columns) is saturated.

    Parameters
    ----------
    picture : raw, less the dark image; NaN where pixels are lit or not for reasons of their own
    too_bright : (rows, columns) which pixels are saturated
    background : level and noise of the dark ones
    """
    level, noise = background
    lit = too_bright | (picture > level + LIT_SIGMAS * noise)
    return float(np.count_nonzero(too_bright)) / max(int(np.count_nonzero(lit)), 1)


def exposure_notices(share: float, name: str) -> list[Notice]:
    """Return what is said where too large a share of a picture's lit pixels is saturated."""
    if share <= GOOD_SATURATED:
        return []
    return [
        Notice(
            "frame-saturated",
            name,
            f"{share:.1%} of its lit pixels are saturated and left out, at most {GOOD_SATURATED:.0%} of a good image's",
            "less light or a shorter exposure; or correct reconstruction.saturation_counts",
            share,
            f"at most {GOOD_SATURATED:g}",
        )
    ]


def uniform_notices(images: LensImages, fit: LatticeFit, picture: NDArray[np.floating], name: str) -> Iterator[Notice]:
    """Say where a raw picture (rows, columns) less its dark image is lit evenly, as no tracers light it."""
    if not fit.lenses:
        return
    column, row = np.clip(np.rint(fit.centres_px).astype(np.int64), 0, np.array(picture.shape[::-1]) - 1).T
    level, noise = images.background(picture)
    # Few tracers leave most lens images dark, which takes less time to see.
    if not np.median(picture[row, column]) > level + LARGEST_OFFSET_SIGMAS * noise:
        return
    difference = neighbours_difference(np.nan_to_num(picture), fit)
    if difference < LARGEST_DIFFERENCE:
        yield Notice(
            "frame-uniform",
            name,
            f"nine in ten lens images differ by less than {100 * difference:.1f} % in brightness from those around, "
            "as under uniform light: it shows no tracers",
            "is it a white image?",
            difference,
            f"above {LARGEST_DIFFERENCE:g}",
        )


def dark_notices(images: LensImages, dark: NDArray[np.floating]) -> list[Notice]:
    """Return what is said where a dark image (rows, columns) shows the lens images: light fell on it."""
    found = images.beside(dark)
    if not found.lit or found.following - CERTAIN_SIGMAS * found.following_sigma < LEAST_DARK_FOLLOWING:
        return []
    return [
        Notice(
            "dark-lit",
            "--dark",
            f"the dark image shows the lens images: {found.following:.0%} of what stands out of its noise lies on them",
            "take it with the cap on",
            found.following,
            f"at most {LEAST_DARK_FOLLOWING:g}",
        )
    ]
