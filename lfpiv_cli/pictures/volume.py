"""Figures of a reconstructed volume [z, y, x]."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures.depths import DEPTH_LABEL
from lfpiv_cli.pictures.planes import PLANES, plane_panels
from lfpiv_cli.pictures.style import AXIS_NAMES, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
