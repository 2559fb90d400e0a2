"""Which particles of a sequence belong together, and where the tracks so made have been.

Axes: places (n, 3) in mm of each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.tracks.candidates import Seen

NO_TRACK = NO_PARTICLE = -1


class Frames(Protocol):
    """Particles of frames by their numbers; those that are not asked for need not be there."""

    def __getitem__(self, number: int, /) -> Seen:
        """Return the particles of a frame."""


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Which particles of a sequence belong together.

    Attributes
    ----------
    labels : for each frame (n,) the number of each particle's track, `NO_TRACK` for none
    count : of tracks
    probability : for each frame (n,) that of the link by which a track has come to each particle; NaN where it begins
    """

    labels: tuple[NDArray[np.int64], ...]
    count: int
    probability: tuple[NDArray[np.float64], ...]

    def particles(self, frame: int, tracks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of the particles in a frame that tracks have there, `NO_PARTICLE` for none."""
        labels = self.labels[frame]
        place = np.full(self.count, NO_PARTICLE)
        place[labels[labels != NO_TRACK]] = np.flatnonzero(labels != NO_TRACK)
        return np.asarray(place[tracks])

    def lengths(self) -> NDArray[np.int64]:
        """Return how many places each track has."""
        counts = np.zeros(self.count, dtype=np.int64)
        for labels in self.labels:
            counts += np.bincount(labels[labels != NO_TRACK], minlength=self.count)
        return counts

    def expected_wrong_links(self) -> float:
        """Return how many links are wrong, by their probabilities."""
        wrong = np.empty(int(self.lengths().sum()))
        end = 0
        for labels, probability in zip(self.labels, self.probability, strict=True):
            tracked = np.flatnonzero(labels != NO_TRACK)
            end += len(tracked)
            # By track in each frame: the last bits of a sum are of the order.
            wrong[end - len(tracked) : end] = 1.0 - probability[tracked[np.argsort(labels[tracked])]]
        wrong[np.isnan(wrong)] = 0.0
        return float(np.sum(wrong))


def tracks_in(found: Trajectories, window: Sequence[int]) -> NDArray[np.int64]:
    """Return the numbers of the tracks that pass some frames."""
    numbers = np.unique(np.concatenate([found.labels[k] for k in window]))
    return numbers[numbers != NO_TRACK]


def places(
    found: Trajectories, frames: Frames, window: Sequence[int], tracks: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places and standard errors (n, m, 3) of tracks in the frames of a window; NaN where there are none."""
    position, sigma = (np.full((len(tracks), len(window), 3), np.nan) for _ in range(2))
    for column, frame in enumerate(window):
        place = found.particles(frame, tracks)
        there = place >= 0
        position[there, column] = frames[frame].position_mm[place[there]]
        sigma[there, column] = frames[frame].sigma_mm()[place[there]]
    return position, sigma


def long_ones(found: Trajectories, shortest: int) -> Trajectories:
    """Return the tracks with so many places at least, numbered anew in the order of their first frames."""
    is_long = found.lengths() >= shortest
    number = np.where(is_long, np.cumsum(is_long) - 1, NO_TRACK)
    number = np.append(number, NO_TRACK)
    labels = tuple(np.where(old == NO_TRACK, NO_TRACK, number[old]) for old in found.labels)
    probability = tuple(
        np.where(label == NO_TRACK, np.nan, each) for label, each in zip(labels, found.probability, strict=True)
    )
    return Trajectories(labels, int(is_long.sum()), probability)
