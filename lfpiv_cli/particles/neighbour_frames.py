"""A second pass over an image with the particles found in the frames before and after it, as in time-resolved PTV.

A particle that was found in a neighbour frame and has no partner here is put where the displacements around it lead,
whether its light seems free or not; then all particles are refined, and those that do not find their light are
dropped. So overlapping particles that splitting did not find are separated; only those without a partner are suspected
of being two, or elsewhere. Only first passes serve as neighbours, and of a pair the second frame's first pass begins
with the first frame's, never the other way round (`second_frames`): each frame's result depends on the images alone,
not on the order in which frames are done.

Axes: particles are rows (x, y, z, light) in image axes, mm and counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.particles.least_squares import SEARCH_GAIN
from lfpiv_cli.particles.rounds import ROUNDS, finished, with_suspects_checked
from lfpiv_cli.particles.search import (
    LAST_UNEXPLAINED,
    State,
    Task,
    blank,
    judged,
    merge,
    noise_with,
    prune,
    rebuilt,
    sweep,
    with_measured_noise,
    with_typical_light,
)
from lfpiv_cli.particles.suspects import settled
from lfpiv_cli.scale import Scale
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.light import Light
from lfpiv_cli.tracks.tracking import expected_of, known_of, track

# A particle without a partner this near to where one is expected is that one, at another depth: near the focal plane
# depths may be wrong by as much as lets light spread by one lens. In microlenses and in such depths (Table 2: 1.25 mm).
SAME_LENSES, SAME_DEPTHS = 0.5, 1.25 / 1.064
# Added particles begin with this share of the light that they have in their own frame: some of it is others' for now.
FIRST_SHARE = 0.5
# Sweeps in which they are refined, and how little unexplained light counts then: first as in early rounds, then as at
# the end. The share of its light that each particle must find afterwards.
REFINING = ((3, 0.1), (4, LAST_UNEXPLAINED))
CLAIMED_SHARE = 0.6


def second_pass(
    task: Task, own: NDArray[np.float64], neighbours: Sequence[NDArray[np.float64]], search_mm: float
) -> State:
    """Return what is found with the help of neighbour frames.

    Parameters
    ----------
    task : the image
    own, neighbours : (n, 4) what first passes found in it and in the frames beside it
    search_mm : largest displacement along each axis
    """
    state = rebuilt(task, blank(task), own)
    state = with_typical_light(task, state, judged(task, state, LAST_UNEXPLAINED))
    state = with_measured_noise(task, replace(state, noise=noise_with(task, state.typical_light)))
    missing, partnered = _missing_particles(task, own, neighbours, search_mm)
    state = settled(task, rebuilt(task, state, np.concatenate([own, missing])), own[partnered])
    for sweeps, unexplained in REFINING:
        sweep(task, state, unexplained, sweeps, SEARCH_GAIN)
    # Three may be where two are, one of them found here for both: with the third beside them chi-squared needs all.
    state, _ = prune(task, merge(task, state), CLAIMED_SHARE, LAST_UNEXPLAINED)
    fits = judged(task, state, ROUNDS[-1].unexplained)
    state, _ = with_suspects_checked(task, state, fits, ROUNDS[-1])
    return finished(task, merge(task, state), ROUNDS[-1])


def _missing_particles(
    task: Task, own: NDArray[np.float64], neighbours: Sequence[NDArray[np.float64]], search_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the neighbours' particles (m, 4) that are missing here, where they are expected, and which own ones (n,)
    have partners among them.
    """
    scale, missing, partnered = task.view.scale, np.zeros((0, 4)), np.zeros(len(own), np.bool_)
    same = scale.box_mm(SAME_LENSES, SAME_DEPTHS)
    for other in neighbours:
        expected, partnerless = _without_partner(own, other, search_mm, scale)
        known = np.concatenate([own[partnerless, :3], missing[:, :3]])
        seen = (expected[:, 2] >= task.depths_mm[0]) & (expected[:, 2] <= task.depths_mm[1])
        seen &= ~_same(expected[:, :3] / same, known / same)
        missing = np.concatenate([missing, expected[seen]])
        partnered |= ~partnerless
    return missing * (1.0, 1.0, 1.0, FIRST_SHARE), partnered


def _same(points: NDArray[np.float64], known: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (n, 3) are known ones (m, 3): within 1 and each other's nearest."""
    if not len(points) or not len(known):
        return np.zeros(len(points), np.bool_)
    distance, to = KDTree(known).query(points)
    _, back = KDTree(points).query(known)
    return np.asarray((distance <= 1.0) & (back[to] == np.arange(len(points))))


def _without_partner(
    own: NDArray[np.float64], other: NDArray[np.float64], search_mm: float, scale: Scale
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return another frame's particles (m, 4) that were not tracked, where they are expected here, and which own ones
    were not.
    """
    there, here = (Seen(each[:, :3], light=Light(each[:, 3])) for each in (other, own))
    tracks = track(there, here, search_mm, scale)
    alone, partnerless = np.ones(len(other), np.bool_), np.ones(len(own), np.bool_)
    alone[tracks.first] = partnerless[tracks.second] = False
    if not len(tracks.first):
        return np.zeros((0, 4)), partnerless
    known = known_of(there, here, tracks.first, tracks.second, scale)
    expected = other.copy()
    expected[:, :3] += expected_of(there.position_mm, known, search_mm, scale).displacement_mm
    return expected[alone], partnerless
