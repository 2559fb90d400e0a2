"""LaVision's .im7: the frames of one recording, read by the manufacturer's library lvpyio (extra `cameras`).

Header as in the manufacturer's published reader ReadIM7.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.errors import InputError, LfpivError, UsageError
from lfpiv_cli.files.inputs import reason
from lfpiv_cli.files.recordings.blocks import values_at
from lfpiv_cli.files.recordings.pixels import CUT, as_counts, ensure_size
from lfpiv_cli.files.recordings.recording import Image, Recording, Shape

# Version, packing, format, sparse; columns, rows, planes, frames.
HEADER, HEADER_BYTES = "<4h4i", 256
# Bits of a pixel by the format of images; positive ones are of vectors.
BITS = {-2: 16, -3: 32, -4: 16, -5: 64}
NOT_PACKED = 0
COUNTS = "PIXEL"


def frames(path: Path) -> Recording:
    """Return the frames that a header declares.

    Raises
    ------
    InputError
    UsageError : lvpyio is not installed
    """
    try:
        import lvpyio  # noqa: F401
    except ImportError as error:
        raise UsageError(f'{path}: images of DaVis need lvpyio: pip install "lfpiv[cameras]"') from error
    with open(path, "rb") as file:
        _, packing, kind, _, columns, rows, planes, pages = values_at(path, file, 0, HEADER)
    size = path.stat().st_size
    if kind not in BITS or planes != 1:
        raise InputError(f"{path}: is of format {kind} with {planes} planes, expected images of counts")
    if min(columns, rows, pages) < 1:
        raise InputError(f"{path}: declares {pages} frames of {columns} x {rows} pixels (columns x rows)")
    ensure_size(f"{path}: a recording", (rows * pages, columns), BITS[kind] // 8, None, size)
    needed = HEADER_BYTES + rows * columns * pages * BITS[kind] // 8
    if packing == NOT_PACKED and needed > size:
        raise InputError(f"{path}: declares {pages} frames that end at byte {needed} of {size}: {CUT}")
    return Recording(pages, (rows, columns), BITS[kind], partial(_read_page, path))


def frames_of_set(path: Path) -> Recording:
    """Refuse a set: what it lists are files with names of their own."""
    raise UsageError(f"{path}: lists a set of images: give the .im7 files of the folder {path.with_suffix('')}")


def _read_page(path: Path, page: int, shape: Shape | None) -> Image:
    expected = frames(path).shape
    ensure_size(f"{path}: frame {page}", expected, 1, shape, path.stat().st_size)
    try:
        counts = _counts(path, page)
        if counts.shape != expected:
            raise InputError(f"{path}: frame {page} decodes to {counts.shape}, it declares {expected}")
        return as_counts(counts)
    except LfpivError:
        raise
    except Exception as error:  # a damaged file can raise anything inside the library
        raise InputError(f"{path}: cannot be decoded: {reason(error)}") from error


def _counts(path: Path, page: int) -> np.ndarray[Any, Any]:
    """Return the counts of a frame as they are stored, without the scale that DaVis shows them in."""
    import lvpyio

    return np.asarray(lvpyio.read_buffer(str(path))[page].components[COUNTS].planes[0])
