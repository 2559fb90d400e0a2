"""Pictures of how well depth can be told.

matplotlib is imported inside: it is an optional extra, and slow to load.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def depth_resolution_figure(told: Mapping[str, Any], geometric_mm: float, lens_mm: float) -> Figure:
    """Return lengths and errors over depth, mm, on one logarithmic scale.

    Parameters
    ----------
    told : `elongation_mm` (m,) at `elongation_depth_mm`, and the bound `sigma_mm` (n, 3) of x, y, z at `depth_mm`
    geometric_mm, lens_mm : depth in which views move by one microlens, and its width in the scene
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    axes = figure.subplots()
    sigma = np.array(told["sigma_mm"])
    axes.semilogy(told["elongation_depth_mm"], told["elongation_mm"], "s-", color="#D55E00", label="length by SART")
    axes.axhline(geometric_mm, color="#E69F00", linestyle="--", label="depth that moves views by a microlens")
    axes.axhline(lens_mm, color="0.4", linestyle=":", label="microlens in the scene")
    axes.semilogy(told["depth_mm"], sigma[:, 2], "-", color="#0072B2", label="smallest error in depth")
    axes.semilogy(told["depth_mm"], sigma[:, 0], "-.", color="#009E73", label="smallest error across")
    axes.set(xlabel="depth behind the focal plane (mm)", ylabel="mm")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    return figure


def seeding_bound_figure(told: Mapping[str, Any], papers_per_lens: float) -> Figure:
    """Return the bound of places, `sigma_mm` (n, 3), over the tracers `per_lens` (n,), with the paper's seeding."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 3.8), layout="constrained")
    axes = figure.subplots()
    sigma = 1e3 * np.array(told["sigma_mm"])
    axes.loglog(told["per_lens"], sigma[:, 2], "o-", color="#0072B2", label="depth")
    axes.loglog(told["per_lens"], sigma[:, 0], "^-.", color="#009E73", label="across")
    axes.axvline(papers_per_lens, color="0.4", linestyle="--", label="the paper's seeding")
    axes.set(xlabel="tracers per microlens", ylabel="smallest standard error (µm)")
    axes.set_xticks(told["per_lens"], labels=[f"{each:g}" for each in told["per_lens"]])
    axes.minorticks_off()
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    return figure
