"""Whether a white image is one: what its lens images say against it.

The limits lie between photographs of uniform light and pictures of scenes taken with the same cameras. Of four white
images, two of them through microscopes, the residual of the lattice is 0.05 to 1 % of the pitch, nine in ten lens
images differ from their neighbours by less than 0.2 to 4 %, and 91 to 98 % of the lens images are found; of pictures
of scenes it is 1 to 13 %, 12 to 17 %, and 3 to 89 %.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial import KDTree

from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.transmission import MIDDLE_PER_PITCH, NARROWEST_LENS_IMAGE
from lfpiv_cli.errors import InputError
from lfpiv_cli.notice import Notice, written

# Shares of the pitch: twice the worst white image's, and half of what pictures of scenes leave at their worst.
LARGE_RESIDUAL, LARGEST_RESIDUAL = 0.02, 0.06
# Where more of the lens images are missing, the lattice is continued far beyond those that were found.
FEWEST_FOUND = 0.5
# Nine in ten lens images of a white image differ less from the median of those around.
LARGEST_DIFFERENCE, DIFFERENCE_PERCENTILE, NEIGHBOURS = 0.08, 90.0, 4
# Of the brightest lens image: darker ones count as this bright, which is nothing.
DARKEST = 1e-9
# What the data sheet says of the lens images' width is believed to this factor.
WIDTH_TOLERANCE = 1.25

WHITE = "white image"
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


def white_notices(white: NDArray[np.float64], fit: LatticeFit, width: float, sheet_width: float | None) -> list[Notice]:
    """Return what speaks against a white image.

    Parameters
    ----------
    white : (rows, columns) raw, less the dark image
    fit : lattice of its lens images
    width : of the lens images over their pitch, in the image that the transmission is from
    sheet_width : the same by the data sheet's f-numbers, None where they are not known
    """
    return [*_of_lattice(fit, white.size), *_of_brightness(white, fit), *_of_width(width, sheet_width)]


def _of_lattice(fit: LatticeFit, pixels: int) -> Iterator[Notice]:
    share = residual_share(fit)
    if share > LARGE_RESIDUAL:
        yield Notice(
            "lattice-residual",
            WHITE,
            f"the lens images are off the lattice by {100 * share:.1f} % of their pitch, at most "
            f"{100 * LARGE_RESIDUAL:.0f} % of a good one",
            IS_IT_WHITE,
            share,
            f"at most {LARGE_RESIDUAL:g}",
        )
    found = fit.lenses * fit.lattice_px.cell_area / pixels
    if found < FEWEST_FOUND:
        yield Notice(
            "lattice-incomplete",
            WHITE,
            f"{fit.lenses} lens images were found, {100 * found:.0f} % of those that the sensor has room for; the "
            "lattice is continued where there are none",
            f"{IS_IT_WHITE}, and light the whole sensor",
            found,
            f"at least {FEWEST_FOUND:g}",
        )


def _of_brightness(white: NDArray[np.float64], fit: LatticeFit) -> Iterator[Notice]:
    difference = neighbours_difference(white, fit)
    if difference > LARGEST_DIFFERENCE:
        yield Notice(
            "white-not-uniform",
            WHITE,
            f"one lens image in ten differs by more than {100 * difference:.0f} % in brightness from those around it, "
            f"at most {100 * LARGEST_DIFFERENCE:.0f} % under uniform light: it looks like a picture of a scene",
            IS_IT_WHITE,
            difference,
            f"at most {LARGEST_DIFFERENCE:g}",
        )


def neighbours_difference(white: NDArray[np.float64], fit: LatticeFit) -> float:
    """Return how much nine in ten lens images at most differ in brightness from the median of those around."""
    half = max(1, int(MIDDLE_PER_PITCH * fit.lattice_px.pitch.mean()))
    level = uniform_filter(np.asarray(white, dtype=np.float64), 2 * half + 1)
    columns, rows = np.clip(np.round(fit.centres_px).astype(int), 0, np.array(white.shape[::-1]) - 1).T
    brightness = level[rows, columns]
    _, nearest = KDTree(fit.centres_px).query(fit.centres_px, NEIGHBOURS + 1)
    around = np.median(brightness[nearest[:, 1:]], axis=1)
    relative = np.abs(brightness - around) / np.maximum(around, DARKEST * max(float(np.abs(brightness).max()), DARKEST))
    return float(np.percentile(relative, DIFFERENCE_PERCENTILE))


def _of_width(width: float, sheet_width: float | None) -> Iterator[Notice]:
    if width < NARROWEST_LENS_IMAGE:
        yield Notice(
            "white-stopped-down",
            WHITE,
            f"its lens images are {width:.2f} of the pitch wide, at least {NARROWEST_LENS_IMAGE:g} is needed for the "
            "transmission, which is left out",
            "give a second --white, taken with the aperture of the measurements",
            width,
            f"at least {NARROWEST_LENS_IMAGE:g}",
        )
    elif sheet_width is not None and not 1.0 / WIDTH_TOLERANCE <= width / min(sheet_width, 1.0) <= WIDTH_TOLERANCE:
        yield Notice(
            "aperture-not-as-told",
            "camera.main_lens.aperture_mm",
            f"the lens images of the white image are {width:.2f} of the pitch wide, {min(sheet_width, 1.0):.2f} by the "
            "data sheet's apertures",
            "correct aperture_mm or f_number, or take the white image with the aperture of the measurements",
            width,
            f"{written(min(sheet_width, 1.0))} within a factor of {WIDTH_TOLERANCE:g}",
        )
