"""LaVision DaVis' .im7: the frames of one recording, one below the other, as they are or packed by zlib.

Header as the manufacturer published it (ReadIM7). Counts are those that are stored, without the scale that DaVis shows.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import opened, reason
from lfpiv_cli.files.recordings.blocks import bytes_at, values_at
from lfpiv_cli.files.recordings.pixels import CUT, as_counts, ensure_size
from lfpiv_cli.files.recordings.recording import Image, Recording, Shape

# Version, packing, format, sparse; columns, rows, planes, frames.
HEADER, HEADER_BYTES = "<4h4i", 256
# Kinds of counts by the format of images; positive ones are of vectors.
KINDS = {-3: "<f4", -4: "<u2", -5: "<f8"}
NOT_PACKED, ZLIB = 0, 2
# The number of packed bytes, before these.
LENGTH, LENGTH_BYTES = "<I", 4
EXPORT_HINT = "save it from DaVis without compression, or as TIFF"


@dataclass(frozen=True)
class _Content:
    """What a header declares."""

    pages: int
    shape: Shape
    kind: str
    packed: bool

    @property
    def frame_bytes(self) -> int:
        return math.prod(self.shape) * np.dtype(self.kind).itemsize


def frames(path: Path) -> Recording:
    """Return the frames that a header declares, after checking that their bytes are there.

    Raises
    ------
    InputError
    """
    with opened(path) as file:
        size = file.seek(0, 2)
        _, packing, kind, _, columns, rows, planes, pages = values_at(path, file, 0, HEADER)
        if kind not in KINDS or planes != 1:
            raise InputError(f"{path}: is of format {kind} with {planes} planes, expected images: {EXPORT_HINT}")
        if packing not in (NOT_PACKED, ZLIB):
            raise InputError(f"{path}: is packed in a way of its own ({packing}): {EXPORT_HINT}")
        if min(columns, rows, pages) < 1:
            raise InputError(f"{path}: declares {pages} frames of {columns} x {rows} pixels (columns x rows)")
        found = _Content(pages, (rows, columns), KINDS[kind], packing == ZLIB)
        item_bytes = np.dtype(found.kind).itemsize
        ensure_size(f"{path}: all frames together", (rows * pages, columns), item_bytes, None, size)
        stored = found.frame_bytes * pages
        if found.packed:
            stored = LENGTH_BYTES + values_at(path, file, HEADER_BYTES, LENGTH)[0]
        if HEADER_BYTES + stored > size:
            raise InputError(
                f"{path}: declares {pages} frames that end at byte {HEADER_BYTES + stored} of {size}: {CUT}"
            )
    return Recording(pages, found.shape, 8 * item_bytes, partial(_read_page, path, found))


def _read_page(path: Path, found: _Content, page: int, shape: Shape | None) -> Image:
    data = _bytes_of(path, found, page, shape)
    return as_counts(np.frombuffer(data, found.kind).reshape(found.shape))


def _bytes_of(path: Path, found: _Content, page: int, shape: Shape | None) -> bytes:
    """Return the bytes of a frame; of packed ones all are unpacked, whose check sum tells damage."""
    begin, end = page * found.frame_bytes, (page + 1) * found.frame_bytes
    with opened(path) as file:
        ensure_size(f"{path}: frame {page}", found.shape, 1, shape, file.seek(0, 2))
        if not found.packed:
            return bytes_at(path, file, HEADER_BYTES + begin, found.frame_bytes)
        (length,) = values_at(path, file, HEADER_BYTES, LENGTH)
        packed = bytes_at(path, file, HEADER_BYTES + LENGTH_BYTES, length)
    expected = found.pages * found.frame_bytes
    unpacking = zlib.decompressobj()
    try:
        # One byte more than there should be, and the check sum after it is looked at.
        data = unpacking.decompress(packed, expected + 1)
    except zlib.error as error:
        raise InputError(f"{path}: cannot be unpacked: {reason(error)}: {CUT}") from error
    if len(data) != expected or not unpacking.eof:
        raise InputError(f"{path}: does not unpack to {found.pages} frames of {found.frame_bytes} bytes: {CUT}")
    return data[begin:end]
