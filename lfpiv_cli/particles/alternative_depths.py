"""Alternative depths for particles that fit badly, and for those near the focal plane, where many depths look alike.

A fit finds the nearest minimum of chi-squared. Near the focal plane, where one lens holds most of a particle's
light, chi-squared has several minima along the depth, one of them mirrored; elsewhere a neighbour that was not known
yet may have led to the wrong one.

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.particles.least_squares import UNKNOWNS, add_light, best_light, fit, respond_all
from lfpiv_cli.particles.response import VALUES
from lfpiv_cli.particles.tiles import Tiles
from lfpiv_cli.particles.view import View, view_of

# Starts relative to the particle's depth, mm; its mirrored depth is another.
OTHER_DEPTHS_MM = np.array([-2.0, -1.5, -1.0, -0.7, -0.4, -0.2, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0])
DEPTH_STEPS = 8


@njit(cache=True, parallel=True)
def try_other_depths(
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
) -> NDArray[np.bool_]:
    """Move suspects to another depth where that lowers chi-squared by `smallest_gain` more than refinement does.

    All suspects among the particles (n, 4) are refined; the residual is kept up to date. Returns which have moved.
    """
    moved = np.zeros(particles.shape[0], np.bool_)
    camera, rest = view.camera[:], view[1:]
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            whole = view_of(camera, rest)
            counts, place = np.zeros(1, np.int64), np.zeros((0, 0), np.int32)
            pixels, values = np.empty((1, capacity), np.int32), np.empty((1, capacity, VALUES))
            trial, best = np.empty((1, UNKNOWNS)), np.empty((1, UNKNOWNS))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                number = tiles.order[at]
                if not suspects[number]:
                    continue
                best[0] = particles[number]
                respond_all(whole, best, counts, pixels, values)
                add_light(pixels[0], values[0], counts[0], best[0, 3], residual)
                own = fit(
                    whole, best, residual, weight, z_low, z_high, DEPTH_STEPS, np.inf, counts, pixels, values, place
                )
                lowest = own - smallest_gain
                for k in range(OTHER_DEPTHS_MM.size + 1):
                    trial[0] = particles[number]
                    trial[0, 2] = -trial[0, 2] if k == OTHER_DEPTHS_MM.size else trial[0, 2] + OTHER_DEPTHS_MM[k]
                    if not z_low <= trial[0, 2] <= z_high:
                        continue
                    respond_all(whole, trial, counts, pixels, values)
                    trial[0, 3] = best_light(pixels[0], values[0], counts[0], residual, weight)
                    change = fit(
                        whole,
                        trial,
                        residual,
                        weight,
                        z_low,
                        z_high,
                        DEPTH_STEPS,
                        np.inf,
                        counts,
                        pixels,
                        values,
                        place,
                    )
                    if change < lowest and trial[0, 3] >= smallest_light:
                        lowest = change
                        best[:] = trial
                        moved[number] = True
                particles[number] = best[0]
                respond_all(whole, best, counts, pixels, values)
                add_light(pixels[0], values[0], counts[0], -best[0, 3], residual)
    return moved
