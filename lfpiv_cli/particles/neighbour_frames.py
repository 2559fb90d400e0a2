"""A second pass over an image with the particles found in the frames before and after it, as in time-resolved PTV.

A particle that was found in a neighbour frame and has no partner here is put where the displacements around it lead,
whether its light seems free or not; then all particles are refined, and those that do not find their light are
dropped. So overlapping particles that splitting did not find are separated. Only first passes serve as neighbours, and
of a pair the second frame's first pass begins with the first frame's, never the other way round (`second_frame`): each
frame's result depends on the images alone, not on the order in which frames are done.

Axes: particles are rows (x, y, z, light) in image axes, mm and counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import Scale
from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.joining import with_twins_joined
from lfpiv_cli.particles.least_squares import SEARCH_GAIN
from lfpiv_cli.particles.rounds import (
    ROUNDS,
    SWEEPS,
    Round,
    accepted,
    after_rounds,
    candidates_of,
    finished,
    steps_of,
    with_candidates,
    with_suspects_checked,
)
from lfpiv_cli.particles.search import (
    LAST_UNEXPLAINED,
    State,
    Task,
    blank,
    judged,
    kept,
    merge,
    noise_with,
    prune,
    rebuilt,
    sweep,
    with_measured_noise,
    with_typical_light,
)
from lfpiv_cli.particles.suspects import good_chi2
from lfpiv_cli.tracks.candidates import Light, Seen
from lfpiv_cli.tracks.tracking import expected_of, known_of, reach_of, track

# Particles of a frame whose places the frames before predict, as in Shake-The-Box, and those that the rest shows.
#
# The predicted particles are refined on the image together, each held where it is expected as firmly as that is
# known: near the focal plane its past says more of its depth than the image. What finds no light is dropped. What
# they leave of the image is searched for the others: those that have come into the volume, and those that overlap.
#
# Axes: particles are rows (x, y, z, light) in image axes, mm and counts.


# A particle goes on as predicted where it ends within so many standard errors of its place and of its light.
PREDICTED_SIGMAS = 4.0
# Standard errors of what is predicted, at least: laterally in microlenses, in depth in depths over which light spreads
# by one lens (Table 2: 0.005 and 0.05 mm), and of the logarithm of the light, as fits share out the light of neighbours
# differently from frame to frame: most of 1.9 tracers for each microlens by a hundredth or two, one in ten by a fifth.
SURE_LENSES, SURE_DEPTHS, SURE_LIGHT = 0.05, 0.05 / 1.064, 0.05
# How little unexplained light counts in sweeps in which each light is held within these limits, and in the one after.
HELD, FREE = (0.3, 0.1, 0.1), 0.05
# The search of what particles leave that go on.
SEARCHES = (
    Round(8, 0.85, 0.1, thorough=True),
    Round(5, 0.75, 0.07, thorough=True),
    Round(4, 0.6, 0.05, thorough=True),
)
# Where fewer than this share of them go on, the frame does not go on from the ones before.
LEAST_FOUND = 0.3
# Units of progress that `find_predicted` reports.
STEPS = steps_of(SEARCHES)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Particles that are expected in an image.

    Attributes
    ----------
    particles : (n, 4)
    sigma_mm : (n, 3) standard errors of their places
    light_sigma : of the logarithm of their light
    """

    particles: Floats
    sigma_mm: Floats
    light_sigma: float

    def part(self, chosen: NDArray[np.bool_]) -> Predicted:
        """Return some of them."""
        return Predicted(self.particles[chosen], self.sigma_mm[chosen], self.light_sigma)


def find_predicted(task: Task, predicted: Predicted, progress: Callable[[int], None] | None = None) -> State | None:
    """Return what is found where particles are predicted, and what the rest shows.

    None where most predicted particles find no light: the image is to be searched from nothing.
    """
    low, high = task.depths_mm
    depth = predicted.particles[:, 2]
    expected = predicted.part((depth >= low) & (depth <= high))
    state = continued(task, expected)
    if not len(expected.particles) or len(state.particles) < LEAST_FOUND * len(expected.particles):
        return None
    for settings in SEARCHES:
        candidates, light = candidates_of(task, state, settings.iterations, progress)
        state = accepted(task, *with_candidates(task, state, candidates, light), settings)
        sweep(task, state, settings.unexplained, SWEEPS, SEARCH_GAIN)
        state, _ = with_suspects_checked(task, state, judged(task, state, settings.unexplained), settings)
        if progress:
            progress(1)
    return finished(task, state, SEARCHES[-1])


def continued(task: Task, predicted: Predicted) -> State:
    """Return the state with those particles that go on as predicted, all refined together."""
    at, scale = predicted.particles, task.view.scale
    typical = float(np.median(at[:, 3])) if len(at) else 0.0
    state = replace(rebuilt(task, blank(task), at.copy()), typical_light=typical, noise=noise_with(task, typical))
    sigma = np.hypot(predicted.sigma_mm, scale.box_mm(SURE_LENSES, SURE_DEPTHS))
    # Their light is not held: what has none is to show it.
    state = replace(state, expected=np.column_stack([at, 1.0 / sigma**2, np.zeros(len(at))]))
    spread = PREDICTED_SIGMAS * max(predicted.light_sigma, SURE_LIGHT)
    low, high = at[:, 3] * np.exp(-spread), at[:, 3] * np.exp(spread)
    for unexplained in HELD:
        sweep(task, state, unexplained, 1, SEARCH_GAIN)
        particles, light = state.particles.copy(), np.clip(state.particles[:, 3], low, high)
        particles[:, 3] = light - state.particles[:, 3]
        add_all(task.view, particles[particles[:, 3] != 0.0], -1.0, state.residual, task.depths_mm)
        particles[:, 3] = light
        state = replace(state, particles=particles)
    sweep(task, state, FREE, 1, SEARCH_GAIN)
    found = state.particles
    sure = (np.abs(found[:, :3] - at[:, :3]) <= PREDICTED_SIGMAS * sigma).all(axis=1)
    sure &= (found[:, 3] > low) & (found[:, 3] < high)
    state = kept(task, state, sure)
    return with_twins_joined(task, state, FREE, judged(task, state, FREE).chi2)


# The first pass over the second frame of a pair, which begins with what the first frame lets expect.
#
# A first round shows where the flow goes. Where the places of most of the first frame's particles can be expected
# well, those that are beyond doubt there go on as predicted, as in a sequence, and what they leave is searched. The
# doubtful ones, most ghosts among them, take no part: the second frame finds them by itself, or not. Where the flow
# changes too much from particle to particle, the other rounds follow, as if there were no first frame.
#
# Axes: particles are rows (x, y, z, light) in image axes, mm and counts.


# A particle is beyond doubt that fits nearly as well as good ones, and finds this share of the light that it claims.
TRUSTED_CHI2, TRUSTED_SHARE = 1.5, 0.98
# A place is expected well enough with a standard error of this: laterally in microlenses, in depths over which light
# spreads by one lens (Table 2: 0.02 and 0.1 mm). Beyond, a particle may end at a neighbour's place.
EXPECTED_LENSES, EXPECTED_DEPTHS = 0.2, 0.1 / 1.064
# Share of the first frame's particles that must be expected so.
LEAST_EXPECTED = 0.6
# Units of progress that prediction saves.
SAVED_STEPS = steps_of(ROUNDS[1:]) - STEPS


def second_frame(task: Task, before: Task, particles: Floats, progress: Callable[[int], None] | None = None) -> Floats:
    """Return the particles (n, 4) of the first pass over the second frame of a pair.

    Parameters
    ----------
    task, before : the second and the first image
    particles : (m, 4) what the first pass found in the first
    """
    state = after_rounds(task, blank(task), ROUNDS[:1], progress)
    trusted = particles[beyond_doubt(before, particles)]
    predicted = predicted_by(trusted, state.particles, task.view.scale)
    if len(predicted.particles) >= LEAST_EXPECTED * len(particles):
        found = find_predicted(task, predicted, progress)
        if found is not None:
            if progress:
                progress(SAVED_STEPS)
            return found.particles
    return finished(task, after_rounds(task, state, ROUNDS[1:], progress), ROUNDS[-1]).particles


def beyond_doubt(task: Task, particles: Floats) -> NDArray[np.bool_]:
    """Return which particles (n, 4) fit well and find nearly all their light."""
    state = rebuilt(task, blank(task), particles)
    state = with_measured_noise(task, with_typical_light(task, state, judged(task, state, LAST_UNEXPLAINED)))
    fits = judged(task, state, LAST_UNEXPLAINED)
    return np.asarray((fits.chi2 < TRUSTED_CHI2 * good_chi2(fits.chi2)) & (fits.share > TRUSTED_SHARE))


def predicted_by(trusted: Floats, seen: Floats, scale: Scale) -> Predicted:
    """Return which of the first frame's particles (n, 4) are expected in the second, where that is known well enough.

    One that was seen there (m, 4) is expected where it was seen.
    """
    first, second = (Seen(each[:, :3], light=Light(each[:, 3])) for each in (trusted, seen))
    tracks = track(first, second, scale)
    known = known_of(first, second, tracks.first, tracks.second, scale)
    expected = expected_of(first.position_mm, known, reach_of(scale), scale)
    at, sigma = trusted.copy(), np.sqrt(expected.variance_mm2)
    at[:, :3] += expected.displacement_mm
    at[tracks.first, :3], sigma[tracks.first] = second.position_mm[tracks.second], 0.0
    if len(tracks.first):
        at[:, 3] *= np.median(seen[tracks.second, 3] / trusted[tracks.first, 3])
    enough = np.all(sigma < scale.box_mm(EXPECTED_LENSES, EXPECTED_DEPTHS), axis=1)
    return Predicted(at, sigma, SURE_LIGHT).part(enough)


# A particle without a partner this near to where one is expected is that one, at another depth: near the focal plane
# depths may be wrong by as much as lets light spread by one lens. In microlenses and in such depths (Table 2: 1.25 mm).
SAME_LENSES, SAME_DEPTHS = 0.5, 1.25 / 1.064
# Added particles begin with this share of the light that they have in their own frame: some of it is others' for now.
FIRST_SHARE = 0.5
# Sweeps in which they are refined, and how little unexplained light counts then: first as in early rounds, then as at
# the end. The share of its light that each particle must find afterwards.
REFINING = ((3, 0.1), (4, LAST_UNEXPLAINED))
CLAIMED_SHARE = 0.6


def second_pass(task: Task, own: Floats, neighbours: Sequence[Floats]) -> State:
    """Return what is found with the help of neighbour frames.

    Parameters
    ----------
    task : the image
    own, neighbours : (n, 4) what first passes found in it and in the frames beside it
    """
    state = rebuilt(task, blank(task), own)
    state = with_typical_light(task, state, judged(task, state, LAST_UNEXPLAINED))
    state = with_measured_noise(task, replace(state, noise=noise_with(task, state.typical_light)))
    state = rebuilt(task, state, np.concatenate([own, _missing_particles(task, own, neighbours)]))
    for sweeps, unexplained in REFINING:
        sweep(task, state, unexplained, sweeps, SEARCH_GAIN)
    # Three may be where two are, one of them found here for both: with the third beside them chi-squared needs all.
    state, _ = prune(task, merge(task, state), CLAIMED_SHARE, LAST_UNEXPLAINED)
    return finished(task, state, ROUNDS[-1])


def _missing_particles(task: Task, own: Floats, neighbours: Sequence[Floats]) -> Floats:
    """Return the neighbours' particles (m, 4) that are missing here, where they are expected."""
    scale, missing = task.view.scale, np.zeros((0, 4))
    same = scale.box_mm(SAME_LENSES, SAME_DEPTHS)
    for other in neighbours:
        there, here = (Seen(each[:, :3], light=Light(each[:, 3])) for each in (other, own))
        tracks = track(there, here, scale)
        alone, partnerless = np.ones(len(other), np.bool_), np.ones(len(own), np.bool_)
        alone[tracks.first] = partnerless[tracks.second] = False
        # Where the other frame's that were not tracked are expected here.
        expected = np.zeros((0, 4))
        if len(tracks.first):
            links = known_of(there, here, tracks.first, tracks.second, scale)
            expected = other.copy()
            expected[:, :3] += expected_of(there.position_mm, links, reach_of(scale), scale).displacement_mm
            expected = expected[alone]
        known = np.concatenate([own[partnerless, :3], missing[:, :3]])
        seen = (expected[:, 2] >= task.depths_mm[0]) & (expected[:, 2] <= task.depths_mm[1])
        if len(expected) and len(known):
            # One is a known one that lies within 1 and is each other's nearest.
            points, others = expected[:, :3] / same, known / same
            distance, to = KDTree(others).query(points)
            _, back = KDTree(points).query(others)
            seen &= ~((distance <= 1.0) & (back[to] == np.arange(len(points))))
        missing = np.concatenate([missing, expected[seen]])
    return missing * (1.0, 1.0, 1.0, FIRST_SHARE)
