"""The tracks of a sequence, a frame at a time: their states at each frame, and half-way between two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.particle_file import POSITION
from lfpiv_cli.flow.field import MM_TO_M
from lfpiv_cli.flow.from_tracks import Paths
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.in_time import Scatter
from lfpiv_cli.tracks.sequences import scatter_in, states_at
from lfpiv_cli.tracks.trajectories import Trajectories


@dataclass(frozen=True, eq=False)
class SequenceTracks:
    """Tracks through frames, whose states are computed when they are asked for.

    Attributes
    ----------
    found : which particles belong together
    frames : the particles
    dt_s : time from one frame to the next
    scatter, half_frames : what all tracks have in common, and how many frames on either side of a time tell a state
    """

    found: Trajectories
    frames: Sequence[Seen]
    dt_s: float
    scatter: Scatter
    half_frames: int

    @classmethod
    def of(cls, found: Trajectories, frames: Sequence[Seen], dt_s: float) -> SequenceTracks:
        """Return the tracks that were found in frames."""
        return cls(found, frames, dt_s, *scatter_in(found, frames))

    def at(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the places of tracks in a frame, in the order of tracks, as the arrays of a file by name."""
        tracks, state = states_at(self.found, self.frames, float(number), self.scatter, self.half_frames)
        particle = self.found.particles(number, tracks)
        return {
            POSITION: state.position_mm,
            "velocity": state.velocity * MM_TO_M / self.dt_s,
            "velocity_sigma": state.velocity_sigma * MM_TO_M / self.dt_s,
            "track": tracks,
            "frame": np.full(len(tracks), number),
            "particle": particle,
            "link_probability": self.found.probability[number][particle],
        }

    def by_track(self) -> dict[str, NDArray[Any]]:
        """Return the places in all frames, by track, then by frame; no array is held twice."""
        lengths = self.found.lengths()
        following, count = np.cumsum(lengths) - lengths, int(lengths.sum())
        arrays: dict[str, NDArray[Any]] = {}
        for number in range(len(self.frames)):
            places = self.at(number)
            rows = following[places["track"]]
            following[places["track"]] += 1
            for name, array in places.items():
                if name not in arrays:
                    arrays[name] = np.empty((count, *array.shape[1:]), array.dtype)
                arrays[name][rows] = array
        return arrays

    @property
    def paths(self) -> Sequence[Paths]:
        """The tracks that pass from each frame to the next."""
        return _Paths(self)

    def summary(self) -> dict[str, Any]:
        """Return counts and figures, units in their names."""
        scatter = self.scatter
        acceleration = np.sqrt(scatter.bending) * MM_TO_M / self.dt_s**2
        return {
            "frames": len(self.frames),
            "particles": sum(len(labels) for labels in self.found.labels),
            "tracked": int(self.found.lengths().sum()),
            "tracks": self.found.count,
            "expected_wrong_links": self.found.expected_wrong_links(),
            "noise_over_stated": scatter.noise.tolist() if scatter.noise_known else None,
            "acceleration_m_s2": acceleration.tolist() if scatter.bending_known else None,
        }


class _Paths(Sequence[Paths]):
    """The paths of tracks in each interval between frames, one computed at a time."""

    def __init__(self, tracks: SequenceTracks) -> None:
        self._tracks = tracks

    def __len__(self) -> int:
        return len(self._tracks.frames) - 1

    @overload
    def __getitem__(self, number: int) -> Paths: ...

    @overload
    def __getitem__(self, number: slice) -> list[Paths]: ...

    def __getitem__(self, number: int | slice) -> Paths | list[Paths]:
        if isinstance(number, slice):
            return [self[each] for each in range(len(self))[number]]
        tracks, time = self._tracks, range(len(self))[number] + 0.5
        state = states_at(tracks.found, tracks.frames, time, tracks.scatter, tracks.half_frames)[1]
        return Paths(state.position_mm, state.velocity, state.velocity_sigma)
