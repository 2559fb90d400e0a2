"""Particles of a frame whose places the frames before predict, as in Shake-The-Box, and those that the rest shows.

The predicted particles are refined on the image together, each held where it is expected as firmly as that is known:
near the focal plane its past says more of its depth than the image. What finds no light is dropped. What they leave of
the image is searched for the others: those that have come into the volume, and those that overlap.

Axes: particles are rows (x, y, z, light) in image axes, mm and counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.particles.joining import with_twins_joined
from lfpiv_cli.particles.least_squares import SEARCH_GAIN
from lfpiv_cli.particles.rounds import (
    Round,
    accepted,
    candidates_of,
    finished,
    with_candidates,
    with_suspects_checked,
)
from lfpiv_cli.particles.search import (
    State,
    Task,
    blank,
    judged,
    kept,
    noise_with,
    rebuilt,
    sweep,
    with_light,
)
from lfpiv_cli.particles.suspects import settled

# A particle goes on as predicted where it ends within so many standard errors of its place and of its light.
PREDICTED_SIGMAS = 4.0
# Standard errors of what is predicted, at least: laterally in microlenses, in depth in depths over which light spreads
# by one lens (Table 2: 0.005 and 0.05 mm), and of the logarithm of the light.
SURE_LENSES, SURE_DEPTHS, SURE_LIGHT = 0.05, 0.05 / 1.064, 0.02
# How little unexplained light counts in sweeps in which each light is held within these limits, and in the one after.
HELD, FREE = (0.3, 0.1, 0.1), 0.05
# The search of what particles leave that go on.
SEARCHES = (
    Round(12, 0.85, 0.1, thorough=True),
    Round(8, 0.75, 0.07, thorough=True),
    Round(6, 0.6, 0.05, thorough=True),
)
SWEEPS = 2
# Where fewer than this share of them go on, the frame does not go on from the ones before.
LEAST_FOUND = 0.3
# Units of progress that `find_predicted` reports.
STEPS = sum(settings.iterations + 1 for settings in SEARCHES)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Particles that are expected in an image.

    Attributes
    ----------
    particles : (n, 4)
    sigma_mm : (n, 3) standard errors of their places
    light_sigma : of the logarithm of their light
    """

    particles: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]
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
    state = gone_on(task, expected)
    if not len(expected.particles) or len(state.particles) < LEAST_FOUND * len(expected.particles):
        return None
    state = settled(task, state, state.particles)
    for settings in SEARCHES:
        state = _one_search(task, state, settings, progress)
        if progress:
            progress(1)
    return finished(task, state, SEARCHES[-1])


def gone_on(task: Task, predicted: Predicted) -> State:
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
        state = with_light(task, state, np.clip(state.particles[:, 3], low, high))
    sweep(task, state, FREE, 1, SEARCH_GAIN)
    found = state.particles
    sure = (np.abs(found[:, :3] - at[:, :3]) <= PREDICTED_SIGMAS * sigma).all(axis=1)
    sure &= (found[:, 3] > low) & (found[:, 3] < high)
    state = kept(task, state, sure)
    return with_twins_joined(task, state, FREE, judged(task, state, FREE).chi2)


def _one_search(task: Task, state: State, settings: Round, progress: Callable[[int], None] | None) -> State:
    """Return the state after one search of what is not explained."""
    candidates, light = candidates_of(task, state, settings.iterations, progress)
    state, candidates = with_candidates(task, state, candidates, light)
    state = accepted(task, state, candidates, settings)
    sweep(task, state, settings.unexplained, SWEEPS, SEARCH_GAIN)
    state, _ = with_suspects_checked(task, state, judged(task, state, settings.unexplained), settings)
    return state
