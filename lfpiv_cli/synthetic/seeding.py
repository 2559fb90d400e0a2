"""Where tracers are seeded, so that images of a volume hold all the light that real ones would.

Axes: (x, y, z) in mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.synthetic.flows import MM_PER_M, Flow
from lfpiv_cli.synthetic.scenes import Box

# Points along each side of the volume at which the flow is asked for its speed: smooth flows change less than this
# resolves, and the faster tracer that it misses is one at the rim of a sequence's first or last frame.
SPEED_POINTS = 21


def seeded_boxes(volume: Grid, reach_mm: float, flow: Flow, carried_s: float, walls: Box | None) -> tuple[Box, Box]:
    """Return the box to seed, and the part of the measured volume that holds tracers.

    Parameters
    ----------
    volume : that is measured
    reach_mm : how far beside the volume a tracer still lights its pixels
    flow, carried_s : tracers are carried by it for this long before and after the time of the seeding; those that come
        into the volume so, or leave it, are seeded too
    walls : between which there are tracers; None: everywhere
    """
    inside = Box.around(volume, (0.0, 0.0, 0.0))
    carried = carried_s * largest_speed_mm_s(flow, inside)
    box = inside.wider((reach_mm + carried[0], reach_mm + carried[1], carried[2]))
    return (box, inside) if walls is None else (box.within(walls), inside.within(walls))


def largest_speed_mm_s(flow: Flow, box: Box) -> NDArray[np.float64]:
    """Return the largest speed along each axis (3,) on a lattice of points of a box."""
    sides = [np.linspace(low, high, SPEED_POINTS) for low, high in zip(box.low_mm, box.high_mm, strict=True)]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(MM_PER_M * np.abs(flow(points)).max(axis=0))
