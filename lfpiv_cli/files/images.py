"""Raw images in, images out: any of `FORMATS`, refused rather than guessed where anything is odd.

Images are float32 arrays `[row, column]` in counts. Colour is read where its channels are all the same. What is odd is
an `InputError` that names the file, in all formats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import recording_cameras as cameras
from lfpiv_cli.files import recording_formats as formats
from lfpiv_cli.files.atomic import written_atomically
from lfpiv_cli.files.inputs import ensure_regular_file, opened, split_page, split_part
from lfpiv_cli.files.recording import LOOKS_LAID_OUT, SUFFIXES, Image, Recording, Shape, raw_frames
from lfpiv_cli.notice import written

# Which formats of frames there are, how each is recognised, and what reads it.


@dataclass(frozen=True)
class Format:
    """A format of frames.

    Attributes
    ----------
    name : as people say it
    starts : the first bytes of its files, where they tell
    suffixes : of its files' names, in small letters, where the first bytes do not tell
    frames : reads a file's header, and with it what FILE:PART says, where the format has parts
    has_parts : whether it has parts, or layouts, to name
    beside : finds the other files that one is read with; a folder stands for all files in it
    in_folders : whether its files are meant where a folder is given for the images in it; an HDF5 file can be anything,
        and a set's images are there besides
    """

    name: str
    frames: Callable[..., Recording]
    starts: tuple[bytes, ...] = ()
    suffixes: tuple[str, ...] = ()
    has_parts: bool = False
    beside: Callable[[Path], tuple[Path, ...]] | None = None
    in_folders: bool = True


RAW = Format("raw", raw_frames, suffixes=SUFFIXES, has_parts=True)
FORMATS = (
    Format("TIFF", formats.tiff_frames, starts=formats.TIFF_STARTS),
    Format("PNG", formats.png_frames, starts=(formats.PNG_START,)),
    Format("HDF5", formats.hdf5_frames, starts=(formats.HDF5_START,), has_parts=True, in_folders=False),
    Format("Phantom cine", cameras.cine_frames, starts=(cameras.CINE_START,)),
    Format("Norpix seq", cameras.seq_frames, starts=(cameras.SEQ_START,)),
    Format("Photron mraw", cameras.mraw_frames, suffixes=(cameras.MRAW_SUFFIX,), beside=cameras.header_beside),
    Format("LaVision im7", cameras.im7_frames, suffixes=(".im7",)),
    Format(
        "LaVision set",
        cameras.set_frames,
        suffixes=(cameras.SET_SUFFIX,),
        beside=cameras.folder_beside,
        in_folders=False,
    ),
    RAW,
)
LONGEST_START = max(len(start) for each in FORMATS for start in each.starts)


def files_beside(path: Path) -> tuple[Path, ...]:
    """Return the files, or the folder of files, that one is read with, whatever it is: none of most."""
    for each in FORMATS:
        if each.beside is not None and path.suffix.lower() in each.suffixes:
            return each.beside(path)
    return ()


def format_of(path: Path, part: str | None = None) -> Format:
    """Return the format of a file: by its first bytes, and where they tell nothing by its name.

    What is neither is raw where a layout is stated.

    Raises
    ------
    InputError : the file is missing, not a regular file, empty, or of no known format
    """
    ensure_regular_file(path)
    with opened(path) as file:
        start = file.read(LONGEST_START)
    # Frames without a header can begin with any bytes.
    found = [each for each in FORMATS if path.suffix.lower() in each.suffixes]
    found = found or [each for each in FORMATS if each.starts and start.startswith(each.starts)]
    if found:
        return found[0]
    if part is not None and LOOKS_LAID_OUT.match(part):
        return RAW
    *others, last = (each.name for each in FORMATS if each.name not in ("TIFF", "PNG"))
    raise InputError(f"{path}: is neither a TIFF nor a PNG image, nor a recording of {', '.join(others)} or {last}")


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
    InputError : the file is missing, broken, or of no known format
    UsageError : more has to be said, or what is said does not fit the format
    """
    file, part = split_part(path)
    ensure_regular_file(file)
    states = (each.stat() for each in (file, *files_beside(file)))
    return _frames(file, part, tuple((state.st_size, state.st_mtime_ns, state.st_ino) for state in states))


@lru_cache(KEPT_HEADERS)
def _frames(file: Path, part: str | None, states: tuple[tuple[int, int, int], ...]) -> Recording:
    """Read a header once; a file that has another size, time or place on the disk is looked at anew."""
    part, page = split_page(part)
    found = format_of(file, part)
    if part is not None and not found.has_parts:
        raise UsageError(f"{file}:{part}: {found.name} files have no parts or layouts to name")
    recording = found.frames(file) if part is None else found.frames(file, part)
    if page is None:
        return recording
    if page >= recording.pages:
        raise InputError(f"{file}: has no page {page}, it holds {recording.pages}")
    time_s = None if recording.time_s is None else recording.time_s[page : page + 1]
    return replace(recording, pages=1, time_s=time_s, read_page=lambda _, shape: recording.read_page(page, shape))


def count_pages(path: Path) -> int:
    """Return how many frames an image file holds: see `frames`."""
    return frames(path).pages


def read_image(path: Path | str, page: int = 0, shape: Shape | None = None) -> Image:
    """Read an image of a TIFF or PNG file or of a camera's recording, or one page of a sequence.

    `FILE.h5:/PATH` names a dataset, `FILE.raw:LAYOUT` the layout of frames without a header.

    Parameters
    ----------
    shape : the sensor's (rows, columns), where it is known

    Returns
    -------
    (rows, columns) float32
        Counts.

    Raises
    ------
    InputError
        The file is missing or broken, in colour, of another size, or has no such page.
    """
    recording = frames(Path(path))
    if not 0 <= page < recording.pages:
        raise InputError(f"{path}: has no page {page}, it holds {recording.pages}")
    return recording.read_page(page, shape)


def read_single(path: Path, shape: Shape | None = None) -> Image:
    """Read the only frame of a file, shape (rows, columns), in counts.

    Parameters
    ----------
    shape : the sensor's (rows, columns), where it is known

    Raises
    ------
    InputError : as `read_image`, and where the file holds several frames
    """
    pages = count_pages(path)
    if pages != 1:
        raise InputError(f"{path}: holds {pages} pages, expected a single image; {path}:page=0 is the first one")
    return read_image(path, 0, shape)


def read_reference(path: Path, shape: Shape | None = None) -> Image:
    """Read an image that others are measured by (white, dark, target, background, mask): each pixel holds counts.

    Raises
    ------
    InputError : as `read_image`, and where a pixel is not a number, or no camera could have it
    """
    image = read_single(path, shape)
    bad = int(np.count_nonzero(~(np.abs(image) <= MOST_COUNTS)))
    if bad:
        raise InputError(
            f"{path}: {bad} of its {image.size} pixels are not counts, numbers below {written(MOST_COUNTS)}"
        )
    return image


def write_tiff(path: Path, array: NDArray[Any], overwrite: bool) -> None:
    """Write an image (rows, columns) of type uint8, uint16 or float32, packed without loss and without time stamps."""
    if array.dtype not in (np.uint8, np.uint16, np.float32) or array.ndim != 2:
        raise TypeError(f"images are uint8, uint16 or float32 (rows, columns), not {array.dtype} {array.shape}")
    # What is no count hardly packs: its lowest level takes half the time and 4 % more room.
    fractions = array.dtype == np.float32
    packing = {"compression": "zlib", "compressionargs": {"level": 1 if fractions else 6}, "predictor": not fractions}
    kept = packing | {"metadata": None, "software": False}
    shape = (array.shape[0], array.shape[1])
    with written_atomically(
        path, overwrite=overwrite, check=lambda made: formats.tiff_frames(made).read_page(0, shape)
    ) as temporary:
        tifffile.imwrite(temporary, array, photometric="minisblack", **kept)
