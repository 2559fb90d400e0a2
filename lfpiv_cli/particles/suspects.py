"""Verification of particles that fit badly: two overlapping ones found as one, or one at a wrong depth.

Axes: see `search`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.particles.alternative_depths import try_other_depths
from lfpiv_cli.particles.search import SMALLEST_LIGHT, State, Task, observed
from lfpiv_cli.particles.splitting import split
from lfpiv_cli.particles.view import footprint_radius_mm
from lfpiv_cli.scale import Scale

# A good particle's chi-squared is the one at this percentile; particles that fit worse by this factor are
# suspects.
GOOD_PERCENTILE, SUSPECT_CHI2 = 20.0, 1.5
# Light that stays within about one lens fits well at many depths: radii, in lenses, of footprints near the focal plane.
# Elsewhere hardly one in a hundred suspects finds another depth: it must fit worse by this factor.
NEAR_FOCUS_LENSES, ELSEWHERE_CHI2 = 0.6, 3.0
# Suspected to be two: brighter than typical by this factor, or, in thorough rounds, bright enough for two.
BRIGHT, ENOUGH_FOR_TWO = 1.2, 2.0 * SMALLEST_LIGHT
# What chi-squared must fall by, in units of a good particle's, where one becomes two, and where it changes its depth.
SPLIT_GAIN, DEPTH_GAIN = 40.0, 10.0
# A particle that could not be split or moved is not tried again until it has changed by this much: laterally in
# microlenses, in depths over which light spreads by one lens (Table 2: 0.05 mm), and by these shares in light and in
# chi-squared.
CHANGED_LENSES, CHANGED_DEPTHS, CHANGED_SHARES = 0.05, 0.05 / 1.064, (0.05, 0.2)
# One that is settled stays so until it has changed so many times as much.
SETTLED = 4.0


def with_depths_corrected(task: Task, state: State, chi2: NDArray[np.float64], unexplained: float) -> State:
    """Return the state with particles moved to depths that explain the light better, the residual in place."""
    observation = observed(task, state, unexplained)
    good = good_chi2(chi2)
    near_focus = footprint_radius_mm(task.view, state.particles) < NEAR_FOCUS_LENSES * 2.0 * task.view.half_x_mm
    signature = _signature(task.view.scale, state.particles, chi2)
    suspects = (near_focus | (chi2 > ELSEWHERE_CHI2 * good)) & ~_tried(state.unmoved, state, signature)
    light = SMALLEST_LIGHT * state.typical_light
    moved = try_other_depths(observation, state.particles, suspects, light, DEPTH_GAIN * good, state.prior)
    return replace(state, unmoved=np.concatenate([state.unmoved, signature[suspects & ~moved]]))


def settled(task: Task, state: State, particles: NDArray[np.float64]) -> State:
    """Return the state in which these particles (m, 4) are not suspected while they stay there: other frames tell."""
    return replace(state, settled=_signature(task.view.scale, particles, np.ones(len(particles)))[:, :-1])


def with_overlaps_split(
    task: Task, state: State, chi2: NDArray[np.float64], unexplained: float, thorough: bool
) -> State:
    """Return the state with overlapping particles separated; `thorough`: also those of usual brightness."""
    observation = observed(task, state, unexplained)
    good = good_chi2(chi2)
    bright = state.particles[:, 3] > (ENOUGH_FOR_TWO if thorough else BRIGHT) * state.typical_light
    signature = _signature(task.view.scale, state.particles, chi2)
    suspects = bright & (chi2 > SUSPECT_CHI2 * good) & ~_tried(state.unsplit, state, signature)
    light = SMALLEST_LIGHT * state.typical_light
    partners = split(observation, state.particles, suspects, light, SPLIT_GAIN * good)
    found = partners[:, 3] > 0.0
    return replace(
        state,
        particles=np.concatenate([state.particles, partners[found]]),
        unsplit=np.concatenate([state.unsplit, signature[suspects & ~found]]),
    )


def good_chi2(chi2: NDArray[np.float64]) -> float:
    """Return chi-squared of a particle that fits well."""
    return max(float(np.percentile(chi2, GOOD_PERCENTILE)), 1.0) if chi2.size else 1.0


def _signature(scale: Scale, particles: NDArray[np.float64], chi2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 5) numbers that differ by 1 where a particle has changed enough to be tried again."""
    tiny = np.finfo(np.float64).tiny
    shares = np.log(np.maximum(np.column_stack([particles[:, 3], chi2]), tiny)) / CHANGED_SHARES
    return np.column_stack([particles[:, :3] / scale.box_mm(CHANGED_LENSES, CHANGED_DEPTHS), shares])


def _settled(state: State, signature: NDArray[np.float64]) -> NDArray[np.bool_]:
    return _among(state.settled / SETTLED, signature[:, :-1] / SETTLED)


def _tried(before: NDArray[np.float64], state: State, signature: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which particles were tried before or are settled, and have hardly changed since."""
    return _among(before, signature) | _settled(state, signature)


def _among(tried: NDArray[np.float64], signature: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which signatures are among others, within 1."""
    if not len(tried):
        return np.zeros(len(signature), dtype=bool)
    distance, _ = KDTree(tried).query(signature, p=np.inf, distance_upper_bound=1.0)
    return np.isfinite(distance)
