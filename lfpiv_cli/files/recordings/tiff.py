"""Greyscale TIFF, one frame a page: refused rather than guessed where anything is odd."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import tifffile

from lfpiv_cli.errors import InputError, LfpivError
from lfpiv_cli.files.inputs import reason
from lfpiv_cli.files.recordings.complaints import keep_complaints, reading
from lfpiv_cli.files.recordings.pixels import CUT, GREY_HINT, HARMLESS_BYTES, as_counts, ensure_size, one_channel
from lfpiv_cli.files.recordings.recording import Image, Recording, Shape
from lfpiv_cli.files.recordings.tiff_chain import directories

STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# Photometric interpretations: of a greyscale TIFF whose zeros are black, and of colours.
BLACK_IS_ZERO, RGB, PALETTE = 1, 2, 3
# TIFF's palettes hold 16-bit colours for indices of 8 bits.
PALETTE_SHIFT = 8
# Of the compressions, none.
NOT_PACKED = 1
# Compressions of faxes: CCITT's three, and the first of them with lines of whole words.
BLACK_AND_WHITE = (2, 3, 4, 32771)
# How a TIFF says that its channels lie apart.
SEPARATE = 2

keep_complaints("tifffile")


def frames(path: Path) -> Recording:
    """Return the pages of a TIFF file whose directories are sound.

    Raises
    ------
    InputError
    """
    with _naming(path), open(path, "rb") as file:
        places = directories(file, path.stat().st_size)
        file.seek(0)
        with tifffile.TiffFile(file) as tiff:
            _ensure_one_frame_a_page(tiff, len(places))
            first = tiff.pages[0]
            bits = first.bitspersample if isinstance(first.bitspersample, int) else first.bitspersample[0]
            return Recording(
                len(places), (first.imagelength, first.imagewidth), bits, partial(_read_page, path, places)
            )


def _read_page(path: Path, places: Sequence[int], page: int, shape: Shape | None) -> Image:
    """Read the page whose directory lies at `places[page]`: the chain of directories is not walked again."""
    with _naming(path), open(path, "rb") as file, tifffile.TiffFile(file) as tiff:
        tiff.filehandle.seek(places[page])
        return _decode_page(tifffile.TiffPage(tiff, page), page, shape)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file in what is raised.

    A damaged file can raise anything inside the decoders, so anything becomes an `InputError`.
    """
    token = reading.set(path)
    try:
        yield
    except LfpivError as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:
        raise InputError(f"{path}: cannot be decoded: {reason(error)}") from error
    finally:
        reading.reset(token)


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


def _decode_page(page: tifffile.TiffPage, number: int, shape: Shape | None) -> Image:
    """Return one page as float32 after checking what it declares."""
    if page.photometric not in (BLACK_IS_ZERO, RGB, PALETTE) or (page.photometric == PALETTE) != _has_palette(page):
        kind = getattr(page.photometric, "name", page.photometric)
        raise InputError(f"page {number} is {kind} with {page.samplesperpixel} samples per pixel: {GREY_HINT}")
    if page.dtype is None or page.dtype.kind not in "uif":
        raise InputError(f"page {number} has {page.bitspersample} bits per pixel of an unknown kind")
    if page.compression in BLACK_AND_WHITE:
        raise InputError(f"page {number} is packed as {page.compression.name}, for black and white alone: {GREY_HINT}")
    size = page.parent.filehandle.size
    pixel_bytes = page.dtype.itemsize * page.samplesperpixel
    ensure_size(f"page {number}", (page.imagelength, page.imagewidth), pixel_bytes, shape, size)
    _ensure_segments(page, number, size)
    array = page.asarray(maxworkers=1)
    if page.samplesperpixel > 1 and page.planarconfig == SEPARATE:
        array = np.moveaxis(array, 0, -1)
    if array.shape[:2] != (page.imagelength, page.imagewidth):
        raise InputError(f"page {number} decodes to {array.shape}, it declares {page.imagelength, page.imagewidth}")
    if page.colormap is not None:
        array = np.moveaxis(page.colormap[:, array] >> PALETTE_SHIFT, 0, -1)
    return as_counts(one_channel(array, f"page {number}"))


def _ensure_segments(page: tifffile.TiffPage, number: int, file_bytes: int) -> None:
    """Refuse strips or tiles that are missing, lie beyond the file's end, or are shorter than their pixels.

    The decoder asks none of these: of a strip that is too short and not packed it takes the bytes after it as pixels,
    and of one that is far too long it reads all.
    """
    segments = math.prod(page.chunked)
    if not len(page.dataoffsets) == len(page.databytecounts) == segments:
        raise InputError(f"page {number} has {len(page.dataoffsets)} of its {segments} strips or tiles: {CUT}")
    for segment, (place, length) in enumerate(zip(page.dataoffsets, page.databytecounts, strict=True)):
        if length == 0 or place + length > file_bytes:
            raise InputError(f"the data of page {number} ends at byte {place + length} of {file_bytes}: {CUT}")
        pixels = _bytes_of(page, segment)
        least, most = pixels if page.compression == NOT_PACKED else 1, HARMLESS_BYTES + 2 * pixels
        if not least <= length <= most:
            raise InputError(
                f"strip or tile {segment} of page {number} has {length} bytes, its pixels take {pixels}: {CUT}"
            )


def _bytes_of(page: tifffile.TiffPage, segment: int) -> int:
    """Return how many bytes a strip or tile takes that is not packed; each of its rows takes whole bytes."""
    rows, columns, *samples = page.chunks
    if not page.is_tiled:  # whose last ones are filled up, where the last strip is shorter
        rows = min(rows, page.imagelength - segment % -(-page.imagelength // rows) * rows)
    return rows * -(-columns * math.prod(samples) * page.bitspersample // 8)


def _has_palette(page: tifffile.TiffPage) -> bool:
    """Return whether a page holds indices of 8 bits into colours."""
    return page.colormap is not None and page.samplesperpixel == 1 and page.dtype == np.uint8
