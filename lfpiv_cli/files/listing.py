"""Inputs by the thousand: lists of files, lists of check sums, and folders, also such as are still being filled."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.batch import VTKHDF_SUFFIX
from lfpiv_cli.files.images import files_beside, format_of
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, reading_from, split_part
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.names import InputKind

# Inputs against a list of their SHA-256, as `sha256sum` writes it: most cameras' formats have no check sum.

# `sha256sum` writes a star before the names of files that are read as bytes.
LINE = re.compile(r"([0-9a-fA-F]{64}) [ *](.+)")
LARGEST_LIST_BYTES = 2**28


def ensure_verified(listed: Path, inputs: Iterable[Path]) -> int:
    """Refuse inputs that are not as a list says, or not in it; return how many files were read for that.

    Parameters
    ----------
    listed : the list; names in it count from its folder
    inputs : files, and folders of which all that is listed is asked
    """
    expected = _read(listed)
    given = [split_part(path)[0] for path in inputs]
    read = [each for path in given for each in (path, *(() if os.path.isdir(path) else files_beside(path)))]
    # The name that each file was given under, by its resolved name.
    asked: dict[Path, Path] = {}
    for path in read:
        resolved = path.resolve()
        inside = [file for file in expected if resolved in file.parents] if os.path.isdir(resolved) else [resolved]
        if not inside or (inside == [resolved] and resolved not in expected):
            raise InputError(f"{path}: is not in {listed}, which lists {len(expected)} files")
        asked |= {file: path if file == resolved else file for file in inside}
    for file, name in asked.items():
        found = sha256(file)
        if found != expected[file]:
            raise InputError(
                f"{name}: has the SHA-256 {found}, {listed} says {expected[file]}: it is damaged, or another"
            )
    return len(asked)


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


# Folders that a camera, or another command, is still filling: files are taken when they are complete, in order.

# A file is complete when it can be read and has not grown for so long: cameras write a frame at once, or page by page.
SETTLED_S = 2.0
LOOK_S = 0.5
# One that cannot be read holds up those behind it for so long; complete later, it is taken then.
PASSED_OVER_S = 10.0

# Size and time of change of a file.
State = tuple[int, int]


def as_they_come(
    listed: Callable[[], Sequence[Path]],
    read: Callable[[Path], object],
    idle_s: float,
    passed_over: Callable[[Path, InputError], None] = lambda _path, _error: None,
) -> Iterator[list[Path]]:
    """Yield the files that are complete, in groups, until nothing has changed for `idle_s` seconds.

    The order is that of the list: a file waits for those before it, but for such as stay unreadable. One that is there
    after the idle time and still cannot be read comes in the last group, for whoever takes it to say what it lacks.

    Parameters
    ----------
    listed : returns the files that are there now, in order
    read : raises `InputError` where a file cannot be read yet
    passed_over : is told once of each file that is waited for no longer, and why
    """
    taken: set[Path] = set()
    passed: set[Path] = set()
    # Since when each file that was not taken is as it is.
    waiting: dict[Path, tuple[State, float]] = {}
    changed_at = time.monotonic()
    while True:
        now, before, waiting = time.monotonic(), waiting, {}
        for path in listed():
            if path in taken or (state := _state(path)) is None:
                continue
            known = before.get(path)
            waiting[path] = known if known is not None and known[0] == state else (state, now)
            if waiting[path] is not known:
                changed_at = now

        # The first of the files that wait, up to one that is not complete.
        now, ready = time.monotonic(), []
        for path, (_, since) in waiting.items():
            if now - since < SETTLED_S:
                break
            try:
                read(path)
            except InputError as error:
                if now - since < PASSED_OVER_S:
                    break
                if path not in passed:
                    passed.add(path)
                    passed_over(path, error)
                continue
            ready.append(path)
        if ready:
            taken.update(ready)
            yield ready
        elif time.monotonic() - changed_at >= max(idle_s, SETTLED_S):
            break
        else:
            time.sleep(LOOK_S)
    if waiting:
        yield list(waiting)


def _state(path: Path) -> State | None:
    """Return the size of a file and when it was changed; None where it is gone, or no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_size, status.st_mtime_ns) if path.is_file() else None


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
    found: list[Path] = []
    for given in paths:
        inside = files_in(given, kind) if os.path.isdir(given) else [given]
        if not inside:
            raise InputError(f"{given}: holds {'no images' if kind == 'images' else f'no {VTKHDF_SUFFIX} files'}")
        found += inside
    return found


def natural(name: str) -> list[str | int]:
    """Return the parts of a name, numbers by their value; texts and numbers take turns."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r"([0-9]+)", name.casefold()))]


def files_in(folder: Path, kind: InputKind) -> list[Path]:
    """Return the files in a folder that are of a kind, in natural order; those whose names begin with a dot are not.

    A kind is told by the name, an image also by its first bytes.

    Raises
    ------
    InputError : the folder cannot be read
    """
    found = []
    with reading_from(folder):
        for path in folder.iterdir():
            suffix = path.suffix.lower()
            if path.name.startswith(".") or path.is_dir():
                continue
            is_of_kind = suffix in IMAGE_SUFFIXES if kind == "images" else suffix == VTKHDF_SUFFIX
            if not is_of_kind and kind == "images":
                with suppress(InputError):
                    is_of_kind = format_of(path).in_folders
            if is_of_kind:
                found.append(path)
    return sorted(found, key=lambda path: (natural(path.name), path.name))
