"""Figures of a reconstructed volume [z, y, x], and of weights: where a voxel's light falls, and how much by depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures.style import AXIS_NAMES, COLOURS, DEPTH_LABEL, MARKERS, new_figure, styled
from lfpiv_cli.pictures.vectors import PLANES, plane_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def column_figure(
    pixels: tuple[NDArray[np.int64], NDArray[np.int64]], weights: NDArray[np.float32], pixel_mm: float, title: str
) -> Figure:
    """Return one voxel's column as the sensor would see it, against pixels' numbers and mm on the sensor.

    Parameters
    ----------
    pixels : rows and columns of the pixels that the voxel lights, one weight each
    """
    rows, columns = pixels
    picture = np.zeros((int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1))
    picture[rows - rows.min(), columns - columns.min()] = weights
    left, right, top, bottom = columns.min() - 0.5, columns.max() + 0.5, rows.min() - 0.5, rows.max() + 0.5
    figure = new_figure(6.8, 6.0)
    axis = figure.subplots()
    image = axis.imshow(picture, cmap="gray", extent=(left, right, bottom, top), interpolation="nearest")
    figure.colorbar(image, ax=axis, label="weight (share of the voxel's light)", location="bottom", shrink=0.8)
    axis.set(xlabel="column (px)", ylabel="row (px)")
    beside = "mm, from the first pixel lit"
    axis.secondary_xaxis("top", functions=_to_mm(left, pixel_mm)).set_xlabel(beside)
    axis.secondary_yaxis("right", functions=_to_mm(top, pixel_mm)).set_ylabel(beside)
    figure.suptitle(title)
    return figure


def _to_mm(first_px: float, pixel_mm: float) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return the conversions from pixels to mm from a place, and back."""
    return lambda px: (px - first_px) * pixel_mm, lambda mm: mm / pixel_mm + first_px


@styled
def light_figure(z_mm: Floats, sums: Mapping[str, Floats]) -> Figure:
    """Return by depth how much of a voxel's light meets the sensor, for voxels at some lateral places."""
    figure = new_figure(6.5, 3.8)
    axes = figure.subplots()
    for (name, values), colour, marker in zip(sums.items(), COLOURS, MARKERS, strict=False):
        axes.plot(z_mm, values, f"{marker}-", color=colour, markerfacecolor="none", label=name)
    highest = max((float(values.max()) for values in sums.values()), default=1.0)
    axes.set(xlabel=DEPTH_LABEL, ylabel="sum of a voxel's weights (1)", ylim=(0.0, 1.05 * highest or 1.0))
    axes.legend()
    return figure


# The scale of projections ends where so many (%) of their values lie within.
BRIGHT_PERCENT = 99.8


@styled
def projections_figure(volume: NDArray[np.float32], grid: Grid) -> Figure:
    """Return the brightest voxel along each line of sight in the three directions, on one scale."""
    figure, axes = plane_panels(grid)
    # Along an axis that a plane is across, nothing is left but the plane.
    seen = [volume.max(axis=2 - plane.normal) for plane in PLANES]
    limit = float(np.percentile(np.concatenate([each.ravel() for each in seen]), BRIGHT_PERCENT)) or 1.0
    for panel, plane, values in zip(axes[0], PLANES, seen, strict=True):
        image = panel.imshow(
            values,
            origin="lower",
            extent=plane.extent(grid),
            cmap="inferno",
            vmin=0.0,
            vmax=limit,
            interpolation="nearest",
        )
        panel.set(
            xlabel=f"{AXIS_NAMES[plane.right]} (mm)",
            ylabel=f"{AXIS_NAMES[plane.up]} (mm)",
            title=f"largest along {AXIS_NAMES[plane.normal]}",
            aspect="equal",
        )
    figure.colorbar(image, ax=axes[0].tolist(), label="intensity (1)", shrink=0.75, extend="max")
    return figure


@styled
def depths_figure(volume: NDArray[np.float32], grid: Grid) -> Figure:
    """Return the mean intensity of each plane by depth."""
    figure = new_figure(6.0, 3.6)
    axes = figure.subplots()
    axes.plot(grid.axis_mm(2), volume.mean(axis=(1, 2), dtype=np.float64))
    axes.set(xlabel=DEPTH_LABEL, ylabel="mean intensity of the plane (1)", ylim=(0.0, None))
    return figure
