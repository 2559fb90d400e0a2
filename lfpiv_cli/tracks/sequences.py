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

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.grid import Scale
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.tracks.candidates import NO_PARTICLE, NO_TRACK, Frames, Seen, Trajectories, long_ones, places, tracks_in
from lfpiv_cli.tracks.gridding import kriged, structure_of
from lfpiv_cli.tracks.in_time import FEWEST_TRACKS, Scatter, State, fit_in_time, scatter_of
from lfpiv_cli.tracks.tracking import NO_TRACKS, Forecast, Tracks, known_of, link_some, reach_of, track

# A forecast takes a track's last four places: enough for a parabola and to see its noise.
PAST_FRAMES = 4
# A velocity takes the places of three frames on either side, or of two, if what three leave is larger than the noise
# that two show by more than this: a cubic then no longer follows the tracks.
HALVES_FRAMES = (3, 2)
LARGEST_MISFIT = 1.1
# Where a particle comes to is not known before how far it moves: the second guess is good enough.
REPEATS = 2
# A ghost finds a partner in the next frame by chance, hardly ever in two.
SHORTEST = 3


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where particles should be in a frame.

    Attributes
    ----------
    position_mm, sigma_mm : (n, 3) places and their standard errors; these are NaN where nothing tells
    light : (n,) as other frames have it
    light_sigma : of the logarithm of a particle's light from frame to frame
    """

    position_mm: Floats
    sigma_mm: Floats
    light: Floats
    light_sigma: float


@dataclass(frozen=True, eq=False)
class PartialTracks:
    """How far a sequence has been followed.

    Attributes
    ----------
    found : the trajectories up to the last frame that was linked
    scatter : of those that pass the last frames
    by_past, by_others : how the last frame's particles should move on by their own pasts, and as others did before
    ahead : where they should be by both, and then those that the last frame alone has lost
    """

    found: Trajectories
    scatter: Scatter
    by_past: Forecast | None
    by_others: Forecast | None
    ahead: Prediction

    @property
    def last(self) -> int:
        """The number of the frame that was linked last."""
        return len(self.found.labels) - 1


def follow(frames: Sequence[Seen], search_mm: float | None, shortest: int, scale: Scale) -> Trajectories:
    """Follow particles through frames; tracks of fewer than `shortest` places are dropped.

    Parameters
    ----------
    search_mm : largest displacement from the first frame to the second; None: any
    scale : of the camera
    """
    partial = begun(frames)
    while partial.last < len(frames) - 1:
        partial = extended(partial, frames, search_mm, scale)
    return long_ones(partial.found, shortest)


def begun(frames: Frames) -> PartialTracks:
    """Return what is known of the first frame alone: particles, and no tracks."""
    first = frames[0]
    unlinked = Trajectories((np.full(len(first), NO_TRACK),), 0, (np.full(len(first), np.nan),))
    unknown = np.full(first.position_mm.shape, np.nan)
    nothing = Prediction(first.position_mm, unknown, first.light_value(), 0.0)
    return PartialTracks(unlinked, Scatter.unknown(), None, None, nothing)


def extended(partial: PartialTracks, frames: Frames, search_mm: float | None, scale: Scale) -> PartialTracks:
    """Return how far it is with one more frame; of `frames` only the new one and the last few before are looked at."""
    number, count = partial.last, len(frames[partial.last + 1])
    found = Trajectories(
        (*partial.found.labels, np.full(count, NO_TRACK)),
        partial.found.count,
        (*partial.found.probability, np.full(count, np.nan)),
    )
    start, end = frames[number], frames[number + 1]
    ahead, own = partial.ahead, slice(0, len(start))
    known = np.isfinite(ahead.sigma_mm[own])
    moved = ahead.position_mm[own] - start.position_mm + np.where(known, 0.0, np.nan)
    links = track(start, end, scale, search_mm, Forecast(moved, ahead.sigma_mm[own]) if known.any() else None)
    found = _linked(found, number, number + 1, links)
    if number:
        earlier = _forecast(found, frames, number - 1, 2, partial.scatter)
        found = _linked(
            found, number - 1, number + 1, _bridges(found, frames, number, earlier, reach_of(scale, search_mm), scale)
        )
    window = _frames_before(number + 2, PAST_FRAMES)
    position, sigma = places(found, frames, window, tracks_in(found, window))
    scatter = scatter_of([(position, sigma)], np.arange(len(window), dtype=np.float64))
    past_factor, others_factor = (
        _residual_factor(start, end, links, each) for each in (partial.by_past, partial.by_others)
    )
    by_past, by_others = _forecast(found, frames, number + 1, 1, scatter), _by_others(found, frames)
    # By both; where others are not known, the past is all there is.
    forecast = past = _widened(by_past, past_factor)
    if by_others is not None:
        variance = (by_others.sigma_mm * (1.0 if others_factor is None else others_factor)) ** 2
        forecast = Forecast(by_others.displacement_mm, np.sqrt(variance))
        if past is not None:
            past2 = past.sigma_mm**2
            weight = np.where(np.isfinite(past2), variance / (variance + past2), 0.0)
            off = np.nan_to_num(past.displacement_mm - by_others.displacement_mm)
            forecast = Forecast(by_others.displacement_mm + weight * off, np.sqrt((1.0 - weight) * variance))
    over_two = _widened(_forecast(found, frames, number, 2, scatter), past_factor)
    return PartialTracks(found, scatter, by_past, by_others, _ahead(found, frames, forecast, over_two))


def _residual_factor(first: Seen, second: Seen, links: Tracks, forecast: Forecast | None) -> Floats | None:
    """Return how large errors (3,) of a forecast are over what is expected of them, at least 1; None: not known.

    Few frames know little of how tracks bend, and a parabola nothing of how their bending changes.
    """
    if forecast is None:
        return None
    off = second.position_mm[links.second] - first.position_mm[links.first] - forecast.displacement_mm[links.first]
    noise = np.nan_to_num(second.sigma_mm()[links.second])
    known = np.isfinite(off).all(axis=1)
    if np.count_nonzero(known) < FEWEST_TRACKS:
        return None
    ratio = np.abs(off[known]) / np.hypot(forecast.sigma_mm[links.first][known], noise[known])
    return np.maximum(MAD_TO_SIGMA * np.median(ratio, axis=0), 1.0)


def _widened(forecast: Forecast | None, factor: Floats | None) -> Forecast | None:
    """Return a forecast with so much larger errors; None where there is none, or its errors are not known."""
    if forecast is None or factor is None:
        return None
    return Forecast(forecast.displacement_mm, forecast.sigma_mm * factor)


def _ahead(found: Trajectories, frames: Frames, forecast: Forecast | None, over_two: Forecast | None) -> Prediction:
    """Return where the particles of the last frame should be in the next one, and those that it alone has lost.

    Parameters
    ----------
    forecast : of the last frame's particles
    over_two : of those of the frame before it, two frames later
    """
    last = len(found.labels) - 1
    at, light = frames[last].position_mm, frames[last].light_value()
    if forecast is None:
        forecast = Forecast(np.zeros(at.shape), np.full(at.shape, np.nan))
    at, sigma = at + np.nan_to_num(forecast.displacement_mm), forecast.sigma_mm
    if over_two is not None:
        before = found.labels[last - 1]
        lost = (before != NO_TRACK) & (found.particles(last, before) == NO_PARTICLE)
        lost &= np.isfinite(over_two.sigma_mm).all(axis=1)
        at = np.concatenate([at, (frames[last - 1].position_mm + over_two.displacement_mm)[lost]])
        sigma = np.concatenate([sigma, over_two.sigma_mm[lost]])
        light = np.concatenate([light, frames[last - 1].light_value()[lost]])
    # The spread of the logarithm of a particle's light from frame to frame, by tracks through the last two.
    numbers, light_sigma = (last - 1, last), 0.0
    tracks = np.intersect1d(tracks_in(found, [numbers[0]]), tracks_in(found, [numbers[1]]))
    earlier, now = (frames[k].light_value()[found.particles(k, tracks)] for k in numbers)
    lit = (earlier > 0.0) & (now > 0.0)
    if lit.any():
        ratio = np.log(now[lit] / earlier[lit])
        light_sigma = float(MAD_TO_SIGMA * np.median(np.abs(ratio - np.median(ratio))))
    return Prediction(at, sigma, light, light_sigma)


def _by_others(found: Trajectories, frames: Frames) -> Forecast | None:
    """Return how the last frame's particles should move on: as those did just before that were where they come to."""
    last = len(found.labels) - 1
    tracks = np.intersect1d(tracks_in(found, [last - 1]), tracks_in(found, [last]))
    if len(tracks) < 2:
        return None
    at = frames[last].position_mm
    position, sigma = places(found, frames, [last - 1, last], tracks)
    moved, noise2 = position[:, 1] - position[:, 0], np.nan_to_num(np.sum(sigma**2, axis=1))
    middle, structure = position.mean(axis=1), structure_of(position.mean(axis=1), moved, noise2)
    nobody, displacement = np.full(len(at), -1), np.zeros_like(at)
    displacement[found.particles(last, tracks)] = moved
    for _ in range(REPEATS):
        displacement, variance = kriged(at + 0.5 * displacement, nobody, middle, moved, noise2, structure)
    return Forecast(displacement, np.sqrt(variance + np.median(noise2, axis=0) + 0.5 * structure.nugget))


def scatter_in(found: Trajectories, frames: Sequence[Seen]) -> tuple[Scatter, int]:
    """Return noise and bending of the tracks of a sequence, and how many frames on either side of a time to take."""
    reported = []
    for width in (2 * half + 1 for half in HALVES_FRAMES):
        # Windows of so many frames that do not overlap.
        windows = [_frames_before(end, width) for end in range(min(width, len(frames)), len(frames) + 1, width)]
        pieces = (places(found, frames, window, tracks_in(found, window)) for window in windows)
        reported.append(scatter_of(pieces, np.arange(len(windows[0]), dtype=np.float64)))
    wide, narrow = reported
    is_followed = np.all(wide.noise <= LARGEST_MISFIT * narrow.noise)
    return (wide, HALVES_FRAMES[0]) if is_followed else (narrow, HALVES_FRAMES[1])


def states_at(
    found: Trajectories, frames: Sequence[Seen], time: float, scatter: Scatter, half_frames: int
) -> tuple[Integers, State]:
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
    position, sigma = places(found, frames, window, numbers)
    return numbers, fit_in_time(position, sigma, np.array(window) - time, scatter)


def _frames_before(end: int, count: int) -> list[int]:
    return list(range(max(0, end - count), end))


def _forecast(found: Trajectories, frames: Frames, number: int, ahead: int, scatter: Scatter) -> Forecast | None:
    """Return where the particles of a frame with a past will have moved so many frames later."""
    points, tracked = frames[number].position_mm, np.flatnonzero(found.labels[number] != NO_TRACK)
    window = _frames_before(number + 1, PAST_FRAMES)
    position, sigma = places(found, frames, window, found.labels[number][tracked])
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
    found: Trajectories, frames: Frames, lost_in: int, forecast: Forecast | None, reach: Floats, scale: Scale
) -> Tracks:
    """Return links over a frame in which tracks have no particle, from the frame before it to the one after."""
    start, end = lost_in - 1, lost_in + 1
    labels = found.labels[start]
    if forecast is None:
        return NO_TRACKS
    tracked = labels != NO_TRACK
    lost = tracked & (found.particles(lost_in, labels) == NO_PARTICLE)
    later = np.where(tracked, found.particles(end, labels), NO_PARTICLE)
    through = np.flatnonzero(later != NO_PARTICLE)
    known = known_of(frames[start], frames[end], through, later[through], scale)
    free = found.labels[end] == NO_TRACK
    return link_some((frames[start], lost), (frames[end], free), known, reach, scale, forecast)


# Where particles should be in a frame by their tracks before and after it.
#
# Once a sequence has been followed, a frame is known from both sides: a particle that it has lost lies between two
# places of its track, and one whose track begins or ends beside it lies on the way on. As a Kalman smoother does
# after its filter, what comes later now counts as what came before.

# Frames on either side that are looked at: a cubic has a place or more to spare.
REACH_FRAMES = 3


def expected_in(found: Trajectories, frames: Frames, number: int) -> Prediction:
    """Return where the particles should be whose tracks have a place in a frame or in one beside it.

    A track's own place in the frame counts as its others do. Of `frames` only those within `REACH_FRAMES` are read.
    """
    window = [k for k in range(number - REACH_FRAMES, number + REACH_FRAMES + 1) if 0 <= k < len(found.labels)]
    tracks = tracks_in(found, [k for k in window if abs(k - number) <= 1])
    position, sigma = places(found, frames, window, tracks)
    known = np.isfinite(position[..., 0])
    reported = known.sum(axis=1) > 1
    tracks, position, sigma, known = tracks[reported], position[reported], sigma[reported], known[reported]
    time = np.array(window, dtype=np.float64) - number
    state = fit_in_time(position, sigma, time, scatter_of([(position, sigma)], time))
    light = np.full(known.shape, np.nan)
    for column, frame in enumerate(window):
        there = known[:, column]
        light[there, column] = np.log(frames[frame].light_value()[found.particles(frame, tracks)[there]])
    usual = np.nanmedian(light, axis=1) if len(tracks) else np.zeros(0)
    off = np.abs(light - usual[:, np.newaxis])[known]
    spread = MAD_TO_SIGMA * float(np.median(off)) if off.size else 0.0
    return Prediction(state.position_mm, state.position_sigma, np.exp(usual), spread)
