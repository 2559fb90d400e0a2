"""Quantities of points over their depth: medians of points in slabs of equal thickness."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.pictures.style import COLOURS, MARKERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SLABS = 20
# A median of fewer points says little.
FEWEST_POINTS = 3
DEPTH_LABEL = "z (mm)"


def slab_edges(z_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the faces of slabs (SLABS + 1,) between the first and the last point; of unit thickness without any."""
    if not z_mm.size or np.ptp(z_mm) == 0.0:
        middle = float(z_mm[0]) if z_mm.size else 0.0
        return np.linspace(middle - 0.5, middle + 0.5, SLABS + 1)
    return np.linspace(float(z_mm.min()), float(z_mm.max()), SLABS + 1)


def percentiles_by_depth(
    z_mm: NDArray[np.float64], values: NDArray[np.float64], percent: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the middles of slabs, and a percentile (100 for the largest) of the known values in each, else NaN."""
    edges = slab_edges(z_mm)
    slab = np.clip(np.searchsorted(edges, z_mm, side="right") - 1, 0, SLABS - 1)
    found = np.full(SLABS, np.nan)
    for k in range(SLABS):
        inside = values[(slab == k) & np.isfinite(values)]
        if inside.size >= FEWEST_POINTS:
            found[k] = np.percentile(inside, percent)
    return 0.5 * (edges[:-1] + edges[1:]), found


def draw_medians(axes: Axes, z_mm: NDArray[np.float64], quantities: dict[str, NDArray[np.float64]], label: str) -> None:
    """Draw medians by depth, a curve for each quantity, on a logarithmic scale."""
    for (name, values), colour, marker in zip(quantities.items(), COLOURS, MARKERS, strict=False):
        axes.plot(*percentiles_by_depth(z_mm, values, 50.0), f"{marker}-", color=colour, label=name)
    axes.set(xlabel=DEPTH_LABEL, ylabel=label)
    axes.set_yscale("log")
    if len(quantities) > 1:
        axes.legend()
