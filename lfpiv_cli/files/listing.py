"""Inputs by the thousand: lists of files, and folders, whose files stand in natural order."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.batch import VTKHDF_SUFFIX
from lfpiv_cli.files.inputs import content_of, reading_from, split_part
from lfpiv_cli.files.recordings.formats import format_of
from lfpiv_cli.names import InputKind

# In place of a list's name: the list is read from standard input.
STANDARD_INPUT = "-"
# Files with these names are images, also where nothing of that kind is in them, so that it is told.
IMAGE_SUFFIXES = (".tif", ".tiff", ".png")


def listed(path: Path) -> list[Path]:
    """Return the files that a list names, a line each; lines with nothing in them count for nothing.

    Names are relative to where the command runs, as in a command line.

    Raises
    ------
    InputError : the list cannot be read, or nothing that it names is there
    """
    if str(path) == STANDARD_INPUT:
        with reading_from(path):
            content = sys.stdin.buffer.read()
    else:
        content = content_of(path)
    if b"\0" in content:
        raise InputError(f"{path}: is no list of files: it holds a zero byte")
    found = [Path(os.fsdecode(line)) for line in content.splitlines() if line.strip()]
    # A comment of code, //, is the root.
    if found and not any(str(each) != each.anchor and os.path.exists(split_part(each)[0]) for each in found):
        raise InputError(f"{path}: is no list of files: of its {len(found)} lines none names one")
    return found


def expanded(paths: Iterable[Path], kind: InputKind) -> list[Path]:
    """Return the files that were given, in place of a folder those in it that are of a kind, in natural order.

    Raises
    ------
    InputError : a folder cannot be read, or holds none
    """
    return [path for given in paths for path in (_some_in(given, kind) if os.path.isdir(given) else [given])]


def in_natural_order(paths: Sequence[Path]) -> list[Path]:
    """Return files by their names as people count: `b2` before `b10`."""
    return sorted(paths, key=lambda path: (_natural(path.name), path.name))


def _natural(name: str) -> list[str | int]:
    """Return the parts of a name, numbers by their value; texts and numbers take turns."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r"([0-9]+)", name.casefold()))]


def files_in(folder: Path, kind: InputKind) -> list[Path]:
    """Return the files in a folder that are of a kind, in natural order; those whose names begin with a dot are not.

    Raises
    ------
    InputError : the folder cannot be read
    """
    with reading_from(folder):
        found = [path for path in folder.iterdir() if not path.name.startswith(".") and _is_of(path, kind)]
    return in_natural_order(found)


def _some_in(folder: Path, kind: InputKind) -> list[Path]:
    found = files_in(folder, kind)
    if not found:
        what = "no images" if kind == "images" else f"no {VTKHDF_SUFFIX} files"
        raise InputError(f"{folder}: holds {what}")
    return found


def _is_of(path: Path, kind: InputKind) -> bool:
    """Return whether a file in a folder is of a kind: by its name, an image also by its first bytes."""
    suffix = path.suffix.lower()
    if path.is_dir():
        return False
    if kind == "results":
        return suffix == VTKHDF_SUFFIX
    if suffix in IMAGE_SUFFIXES:
        return True
    try:
        return format_of(path).in_folders
    except InputError:
        return False
