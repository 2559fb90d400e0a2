"""Two for one: particles so close that they were found as one, told apart where two explain the light much better.

Both are fitted together, eight unknowns: block coordinates creep where two responses nearly coincide.

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.particles.fitting import (
    DAMPING,
    DAMPING_DOWN,
    DAMPING_UP,
    LONGEST_DEPTH_STEP_MM,
    SMALLEST_GAIN,
    UNKNOWNS,
    add_light,
    normal_equations,
    solve_damped,
)
from lfpiv_cli.particles.response import VALUES, respond
from lfpiv_cli.particles.tiles import LARGEST_MOVE_MM, Tiles
from lfpiv_cli.particles.view import View

# Half the distance (x, y, z) of two particles at the start, mm: half a voxel of Table 2 sideways, or along the depth in
# which a volume cannot tell two from one.
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
# A start that after so many steps has not won this share of what is asked for is given up: half the time is saved.
EARLY_STEPS, EARLY_GAIN = 4, 0.25


@njit(cache=True)
def _pair_equations(
    view: View,
    pair: NDArray[np.float64],
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
    counts: NDArray[np.int64],
    place: NDArray[np.int32],
    matrix: NDArray[np.float64],
    right: NDArray[np.float64],
) -> float:
    """Fill the normal equations (8, 8) of two particles (2, 4); return what they add to chi-squared together.

    `place` (side, side) is zero and serves to find common pixels; it is zero again on return.
    """
    side = place.shape[0]
    for m in range(2):
        counts[m] = respond(view, pair[m, 0], pair[m, 1], pair[m, 2], pixels[m], values[m])
    first, second = slice(0, UNKNOWNS), slice(UNKNOWNS, 2 * UNKNOWNS)
    block = np.empty((UNKNOWNS, UNKNOWNS))
    change = normal_equations(pixels[0], values[0], counts[0], pair[0, 3], residual, weight, block, right[first])
    matrix[first, first] = block
    add_light(pixels[0], values[0], counts[0], -pair[0, 3], residual)
    change += normal_equations(pixels[1], values[1], counts[1], pair[1, 3], residual, weight, block, right[second])
    matrix[second, second] = block
    add_light(pixels[0], values[0], counts[0], pair[0, 3], residual)
    # What the first explains is off the second's side already; the first's side still lacks the second's light.
    top, left = view.rows, view.columns
    for k in range(counts[0]):
        top, left = min(top, pixels[0, k] // view.columns), min(left, pixels[0, k] % view.columns)
    for k in range(counts[0]):
        place[pixels[0, k] // view.columns - top, pixels[0, k] % view.columns - left] = k + 1
    cross = np.zeros((UNKNOWNS, UNKNOWNS))
    one, two = np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    for k in range(counts[1]):
        row, column = pixels[1, k] // view.columns - top, pixels[1, k] % view.columns - left
        if not (0 <= row < side and 0 <= column < side) or place[row, column] == 0:
            continue
        at = place[row, column] - 1
        w = weight[pixels[1, k]]
        for i in range(3):
            one[i] = pair[0, 3] * values[0, at, i + 1]
            two[i] = pair[1, 3] * values[1, k, i + 1]
        one[3], two[3] = values[0, at, 0], values[1, k, 0]
        for i in range(UNKNOWNS):
            right[i] -= w * one[i] * pair[1, 3] * values[1, k, 0]
            for j in range(UNKNOWNS):
                cross[i, j] += w * one[i] * two[j]
    matrix[first, second] = cross
    matrix[second, first] = cross.T
    for k in range(counts[0]):
        place[pixels[0, k] // view.columns - top, pixels[0, k] % view.columns - left] = 0
    return change


@njit(cache=True)
def _fit_pair(
    view: View,
    pair: NDArray[np.float64],
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    z_low: float,
    z_high: float,
    promising: float,
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
    place: NDArray[np.int32],
) -> float:
    """Improve two particles (2, 4) in place; return what they add to chi-squared.

    Gives up early where this is not below `promising` after a few steps.
    """
    n = 2 * UNKNOWNS
    counts = np.zeros(2, np.int64)
    matrix, trial_matrix = np.empty((n, n)), np.empty((n, n))
    right, trial_right = np.empty(n), np.empty(n)
    step, trial, begin = np.zeros(n), np.empty_like(pair), pair.copy()
    change = _pair_equations(view, pair, residual, weight, pixels, values, counts, place, matrix, right)
    damping = DAMPING
    for number in range(PAIR_STEPS):
        if number == EARLY_STEPS and change > promising:
            break
        if not solve_damped(matrix, right, damping, step) or np.dot(step, right) < SMALLEST_GAIN:
            break
        for m in range(2):
            for i in range(UNKNOWNS):
                trial[m, i] = pair[m, i] + step[m * UNKNOWNS + i]
            for i in range(2):
                trial[m, i] = min(max(trial[m, i], begin[m, i] - LARGEST_MOVE_MM), begin[m, i] + LARGEST_MOVE_MM)
            low, high = pair[m, 2] - LONGEST_DEPTH_STEP_MM, pair[m, 2] + LONGEST_DEPTH_STEP_MM
            trial[m, 2] = min(max(trial[m, 2], low, z_low), high, z_high)
            trial[m, 3] = max(trial[m, 3], 0.0)
        trial_change = _pair_equations(
            view, trial, residual, weight, pixels, values, counts, place, trial_matrix, trial_right
        )
        if not trial_change < change:
            damping *= DAMPING_UP
            continue
        gain = change - trial_change
        pair[:], matrix[:], right[:], change = trial, trial_matrix, trial_right, trial_change
        damping *= DAMPING_DOWN
        if gain < SMALLEST_GAIN:
            break
    return change


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
    twins = np.zeros_like(particles)
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            pixels, values = np.empty((2, capacity), np.int32), np.empty((2, capacity, VALUES))
            place = np.zeros((box_px, box_px), np.int32)
            matrix, right = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
            pair, best = np.empty((2, UNKNOWNS)), np.empty((2, UNKNOWNS))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                number = tiles.order[at]
                if not suspects[number]:
                    continue
                x, y, z, light = particles[number]
                count = respond(view, x, y, z, pixels[0], values[0])
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
                    change = _fit_pair(view, pair, residual, weight, z_low, z_high, promising, pixels, values, place)
                    if change < lowest and min(pair[0, 3], pair[1, 3]) >= smallest_light:
                        lowest, found = change, True
                        best[:] = pair
                if found:
                    particles[number] = best[0]
                    twins[number] = best[1]
                    for m in range(2):
                        count = respond(view, best[m, 0], best[m, 1], best[m, 2], pixels[0], values[0])
                        add_light(pixels[0], values[0], count, -best[m, 3], residual)
                else:
                    count = respond(view, x, y, z, pixels[0], values[0])
                    add_light(pixels[0], values[0], count, -light, residual)
    return twins
