"""Raw images in, images out: greyscale TIFF and PNG, refused rather than guessed where anything is odd.

Images are float32 arrays `[row, column]` in counts. Colour is read where its channels are all the same.
"""

from __future__ import annotations

import logging
import math
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, LfpivError
from lfpiv_cli.files.atomic import write_atomically
from lfpiv_cli.files.inputs import ensure_regular_file, reason
from lfpiv_cli.files.tiff_chain import CUT, count_directories

Image = NDArray[np.float32]

TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
PNG_START = b"\x89PNG\r\n\x1a\n"
# Photometric interpretations: of a greyscale TIFF whose zeros are black, and of colours.
BLACK_IS_ZERO, RGB, PALETTE = 1, 2, 3
# Samples of a pixel by a PNG's colour type, once decoded: grey, colour, palette, and with transparency.
PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
# TIFF's palettes hold 16-bit colours for indices of 8 bits.
PALETTE_SHIFT = 8
# Numbers of samples of which the last is the transparency, and how a TIFF says that its channels lie apart.
TRANSPARENT_SAMPLES = (2, 4)
SEPARATE = 2
# The largest sensor sold has 151 million pixels; a header that declares more is wrong or hostile.
MOST_PIXELS = 160_000_000
# Without a sensor size to compare with, a header may declare this much whatever the file's size ...
HARMLESS_BYTES = 64 * 2**20
# ... and beyond it no more than deflate could have packed into the file.
LARGEST_RATIO = 1100
GREY_HINT = "save the sensor's raw image as greyscale"

# The decoder's warnings about a damaged file repeat what our errors say.
logging.getLogger("tifffile").addHandler(logging.NullHandler())
logging.getLogger("tifffile").propagate = False


def count_pages(path: Path) -> int:
    """Return how many frames an image file holds.

    Raises
    ------
    InputError
        If the file is missing, broken, or neither TIFF nor PNG.
    """
    if _is_png(path):
        return 1
    with _open_tiff(path) as (_, pages):
        return pages


def read_image(path: Path, shape: tuple[int, int] | None = None) -> Image:
    """Read the only frame of a file, shape (rows, columns), in counts.

    Parameters
    ----------
    shape : the sensor's (rows, columns), where it is known

    Raises
    ------
    InputError
        If the file is broken, holds several frames, is in colour, or has another size.
    """
    pages = count_pages(path)
    if pages != 1:
        raise InputError(f"{path}: holds {pages} pages, expected a single image")
    return read_page(path, 0, shape)


def read_page(path: Path, page: int, shape: tuple[int, int] | None = None) -> Image:
    """Read frame `page`, counted from 0: see `read_image`."""
    if _is_png(path):
        return _read_png(path, shape)
    with _open_tiff(path) as (tiff, pages):
        if not 0 <= page < pages:
            raise InputError(f"{path}: has no page {page}, it holds {pages}")
        return _decode_page(tiff, page, shape)


def write_tiff(path: Path, array: NDArray[Any], overwrite: bool) -> None:
    """Write an image (rows, columns) of type uint8 or uint16, packed without loss and without time stamps.

    Raises
    ------
    OutputExistsError, OutputError
    """
    if array.dtype not in (np.uint8, np.uint16, np.float32) or array.ndim != 2:
        raise TypeError(f"images are uint8, uint16 or float32 (rows, columns), not {array.dtype} {array.shape}")

    def write(temporary: Path) -> None:
        tifffile.imwrite(
            temporary,
            array,
            photometric="minisblack",
            compression="zlib",
            predictor=array.dtype != np.float32,
            metadata=None,
            software=False,
        )

    def check(temporary: Path) -> None:
        read_image(temporary, (array.shape[0], array.shape[1]))

    write_atomically(path, write, overwrite=overwrite, check=check)


def _is_png(path: Path) -> bool:
    """Return whether a file is a PNG; raise where it is neither PNG nor TIFF."""
    ensure_regular_file(path)
    try:
        with open(path, "rb") as file:
            start = file.read(len(PNG_START))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason(error)}") from error
    if start == PNG_START:
        return True
    if start[:4] in TIFF_STARTS:
        return False
    raise InputError(f"{path}: is neither a TIFF nor a PNG image")


@contextmanager
def _open_tiff(path: Path) -> Iterator[tuple[tifffile.TiffFile, int]]:
    """Open a TIFF file whose directories are sound, with the number of its pages.

    A damaged file can raise anything inside the decoders, so anything becomes an `InputError` that names the file.
    """
    try:
        with open(path, "rb") as file:
            pages = count_directories(file, path.stat().st_size)
            file.seek(0)
            with tifffile.TiffFile(file) as tiff:
                _ensure_one_frame_a_page(tiff, pages)
                yield tiff, pages
    except LfpivError as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:
        raise InputError(f"{path}: cannot be decoded: {reason(error)}") from error


def _ensure_one_frame_a_page(tiff: tifffile.TiffFile, pages: int) -> None:
    """Refuse the writers' private ways of storing many frames behind one directory."""
    first = tiff.pages[0]
    description = first.description
    frames = 1
    if found := re.search(r"^images=(\d+)", description, re.MULTILINE):
        frames = int(found.group(1))
    elif found := re.match(r'{"shape": \[([\d, ]+)\]', description):
        frames = math.prod(int(n) for n in found.group(1).split(",")) // max(math.prod(first.shape), 1)
    if frames > pages:
        raise InputError(f"holds {pages} pages and says {frames} frames: save it as an ordinary multi-page TIFF")


def _decode_page(tiff: tifffile.TiffFile, number: int, shape: tuple[int, int] | None) -> Image:
    """Return one page as float32 after checking what it declares."""
    page = tiff.pages[number]
    if not isinstance(page, tifffile.TiffPage):
        raise InputError(f"page {number} cannot be decoded")
    if page.photometric not in (BLACK_IS_ZERO, RGB, PALETTE) or (page.photometric == PALETTE) != _has_palette(page):
        kind = getattr(page.photometric, "name", page.photometric)
        raise InputError(f"page {number} is {kind} with {page.samplesperpixel} samples per pixel: {GREY_HINT}")
    if page.dtype is None or page.dtype.kind not in "uif":
        raise InputError(f"page {number} has {page.bitspersample} bits per pixel of an unknown kind")
    size = tiff.filehandle.size
    pixel_bytes = page.dtype.itemsize * page.samplesperpixel
    _ensure_size(f"page {number}", (page.imagelength, page.imagewidth), pixel_bytes, shape, size)
    segments = math.prod(page.chunked)
    if not len(page.dataoffsets) == len(page.databytecounts) == segments:
        raise InputError(f"page {number} has {len(page.dataoffsets)} of its {segments} strips or tiles: {CUT}")
    for place, length in zip(page.dataoffsets, page.databytecounts, strict=True):
        if length == 0 or place + length > size:
            raise InputError(f"the data of page {number} ends at byte {place + length} of {size}: {CUT}")
    array = page.asarray(maxworkers=1)
    if page.samplesperpixel > 1 and page.planarconfig == SEPARATE:
        array = np.moveaxis(array, 0, -1)
    if array.shape[:2] != (page.imagelength, page.imagewidth):
        raise InputError(f"page {number} decodes to {array.shape}, it declares {page.imagelength, page.imagewidth}")
    if page.colormap is not None:
        array = np.moveaxis(page.colormap[:, array] >> PALETTE_SHIFT, 0, -1)
    return _as_counts(_one_channel(array, f"page {number}"))


def _has_palette(page: tifffile.TiffPage) -> bool:
    """Return whether a page holds indices of 8 bits into colours."""
    return page.colormap is not None and page.samplesperpixel == 1 and page.dtype == np.uint8


def _one_channel(array: NDArray[Any], what: str) -> NDArray[Any]:
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


def _read_png(path: Path, shape: tuple[int, int] | None) -> Image:
    """Read a PNG file after checking its header and the check sums of all its parts."""
    try:
        content = path.read_bytes()
        columns, rows, bits, colour = _png_header(content)
        if colour not in PNG_SAMPLES:
            raise InputError(f"is a PNG of colour type {colour}: {GREY_HINT}")
        _ensure_size("the image", (rows, columns), PNG_SAMPLES[colour] * (1 if bits <= 8 else 2), shape, len(content))
        array = imagecodecs.png_decode(content)
        if array.shape[:2] != (rows, columns):
            raise InputError(f"decodes to {array.shape}, it declares {rows, columns}")
        return _as_counts(_one_channel(array, "the image"))
    except LfpivError as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:  # as in _open_tiff
        raise InputError(f"{path}: cannot be decoded: {reason(error)}") from error


def _png_header(content: bytes) -> tuple[int, int, int, int]:
    """Return width, height, bit depth and colour type of a PNG whose parts are all there and undamaged."""
    place = len(PNG_START)
    header = b""
    while True:
        length = int.from_bytes(content[place : place + 4], "big")
        kind = content[place + 4 : place + 8]
        end = place + 12 + length
        if end > len(content):
            raise InputError(f"the part at byte {place} ends at byte {end} of {len(content)}: {CUT}")
        if zlib.crc32(content[place + 4 : end - 4]) != int.from_bytes(content[end - 4 : end], "big"):
            raise InputError(f"the part at byte {place} has a wrong check sum: {CUT}")
        if kind == b"IHDR":
            header = content[place + 8 : end - 4]
        if kind == b"IEND":
            break
        place = end
    if len(header) != 13:
        raise InputError(f"its header has {len(header)} bytes, expected 13")
    return int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big"), header[8], header[9]


def _ensure_size(
    what: str, declared: tuple[int, int], item_bytes: int, shape: tuple[int, int] | None, file_bytes: int
) -> None:
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


def _as_counts(array: NDArray[Any]) -> Image:
    """Return an image as float32; what exceeds its range becomes infinite and is flagged with the saturated."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32)
