"""How much of the light each pixel passes, from a white image: vignetting, dust, the rims of the lens images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.optics.microlenses import Lattice

# What passes less than this of the centre's light says more about noise and stray light than about the scene.
TRANSMISSION_FLOOR = 0.05
# The reference is the light in the middle of the lens images, within this share of the pitch from their centres, over
# a square of this many pixels in the middle of the sensor: wide enough for two hundred lenses of 30 px.
MIDDLE_PER_PITCH = 0.25
MIDDLE_SIDE_PX = 512
# Vignetting is smooth over the sensor: a polynomial of degree four holds cos^4 and the shadow of a barrel. It is
# fitted to the medians of this many blocks along each side, which dust and dead pixels do not move; of fewer, where a
# block would be narrower than this many lenses: some would hold no middle of a lens image, and what they border on is
# extrapolated.
VIGNETTING_DEGREE = 4
VIGNETTING_BLOCKS = 24
LENSES_PER_BLOCK = 1.5
# In narrower lens images, shares of the pitch, the middles reach the dark around: a quarter of the pitch on either side
# and a pixel's blur.
NARROWEST_LENS_IMAGE = 0.6
# A block of fewer usable middles says nothing.
FEWEST_MIDDLES = 20


def relative_transmission(white: NDArray[np.float32], lattice_px: Lattice) -> NDArray[np.float32]:
    """Return the share (rows, columns) of the centre's light that each pixel passes; 0 where it cannot be used.

    Parameters
    ----------
    white : (rows, columns) white minus dark, rectified, 0 outside the sensor
    lattice_px : lens images in the same frame
    """
    relative = white / np.float32(centre_level(white, lattice_px))
    return np.where(relative >= TRANSMISSION_FLOOR, relative, np.float32(0.0))


def centre_level(white: NDArray[np.float32], lattice_px: Lattice) -> float:
    """Return the median brightness of the middles of the lens images around the sensor's centre."""
    part, place, index = _middle_part(white, lattice_px)
    offset = place - lattice_px.points(index)
    middle = np.hypot(offset[..., 0], offset[..., 1]) <= MIDDLE_PER_PITCH * lattice_px.pitch.min()
    return float(np.median(part[middle]))


def lens_image_width(white: NDArray[np.float32], lattice_px: Lattice) -> float:
    """Return how wide lens images are over their pitch, around the sensor's centre: the diameter of a disc as large.

    As large as what is at least half as bright as the brightest pixel of a lens image, in the middle one of them all.
    """
    part, place, index = _middle_part(white, lattice_px)
    lens = index - index.min(axis=(0, 1))
    brightest = np.full(lens.max(axis=(0, 1)) + 1, -np.inf)
    np.maximum.at(brightest, (lens[..., 0], lens[..., 1]), part)
    lit = float(np.mean(part > 0.5 * np.median(brightest[np.isfinite(brightest)])))
    area = lit * lattice_px.cell_area
    return float(np.sqrt(4.0 / np.pi * area) / lattice_px.pitch.mean())


def fit_vignetting(transmission: NDArray[np.float32], lattice_px: Lattice) -> NDArray[np.float64] | None:
    """Return what of the transmission varies slowly over the lenses, as coefficients [y power, x power]; see below.

    Only the middles of the lens images are used: their rims show the aperture, which the weights hold already. None
    where there is too little to see it by.

    Parameters
    ----------
    transmission : (rows, columns) from `relative_transmission`
    lattice_px : lens images in the same frame
    """
    rows, columns = transmission.shape
    place, level = _block_levels(transmission, lattice_px)
    powers = [(i, j) for i in range(VIGNETTING_DEGREE + 1) for j in range(VIGNETTING_DEGREE + 1 - i)]
    if len(level) < 2 * len(powers):
        return None
    half = np.array([columns, rows]) / 2.0
    x, y = ((place - half) / half).T
    design = np.stack([x**i * y**j for i, j in powers], axis=1)
    found = np.linalg.lstsq(design, level, rcond=None)[0]
    coefficients = np.zeros((VIGNETTING_DEGREE + 1, VIGNETTING_DEGREE + 1))
    for (i, j), coefficient in zip(powers, found, strict=True):
        coefficients[j, i] = coefficient / found[0]
    return coefficients


def vignetting_surface(coefficients: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the share (rows, columns) of the middle's light that passes: a polynomial in the place over the sensor.

    x and y run from -1 to 1 over the columns and the rows.
    """
    y, x = ((np.arange(n) - n / 2.0) / (n / 2.0) for n in shape)
    surface = np.polynomial.polynomial.polygrid2d(y, x, coefficients)
    return np.clip(surface, TRANSMISSION_FLOOR, 1.0 / TRANSMISSION_FLOOR).astype(np.float32)


def _middle_part(
    white: NDArray[np.float32], lattice_px: Lattice
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.int64]]:
    """Return the square around the sensor's centre, its pixels' places (..., 2) as (column, row), and their lenses."""
    rows, columns = white.shape
    top, left = max(0, (rows - MIDDLE_SIDE_PX) // 2), max(0, (columns - MIDDLE_SIDE_PX) // 2)
    part = white[top : top + MIDDLE_SIDE_PX, left : left + MIDDLE_SIDE_PX]
    row, column = np.indices(part.shape)
    place = np.stack([column + left, row + top], axis=-1).astype(np.float64)
    return part, place, lattice_px.nearest(place)


def _block_levels(
    transmission: NDArray[np.float32], lattice_px: Lattice
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places (n, 2) as (column, row) and medians (n,) of the middles of lens images, block by block."""
    rows, columns = transmission.shape
    width = LENSES_PER_BLOCK * float(lattice_px.pitch.max())
    row_edges, column_edges = (
        np.linspace(0, side, max(1, min(VIGNETTING_BLOCKS, int(side / width))) + 1).astype(int)
        for side in (rows, columns)
    )
    places, levels = [], []
    for top, bottom in zip(row_edges, row_edges[1:], strict=False):
        for left, right in zip(column_edges, column_edges[1:], strict=False):
            row, column = np.mgrid[top:bottom, left:right]
            place = np.stack([column, row], axis=-1).astype(np.float64)
            offset = place - lattice_px.points(lattice_px.nearest(place))
            part = transmission[top:bottom, left:right]
            middle = np.hypot(offset[..., 0], offset[..., 1]) <= MIDDLE_PER_PITCH * lattice_px.pitch.min()
            used = middle & (part > 0.0)
            if used.sum() >= FEWEST_MIDDLES:
                places.append(place[used].mean(axis=0))
                levels.append(float(np.median(part[used])))
    return np.array(places).reshape(-1, 2), np.array(levels)
