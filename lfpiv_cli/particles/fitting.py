"""Fitting single particles to what the others leave of the image.

Particles are refined one after the other (block coordinates), those of different tiles at once (`tiles`).

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.particles.least_squares import UNKNOWNS, add_light, best_light, fit, respond_all, respond_once
from lfpiv_cli.particles.response import VALUES, respond
from lfpiv_cli.particles.tiles import Tiles
from lfpiv_cli.particles.view import View, view_of

# Candidates are brought into the fit from these depths beside their own, mm.
START_DEPTHS_MM = np.array([0.0, -0.4, 0.4])
# Steps for a candidate, for a particle in a sweep.
CANDIDATE_STEPS = 12
SWEEP_STEPS = 4
# A particle claims its light where at least this share of it is found (the rest may be noise and neighbours).
CLAIM = 0.7


@njit(cache=True)
def claimed_share(
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
    count: int,
    light: float,
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> float:
    """Return the share of the light that a particle would claim which is there: sum min(r+, c I f) / sum c I f.

    Pixels without weight do not count.
    """
    found = wanted = 0.0
    for k in range(count):
        if weight[pixels[k]] > 0.0:
            claim = CLAIM * light * values[k, 0]
            wanted += claim
            found += min(max(residual[pixels[k]], 0.0), claim)
    return found / wanted if wanted > 0.0 else 0.0


@njit(cache=True, parallel=True)
def refine(
    view: View,
    particles: NDArray[np.float64],
    tiles: Tiles,
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    z_low: float,
    z_high: float,
    capacity: int,
) -> None:
    """Refine all particles (n, 4) once, in place, and keep the residual up to date."""
    camera, rest = view.camera[:], view[1:]
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            whole = view_of(camera, rest)
            counts, place = np.zeros(1, np.int64), np.zeros((0, 0), np.int32)
            pixels, values = np.empty((1, capacity), np.int32), np.empty((1, capacity, VALUES))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                number = tiles.order[at]
                one = particles[number : number + 1]
                respond_all(whole, one, counts, pixels, values)
                add_light(pixels[0], values[0], counts[0], one[0, 3], residual)
                fit(whole, one, residual, weight, z_low, z_high, SWEEP_STEPS, np.inf, counts, pixels, values, place)
                add_light(pixels[0], values[0], counts[0], -one[0, 3], residual)


@njit(cache=True, parallel=True)
def accept(
    view: View,
    candidates: NDArray[np.float64],
    tiles: Tiles,
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    z_low: float,
    z_high: float,
    smallest_light: float,
    smallest_share: float,
    capacity: int,
) -> NDArray[np.bool_]:
    """Fit candidates (n, 4) in place, one after the other; return which ones stay, their light off the residual."""
    accepted = np.zeros(candidates.shape[0], np.bool_)
    camera, rest = view.camera[:], view[1:]
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            whole = view_of(camera, rest)
            counts, place = np.zeros(1, np.int64), np.zeros((0, 0), np.int32)
            pixels, values = np.empty((1, capacity), np.int32), np.empty((1, capacity, VALUES))
            trial, best = np.empty((1, UNKNOWNS)), np.empty((1, UNKNOWNS))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                number = tiles.order[at]
                lowest = 0.0
                for depth in START_DEPTHS_MM:
                    trial[0] = candidates[number]
                    trial[0, 2] = min(max(trial[0, 2] + depth, z_low), z_high)
                    respond_all(whole, trial, counts, pixels, values)
                    trial[0, 3] = best_light(pixels[0], values[0], counts[0], residual, weight)
                    change = fit(
                        whole,
                        trial,
                        residual,
                        weight,
                        z_low,
                        z_high,
                        CANDIDATE_STEPS,
                        np.inf,
                        counts,
                        pixels,
                        values,
                        place,
                    )
                    if change < lowest:
                        lowest = change
                        best[:] = trial
                if lowest == 0.0 or best[0, 3] < smallest_light:
                    continue
                respond_all(whole, best, counts, pixels, values)
                share = claimed_share(pixels[0], values[0], counts[0], best[0, 3], residual, weight)
                if share >= smallest_share:
                    candidates[number] = best[0]
                    accepted[number] = True
                    add_light(pixels[0], values[0], counts[0], -best[0, 3], residual)
    return accepted


@njit(cache=True, parallel=True)
def add_all(
    view: View,
    particles: NDArray[np.float64],
    tiles: Tiles,
    sign: float,
    image: NDArray[np.float64],
    capacity: int,
) -> None:
    """Add the light of all particles (n, 4), times `sign`, to an image."""
    camera, rest = view.camera[:], view[1:]
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            whole = view_of(camera, rest)
            pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                particle = particles[tiles.order[at]]
                count = respond(whole, particle[0], particle[1], particle[2], pixels, values)
                add_light(pixels, values, count, sign * particle[3], image)


@njit(cache=True, parallel=True)
def judge(
    view: View,
    particles: NDArray[np.float64],
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    capacity: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return local chi-squared, claimed share and share of the light that is seen of each particle.

    Local chi-squared is the mean of w r^2 over the particle's light; 1 for a perfect model. Pixels without weight see
    nothing.
    """
    chi2, share, seen = np.zeros(len(particles)), np.zeros(len(particles)), np.zeros(len(particles))
    camera, rest = view.camera[:], view[1:]
    for number in prange(len(particles)):
        whole = view_of(camera, rest)
        pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
        x, y, z, light = particles[number]
        count = respond_once(whole, x, y, z, pixels, values)
        found = wanted = total = squares = 0.0
        for k in range(count):
            f, r = values[k, 0], residual[pixels[k]]
            if weight[pixels[k]] == 0.0:
                continue
            total += f
            squares += f * weight[pixels[k]] * r * r
            wanted += CLAIM * light * f
            found += min(max(r + light * f, 0.0), CLAIM * light * f)
        if total > 0.0:
            chi2[number], seen[number] = squares / total, total
        if wanted > 0.0:
            share[number] = found / wanted
    return chi2, share, seen
