"""Pictures of a measured flow beside the true one.

matplotlib is imported inside: it is an optional extra, and slow to load.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.validation.channel import PAPER_SLICES, Duct, table_4
from lfpiv_cli.validation.flow import Comparison, compare, cumulative_distribution
from lfpiv_cli.validation.methods import Measured

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COMPONENT_NAMES = ("u", "v", "w")
# Of the truth, and of the methods in their order.
STYLES = ("-", "o", "x")


def flow_figure(methods: Mapping[str, Measured]) -> Figure:
    """Return a picture of flows measured on one grid, at least one of them.

    A row for each: vectors and errors in the mid plane (errors on one scale), cumulative distribution; below them the
    profiles of all.
    """
    from matplotlib.figure import Figure

    pairs = {name: compare(m.field, m.truth, m.inside) for name, m in methods.items()}
    direction = next(iter(pairs.values())).direction
    main = int(np.argmax(np.abs(direction))) if direction is not None else 0
    errors = {name: _mid_plane_error(m, main) for name, m in methods.items()}
    found = np.concatenate([np.abs(error[np.isfinite(error)]) for error in errors.values()])
    limit = float(found.max()) if found.size and found.max() > 0.0 else 1.0
    figure = Figure(figsize=(12.0, 3.75 * (len(methods) + 1)), layout="constrained")
    axes = figure.subplots(len(methods) + 1, 3)
    for row, (name, m) in zip(axes, methods.items(), strict=False):
        _draw_plane(row[0], m.field, main, name)
        _draw_error(row[1], m.field, errors[name], limit, main, name)
        _draw_cumulative(row[2], pairs[name], name)
    for axis in range(3):
        _draw_profile(axes[-1, axis], methods, axis, main)
    return figure


def slices_figure(methods: Mapping[str, Measured], duct: Duct) -> Figure:
    """Return the paper's six slices: streamwise profiles across each (Fig. 16), and their errors beside Table 4's.

    Profiles are means along the flow, over the planes of windows on both sides of a slice.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 3)
    tables = {name: table_4(m.field, m.truth, m.inside, duct) for name, m in methods.items()}
    main = "xyz".index(duct.axis)
    first = next(iter(methods.values()))
    grid = first.field.grid
    curves = {"true": first.truth} | {
        name: np.where(m.inside[..., np.newaxis], m.field.velocity, np.nan) for name, m in methods.items()
    }
    for row, (name, axis) in zip(axes, duct.across.items(), strict=True):
        other = 3 - axis - main
        for panel, share in zip(row, PAPER_SLICES[name], strict=True):
            position = duct.position_mm(axis, share)
            for (label, values), style in zip(curves.items(), STYLES, strict=False):
                profile = profile_at(values[..., main], grid.axis_mm(axis), position, axis, main)
                panel.plot(grid.axis_mm(other), profile, style, markersize=4, label=label)
            rows = {method: table[f"{name} {share}"] for method, table in tables.items()}
            told = [_told(method, errors["ours_percent"]) for method, errors in rows.items()]
            paper = next(iter(rows.values()))["paper_ert_percent"]
            panel.set(
                title=f"{name} = {share} (paper {paper:.2f} %)\n{', '.join(told)}",
                xlabel=f"{'xyz'[other]} (mm)",
                ylabel=f"{COMPONENT_NAMES[main]} (m/s)",
            )
            panel.legend()
    return figure


def _told(method: str, percent: float | None) -> str:
    return f"{method} unknown" if percent is None else f"{method} {percent:.2f} %"


def profile_at(
    values: NDArray[np.float64], places: NDArray[np.float64], position: float, axis: int, along: int
) -> NDArray[np.float64]:
    """Return a slice across one axis (0 for x) of values [z, y, x], interpolated, and its mean along another."""
    # what is left of [z, y, x] once the first axis is taken
    left = [k for k in (2, 1, 0) if k != axis].index(along)
    between = slice_at(values, places, position, axis)
    known = np.isfinite(between)
    count = known.sum(axis=left)
    profile = np.full(count.shape, np.nan)
    np.divide(np.where(known, between, 0.0).sum(axis=left), count, out=profile, where=count > 0)
    return profile


def slice_at(
    values: NDArray[np.float64], places: NDArray[np.float64], position: float, axis: int
) -> NDArray[np.float64]:
    """Return a slice across one axis (0 for x) of values [z, y, x], interpolated between planes at `places`."""
    at = float(np.clip(np.interp(position, places, np.arange(places.size)), 0, places.size - 1))
    low = min(int(at), max(0, places.size - 2))
    high = min(low + 1, places.size - 1)
    planes = np.moveaxis(values, 2 - axis, 0)
    return np.asarray((1.0 - (at - low)) * planes[low] + (at - low) * planes[high])


def _mid_plane(values: NDArray) -> NDArray:
    """Return the middle x-y plane of an array [z, y, x]."""
    return values[values.shape[0] // 2]


def _draw_plane(axes: Axes, field: VectorField, main: int, name: str) -> None:
    """Draw the measured vectors of the mid plane, coloured by the main component."""
    velocity = _mid_plane(field.velocity)
    x, y = np.meshgrid(field.grid.axis_mm(0), field.grid.axis_mm(1))
    shown = np.isfinite(velocity).all(axis=-1)
    if shown.any():
        u, v = velocity[shown, 0], velocity[shown, 1]
        arrows = axes.quiver(x[shown], y[shown], u, v, velocity[shown, main], angles="xy")
        axes.figure.colorbar(arrows, ax=axes, label=f"{COMPONENT_NAMES[main]} (m/s)")
    _label_plane(axes, field, name)


def _mid_plane_error(measured: Measured, main: int) -> NDArray[np.float64]:
    """Return measured less true main component in the mid plane, m/s; NaN where missing or outside."""
    error = _mid_plane(measured.field.velocity - measured.truth)[..., main]
    return np.asarray(np.where(_mid_plane(measured.inside), error, np.nan))


def _draw_error(axes: Axes, field: VectorField, error: NDArray[np.float64], limit: float, main: int, name: str) -> None:
    """Draw errors of the main component in the mid plane, from -limit to limit; blank where unknown."""
    x_low, x_high = field.grid.bounds_mm(0)
    y_low, y_high = field.grid.bounds_mm(1)
    image = axes.imshow(
        error, origin="lower", extent=(x_low, x_high, y_low, y_high), cmap="RdBu_r", vmin=-limit, vmax=limit
    )
    axes.figure.colorbar(image, ax=axes, label=f"{COMPONENT_NAMES[main]} measured - true (m/s)")
    _label_plane(axes, field, f"error of {name}")


def _label_plane(axes: Axes, field: VectorField, title: str) -> None:
    """Name the axes of a mid-plane picture."""
    depth = field.grid.axis_mm(2)[field.grid.shape_xyz[2] // 2]
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{title}, z = {depth:.2f} mm", aspect="equal")


def _draw_cumulative(axes: Axes, pairs: Comparison, name: str) -> None:
    """Draw the share of vectors over their relative error."""
    shares = cumulative_distribution(pairs)
    for share, label in (("streamwise_share", "streamwise"), ("vector_share", "whole vector")):
        if shares[share] is not None:
            axes.plot(shares["relative_error"], shares[share], label=label)
    axes.axvline(0.25, color="0.7", linewidth=0.8)
    axes.set(xlabel="relative error", ylabel="share of vectors", title=f"{name}, cumulative", ylim=(0.0, 1.0))
    axes.legend()


def _draw_profile(axes: Axes, methods: Mapping[str, Measured], axis: int, main: int) -> None:
    """Draw the means over planes across an axis: the main component, over the windows that all methods have found."""
    others = tuple(k for k in range(3) if k != 2 - axis)
    first = next(iter(methods.values()))
    curves = {"true": first.truth} | {name: m.field.velocity for name, m in methods.items()}
    judged = np.all([m.inside & np.isfinite(m.field.velocity).all(axis=-1) for m in methods.values()], axis=0)
    count = judged.sum(axis=others)
    for (label, values), style in zip(curves.items(), STYLES, strict=False):
        total = np.where(judged, values[..., main], 0.0).sum(axis=others)
        mean = np.full(count.shape, np.nan)
        np.divide(total, count, out=mean, where=count > 0)
        axes.plot(first.field.grid.axis_mm(axis), mean, style, markersize=4, label=label)
    # Zero belongs in the picture: else the scale would blow up noise of a per mille.
    axes.axhline(0.0, color="0.7", linewidth=0.8)
    axes.set(xlabel=f"{'xyz'[axis]} (mm)", ylabel=f"{COMPONENT_NAMES[main]} (m/s), mean over the plane")
    axes.legend()
