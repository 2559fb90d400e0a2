"""How files are written: beside the target, checked, flushed, then renamed onto it; logs alone grow line by line.

A file under its final name is therefore always complete: a fault leaves the old one, or none. Folders of outputs that
are missing are made, all of them, when the first file in them begins, and gone again where none came to stand in them.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import secrets
import socket
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import Enum, auto
from functools import lru_cache
from pathlib import Path
from typing import Any

from lfpiv_cli.errors import InputError, OutputError, OutputExistsError, UsageError
from lfpiv_cli.files.inputs import reason, split_part

# Where the files of a command lie: no two outputs in one place, and none in that of an input.


def ensure_apart(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Refuse outputs of which one would replace another, or an input, before anything is computed."""
    inputs = [split_part(path)[0] for path in inputs]
    read = {place_of(path) for path in inputs}
    files = {identity for identity in map(_identity, inputs) if identity is not None}
    written: set[tuple[str, str]] = set()
    for path in outputs:
        place = place_of(path)
        if place in read or _identity(path) in files:
            raise UsageError(f"{path}: the output is also an input")
        if place in written:
            raise UsageError(f"{path}: two outputs of this command would have this name")
        written.add(place)


def place_of(path: Path) -> tuple[str, str]:
    """Return folder and name of a file, the same for all names that lead there, whether it exists or not."""
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


# Once a folder: there may be thousands of files.
_real = lru_cache(maxsize=16)(os.path.realpath)


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what tells an existing file from all others; None where there is none."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


# Which process a file belongs to that some process left: of this host or another one, running or dead.


@lru_cache(maxsize=1)
def host_digest() -> str:
    """Return what stands for this host in the names of files."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def is_running(process: int) -> bool:
    """Return whether a process of this host runs."""
    if os.name != "posix":  # where asking with a signal would send it
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


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
    UsageError : the target is one of the inputs
    OutputExistsError : it exists and `overwrite` is false
    OutputError : it is not a regular file, or its folder is read-only or cannot be made
    """
    _ensure_possible(target)
    ensure_apart([target], inputs)
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


@contextmanager
def written_atomically(
    target: Path, *, overwrite: bool, check: Callable[[Path], object] | None = None
) -> Iterator[Path]:
    """Write a file so that it appears under its name only when it is complete.

    Yields the temporary file to fill, which exists, is empty and has the target's suffix.

    Parameters
    ----------
    check : reads the finished temporary file back and raises `InputError` where it is not what was meant

    Raises
    ------
    OutputExistsError, OutputError
        As `ensure_writable`, and where the system refuses (no space, file too large, no permission).
    """
    ensure_writable(target, overwrite)
    with folder_of(target):
        _clear(target.parent.absolute(), os.getpid())
        begun_by = f"{host_digest()}-{os.getpid()}-{secrets.token_hex(4)}"
        temporary = target.with_name(f".{target.stem[:KEPT_CHARACTERS]}.{begun_by}.partial{target.suffix}")
        try:
            os.close(create_alone(temporary))
            yield temporary
            if check is not None:
                try:
                    check(temporary)
                except InputError as error:
                    raise OutputError(f"{target}: what was written does not read back: {error}") from error
            _flush(temporary, os.O_RDWR)
            ensure_writable(target, overwrite)
            os.replace(temporary, target)
            with contextlib.suppress(OSError):  # Windows cannot open folders
                _flush(target.parent, os.O_RDONLY)
        except OSError as error:
            raise OutputError(f"{target}: cannot be written: {reason(error)}") from error
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink()


def _flush(path: Path, flags: int) -> None:
    """Bring a file's content, or a folder's entries, to the disk."""
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: Path, value: Mapping[str, Any], overwrite: bool) -> None:
    """Write an object as JSON, keys in their order, NaN and infinities as null (JSON has no word for them)."""
    write_text(path, json.dumps(without_nan(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n", overwrite)


def write_text(path: Path, text: str, overwrite: bool) -> None:
    """Write text in UTF-8; names of files that are no UTF-8 keep their bytes."""
    content = text.encode("utf-8", "surrogateescape")
    with written_atomically(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(content)


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


# Claims: which output of a folder some worker makes now, so that several workers share a batch.
#
# A claim is a small hidden file beside the output, which only one worker can create. A claim that a dead worker left
# is taken over; should two take it over at once, both make the output, which is written whole and the same by either.

# A worker touches its claim this often; one that was not touched for so long belongs to a worker that is dead, on
# whatever host. The clocks of hosts that share a disk differ by less.
TOUCHED_EVERY_S, DEAD_AFTER_S = 20.0, 300.0
# How often a worker looks at what others have claimed, where it waits for it.
SECONDS_BETWEEN_LOOKS = 0.5


class Turn(Enum):
    """What keeps an output from being made: another worker makes it now, or has made it since the batch began."""

    CLAIMED = auto()
    SKIPPED = auto()


@contextmanager
def claimed(target: Path) -> Iterator[bool]:
    """Claim an output while it is made; yields whether the claim was granted.

    Raises
    ------
    OutputError : the folder takes no file, or cannot be made
    """
    # Beside it, under a name that is not longer than the system allows.
    digest = hashlib.sha256(os.fsencode(target.name)).hexdigest()[:8]
    claim = target.with_name(f".{target.stem[:KEPT_CHARACTERS]}.{digest}.claim")
    granted, ended = False, threading.Event()

    def keep_touching() -> None:
        while not ended.wait(TOUCHED_EVERY_S):
            with contextlib.suppress(OSError):
                os.utime(claim)

    with folder_of(target):
        try:
            granted = _create(claim)
            if not granted and _is_dead(claim):
                claim.unlink(missing_ok=True)
                granted = _create(claim)
            if granted:
                threading.Thread(target=keep_touching, daemon=True).start()
            yield granted
        finally:
            ended.set()
            if granted:
                claim.unlink(missing_ok=True)


@contextmanager
def awaited(target: Path) -> Iterator[None]:
    """Claim an output, after another worker that makes it now has ended."""
    while True:
        with claimed(target) as granted:
            if granted:
                yield
                return
        time.sleep(SECONDS_BETWEEN_LOOKS)


def _create(claim: Path) -> bool:
    """Create a claim; return whether there was none."""
    try:
        descriptor = create_alone(claim)
    except FileExistsError:
        return False
    except OSError as error:
        raise OutputError(f"{claim.parent}: cannot be written into: {reason(error)}") from error
    try:
        os.write(descriptor, json.dumps({"host": socket.gethostname(), "process": os.getpid()}).encode())
    finally:
        os.close(descriptor)
    return True


def _is_dead(claim: Path) -> bool:
    """Return whether a claim's worker is dead: no process of this host, or silent for long."""
    try:
        silent_s = time.time() - claim.stat().st_mtime
        worker = json.loads(claim.read_bytes())
        host, process = worker["host"], int(worker["process"])
    except FileNotFoundError:
        return False  # its worker has just ended; the next look finds what it made
    except (OSError, ValueError, KeyError, TypeError):
        return silent_s > DEAD_AFTER_S  # it is being written, or its worker was killed while it was
    return silent_s > DEAD_AFTER_S or (host == socket.gethostname() and not is_running(process))


# A log for programs that watch batches: a line of JSON for each event, added to what the file holds.

# Opens a pipe that nobody reads with an error, where it would wait for a reader; of Unix alone.
AT_ONCE = getattr(os, "O_NONBLOCK", 0)
# How each line begins.
BEGINS = b'{"time": '


class EventLog:
    """The log of one command.

    Each line has `time` (UTC), `process`, `command` and `event`. Lines are written whole, one at a time, so that
    several commands can share a file.
    """

    def __init__(self, path: Path, command: str, read_only: bool = False) -> None:
        """Take the file, which need not exist; with `read_only` nothing is added to it.

        Raises
        ------
        UsageError : it exists and holds something else
        """
        self.path, self._command, self._read_only = path, command, read_only
        if not path.is_file():
            return
        with open(path, "rb") as file:
            begin = file.read(len(BEGINS))
        if begin and begin != BEGINS:
            raise UsageError(f"{path}: is no log: its first line is no event with its time; --log would add to it")

    def write(self, event: str, fields: Mapping[str, Any]) -> None:
        """Add an event."""
        if self._read_only:
            return
        head = {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "process": os.getpid(),
            "command": self._command,
            "event": event,
        }
        line = json.dumps(head | without_nan(fields), allow_nan=False) + "\n"
        try:
            if not self.path.parent.exists():
                self.path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | AT_ONCE, 0o666)
            try:
                if AT_ONCE:
                    os.set_blocking(descriptor, True)
                os.write(descriptor, line.encode())
            finally:
                os.close(descriptor)
        except OSError as error:
            words = "is a pipe that nobody reads" if error.errno == errno.ENXIO else reason(error)
            raise OutputError(f"{self.path}: cannot be written: {words}") from error

    def last(self, event: str, **fields: Any) -> dict[str, Any] | None:
        """Return the last event of this command with this name and these fields; None where there is none."""
        wanted = {"command": self._command, "event": event} | fields
        found = None
        for line in self.path.read_bytes().splitlines() if self.path.is_file() else ():
            try:
                read = json.loads(line)
            except ValueError:
                continue  # a line that was cut with its process
            if isinstance(read, dict) and wanted.items() <= read.items():
                found = read
        return found


def largest_memory_mb() -> float | None:
    """Return the most memory that this process has had so far; None where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    units = 1e6 if sys.platform == "darwin" else 1e3
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / units, 1)
