"""Active sets: which particles the next sweep fits again, because their last fit or neighbours' fits changed something.

A fit that lowers chi-squared by g changes a particle's light by g, in pixels' variances. Of that a neighbour sees what
their light has in common.

Axes: image axes, mm; a particle is a row (x, y, z, light).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.particles.view import View, footprint_radius_mm, on_array_mm

# A particle is fitted again where its neighbours' gains, as far as their light overlaps with its own, exceed by this
# factor what ends a fit. What is left undone so is less than a thousandth of what sweeps gain.
DISTURBING = 20.0


class Overlaps(NamedTuple):
    """Pairs of particles whose footprints overlap, and the share of a gain that the other of the two sees."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    share: NDArray[np.float64]


def overlaps_of(view: View, particles: NDArray[np.float64]) -> Overlaps:
    """Return which particles (n, 4) disturb each other: the more, the closer their middles and their radii are."""
    on_array = on_array_mm(view, particles)
    # Light that touches a lens's cell spreads over it.
    radius = footprint_radius_mm(view, particles) + 2.0 * max(view.half_x_mm, view.half_y_mm)
    pairs = KDTree(on_array).query_pairs(2.0 * float(radius.max(initial=0.0)), output_type="ndarray")
    first, second = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)
    distance = np.hypot(*(on_array[first] - on_array[second]).T)
    one, other = radius[first], radius[second]
    near = np.maximum(1.0 - distance / (one + other), 0.0)
    return Overlaps(first, second, (near * np.minimum(one, other) / np.maximum(one, other)) ** 2)


def disturbance(overlaps: Overlaps, gain: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what each particle (n,) sees of its neighbours' gains (n,)."""
    first, second, share = overlaps
    seen = np.zeros(gain.size)
    for one, other in ((first, second), (second, first)):
        seen += np.bincount(one, share * gain[other], gain.size)
    return seen
