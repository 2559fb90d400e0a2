"""Which formats of frames there are, how each is recognised, and what reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.inputs import ensure_regular_file, opened
from lfpiv_cli.files.recordings import cine, davis_set, im7, mraw, png, raw, seq, stack, tiff
from lfpiv_cli.files.recordings.recording import Recording


@dataclass(frozen=True)
class Format:
    """A format of frames.

    Attributes
    ----------
    name : as people say it
    starts : the first bytes of its files, where they tell
    suffixes : of its files' names, in small letters, where the first bytes do not tell
    frames : reads a file's header
    frames_of : reads what FILE:PART says of a file, where the format has parts
    beside : finds the other files that one is read with; a folder stands for all files in it
    in_folders : whether its files are meant where a folder is given for the images in it; an HDF5 file can be anything,
        and a set's images are there besides
    """

    name: str
    frames: Callable[[Path], Recording]
    starts: tuple[bytes, ...] = ()
    suffixes: tuple[str, ...] = ()
    frames_of: Callable[[Path, str], Recording] | None = None
    beside: Callable[[Path], tuple[Path, ...]] | None = None
    in_folders: bool = True


RAW = Format("raw", raw.frames, suffixes=raw.SUFFIXES, frames_of=raw.frames_laid_out)
FORMATS = (
    Format("TIFF", tiff.frames, starts=tiff.STARTS),
    Format("PNG", png.frames, starts=(png.START,)),
    Format("HDF5", stack.frames, starts=(stack.START,), frames_of=stack.frames_named, in_folders=False),
    Format("Phantom cine", cine.frames, starts=(cine.START,)),
    Format("Norpix seq", seq.frames, starts=(seq.START,)),
    Format("Photron mraw", mraw.frames, suffixes=(mraw.SUFFIX,), beside=mraw.beside),
    Format("LaVision im7", im7.frames, suffixes=(".im7",)),
    Format("LaVision set", davis_set.frames, suffixes=(davis_set.SUFFIX,), beside=davis_set.beside, in_folders=False),
    RAW,
)
LONGEST_START = max(len(start) for each in FORMATS for start in each.starts)


def open_recording(path: Path, part: str | None) -> Recording:
    """Return what a file's header says of its frames.

    Raises
    ------
    InputError : the file is broken or of no known format
    UsageError : the format has no parts and one was named, or needs more to be said
    """
    found = format_of(path, part)
    if part is None:
        return found.frames(path)
    if found.frames_of is None:
        raise UsageError(f"{path}:{part}: {found.name} files have no parts or layouts to name")
    return found.frames_of(path, part)


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
    by_name = [each for each in FORMATS if path.suffix.lower() in each.suffixes]
    # Frames without a header can begin with any bytes.
    if not by_name:
        for each in FORMATS:
            if each.starts and start.startswith(each.starts):
                return each
    if by_name:
        return by_name[0]
    if part is not None and raw.LOOKS_LAID_OUT.match(part):
        return RAW
    raise InputError(f"{path}: is neither a TIFF nor a PNG image, nor a recording of {_others()}")


def _others() -> str:
    names = [each.name for each in FORMATS if each.name not in ("TIFF", "PNG")]
    return ", ".join(names[:-1]) + f" or {names[-1]}"
