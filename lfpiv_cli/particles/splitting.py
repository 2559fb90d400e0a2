"""Overlapping particle images: two particles where one was found, if two explain the light much better.

Both are fitted together, eight unknowns: block coordinates creep where two responses nearly coincide.

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.particles.least_squares import (
    CHOICE_GAIN,
    UNKNOWNS,
    Effort,
    Observation,
    add_light,
    copy_rows,
    fit,
    lit_by,
    normal_equations,
    respond_all,
    room_for,
)
from lfpiv_cli.particles.tiles import footprint_px, over_tiles

# Half the distance (x, y, z) of two particles at the start: sideways in microlenses, or along the depth in which a
# volume shows two as one, in depths over which light spreads by one lens (Table 2: 0.2, 0.5 and 1 mm).
STARTS = np.array(
    [
        (0.3, 0.0, 0.0),
        (0.0, 0.3, 0.0),
        (0.2, 0.2, 0.0),
        (0.2, -0.2, 0.0),
        (0.0, 0.0, 0.2 / 1.064),
        (0.0, 0.0, 0.5 / 1.064),
        (0.0, 0.0, 1.0 / 1.064),
    ]
)
# Steps from every start. The best ones are fitted on, so many steps at most, if they have by then gained this share of
# what is asked for: which place is right shows long before a fit has ended.
FIRST_STEPS = 4
FINALISTS = 2
PAIR_STEPS = 12
FIRST_GAIN = 0.25


def split(
    observation: Observation,
    particles: NDArray[np.float64],
    suspects: NDArray[np.bool_],
    smallest_light: float,
    smallest_gain: float,
) -> NDArray[np.float64]:
    """Replace suspects by two particles where that lowers chi-squared by `smallest_gain`.

    The first of the two takes the suspect's place in `particles` (n, 4); the second ones are returned in an array of
    the same shape whose other rows are zero. The residual is kept up to date.
    """
    partners = np.zeros_like(particles)
    places = footprint_px(observation.optics, *observation.depths_mm) * observation.optics.camera.columns

    def work(numbers: NDArray[np.int64]) -> None:
        least = (smallest_gain, smallest_light)
        efforts = Effort(FIRST_STEPS, CHOICE_GAIN), Effort(PAIR_STEPS, CHOICE_GAIN)
        _split(observation, particles, numbers[suspects[numbers]], places, efforts, least, partners)

    over_tiles(work, observation.optics, particles, observation.depths_mm)
    return partners


@njit(cache=True, nogil=True)
def _split(
    observation: Observation,
    particles: NDArray[np.float64],
    numbers: NDArray[np.int64],
    places: int,
    efforts: tuple[Effort, Effort],
    least: tuple[float, float],
    partners: NDArray[np.float64],
) -> None:
    """Do the work of `split` for suspects of a tile.

    `efforts` are for every start and for the best ones; `least` is what two must gain, and the light of each.
    """
    view, residual, scale = observation.optics, observation.residual, observation.optics.scale
    responses = room_for(2, observation.capacity, places)
    matrix, right = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    pair, best = np.empty((2, UNKNOWNS)), np.empty((2, UNKNOWNS))
    prior = np.zeros((2, 2 * UNKNOWNS))
    begun, changes = np.empty((len(STARTS), 2, UNKNOWNS)), np.empty(len(STARTS))
    for number in numbers:
        one = particles[number : number + 1]
        light = one[0, 3]
        respond_all(view, one, responses)
        pixels, values = lit_by(responses, 0)
        add_light(pixels, values, light, residual)
        single = normal_equations(pixels, values, light, residual, observation.weight, responses.picked, matrix, right)
        lowest = single - least[0]
        promising = single - FIRST_GAIN * least[0]
        for start, offset in enumerate(STARTS):
            for m in range(2):
                sign = 1.0 - 2.0 * m
                pair[m, 0] = one[0, 0] + sign * offset[0] * scale.lens_mm
                pair[m, 1] = one[0, 1] + sign * offset[1] * scale.lens_mm
                depth = one[0, 2] + sign * offset[2] * scale.depth_mm
                pair[m, 2] = min(max(depth, observation.low_mm), observation.high_mm)
                pair[m, 3] = 0.5 * light
            respond_all(view, pair, responses)
            changes[start] = fit(observation, pair, prior, responses, efforts[0])
            copy_rows(pair, begun[start])
        found = False
        for _ in range(FINALISTS):
            chosen = np.argmin(changes)
            if changes[chosen] > promising:
                break
            changes[chosen] = np.inf
            copy_rows(begun[chosen], pair)
            respond_all(view, pair, responses)
            change = fit(observation, pair, prior, responses, efforts[1])
            if change < lowest and min(pair[0, 3], pair[1, 3]) >= least[1]:
                lowest, found = change, True
                copy_rows(pair, best)
        if found:
            copy_rows(best[:1], one)
            copy_rows(best[1:], partners[number : number + 1])
            respond_all(view, best, responses)
            for m in range(2):
                pixels, values = lit_by(responses, m)
                add_light(pixels, values, -best[m, 3], residual)
        else:
            respond_all(view, one, responses)
            pixels, values = lit_by(responses, 0)
            add_light(pixels, values, -light, residual)
