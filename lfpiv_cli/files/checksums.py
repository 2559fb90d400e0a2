"""Inputs against a list of their SHA-256, as `sha256sum` writes it: most cameras' formats have no check sum."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, split_part
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.files.recordings.formats import files_beside

# `sha256sum` writes a star before the names of files that are read as bytes.
LINE = re.compile(r"([0-9a-fA-F]{64}) [ *](.+)")
LARGEST_LIST_BYTES = 2**28


def ensure_verified(listed: Path, inputs: Iterable[Path]) -> int:
    """Refuse inputs that are not as a list says, or not in it; return how many files were read for that.

    Parameters
    ----------
    listed : the list; names in it count from its folder
    inputs : files, and folders of which all that is listed is asked

    Raises
    ------
    InputError
    """
    expected = _read(listed)
    read = (each for path in inputs for each in _with_those_beside(split_part(path)[0]))
    asked = dict(pair for path in read for pair in _files(path, listed, expected))
    for file, name in asked.items():
        found = sha256(file)
        if found != expected[file]:
            raise InputError(
                f"{name}: has the SHA-256 {found}, {listed} says {expected[file]}: it is damaged, or another"
            )
    return len(asked)


def _with_those_beside(path: Path) -> tuple[Path, ...]:
    """Return a file, and those that it is read with."""
    return (path,) if os.path.isdir(path) else (path, *files_beside(path))


def _files(path: Path, listed: Path, expected: dict[Path, str]) -> Iterator[tuple[Path, Path]]:
    """Yield the resolved name of each file that an input is, with the one that it was given under."""
    resolved = path.resolve()
    inside = [file for file in expected if resolved in file.parents] if os.path.isdir(resolved) else [resolved]
    if not inside or (inside == [resolved] and resolved not in expected):
        raise InputError(f"{path}: is not in {listed}, which lists {len(expected)} files")
    for file in inside:
        yield file, path if file == resolved else file


def _read(listed: Path) -> dict[Path, str]:
    """Return the SHA-256 of each file in a list, by its resolved name."""
    size = ensure_regular_file(listed)
    if size > LARGEST_LIST_BYTES:
        raise InputError(f"{listed}: has {size} bytes, expected a list of at most {LARGEST_LIST_BYTES}")
    lines = content_of(listed).decode("utf-8", errors="surrogateescape").splitlines()
    found: dict[Path, str] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        match = LINE.fullmatch(line)
        if match is None:
            raise InputError(f"{listed}:{number}: is no line of sha256sum: 64 digits, two spaces, a file's name")
        name = (listed.parent / match[2]).resolve()
        if found.setdefault(name, match[1].lower()) != match[1].lower():
            raise InputError(f"{listed}:{number}: {match[2]} has another SHA-256 further above")
    return found
