"""Overlapping particle images: two particles where one was found, if two explain the light much better.

Both are fitted together, eight unknowns: block coordinates creep where two responses nearly coincide.

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.particles.least_squares import (
    UNKNOWNS,
    add_light,
    fit,
    normal_equations,
    respond_all,
    respond_once,
)
from lfpiv_cli.particles.response import VALUES
from lfpiv_cli.particles.tiles import Tiles
from lfpiv_cli.particles.view import View, view_of

# Half the distance (x, y, z) of two particles at the start, mm: half a voxel of Table 2 sideways, or along the depth in
# which a volume shows two as one.
STARTS_MM = np.array(
    [
        (0.03, 0.0, 0.0),
        (0.0, 0.03, 0.0),
        (0.02, 0.02, 0.0),
        (0.02, -0.02, 0.0),
        (0.0, 0.0, 0.2),
        (0.0, 0.0, 0.5),
        (0.0, 0.0, 1.0),
    ]
)
PAIR_STEPS = 12
# A start that after the first steps has not gained this share of what is asked for is given up: half the time is saved.
EARLY_GAIN = 0.25


@njit(cache=True, parallel=True)
def split(
    view: View,
    particles: NDArray[np.float64],
    suspects: NDArray[np.bool_],
    tiles: Tiles,
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    z_low: float,
    z_high: float,
    smallest_light: float,
    smallest_gain: float,
    capacity: int,
    box_px: int,
) -> NDArray[np.float64]:
    """Replace suspects by two particles where that lowers chi-squared by `smallest_gain`.

    The first of the two takes the suspect's place in `particles` (n, 4); the second ones are returned in an array of
    the same shape whose other rows are zero. The residual is kept up to date.
    """
    partners = np.zeros_like(particles)
    camera, rest = view.camera[:], view[1:]
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            whole = view_of(camera, rest)
            pixels, values = np.empty((2, capacity), np.int32), np.empty((2, capacity, VALUES))
            counts, place = np.zeros(2, np.int64), np.zeros((box_px, box_px), np.int32)
            matrix, right = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
            pair, best = np.empty((2, UNKNOWNS)), np.empty((2, UNKNOWNS))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                number = tiles.order[at]
                if not suspects[number]:
                    continue
                x, y, z, light = particles[number]
                count = respond_once(whole, x, y, z, pixels[0], values[0])
                add_light(pixels[0], values[0], count, light, residual)
                single = normal_equations(pixels[0], values[0], count, light, residual, weight, matrix, right)
                lowest = single - smallest_gain
                promising = single - EARLY_GAIN * smallest_gain
                found = False
                for k in range(STARTS_MM.shape[0]):
                    for m in range(2):
                        sign = 1.0 - 2.0 * m
                        pair[m, 0] = x + sign * STARTS_MM[k, 0]
                        pair[m, 1] = y + sign * STARTS_MM[k, 1]
                        pair[m, 2] = min(max(z + sign * STARTS_MM[k, 2], z_low), z_high)
                        pair[m, 3] = 0.5 * light
                    respond_all(whole, pair, counts, pixels, values)
                    change = fit(
                        whole,
                        pair,
                        residual,
                        weight,
                        z_low,
                        z_high,
                        PAIR_STEPS,
                        promising,
                        counts,
                        pixels,
                        values,
                        place,
                    )
                    if change < lowest and min(pair[0, 3], pair[1, 3]) >= smallest_light:
                        lowest, found = change, True
                        best[:] = pair
                if found:
                    particles[number] = best[0]
                    partners[number] = best[1]
                    respond_all(whole, best, counts, pixels, values)
                    for m in range(2):
                        add_light(pixels[m], values[m], counts[m], -best[m, 3], residual)
                else:
                    count = respond_once(whole, x, y, z, pixels[0], values[0])
                    add_light(pixels[0], values[0], count, -light, residual)
    return partners
