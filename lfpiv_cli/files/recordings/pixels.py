"""What all formats ask of a frame's declared size, and of channels that should be one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.recordings.recording import Image, Shape

# Numbers of samples of which the last is the transparency.
TRANSPARENT_SAMPLES = (2, 4)
# The largest sensor sold has 151 million pixels; a header that declares more is wrong or hostile.
MOST_PIXELS = 160_000_000
# Without a sensor size to compare with, a header may declare this much whatever the file's size ...
HARMLESS_BYTES = 64 * 2**20
# ... and beyond it no more than deflate could have packed into the file.
LARGEST_RATIO = 1100
GREY_HINT = "save the sensor's raw image as greyscale"
CUT = "the file is cut off or damaged"


def ensure_size(what: str, declared: Shape, item_bytes: int, shape: Shape | None, file_bytes: int) -> None:
    """Refuse a declared size that is not the sensor's, or that nothing could have."""
    rows, columns = declared
    if shape is not None and declared != shape:
        raise InputError(
            f"{what} is {columns} x {rows} pixels (columns x rows), expected the sensor's {shape[1]} x {shape[0]}"
        )
    pixels = rows * columns
    if not 0 < pixels <= MOST_PIXELS:
        raise InputError(f"{what} declares {columns} x {rows} pixels, expected at most {MOST_PIXELS} in all")
    if pixels * item_bytes > max(HARMLESS_BYTES, LARGEST_RATIO * file_bytes):
        raise InputError(f"{what} declares {columns} x {rows} pixels, more than {file_bytes} bytes can hold")


def one_channel(array: NDArray[Any], what: str) -> NDArray[Any]:
    """Return the channel that all channels of an image (rows, columns[, samples]) are alike.

    A last one of two or four is how transparent pixels are; it must be the same everywhere.

    Raises
    ------
    InputError
    """
    if array.ndim == 2:
        return array
    samples = array.shape[2]
    colours = array[..., : samples - (samples in TRANSPARENT_SAMPLES)]
    first = np.broadcast_to(colours[..., :1], colours.shape)
    if not np.array_equal(colours, first, equal_nan=colours.dtype.kind == "f"):
        raise InputError(f"{what} is in colour, its {colours.shape[2]} channels differ: {GREY_HINT}")
    if samples in TRANSPARENT_SAMPLES and np.ptp(array[..., -1]) != 0:
        raise InputError(f"{what} has pixels of different transparency: {GREY_HINT}")
    return array[..., 0]


def as_counts(array: NDArray[Any]) -> Image:
    """Return an image as float32; what exceeds its range becomes infinite and is flagged with the saturated."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32)
