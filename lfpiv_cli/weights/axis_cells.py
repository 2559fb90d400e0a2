"""The cells of one axis: where its lenses and its pixels meet.

A pixel at the border of two micro-images sees the main lens through both, at opposite ends of the aperture. So weights
are kept by *cell*, the meeting of one lens and one pixel.

Axes: one image axis at a time (columns or rows), in mm about the optical axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import KernelCamera

# Width given to a patch that lies outside the aperture, in radii: small beside the patch of a whole pixel (a tenth).
SMALLEST_PATCH = 1e-3


class AxisOptics(NamedTuple):
    """One axis of the camera; its square aperture is as wide as the round one.

    Attributes
    ----------
    camera : what both axes share
    lens_origin_mm, lens_pitch_mm : a lens centre on the array and the pitch along this axis
    lens_width_mm : what of the pitch a lens takes in, half of it to either side
    pixels : of the sensor along this axis
    """

    camera: KernelCamera
    lens_origin_mm: float
    lens_pitch_mm: float
    lens_width_mm: float
    pixels: int


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of one axis, lens by lens and pixel by pixel.

    Attributes
    ----------
    first_lens : number n of the first lens, centred at lens_origin + n lens_pitch
    start : (lenses + 1,) int64, the first cell of each lens
    pixel : (cells,) int32, the pixel of each cell, ascending within a lens
    patch_mm : (cells, 2) the interval of the main lens that the cell sees through its lens's centre, inside the
    aperture
    """

    first_lens: int
    start: NDArray[np.int64]
    pixel: NDArray[np.int32]
    patch_mm: NDArray[np.float64]


def micro_image_cells(optics: AxisOptics) -> Cells:
    """Return the cells of all lenses whose micro-image meets the sensor."""
    camera = optics.camera
    tilt = camera.microlens_distance_mm / camera.image_distance_mm
    reach = tilt * camera.aperture_radius_mm + (tilt + abs(camera.bend)) * 0.5 * optics.lens_width_mm
    half = 0.5 * optics.pixels * camera.pixel_mm
    edge = np.array([-half - reach, half + reach]) / (1.0 + tilt)
    first, last = np.rint((edge - optics.lens_origin_mm) / optics.lens_pitch_mm).astype(int)
    number = np.arange(first, last + 1)
    lens = optics.lens_origin_mm + number * optics.lens_pitch_mm
    low = np.floor((lens * (1.0 + tilt) - reach + half) / camera.pixel_mm).astype(int).clip(0, optics.pixels)
    high = np.floor((lens * (1.0 + tilt) + reach + half) / camera.pixel_mm).astype(int).clip(-1, optics.pixels - 1)
    counts = np.maximum(high - low + 1, 0)
    start = np.concatenate([[0], np.cumsum(counts)])
    owner = np.repeat(np.arange(lens.size), counts)
    pixel = low[owner] + np.arange(start[-1]) - start[owner]
    return Cells(int(first), start.astype(np.int64), pixel.astype(np.int32), _patches(optics, lens[owner], pixel))


def _patches(optics: AxisOptics, lens_mm: NDArray[np.float64], pixel: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the intervals of the main lens that pixels see through lenses' centres, shape (cells, 2)."""
    camera = optics.camera
    magnify = camera.image_distance_mm / camera.microlens_distance_mm
    edges = (pixel[:, np.newaxis] + np.array([1, 0]) - 0.5 * optics.pixels) * camera.pixel_mm
    patch = lens_mm[:, np.newaxis] - (edges - lens_mm[:, np.newaxis]) * magnify
    radius = camera.aperture_radius_mm
    patch = np.clip(patch, -radius, radius)
    # A cell that only rays away from the lens's centre reach sees the very edge of the aperture.
    sliver = SMALLEST_PATCH * radius
    return np.stack([np.minimum(patch[:, 0], radius - sliver), np.maximum(patch[:, 1], sliver - radius)], axis=1)
