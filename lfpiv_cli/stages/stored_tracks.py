"""The tracks of a sequence as the stages put them together: on a disk, with the last few frames in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, overload

from lfpiv_cli.files.config import Config
from lfpiv_cli.files.particle_file import TRAJECTORIES_FORMAT, Points
from lfpiv_cli.files.track_store import StoredTracks, TrackStore
from lfpiv_cli.interface.tracks import Tracking, TracksOf, seen_in, sequence_of
from lfpiv_cli.reference import Reference
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.sequences import HALVES_FRAMES
from lfpiv_cli.tracks.trajectories import Trajectories

# States look at so many frames, one after the other; forecasts at fewer.
KEPT_FRAMES = 2 * max(HALVES_FRAMES) + 1


class SeenFrames(Sequence[Seen]):
    """The particles of a sequence's frames, read when they are asked for; the last few stay in memory."""

    def __init__(self, count: int, read: Callable[[int], Points]) -> None:
        """Take how many frames there are, and what reads one."""
        self._count, self._read = count, read
        self._kept: OrderedDict[int, Seen] = OrderedDict()
        self._counts: dict[int, int] = {}

    def __len__(self) -> int:
        """Return how many frames there are."""
        return self._count

    @overload
    def __getitem__(self, number: int) -> Seen: ...

    @overload
    def __getitem__(self, number: slice) -> list[Seen]: ...

    def __getitem__(self, number: int | slice) -> Seen | list[Seen]:
        """Return the particles of a frame."""
        if isinstance(number, slice):
            return [self[each] for each in range(self._count)[number]]
        if number not in self._kept:
            self._kept[number] = seen_in(self._read(range(self._count)[number]))
            self._counts[number] = len(self._kept[number])
            if len(self._kept) > KEPT_FRAMES:
                self._kept.popitem(last=False)
        return self._kept[number]

    def particles(self, number: int) -> int:
        """Return how many particles a frame has."""
        return self._counts[number] if number in self._counts else len(self[number])


@contextmanager
def stored_tracks(
    frames: SeenFrames,
    reference: Reference,
    settings: Config,
    chosen: Tracking,
    provenance: Mapping[str, Any],
    folder: Path,
    found: Trajectories | None = None,
) -> Iterator[TracksOf[StoredTracks]]:
    """Yield the tracks of a sequence, whose places lie in a folder for as long; as `tracked` in memory.

    Raises
    ------
    OutputError : there is no room in the folder
    """
    sequence = sequence_of(frames, chosen, found)
    with TrackStore(folder) as store:
        for number in range(len(frames)):
            store.put(sequence.at(number))
        points = StoredTracks(store, reference, chosen.attributes(reference), dict(provenance))
        yield TracksOf(points, TRAJECTORIES_FORMAT, sequence.paths, sequence.summary(), settings)
