"""Material acceleration: the second derivative of trajectories at one time, with its covariance.

A parabola through several places is wrong by what the fourth derivative makes of it, a quartic has four times a
parabola's noise. How large third and fourth derivatives are is a property of the flow and is taken from all tracks;
each track's are drawn to zero as far as derivatives of that size are what noise makes. What is left out is alike among
neighbours, noise is not: a fit to many tracks lessens noise alone, so that derivatives are drawn to zero less than
would be best for one track.

Axes: places (n, m, 3) in mm of n tracks in m frames, NaN where a track has none; times in frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.trajectories import NO_TRACK, Trajectories

Floats = NDArray[np.float64]

# 1, t, t^2/2, t^3/6, t^4/24; the first three are whatever the places say.
TERMS, FREE_TERMS = 5, 3
SECOND = 2
# Frames on either side of a time: over seven places a quartic has a fourth of the noise that it has over five.
HALF_FRAMES = 3
# With fewer tracks no derivatives beyond the second are told from noise.
FEWEST_TRACKS = 30
# Tracks of which the most are looked at for what all have in common.
MOST_TRACKS = 10000
# The standard error of the square of a spread by its median, times the root of the number: derivatives that do not show
# may be as large as this lets them be.
SPREAD_ERROR = 2.33
# Tracks of a fit to many whose errors of noise are averaged, while those of neglected derivatives are not.
AVERAGED_TRACKS = 30.0
# No derivative is known to be smaller than so many mm per frame^3 or frame^4, squared; it keeps equations finite.
SMALLEST_VARIANCE = 1e-16


@dataclass(frozen=True, eq=False)
class Bends:
    """What all tracks have in common, by component.

    Attributes
    ----------
    noise : (3,) how large errors of places are over the stated ones
    variance : (2, 3) of the third and fourth derivatives, mm^2 per frame^6 and frame^8
    """

    noise: Floats
    variance: Floats


@dataclass(frozen=True, eq=False)
class Motion:
    """Tracks at one time.

    Attributes
    ----------
    position_mm, velocity, acceleration : (n, 3), mm, mm per frame and mm per frame^2
    covariance : (n, 3, 3) of the acceleration
    neglected : (n, 3) what fourth derivatives of the size that tracks have make of the acceleration; neighbours are
        wrong alike
    """

    position_mm: Floats
    velocity: Floats
    acceleration: Floats
    covariance: Floats
    neglected: Floats


def motions_at(
    found: Trajectories, frames: Sequence[Seen], frame: int, bends: Bends
) -> tuple[NDArray[np.int64], Motion]:
    """Return the tracks that have a place in a frame and two more in the window about it, and their motion there."""
    numbers = found.labels[frame]
    numbers = np.unique(numbers[numbers != NO_TRACK])
    window = _window(frame, len(frames))
    position, covariance = places(found, frames, window, numbers)
    enough = np.isfinite(position[..., 0]).sum(axis=1) >= FREE_TERMS
    time = np.array(window, dtype=np.float64) - frame
    return numbers[enough], motion_of(position[enough], covariance[enough], time, bends)


def _window(frame: int, frames: int) -> list[int]:
    return [k for k in range(frame - HALF_FRAMES, frame + HALF_FRAMES + 1) if 0 <= k < frames]


def bends_in(found: Trajectories, frames: Sequence[Seen]) -> Bends | None:
    """Return what the tracks of a sequence have in common; None where too few are long enough to tell."""
    windows = [_window(frame, len(frames)) for frame in _middles(len(frames))]
    share = MOST_TRACKS // len(windows)
    told: list[tuple[Floats, Floats, Floats]] = []
    for window in windows:
        numbers = found.labels[window[0]]
        numbers = np.unique(numbers[numbers != NO_TRACK])
        for frame in window[1:]:
            numbers = np.intersect1d(numbers, found.labels[frame])
        position, covariance = places(found, frames, window, numbers[:: max(1, len(numbers) // max(share, 1))])
        told.append((position, covariance, np.array(window, dtype=np.float64) - window[len(window) // 2]))
    position, covariance = (np.concatenate([each[k] for each in told]) for k in range(2))
    known = np.isfinite(position).all(axis=(1, 2))
    return bends_of(position[known], covariance[known], told[0][2])


def _middles(frames: int) -> list[int]:
    """Return the middles of windows that do not overlap."""
    width = min(2 * HALF_FRAMES + 1, frames)
    return list(range(width // 2, frames - (width - 1) // 2, width))


def places(
    found: Trajectories, frames: Sequence[Seen], window: Sequence[int], tracks: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Return places (n, m, 3) of tracks in the frames of a window, and their covariances (n, m, 3, 3).

    They are NaN where a track has none, or none whose errors are known; the covariances are 1 there.
    """
    position = np.full((len(tracks), len(window), 3), np.nan)
    covariance = np.broadcast_to(np.eye(3), (len(tracks), len(window), 3, 3)).copy()
    for column, frame in enumerate(window):
        place = found.particles(frame, tracks)
        stated = whole(frames[frame].covariance()[place])
        there = (place >= 0) & (np.linalg.eigvalsh(stated)[:, 0] > 0.0)
        position[there, column] = frames[frame].position_mm[place[there]]
        covariance[there, column] = stated[there]
    return position, covariance


def whole(six: Floats) -> Floats:
    """Return matrices (n, 3, 3) of their elements (n, 6): xx, yy, zz, xy, yz, xz."""
    return np.asarray(six[:, [0, 3, 5, 3, 1, 4, 5, 4, 2]].reshape(-1, 3, 3))


def six_of(matrices: Floats) -> Floats:
    """Return the elements (n, 6) of symmetric matrices (n, 3, 3): xx, yy, zz, xy, yz, xz."""
    return np.asarray(matrices[:, [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]])


def motion_of(position_mm: Floats, covariance_mm2: Floats, time: Floats, bends: Bends) -> Motion:
    """Return place, velocity and acceleration at time 0 of tracks with three places at least.

    Parameters
    ----------
    position_mm, covariance_mm2 : (n, m, 3) and (n, m, 3, 3), as stated
    time : (m,) of the frames
    """
    stated = covariance_mm2 * np.outer(bends.noise, bends.noise)
    solution, covariance = _polynomial(position_mm, stated, time, AVERAGED_TRACKS * bends.variance)
    fourth = np.where(np.isfinite(position_mm), _terms(time)[:, -1:] * np.sqrt(bends.variance[-1]), np.nan)
    neglected = _polynomial(fourth, stated, time, AVERAGED_TRACKS * bends.variance)[0][:, SECOND]
    return Motion(solution[:, 0], solution[:, 1], solution[:, SECOND], covariance[:, SECOND, :, SECOND], neglected)


def bends_of(position_mm: Floats, covariance_mm2: Floats, time: Floats) -> Bends | None:
    """Return noise and higher derivatives of tracks that have all places; None where these are too few to tell.

    Scatter beyond the fits' own errors is the derivatives'; that of the residuals shows the noise.
    """
    if len(position_mm) < FEWEST_TRACKS or len(time) < TERMS:
        return None
    solution, covariance = _polynomial(position_mm, covariance_mm2, time, np.full((TERMS - FREE_TERMS, 3), np.inf))
    noise2, freedom = np.ones(3), len(time) - TERMS
    if freedom:
        left = position_mm - np.einsum("mi,nia->nma", _terms(time), solution)
        stated = np.diagonal(covariance_mm2, axis1=-2, axis2=-1)
        # The median of chi-squared.
        noise2 = np.median(np.sum(left**2 / stated, axis=1), axis=0) / (2.0 * gammaincinv(0.5 * freedom, 0.5))
    variance = np.empty((TERMS - FREE_TERMS, 3))
    for row, term in enumerate(range(FREE_TERMS, TERMS)):
        of_noise = noise2 * np.diagonal(covariance[:, term, :, term], axis1=-2, axis2=-1)
        spread = MAD_TO_SIGMA * np.median(np.abs(solution[:, term]) / np.sqrt(of_noise), axis=0)
        unseen = SPREAD_ERROR / np.sqrt(len(solution)) * spread**2
        variance[row] = (np.maximum(spread**2 - 1.0, 0.0) + unseen) * np.median(of_noise, axis=0)
    return Bends(np.sqrt(noise2), variance)


def _terms(time: Floats) -> Floats:
    return np.stack([time**power / factorial(power) for power in range(TERMS)], axis=1)


def _polynomial(position_mm: Floats, covariance_mm2: Floats, time: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives (n, 5, 3) at time 0, and their covariances (n, 5, 3, 5, 3).

    `variance` : (2, 3) that is expected of the third and fourth ones
    """
    terms, known = _terms(time), np.isfinite(position_mm[..., 0])
    weight = known[..., np.newaxis, np.newaxis] * np.linalg.inv(covariance_mm2)
    matrix = np.einsum("nmab,mi,mj->niajb", weight, terms, terms, optimize=True)
    for row, term in enumerate(range(FREE_TERMS, TERMS)):
        for axis in range(3):
            matrix[:, term, axis, term, axis] += 1.0 / max(variance[row, axis], SMALLEST_VARIANCE)
    size = 3 * TERMS
    covariance = _inverse(matrix.reshape(-1, size, size))
    weighted = np.einsum("nmab,nmb->nma", weight, np.where(known[..., np.newaxis], position_mm, 0.0))
    right = np.einsum("mi,nma->nia", terms, weighted).reshape(-1, size)
    solution = np.einsum("nij,nj->ni", covariance, right)
    return solution.reshape(-1, TERMS, 3), covariance.reshape(-1, TERMS, 3, TERMS, 3)


def _inverse(matrices: Floats) -> Floats:
    """Return the inverses of positive definite matrices (n, k, k), with ones on the diagonals in between."""
    scale = 1.0 / np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1))
    both = scale[:, :, np.newaxis] * scale[:, np.newaxis]
    return np.asarray(np.linalg.inv(matrices * both) * both)
