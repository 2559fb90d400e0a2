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
    rows, columns = white.shape
    top, left = max(0, (rows - MIDDLE_SIDE_PX) // 2), max(0, (columns - MIDDLE_SIDE_PX) // 2)
    part = white[top : top + MIDDLE_SIDE_PX, left : left + MIDDLE_SIDE_PX]
    row, column = np.indices(part.shape)
    place = np.stack([column + left, row + top], axis=-1).astype(np.float64)
    offset = place - lattice_px.points(lattice_px.nearest(place))
    middle = np.hypot(offset[..., 0], offset[..., 1]) <= MIDDLE_PER_PITCH * lattice_px.pitch.min()
    return float(np.median(part[middle]))
