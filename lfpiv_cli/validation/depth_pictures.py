"""Pictures of how well depth can be told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv_cli.pictures.style import BLUE, GREEN, ORANGE, VERMILION, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def depth_resolution_figure(told: Mapping[str, Any], geometric_mm: float, lens_mm: float) -> Figure:
    """Return lengths and errors over depth, mm, on one logarithmic scale.

    Parameters
    ----------
    told : `elongation_mm` (m,) at `elongation_depth_mm`, and the bound `sigma_mm` (n, 3) of x, y, z at `depth_mm`
    geometric_mm, lens_mm : depth in which views move by one microlens, and its width in the scene
    """
    figure = new_figure(7.5, 4.6)
    axes = figure.subplots()
    sigma = np.array(told["sigma_mm"])
    axes.semilogy(told["elongation_depth_mm"], told["elongation_mm"], "s-", color=VERMILION, label="length by SART")
    axes.axhline(geometric_mm, color=ORANGE, linestyle="--", label="depth that moves views by a microlens")
    axes.axhline(lens_mm, color="0.4", linestyle=":", label="microlens in the scene")
    axes.semilogy(told["depth_mm"], sigma[:, 2], "-", color=BLUE, label="smallest error in depth")
    axes.semilogy(told["depth_mm"], sigma[:, 0], "-.", color=GREEN, label="smallest error across")
    axes.set(xlabel="depth behind the focal plane (mm)", ylabel="mm")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    return figure


@styled
def seeding_bound_figure(told: Mapping[str, Any], papers_per_lens: float) -> Figure:
    """Return the bound of places, `sigma_mm` (n, 3), over the tracers `per_lens` (n,), with the paper's seeding."""
    figure = new_figure(6.5, 3.8)
    axes = figure.subplots()
    sigma = 1e3 * np.array(told["sigma_mm"])
    axes.loglog(told["per_lens"], sigma[:, 2], "o-", color=BLUE, label="depth")
    axes.loglog(told["per_lens"], sigma[:, 0], "^-.", color=GREEN, label="across")
    axes.axvline(papers_per_lens, color="0.4", linestyle="--", label="the paper's seeding")
    axes.set(xlabel="tracers per microlens", ylabel="smallest standard error (µm)")
    axes.set_xticks(told["per_lens"], labels=[f"{each:g}" for each in told["per_lens"]])
    axes.minorticks_off()
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    return figure
