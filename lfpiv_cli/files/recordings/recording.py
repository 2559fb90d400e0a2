"""A file of frames, whatever its format: how many, how large, when each was taken, and how one is read."""

from __future__ import annotations

import logging
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.notice import Notice

# What the decoders of images complain of, kept until the command tells it: formats without check sums have no more.

# Of a damaged file there can be one for each page.
MOST_KEPT = 20

# The file that is read.
reading: ContextVar[Path | None] = ContextVar("reading", default=None)
_kept: list[Notice] = []


class _Keeper(logging.Handler):
    """Keeps what a decoder logs."""

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message, each once."""
        path = reading.get()
        notice = Notice(
            "decoder-complains",
            "an image" if path is None else path.name,
            f"the decoder says: {record.getMessage().splitlines()[0]}",
            "compare the file with the camera's; --verify SHA256SUMS does",
        )
        if len(_kept) < MOST_KEPT and notice not in _kept:
            _kept.append(notice)


# In place of printing it.
_logger = logging.getLogger("tifffile")
_logger.addHandler(_Keeper(logging.WARNING))
_logger.propagate = False


def taken_complaints() -> list[Notice]:
    """Return what was complained of since the last time."""
    taken, _kept[:] = list(_kept), []
    return taken


Image = NDArray[np.float32]
Shape = tuple[int, int]


class PageReader(Protocol):
    """Reads one frame of a file that is named in it."""

    def __call__(self, page: int, shape: Shape | None) -> Image:
        """Return frame `page` (rows, columns) in counts; `shape` is the sensor's (rows, columns), where it is known.

        Raises
        ------
        InputError : the frame is damaged, in colour, or of another size; the message names the file
        """


@dataclass(frozen=True, eq=False)
class Recording:
    """What the header of a file says. It holds no open file, so that any number of them may be kept.

    Attributes
    ----------
    pages : number of frames
    shape : (rows, columns) of the first one
    bits : of a pixel, as they are stored
    read_page : reads the frame of a number that is at least 0 and less than `pages`
    time_s : when each frame was taken, shape (pages,), from the first frame or another start; None where it is not told
    """

    pages: int
    shape: Shape
    bits: int
    read_page: PageReader
    time_s: NDArray[np.float64] | None = None


# What all formats ask of a frame's declared size, and of channels that should be one.

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
