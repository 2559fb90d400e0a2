"""Iterative particle reconstruction from a raw image: candidates, acceptance, splitting, refinement and pruning.

Each round explains what is left of the image by a volume, takes its peaks as candidates, fits and accepts those whose
light is there, separates overlapping ones and refines all. Early rounds accept only what is plainly there and let
unexplained light count for little; later ones ask for less and verify every particle that fits badly. What is found
then is tried at other depths, too. Ghost particles find too little light and are pruned.

Axes: see `search`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.particles.fitting import Least, accept, judge
from lfpiv_cli.particles.joining import (
    LARGEST_LOSS,
    boxes_of,
    explain_rest,
    find_peaks,
    points_in_raw_frame,
    with_twins_joined,
)
from lfpiv_cli.particles.least_squares import SEARCH_GAIN
from lfpiv_cli.particles.refraction import places_by_snell
from lfpiv_cli.particles.search import (
    LAST_SWEEPS,
    LAST_UNEXPLAINED,
    SMALLEST_LIGHT,
    SMALLEST_SEEN,
    Fits,
    State,
    Task,
    blank,
    judged,
    noise_with,
    observed,
    prune,
    sweep,
    usual_light,
    with_measured_noise,
    with_typical_light,
)
from lfpiv_cli.particles.stated import Particles, result
from lfpiv_cli.particles.suspects import good_chi2, lacking, with_depths_corrected, with_overlaps_split
from lfpiv_cli.particles.view import lens_pixels


@dataclass(frozen=True)
class Round:
    """One round.

    Attributes
    ----------
    iterations : of expectation maximisation
    claimed_share : least share of its claimed light that a candidate must find
    unexplained : weight of light above the model in a pixel's variance
    thorough : whether particles of usual brightness are suspects, too
    """

    iterations: int
    claimed_share: float
    unexplained: float
    thorough: bool


# As long as half the light is unexplained most particles fit badly, and verifying them all is in vain.
ROUNDS = (
    Round(13, 0.9, 0.3, thorough=False),
    Round(8, 0.85, 0.2, thorough=False),
    Round(8, 0.8, 0.1, thorough=True),
    Round(5, 0.75, 0.07, thorough=True),
    Round(4, 0.7, 0.05, thorough=True),
    Round(4, 0.6, 0.05, thorough=True),
)

# A thorough round that finds no more than this share more is the last one; what follows looks for more anyway. Where
# there is none yet, it may be found by a round that asks for less.
FEW = 0.01
# Sweeps of refinement after candidates and after splitting: with twice as many as many tracers are found, or fewer.
SWEEPS, SWEEPS_AFTER_SPLIT = 2, 1
# How often particles are checked, and joined afterwards, at most: until that changes their number by hardly any more.
# With 0.65 for each microlens that is after three checks and one join, with 3 after twelve and ten.
MOST_CHECKS, MOST_JOINS, HARDLY_ANY = 40, 12, 0.003
# Chi-squared of good ones where little more than noise is left, and by what each check must lower it until then: by a
# tenth and more with 3 and 4 for each microlens; of tracers that are fitted by rays, but lit by waves, by a twentieth
# to a seventh, and it stays at 3.
NEXT_TO_NOISE, LEAST_PROGRESS = 2.0, 0.93
# Of crowds the first ones found are several in one, and those too faint beside them that are single: where the brighter
# ones, at this percentile, are fainter than what was typical, they are.
BRIGHTER_PERCENTILE = 75.0
# Before any particle is known, its light is taken from the peaks: one in ten is brighter than a typical particle. Where
# not even so many stand out of the noise, as with few tracers, most peaks are noise: then one in ten of those that do.
FIRST_TYPICAL_PERCENTILE = 90.0
# A peak stands out that is brighter than noise makes a particle's light by this factor. Peaks are the largest of many
# thousands, and gather noise from more pixels than a particle lights.
STANDING_OUT = 20.0
# Share of a typical particle's light that a peak must have to be tried.
CANDIDATE_LIGHT = 0.05
# What a candidate must lower chi-squared by: among thousands of places noise alone gives some 30.
CANDIDATE_GAIN = 50.0
# A particle stays while it finds this much less of its light than a candidate had to.
PRUNING_SLACK = 0.3


def find_particles(
    task: Task, rounds: tuple[Round, ...] = ROUNDS, progress: Callable[[int], None] | None = None
) -> Particles:
    """Return the particles that explain a raw image; `progress` is called with 1 after each iteration and round."""
    return result(task, first_pass(task, rounds, progress))


def first_pass(task: Task, rounds: tuple[Round, ...] = ROUNDS, progress: Callable[[int], None] | None = None) -> State:
    """Return the state after the rounds, without the help of other frames; see `find_particles`."""
    return finished(task, after_rounds(task, blank(task), rounds, progress), rounds[-1])


def after_rounds(
    task: Task, state: State, rounds: tuple[Round, ...], progress: Callable[[int], None] | None = None
) -> State:
    """Return the state after some more rounds: as many as find more than few that the one before had not."""
    for number, settings in enumerate(rounds):
        before = len(state.particles)
        candidates, light = candidates_of(task, state, settings.iterations, progress)
        state = explained(task, *with_candidates(task, state, candidates, light), settings)
        if progress:
            progress(1)
        if settings.thorough and 0 < len(state.particles) <= (1.0 + FEW) * before:
            if progress:
                progress(steps_of(rounds[number + 1 :]))
            break
    return state


def steps_of(rounds: tuple[Round, ...]) -> int:
    """Return the units of progress that rounds report."""
    return sum(settings.iterations + 1 for settings in rounds)


def finished(task: Task, state: State, settings: Round) -> State:
    """Return the state refined with the noise that is left, without what does not hold then.

    Two tracers with one peak are told from one by that noise alone: what is assumed while most are sought leaves bright
    pixels much freedom. First all that fits worse than the noise predicts is taken for several in one, as in crowds
    most are. Where that does not leave noise alone the model of light is wrong, and only what fits worse than good ones
    is.
    """
    begin = replace(state, particles=state.particles.copy(), residual=state.residual.copy())
    apart, good = separated(task, begin, settings, to_noise=True)
    if good > NEXT_TO_NOISE:
        apart, _ = separated(task, state, settings, to_noise=False)
    return concluded(task, apart, settings)


def separated(task: Task, state: State, settings: Round, to_noise: bool) -> tuple[State, float]:
    """Return the state after checks until hardly any more are found, and chi-squared of its good ones.

    Suspected is what fits worse than good ones, or with `to_noise` than the noise predicts; then checks end, too, where
    they lead no further.
    """
    found, good = True, np.inf
    for check in range(MOST_CHECKS):
        before, good_before = len(state.particles), good
        state = with_measured_noise(task, state)
        sweep(task, state, LAST_UNEXPLAINED, LAST_SWEEPS)
        if check > 0 and found and len(state.particles):
            candidates, light = candidates_of(task, state, settings.iterations, None)
            candidates = candidates[light > CANDIDATE_LIGHT * state.typical_light]
            state = accepted(task, state, candidates, replace(settings, unexplained=LAST_UNEXPLAINED))
            sweep(task, state, LAST_UNEXPLAINED, LAST_SWEEPS)
            found = len(state.particles) > before
        fits = judged(task, state, LAST_UNEXPLAINED)
        good = good_chi2(fits.chi2)
        if to_noise and good > max(NEXT_TO_NOISE, LEAST_PROGRESS * good_before):
            break
        fainter = usual_light(state, fits, BRIGHTER_PERCENTILE) or state.typical_light
        state = replace(state, typical_light=min(state.typical_light, fainter))
        state = with_suspects_tried(task, state, fits, LAST_UNEXPLAINED, 1.0 if to_noise else good)
        if check > 0 and len(state.particles) - before <= HARDLY_ANY * before:
            break
    return state, good


def with_suspects_tried(
    task: Task, state: State, fits: Fits, unexplained: float, good: float, least: Floats | float = 0.0
) -> State:
    """Return the state after all that fit worse than `good` were tried as two, and before that at other depths.

    `least` is what two must lower chi-squared by at least, of each or of all.
    """
    state = with_depths_corrected(task, state, fits.chi2, unexplained, good)
    return with_overlaps_split(task, state, fits.chi2, unexplained, good, thorough=True, least=least)


def concluded(task: Task, state: State, settings: Round) -> State:
    """Return the state with those joined that the noise does not tell apart, without those that do not hold.

    Joined ones leave the others other light: again, until hardly any are joined. What is split then must gain what two
    that are joined may lose, or the two would go to and fro.
    """
    for number in range(MOST_JOINS):
        state = with_measured_noise(task, state)
        sweep(task, state, LAST_UNEXPLAINED, LAST_SWEEPS)
        before = len(state.particles)
        lacks = lacking(task, state, LAST_UNEXPLAINED)
        state = with_twins_joined(task, state, LAST_UNEXPLAINED, judged(task, state, LAST_UNEXPLAINED).chi2, lacks)
        if number == MOST_JOINS - 1 or before - len(state.particles) <= HARDLY_ANY * before:
            break
        sweep(task, state, LAST_UNEXPLAINED, LAST_SWEEPS)
        fits = judged(task, state, LAST_UNEXPLAINED)
        good = good_chi2(fits.chi2)
        least = np.maximum(lacking(task, state, LAST_UNEXPLAINED), LARGEST_LOSS * good)
        state = with_suspects_tried(task, state, fits, LAST_UNEXPLAINED, good, least)
    return pruned(task, state, settings)[0]


def pruned(task: Task, state: State, settings: Round) -> tuple[State, Fits]:
    """Return the state without particles that do not find their light, as a round asks for it, and how these fit."""
    return prune(task, state, settings.claimed_share - PRUNING_SLACK, settings.unexplained)


def explained(task: Task, state: State, candidates: Floats, settings: Round) -> State:
    """Return the state with what of the candidates holds, refined and checked."""
    state = accepted(task, state, candidates, settings)
    sweep(task, state, settings.unexplained, SWEEPS, SEARCH_GAIN)
    fits = judged(task, state, settings.unexplained)
    state = with_typical_light(task, state, fits)
    return with_typical_light(task, *with_suspects_checked(task, state, fits, settings))


def with_candidates(task: Task, state: State, candidates: Floats, light: Floats) -> tuple[State, Floats]:
    """Return the state with its typical light, by candidates where no particle is known, and those to be tried."""
    typical, bright = state.typical_light, light > task.least_light
    candidates, light = candidates[bright], light[bright]
    if typical == 0.0:
        # Where hardly any light meets the sensor, at the volume's rim, noise becomes peaks brighter than tracers.
        *_, seen = judge(observed(task, state, LAST_UNEXPLAINED), candidates)
        noise = state.noise.of_dark(task.haze) * np.sqrt(lens_pixels(task.view))
        typical = first_typical_light(light[seen > SMALLEST_SEEN], noise)
    candidates = candidates[light > CANDIDATE_LIGHT * typical] if typical > 0.0 else candidates[:0]
    return replace(state, typical_light=typical, noise=noise_with(task, typical)), candidates


def first_typical_light(light: Floats, noise_counts: float) -> float:
    """Return the light of a typical particle as far as peaks tell; 0 where there are none.

    Where none stands out of the noise all may be noise, and the fit will tell.

    Parameters
    ----------
    light : (n,) of the peaks, counts
    noise_counts : standard error of a lone particle's light by read noise
    """
    if not light.size:
        return 0.0
    standing_out = light > STANDING_OUT * noise_counts
    if standing_out.any() and np.count_nonzero(standing_out) < (1.0 - 0.01 * FIRST_TYPICAL_PERCENTILE) * len(light):
        return float(np.percentile(light[standing_out], FIRST_TYPICAL_PERCENTILE, method="higher"))
    return float(np.percentile(light, FIRST_TYPICAL_PERCENTILE))


def with_suspects_checked(task: Task, state: State, fits: Fits, settings: Round) -> tuple[State, Fits]:
    """Return the state after particles that fit badly were tried as two, as far as a round does.

    `fits` says how well they fit; returned is how well those do that stay. Other depths are tried when noise alone is
    left: before, none more are found by them.
    """
    good = good_chi2(fits.chi2)
    state = with_overlaps_split(task, state, fits.chi2, settings.unexplained, good, settings.thorough)
    sweep(task, state, settings.unexplained, SWEEPS_AFTER_SPLIT, SEARCH_GAIN)
    return pruned(task, with_twins_joined(task, state, settings.unexplained, fits.chi2), settings)


def candidates_of(
    task: Task, state: State, iterations: int, progress: Callable[[int], None] | None
) -> tuple[Floats, Floats]:
    """Return candidates (n, 4), brightest first, and their light (n,)."""
    model = (task.image - state.residual).reshape(task.prepared.shape).astype(np.float32)
    background = task.weights.prepare(model)
    volume = explain_rest(task.problem, background, iterations, progress)
    index, light = find_peaks(volume, boxes_of(task.view.scale, task.weights.grid.spacing_mm))
    points = task.camera.to_image_axes(points_in_raw_frame(task.weights, index))
    points = places_by_snell(points, task.view)
    return np.column_stack([points, light]), light


def accepted(task: Task, state: State, candidates: Floats, settings: Round) -> State:
    """Return the state with those candidates that hold."""
    observation = observed(task, state, settings.unexplained)
    light = SMALLEST_LIGHT * state.typical_light
    least = Least(light, settings.claimed_share, SMALLEST_SEEN, CANDIDATE_GAIN)
    stay = accept(observation, candidates, least)
    return replace(state, particles=np.concatenate([state.particles, candidates[stay]]))
