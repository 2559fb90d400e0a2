"""Pictures of bubbles on a channel's wall and of what they do to velocities (the paper's Figs. 16 and 17)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.pictures.style import BLUE, DIVERGING, GREEN, ORANGE, PURPLE, SEQUENTIAL, VERMILION, new_figure, styled
from lfpiv_cli.validation.channel import Duct
from lfpiv_cli.validation.methods import Measured
from lfpiv_cli.validation.near_wall import PAPERS_WALL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "^"), (PURPLE, "v"), (ORANGE, "D"))


@styled
def raw_figure(image: NDArray[np.float32], mask: NDArray[np.bool_]) -> Figure:
    """Return a part of a raw image with bubbles, alone and with the outline of what a mask leaves out."""
    figure = new_figure(10.0, 10.0 * 0.5 * image.shape[0] / image.shape[1] + 1.0)
    highest = float(np.percentile(image[~mask], 99.9)) if not mask.all() else float(image.max())
    for axes, title in zip(figure.subplots(1, 2), ("raw image", "left out by the mask"), strict=True):
        shown = axes.imshow(np.sqrt(np.clip(image, 0.0, highest)), cmap="gray", vmin=0.0, interpolation="nearest")
        axes.set(xlabel="column (px)", ylabel="row (px)", title=title)
    axes.imshow(np.where(mask, 1.0, np.nan), cmap="autumn", alpha=0.6, interpolation="nearest")
    bar = figure.colorbar(shown, ax=figure.axes, shrink=0.8, label="counts, root scale")
    ticks = np.linspace(0.0, np.sqrt(highest), 4)
    bar.set_ticks(list(ticks), labels=[f"{tick**2:.0f}" for tick in ticks])
    return figure


@styled
def plane_figure(methods: Mapping[str, Measured], duct: Duct, plane: int) -> Figure:
    """Return vectors and the error of the velocity along the flow in one x-y plane of windows, by way to measure."""
    main, axis = "xyz".index(duct.axis), duct.across["x/D"]
    first = next(iter(methods.values()))
    highest = float(first.truth[..., main].max())
    figure = new_figure(3.2 * len(methods) + 1.0, 8.2)
    axes = figure.subplots(2, len(methods), squeeze=False, sharex=True, sharey=True)
    for column, (name, m) in zip(axes.T, methods.items(), strict=True):
        places = [m.field.grid.axis_mm(k) for k in (main, axis)]
        along, across = np.meshgrid(*places)
        shares = (across - duct.position_mm(axis, 0.0)) / duct.width_mm
        velocity = _oriented(m.field.velocity[plane], main)
        error = velocity[..., main] - _oriented(m.truth[plane], main)[..., main]
        arrows = column[0].quiver(
            along,
            shares,
            velocity[..., main],
            velocity[..., axis],
            velocity[..., main],
            cmap=SEQUENTIAL,
            clim=(0.0, highest),
            scale=12.0 * highest,
            width=0.008,
        )
        image = column[1].pcolormesh(along, shares, error, cmap=DIVERGING, vmin=-0.5 * highest, vmax=0.5 * highest)
        column[0].set(title=name)
        column[1].set(xlabel=f"{'xyz'[main]}, along the flow (mm)")
        for panel in column:
            panel.axhline(PAPERS_WALL, color="0.4", linewidth=0.8, linestyle="--")
    for panel in axes[:, 0]:
        panel.set_ylabel("x/D")
    figure.colorbar(arrows, ax=axes[0], label="velocity along the flow (m/s)")
    figure.colorbar(image, ax=axes[1], label="measured - true (m/s)")
    return figure


@styled
def wall_profile_figure(methods: Mapping[str, Measured], duct: Duct) -> Figure:
    """Return the mean over flow and depth of the velocity along the flow, over x/D, and its error beside it."""
    figure = new_figure(10.0, 4.2)
    left, right = figure.subplots(1, 2)
    main, axis = "xyz".index(duct.axis), duct.across["x/D"]
    first = next(iter(methods.values()))
    places = _shares(first, duct, axis)
    true = _mean_over(first.truth[..., main], first.inside, axis)
    left.plot(places, true, color="black", label="analytic")
    for (name, m), (colour, marker) in zip(methods.items(), STYLES, strict=False):
        found = _mean_over(m.field.velocity[..., main], m.inside, axis)
        left.plot(_shares(m, duct, axis), found, marker, color=colour, markerfacecolor="none", label=name)
        own = _mean_over(m.truth[..., main], m.inside, axis)
        right.plot(_shares(m, duct, axis), 100.0 * (found / own - 1.0), marker + "-", color=colour, label=name)
    left.set(xlabel="x/D", ylabel="velocity along the flow, mean of the plane (m/s)")
    right.set(xlabel="x/D", ylabel="its error (%)")
    right.axhline(0.0, color="0.6", linewidth=0.8)
    for panel in (left, right):
        _mark_wall(panel)
    left.legend(fontsize=8)
    return figure


def _mark_wall(axes: Axes) -> None:
    """Mark where the paper's velocities are too small."""
    axes.axvspan(PAPERS_WALL, 1.0, color="0.9", zorder=0)
    axes.grid(alpha=0.3)


def _oriented(plane: NDArray[np.float64], main: int) -> NDArray[np.float64]:
    """Return a plane [y, x] of vectors with the flow's axis last."""
    return plane if main == 0 else np.swapaxes(plane, 0, 1)


def _shares(measured: Measured, duct: Duct, axis: int) -> NDArray[np.float64]:
    places = measured.field.grid.axis_mm(axis)
    return np.asarray((places - duct.position_mm(axis, 0.0)) / duct.width_mm)


def _mean_over(values: NDArray[np.float64], inside: NDArray[np.bool_], axis: int) -> NDArray[np.float64]:
    """Return the means (n,) over planes across an axis (0 for x) of values [z, y, x], of what is known inside."""
    others = tuple(k for k in range(3) if k != 2 - axis)
    known = inside & np.isfinite(values)
    count = known.sum(axis=others)
    mean = np.full(count.shape, np.nan)
    np.divide(np.where(known, values, 0.0).sum(axis=others), count, out=mean, where=count > 0)
    return mean
