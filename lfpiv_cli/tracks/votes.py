"""The first guess of links: neighbours vote for displacements that resemble their own.

A displacement that takes a particle to one of the next frame takes many of its neighbours to others there, more or
less: how far neighbours' displacements differ is not known at first, so likenesses of several widths count together.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.scale import Scale
from lfpiv_cli.threads import share_out
from lfpiv_cli.tracks.candidates import Candidates

NEIGHBOURS = 14
# Standard deviations of the differences between neighbours' displacements, laterally, in microlenses in the scene.
WIDTHS_LENSES = (0.4, 0.8, 1.6)
# Differences beyond so many of the widest one are none of a neighbour's.
REACH = 3.0
# The share of neighbours without a partner, or that move in ways of their own.
ALONE = 0.1
# Pairs whose light speaks against them more than this take no part.
LEAST_LIGHT_RATIO = 0.02


def votes(
    points: NDArray[np.float64],
    candidates: Candidates,
    density_per_mm3: float,
    scale: Scale,
    equal: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the logarithm (c,) of how much more likely each pair is than chance; -inf where light excludes it.

    Parameters
    ----------
    points : (n, 3) of the first frame
    candidates : in the order of these
    density_per_mm3 : of the particles of the second frame
    equal : (3,) what distances are divided by, so that they are known equally well along all axes
    """
    taken = np.flatnonzero(candidates.light_ratio > LEAST_LIGHT_RATIO)
    ratio = candidates.light_ratio[taken]
    begin = np.searchsorted(candidates.first[taken], np.arange(len(points) + 1))
    count = min(NEIGHBOURS + 1, len(points))
    neighbours = KDTree(points).query(points, k=np.arange(1, count + 1))[1][:, 1:]
    widths = np.array(WIDTHS_LENSES) * scale.lens_mm
    heights = 1.0 / ((2.0 * np.pi) ** 1.5 * widths**3 * np.prod(equal) * len(widths) * density_per_mm3)
    support = np.empty(len(taken))
    share_out(
        _support,
        len(points),
        begin,
        candidates.displacement_mm[taken] / equal,
        ratio,
        np.ascontiguousarray(neighbours),
        widths,
        heights,
        support,
    )
    score = np.full(len(candidates.first), -np.inf)
    score[taken] = support + np.log(ratio)
    return score


@njit(cache=True, nogil=True)
def _support(
    part: tuple[int, int],
    begin: NDArray[np.int64],
    displacement: NDArray[np.float64],
    ratio: NDArray[np.float64],
    neighbours: NDArray[np.int64],
    widths: NDArray[np.float64],
    heights: NDArray[np.float64],
    support: NDArray[np.float64],
) -> None:
    """Write the sum over a particle's neighbours of how well one of their pairs resembles each of its own."""
    furthest2 = (REACH * widths[-1]) ** 2
    for n in range(part[0], part[1]):
        for c in range(begin[n], begin[n + 1]):
            total = 0.0
            for k in range(neighbours.shape[1]):
                beside = neighbours[n, k]
                alike = 0.0
                for other in range(begin[beside], begin[beside + 1]):
                    x = displacement[other, 0] - displacement[c, 0]
                    y = displacement[other, 1] - displacement[c, 1]
                    z = displacement[other, 2] - displacement[c, 2]
                    off2 = x * x + y * y + z * z
                    if off2 < furthest2:
                        for w in range(widths.size):
                            alike += ratio[other] * heights[w] * np.exp(-0.5 * off2 / (widths[w] * widths[w]))
                total += np.log(ALONE + (1.0 - ALONE) * alike)
            support[c] = total
