"""Phantom's .cine: headers, a table of times, a table of places, and frames with bottom rows first.

Structures and offsets as in Vision Research's description of the format. Counts are given as stored, neither flipped
for display nor stretched between black and white levels.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.inputs import opened
from lfpiv_cli.files.recordings.bayer import COLOUR_HINT
from lfpiv_cli.files.recordings.blocks import at_rate, bytes_at, recording, values_at
from lfpiv_cli.files.recordings.packing import Pixels
from lfpiv_cli.files.recordings.pixels import CUT, ensure_size
from lfpiv_cli.files.recordings.recording import Recording

START = b"CI"
# CINEFILEHEADER: type, its length, compression, version, numbers of images at the camera, of these in the file, and
# where the next structures lie.
FILE_HEADER = "<2s3HiIiI3I"
NOT_INTERPOLATED = 2
# BITMAPINFOHEADER up to the bytes of a frame.
BITMAP = "<I2i2H2I"
WHOLE, PACKED_10, PACKED_12 = 0, 256, 1024
# SETUP: mark and length, frames a second, colour filters, bits of a pixel that are used, by their places in it.
SETUP_MARK_AT, SETUP_MARK = 140, b"ST"
RATE_AT, FILTERS_AT, USED_BITS_AT = 768, 808, 896
# Blocks after it: length, kind, reserved; one of them holds a time for each frame.
BLOCK, TIMES = "<I2H", 1002
# Cameras write some ten of them.
MOST_BLOCKS = 100
BLOCK_BYTES = 8
# Times count 2^-32 s; the lowest two bits are flags.
FLAG_BITS = 2
TICKS_PER_S = 2.0 ** (32 - FLAG_BITS)
# Each frame begins with notes, whose last four bytes are the frame's own length.
SHORTEST_NOTES = 8
ROW_MULTIPLE = 4
LINEAR_BITS = 12


def frames(path: Path) -> Recording:
    """Return the frames of a recording of a monochrome camera, and their times.

    Raises
    ------
    InputError
    """
    with opened(path) as file:
        return _frames(path, file)


def _frames(path: Path, file: BinaryIO) -> Recording:
    header = values_at(path, file, 0, FILE_HEADER)
    _, _, compression, version, _, _, _, pages, bitmap_at, setup_at, places_at = header
    if compression not in (0, NOT_INTERPOLATED) or version not in (0, 1):
        raise InputError(f"{path}: is a cine of compression {compression} and version {version}: save it as a raw cine")
    (filters,) = values_at(path, file, setup_at + FILTERS_AT, "<I")
    if compression == NOT_INTERPOLATED and filters:
        raise InputError(f"{path}: holds {COLOUR_HINT}")
    kind = np.dtype("<i8" if version else "<u4")
    if not pages:
        raise InputError(f"{path}: it holds no frames")
    places = np.frombuffer(bytes_at(path, file, places_at, pages * kind.itemsize), kind).astype(np.int64)
    pixels, used = _pixels(path, file, bitmap_at, setup_at)
    ensure_size(f"{path}: a frame", pixels.shape, 1, None, path.stat().st_size)
    times = _times(path, file, setup_at, places_at, pages)

    def begin(file: BinaryIO, place: int) -> int:
        return _after_notes(path, file, place, pixels.frame_bytes)

    found = recording(path, places, pixels, begin=begin)
    return Recording(pages, found.shape, used, found.read_page, times)


def _pixels(path: Path, file: BinaryIO, bitmap_at: int, setup_at: int) -> tuple[Pixels, int]:
    """Return how pixels are stored, and how many of their bits are used."""
    _, columns, height, _, stored, packing, frame_bytes = values_at(path, file, bitmap_at, BITMAP)
    (mark,) = values_at(path, file, setup_at + SETUP_MARK_AT, "<2s")
    if mark != SETUP_MARK:
        raise InputError(f"{path}: has no SETUP at byte {setup_at}: {CUT}")
    (used,) = values_at(path, file, setup_at + USED_BITS_AT, "<I")
    shape = (abs(height), columns)
    if columns <= 0 or height == 0:
        raise InputError(f"{path}: declares frames of {columns} x {height} pixels (columns x rows)")
    if packing == PACKED_10:
        pixels, used = Pixels(shape, 10, "high-first", table=linear_counts(path)), LINEAR_BITS
    elif packing == PACKED_12:
        pixels = Pixels(shape, 12, "high-first")
    elif packing == WHOLE and stored in (8, 16):
        padded = Pixels(shape, stored, row_multiple=ROW_MULTIPLE, bottom_up=height > 0)
        tight = Pixels(shape, stored, bottom_up=height > 0)
        pixels = padded if frame_bytes == padded.frame_bytes else tight
    else:
        raise InputError(f"{path}: has {stored} bits a pixel, packed by kind {packing}: {COLOUR_HINT}")
    if frame_bytes != pixels.frame_bytes:
        raise InputError(f"{path}: declares {frame_bytes} bytes a frame, expected {pixels.frame_bytes}")
    return pixels, used if 0 < used <= pixels.bits or packing == PACKED_10 else pixels.bits


def linear_counts(path: Path) -> NDArray[np.uint16]:
    """Return the counts, linear in the light and of 12 bits, of the 1024 codes of a cine packed to 10 bits.

    Raises
    ------
    UsageError : the library that has the manufacturer's table is missing
    """
    try:
        from cine_reader.unpack import unpack_10bit_numpy
    except ImportError:
        raise UsageError(f'{path}: is packed to 10 bits: pip install "lfpiv[cameras]"') from None
    # Four codes are five bytes: all 1024 in order, through the library's own unpacking.
    codes = "".join(f"{code:010b}" for code in range(1024))
    return unpack_10bit_numpy(int(codes, 2).to_bytes(len(codes) // 8, "big"))


def _after_notes(path: Path, file: BinaryIO, place: int, frame_bytes: int) -> int:
    """Return where the pixels of the frame at `place` begin."""
    (notes_bytes,) = values_at(path, file, place, "<I")
    if notes_bytes < SHORTEST_NOTES:
        raise InputError(f"{path}: the notes of the frame at byte {place} have {notes_bytes} bytes: {CUT}")
    (declared,) = values_at(path, file, place + notes_bytes - 4, "<I")
    if declared != frame_bytes:
        raise InputError(f"{path}: the frame at byte {place} declares {declared} bytes, expected {frame_bytes}: {CUT}")
    return place + notes_bytes


def _times(path: Path, file: BinaryIO, setup_at: int, places_at: int, pages: int) -> NDArray[np.float64] | None:
    """Return the times of the frames, in s from the first one's; without a table of times, by the frame rate."""
    (length,) = values_at(path, file, setup_at + SETUP_MARK_AT + 2, "<H")
    place = setup_at + length
    for _ in range(MOST_BLOCKS):
        if not setup_at < place < places_at:
            break
        block_bytes, kind, _ = values_at(path, file, place, BLOCK)
        if kind == TIMES:
            ticks = np.frombuffer(bytes_at(path, file, place + BLOCK_BYTES, 8 * pages), "<u8")
            exact = ticks >> np.uint64(FLAG_BITS)
            return (exact.astype(np.int64) - int(exact[0])) / TICKS_PER_S
        if block_bytes < BLOCK_BYTES:
            break
        place += block_bytes
    (rate_hz,) = values_at(path, file, setup_at + RATE_AT, "<I")
    return at_rate(pages, rate_hz)
