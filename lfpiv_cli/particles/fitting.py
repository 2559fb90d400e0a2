"""Fitting single particles to what the others leave of the image: Levenberg-Marquardt in x, y, z and light.

With r the residual without the particle, w the weights and f its response, chi-squared differs from that without it by

    sum w (I^2 f^2 - 2 I f r),

a sum over the pixels that the particle lights wherever it moves. Particles are refined one after the other (block
coordinates), those of different tiles at once (`tiles`).

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.particles.response import VALUES, respond
from lfpiv_cli.particles.tiles import LARGEST_MOVE_MM, Tiles
from lfpiv_cli.particles.view import View

UNKNOWNS = 4
# Damping relative to the diagonal: its start, and the factors after a step that failed or helped.
DAMPING = 1e-3
DAMPING_UP = 10.0
DAMPING_DOWN = 0.2
# A step that lowers chi-squared by less ends the fit: a hundredth of what one standard error costs.
SMALLEST_GAIN = 0.01
# Longest step in depth, mm: further away the response is another one and its slope says nothing.
LONGEST_DEPTH_STEP_MM = 0.5
# Candidates are brought into the fit from these depths beside their own, mm.
START_DEPTHS_MM = np.array([0.0, -0.4, 0.4])
# Steps for a candidate, for a particle in a sweep.
CANDIDATE_STEPS = 12
SWEEP_STEPS = 4
# A particle claims its light where at least this share of it is found (the rest may be noise and neighbours).
CLAIM = 0.7


@njit(cache=True)
def normal_equations(
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
    count: int,
    light: float,
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    matrix: NDArray[np.float64],
    right: NDArray[np.float64],
) -> float:
    """Fill J^T W J (4, 4) and J^T W (r - I f); return what the particle adds to chi-squared."""
    matrix[:] = 0.0
    right[:] = 0.0
    change = 0.0
    for k in range(count):
        at = pixels[k]
        w = weight[at]
        f, r = light * values[k, 0], residual[at]
        change += w * f * (f - 2.0 * r)
        a, b, c, d = light * values[k, 1], light * values[k, 2], light * values[k, 3], values[k, 0]
        left = w * (r - f)
        right[0] += a * left
        right[1] += b * left
        right[2] += c * left
        right[3] += d * left
        matrix[0, 0] += w * a * a
        matrix[0, 1] += w * a * b
        matrix[0, 2] += w * a * c
        matrix[0, 3] += w * a * d
        matrix[1, 1] += w * b * b
        matrix[1, 2] += w * b * c
        matrix[1, 3] += w * b * d
        matrix[2, 2] += w * c * c
        matrix[2, 3] += w * c * d
        matrix[3, 3] += w * d * d
    for row in range(1, UNKNOWNS):
        for column in range(row):
            matrix[row, column] = matrix[column, row]
    return change


@njit(cache=True)
def solve_damped(
    matrix: NDArray[np.float64], right: NDArray[np.float64], damping: float, step: NDArray[np.float64]
) -> bool:
    """Solve (A + damping diag A) step = b by Cholesky's method; return False where A is not positive definite."""
    n = right.size
    lower = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            if i == j:
                total *= 1.0 + damping
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * step[k]
        step[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * step[k]
        step[i] = total / lower[i, i]
    return True


@njit(cache=True)
def best_light(
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
    count: int,
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> float:
    """Return the light, at least 0, that a particle at this place gets by weighted least squares."""
    top = bottom = 0.0
    for k in range(count):
        w = weight[pixels[k]]
        top += w * values[k, 0] * residual[pixels[k]]
        bottom += w * values[k, 0] ** 2
    return max(top / bottom, 0.0) if bottom > 0.0 else 0.0


@njit(cache=True)
def add_light(
    pixels: NDArray[np.int32], values: NDArray[np.float64], count: int, light: float, image: NDArray[np.float64]
) -> None:
    """Add light times the response to an image."""
    for k in range(count):
        image[pixels[k]] += light * values[k, 0]


@njit(cache=True)
def fit_particle(
    view: View,
    particle: NDArray[np.float64],
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    z_low: float,
    z_high: float,
    steps: int,
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
) -> tuple[float, int]:
    """Improve a particle (4,) in place; return what it adds to chi-squared (below 0) and the count of its entries.

    The residual must not contain the particle. `pixels` and `values` hold its response on return. A particle without
    entries (off the sensor) is left as it is.
    """
    matrix, trial_matrix = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    right, trial_right = np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    step, trial, begin = np.zeros(UNKNOWNS), np.empty(UNKNOWNS), particle.copy()
    count = respond(view, particle[0], particle[1], particle[2], pixels, values)
    change = normal_equations(pixels, values, count, particle[3], residual, weight, matrix, right)
    damping, last_failed = DAMPING, False
    for _ in range(steps):
        if not solve_damped(matrix, right, damping, step):
            break
        predicted = 0.0
        for i in range(UNKNOWNS):
            predicted += step[i] * right[i]
        if predicted < SMALLEST_GAIN:
            break
        for i in range(UNKNOWNS):
            trial[i] = particle[i] + step[i]
        for i in range(2):
            trial[i] = min(max(trial[i], begin[i] - LARGEST_MOVE_MM), begin[i] + LARGEST_MOVE_MM)
        trial[2] = min(max(trial[2], particle[2] - LONGEST_DEPTH_STEP_MM), particle[2] + LONGEST_DEPTH_STEP_MM)
        trial[2] = min(max(trial[2], z_low), z_high)
        trial[3] = max(trial[3], 0.0)
        count = respond(view, trial[0], trial[1], trial[2], pixels, values)
        trial_change = normal_equations(pixels, values, count, trial[3], residual, weight, trial_matrix, trial_right)
        last_failed = not trial_change < change
        if last_failed:
            damping *= DAMPING_UP
            continue
        gain = change - trial_change
        particle[:], matrix[:], right[:], change = trial, trial_matrix, trial_right, trial_change
        damping *= DAMPING_DOWN
        if gain < SMALLEST_GAIN:
            break
    if last_failed:
        count = respond(view, particle[0], particle[1], particle[2], pixels, values)
    return change, count


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
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                particle = particles[tiles.order[at]]
                count = respond(view, particle[0], particle[1], particle[2], pixels, values)
                add_light(pixels, values, count, particle[3], residual)
                _, count = fit_particle(view, particle, residual, weight, z_low, z_high, SWEEP_STEPS, pixels, values)
                add_light(pixels, values, count, -particle[3], residual)


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
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
            trial, best = np.empty(UNKNOWNS), np.empty(UNKNOWNS)
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                number = tiles.order[at]
                lowest = 0.0
                for depth in START_DEPTHS_MM:
                    trial[:] = candidates[number]
                    trial[2] = min(max(trial[2] + depth, z_low), z_high)
                    count = respond(view, trial[0], trial[1], trial[2], pixels, values)
                    trial[3] = best_light(pixels, values, count, residual, weight)
                    change, count = fit_particle(
                        view, trial, residual, weight, z_low, z_high, CANDIDATE_STEPS, pixels, values
                    )
                    if change < lowest:
                        lowest = change
                        best[:] = trial
                if lowest == 0.0 or best[3] < smallest_light:
                    continue
                count = respond(view, best[0], best[1], best[2], pixels, values)
                if claimed_share(pixels, values, count, best[3], residual, weight) >= smallest_share:
                    candidates[number] = best
                    accepted[number] = True
                    add_light(pixels, values, count, -best[3], residual)
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
    for group in range(4):
        for tile in prange(tiles.groups[group], tiles.groups[group + 1]):
            pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
            for at in range(tiles.start[tile], tiles.start[tile + 1]):
                particle = particles[tiles.order[at]]
                count = respond(view, particle[0], particle[1], particle[2], pixels, values)
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
    for number in prange(len(particles)):
        pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
        x, y, z, light = particles[number]
        count = respond(view, x, y, z, pixels, values)
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
