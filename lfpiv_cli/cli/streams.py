"""stdout and stderr that never stop a command: what cannot be said is lost, what is to be written is not."""

from __future__ import annotations

import errno
import io
import os
import sys

from lfpiv_cli.errors import OutputError


class Stream(io.RawIOBase):
    """A descriptor to write to, whose first failure is kept and not raised."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.failure: OSError | None = None

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return os.isatty(self._descriptor)

    def write(self, data: bytes | bytearray | memoryview) -> int:  # type: ignore[override]
        """Write all of the bytes, or none that could be written."""
        left = memoryview(data).cast("B")
        try:
            while left and self.failure is None:
                left = left[os.write(self._descriptor, left) :]
        except OSError as error:
            self.failure = error
        return len(data)


def open_streams() -> Stream:
    """Put such streams in the place of stdout and stderr, and something in that of descriptors that are closed.

    A file that was opened under the number of a closed stdout would get what is printed.

    Returns
    -------
    Stream
        That of stdout.
    """
    descriptor = os.open(os.devnull, os.O_RDWR)
    while descriptor <= 2:
        descriptor = os.dup(descriptor)
    os.close(descriptor)
    streams = {}
    for name, number in (("stdout", 1), ("stderr", 2)):
        before = getattr(sys, name)
        streams[name] = Stream(number)
        if before is not getattr(sys, f"__{name}__"):  # whoever has put another one there wants what is said
            continue
        encoding, errors = (before.encoding, before.errors) if before else ("utf-8", "backslashreplace")
        text = io.TextIOWrapper(
            io.BufferedWriter(streams[name]),  # type: ignore[type-var]
            encoding=encoding,
            errors=errors,
            line_buffering=number == 2,
        )
        setattr(sys, name, text)
    return streams["stdout"]


def ensure_said(stdout: Stream) -> None:
    """Refuse to call a command done whose answer on stdout was lost; a reader that has gone wanted no more of it.

    Raises
    ------
    OutputError
    """
    sys.stdout.flush()
    if stdout.failure is not None and stdout.failure.errno != errno.EPIPE:
        raise OutputError(f"stdout: cannot be written: {os.strerror(stdout.failure.errno or 0)}; all files are written")
