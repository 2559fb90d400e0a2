"""Fitting single particles to what the others leave of the image.

Particles are refined one after the other (block coordinates), those of different tiles at once (`view`).

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numba import float64
from numba.core.typing.typeof import typeof_impl
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, by_address, njit
from lfpiv_cli.particles.least_squares import (
    CHOICE_GAIN,
    NO_ROWS,
    SMALLEST_GAIN,
    SUMS,
    UNKNOWNS,
    Effort,
    Observation,
    Respond,
    Responses,
    add_light,
    best_light,
    change_by,
    copy_rows,
    fit,
    lit_by,
    respond_of,
    room_for,
)
from lfpiv_cli.particles.refraction import on_line_of_sight
from lfpiv_cli.particles.view import View, entry_capacity, over_tiles, type_by_form

# Where a candidate begins, off its place (x, y, z), in microlenses and in depths over which light spreads by one lens
# (Table 2: 0.4 mm). One that does not hold where it is begins again at the depths; where light spreads by no more than
# so many lenses fits reach a particle only from its own part of a lens: there beside it, too.
STARTS_BY_DEPTH = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -0.4 / 1.064), (0.0, 0.0, 0.4 / 1.064)])
STARTS_BESIDE = 0.33 * np.array([(x, y, 0.0) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) if x or y])
FEW_LENSES = 2.0
# Steps from each of these places; from where that led in the best of them; for a particle in a sweep.
FIRST_STEPS = 3
CANDIDATE_STEPS = 12
SWEEP_STEPS = 4
# Of starts whose light is the best one there.
UNKNOWN_LIGHT = -1.0
# A particle claims its light where at least this share of it is found (the rest may be noise and neighbours).
CLAIM = 0.7


@njit(cache=True, fastmath=SUMS, **COUNT_NO_REFERENCES)
def claimed_share(
    pixels: NDArray[np.int32], values: Floats, light: float, residual: Floats, weight: Floats, own: float
) -> float:
    """Return the share of the light that a particle would claim which is there: sum min(r+, c I f) / sum c I f.

    Pixels without weight do not count. `own` is the particle's light that the residual lacks already.
    """
    found = wanted = 0.0
    for k in range(pixels.size):
        if weight[pixels[k]] > 0.0:
            claim = CLAIM * light * values[0, k]
            wanted += claim
            found += min(max(residual[pixels[k]] + own * values[0, k], 0.0), claim)
    return found / wanted if wanted > 0.0 else 0.0


@njit(cache=True, fastmath=SUMS, **COUNT_NO_REFERENCES)
def seen_share(pixels: NDArray[np.int32], values: Floats, weight: Floats) -> float:
    """Return the share of a particle's light that meets pixels with weight."""
    seen = 0.0
    for k in range(pixels.size):
        if weight[pixels[k]] > 0.0:
            seen += values[0, k]
    return seen


def refine(
    observation: Observation,
    particles: Floats,
    enough: float = SMALLEST_GAIN,
    chosen: NDArray[np.bool_] | None = None,
    prior: Floats | None = None,
) -> Floats:
    """Refine all or the chosen ones of particles (n, 4) once, in place, and keep the residual up to date.

    `enough` is what ends a fit, see `least_squares.Effort`, `prior` (n, 8) what is expected of particles, see
    `least_squares.fit`. Returns what each fit lowered chi-squared by.
    """
    every = np.ones(len(particles), np.bool_) if chosen is None else chosen
    return fit_again(observation, particles, every, Effort(SWEEP_STEPS, enough), prior=prior).gain


Fit: TypeAlias = Callable[[Observation, Floats, Floats, Responses, Effort], float]


class Choice(NamedTuple):
    """How the best of several places where a fit can begin is found.

    Which place is right shows long before a fit has ended.

    Attributes
    ----------
    first : from each place
    then : from where that led, for the best ones
    finalists : how many these are
    faintest, brightest : light of each particle that is fitted
    """

    first: Effort
    then: Effort
    finalists: int
    faintest: float
    brightest: float


# Where all starts are followed to their ends at once.
NO_FURTHER = Effort(0, 0.0)
NOWHERE_ELSE = Choice(NO_FURTHER, NO_FURTHER, 0, 0.0, np.inf)


@njit(cache=True)
def begin_at(view: View, particle: Floats, depths_mm: Floats, starts: Floats) -> None:
    """Fill in starts (n, 1, 4) at depths (n,) of a particle's line of sight; their light is still to be found."""
    for n in range(depths_mm.size):
        depth = depths_mm[n]
        starts[n, 0, 2], starts[n, 0, 3] = depth, UNKNOWN_LIGHT
        if not np.isnan(depth):
            starts[n, 0, 0], starts[n, 0, 1] = on_line_of_sight(view, particle[0], particle[1], particle[2], depth)


@njit(cache=True)
def fit_best(
    to: tuple[Observation, Fit],
    starts: Floats,
    prior: Floats,
    responses: Responses,
    choice: Choice,
    limits: tuple[float, float],
    best: Floats,
) -> float:
    """Fit one particle or two from several starts; fill in the best fit.

    Parameters
    ----------
    to : what is fitted to, and `least_squares.fit`
    starts : (n, k, 4) where fits begin, worked on; with `UNKNOWN_LIGHT` the best one there is taken, depths that are
        NaN are left out
    prior : (k, 8) see `least_squares.fit`
    limits : what a start must add to chi-squared at most to be followed, and what the best must stay below
    best : (k, 4) filled where a fit does

    Returns
    -------
    what the best adds to chi-squared, the second of the limits where none is better
    """
    observation, fit_one = to
    changes, view = np.full(len(starts), np.inf), observation.optics
    promising, lowest = limits
    for n in range(len(starts)):
        if np.isnan(starts[n, 0, 2]):
            continue
        observation.respond(view, starts[n], responses)
        if starts[n, 0, 3] == UNKNOWN_LIGHT:
            pixels, values = lit_by(responses, 0)
            starts[n, 0, 3] = best_light(pixels, values, observation.residual, observation.weight)
        changes[n] = fit_one(observation, starts[n], prior, responses, choice.first)
    for _ in range(min(choice.finalists, len(starts))):
        chosen = np.argmin(changes)
        if changes[chosen] > promising:
            break
        changes[chosen] = np.inf
        observation.respond(view, starts[chosen], responses)
        change = fit_one(observation, starts[chosen], prior, responses, choice.then)
        light = starts[chosen, :, 3]
        if change < lowest and choice.faintest <= light.min() and light.max() < choice.brightest:
            lowest = change
            copy_rows(starts[chosen], best)
    return lowest


class Fitter(NamedTuple):
    """What kernels fit particles with, by the functions' addresses.

    Attributes
    ----------
    to : what is fitted to, and `least_squares.fit`
    best : `fit_best`
    """

    to: tuple[Observation, Fit]
    best: Callable[[tuple[Observation, Fit], Floats, Floats, Responses, Choice, tuple[float, float], Floats], float]


typeof_impl.register(Fitter)(type_by_form)


def fitter_of(observation: Observation) -> Fitter:
    """Return what fits particles to an observation."""
    responses, starts = room_for(1, 1, 0), np.empty((0, 0, UNKNOWNS))
    to = observation, by_address(fit, float64, observation, NO_ROWS, NO_ROWS, responses, NO_FURTHER)
    of_best = starts, NO_ROWS, responses, NOWHERE_ELSE, (0.0, 0.0), NO_ROWS
    return Fitter(to, by_address(fit_best, float64, to, *of_best))


class Refitted(NamedTuple):
    """What came of fits of particles that were known.

    Attributes
    ----------
    moved : (n,) which particles have been moved to another depth
    gain : (n,) what each fit lowered chi-squared by, 0 for particles that were not fitted
    """

    moved: NDArray[np.bool_]
    gain: Floats


class Elsewhere(NamedTuple):
    """Where else fits of particles begin.

    Attributes
    ----------
    depths_mm : (n, k) on each one's line of sight, NaN for nowhere
    choice : among these
    gain : what another depth must gain in chi-squared
    """

    depths_mm: Floats
    choice: Choice
    gain: float


def fit_again(
    observation: Observation,
    particles: Floats,
    chosen: NDArray[np.bool_],
    effort: Effort,
    elsewhere: Elsewhere | None = None,
    prior: Floats | None = None,
) -> Refitted:
    """Fit the chosen ones of particles (n, 4) in place, from where they are and from other depths.

    The residual is kept up to date.

    Parameters
    ----------
    elsewhere : where else to begin; default: nowhere
    prior : (n, 8) what is expected of the particles; default: nothing
    """
    expected = nothing_expected(len(particles)) if prior is None else prior
    others = Elsewhere(np.empty((len(particles), 0)), NOWHERE_ELSE, 0.0) if elsewhere is None else elsewhere
    fitter, refitted = fitter_of(observation), Refitted(np.zeros(len(particles), np.bool_), np.zeros(len(particles)))
    arguments = fitter, particles, expected, effort, others, refitted
    over_tiles(_fit_again, observation.optics, particles, observation.depths_mm, *arguments, chosen=chosen)
    return refitted


@njit(cache=True, nogil=True)
def _fit_again(
    numbers: NDArray[np.int64],
    fitter: Fitter,
    particles: Floats,
    prior: Floats,
    effort: Effort,
    elsewhere: Elsewhere,
    refitted: Refitted,
) -> None:
    """Do the work of `fit_again` for the particles of a tile."""
    (observation, fit_one), depths = fitter.to, elsewhere.depths_mm
    view, residual = observation.optics, observation.residual
    responses = room_for(1, observation.capacity, 0)
    starts, best = np.empty((depths.shape[1], 1, UNKNOWNS)), np.empty((1, UNKNOWNS))
    for number in numbers:
        copy_rows(particles[number : number + 1], best)
        expected = prior[number : number + 1]
        observation.respond(view, best, responses)
        pixels, values = lit_by(responses, 0)
        add_light(pixels, values, best[0, 3], residual)
        after = fit_one(observation, best, expected, responses, effort)
        before = responses.began[0]
        if depths.shape[1] > 0:
            lowest = after - elsewhere.gain
            begin_at(view, particles[number], depths[number], starts)
            choice, limits = elsewhere.choice, (np.inf, lowest)
            change = fitter.best(fitter.to, starts, expected, responses, choice, limits, best)
            if change < lowest:
                after = change
                refitted.moved[number] = True
        refitted.gain[number] = before - after
        copy_rows(best, particles[number : number + 1])
        if depths.shape[1] > 0:
            observation.respond(view, best, responses)
        pixels, values = lit_by(responses, 0)
        add_light(pixels, values, -best[0, 3], residual)


def other_ends(
    observation: Observation, particles: Floats, chosen: NDArray[np.bool_], places: Floats, effort: Effort
) -> tuple[Floats, Floats]:
    """Return where fits of the chosen ones of particles (n, 4) end that begin at other places (n, k, 3).

    A place is one sideways at the particle's depth, and the depth to which its line of sight is followed from there.
    Returned are the ends (n, k, 4), and by how much chi-squared is larger there than where they are (n, k), infinite
    for those that are not chosen. The residual is in place again on return.
    """
    ends, rises = np.zeros((*places.shape[:2], UNKNOWNS)), np.full(places.shape[:2], np.inf)
    arguments = fitter_of(observation), particles, places, effort, ends, rises
    over_tiles(_other_ends, observation.optics, particles, observation.depths_mm, *arguments, chosen=chosen)
    return ends, rises


@njit(cache=True, nogil=True)
def _other_ends(
    numbers: NDArray[np.int64],
    fitter: Fitter,
    particles: Floats,
    places: Floats,
    effort: Effort,
    ends: Floats,
    rises: Floats,
) -> None:
    """Do the work of `other_ends` for the particles of a tile."""
    observation, fit_one = fitter.to
    view, residual, weight = observation.optics, observation.residual, observation.weight
    responses, prior = room_for(1, observation.capacity, 0), np.zeros((1, 2 * UNKNOWNS))
    for number in numbers:
        own, depth = particles[number : number + 1], particles[number, 2]
        observation.respond(view, own, responses)
        pixels, values = lit_by(responses, 0)
        add_light(pixels, values, own[0, 3], residual)
        before = change_by(pixels, values, own[0, 3], residual, weight)
        for k in range(places.shape[1]):
            end, place = ends[number, k : k + 1], places[number, k]
            end[0, 0], end[0, 1] = on_line_of_sight(view, place[0], place[1], depth, place[2])
            end[0, 2] = place[2]
            observation.respond(view, end, responses)
            pixels, values = lit_by(responses, 0)
            end[0, 3] = best_light(pixels, values, residual, weight)
            rises[number, k] = fit_one(observation, end, prior, responses, effort) - before
        observation.respond(view, own, responses)
        pixels, values = lit_by(responses, 0)
        add_light(pixels, values, -own[0, 3], residual)


def nothing_expected(count: int) -> Floats:
    """Return the prior (n, 8) of particles of which nothing is known but their image, see `least_squares.fit`."""
    return np.zeros((count, 2 * UNKNOWNS))


class Least(NamedTuple):
    """What a candidate must have.

    Attributes
    ----------
    light : counts
    found, seen : shares of it that are found in the image, and that meet the sensor
    gain : by which it lowers chi-squared
    """

    light: float
    found: float
    seen: float
    gain: float


def accept(observation: Observation, candidates: Floats, least: Least) -> NDArray[np.bool_]:
    """Fit candidates (n, 4) in place, one after the other; return which ones stay, their light off the residual."""
    accepted, fitter = np.zeros(len(candidates), np.bool_), fitter_of(observation)
    choice = Choice(Effort(FIRST_STEPS, CHOICE_GAIN), Effort(CANDIDATE_STEPS, CHOICE_GAIN), 1, least.light, np.inf)
    scale = observation.optics.scale
    off = np.concatenate([STARTS_BY_DEPTH, STARTS_BESIDE]) * scale.box_mm(1.0, 1.0)
    narrow = np.abs(candidates[:, 2]) < FEW_LENSES * scale.depth_mm
    begins = np.where(narrow, len(off), len(STARTS_BY_DEPTH))
    arguments = fitter, candidates, choice, off, begins, least, accepted
    over_tiles(_accept, observation.optics, candidates, observation.depths_mm, *arguments)
    return accepted


@njit(cache=True, nogil=True)
def _accept(
    numbers: NDArray[np.int64],
    fitter: Fitter,
    candidates: Floats,
    choice: Choice,
    off: Floats,
    begins: NDArray[np.int64],
    least: Least,
    accepted: NDArray[np.bool_],
) -> None:
    """Do the work of `accept` for the candidates of a tile, each from the first `begins` of places `off` (k, 3)."""
    observation, _ = fitter.to
    responses, best = room_for(1, observation.capacity, 0), np.empty((1, UNKNOWNS))
    starts = np.empty((len(off), 1, UNKNOWNS))
    for number in numbers:
        _begin_off(observation, candidates[number], off[:1], starts[:1])
        holds = _holds(fitter, starts[:1], responses, choice, least, best)
        if not holds:
            others = starts[1 : begins[number]]
            _begin_off(observation, candidates[number], off[1:], others)
            holds = _holds(fitter, others, responses, choice, least, best)
        if holds:
            copy_rows(best, candidates[number : number + 1])
            accepted[number] = True
            pixels, values = lit_by(responses, 0)
            add_light(pixels, values, -best[0, 3], observation.residual)


@njit(cache=True)
def _begin_off(observation: Observation, candidate: Floats, off: Floats, starts: Floats) -> None:
    """Fill in starts (n, 1, 4) so far off a candidate: sideways at its depth, and on the line of sight from there."""
    place, depth = candidate.copy(), np.empty(1)
    for k in range(len(starts)):
        place[0], place[1] = candidate[0] + off[k, 0], candidate[1] + off[k, 1]
        depth[0] = min(max(candidate[2] + off[k, 2], observation.low_mm), observation.high_mm)
        begin_at(observation.optics, place, depth, starts[k : k + 1])


@njit(cache=True, nogil=True)
def _holds(fitter: Fitter, starts: Floats, responses: Responses, choice: Choice, least: Least, best: Floats) -> bool:
    """Fit a candidate from several starts and fill in the best fit and its response; return whether it holds."""
    observation, _ = fitter.to
    residual, weight, prior = observation.residual, observation.weight, np.zeros((1, 2 * UNKNOWNS))
    if fitter.best(fitter.to, starts, prior, responses, choice, (0.0, -least.gain), best) >= -least.gain:
        return False
    observation.respond(observation.optics, best, responses)
    pixels, values = lit_by(responses, 0)
    if seen_share(pixels, values, weight) <= least.seen:
        return False
    return claimed_share(pixels, values, best[0, 3], residual, weight, 0.0) >= least.found


def add_all(view: View, particles: Floats, sign: float, image: Floats, depths_mm: tuple[float, float]) -> None:
    """Add the light of all particles (n, 4) between two depths, times `sign`, to an image."""
    arguments = respond_of(view), view, particles, sign, image, entry_capacity(view, *depths_mm)
    over_tiles(_add_all, view, particles, depths_mm, *arguments)


@njit(cache=True, nogil=True)
def _add_all(
    numbers: NDArray[np.int64],
    respond: Respond,
    view: View,
    particles: Floats,
    sign: float,
    image: Floats,
    capacity: int,
) -> None:
    """Do the work of `add_all` for the particles of a tile."""
    responses = room_for(1, capacity, 0)
    for number in numbers:
        respond(view, particles[number : number + 1], responses)
        pixels, values = lit_by(responses, 0)
        add_light(pixels, values, sign * particles[number, 3], image)


def light_errors(observation: Observation, particles: Floats, model: Floats) -> tuple[Floats, Floats]:
    """Return how wrong the light of each particle (n,) is, the square of the share, and that light's own square (n,).

    Squares are in variances of pixels. Noise differs from pixel to pixel; what the model of light lacks is alike in
    pixels side by side, whose products tell it: in the mean 0 where there is noise alone, and below as above it.
    """
    error2, power = np.zeros(len(particles)), np.zeros(len(particles))
    arguments = observation, particles, model, error2, power
    over_tiles(_write_light_errors, observation.optics, particles, observation.depths_mm, *arguments)
    return error2, power


@njit(cache=True, nogil=True)
def _write_light_errors(
    numbers: NDArray[np.int64],
    observation: Observation,
    particles: Floats,
    model: Floats,
    error2: Floats,
    power: Floats,
) -> None:
    """Do the work of `light_errors` for the particles of a tile."""
    residual, weight = observation.residual, observation.weight
    responses = room_for(1, observation.capacity, 0)
    for number in numbers:
        observation.respond(observation.optics, particles[number : number + 1], responses)
        pixels, values = lit_by(responses, 0)
        alike = light = 0.0
        for k in range(pixels.size):
            f, pixel = values[0, k], pixels[k]
            power[number] += weight[pixel] * (particles[number, 3] * f) ** 2
            light += f * weight[pixel] * model[pixel] ** 2
            if pixel + 1 < residual.size:
                both = np.sqrt(weight[pixel] * weight[pixel + 1])
                alike += f * both * residual[pixel] * residual[pixel + 1]
        if light > 0.0:
            error2[number] = alike / light


def judge(observation: Observation, particles: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return local chi-squared, claimed share, counts in the brightest pixel and share that is seen of each particle.

    Local chi-squared is the mean of w r^2 over the particle's light; 1 for a perfect model. Pixels without weight see
    nothing.
    """
    chi2, share, brightest, seen = (np.zeros(len(particles)) for _ in range(4))
    # By tiles: neighbours' pixels are still at hand.
    arguments = observation, particles, chi2, share, brightest, seen
    over_tiles(_judge, observation.optics, particles, observation.depths_mm, *arguments)
    return chi2, share, brightest, seen


@njit(cache=True, nogil=True)
def _judge(
    numbers: NDArray[np.int64],
    observation: Observation,
    particles: Floats,
    chi2: Floats,
    share: Floats,
    brightest: Floats,
    seen: Floats,
) -> None:
    """Do the work of `judge` for the particles of a tile."""
    residual, weight = observation.residual, observation.weight
    responses = room_for(1, observation.capacity, 0)
    for number in numbers:
        observation.respond(observation.optics, particles[number : number + 1], responses)
        pixels, values = lit_by(responses, 0)
        total = squares = most = 0.0
        for k in range(pixels.size):
            f, w = values[0, k], weight[pixels[k]]
            if w > 0.0:
                total += f
                most = max(most, f)
                squares += f * w * residual[pixels[k]] * residual[pixels[k]]
        if total > 0.0:
            chi2[number], seen[number] = squares / total, total
        light = particles[number, 3]
        brightest[number] = light * most
        share[number] = claimed_share(pixels, values, light, residual, weight, light)
