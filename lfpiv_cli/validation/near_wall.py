"""How well a channel's flow is measured beside one wall, where bubbles stick to it (the paper's Figs. 16 and 17)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.validation.channel import Duct
from lfpiv_cli.validation.flow import TOLERANCE, compare, relative_errors
from lfpiv_cli.validation.methods import Measured

# The paper sees velocities that are too small beyond this share of the channel's width.
PAPERS_WALL = 0.8


@dataclass(frozen=True)
class NearWall:
    """Figures of the windows beyond a share of the width, along the flow.

    Attributes
    ----------
    windows : how many
    within_25 : share of them within a quarter of the true velocity
    mean_error : of the sum of velocities, a share
    within_sigma, mean_sigma : by how much chance moves the two, one standard error each
    """

    windows: int
    within_25: float
    mean_error: float
    within_sigma: float
    mean_sigma: float


def beside_wall(measured: Measured, duct: Duct, beyond: float = PAPERS_WALL) -> NDArray[np.bool_]:
    """Return which windows (nz, ny, nx) lie beyond a share of the width, of those that are judged."""
    axis = duct.across["x/D"]
    places = measured.field.grid.centres_mm()[..., axis]
    return np.asarray(measured.inside & (places > duct.position_mm(axis, beyond)))


def near_wall(measured: Measured, duct: Duct, beyond: float = PAPERS_WALL) -> NearWall:
    """Return the figures of a duct's windows near the wall at the high end of its lateral axis."""
    pairs = compare(measured.field, measured.truth, beside_wall(measured, duct, beyond))
    streamwise, _ = relative_errors(pairs)
    # a duct's flow has a direction
    assert streamwise is not None
    assert pairs.direction is not None
    within = streamwise < TOLERANCE
    true, found = pairs.true @ pairs.direction, pairs.measured @ pairs.direction
    error, total = (found - true)[pairs.found], float(true[pairs.found].sum())
    count = len(within)
    return NearWall(
        count,
        float(within.mean()),
        float(error.sum() / total),
        float(np.sqrt(within.mean() * (1.0 - within.mean()) / count)),
        float(np.sqrt(error.size) * error.std() / total),
    )
