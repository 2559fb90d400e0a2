"""Files whose frames lie at known places, each in as many bytes as the next."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import opened
from lfpiv_cli.files.recordings.packing import Pixels
from lfpiv_cli.files.recordings.pixels import CUT, ensure_size
from lfpiv_cli.files.recordings.recording import Image, Recording, Shape


def values_at(path: Path, file: BinaryIO, place: int, layout: str) -> tuple[Any, ...]:
    """Return the values at a place of a file, laid out as `struct` says.

    Raises
    ------
    InputError : the file ends before
    """
    length = struct.calcsize(layout)
    return struct.unpack(layout, bytes_at(path, file, place, length))


def bytes_at(path: Path, file: BinaryIO, place: int, length: int) -> bytes:
    """Return `length` bytes at a place of a file; see `values_at`."""
    size = file.seek(0, 2)
    if not 0 <= place <= place + length <= size:
        raise InputError(f"{path}: holds {size} bytes, and what it declares ends at byte {place + length}: {CUT}")
    file.seek(place)
    found = file.read(length)
    if len(found) < length:
        raise InputError(f"{path}: ended while it was read: {CUT}")
    return found


def recording(
    path: Path,
    places: Sequence[int] | NDArray[np.int64],
    pixels: Pixels,
    time_s: NDArray[np.float64] | None = None,
    begin: Callable[[BinaryIO, int], int] | None = None,
) -> Recording:
    """Return a recording whose frame k lies at byte `places[k]`, after checking that all end inside the file.

    Parameters
    ----------
    begin : tells where the pixels of the frame at a place begin, where that is not the place itself

    Raises
    ------
    InputError
    """
    size = path.stat().st_size
    if not len(places):
        raise InputError(f"{path}: it holds no frames")
    ensure_size(f"{path}: a frame", pixels.shape, 1, None, size)
    ends = (places[0], places[-1]) if isinstance(places, range) else (int(np.min(places)), int(np.max(places)))
    last = max(ends)
    if begin is not None and 0 <= last < size:
        with open(path, "rb") as file:
            last = begin(file, last)
    if min(ends) < 0 or last + pixels.frame_bytes > size:
        raise InputError(
            f"{path}: declares {len(places)} frames of {pixels.frame_bytes} bytes, of which the last ends at byte "
            f"{last + pixels.frame_bytes} of {size}: {CUT}"
        )
    return Recording(len(places), pixels.shape, pixels.bits, partial(_read_page, path, places, pixels, begin), time_s)


def _read_page(
    path: Path,
    places: Sequence[int] | NDArray[np.int64],
    pixels: Pixels,
    begin: Callable[[BinaryIO, int], int] | None,
    page: int,
    shape: Shape | None,
) -> Image:
    with opened(path) as file:
        ensure_size(f"{path}: frame {page}", pixels.shape, 1, shape, file.seek(0, 2))
        place = int(places[page])
        data = bytes_at(path, file, begin(file, place) if begin else place, pixels.frame_bytes)
    return pixels.decode(data)


def at_rate(pages: int, rate_hz: float) -> NDArray[np.float64] | None:
    """Return when frames at an even rate were taken, in s from the first; None where a header tells no rate."""
    if not 0.0 < rate_hz < float("inf"):
        return None
    return np.arange(pages) / rate_hz
