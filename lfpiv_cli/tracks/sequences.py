"""Lagrangian particle tracking over many frames: a trajectory's own past and its neighbours predict each link.

What is no particle does not move with the others for long: a ghost finds a partner in the next frame by chance, hardly
in the one after it where its past says it should be. Tracks that are short are therefore dropped. A particle that one
frame has lost is sought in the next where its track would have come to.

Axes: places (n, 3) in mm of each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.scale import Scale
from lfpiv_cli.tracks.in_time import Scatter, State, fit_in_time, scatter_of
from lfpiv_cli.tracks.tracking import Forecast, expected_displacement, gate_mm, mutual, track

# A forecast takes a track's last four places: enough for a parabola and to see its noise.
PAST_FRAMES = 4
# A velocity takes the places of three frames on either side, or of two, if what three leave is larger than the noise
# that two show by more than this: a parabola then no longer follows the tracks.
HALVES_FRAMES = (3, 2)
LARGEST_MISFIT = 1.1
# A ghost finds a partner in the next frame by chance, hardly ever in two.
SHORTEST = 3
NO_TRACK = -1

Frames = Sequence[NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Which particles of a sequence belong together.

    Attributes
    ----------
    labels : for each frame (n,) the number of each particle's track, `NO_TRACK` for none
    count : of tracks
    """

    labels: tuple[NDArray[np.int64], ...]
    count: int

    def particles(self, frame: int, tracks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of the particles in a frame that tracks have there, -1 for none."""
        labels = self.labels[frame]
        place = np.full(self.count, -1)
        place[labels[labels != NO_TRACK]] = np.flatnonzero(labels != NO_TRACK)
        return np.asarray(place[tracks])


def follow(points: Frames, sigma_mm: Frames, search_mm: float, shortest: int, scale: Scale) -> Trajectories:
    """Follow particles through frames; tracks of fewer than `shortest` places are dropped.

    Parameters
    ----------
    points, sigma_mm : for each frame (n, 3) places and their standard errors, mm
    search_mm : largest displacement along each axis from the first frame to the second
    scale : of the camera
    """
    found = Trajectories(tuple(np.full(len(frame), NO_TRACK) for frame in points), 0)
    scatter = Scatter.unknown()
    for number in range(len(points) - 1):
        forecast = _forecast(found, points, sigma_mm, number, 1, scatter)
        links = track(points[number], points[number + 1], search_mm, scale, forecast)
        found = _linked(found, number, links.first, number + 1, links.second)
        if number:
            found = _linked(found, *_bridges(found, points, sigma_mm, number, scatter, search_mm, scale))
        window = _frames_before(number + 2, PAST_FRAMES)
        position, sigma = _places(found, points, sigma_mm, window, np.arange(found.count))
        scatter = scatter_of(position, sigma, np.arange(len(window), dtype=np.float64))
    return _long_ones(found, shortest)


def scatter_in(found: Trajectories, points: Frames, sigma_mm: Frames) -> tuple[Scatter, int]:
    """Return noise and bending of the tracks of a sequence, and how many frames on either side of a time to take."""
    wide, narrow = (_scatter_of_windows(found, points, sigma_mm, 2 * half + 1) for half in HALVES_FRAMES)
    is_followed = np.all(wide.noise <= LARGEST_MISFIT * narrow.noise)
    return (wide, HALVES_FRAMES[0]) if is_followed else (narrow, HALVES_FRAMES[1])


def _scatter_of_windows(found: Trajectories, points: Frames, sigma_mm: Frames, width: int) -> Scatter:
    """Return noise and bending of the tracks in windows of so many frames that do not overlap."""
    windows = [_frames_before(end, width) for end in range(min(width, len(points)), len(points) + 1, width)]
    pieces = [_places(found, points, sigma_mm, window, np.arange(found.count)) for window in windows]
    position, sigma = (np.concatenate(pair) for pair in zip(*pieces, strict=True))
    return scatter_of(position, sigma, np.arange(position.shape[1], dtype=np.float64))


def states_at(
    found: Trajectories, points: Frames, sigma_mm: Frames, time: float, scatter: Scatter, half_frames: int
) -> tuple[NDArray[np.int64], State]:
    """Return the tracks that pass a time, given in frames, and their states then.

    Half-way between two frames these are the tracks with a place before and one after, at most two frames apart, and
    the places of so many frames on either side are taken; at a frame, besides, its own.
    """
    before, after = int(np.floor(time)), int(np.ceil(time))
    present = [
        set(found.labels[k].tolist()) - {NO_TRACK} if 0 <= k < len(points) else set()
        for k in (before - 1, before, after, after + 1)
    ]
    passing = present[1] if before == after else (present[0] | present[1]) & (present[2] | present[3])
    numbers = np.array(sorted(passing), dtype=np.int64)
    window = [k for k in range(int(np.ceil(time - half_frames)), int(time + half_frames) + 1) if 0 <= k < len(points)]
    position, sigma = _places(found, points, sigma_mm, window, numbers)
    return numbers, fit_in_time(position, sigma, np.array(window) - time, scatter)


def _frames_before(end: int, count: int) -> list[int]:
    return list(range(max(0, end - count), end))


def _places(
    found: Trajectories, points: Frames, sigma_mm: Frames, window: Sequence[int], tracks: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places and standard errors (n, m, 3) of tracks in the frames of a window; NaN where there are none."""
    position, sigma = (np.full((len(tracks), len(window), 3), np.nan) for _ in range(2))
    for column, frame in enumerate(window):
        place = found.particles(frame, tracks)
        there = place >= 0
        position[there, column] = points[frame][place[there]]
        sigma[there, column] = sigma_mm[frame][place[there]]
    return position, sigma


def _forecast(
    found: Trajectories, points: Frames, sigma_mm: Frames, number: int, ahead: int, scatter: Scatter
) -> Forecast | None:
    """Return where the particles of a frame with a past will have moved so many frames later."""
    tracked = np.flatnonzero(found.labels[number] != NO_TRACK)
    window = _frames_before(number + 1, PAST_FRAMES)
    position, sigma = _places(found, points, sigma_mm, window, found.labels[number][tracked])
    has_past = np.isfinite(position[..., 0]).sum(axis=1) > 1
    if not has_past.any():
        return None
    tracked = tracked[has_past]
    state = fit_in_time(position[has_past], sigma[has_past], np.array(window) - float(number + ahead), scatter)
    displacement, error = (np.full(points[number].shape, np.nan) for _ in range(2))
    displacement[tracked] = state.position_mm - points[number][tracked]
    error[tracked] = state.position_sigma
    return Forecast(displacement, error)


def _linked(
    found: Trajectories, start: int, first: NDArray[np.int64], end: int, second: NDArray[np.int64]
) -> Trajectories:
    """Return the trajectories with particles of one frame linked to those of a later one."""
    labels = list(found.labels)
    labels[start], labels[end] = labels[start].copy(), labels[end].copy()
    begun = first[labels[start][first] == NO_TRACK]
    labels[start][begun] = found.count + np.arange(len(begun))
    labels[end][second] = labels[start][first]
    return Trajectories(tuple(labels), found.count + len(begun))


def _bridges(
    found: Trajectories,
    points: Frames,
    sigma_mm: Frames,
    lost_in: int,
    scatter: Scatter,
    search_mm: float,
    scale: Scale,
) -> tuple[int, NDArray[np.int64], int, NDArray[np.int64]]:
    """Return links over a frame in which a track has no particle: frames and particles of both ends."""
    start, end = lost_in - 1, lost_in + 1
    labels = found.labels[start]
    later = found.particles(end, labels) if found.count else np.full(len(labels), -1)
    later[labels == NO_TRACK] = -1
    through = later >= 0
    none = np.zeros(0, dtype=np.int64)
    forecast = _forecast(found, points, sigma_mm, start, 2, scatter)
    if forecast is None:
        return start, none, end, none
    displacement = np.full(points[start].shape, np.nan)
    displacement[through] = points[end][later[through]] - points[start][through]
    expected = expected_displacement(points[start], displacement, scale, forecast)
    lost = np.flatnonzero((labels != NO_TRACK) & (found.particles(lost_in, labels) < 0))
    free = np.flatnonzero(found.labels[end] == NO_TRACK)
    if not lost.size or not free.size:
        return start, none, end, none
    gate = gate_mm(displacement - expected, search_mm, scale)
    first, second = mutual((points[start] + expected)[lost], points[end][free], gate, scale)
    return start, lost[first], end, free[second]


def _long_ones(found: Trajectories, shortest: int) -> Trajectories:
    """Return the tracks with so many places at least, numbered anew in the order of their first frames."""
    every = np.concatenate([labels[labels != NO_TRACK] for labels in found.labels])
    is_long = np.bincount(every, minlength=found.count) >= shortest
    number = np.where(is_long, np.cumsum(is_long) - 1, NO_TRACK)
    labels = tuple(np.where(old == NO_TRACK, NO_TRACK, np.append(number, NO_TRACK)[old]) for old in found.labels)
    return Trajectories(labels, int(is_long.sum()))
