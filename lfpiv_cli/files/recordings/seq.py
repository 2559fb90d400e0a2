"""Norpix' .seq: a header of 1024 or 8192 bytes, then frames, each followed by its time.

Offsets as in the format's description, which StreamPix' manual has.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import opened
from lfpiv_cli.files.recordings.bayer import COLOUR_HINT
from lfpiv_cli.files.recordings.blocks import recording, values_at
from lfpiv_cli.files.recordings.packing import Pixels
from lfpiv_cli.files.recordings.pixels import CUT, ensure_size
from lfpiv_cli.files.recordings.recording import Recording

START = b"\xed\xfe\0\0"
# Version, at byte 28; from 5 on the header has 8192 bytes whatever it says, and times have microseconds.
VERSION_AT, LONG_HEADER_VERSION = 28, 5
SHORT_HEADER, LONG_HEADER = 1024, 8192
# Width, height, bits of a pixel in the file and of these those that are used, bytes of a frame, format, number of
# frames, origin, bytes from one frame to the next.
FRAME_AT, FRAME = 548, "<9I"
COMPRESSION_AT = 620
MONOCHROME, RAW_BAYER = 100, 101
# Seconds, milliseconds, microseconds.
TIME = np.dtype([("s", "<u4"), ("ms", "<u2"), ("us", "<u2")])


def frames(path: Path) -> Recording:
    """Return the frames of a sequence that is not compressed, and their times.

    Raises
    ------
    InputError
    """
    with opened(path) as file:
        return _frames(path, file)


def _frames(path: Path, file: BinaryIO) -> Recording:
    (version,) = values_at(path, file, VERSION_AT, "<i")
    columns, rows, stored, used, frame_bytes, kind, pages, _, step = values_at(path, file, FRAME_AT, FRAME)
    (compression,) = values_at(path, file, COMPRESSION_AT, "<I")
    if compression:
        raise InputError(f"{path}: its frames are compressed (kind {compression}): save it without compression")
    if kind != MONOCHROME:
        what = "raw Bayer" if kind == RAW_BAYER else f"of kind {kind}"
        raise InputError(f"{path}: its frames are {what}, expected monochrome ({MONOCHROME}): {COLOUR_HINT}")
    if stored not in (8, 16) or not 0 < used <= stored:
        raise InputError(f"{path}: has {used} bits in {stored} a pixel, expected them in 8 or 16")
    ensure_size(f"{path}: a frame", (rows, columns), stored // 8, None, path.stat().st_size)
    pixels = Pixels((rows, columns), stored)
    if frame_bytes != pixels.frame_bytes or step < frame_bytes + TIME.itemsize:
        raise InputError(
            f"{path}: declares frames of {frame_bytes} bytes every {step} bytes, expected {pixels.frame_bytes} for "
            f"{columns} x {rows} pixels, and {TIME.itemsize} for a time"
        )
    first = LONG_HEADER if version >= LONG_HEADER_VERSION else SHORT_HEADER
    places = range(first, first + pages * step, step)
    found = recording(path, places, pixels)
    return Recording(pages, found.shape, used, found.read_page, _times(path, file, places, frame_bytes, version))


def _times(path: Path, file: BinaryIO, places: range, frame_bytes: int, version: int) -> NDArray[np.float64]:
    """Return the times of the frames, in s from the first one's."""
    size = file.seek(0, 2)
    stamps = np.empty(len(places), TIME)
    for page, place in enumerate(places):
        if place + frame_bytes + TIME.itemsize > size:
            raise InputError(f"{path}: ends before the time of frame {page}: {CUT}")
        file.seek(place + frame_bytes)
        stamps[page] = np.frombuffer(file.read(TIME.itemsize), TIME)[0]
    if version < LONG_HEADER_VERSION:
        stamps["us"] = 0
    ticks = stamps["s"].astype(np.int64) * 1_000_000 + stamps["ms"].astype(np.int64) * 1000 + stamps["us"]
    return (ticks - ticks[0]) / 1e6
