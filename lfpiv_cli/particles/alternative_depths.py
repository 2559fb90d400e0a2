"""Alternative depths for particles that fit badly, and for those near the focal plane, where many depths look alike.

A fit finds the nearest minimum of chi-squared. Near the focal plane, where one lens holds most of a particle's
light, chi-squared has several minima along the depth, one of them mirrored; elsewhere a neighbour that was not known
yet may have led to the wrong one.

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.particles.fitting import fit_again
from lfpiv_cli.particles.least_squares import CHOICE_GAIN, Effort, Observation

# Starts relative to the particle's depth, in depths over which light spreads by one lens (Table 2: 0.2 to 2 mm); its
# mirrored depth is another.
OTHER_DEPTHS = np.array([-2.0, -1.5, -1.0, -0.7, -0.4, -0.2, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0]) / 1.064
STEPS = 8


def try_other_depths(
    observation: Observation,
    particles: NDArray[np.float64],
    suspects: NDArray[np.bool_],
    smallest_light: float,
    smallest_gain: float,
    prior: NDArray[np.float64] | None = None,
) -> NDArray[np.bool_]:
    """Move suspects to another depth where that lowers chi-squared by `smallest_gain` more than refinement does.

    All suspects among the particles (n, 4) are refined; the residual is kept up to date. Returns which have moved.
    """
    depth = particles[:, 2:3]
    starts = np.concatenate([depth + OTHER_DEPTHS * observation.optics.scale.depth_mm, -depth], axis=1)
    starts[(starts < observation.low_mm) | (starts > observation.high_mm)] = np.nan
    effort, least = Effort(STEPS, CHOICE_GAIN), (smallest_gain, smallest_light)
    return fit_again(observation, particles, suspects, effort, starts, least, prior).moved
