"""Folders that a camera, or another command, is still filling: files are taken when they are complete, in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from lfpiv_cli.errors import InputError

# A file is complete when it can be read and has not grown for so long: cameras write a frame at once, or page by page.
SETTLED_S = 2.0
LOOK_S = 0.5

# Size and time of change of a file.
State = tuple[int, int]


def as_they_come(
    listed: Callable[[], Sequence[Path]],
    read: Callable[[Path], object],
    idle_s: float,
) -> Iterator[list[Path]]:
    """Yield the files that are complete, in groups, until nothing has changed for `idle_s` seconds.

    The order is that of the list: a file waits for those before it. One that is there after the idle time and still
    cannot be read comes in the last group, for whoever takes it to say what it lacks.

    Parameters
    ----------
    listed : returns the files that are there now, in order
    read : raises `InputError` where a file cannot be read yet
    """
    folder, idle_s = _Filling(listed, read), max(idle_s, SETTLED_S)
    while True:
        folder.look()
        if ready := folder.complete():
            folder.take(ready)
            yield ready
        elif time.monotonic() - folder.changed_at >= idle_s:
            break
        else:
            time.sleep(LOOK_S)
    if rest := list(folder.waiting):
        yield rest


class _Filling:
    """What is known of files that are being written."""

    def __init__(self, listed: Callable[[], Sequence[Path]], read: Callable[[Path], object]) -> None:
        """Take how the files are listed and read."""
        self._listed, self._read = listed, read
        self._taken: set[Path] = set()
        # Since when each file that was not taken is as it is.
        self.waiting: dict[Path, tuple[State, float]] = {}
        self.changed_at = time.monotonic()

    def look(self) -> None:
        """Note which files are new, or have changed since the last look."""
        now, before = time.monotonic(), self.waiting
        self.waiting = {}
        for path in self._listed():
            if path in self._taken or (state := _state(path)) is None:
                continue
            known = before.get(path)
            self.waiting[path] = known if known is not None and known[0] == state else (state, now)
            if self.waiting[path] is not known:
                self.changed_at = now

    def complete(self) -> list[Path]:
        """Return the first of the files that wait, up to one that is not complete."""
        now, complete = time.monotonic(), []
        for path, (_, since) in self.waiting.items():
            if now - since < SETTLED_S or not self._is_readable(path):
                break
            complete.append(path)
        return complete

    def take(self, paths: Sequence[Path]) -> None:
        """Leave these out from here on."""
        self._taken.update(paths)
        for path in paths:
            del self.waiting[path]

    def _is_readable(self, path: Path) -> bool:
        try:
            self._read(path)
        except InputError:
            return False
        return True


def _state(path: Path) -> State | None:
    """Return the size of a file and when it was changed; None where it is gone, or no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_size, status.st_mtime_ns) if path.is_file() else None
