"""Trajectory fits: position and velocity by local polynomials in time, with the noise and the bending of trajectories.

A track is a cubic over a few frames. How large second and third derivatives are is a property of the flow, and is taken
from all tracks: each track's are drawn to zero as far as derivatives of that size are what noise makes, and what they
may be counts in its standard errors. In a straight flow the fit is a line. Without the third derivative velocities in
vortices that turn by a tenth of a circle over the frames of a fit are off by ten stated errors.

Axes: places (n, m, 3) in mm of n tracks in m frames, NaN where a track has none; times in frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from lfpiv_cli.robust import MAD_TO_SIGMA

# 1, t, t^2/2, t^3/6, of which the first two are whatever the places say. A parabola has three unknowns, a cubic four;
# with one place more its residual shows the noise.
TERMS, FREE_TERMS, PARABOLA = 4, 2, 3
# Fewer tracks than this show neither noise nor bending.
FEWEST_TRACKS = 30
# No derivative is known to be smaller than this, squared, mm^2 per frame^4 or frame^6: a nanometre; it keeps the
# equations finite.
SMALLEST_VARIANCE = 1e-12
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

    position_mm: NDArray[np.float64]
    velocity: NDArray[np.float64]
    position_sigma: NDArray[np.float64]
    velocity_sigma: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scatter:
    """What all tracks have in common, by component.

    Attributes
    ----------
    noise : (3,) how large errors of places are over the stated ones
    bending : (3,) variance of the second derivatives, mm^2 per frame^4
    twisting : (3,) variance of the third derivatives, mm^2 per frame^6
    noise_known, bending_known : whether tracks are enough to tell them, or else errors as stated and straight tracks
    """

    noise: NDArray[np.float64]
    bending: NDArray[np.float64]
    twisting: NDArray[np.float64]
    noise_known: bool = False
    bending_known: bool = False

    @classmethod
    def unknown(cls) -> Scatter:
        """Return the one to begin with: errors as stated, straight tracks."""
        return cls(np.ones(3), np.zeros(3), np.zeros(3))


def fit_in_time(
    position_mm: NDArray[np.float64], sigma_mm: NDArray[np.float64], time: NDArray[np.float64], scatter: Scatter
) -> State:
    """Return the state at time 0 of tracks with two places at least.

    Parameters
    ----------
    position_mm, sigma_mm : (n, m, 3) places and their stated standard errors
    time : (m,) of the frames
    """
    expected = np.stack([scatter.bending, scatter.twisting])
    # Residuals smaller than stated show that errors of neighbouring frames are alike, not that they are smaller.
    noise = np.maximum(scatter.noise, 1.0)
    solution, covariance = _polynomial(position_mm, sigma_mm * noise, time, expected)
    error = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return State(solution[..., 0], solution[..., 1], error[..., 0], error[..., 1])


def scatter_of(position_mm: NDArray[np.float64], sigma_mm: NDArray[np.float64], time: NDArray[np.float64]) -> Scatter:
    """Return noise and bending of tracks; the unknown ones where too few tracks are long enough."""
    return scatter_of_pieces([(position_mm, sigma_mm)], time)


def scatter_of_pieces(
    pieces: Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]], time: NDArray[np.float64]
) -> Scatter:
    """Return noise and bending as `scatter_of` does, of tracks that come in pieces: of each but little is kept.

    Third derivatives are told by tracks of five places or more; where these are too few they are taken for those of
    circles with the velocities and the bendings that there are.
    """
    told = [_bends_of(position, sigma, time - np.mean(time)) for position, sigma in pieces]
    misfit = np.concatenate([each.misfit for each in told])
    second, third = (np.concatenate([getattr(each, name) for each in told]) for name in ("second", "third"))
    velocity = np.concatenate([each.velocity for each in told])
    # Pieces go as soon as they are put together.
    del told
    if len(second) < FEWEST_TRACKS:
        return Scatter.unknown()
    noise2: NDArray[np.float64] = np.ones(3)
    noise_known = len(misfit) >= FEWEST_TRACKS
    if noise_known:
        noise2 = np.median(misfit, axis=0)
    bending = _variance(second, noise2)
    if len(third) >= FEWEST_TRACKS:
        twisting = _variance(third, noise2, SHOWN)
    else:
        # On a circle a velocity u and a second derivative a go with a third one of a^2 / u.
        around = np.sum((MAD_TO_SIGMA * np.median(np.abs(velocity - np.median(velocity, axis=0)), axis=0)) ** 2)
        twisting = bending * np.sum(bending) / around if around else np.zeros(3)
    return Scatter(np.sqrt(noise2), bending, twisting, noise_known=noise_known, bending_known=True)


@dataclass(frozen=True, eq=False)
class _Bends:
    """What tracks tell of noise and bending.

    Attributes
    ----------
    misfit : (l, 3) squares of what fits leave over what stated errors let expect, of tracks with places to spare
    velocity : (k, 3)
    second : (k, 2, 3) second derivatives, and their variances
    third : (j, 2, 3) third derivatives of the tracks with five places or more, and their variances
    """

    misfit: NDArray[np.float64]
    velocity: NDArray[np.float64]
    second: NDArray[np.float64]
    third: NDArray[np.float64]


def _variance(derivatives: NDArray[np.float64], noise2: NDArray[np.float64], shown: float = 0.0) -> NDArray[np.float64]:
    """Return the variance (3,) of derivatives (n, 2, 3), given with their errors' variances, beyond these errors.

    Where it does not differ from none by so many standard errors as are to be `shown`, it is 0.
    """
    value, of_noise = derivatives[:, 0], derivatives[:, 1] * noise2
    spread = MAD_TO_SIGMA * np.median(np.abs(value) / np.sqrt(of_noise), axis=0)
    more = spread**2 - 1.0
    more[more < shown * SPREAD_ERROR / np.sqrt(len(value))] = 0.0
    return np.asarray(np.maximum(more, 0.0) * np.median(of_noise, axis=0))


def _bends_of(position_mm: NDArray[np.float64], sigma_mm: NDArray[np.float64], time: NDArray[np.float64]) -> _Bends:
    """Return what the tracks tell that are long enough: by cubics where these leave a residual, else by parabolas."""
    count = np.isfinite(position_mm[..., 0]).sum(axis=1)
    misfit, velocity, second, third = [], [], [], []
    for which, terms in ((count > TERMS, TERMS), ((count >= PARABOLA) & (count <= TERMS), PARABOLA)):
        position, sigma, freedom = position_mm[which], sigma_mm[which], count[which] - terms
        free = np.full((TERMS - FREE_TERMS, 3), np.inf)
        free[terms - FREE_TERMS :] = 0.0
        solution, covariance = _polynomial(position, sigma, time, free)
        left = position - np.einsum("mi,nai->nma", _terms(time), solution)
        squares = np.nansum((left / sigma) ** 2, axis=1)[freedom > 0]
        # The median of chi-squared.
        misfit.append(squares / (2.0 * gammaincinv(0.5 * freedom[freedom > 0], 0.5))[:, np.newaxis])
        velocity.append(solution[..., 1].copy())
        parts = [np.stack([solution[..., k], covariance[..., k, k]], axis=1) for k in (2, 3)]
        second.append(parts[0])
        third.append(parts[1][:0] if terms == PARABOLA else parts[1])
    return _Bends(*(np.concatenate(each) for each in (misfit, velocity, second, third)))


def _terms(time: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.ones_like(time), time, time**2 / 2.0, time**3 / 6.0], axis=1)


def _polynomial(
    position_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    time: NDArray[np.float64],
    expected: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the derivatives (n, 3, 4) of each component at time 0, and their covariances (n, 3, 4, 4).

    `expected` : (2, 3) variances of the second and third derivatives
    """
    terms, known = _terms(time), np.isfinite(position_mm)
    weight = np.where(known, np.where(known, sigma_mm, 1.0) ** -2.0, 0.0)
    matrix = np.einsum("nma,mi,mj->naij", weight, terms, terms)
    for row, term in enumerate(range(FREE_TERMS, TERMS)):
        matrix[..., term, term] += 1.0 / np.maximum(expected[row], SMALLEST_VARIANCE)
    covariance = np.linalg.inv(matrix)
    right = np.einsum("nma,mi,nma->nai", weight, terms, np.where(known, position_mm, 0.0))
    return np.einsum("naij,naj->nai", covariance, right), covariance
