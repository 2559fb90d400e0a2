"""The green of a sensor behind colour filters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.recordings.recording import Image

# Colours of the filters over the first two pixels of the first row, and of the second.
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
COLOUR_HINT = (
    "the frames of a colour sensor; save them without a header and state the layout with its pattern, "
    "as in frames.raw:1280x800x16:bayer=RGGB, to read their green"
)


def green_of(mosaic: Image, pattern: str) -> Image:
    """Return what a sensor sees in green: half of its pixels as they are, the others by the mean of those beside.

    A pixel behind a red or blue filter has green ones above, below, left and right; at the rim two or three of them.
    """
    green = _is_green(mosaic.shape, pattern)
    seen = np.pad(np.where(green, mosaic, np.float32(0.0)), 1)
    there = np.pad(green.astype(np.float32), 1)
    total, count = (a[:-2, 1:-1] + a[2:, 1:-1] + a[1:-1, :-2] + a[1:-1, 2:] for a in (seen, there))
    return np.where(green, mosaic, total / np.maximum(count, 1.0)).astype(np.float32)


def _is_green(shape: tuple[int, ...], pattern: str) -> NDArray[np.bool_]:
    """Return which pixels (rows, columns) lie behind green filters."""
    cell = np.array([colour == "G" for colour in pattern]).reshape(2, 2)
    rows, columns = shape
    return np.tile(cell, (rows // 2 + 1, columns // 2 + 1))[:rows, :columns]
