"""A log for programs that watch batches: a line of JSON for each event, added to what the file holds."""

from __future__ import annotations

import errno
import json
import os
import sys
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lfpiv_cli.errors import OutputError, UsageError
from lfpiv_cli.files.atomic import without_nan
from lfpiv_cli.files.inputs import reason

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
        if path.is_file() and path.stat().st_size and not _begins_as_log(path):
            raise UsageError(f"{path}: is no log: its first line is no event with its time; --log would add to it")

    def write(self, event: str, fields: Mapping[str, Any]) -> None:
        """Add an event.

        Raises
        ------
        OutputError
        """
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
        for line in self._lines():
            try:
                told = json.loads(line)
            except ValueError:
                continue  # a line that was cut with its process
            if isinstance(told, dict) and wanted.items() <= told.items():
                found = told
        return found

    def _lines(self) -> Iterator[bytes]:
        """Yield the lines that are there."""
        if self.path.is_file():
            with open(self.path, "rb") as file:
                yield from file


def largest_memory_mb() -> float | None:
    """Return the most memory that this process has had so far; None where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    units = 1e6 if sys.platform == "darwin" else 1e3
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / units, 1)


def _begins_as_log(path: Path) -> bool:
    """Return whether a file begins as a log does."""
    with open(path, "rb") as file:
        return file.read(len(BEGINS)) == BEGINS
