"""What a picture's light says against the calibration, or against the picture: lens images that have moved, and more.

The shift of the lens images that matters is a share of their pitch, as it moves the image of the aperture by that share
of its diameter: what lies before or behind the focal plane moves sideways with its depth, and light at the rims of lens
images is given to other lenses. At 0.8 % of the pitch a displacement is off sideways by 0.1 % of its part in depth; at
16 %, 3 of 18 px, a board's depth was off by 0.05 mm where it is known to 0.003.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.calibration.board_pose import COMMON_SHARE_OF_LENS_DEPTH, BoardPose, lens_in_scene_mm
from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.lens_light import LensImages, cell_places, part_middles
from lfpiv_cli.calibration.white import MIDDLE_PER_PITCH, NARROWEST_LENS_IMAGE
from lfpiv_cli.errors import InputError
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.robust import MAD_TO_SIGMA

# What is not a thin lens before a parallel array: an aperture that is cut aslant, a tilted array, a curved field.
#
# Lens images show the aperture. A barrel cuts it towards the corners to the shape that two circles have in common
# (cat's eye), narrower along the image height than across; their second moments tell both, without a threshold of
# brightness. Where the microlenses are further from the sensor their images are larger. A board's dots tell where the
# focus is.
#
# Axes: (column, row); image heights over that of the sensor's corners.

# Lens images of an ideal camera differ by 0.1 to 0.3 %. With a twentieth of the aperture cut off in the corners places
# erred by four stated errors, with a fifth a sixth of the tracers was found; with microlenses 1.2 % further from the
# sensor there depths erred by two, with 2.9 % by three. Of photographs one differs by 1.0 % from side to side.
LARGEST_CUT, LARGEST_GROWTH = 0.02, 0.01
# Five times what dots have in common anyway, over the depth in which light spreads by one microlens.
LARGEST_FIELD_DEPTH = 5.0 * COMMON_SHARE_OF_LENS_DEPTH

# What lies above the mean of the brightest tenth of a lens image's cell is its plateau.
BRIGHTEST_SHARE = 0.1
# Dots beyond the four numbers that are fitted: fewer know their scatter badly.
FEWEST_SPARE_DOTS = 5

WHITE = "white image"


class Fitted(NamedTuple):
    """A number and its standard error."""

    value: float
    sigma: float

    def beyond(self, largest: float) -> bool:
        """Return whether its size is above a limit, and not by chance."""
        return abs(self.value) > max(largest, CERTAIN_SIGMAS * self.sigma)


class Shapes(NamedTuple):
    """How lens images change from the middle to the corners.

    Attributes
    ----------
    cut : share of the light-giving area that is lost
    oblong : mean square width along the image height over that across, less 1
    growth : (along the columns, along the rows) of their width
    """

    cut: Fitted
    oblong: Fitted
    growth: tuple[Fitted, Fitted]


def shapes_of(images: LensImages, image_shape: tuple[int, int]) -> Shapes:
    """Return how the lens images of uniform light change over a picture (rows, columns)."""
    size = np.array(image_shape[::-1], dtype=np.float64)
    at = part_middles() * size / np.hypot(*size)
    terms = np.column_stack([np.ones(len(at)), at, np.sum(at**2, axis=1)])
    lattice, pattern, least = images.lattice_px, images.pattern, np.finfo(np.float64).tiny

    # Second moments (parts, 2, 2) along columns and rows, in square pixels.
    place = cell_places(pattern.shape[-1]) @ lattice.basis
    cell = Lattice(np.zeros(2), lattice.basis, lattice.layout)
    place = place - cell.points(cell.nearest(place))
    share = pattern / np.maximum(pattern.sum(axis=(1, 2), keepdims=True), least)
    mean = np.einsum("pij,ijk->pk", share, place)
    square = np.einsum("pij,ijk,ijl->pkl", share, place, place) - mean[:, :, np.newaxis] * mean[:, np.newaxis]
    along_x, along_y = square[:, 0, 0], square[:, 1, 1]
    width2 = along_x + along_y
    middle = float(np.median(width2))

    # Areas (parts,): light over the plateau, in bins.
    light = np.sort(pattern.reshape(len(pattern), -1), axis=1)
    plateau = light[:, -max(1, int(BRIGHTEST_SHARE * light.shape[1])) :].mean(axis=1)
    area, *_, lost = _fit(terms, light.sum(axis=1) / np.maximum(plateau, least))
    growth = _fit(terms, 0.5 * width2 / middle)
    (x, y), ones, none = at.T, np.ones(len(at)), np.zeros(len(at))
    aslant = np.concatenate([np.column_stack([ones, none, x**2 - y**2]), np.column_stack([none, ones, 2.0 * x * y])])
    oblong = _fit(aslant, np.concatenate([along_x - along_y, 2.0 * square[:, 0, 1]]) / middle)
    return Shapes(Fitted(-lost.value / area.value, lost.sigma / area.value), oblong[2], (growth[1], growth[2]))


def shape_notices(shapes: Shapes) -> Iterator[Notice]:
    """Say where the aperture is cut towards the corners, or else where the microlenses' distance changes."""
    cut, most = shapes.cut.value, max(shapes.growth, key=lambda side: abs(side.value))
    if shapes.cut.beyond(LARGEST_CUT) and shapes.oblong.beyond(0.0) and shapes.oblong.value < 0.0 < cut:
        text = (
            f"lens images are lens-shaped towards the corners: {cut:.0%} of the aperture is cut off "
            f"there, at most {LARGEST_CUT:.0%} of a good one; pitch, places and depths are off by it"
        )
        remedy = "stop the main lens down until lens images are alike everywhere"
        yield Notice("aperture-cut", WHITE, text, remedy, cut, f"at most {LARGEST_CUT:g}")
    elif most.beyond(LARGEST_GROWTH):
        text = (
            f"lens images are {abs(most.value):.1%} wider half a diagonal from the middle along the "
            f"{'columns' if most is shapes.growth[0] else 'rows'}, and as much narrower on the other side, at most "
            f"{LARGEST_GROWTH:.1%} of a good camera: microlenses are not everywhere as far from the sensor"
        )
        remedy = "mount the array parallel to the sensor, or use what is near the middle"
        yield Notice("array-tilted", WHITE, text, remedy, most.value, f"within {LARGEST_GROWTH:g}")


def field_depth(pose: BoardPose, camera: Camera) -> Fitted | None:
    """Return how much further a flat board seems to be in the corners of the sensor than in its middle, mm.

    None where there are too few dots to tell.
    """
    if pose.dots_found < 4 + FEWEST_SPARE_DOTS:
        return None
    corner = 0.5 * camera.pixel_mm * float(np.hypot(camera.columns, camera.rows))
    height = camera.px_to_mm(pose.dots_px) / corner
    terms = np.column_stack([np.ones(len(height)), height, np.sum(height**2, axis=1)])
    # From few dots in the middle the corners are far away, and what dots have in common may change up to there.
    common_mm = COMMON_SHARE_OF_LENS_DEPTH * lens_in_scene_mm(camera)[1]
    return _fit(terms, pose.residual_mm[:, 2], common_mm)[3]


def _fit(terms: Floats, values: Floats, least: float = 0.0) -> list[Fitted]:
    """Return the coefficients (k,) of terms (n, k) that fit values (n,) best, and standard errors by the scatter.

    Values err by `least` at least, however little few of them scatter.
    """
    found = np.linalg.lstsq(terms, values, rcond=None)[0]
    freedom = max(1, len(values) - terms.shape[1])
    scatter = float(np.sum((values - terms @ found) ** 2)) / freedom
    variance = max(scatter, least**2) * np.diag(np.linalg.pinv(terms.T @ terms))
    return [Fitted(float(value), float(np.sqrt(square))) for value, square in zip(found, variance, strict=True)]


# Whether a white image is one: what its lens images say against it.
#
# The limits lie between photographs of uniform light and pictures of scenes taken with the same cameras. Of four
# white images, two of them through microscopes, the residual of the lattice is 0.05 to 1 % of the pitch, nine in ten
# lens images differ from their neighbours by less than 0.2 to 4 %, and 91 to 98 % of the lens images are found; of
# pictures of scenes it is 1 to 13 %, 12 to 17 %, and 3 to 89 %.

# Shares of the pitch: twice the worst white image's, and half of what pictures of scenes leave at their worst.
LARGE_RESIDUAL, LARGEST_RESIDUAL = 0.02, 0.06
# Where more of the lens images are missing, the lattice is continued far beyond those that were found.
FEWEST_FOUND = 0.5
# Nine in ten lens images of a white image differ less from the median of those around.
LARGEST_DIFFERENCE, DIFFERENCE_PERCENTILE, NEIGHBOURS = 0.08, 90.0, 4
# Of thousands the brightest differs by two to four times as much; tracers in haze are brighter than that.
STANDING_OUT = 6.0
# Of the brightest lens image: darker ones count as this bright, which is nothing.
DARKEST = 1e-9
# What the data sheet says of the lens images' width is believed to this factor: rendered ones were 0.96 to 1.00 times
# as wide, and depths are off by as much as the f-number towards the array.
WIDTH_TOLERANCE = 1.07

IS_IT_WHITE = "photograph uniform light, out of focus, at two thirds of full scale"


def check_residual(fit: LatticeFit) -> None:
    """Refuse lens images that form no lattice.

    Raises
    ------
    InputError
    """
    share = residual_share(fit)
    if share > LARGEST_RESIDUAL:
        raise InputError(
            f"the lens images of the white image are off a lattice by {100 * share:.1f} % of their pitch, at most "
            f"{100 * LARGEST_RESIDUAL:.0f} % may be; it is not a white image: {IS_IT_WHITE}"
        )


def residual_share(fit: LatticeFit) -> float:
    """Return the residual of the lattice's model, along the axis where it is larger, over the pitch."""
    residual = fit.residual_px if fit.cubic_used else fit.residual_affine_px
    return float(residual.max() / fit.lattice_px.pitch.mean())


def white_notices(white: Floats, fit: LatticeFit, width: float, sheet_width: float | None) -> Iterator[Notice]:
    """Say what speaks against a white image.

    Parameters
    ----------
    white : (rows, columns) raw, less the dark image
    fit : lattice of its lens images
    width : of the lens images over their pitch, in the image that the transmission is from
    sheet_width : the same by the data sheet, None where they are not known
    """
    share = residual_share(fit)
    if share > LARGE_RESIDUAL:
        text = (
            f"the lens images are off the lattice by {100 * share:.1f} % of their pitch, at most "
            f"{100 * LARGE_RESIDUAL:.0f} % of a good one"
        )
        yield Notice("lattice-residual", WHITE, text, IS_IT_WHITE, share, f"at most {LARGE_RESIDUAL:g}")
    found = fit.lenses * fit.lattice_px.cell_area / white.size
    if found < FEWEST_FOUND:
        text = (
            f"{fit.lenses} lens images were found, {100 * found:.0f} % of those that the sensor has room for; the "
            "lattice is continued where there are none"
        )
        remedy = f"{IS_IT_WHITE}, and light the whole sensor"
        yield Notice("lattice-incomplete", WHITE, text, remedy, found, f"at least {FEWEST_FOUND:g}")
    difference, _ = neighbours_difference(white, fit)
    if difference > LARGEST_DIFFERENCE:
        text = (
            f"one lens image in ten differs by more than {100 * difference:.0f} % in brightness from those around it, "
            f"at most {100 * LARGEST_DIFFERENCE:.0f} % under uniform light: it looks like a picture of a scene"
        )
        yield Notice("white-not-uniform", WHITE, text, IS_IT_WHITE, difference, f"at most {LARGEST_DIFFERENCE:g}")
    reported = None if sheet_width is None else min(sheet_width, 1.0)
    if width < NARROWEST_LENS_IMAGE:
        text = (
            f"its lens images are {width:.2f} of the pitch wide, at least {NARROWEST_LENS_IMAGE:g} is needed for the "
            "transmission, which is left out"
        )
        remedy = "give a second --white, taken with the aperture of the measurements"
        yield Notice("white-stopped-down", WHITE, text, remedy, width, f"at least {NARROWEST_LENS_IMAGE:g}")
    elif reported is not None and not 1.0 / WIDTH_TOLERANCE <= width / reported <= WIDTH_TOLERANCE:
        text = (
            f"the lens images of the white image are {width:.3f} of the pitch wide, {reported:.3f} by the data sheet's "
            "aperture and microlenses: depths may be off by as large a share"
        )
        remedy = (
            "correct what is off of aperture_mm or f_number, microlenses.focal_length_mm and pupil_ratio, or take the "
            "white image with the aperture of the measurements"
        )
        expected = f"{written(reported)} within a factor of {WIDTH_TOLERANCE:g}"
        yield Notice("aperture-not-as-told", "camera.main_lens.aperture_mm", text, remedy, width, expected)


def blur_notices(images: LensImages, white: NDArray[np.floating], camera: Camera) -> Iterator[Notice]:
    """Yield what is said where the rims of the lens images of a white image less its dark one are blurred.

    Pixels, bins, diffusion, what one lens diffracts and its focus blur them in any case.
    """
    array_mm, distance_mm = float(camera.lattice.pitch.mean()), camera.microlens_distance_mm
    bin_px = float(images.lattice_px.pitch.mean()) / images.pattern.shape[-1]
    defocus = abs(1.0 - distance_mm / camera.microlens_focal_length_mm + distance_mm / camera.image_distance_mm)
    blurs_px = (
        np.sqrt(1.0 / 12.0),
        bin_px / np.sqrt(6.0),
        USUAL_DIFFUSION_PX,
        DIFFRACTED * GREEN_MM * distance_mm / array_mm / camera.pixel_mm,
        defocus * array_mm / camera.pixel_mm / np.sqrt(12.0),
    )
    found, expected = images.rim_width_px(white), float(np.linalg.norm(blurs_px))
    if found > np.hypot(expected, LARGEST_BLUR_PX):
        more = float(np.sqrt(found**2 - expected**2))
        text = (
            f"the rims of its lens images are {written(found, 2)} px wide (standard deviation), {written(expected, 2)} "
            f"by the data sheet: it is blurred by {written(more, 2)} px, at most {LARGEST_BLUR_PX:g} of a good one; "
            "frames beside it seem to have moved"
        )
        remedy = "take it with the camera still, focused as for the frames, and the diffuser evenly lit"
        yield Notice("white-blurred", WHITE, text, remedy, more, f"at most {LARGEST_BLUR_PX:g} px")


def neighbours_difference(white: Floats, fit: LatticeFit) -> tuple[float, float]:
    """Return how much nine in ten lens images at most differ in brightness from the median of those around.

    And how much brighter the one is that stands out most.
    """
    half = max(1, int(MIDDLE_PER_PITCH * fit.lattice_px.pitch.mean()))
    level = uniform_filter(np.asarray(white, dtype=np.float64), 2 * half + 1)
    columns, rows = np.clip(np.round(fit.centres_px).astype(int), 0, np.array(white.shape[::-1]) - 1).T
    brightness = level[rows, columns]
    _, nearest = KDTree(fit.centres_px).query(fit.centres_px, NEIGHBOURS + 1)
    around = np.median(brightness[nearest[:, 1:]], axis=1)
    relative = (brightness - around) / np.maximum(around, DARKEST * max(float(np.abs(brightness).max()), DARKEST))
    return float(np.percentile(np.abs(relative), DIFFERENCE_PERCENTILE)), float(relative.max())


# Lens images that have moved by less do no harm: a share of the pitch, and what pixels themselves make of small ones.
LARGEST_SHIFT_SHARE, LARGEST_SHIFT_PX = 0.008, 0.15
# Rims of white images of drawn rigs are as wide as is expected; those that are blurred by this, as standard deviation,
# are not. Of a lens that diffracts, the share of wavelength times f-number that its blur is.
LARGEST_BLUR_PX, DIFFRACTED, GREEN_MM = 0.6, 0.45, 5.5e-4
# In so many standard errors, of as many places and pictures as people have.
CERTAIN_SIGMAS = 5.0
# Of two signs together so many are enough.
BOTH_SIGMAS = 3.0
# What has moved has moved by more than does no harm where it is this many standard errors beyond.
HARMFUL_SIGMAS = 2.0
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
    following, sigma = found.following, found.following_sigma
    largest = max(LARGEST_SHIFT_SHARE * float(images.lattice_px.pitch.mean()), LARGEST_SHIFT_PX)
    sizes = [(float(np.hypot(*place.shift_px)), place) for place in found.places]
    certain = [
        (size, place)
        for size, place in sizes
        if size > max(largest + HARMFUL_SIGMAS * place.sigma_px, CERTAIN_SIGMAS * place.sigma_px)
    ]
    by_chance = following - CERTAIN_SIGMAS * sigma <= LEAST_CERTAIN_FOLLOWING
    # What seems to have moved for certain, and may be chance, lies elsewhere: as in a mirrored picture of few tracers.
    if following + (BOTH_SIGMAS if certain and by_chance else CERTAIN_SIGMAS) * sigma < LEAST_FOLLOWING:
        text = (
            f"{max(following, 0.0):.0%} of its light follows the lens images of the calibration, at "
            f"least {LEAST_FOLLOWING:.0%} of a good picture's"
        )
        other = "is it of the calibrated camera, neither scaled, turned nor mirrored? a --dark takes bright pixels off"
        return [Notice("light-off-lens-images", name, text, other, following, f"at least {LEAST_FOLLOWING:g}")]
    if not certain or by_chance:
        return []
    size, place = max(certain, key=lambda each: each[0])
    text = (
        f"its lens images lie up to {size:.2f} +- {place.sigma_px:.2f} px beside those of the calibration "
        f"({place.shift_px[0]:+z.2f} columns, {place.shift_px[1]:+z.2f} rows), at most {largest:.2f} do no harm"
    )
    return [Notice("lens-images-moved", name, text, remedy, size, f"at most {written(largest, 2)} px")]


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
    text = (
        f"where no light falls, between the lens images, it is {written(abs(level))} counts "
        f"{'brighter' if level > 0.0 else 'darker'} than without light, at most {written(largest, 2)} may be"
    )
    remedy = "give a --dark with the exposure, the gain and the bits of the images"
    return [Notice("dark-level", name, text, remedy, level, f"within {written(largest, 2)} counts")]


def saturated_share(picture: NDArray[np.floating], too_bright: Flags, background: tuple[float, float]) -> float:
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
    text = f"{share:.1%} of its lit pixels are saturated and left out, at most {GOOD_SATURATED:.0%} of a good image's"
    remedy = "less light or a shorter exposure; or correct reconstruction.saturation_counts"
    return [Notice("frame-saturated", name, text, remedy, share, f"at most {GOOD_SATURATED:g}")]


def uniform_notices(images: LensImages, fit: LatticeFit, picture: NDArray[np.floating], name: str) -> Iterator[Notice]:
    """Say where a raw picture (rows, columns) less its dark image is lit evenly, as no tracers light it."""
    if not fit.lenses:
        return
    column, row = np.clip(np.rint(fit.centres_px).astype(np.int64), 0, np.array(picture.shape[::-1]) - 1).T
    level, noise = images.background(picture)
    # Few tracers leave most lens images dark, which takes less time to see.
    if not np.median(picture[row, column]) > level + LARGEST_OFFSET_SIGMAS * noise:
        return
    difference, most = neighbours_difference(np.nan_to_num(picture), fit)
    if difference < LARGEST_DIFFERENCE and most < STANDING_OUT * difference:
        text = (
            f"nine in ten lens images differ by less than {100 * difference:.1f} % in brightness from those around, "
            "as under uniform light: it shows no tracers"
        )
        yield Notice("frame-uniform", name, text, "is it a white image?", difference, f"above {LARGEST_DIFFERENCE:g}")


def dark_notices(images: LensImages, dark: NDArray[np.floating]) -> list[Notice]:
    """Return what is said where a dark image (rows, columns) shows the lens images: light fell on it."""
    found = images.beside(dark)
    if not found.lit or found.following - CERTAIN_SIGMAS * found.following_sigma < LEAST_DARK_FOLLOWING:
        return []
    text = f"the dark image shows the lens images: {found.following:.0%} of what stands out of its noise lies on them"
    expected = f"at most {LEAST_DARK_FOLLOWING:g}"
    return [Notice("dark-lit", "--dark", text, "take it with the cap on", found.following, expected)]
