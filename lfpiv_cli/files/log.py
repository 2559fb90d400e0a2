"""A log for programs that watch batches: a line of JSON for each event, added to what the file holds."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lfpiv_cli.errors import OutputError, UsageError
from lfpiv_cli.files.atomic import without_nan
from lfpiv_cli.files.inputs import reason


class EventLog:
    """The log of one command.

    Each line has `time` (UTC), `process`, `command` and `event`. Lines are written whole, one at a time, so that
    several commands can share a file.
    """

    def __init__(self, path: Path, command: str) -> None:
        """Take the file, which need not exist.

        Raises
        ------
        UsageError : it exists and holds something else
        """
        self.path, self._command = path, command
        if path.is_file() and path.stat().st_size and not _begins_as_log(path):
            raise UsageError(f"{path}: is no log: its first line is no JSON object; --log would add to it")

    def write(self, event: str, fields: Mapping[str, Any]) -> None:
        """Add an event.

        Raises
        ------
        OutputError
        """
        head = {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "process": os.getpid(),
            "command": self._command,
            "event": event,
        }
        line = json.dumps(head | without_nan(fields), allow_nan=False) + "\n"
        try:
            descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            try:
                os.write(descriptor, line.encode())
            finally:
                os.close(descriptor)
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {reason(error)}") from error


def _begins_as_log(path: Path) -> bool:
    """Return whether a file's first byte is that of a JSON object."""
    with open(path, "rb") as file:
        return file.read(1) == b"{"
