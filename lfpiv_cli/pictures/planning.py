"""Pictures of what a rig will see: how well tracers are placed, and how much is in view, by depth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.pictures.style import AXIS_NAMES, BLUE, GREEN, GREY, MARKERS, VERMILION, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (GREEN, VERMILION, BLUE)


@styled
def planning_figure(told: Mapping[str, NDArray[np.float64]], bounds_mm: NDArray[np.float64]) -> Figure:
    """Return errors over depth, and the volume within the field of view seen from above and from the side.

    Parameters
    ----------
    told : `depth_mm` (n,), `sigma_mm` (n, 3), half the fields of view `full_view_mm` and `any_view_mm` (n, 2)
    bounds_mm : (3, 2) of the volume, z from the focal point
    """
    figure = new_figure(9.5, 3.6)
    errors, *views = figure.subplots(1, 3)
    for axis, name in enumerate(AXIS_NAMES):
        errors.semilogy(
            told["depth_mm"], 1e3 * told["sigma_mm"][:, axis], color=COLOURS[axis], marker=MARKERS[axis], label=name
        )
    errors.set(xlabel="z from the focal plane (mm)", ylabel="smallest error of a tracer alone (µm)")
    errors.grid(alpha=0.3, which="both")
    errors.legend()
    for axis, axes in enumerate(views):
        _draw_view(axes, told, bounds_mm, axis)
    views[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return figure


def _draw_view(axes: Axes, told: Mapping[str, NDArray[np.float64]], bounds_mm: NDArray[np.float64], axis: int) -> None:
    """Draw what is in view across one axis, and the volume."""
    depth = told["depth_mm"]
    for name, label, shade in (("any_view_mm", "seen in part", 0.85), ("full_view_mm", "seen in full", 0.65)):
        half = told[name][:, axis]
        axes.fill_between(depth, -half, half, color=str(shade), label=label)
    (left, right), (low, high) = bounds_mm[2], bounds_mm[axis]
    axes.plot([left, right, right, left, left], [low, low, high, high, low], color=VERMILION, label="volume")
    axes.axvline(0.0, color=GREY, linestyle=":")
    axes.set(xlabel="z from the focal plane (mm)", ylabel=f"{AXIS_NAMES[axis]} (mm)")
