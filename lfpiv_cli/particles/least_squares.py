"""Levenberg-Marquardt for one particle, or two together, in x, y, z and light.

With r the residual without the particles, w the weights and f a response, chi-squared differs from that without a
particle of light I by

    sum w (I^2 f^2 - 2 I f r),

a sum over the pixels that it lights wherever it moves.

What is expected of a particle before its image is looked at adds ((p - p_0) / sigma)^2 for each of its unknowns.

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import void
from numba.core.typing.typeof import typeof_impl
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, COUNT_REFERENCES, by_address, njit
from lfpiv_cli.particles.line_light import VALUES, respond_by_lines
from lfpiv_cli.particles.refraction import Rays, bend_of, room_for_rays
from lfpiv_cli.particles.rows import Scratch, respond_rows, scratch
from lfpiv_cli.particles.view import LARGEST_MOVE_LENSES, View, by_waves, entry_capacity, type_by_form

UNKNOWNS = 4
NO_ROWS = np.empty((0, UNKNOWNS))
# Damping relative to the diagonal: its start, and the factors after a step that failed or helped.
DAMPING = 1e-3
DAMPING_UP = 10.0
DAMPING_DOWN = 0.2
# A step that lowers chi-squared by less ends the fit: a hundredth of what one standard error costs where places are to
# be final; as much as that where it is only asked which of several places is right, half of it in between.
SMALLEST_GAIN, CHOICE_GAIN, SEARCH_GAIN = 0.01, 1.0, 0.5
# Longest step in depth, in depths over which light spreads by one lens (Table 2: 0.5 mm): further away the response is
# another one and its slope says nothing.
LONGEST_STEP_DEPTHS = 0.5 / 1.064
# What the compiler may do to sums: add many terms at once. The order is the same for any number of threads.
SUMS = {"reassoc", "contract", "nsz"}


class Responses(NamedTuple):
    """Responses of one particle or two that are fitted together.

    Attributes
    ----------
    counts, pixels, values : (k,), (k, capacity), (k, 4, capacity) as `respond_rows` writes them
    place : zeros, one for each pixel of as many rows as a footprint spans where there are two particles; serves to
        find common pixels
    common : (2, 4, capacity) where there are two particles, room for what both do to common pixels
    picked : (2, capacity), room for the residual and the weights of the pixels of one of them
    passed : (capacity,) room for the share of light that reaches these pixels
    began : (1,) what particles added to chi-squared where the last fit began
    rays, scratch : room for a particle's rays, and for what lenses show
    matrices, vectors, places : (3, 4 k, 4 k), (3, 4 k) and (2, k, 4), room for the steps of a fit
    block : (4, 4) room for what one of two does to the pixels
    """

    counts: NDArray[np.int64]
    pixels: NDArray[np.int32]
    values: Singles
    place: NDArray[np.int32]
    common: Floats
    picked: Floats
    passed: Singles
    began: Floats
    rays: Rays
    scratch: Scratch
    matrices: Floats
    vectors: Floats
    places: Floats
    block: Floats


Respond: TypeAlias = Callable[[View, Floats, Responses], None]


class Observation(NamedTuple):
    """What particles are fitted to.

    Attributes
    ----------
    respond : see `respond_of`
    optics : how particles are seen (numba reserves the name `view`)
    residual : (pixels,) what the particles leave of the image; kernels keep it up to date
    weight : (pixels,) 1/variance
    low_mm, high_mm : depths between which particles stay
    capacity : entries that a particle can have at most
    """

    respond: Respond
    optics: View
    residual: Floats
    weight: Floats
    low_mm: float
    high_mm: float
    capacity: int

    @property
    def depths_mm(self) -> tuple[float, float]:
        """Between which particles stay."""
        return self.low_mm, self.high_mm


typeof_impl.register(Observation)(type_by_form)


def observation_of(view: View, residual: Floats, weight: Floats, depths_mm: tuple[float, float]) -> Observation:
    """Return the observation of particles between two depths."""
    return Observation(respond_of(view), view, residual, weight, *depths_mm, entry_capacity(view, *depths_mm))


class Effort(NamedTuple):
    """How far a fit goes: so many steps at most, until one lowers chi-squared by less than `enough`."""

    steps: int
    enough: float


@njit(cache=True)
def room_for(members: int, capacity: int, places: int) -> Responses:
    """Return room for the responses of so many particles."""
    pixels, values = np.empty((members, capacity), np.int32), np.empty((members, VALUES, capacity), np.float32)
    common = np.empty((2, UNKNOWNS, capacity if members == 2 else 0))
    place, picked, began = np.zeros(places, np.int32), np.empty((2, capacity)), np.zeros(1)
    counts, rays, passed = np.zeros(members, np.int64), room_for_rays(), np.empty(capacity, np.float32)
    n = UNKNOWNS * members
    of_fit = np.empty((3, n, n)), np.zeros((3, n)), np.empty((2, members, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    return Responses(counts, pixels, values, place, common, picked, passed, began, rays, scratch(capacity), *of_fit)


@njit(cache=True, **COUNT_NO_REFERENCES)
def copy_rows(source: Floats, target: Floats) -> None:
    """Copy the rows of an array (n, m) into another; `target[:] = source` takes a second longer to compile."""
    for row in range(source.shape[0]):
        for column in range(source.shape[1]):
            target[row, column] = source[row, column]


@njit(cache=True, **COUNT_REFERENCES)
def lit_by(responses: Responses, member: int) -> tuple[NDArray[np.int32], Singles]:
    """Return the pixels (n,) that a particle lights, and values (4, n or more), the first of which are theirs."""
    return responses.pixels[member][: responses.counts[member]], responses.values[member]


@njit(cache=True, **COUNT_NO_REFERENCES)
def pick(pixels: NDArray[np.int32], image: NDArray[Any], picked: NDArray[Any]) -> None:
    """Fill in an image's values in some pixels: side by side, sums over them are taken many at once."""
    for k in range(pixels.size):
        # Without a sign a number is not asked whether it counts from the end.
        picked[k] = image[np.uint32(pixels[k])]


@njit(cache=True, fastmath=SUMS, **COUNT_NO_REFERENCES)
def normal_equations(
    pixels: NDArray[np.int32],
    values: Singles,
    light: float,
    observation: Observation,
    picked: Floats,
    matrix: Floats,
    right: Floats,
) -> float:
    """Fill J^T W J (4, 4) and J^T W (r - I f); return what the particle adds to chi-squared.

    `picked` (2, n or more) is room.
    """
    pick(pixels, observation.residual, picked[0])
    pick(pixels, observation.weight, picked[1])
    change = 0.0
    # Kept out of arrays, sums stay in registers.
    r0 = r1 = r2 = r3 = 0.0
    m00 = m01 = m02 = m03 = m11 = m12 = m13 = m22 = m23 = m33 = 0.0
    for k in range(pixels.size):
        r, w, d = picked[0, k], picked[1, k], values[0, k]
        f = light * d
        change += w * f * (f - 2.0 * r)
        a, b, c = light * values[1, k], light * values[2, k], light * values[3, k]
        left = w * (r - f)
        r0 += a * left
        r1 += b * left
        r2 += c * left
        r3 += d * left
        m00 += w * a * a
        m01 += w * a * b
        m02 += w * a * c
        m03 += w * a * d
        m11 += w * b * b
        m12 += w * b * c
        m13 += w * b * d
        m22 += w * c * c
        m23 += w * c * d
        m33 += w * d * d
    right[0], right[1], right[2], right[3] = r0, r1, r2, r3
    matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3] = m00, m01, m02, m03
    matrix[1, 1], matrix[1, 2], matrix[1, 3] = m11, m12, m13
    matrix[2, 2], matrix[2, 3], matrix[3, 3] = m22, m23, m33
    for row in range(1, UNKNOWNS):
        for column in range(row):
            matrix[row, column] = matrix[column, row]
    return change


@njit(cache=True, fastmath=SUMS, **COUNT_NO_REFERENCES)
def _product(one: Floats, other: Floats) -> float:
    """Return the scalar product of two vectors."""
    total = 0.0
    for k in range(one.size):
        total += one[k] * other[k]
    return total


@njit(cache=True, **COUNT_NO_REFERENCES)
def _pair_equations(
    observation: Observation, pair: Floats, responses: Responses, matrix: Floats, right: Floats
) -> float:
    """Fill the normal equations (8, 8) of two particles (2, 4); return what they add to chi-squared together.

    The place of the responses is zero again on return.
    """
    columns, residual, weight = observation.optics.camera.columns, observation.residual, observation.weight
    block = responses.block
    pixels_1, values_1 = responses.pixels[0][: responses.counts[0]], responses.values[0]
    pixels_2, values_2 = responses.pixels[1][: responses.counts[1]], responses.values[1]
    picked = responses.picked
    change = normal_equations(pixels_1, values_1, pair[0, 3], observation, picked, block, right[:UNKNOWNS])
    copy_rows(block, matrix[:UNKNOWNS, :UNKNOWNS])
    add_light(pixels_1, values_1, -pair[0, 3], residual)
    change += normal_equations(pixels_2, values_2, pair[1, 3], observation, picked, block, right[UNKNOWNS:])
    copy_rows(block, matrix[UNKNOWNS:, UNKNOWNS:])
    add_light(pixels_1, values_1, pair[0, 3], residual)
    # What the first explains is off the second's side already; the first's side still lacks the second's light.
    if pixels_1.size == 0:
        return change
    place, start = responses.place, pixels_1[0]
    for pixel in pixels_1:
        start = min(start, pixel)
    start = start // columns * columns
    # Backwards: of a pixel that is named again the first entry counts.
    for k in range(pixels_1.size - 1, -1, -1):
        place[pixels_1[k] - start] = k + 1
    one, two = responses.common[0], responses.common[1]
    count = 0
    for k in range(pixels_2.size):
        away = pixels_2[k] - start
        if not 0 <= away < place.size or place[away] == 0:
            continue
        at = place[away] - 1
        w = weight[pixels_2[k]]
        for i in range(UNKNOWNS):
            one[i, count] = w * values_1[i, at]
            two[i, count] = values_2[i, k]
        count += 1
    for i in range(UNKNOWNS):
        # Values begin with light, unknowns end with it.
        by_i, scale_i = (i + 1) % UNKNOWNS, pair[0, 3] if i < 3 else 1.0
        right[i] -= scale_i * pair[1, 3] * _product(one[by_i, :count], two[0, :count])
        for j in range(UNKNOWNS):
            by_j, scale_j = (j + 1) % UNKNOWNS, pair[1, 3] if j < 3 else 1.0
            cross = scale_i * scale_j * _product(one[by_i, :count], two[by_j, :count])
            matrix[i, UNKNOWNS + j] = matrix[UNKNOWNS + j, i] = cross
    for pixel in pixels_1:
        place[pixel - start] = 0
    return change


@njit(cache=True, **COUNT_NO_REFERENCES)
def factored(matrix: Floats, damping: float, lower: Floats) -> bool:
    """Fill L of A + damping diag A = L L^T (Cholesky); return False where that is not positive definite."""
    for i in range(matrix.shape[0]):
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
    return True


@njit(cache=True, **COUNT_NO_REFERENCES)
def substitute(lower: Floats, right: Floats, solution: Floats) -> None:
    """Fill the x of L L^T x = b."""
    n = lower.shape[0]
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * solution[k]
        solution[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * solution[k]
        solution[i] = total / lower[i, i]


@njit(cache=True, **COUNT_NO_REFERENCES)
def fit(observation: Observation, members: Floats, prior: Floats, responses: Responses, effort: Effort) -> float:
    """Improve one particle or two (k, 4) in place; return what they add to chi-squared (below 0 where they help).

    The residual must contain none of them. Particles without pixels (off the sensor) are left as they are.

    Parameters
    ----------
    prior : (k, 8) values and weights 1/sigma^2 of what is expected of them; weights of 0: nothing is
    responses : of the particles, on entry as on return; says on return where the fit began
    """
    n = UNKNOWNS * members.shape[0]
    matrix, trial_matrix, lower = responses.matrices[0], responses.matrices[1], responses.matrices[2]
    right, trial_right, step = responses.vectors[0], responses.vectors[1], responses.vectors[2]
    trial, begin = responses.places[0], responses.places[1]
    copy_rows(members, begin)
    change = _equations(observation, members, prior, responses, matrix, right)
    responses.began[0] = change
    damping, last_failed = DAMPING, False
    for _ in range(effort.steps):
        if not factored(matrix, damping, lower):
            break
        substitute(lower, right, step)
        predicted = 0.0
        for i in range(n):
            predicted += step[i] * right[i]
        if predicted < effort.enough:
            break
        _move(observation, members, begin, step, trial)
        observation.respond(observation.optics, trial, responses)
        trial_change = _equations(observation, trial, prior, responses, trial_matrix, trial_right)
        last_failed = not trial_change < change
        if last_failed:
            damping *= DAMPING_UP
            continue
        gain = change - trial_change
        copy_rows(trial, members)
        matrix, trial_matrix, right, trial_right, change = trial_matrix, matrix, trial_right, right, trial_change
        damping *= DAMPING_DOWN
        if gain < effort.enough:
            break
    if last_failed:
        observation.respond(observation.optics, members, responses)
    return change


# Inlined: one function less to compile all of the response into.
@njit(cache=True, inline="always", **COUNT_NO_REFERENCES)
def _equations(
    observation: Observation, members: Floats, prior: Floats, responses: Responses, matrix: Floats, right: Floats
) -> float:
    """Fill the normal equations of one particle or two; return what they add to chi-squared."""
    if members.shape[0] == 2:
        change = _pair_equations(observation, members, responses, matrix, right)
    else:
        pixels, values = responses.pixels[0][: responses.counts[0]], responses.values[0]
        change = normal_equations(pixels, values, members[0, 3], observation, responses.picked, matrix, right)
    for m in range(members.shape[0]):
        for i in range(UNKNOWNS):
            expected, weight, row = prior[m, i], prior[m, UNKNOWNS + i], m * UNKNOWNS + i
            right[row] += weight * (expected - members[m, i])
            matrix[row, row] += weight
    return change + prior_chi2(members, prior)


@njit(cache=True, **COUNT_NO_REFERENCES)
def prior_chi2(members: Floats, prior: Floats) -> float:
    """Return what particles (k, 4) add to chi-squared by being other than expected (k, 8)."""
    total = 0.0
    for m in range(members.shape[0]):
        for i in range(UNKNOWNS):
            total += prior[m, UNKNOWNS + i] * (members[m, i] - prior[m, i]) ** 2
    return total


@njit(cache=True, **COUNT_NO_REFERENCES)
def _move(observation: Observation, members: Floats, begin: Floats, step: Floats, trial: Floats) -> None:
    """Fill `trial` (k, 4) with particles moved by a step, within what a sweep and a linear model allow."""
    scale = observation.optics.scale
    furthest, deepest = LARGEST_MOVE_LENSES * scale.lens_mm, LONGEST_STEP_DEPTHS * scale.depth_mm
    for m in range(members.shape[0]):
        for i in range(UNKNOWNS):
            trial[m, i] = members[m, i] + step[m * UNKNOWNS + i]
        for i in range(2):
            trial[m, i] = min(max(trial[m, i], begin[m, i] - furthest), begin[m, i] + furthest)
        low, high = members[m, 2] - deepest, members[m, 2] + deepest
        trial[m, 2] = min(max(trial[m, 2], low, observation.low_mm), high, observation.high_mm)
        trial[m, 3] = max(trial[m, 3], 0.0)


def respond_all(view: View, members: Floats, responses: Responses) -> None:
    """Write the responses of one particle or two (k, 4)."""
    (_respond_by_waves if by_waves(view) else _respond_by_rays)(view, members, responses)


def respond_of(view: View) -> Respond:
    """Return the address of what writes responses, as `respond_all` does, by the view's light."""
    respond: Respond = by_address(
        _respond_by_waves if by_waves(view) else _respond_by_rays, void, view, NO_ROWS, room_for(1, 1, 0)
    )
    return respond


@njit(cache=True, **COUNT_NO_REFERENCES)
def _respond_by_rays(view: View, members: Floats, responses: Responses) -> None:
    """Write responses by rays."""
    for m in range(members.shape[0]):
        pixels, values = responses.pixels[m], responses.values[m]
        bend = bend_of(view, members[m, 0], members[m, 1], members[m, 2], responses.rays)
        responses.counts[m] = respond_rows(view, bend, pixels, values, responses.scratch)
        _pass(view.passed, pixels[: responses.counts[m]], values, responses.passed)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _respond_by_waves(view: View, members: Floats, responses: Responses) -> None:
    """Write responses by waves."""
    for m in range(members.shape[0]):
        pixels, values = responses.pixels[m], responses.values[m]
        bend = bend_of(view, members[m, 0], members[m, 1], members[m, 2], responses.rays)
        responses.counts[m] = respond_by_lines(view, bend, members[m, 2], pixels, values)
        _pass(view.passed, pixels[: responses.counts[m]], values, responses.passed)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _pass(passed: Singles, pixels: NDArray[np.int32], values: Singles, shares: Singles) -> None:
    """Leave of light and its derivatives what reaches the pixels, all where nothing is known of it.

    `shares` is room.
    """
    if passed.size == 0:
        return
    pick(pixels, passed, shares)
    for m in range(UNKNOWNS):
        light = values[m]
        for k in range(pixels.size):
            light[k] *= shares[k]


@njit(cache=True, fastmath=SUMS, **COUNT_NO_REFERENCES)
def best_light(pixels: NDArray[np.int32], values: Singles, residual: Floats, weight: Floats) -> float:
    """Return the light, at least 0, that a particle at this place gets by weighted least squares."""
    top = bottom = 0.0
    for k in range(pixels.size):
        w = weight[pixels[k]]
        top += w * values[0, k] * residual[pixels[k]]
        bottom += w * values[0, k] ** 2
    return max(top / bottom, 0.0) if bottom > 0.0 else 0.0


@njit(cache=True, fastmath=SUMS, **COUNT_NO_REFERENCES)
def change_by(pixels: NDArray[np.int32], values: Singles, light: float, residual: Floats, weight: Floats) -> float:
    """Return what a particle of this light adds to chi-squared."""
    change = 0.0
    for k in range(pixels.size):
        f = light * values[0, k]
        change += weight[pixels[k]] * f * (f - 2.0 * residual[pixels[k]])
    return change


@njit(cache=True, **COUNT_NO_REFERENCES)
def add_light(pixels: NDArray[np.int32], values: Singles, light: float, image: Floats) -> None:
    """Add light times the response to an image."""
    for k in range(pixels.size):
        image[pixels[k]] += light * values[0, k]
