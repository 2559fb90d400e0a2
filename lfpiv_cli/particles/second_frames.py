"""The first pass over the second frame of a pair, which begins with what the first frame lets expect.

A first round shows where the flow goes. Where the places of most of the first frame's particles can be expected well,
those that are beyond doubt there go on as predicted, as in a sequence, and what they leave is searched. The doubtful
ones, most ghosts among them, take no part: the second frame finds them by itself, or not. Where the flow changes too
much from particle to particle, the other rounds follow, as if there were no first frame.

Axes: particles are rows (x, y, z, light) in image axes, mm and counts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.particles.prediction import STEPS, Predicted, find_predicted
from lfpiv_cli.particles.rounds import ROUNDS, after_rounds, finished
from lfpiv_cli.particles.search import (
    LAST_UNEXPLAINED,
    Task,
    blank,
    judged,
    rebuilt,
    with_measured_noise,
    with_typical_light,
)
from lfpiv_cli.particles.suspects import SUSPECT_CHI2, good_chi2
from lfpiv_cli.scale import Scale
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.light import Light
from lfpiv_cli.tracks.tracking import expected_of, known_of, track

# A particle is beyond doubt that is no suspect and finds this share of the light that it claims.
TRUSTED_SHARE = 0.98
# A place is expected well enough with a standard error of this: laterally in microlenses, in depths over which light
# spreads by one lens (Table 2: 0.02 and 0.1 mm). Beyond, a particle may end at a neighbour's place.
EXPECTED_LENSES, EXPECTED_DEPTHS = 0.2, 0.1 / 1.064
# Share of the first frame's particles that must be expected so.
LEAST_EXPECTED = 0.6
# Standard error of the logarithm of light from frame to frame: fits share out the light of neighbours differently.
LIGHT_SIGMA = 0.05
# Units of progress that prediction saves.
SAVED_STEPS = sum(settings.iterations + 1 for settings in ROUNDS[1:]) - STEPS


def second_frame(
    task: Task,
    before: Task,
    particles: NDArray[np.float64],
    search_mm: float,
    progress: Callable[[int], None] | None = None,
) -> NDArray[np.float64]:
    """Return the particles (n, 4) of the first pass over the second frame of a pair.

    Parameters
    ----------
    task, before : the second and the first image
    particles : (m, 4) what the first pass found in the first
    search_mm : largest displacement along each axis
    """
    state = after_rounds(task, blank(task), ROUNDS[:1], progress)
    trusted = particles[beyond_doubt(before, particles)]
    predicted = predicted_by(trusted, state.particles, search_mm, task.view.scale)
    if len(predicted.particles) >= LEAST_EXPECTED * len(particles):
        found = find_predicted(task, predicted, progress)
        if found is not None:
            if progress:
                progress(SAVED_STEPS)
            return found.particles
    return finished(task, after_rounds(task, state, ROUNDS[1:], progress), ROUNDS[-1]).particles


def beyond_doubt(task: Task, particles: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which particles (n, 4) fit well and find nearly all their light."""
    state = rebuilt(task, blank(task), particles)
    state = with_measured_noise(task, with_typical_light(task, state, judged(task, state, LAST_UNEXPLAINED)))
    fits = judged(task, state, LAST_UNEXPLAINED)
    return np.asarray((fits.chi2 < SUSPECT_CHI2 * good_chi2(fits.chi2)) & (fits.share > TRUSTED_SHARE))


def predicted_by(trusted: NDArray[np.float64], seen: NDArray[np.float64], search_mm: float, scale: Scale) -> Predicted:
    """Return which of the first frame's particles (n, 4) are expected in the second, where that is known well enough.

    One that was seen there (m, 4) is expected where it was seen.
    """
    first, second = (Seen(each[:, :3], light=Light(each[:, 3])) for each in (trusted, seen))
    tracks = track(first, second, search_mm, scale)
    known = known_of(first, second, tracks.first, tracks.second, scale)
    expected = expected_of(first.position_mm, known, search_mm, scale)
    at, sigma = trusted.copy(), np.sqrt(expected.variance_mm2)
    at[:, :3] += expected.displacement_mm
    at[tracks.first, :3], sigma[tracks.first] = second.position_mm[tracks.second], 0.0
    if len(tracks.first):
        at[:, 3] *= np.median(seen[tracks.second, 3] / trusted[tracks.first, 3])
    enough = np.all(sigma < scale.box_mm(EXPECTED_LENSES, EXPECTED_DEPTHS), axis=1)
    return Predicted(at, sigma, LIGHT_SIGMA).part(enough)
