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
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.in_time import Scatter, State, fit_in_time, scatter_of
from lfpiv_cli.tracks.tracking import NO_TRACKS, Forecast, Tracks, known_of, link_some, track

# A forecast takes a track's last four places: enough for a parabola and to see its noise.
PAST_FRAMES = 4
# A velocity takes the places of three frames on either side, or of two, if what three leave is larger than the noise
# that two show by more than this: a parabola then no longer follows the tracks.
HALVES_FRAMES = (3, 2)
LARGEST_MISFIT = 1.1
# A ghost finds a partner in the next frame by chance, hardly ever in two.
SHORTEST = 3
NO_TRACK = NO_PARTICLE = -1

Frames = Sequence[Seen]


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


def follow(frames: Frames, search_mm: float, shortest: int, scale: Scale) -> Trajectories:
    """Follow particles through frames; tracks of fewer than `shortest` places are dropped.

    Parameters
    ----------
    search_mm : largest displacement along each axis from the first frame to the second
    scale : of the camera
    """
    unknown = tuple(np.full(len(frame), np.nan) for frame in frames)
    found = Trajectories(tuple(np.full(len(frame), NO_TRACK) for frame in frames), 0, unknown)
    scatter = Scatter.unknown()
    for number in range(len(frames) - 1):
        forecast = _forecast(found, frames, number, 1, scatter)
        links = track(frames[number], frames[number + 1], search_mm, scale, forecast)
        found = _linked(found, number, number + 1, links)
        if number:
            found = _linked(found, number - 1, number + 1, _bridges(found, frames, number, scatter, search_mm, scale))
        window = _frames_before(number + 2, PAST_FRAMES)
        position, sigma = _places(found, frames, window, np.arange(found.count))
        scatter = scatter_of(position, sigma, np.arange(len(window), dtype=np.float64))
    return _long_ones(found, shortest)


def scatter_in(found: Trajectories, frames: Frames) -> tuple[Scatter, int]:
    """Return noise and bending of the tracks of a sequence, and how many frames on either side of a time to take."""
    wide, narrow = (_scatter_of_windows(found, frames, 2 * half + 1) for half in HALVES_FRAMES)
    is_followed = np.all(wide.noise <= LARGEST_MISFIT * narrow.noise)
    return (wide, HALVES_FRAMES[0]) if is_followed else (narrow, HALVES_FRAMES[1])


def _scatter_of_windows(found: Trajectories, frames: Frames, width: int) -> Scatter:
    """Return noise and bending of the tracks in windows of so many frames that do not overlap."""
    windows = [_frames_before(end, width) for end in range(min(width, len(frames)), len(frames) + 1, width)]
    pieces = [_places(found, frames, window, np.arange(found.count)) for window in windows]
    position, sigma = (np.concatenate(pair) for pair in zip(*pieces, strict=True))
    return scatter_of(position, sigma, np.arange(position.shape[1], dtype=np.float64))


def states_at(
    found: Trajectories, frames: Frames, time: float, scatter: Scatter, half_frames: int
) -> tuple[NDArray[np.int64], State]:
    """Return the tracks that pass a time, given in frames, and their states then.

    Half-way between two frames these are the tracks with a place before and one after, at most two frames apart, and
    the places of so many frames on either side are taken; at a frame, besides, its own.
    """
    before, after = int(np.floor(time)), int(np.ceil(time))
    present = [
        set(found.labels[k].tolist()) - {NO_TRACK} if 0 <= k < len(frames) else set()
        for k in (before - 1, before, after, after + 1)
    ]
    passing = present[1] if before == after else (present[0] | present[1]) & (present[2] | present[3])
    numbers = np.array(sorted(passing), dtype=np.int64)
    window = [k for k in range(int(np.ceil(time - half_frames)), int(time + half_frames) + 1) if 0 <= k < len(frames)]
    position, sigma = _places(found, frames, window, numbers)
    return numbers, fit_in_time(position, sigma, np.array(window) - time, scatter)


def _frames_before(end: int, count: int) -> list[int]:
    return list(range(max(0, end - count), end))


def _places(
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


def _forecast(found: Trajectories, frames: Frames, number: int, ahead: int, scatter: Scatter) -> Forecast | None:
    """Return where the particles of a frame with a past will have moved so many frames later."""
    points, tracked = frames[number].position_mm, np.flatnonzero(found.labels[number] != NO_TRACK)
    window = _frames_before(number + 1, PAST_FRAMES)
    position, sigma = _places(found, frames, window, found.labels[number][tracked])
    has_past = np.isfinite(position[..., 0]).sum(axis=1) > 1
    if not has_past.any():
        return None
    tracked = tracked[has_past]
    state = fit_in_time(position[has_past], sigma[has_past], np.array(window) - float(number + ahead), scatter)
    displacement, error = (np.full(points.shape, np.nan) for _ in range(2))
    displacement[tracked] = state.position_mm - points[tracked]
    error[tracked] = state.position_sigma
    return Forecast(displacement, error)


def _linked(found: Trajectories, start: int, end: int, links: Tracks) -> Trajectories:
    """Return the trajectories with particles of one frame linked to those of a later one."""
    labels, probability = list(found.labels), list(found.probability)
    labels[start], labels[end], probability[end] = labels[start].copy(), labels[end].copy(), probability[end].copy()
    begun = links.first[labels[start][links.first] == NO_TRACK]
    labels[start][begun] = found.count + np.arange(len(begun))
    labels[end][links.second] = labels[start][links.first]
    probability[end][links.second] = links.probability
    return Trajectories(tuple(labels), found.count + len(begun), tuple(probability))


def _bridges(
    found: Trajectories, frames: Frames, lost_in: int, scatter: Scatter, search_mm: float, scale: Scale
) -> Tracks:
    """Return links over a frame in which tracks have no particle, from the frame before it to the one after."""
    start, end = lost_in - 1, lost_in + 1
    labels = found.labels[start]
    forecast = _forecast(found, frames, start, 2, scatter)
    if forecast is None:
        return NO_TRACKS
    tracked = labels != NO_TRACK
    lost = tracked & (found.particles(lost_in, labels) == NO_PARTICLE)
    later = np.where(tracked, found.particles(end, labels), NO_PARTICLE)
    through = np.flatnonzero(later != NO_PARTICLE)
    known = known_of(frames[start], frames[end], through, later[through], scale)
    free = found.labels[end] == NO_TRACK
    return link_some((frames[start], lost), (frames[end], free), known, search_mm, scale, forecast)


def _long_ones(found: Trajectories, shortest: int) -> Trajectories:
    """Return the tracks with so many places at least, numbered anew in the order of their first frames."""
    every = np.concatenate([labels[labels != NO_TRACK] for labels in found.labels])
    is_long = np.bincount(every, minlength=found.count) >= shortest
    number = np.where(is_long, np.cumsum(is_long) - 1, NO_TRACK)
    labels = tuple(np.where(old == NO_TRACK, NO_TRACK, np.append(number, NO_TRACK)[old]) for old in found.labels)
    probability = tuple(
        np.where(label == NO_TRACK, np.nan, each) for label, each in zip(labels, found.probability, strict=True)
    )
    return Trajectories(labels, int(is_long.sum()), probability)
