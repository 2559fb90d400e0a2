"""Where particles should be in a frame by their tracks before and after it.

Once a sequence has been followed, a frame is known from both sides: a particle that it has lost lies between two places
of its track, and one whose track begins or ends beside it lies on the way on. As a Kalman smoother does after its
filter, what comes later now counts as what came before.

Axes: places (n, 3) in mm of each frame.
"""

from __future__ import annotations

import numpy as np

from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.tracks.in_time import fit_in_time, scatter_of
from lfpiv_cli.tracks.sequences import Ahead
from lfpiv_cli.tracks.trajectories import Frames, Trajectories, places, tracks_in

# Frames on either side that are looked at: a cubic has a place or more to spare.
REACH_FRAMES = 3


def expected_in(found: Trajectories, frames: Frames, number: int) -> Ahead:
    """Return where the particles should be whose tracks have a place in a frame or in one beside it.

    A track's own place in the frame counts as its others do. Of `frames` only those within `REACH_FRAMES` are read.
    """
    window = [k for k in range(number - REACH_FRAMES, number + REACH_FRAMES + 1) if 0 <= k < len(found.labels)]
    tracks = tracks_in(found, [k for k in window if abs(k - number) <= 1])
    position, sigma = places(found, frames, window, tracks)
    known = np.isfinite(position[..., 0])
    told = known.sum(axis=1) > 1
    tracks, position, sigma, known = tracks[told], position[told], sigma[told], known[told]
    time = np.array(window, dtype=np.float64) - number
    state = fit_in_time(position, sigma, time, scatter_of(position, sigma, time))
    light = np.full(known.shape, np.nan)
    for column, frame in enumerate(window):
        there = known[:, column]
        light[there, column] = np.log(frames[frame].light_value()[found.particles(frame, tracks)[there]])
    usual = np.nanmedian(light, axis=1) if len(tracks) else np.zeros(0)
    off = np.abs(light - usual[:, np.newaxis])[known]
    spread = MAD_TO_SIGMA * float(np.median(off)) if off.size else 0.0
    return Ahead(state.position_mm, state.position_sigma, np.exp(usual), spread)
