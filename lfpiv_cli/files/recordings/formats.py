"""Which formats of frames there are, how each is recognised, and what reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import ensure_regular_file, reason
from lfpiv_cli.files.recordings import png, tiff
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
    """

    name: str
    starts: tuple[bytes, ...]
    suffixes: tuple[str, ...]
    frames: Callable[[Path], Recording]


FORMATS = (
    Format("TIFF", tiff.STARTS, (), tiff.frames),
    Format("PNG", (png.START,), (), png.frames),
)
LONGEST_START = max(len(start) for each in FORMATS for start in each.starts)


def format_of(path: Path) -> Format:
    """Return the format of a file: by its first bytes, and where they tell nothing by its name.

    Raises
    ------
    InputError : the file is missing, not a regular file, empty, or of no known format
    """
    ensure_regular_file(path)
    try:
        with open(path, "rb") as file:
            start = file.read(LONGEST_START)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason(error)}") from error
    for each in FORMATS:
        if start.startswith(each.starts):
            return each
    for each in FORMATS:
        if path.suffix.lower() in each.suffixes:
            return each
    raise InputError(f"{path}: is neither a TIFF nor a PNG image")
