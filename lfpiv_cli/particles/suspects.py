"""Verification of particles that fit badly: two overlapping ones found as one, or one at a wrong depth.

Axes: see `search`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import Scale
from lfpiv_cli.kernels import njit
from lfpiv_cli.particles.fitting import NO_FURTHER, Choice, Elsewhere, Fitter, fit_again, fitter_of, light_errors
from lfpiv_cli.particles.least_squares import (
    CHOICE_GAIN,
    UNKNOWNS,
    Effort,
    Observation,
    add_light,
    change_by,
    copy_rows,
    lit_by,
    room_for,
)
from lfpiv_cli.particles.search import GOOD_PERCENTILE, SMALLEST_LIGHT, State, Task, observed, usual_chi2
from lfpiv_cli.particles.view import by_waves, footprint_px, footprint_radius_mm, over_tiles

# Overlapping particle images: two particles where one was found, if two explain the light much better.
#
# Both are fitted together, eight unknowns: block coordinates creep where two responses nearly coincide.
#
# Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).


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
# Steps from every start. The best one is fitted on, so many steps at most, if it has by then gained this share of what
# is asked for.
FIRST_STEPS = 4
PAIR_STEPS = 12
FIRST_GAIN = 0.25


def split(
    observation: Observation,
    particles: Floats,
    suspects: NDArray[np.bool_],
    smallest_light: float,
    smallest_gain: Floats,
) -> Floats:
    """Replace suspects by two particles where that lowers chi-squared by `smallest_gain`.

    The first of the two takes the suspect's place in `particles` (n, 4); the second ones are returned in an array of
    the same shape whose other rows are zero. The residual is kept up to date.
    """
    partners, fitter = np.zeros_like(particles), fitter_of(observation)
    places = footprint_px(observation.optics, *observation.depths_mm) * observation.optics.camera.columns
    first, then = Effort(FIRST_STEPS, CHOICE_GAIN), Effort(PAIR_STEPS, CHOICE_GAIN)
    choice = Choice(first, then, 1, smallest_light, np.inf)
    arguments = fitter, particles, places, choice, smallest_gain, partners
    over_tiles(_split, observation.optics, particles, observation.depths_mm, *arguments, chosen=suspects)
    return partners


@njit(cache=True, nogil=True)
def _split(
    numbers: NDArray[np.int64],
    fitter: Fitter,
    particles: Floats,
    places: int,
    choice: Choice,
    gain: Floats,
    partners: Floats,
) -> None:
    """Do the work of `split` for suspects of a tile; `gain` is what two must lower chi-squared by."""
    observation, _ = fitter.to
    view, residual, scale = observation.optics, observation.residual, observation.optics.scale
    responses, prior = room_for(2, observation.capacity, places), np.zeros((2, 2 * UNKNOWNS))
    best, starts = np.empty((2, UNKNOWNS)), np.empty((len(STARTS), 2, UNKNOWNS))
    for number in numbers:
        one = particles[number : number + 1]
        light = one[0, 3]
        observation.respond(view, one, responses)
        pixels, values = lit_by(responses, 0)
        add_light(pixels, values, light, residual)
        single = change_by(pixels, values, light, residual, observation.weight)
        for start, offset in enumerate(STARTS):
            for m in range(2):
                sign, pair = 1.0 - 2.0 * m, starts[start]
                pair[m, 0] = one[0, 0] + sign * offset[0] * scale.lens_mm
                pair[m, 1] = one[0, 1] + sign * offset[1] * scale.lens_mm
                depth = one[0, 2] + sign * offset[2] * scale.depth_mm
                pair[m, 2] = min(max(depth, observation.low_mm), observation.high_mm)
                pair[m, 3] = 0.5 * light
        limits = single - FIRST_GAIN * gain[number], single - gain[number]
        if fitter.best(fitter.to, starts, prior, responses, choice, limits, best) < limits[1]:
            copy_rows(best[:1], one)
            copy_rows(best[1:], partners[number : number + 1])
            observation.respond(view, best, responses)
            for m in range(2):
                pixels, values = lit_by(responses, m)
                add_light(pixels, values, -best[m, 3], residual)
        else:
            observation.respond(view, one, responses)
            pixels, values = lit_by(responses, 0)
            add_light(pixels, values, -light, residual)


# Alternative depths for particles that fit badly, and for those near the focal plane, where many depths look alike.
#
# A fit finds the nearest minimum of chi-squared. Near the focal plane, where one lens holds most of a particle's
# light, chi-squared has several minima along the depth, one of them mirrored; elsewhere a neighbour that was not
# known yet may have led to the wrong one.
#
# Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).


# Starts relative to the particle's depth, in depths over which light spreads by one lens (Table 2: 0.2 to 2 mm); its
# mirrored depth is another.
OTHER_DEPTHS = np.array([-2.0, -1.5, -1.0, -0.7, -0.4, -0.2, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0]) / 1.064
STEPS, FINALISTS = 14, 2


def try_other_depths(
    observation: Observation,
    particles: Floats,
    suspects: NDArray[np.bool_],
    smallest_light: float,
    smallest_gain: float,
    prior: Floats | None = None,
) -> NDArray[np.bool_]:
    """Move suspects to another depth where that lowers chi-squared by `smallest_gain` more than refinement does.

    All suspects among the particles (n, 4) are refined; the residual is kept up to date. Returns which have moved.
    """
    depth = particles[:, 2:3]
    starts = np.concatenate([depth + OTHER_DEPTHS * observation.optics.scale.depth_mm, -depth], axis=1)
    starts[(starts < observation.low_mm) | (starts > observation.high_mm)] = np.nan
    effort = Effort(STEPS, CHOICE_GAIN)
    choice = Choice(effort, NO_FURTHER, FINALISTS, smallest_light, np.inf)
    elsewhere = Elsewhere(starts, choice, smallest_gain)
    return fit_again(observation, particles, suspects, effort, elsewhere, prior).moved


# Suspects fit worse than the noise predicts, and so many times as much worse as good ones where these do, too.
SUSPECT_CHI2 = 1.5
# Light that stays within about one lens fits well at many depths: radii, in lenses, of footprints near the focal plane.
# Elsewhere hardly one in a hundred suspects finds another depth: it must fit worse by this factor.
NEAR_FOCUS_LENSES, ELSEWHERE_CHI2 = 0.6, 3.0
# Suspected to be two: brighter than typical by this factor, or, in thorough rounds, bright enough for two.
BRIGHT, ENOUGH_FOR_TWO = 1.2, 2.0 * SMALLEST_LIGHT
# What chi-squared must fall by where one becomes two: little more than by noise, as their neighbours give way to two
# only afterwards, and two that are one are joined then; and many times what good ones have beyond the noise. Tables of
# light by waves lack up to half a percent of it, which several explain one after the other. And where one changes its
# depth, in units of a good particle's.
SPLIT_GAIN, SPLIT_GAIN_BY_WAVES, SPLIT_GAIN_BEYOND, DEPTH_GAIN = 8.0, 40.0, 40.0, 10.0
# And where the model of light is wrong, so many times what it leaves of those that fit well: by others it leaves more.
# Of tracers of eight points by waves, up to 4 % of whose light is elsewhere, from 40 to 100 as few are found as two.
MODEL_GAIN = 50.0
# A particle that could not be split or moved is not tried again until it has changed by this much: laterally in
# microlenses, in depths over which light spreads by one lens (Table 2: 0.05 mm), and by these shares in light and in
# chi-squared.
CHANGED_LENSES, CHANGED_DEPTHS, CHANGED_SHARES = 0.05, 0.05 / 1.064, (0.05, 0.2)


def with_depths_corrected(task: Task, state: State, chi2: Floats, unexplained: float, good: float) -> State:
    """Return the state with particles moved to depths that explain the light better, the residual in place.

    `good` is chi-squared of those that fit well.
    """
    observation = observed(task, state, unexplained)
    near_focus = footprint_radius_mm(task.view, state.particles) < NEAR_FOCUS_LENSES * 2.0 * task.view.half_x_mm
    signature = _signature(task.view.scale, state.particles, chi2)
    suspects = (near_focus | (chi2 > ELSEWHERE_CHI2 * good)) & ~_tried(state.unmoved, signature)
    light = SMALLEST_LIGHT * state.typical_light
    moved = try_other_depths(observation, state.particles, suspects, light, DEPTH_GAIN * good, state.prior)
    return replace(state, unmoved=np.concatenate([state.unmoved, signature[suspects & ~moved]]))


def with_overlaps_split(
    task: Task,
    state: State,
    chi2: Floats,
    unexplained: float,
    good: float,
    thorough: bool,
    least: Floats | float = 0.0,
) -> State:
    """Return the state with overlapping particles separated; `thorough`: also those of usual brightness.

    `good` is chi-squared of those that fit well, `least` what two must lower it by at least, of each or of all.
    """
    observation = observed(task, state, unexplained)
    bright = state.particles[:, 3] > (ENOUGH_FOR_TWO if thorough else BRIGHT) * state.typical_light
    signature = _signature(task.view.scale, state.particles, chi2)
    suspects = bright & (chi2 > 1.0 + SUSPECT_CHI2 * (good - 1.0)) & ~_tried(state.unsplit, signature)
    light = SMALLEST_LIGHT * state.typical_light
    usual = SPLIT_GAIN_BY_WAVES if by_waves(task.view) else SPLIT_GAIN
    gain = np.full(len(state.particles), np.maximum(usual + SPLIT_GAIN_BEYOND * (good - 1.0), least))
    partners = split(observation, state.particles, suspects, light, gain)
    found = partners[:, 3] > 0.0
    return replace(
        state,
        particles=np.concatenate([state.particles, partners[found]]),
        unsplit=np.concatenate([state.unsplit, signature[suspects & ~found]]),
    )


def lacking(task: Task, state: State, unexplained: float) -> Floats:
    """Return by how much two must lower chi-squared for each particle (n,), as the model of light is wrong; 0 if not.

    As wrong as it is for those that fit well, it is for all. In crowds what is left is that of many.
    """
    model = task.light - state.residual
    error2, power = light_errors(observed(task, state, unexplained), state.particles, model)
    usual = float(np.percentile(error2, GOOD_PERCENTILE)) if len(error2) else 0.0
    return MODEL_GAIN * max(usual, 0.0) * power


def good_chi2(chi2: Floats) -> float:
    """Return chi-squared of a particle that fits well, at least 1."""
    return max(usual_chi2(chi2), 1.0)


def _signature(scale: Scale, particles: Floats, chi2: Floats) -> Floats:
    """Return (n, 5) numbers that differ by 1 where a particle has changed enough to be tried again."""
    tiny = np.finfo(np.float64).tiny
    shares = np.log(np.maximum(np.column_stack([particles[:, 3], chi2]), tiny)) / CHANGED_SHARES
    return np.column_stack([particles[:, :3] / scale.box_mm(CHANGED_LENSES, CHANGED_DEPTHS), shares])


def _tried(before: Floats, signature: Floats) -> NDArray[np.bool_]:
    """Return which particles were tried before and have hardly changed since."""
    if not len(before):
        return np.zeros(len(signature), dtype=bool)
    distance, _ = KDTree(before).query(signature, p=np.inf, distance_upper_bound=1.0)
    return np.isfinite(distance)
