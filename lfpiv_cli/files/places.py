"""Where the files of a command lie: no two outputs in one place, and none in that of an input."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.inputs import split_part

# The folder as the system knows it, and the name in it; what an existing file is, whatever leads to it.
Place = tuple[str, str]
Identity = tuple[int, int]


def ensure_apart(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Refuse outputs of which one would replace another, or an input, before anything is computed.

    Raises
    ------
    UsageError
    """
    inputs = [split_part(path)[0] for path in inputs]
    read = {place_of(path) for path in inputs}
    files = {identity for identity in map(_identity, inputs) if identity is not None}
    written: set[Place] = set()
    for path in outputs:
        place = place_of(path)
        if place in read or _identity(path) in files:
            raise UsageError(f"{path}: the output is also an input")
        if place in written:
            raise UsageError(f"{path}: two outputs of this command would have this name")
        written.add(place)


def place_of(path: Path) -> Place:
    """Return the place of a file, the same for all names that lead there, whether it exists or not."""
    folder = _real(path.parent)
    return folder, folded(path.name, Path(folder))


def folded(name: str, folder: Path) -> str:
    """Return a name as a folder's file system compares it: where A is a there, in small letters."""
    return unicodedata.normalize("NFC", name).casefold() if ignores_case(folder) else name


@lru_cache(maxsize=16)
def ignores_case(folder: Path) -> bool:
    """Return whether a folder's file system takes A and a for one, asked by the name of a folder that is there."""
    for place in (folder.resolve(), *folder.resolve().parents):
        other = place.name.swapcase()
        if other != place.name and place.exists():
            return _identity(place.with_name(other)) == _identity(place)
    return False


@lru_cache(maxsize=16)
def _real(folder: Path) -> str:
    return os.path.realpath(folder)


def _identity(path: Path) -> Identity | None:
    """Return what tells an existing file from all others; None where there is none."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino
