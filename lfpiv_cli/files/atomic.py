"""The one way in which files are written: beside the target, checked, flushed, then renamed onto it.

A file under its final name is therefore always complete: a fault leaves the old one, or none. Folders of outputs that
are missing are made, all of them, when the first file in them begins, and gone again where none came to stand in them.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from lfpiv_cli.errors import InputError, LfpivError, OutputError, OutputExistsError, UsageError
from lfpiv_cli.files.inputs import reason, split_part
from lfpiv_cli.files.processes import host_digest, is_running

# How much of the target's name the temporary file keeps: 40 characters of 4 bytes and the rest stay below the 255 bytes
# that common file systems allow.
KEPT_CHARACTERS = 40
# The name of a file that is being written, with the process that writes it.
PARTIAL = re.compile(r"\..*\.(?P<host>[0-9a-f]{8})-(?P<process>\d{1,10})-[0-9a-f]{8}\.partial(\..*)?", re.DOTALL)
# Of a path in a message: a line or two.
LONGEST_SHOWN = 200
# Another process may remove a folder that is empty just before a file begins in it.
MOST_ATTEMPTS = 20


def ensure_writable(target: Path, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Refuse a target that could not be written, before anything is computed.

    Raises
    ------
    UsageError
        If the target is one of the inputs.
    OutputExistsError
        If it exists and `overwrite` is false.
    OutputError
        If it is not a regular file, or its folder is read-only or cannot be made.
    """
    for path in inputs:
        if _same_file(target, split_part(path)[0]):
            raise UsageError(f"{target}: the output is also an input")
    _ensure_possible(target)
    if target.is_dir():
        raise OutputError(f"{target}: cannot be written: it is a folder")
    if os.path.lexists(target):
        if not overwrite:
            raise OutputExistsError(f"{target}: exists already (use --overwrite to replace it)")
        if not target.is_file():
            raise OutputError(f"{target}: cannot be replaced: it is not a regular file")
    _ensure_folder(target)


def _ensure_folder(target: Path) -> None:
    """Refuse a target whose folder takes no file, or cannot be made in the last one on the way there that exists."""
    folder = next(each for each in target.parents if os.path.lexists(each))
    if folder.is_dir() and os.access(folder, os.W_OK | os.X_OK):
        return
    if not os.path.lexists(folder):  # another process has just removed it, empty
        _ensure_folder(target)
        return
    why = f"the folder {folder} is read-only" if folder.is_dir() else f"{folder} is not a folder"
    raise OutputError(f"{target}: cannot be written: {why}")


@contextmanager
def folder_of(target: Path) -> Iterator[None]:
    """Make the folders of an output that are missing; in the end, remove those of them in which nothing stands.

    Raises
    ------
    OutputError : they cannot be made
    """
    missing = [folder for folder in target.absolute().parents if not folder.exists()]
    try:
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{target}: cannot be written: {reason(error)}") from error
        yield
    finally:
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()


def create_alone(path: Path) -> int:
    """Create a file that must not be there, and its folder where that has gone; return its descriptor, for writing.

    Raises
    ------
    OSError : FileExistsError where it is there
    """
    for _ in range(MOST_ATTEMPTS):
        with contextlib.suppress(FileNotFoundError):
            return os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)


def _ensure_possible(target: Path) -> None:
    """Refuse a name that no file or folder can have: the system would raise wherever it is asked of it."""
    there = next((folder for folder in target.parents if _exists(folder, target)), Path())
    for part in target.relative_to(there).parts:
        _exists(there / part, target)


def _exists(path: Path, target: Path) -> bool:
    """Return whether a part of a target's path exists.

    Raises
    ------
    OutputError : nothing can
    """
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError) as error:
        raise OutputError(f"{shown(target)}: cannot be written: {reason(error)}") from error
    return True


def shown(path: Path) -> str:
    """Return a path as a message names it: one that is too long for any file by its end."""
    text = str(path)
    return text if len(text) <= LONGEST_SHOWN else f"...{text[-LONGEST_SHOWN:]}"


def write_atomically(
    target: Path,
    write: Callable[[Path], None],
    *,
    overwrite: bool,
    check: Callable[[Path], None] | None = None,
) -> None:
    """Write a file so that it appears under its name only when it is complete.

    Parameters
    ----------
    write : fills the temporary file that it is given, which exists, is empty and has the target's suffix
    check : reads the finished temporary file back and raises `InputError` where it is not what was meant

    Raises
    ------
    OutputExistsError, OutputError
        As `ensure_writable`, and where the system refuses (no space, file too large, no permission).
    """
    ensure_writable(target, overwrite)
    with folder_of(target):
        _write(target, write, overwrite, check)


def _write(target: Path, write: Callable[[Path], None], overwrite: bool, check: Callable[[Path], None] | None) -> None:
    """Do the work of `write_atomically` in a folder that is there."""
    temporary: Path | None = None
    try:
        temporary = _reserve(target)
        write(temporary)
        if check is not None:
            _read_back(target, temporary, check)
        _flush(temporary)
        ensure_writable(target, overwrite)
        os.replace(temporary, target)
        temporary = None
        _flush_folder(target.parent)
    except LfpivError:
        raise
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {reason(error)}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _read_back(target: Path, temporary: Path, check: Callable[[Path], None]) -> None:
    """Raise where a finished file is not what was meant."""
    try:
        check(temporary)
    except InputError as error:
        raise OutputError(f"{target}: what was written does not read back: {error}") from error


def write_json(path: Path, value: Mapping[str, Any], overwrite: bool) -> None:
    """Write an object as JSON, keys in their order, NaN and infinities as null (JSON has no word for them)."""
    write_text(path, json.dumps(without_nan(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n", overwrite)


def write_text(path: Path, text: str, overwrite: bool) -> None:
    """Write text in UTF-8; names of files that are no UTF-8 keep their bytes."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(text.encode("utf-8", "surrogateescape"))

    write_atomically(path, write, overwrite=overwrite)


def without_nan(value: Any) -> Any:
    """Return plain Python data (numpy scalars and arrays unpacked) in which NaN and infinities are None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return value


def _reserve(target: Path) -> Path:
    """Create an empty file beside the target that nobody else has, with the permissions the umask allows."""
    _clear(target.parent.absolute(), os.getpid())
    begun_by = f"{host_digest()}-{os.getpid()}-{secrets.token_hex(4)}"
    temporary = target.with_name(f".{target.stem[:KEPT_CHARACTERS]}.{begun_by}.partial{target.suffix}")
    os.close(create_alone(temporary))
    return temporary


@lru_cache(maxsize=64)
def _clear(folder: Path, _process: int) -> None:
    """Remove from a folder what processes of this host had begun to write when they were killed.

    Once a folder: there may be thousands of files. What is of a dead process whose number another one has now stays.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            left = PARTIAL.fullmatch(entry.name)
            if left is not None and left["host"] == host_digest() and not is_running(int(left["process"])):
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)


def _flush(path: Path) -> None:
    """Bring a file's content to the disk."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def _flush_folder(folder: Path) -> None:
    """Bring a folder's entries to the disk where the system can (Windows cannot open folders)."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _same_file(first: Path, second: Path) -> bool:
    """Return whether two names lead to one file; a name that leads nowhere yet is compared by its resolved path."""
    try:
        return os.path.samefile(first, second)
    except (OSError, ValueError):
        return os.path.realpath(first) == os.path.realpath(second)
