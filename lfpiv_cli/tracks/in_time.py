"""Trajectory fits: position and velocity by local polynomials in time, with the noise and the bending of trajectories.

A track is a parabola over a few frames. How much tracks bend is a property of the flow, and is taken from all of them:
each bending is drawn to zero as far as bendings of that size are what noise makes. In a straight flow the fit is a
line.

Axes: places (n, m, 3) in mm of n tracks in m frames, NaN where a track has none; times in frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from lfpiv_cli.robust import MAD_TO_SIGMA

# A parabola has three unknowns; with one place more its residual shows the noise.
TERMS = 3
# Fewer tracks than this show neither noise nor bending.
FEWEST_TRACKS = 30
# No bending is known to be smaller than this, mm^2 per frame^4: a nanometre; it keeps the equations finite.
SMALLEST_BENDING = 1e-12


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
    noise_known, bending_known : whether tracks are enough to tell them, or else errors as stated and straight tracks
    """

    noise: NDArray[np.float64]
    bending: NDArray[np.float64]
    noise_known: bool = False
    bending_known: bool = False

    @classmethod
    def unknown(cls) -> Scatter:
        """Return the one to begin with: errors as stated, straight tracks."""
        return cls(np.ones(3), np.zeros(3))


def fit_in_time(
    position_mm: NDArray[np.float64], sigma_mm: NDArray[np.float64], time: NDArray[np.float64], scatter: Scatter
) -> State:
    """Return the state at time 0 of tracks with two places at least.

    Parameters
    ----------
    position_mm, sigma_mm : (n, m, 3) places and their stated standard errors
    time : (m,) of the frames
    """
    solution, covariance = _parabola(position_mm, sigma_mm * scatter.noise, time, scatter.bending)
    error = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return State(solution[..., 0], solution[..., 1], error[..., 0], error[..., 1])


def scatter_of(position_mm: NDArray[np.float64], sigma_mm: NDArray[np.float64], time: NDArray[np.float64]) -> Scatter:
    """Return noise and bending of tracks; the unknown ones where too few tracks are long enough."""
    return scatter_of_pieces([(position_mm, sigma_mm)], time)


def scatter_of_pieces(
    pieces: Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]], time: NDArray[np.float64]
) -> Scatter:
    """Return noise and bending as `scatter_of` does, of tracks that come in pieces: of each but little is kept."""
    bends = list(zip(*(_bends_of(position, sigma, time) for position, sigma in pieces), strict=True))
    # Pieces go as soon as they are put together.
    misfit, variance, bending = (np.concatenate(bends.pop()) for _ in range(3))
    if len(bending) < FEWEST_TRACKS:
        return Scatter.unknown()
    noise2: NDArray[np.float64] = np.ones(3)
    noise_known = len(misfit) >= FEWEST_TRACKS
    if noise_known:
        noise2 = np.median(misfit, axis=0)
    variance *= noise2
    spread = MAD_TO_SIGMA * np.median(np.abs(bending) / np.sqrt(variance), axis=0)
    squared = np.maximum(spread**2 - 1.0, 0.0) * np.median(variance, axis=0)
    return Scatter(np.sqrt(noise2), squared, noise_known=noise_known, bending_known=True)


def _bends_of(
    position_mm: NDArray[np.float64], sigma_mm: NDArray[np.float64], time: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """Return second derivatives and their variances (k, 3) of the tracks that are long enough, and misfits (l, 3).

    The misfits are of those with a place more than a parabola needs: squares over what stated errors let expect.
    """
    count = np.isfinite(position_mm[..., 0]).sum(axis=1)
    bent = count >= TERMS
    position, sigma, freedom = position_mm[bent], sigma_mm[bent], count[bent] - TERMS
    solution, covariance = _parabola(position, sigma, time, np.full(3, np.inf))
    left = position - np.einsum("mi,nai->nma", _terms(time), solution)
    squares = np.nansum((left / sigma) ** 2, axis=1)[freedom > 0]
    # The median of chi-squared.
    median = 2.0 * gammaincinv(0.5 * freedom[freedom > 0], 0.5)
    # Copies, as views would keep all of the solution.
    return solution[..., 2].copy(), covariance[..., 2, 2].copy(), squares / median[:, np.newaxis]


def _terms(time: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.ones_like(time), time, 0.5 * time**2], axis=1)


def _parabola(
    position_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    time: NDArray[np.float64],
    bending: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the coefficients (n, 3, 3) of 1, t, t^2/2 of each component, and their covariances (n, 3, 3, 3)."""
    terms, known = _terms(time), np.isfinite(position_mm)
    weight = np.where(known, np.where(known, sigma_mm, 1.0) ** -2.0, 0.0)
    matrix = np.einsum("nma,mi,mj->naij", weight, terms, terms)
    matrix[..., 2, 2] += 1.0 / np.maximum(bending, SMALLEST_BENDING)
    covariance = np.linalg.inv(matrix)
    right = np.einsum("nma,mi,nma->nai", weight, terms, np.where(known, position_mm, 0.0))
    return np.einsum("naij,naj->nai", covariance, right), covariance
