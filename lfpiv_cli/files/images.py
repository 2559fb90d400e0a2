"""Raw images in, images out: any format of `recordings`, refused rather than guessed where anything is odd.

Images are float32 arrays `[row, column]` in counts. Colour is read where its channels are all the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.atomic import write_atomically
from lfpiv_cli.files.inputs import ensure_regular_file, split_page, split_part
from lfpiv_cli.files.recordings import tiff
from lfpiv_cli.files.recordings.formats import files_beside, open_recording
from lfpiv_cli.files.recordings.recording import Image, Recording, Shape
from lfpiv_cli.notice import written

# Files whose headers are kept, so that a recording of thousands of frames is not looked through again for each. A batch
# reads one recording after the other, beside a white and a dark image; long ones have some megabytes of places.
KEPT_HEADERS = 8
# Far above what any sensor counts; sums of the squares of so large numbers still are numbers.
MOST_COUNTS = 1e12


def frames(path: Path) -> Recording:
    """Return what the header of a file of frames says: pages, shape, bits, time stamps.

    Parameters
    ----------
    path : of the file, or `FILE.h5:/PATH` for a dataset in it, `FILE.raw:LAYOUT` for frames without a header; at the
        end `:page=N` for one of them

    Raises
    ------
    InputError
        If the file is missing, broken, or of no known format.
    UsageError
        If more has to be said, or what is said does not fit the format.
    """
    file, part = split_part(path)
    ensure_regular_file(file)
    return _frames(file, part, tuple(_state_of(each) for each in (file, *files_beside(file))))


def _state_of(file: Path) -> tuple[int, int, int]:
    """Return what changes when a file does."""
    status = file.stat()
    return status.st_size, status.st_mtime_ns, status.st_ino


@lru_cache(KEPT_HEADERS)
def _frames(file: Path, part: str | None, states: tuple[tuple[int, int, int], ...]) -> Recording:
    """Read a header once; a file that has another size, time or place on the disk is looked at anew."""
    part, page = split_page(part)
    recording = open_recording(file, part)
    return recording if page is None else _only(file, recording, page)


def _only(file: Path, recording: Recording, page: int) -> Recording:
    """Return one page of a recording as a recording."""
    if page >= recording.pages:
        raise InputError(f"{file}: has no page {page}, it holds {recording.pages}")
    time_s = None if recording.time_s is None else recording.time_s[page : page + 1]
    return replace(recording, pages=1, time_s=time_s, read_page=lambda _, shape: recording.read_page(page, shape))


def count_pages(path: Path) -> int:
    """Return how many frames an image file holds: see `frames`."""
    return frames(path).pages


def times_of(path: Path) -> NDArray[np.float64] | None:
    """Return when each frame of a file was taken, in s, shape (pages,); None where the file does not tell.

    Raises
    ------
    InputError : as `frames`
    """
    return frames(path).time_s


def read_image(path: Path, shape: Shape | None = None) -> Image:
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
        raise InputError(f"{path}: holds {pages} pages, expected a single image; {path}:page=0 is the first one")
    return read_page(path, 0, shape)


def read_reference(path: Path, shape: Shape | None = None) -> Image:
    """Read an image that others are measured by (white, dark, target, background, mask): each pixel holds counts.

    Raises
    ------
    InputError : as `read_image`, and where a pixel is not a number, or no camera could have it
    """
    image = read_image(path, shape)
    bad = int(np.count_nonzero(~(np.abs(image) <= MOST_COUNTS)))
    if bad:
        raise InputError(
            f"{path}: {bad} of its {image.size} pixels are not counts, numbers below {written(MOST_COUNTS)}"
        )
    return image


def read_page(path: Path, page: int, shape: Shape | None = None) -> Image:
    """Read frame `page`, counted from 0: see `read_image`."""
    recording = frames(path)
    if not 0 <= page < recording.pages:
        raise InputError(f"{path}: has no page {page}, it holds {recording.pages}")
    return recording.read_page(page, shape)


def ensure_shape(paths: Iterable[Path], shape: Shape) -> None:
    """Refuse files whose headers say frames of another shape, before any of them is read.

    Raises
    ------
    InputError : as `read_page`
    """
    for path in paths:
        if frames(path).shape != shape:
            read_page(path, 0, shape)  # says what is wrong


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
        tiff.frames(temporary).read_page(0, (array.shape[0], array.shape[1]))

    write_atomically(path, write, overwrite=overwrite, check=check)
