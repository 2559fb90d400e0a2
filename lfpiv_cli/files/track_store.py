"""The places of a sequence's tracks on a disk: put there a frame at a time, read by frame or by track.

However long a sequence is, a block of tracks, or a frame, is all of it that is in memory.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import OutputError
from lfpiv_cli.files.inputs import reason
from lfpiv_cli.reference import Reference

# Rows of the tracks that are put in order together: a few megabytes.
BLOCK_ROWS = 2**16


class TrackStore:
    """Rows of tracks in a file without a name, which ends with the process; by frame, and by track within one."""

    def __init__(self, folder: Path) -> None:
        """Begin a file in a folder, on the disk that the tracks will be written to.

        Raises
        ------
        OutputError
        """
        self._folder = folder
        # For each frame, where its arrays begin in the file, and its number of rows.
        self._begins: list[dict[str, int]] = []
        self._counts: list[int] = []
        self._kinds: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._lengths: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        try:
            self._file = tempfile.TemporaryFile(buffering=0, dir=folder)  # noqa: SIM115
        except OSError as error:
            raise self._error(error) from error

    def __enter__(self) -> TrackStore:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the file."""
        self._file.close()

    @property
    def frames(self) -> NDArray[np.int64]:
        """The number of rows of each frame."""
        return np.array(self._counts, dtype=np.int64)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """The number of rows of each track."""
        return self._lengths

    def put(self, rows: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of one more frame, in the order of `track`, in which no number comes twice.

        Raises
        ------
        OutputError
        """
        track = rows["track"]
        if len(track) and track[-1] >= len(self._lengths):
            self._lengths = np.append(self._lengths, np.zeros(track[-1] + 1 - len(self._lengths), np.int64))
        self._lengths[track] += 1
        self._counts.append(len(track))
        self._kinds = self._kinds or {name: (array.dtype, array.shape[1:]) for name, array in rows.items()}
        begins = {}
        try:
            for name, array in rows.items():
                begins[name] = self._file.tell()
                left = np.ascontiguousarray(array).data.cast("B") if array.size else memoryview(b"")
                while left:
                    left = left[self._file.write(left) :]
        except OSError as error:
            raise self._error(error) from error
        self._begins.append(begins)

    def by_frame(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield the rows of an array in each frame."""
        return (self._read(frame, name, 0, count) for frame, count in enumerate(self._counts))

    def by_track(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield the rows of an array by track, then by frame, in blocks of whole tracks; one at least."""
        for begins, ends in pairwise(self._cuts.T):
            tracks = self._block("track", begins, ends)
            order = np.argsort(tracks, kind="stable")
            yield (tracks if name == "track" else self._block(name, begins, ends))[order]

    @cached_property
    def _cuts(self) -> NDArray[np.int64]:
        """Where in each frame's rows the blocks of tracks begin, and where the last one ends: (frames, blocks + 1)."""
        ends = np.cumsum(self._lengths)
        inner = np.searchsorted(ends, np.arange(BLOCK_ROWS, ends[-1] if len(ends) else 0, BLOCK_ROWS), "right")
        edges = np.array([0, *inner, len(ends)])
        return np.array([np.searchsorted(track, edges) for track in self.by_frame("track")])

    def _block(self, name: str, begins: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[Any]:
        """Return rows of an array from each frame, one frame after the other."""
        spans = enumerate(zip(begins.tolist(), ends.tolist(), strict=True))
        return np.concatenate([self._read(frame, name, begin, end) for frame, (begin, end) in spans])

    def _read(self, frame: int, name: str, begin: int, end: int) -> NDArray[Any]:
        dtype, shape = self._kinds[name]
        rows = np.empty((end - begin, *shape), dtype)
        if rows.size:
            self._file.seek(self._begins[frame][name] + begin * dtype.itemsize * math.prod(shape))
            if self._file.readinto(rows.data.cast("B")) != rows.nbytes:
                raise OutputError(f"{self._folder}: what was put there for a while cannot be read")
        return rows

    def _error(self, error: OSError) -> OutputError:
        return OutputError(f"{self._folder}: tracks cannot be put there for a while: {reason(error)}")


@dataclass(frozen=True, eq=False)
class StoredTracks:
    """Tracks of a sequence that are on a disk, in place of `Points` in memory.

    Attributes
    ----------
    store : with all places
    reference : the origin of their coordinates
    attributes, provenance : what their file says about itself
    """

    store: TrackStore
    reference: Reference
    attributes: dict[str, Any]
    provenance: dict[str, Any]

    @property
    def count(self) -> int:
        """How many places there are."""
        return int(self.store.frames.sum())

    def rows(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield the rows of an array in the order of a file, in pieces."""
        return self.store.by_track(name)

    def lines(self) -> NDArray[np.int64]:
        """Return where each track's rows begin, and where the last one's end."""
        lengths = self.store.lengths
        return np.concatenate([[0], np.cumsum(lengths[lengths > 0])])

    def in_frames(self, _frames: int) -> tuple[NDArray[np.int64], Callable[[str], Iterator[NDArray[Any]]]]:
        """Return how many places each frame has, and what yields an array's rows in each."""
        return self.store.frames, self.store.by_frame
