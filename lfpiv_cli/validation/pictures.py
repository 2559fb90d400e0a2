"""Pictures of a measured flow beside the true one.

matplotlib is imported inside: it is an optional extra, and slow to load.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.validation.channel import PAPER_SLICES, Duct, table_4
from lfpiv_cli.validation.flow import Comparison, compare, cumulative_distribution

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COMPONENT_NAMES = ("u", "v", "w")


def flow_figure(field: VectorField, truth_velocity: NDArray[np.float64], inside: NDArray[np.bool_]) -> Figure:
    """Return a picture of a measured flow: mid-plane vectors and errors, profiles, cumulative distribution.

    Parameters
    ----------
    truth_velocity : (nz, ny, nx, 3) m/s at the window centres
    inside : (nz, ny, nx) True for the windows that are judged
    """
    from matplotlib.figure import Figure

    pairs = compare(field, truth_velocity, inside)
    figure = Figure(figsize=(12.0, 7.5), layout="constrained")
    axes = figure.subplots(2, 3)
    main = int(np.argmax(np.abs(pairs.direction))) if pairs.direction is not None else 0
    _draw_plane(axes[0, 0], field, main)
    _draw_error(axes[0, 1], field, truth_velocity, inside, main)
    _draw_cumulative(axes[0, 2], pairs)
    for axis in range(3):
        _draw_profile(axes[1, axis], field, truth_velocity, inside, axis, main)
    return figure


def slices_figure(
    field: VectorField, truth_velocity: NDArray[np.float64], inside: NDArray[np.bool_], duct: Duct
) -> Figure:
    """Return the paper's six slices: streamwise profiles across each (Fig. 16), and their errors beside Table 4's.

    Profiles are means along the flow, over the planes of windows on both sides of a slice.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 3)
    table = table_4(field, truth_velocity, inside, duct)
    main = "xyz".index(duct.axis)
    measured = np.where(inside[..., np.newaxis], field.velocity, np.nan)
    for row, (name, axis) in zip(axes, duct.across.items(), strict=True):
        other = 3 - axis - main
        for panel, share in zip(row, PAPER_SLICES[name], strict=True):
            position = duct.position_mm(axis, share)
            places = field.grid.axis_mm(other)
            for values, style, label in ((truth_velocity, "-", "true"), (measured, "o", "measured")):
                profile = _profile_at(values[..., main], field.grid.axis_mm(axis), position, axis, main)
                panel.plot(places, profile, style, markersize=4, label=label)
            errors = table[f"{name} {share}"]
            ours = "unknown" if errors["ours_percent"] is None else f"{errors['ours_percent']:.2f} %"
            panel.set(
                title=f"{name} = {share}: {ours} (paper {errors['paper_ert_percent']:.2f} %)",
                xlabel=f"{'xyz'[other]} (mm)",
                ylabel=f"{COMPONENT_NAMES[main]} (m/s)",
            )
            panel.legend()
    return figure


def _profile_at(
    values: NDArray[np.float64], places: NDArray[np.float64], position: float, axis: int, along: int
) -> NDArray[np.float64]:
    """Return a slice across one axis (0 for x) of values [z, y, x], interpolated, and its mean along another."""
    at = float(np.clip(np.interp(position, places, np.arange(places.size)), 0, places.size - 1))
    low = min(int(at), max(0, places.size - 2))
    high = min(low + 1, places.size - 1)
    planes = np.moveaxis(values, (2 - axis, 2 - along), (0, 1))
    known = np.isfinite(planes[low]) & np.isfinite(planes[high])
    between = np.where(known, (1.0 - (at - low)) * planes[low] + (at - low) * planes[high], 0.0)
    count = known.sum(axis=0)
    profile = np.full(count.shape, np.nan)
    np.divide(between.sum(axis=0), count, out=profile, where=count > 0)
    return profile


def _mid_plane(values: NDArray) -> NDArray:
    """Return the middle x-y plane of an array [z, y, x]."""
    return values[values.shape[0] // 2]


def _draw_plane(axes: Axes, field: VectorField, main: int) -> None:
    """Draw the measured vectors of the mid plane, coloured by the main component."""
    velocity = _mid_plane(field.velocity)
    x, y = np.meshgrid(field.grid.axis_mm(0), field.grid.axis_mm(1))
    shown = np.isfinite(velocity).all(axis=-1)
    if shown.any():
        u, v = velocity[shown, 0], velocity[shown, 1]
        arrows = axes.quiver(x[shown], y[shown], u, v, velocity[shown, main], angles="xy")
        axes.figure.colorbar(arrows, ax=axes, label=f"{COMPONENT_NAMES[main]} (m/s)")
    _label_plane(axes, field, "measured")


def _draw_error(
    axes: Axes, field: VectorField, truth: NDArray[np.float64], inside: NDArray[np.bool_], main: int
) -> None:
    """Draw measured less true main component in the mid plane; blank where missing or outside."""
    error = np.where(_mid_plane(inside), _mid_plane(field.velocity - truth)[..., main], np.nan)
    found = np.abs(error[np.isfinite(error)])
    limit = float(found.max()) if found.size and found.max() > 0.0 else 1.0
    x_low, x_high = field.grid.bounds_mm(0)
    y_low, y_high = field.grid.bounds_mm(1)
    image = axes.imshow(
        error, origin="lower", extent=(x_low, x_high, y_low, y_high), cmap="RdBu_r", vmin=-limit, vmax=limit
    )
    axes.figure.colorbar(image, ax=axes, label=f"{COMPONENT_NAMES[main]} measured - true (m/s)")
    _label_plane(axes, field, "error")


def _label_plane(axes: Axes, field: VectorField, title: str) -> None:
    """Name the axes of a mid-plane picture."""
    depth = field.grid.axis_mm(2)[field.grid.shape_xyz[2] // 2]
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=f"{title}, z = {depth:.2f} mm", aspect="equal")


def _draw_cumulative(axes: Axes, pairs: Comparison) -> None:
    """Draw the share of vectors over their relative error."""
    shares = cumulative_distribution(pairs)
    for name, label in (("streamwise_share", "streamwise"), ("vector_share", "whole vector")):
        if shares[name] is not None:
            axes.plot(shares["relative_error"], shares[name], label=label)
    axes.axvline(0.25, color="0.7", linewidth=0.8)
    axes.set(xlabel="relative error", ylabel="share of vectors", title="cumulative distribution", ylim=(0.0, 1.0))
    axes.legend()


def _draw_profile(
    axes: Axes,
    field: VectorField,
    truth: NDArray[np.float64],
    inside: NDArray[np.bool_],
    axis: int,
    main: int,
) -> None:
    """Draw the means over planes across an axis: the main component, measured and true, over the same windows."""
    judged = inside & np.isfinite(field.velocity).all(axis=-1)
    others = tuple(k for k in range(3) if k != 2 - axis)
    count = judged.sum(axis=others)
    for values, style, label in ((truth, "-", "true"), (field.velocity, "o", "measured")):
        total = np.where(judged, values[..., main], 0.0).sum(axis=others)
        mean = np.full(count.shape, np.nan)
        np.divide(total, count, out=mean, where=count > 0)
        axes.plot(field.grid.axis_mm(axis), mean, style, markersize=4, label=label)
    # Zero belongs in the picture: else the scale would blow up noise of a per mille.
    axes.axhline(0.0, color="0.7", linewidth=0.8)
    axes.set(xlabel=f"{'xyz'[axis]} (mm)", ylabel=f"{COMPONENT_NAMES[main]} (m/s), mean over the plane")
    axes.legend()
