"""Pictures of the paper's channel flow (Figs. 15, 16 and 18): its six slices, by several ways to measure.

Axes: lengths as shares of the channel's width from its low wall, as the paper has them; its x is our other lateral
axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.pictures.style import BLUE, GREEN, PURPLE, SEQUENTIAL, VERMILION, new_figure, styled
from lfpiv_cli.synthetic.flows import Flow
from lfpiv_cli.validation.channel import PAPER_SLICES, Duct
from lfpiv_cli.validation.flow import TOLERANCE, compare, cumulative_distribution
from lfpiv_cli.validation.methods import Measured
from lfpiv_cli.validation.pictures import profile_at, slice_at

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Colours that the colour-blind tell apart; in print markers do.
STYLES = ((VERMILION, "s", "--"), (BLUE, "o", "-."), (GREEN, "^", "-"), (PURPLE, "v", ":"))
# Points of the lines of the true flow.
LINE_POINTS = 101


@styled
def slice_maps_figure(methods: Mapping[str, Measured], duct: Duct) -> Figure:
    """Return the size of the velocity in the six slices (columns), true and by each way (rows), on one scale."""
    first = next(iter(methods.values()))
    rows = {"true": (first, first.truth)} | {name: (m, m.field.velocity) for name, m in methods.items()}
    highest = max(float(np.linalg.norm(m.truth[m.inside], axis=-1).max()) for m in methods.values())
    figure = new_figure(13.0, 2.3 * len(rows) + 0.6)
    axes = figure.subplots(len(rows), 6, squeeze=False, sharey=True)
    main = "xyz".index(duct.axis)
    for row, (name, (measured, velocity)) in zip(axes, rows.items(), strict=True):
        speed = np.where(measured.inside, np.linalg.norm(velocity, axis=-1), np.nan)
        places = [(k, axis, share) for k, axis in duct.across.items() for share in PAPER_SLICES[k]]
        for panel, (key, axis, share) in zip(row, places, strict=True):
            other = 3 - axis - main
            position = duct.position_mm(axis, share)
            shown = slice_at(speed, measured.field.grid.axis_mm(axis), position, axis)
            # of what is left of [z, y, x] the flow's axis goes up, as the paper has it
            shown = shown if _first_left(axis) == main else shown.T
            image = panel.imshow(
                shown,
                origin="lower",
                extent=(*_shares(measured, duct, other), *_shares(measured, duct, main)),
                vmin=0.0,
                vmax=highest,
                cmap=SEQUENTIAL,
                aspect="auto",
            )
            panel.set(xlabel=f"{_paper_name(other)}/D", title=f"{key} = {share}")
        row[0].set_ylabel(f"{name}\ny/D, along the flow")
    figure.colorbar(image, ax=axes, label="size of the velocity (m/s)", shrink=0.8)
    return figure


@styled
def profiles_figure(methods: Mapping[str, Measured], duct: Duct, flow: Flow) -> Figure:
    """Return the velocity along the flow in the six slices, means along the flow, with lines of the true flow."""
    figure = new_figure(11.0, 6.5)
    axes = figure.subplots(2, 3, sharey=True)
    main = "xyz".index(duct.axis)
    for row, (key, axis) in zip(axes, duct.across.items(), strict=True):
        other = 3 - axis - main
        for panel, share in zip(row, PAPER_SLICES[key], strict=True):
            position = duct.position_mm(axis, share)
            shares = np.linspace(0.0, 1.0, LINE_POINTS)
            points = np.tile(duct.centre_mm, (LINE_POINTS, 1))
            points[:, axis], points[:, other] = position, [duct.position_mm(other, s) for s in shares]
            panel.plot(shares, flow(points)[:, main], color="black", label="analytic")
            for (name, m), (colour, marker, _) in zip(methods.items(), STYLES, strict=False):
                velocity = np.where(m.inside, m.field.velocity[..., main], np.nan)
                profile = profile_at(velocity, m.field.grid.axis_mm(axis), position, axis, main)
                places = _share(m.field.grid.axis_mm(other), duct, other)
                panel.plot(places, profile, marker, color=colour, markersize=5, markerfacecolor="none", label=name)
            panel.set(title=f"{key} = {share}", xlabel=f"{_paper_name(other)}/D", xlim=(0.0, 1.0))
            panel.grid(alpha=0.3)
        row[0].set_ylabel("velocity along the flow (m/s)")
    axes[0, 0].legend(fontsize=8)
    return figure


@styled
def cumulative_figure(methods: Mapping[str, Measured]) -> Figure:
    """Return the share of vectors over their relative error, along the flow and of the whole vector, with the 25 %."""
    figure = new_figure(10.0, 4.2)
    panels = figure.subplots(1, 2, sharey=True)
    for (name, m), (colour, _, line) in zip(methods.items(), STYLES, strict=False):
        shares = cumulative_distribution(compare(m.field, m.truth, m.inside))
        errors = 100.0 * np.array(shares["relative_error"])
        for axes, key in zip(panels, ("streamwise_share", "vector_share"), strict=True):
            axes.plot(errors, 100.0 * np.array(shares[key], dtype=np.float64), line, color=colour, label=name)
    panels[0].plot([100.0 * TOLERANCE], [75.0], "k*", markersize=9, label="paper: more than 75 %")
    for axes, what in zip(panels, ("the velocity along the flow", "the whole vector"), strict=True):
        axes.axvline(100.0 * TOLERANCE, color="0.4", linewidth=0.8)
        axes.set(xlabel=f"relative error of {what} (%)", xlim=(0.0, 100.0), ylim=(0.0, 101.0))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("share of the vectors (%)")
    panels[0].legend(loc="lower right")
    return figure


def _first_left(axis: int) -> int:
    """Return the axis (0 for x) that is the first of an array [z, y, x] without one."""
    return 1 if axis == 2 else 2


def _paper_name(axis: int) -> str:
    """Return the paper's name of an axis across the flow: its x is our other lateral one."""
    return "z" if axis == 2 else "x"


def _share(places_mm: NDArray[np.float64], duct: Duct, axis: int) -> NDArray[np.float64]:
    """Return places along an axis as shares of the width from the low wall."""
    return np.asarray((places_mm - duct.position_mm(axis, 0.0)) / duct.width_mm)


def _shares(measured: Measured, duct: Duct, axis: int) -> tuple[float, float]:
    """Return the bounds of the windows along an axis as shares of the width; along the flow from the first one."""
    low, high = measured.field.grid.bounds_mm(axis)
    if "xyz".index(duct.axis) == axis:
        return 0.0, (high - low) / duct.width_mm
    ends = _share(np.array([low, high]), duct, axis)
    return float(ends[0]), float(ends[1])
