"""Trajectory fits: position and velocity by local polynomials in time, with the noise and the bending of trajectories.

A track is a cubic over a few frames. How large second and third derivatives are is a property of the flow, and is taken
from all tracks: each track's are drawn to zero as far as derivatives of that size are what noise makes, and what they
may be counts in its standard errors. In a straight flow the fit is a line. Without the third derivative velocities in
vortices that turn by a tenth of a circle over the frames of a fit are off by ten stated errors.

Axes: places (n, m, 3) in mm of n tracks in m frames, NaN where a track has none; times in frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np
from scipy.special import gammaincinv

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.tracks.candidates import Seen, Trajectories, tracks_in

# Material acceleration: the second derivative of trajectories at one time, with its covariance.
#
# A parabola through several places is wrong by what the fourth derivative makes of it, a quartic has four times a
# parabola's noise. How large third and fourth derivatives are is a property of the flow and is taken from all tracks;
# each track's are drawn to zero as far as derivatives of that size are what noise makes. What is left out is alike
# among neighbours, noise is not: a fit to many tracks lessens noise alone, so that derivatives are drawn to zero less
# than would be best for one track.

# 1, t, t^2/2, t^3/6, t^4/24; the first three are whatever the places say.
QUARTIC, FREE_OF_QUARTIC = 5, 3
SECOND = 2
# Frames on either side of a time: over seven places a quartic has a fourth of the noise that it has over five.
HALF_FRAMES = 3
# Tracks of which the most are looked at for what all have in common.
MOST_TRACKS = 10000
# Tracks of a fit to many whose errors of noise are averaged, while those of neglected derivatives are not.
AVERAGED_TRACKS = 30.0
# No derivative is known to be smaller than so many mm per frame^3 or frame^4, squared; it keeps equations finite.
SMALLEST_OF_QUARTIC = 1e-16


@dataclass(frozen=True, eq=False)
class HighDerivatives:
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
    found: Trajectories, frames: Sequence[Seen], frame: int, derivatives: HighDerivatives
) -> tuple[Integers, Motion]:
    """Return the tracks that have a place in a frame and two more in the window about it, and their motion there."""
    numbers, window = tracks_in(found, [frame]), _window(frame, len(frames))
    position, covariance = places_with_covariances(found, frames, window, numbers)
    enough = np.isfinite(position[..., 0]).sum(axis=1) >= FREE_OF_QUARTIC
    time = np.array(window, dtype=np.float64) - frame
    return numbers[enough], motion_of(position[enough], covariance[enough], time, derivatives)


def _window(frame: int, frames: int) -> list[int]:
    return [k for k in range(frame - HALF_FRAMES, frame + HALF_FRAMES + 1) if 0 <= k < frames]


def high_derivatives_in(found: Trajectories, frames: Sequence[Seen]) -> HighDerivatives | None:
    """Return what the tracks of a sequence have in common; None where too few are long enough to tell."""
    width = min(2 * HALF_FRAMES + 1, len(frames))
    # Their middles, of windows that do not overlap.
    middles = range(width // 2, len(frames) - (width - 1) // 2, width)
    windows = [_window(frame, len(frames)) for frame in middles]
    share = MOST_TRACKS // len(windows)
    reported: list[tuple[Floats, Floats, Floats]] = []
    for window in windows:
        numbers = tracks_in(found, window[:1])
        for frame in window[1:]:
            numbers = np.intersect1d(numbers, found.labels[frame])
        position, covariance = places_with_covariances(
            found, frames, window, numbers[:: max(1, len(numbers) // max(share, 1))]
        )
        reported.append((position, covariance, np.array(window, dtype=np.float64) - window[len(window) // 2]))
    position, covariance = (np.concatenate([each[k] for each in reported]) for k in range(2))
    known = np.isfinite(position).all(axis=(1, 2))
    return high_derivatives_of(position[known], covariance[known], reported[0][2])


def places_with_covariances(
    found: Trajectories, frames: Sequence[Seen], window: Sequence[int], tracks: Integers
) -> tuple[Floats, Floats]:
    """Return places (n, m, 3) of tracks in the frames of a window, and their covariances (n, m, 3, 3).

    They are NaN where a track has none, or none whose errors are known; the covariances are 1 there.
    """
    position = np.full((len(tracks), len(window), 3), np.nan)
    covariance = np.broadcast_to(np.eye(3), (len(tracks), len(window), 3, 3)).copy()
    for column, frame in enumerate(window):
        place = found.particles(frame, tracks)
        stated = frames[frame].covariances()[place]
        there = (place >= 0) & (np.linalg.eigvalsh(stated)[:, 0] > 0.0)
        position[there, column] = frames[frame].position_mm[place[there]]
        covariance[there, column] = stated[there]
    return position, covariance


def motion_of(position_mm: Floats, covariance_mm2: Floats, time: Floats, derivatives: HighDerivatives) -> Motion:
    """Return place, velocity and acceleration at time 0 of tracks with three places at least.

    Parameters
    ----------
    position_mm, covariance_mm2 : (n, m, 3) and (n, m, 3, 3), as stated
    time : (m,) of the frames
    """
    stated = covariance_mm2 * np.outer(derivatives.noise, derivatives.noise)
    solution, covariance = _quartic(position_mm, stated, time, AVERAGED_TRACKS * derivatives.variance)
    fourth = np.where(
        np.isfinite(position_mm), _terms(time, QUARTIC)[:, -1:] * np.sqrt(derivatives.variance[-1]), np.nan
    )
    neglected = _quartic(fourth, stated, time, AVERAGED_TRACKS * derivatives.variance)[0][:, SECOND]
    return Motion(solution[:, 0], solution[:, 1], solution[:, SECOND], covariance[:, SECOND, :, SECOND], neglected)


def high_derivatives_of(position_mm: Floats, covariance_mm2: Floats, time: Floats) -> HighDerivatives | None:
    """Return noise and higher derivatives of tracks that have all places; None where these are too few to tell.

    Scatter beyond the fits' own errors is the derivatives'; that of the residuals shows the noise.
    """
    if len(position_mm) < FEWEST_TRACKS or len(time) < QUARTIC:
        return None
    solution, covariance = _quartic(position_mm, covariance_mm2, time, np.full((QUARTIC - FREE_OF_QUARTIC, 3), np.inf))
    noise2, freedom = np.ones(3), len(time) - QUARTIC
    if freedom:
        left = position_mm - np.einsum("mi,nia->nma", _terms(time, QUARTIC), solution)
        stated = np.diagonal(covariance_mm2, axis1=-2, axis2=-1)
        # The median of chi-squared.
        noise2 = np.median(np.sum(left**2 / stated, axis=1), axis=0) / (2.0 * gammaincinv(0.5 * freedom, 0.5))
    variance = np.empty((QUARTIC - FREE_OF_QUARTIC, 3))
    for row, term in enumerate(range(FREE_OF_QUARTIC, QUARTIC)):
        of_noise = noise2 * np.diagonal(covariance[:, term, :, term], axis1=-2, axis2=-1)
        spread = MAD_TO_SIGMA * np.median(np.abs(solution[:, term]) / np.sqrt(of_noise), axis=0)
        unseen = SPREAD_ERROR / np.sqrt(len(solution)) * spread**2
        variance[row] = (np.maximum(spread**2 - 1.0, 0.0) + unseen) * np.median(of_noise, axis=0)
    return HighDerivatives(np.sqrt(noise2), variance)


def _quartic(position_mm: Floats, covariance_mm2: Floats, time: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives (n, 5, 3) at time 0, and their covariances (n, 5, 3, 5, 3).

    `variance` : (2, 3) that is expected of the third and fourth ones
    """
    terms, known = _terms(time, QUARTIC), np.isfinite(position_mm[..., 0])
    weight = known[..., np.newaxis, np.newaxis] * np.linalg.inv(covariance_mm2)
    matrix = np.einsum("nmab,mi,mj->niajb", weight, terms, terms, optimize=True)
    for row, term in enumerate(range(FREE_OF_QUARTIC, QUARTIC)):
        for axis in range(3):
            matrix[:, term, axis, term, axis] += 1.0 / max(variance[row, axis], SMALLEST_OF_QUARTIC)
    size = 3 * QUARTIC
    matrix = matrix.reshape(-1, size, size)
    # With ones on the diagonals in between.
    scale = 1.0 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    both = scale[:, :, np.newaxis] * scale[:, np.newaxis]
    covariance = np.linalg.inv(matrix * both) * both
    weighted = np.einsum("nmab,nmb->nma", weight, np.where(known[..., np.newaxis], position_mm, 0.0))
    right = np.einsum("mi,nma->nia", terms, weighted).reshape(-1, size)
    solution = np.einsum("nij,nj->ni", covariance, right)
    return solution.reshape(-1, QUARTIC, 3), covariance.reshape(-1, QUARTIC, 3, QUARTIC, 3)


# 1, t, t^2/2, t^3/6, of which the first two are whatever the places say. A parabola has three unknowns, a cubic four;
# with one place more its residual shows the noise.
CUBIC, FREE_OF_CUBIC, PARABOLA = 4, 2, 3
# Fewer tracks than this show neither noise nor bending.
FEWEST_TRACKS = 30
# No derivative is known to be smaller than this, squared, mm^2 per frame^4 or frame^6: a nanometre; it keeps the
# equations finite.
SMALLEST_OF_CUBIC = 1e-12
# The standard error of the square of a spread by its median, times the root of the number. Third derivatives that do
# not show by twice as much are none: to allow for them makes velocities three times as uncertain.
SPREAD_ERROR, SHOWN = 2.33, 2.0


@dataclass(frozen=True, eq=False)
class State:
    """Place and velocity of tracks at one time.

    Attributes
    ----------
    position_mm, velocity : (n, 3), mm and mm per frame
    position_sigma, velocity_sigma : (n, 3) standard errors
    """

    position_mm: Floats
    velocity: Floats
    position_sigma: Floats
    velocity_sigma: Floats


@dataclass(frozen=True, eq=False)
class Scatter:
    """What all tracks have in common, by component.

    Attributes
    ----------
    noise : (3,) how large errors of places are over the stated ones
    bending : (3,) variance of the second derivatives, mm^2 per frame^4
    jerk : (3,) variance of the third derivatives, mm^2 per frame^6
    noise_known, bending_known : whether tracks are enough to tell them, or else errors as stated and straight tracks
    """

    noise: Floats
    bending: Floats
    jerk: Floats
    noise_known: bool = False
    bending_known: bool = False

    @classmethod
    def unknown(cls) -> Scatter:
        """Return the one to begin with: errors as stated, straight tracks."""
        return cls(np.ones(3), np.zeros(3), np.zeros(3))


def fit_in_time(position_mm: Floats, sigma_mm: Floats, time: Floats, scatter: Scatter) -> State:
    """Return the state at time 0 of tracks with two places at least.

    Parameters
    ----------
    position_mm, sigma_mm : (n, m, 3) places and their stated standard errors
    time : (m,) of the frames
    """
    expected = np.stack([scatter.bending, scatter.jerk])
    # Residuals smaller than stated show that errors of neighbouring frames are alike, not that they are smaller.
    noise = np.maximum(scatter.noise, 1.0)
    solution, covariance = _cubic(position_mm, sigma_mm * noise, time, expected)
    error = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return State(solution[..., 0], solution[..., 1], error[..., 0], error[..., 1])


def scatter_of(pieces: Iterable[tuple[Floats, Floats]], time: Floats) -> Scatter:
    """Return noise and bending of tracks that come in pieces: of the places and errors of each but little is kept.

    They are the unknown ones where too few tracks are long enough.
    Third derivatives are told by tracks of five places or more; where these are too few they are taken for those of
    circles with the velocities and the bendings that there are.
    """
    reported: list[list[Floats]] = [[], [], [], []]
    about = time - np.mean(time)
    for places, errors in pieces:
        count = np.isfinite(places[..., 0]).sum(axis=1)
        # By cubics where these leave a residual, else by parabolas, which tell no third derivative.
        for which, terms in ((count > CUBIC, CUBIC), ((count >= PARABOLA) & (count <= CUBIC), PARABOLA)):
            position, sigma, freedom = places[which], errors[which], count[which] - terms
            free = np.full((CUBIC - FREE_OF_CUBIC, 3), np.inf)
            free[terms - FREE_OF_CUBIC :] = 0.0
            solution, covariance = _cubic(position, sigma, about, free)
            left = position - np.einsum("mi,nai->nma", _terms(about, CUBIC), solution)
            squares = np.nansum((left / sigma) ** 2, axis=1)[freedom > 0]
            # The median of chi-squared.
            over = squares / (2.0 * gammaincinv(0.5 * freedom[freedom > 0], 0.5))[:, np.newaxis]
            parts = [np.stack([solution[..., k], covariance[..., k, k]], axis=1) for k in (2, 3)]
            third = parts[1][:0] if terms == PARABOLA else parts[1]
            for kept, new in zip(reported, (over, solution[..., 1].copy(), parts[0], third), strict=True):
                kept.append(new)
    misfit, velocity, second, third = (np.concatenate(each) for each in reported)
    # Pieces go as soon as they are put together.
    del reported
    if len(second) < FEWEST_TRACKS:
        return Scatter.unknown()
    noise2: Floats = np.ones(3)
    noise_known = len(misfit) >= FEWEST_TRACKS
    if noise_known:
        noise2 = np.median(misfit, axis=0)
    bending = _variance(second, noise2)
    if len(third) >= FEWEST_TRACKS:
        jerk = _variance(third, noise2, SHOWN)
    else:
        # On a circle a velocity u and a second derivative a go with a third one of a^2 / u.
        around = np.sum((MAD_TO_SIGMA * np.median(np.abs(velocity - np.median(velocity, axis=0)), axis=0)) ** 2)
        jerk = bending * np.sum(bending) / around if around else np.zeros(3)
    return Scatter(np.sqrt(noise2), bending, jerk, noise_known=noise_known, bending_known=True)


def _variance(derivatives: Floats, noise2: Floats, shown: float = 0.0) -> Floats:
    """Return the variance (3,) of derivatives (n, 2, 3), given with their errors' variances, beyond these errors.

    Where it does not differ from none by so many standard errors as are to be `shown`, it is 0.
    """
    value, of_noise = derivatives[:, 0], derivatives[:, 1] * noise2
    spread = MAD_TO_SIGMA * np.median(np.abs(value) / np.sqrt(of_noise), axis=0)
    more = spread**2 - 1.0
    more[more < shown * SPREAD_ERROR / np.sqrt(len(value))] = 0.0
    return np.asarray(np.maximum(more, 0.0) * np.median(of_noise, axis=0))


def _terms(time: Floats, count: int) -> Floats:
    """Return 1, t, t^2/2, t^3/6 ..., (m, count)."""
    return np.stack([time**power / factorial(power) for power in range(count)], axis=1)


def _cubic(position_mm: Floats, sigma_mm: Floats, time: Floats, expected: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives (n, 3, 4) of each component at time 0, and their covariances (n, 3, 4, 4).

    `expected` : (2, 3) variances of the second and third derivatives
    """
    terms, known = _terms(time, CUBIC), np.isfinite(position_mm)
    weight = np.where(known, np.where(known, sigma_mm, 1.0) ** -2.0, 0.0)
    matrix = np.einsum("nma,mi,mj->naij", weight, terms, terms)
    for row, term in enumerate(range(FREE_OF_CUBIC, CUBIC)):
        matrix[..., term, term] += 1.0 / np.maximum(expected[row], SMALLEST_OF_CUBIC)
    covariance = np.linalg.inv(matrix)
    right = np.einsum("nma,mi,nma->nai", weight, terms, np.where(known, position_mm, 0.0))
    return np.einsum("naij,naj->nai", covariance, right), covariance
