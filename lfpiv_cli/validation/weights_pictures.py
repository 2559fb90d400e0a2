"""Pictures of single voxels' columns: beside each other (as the paper's Fig. 5) and their figures (as its Fig. 6).

matplotlib is imported inside: it is an optional extra, and slow to load.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.validation.weights import Column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = {
    "drt_exact": "DRT, exact",
    "ert": "ERT, converged",
    "factorised": "ERT, factorised",
    "ray_count": "ERT, 500 x 10,000 rays",
}


def columns_figure(columns: list[Column]) -> Figure:
    """Return the columns of voxels, one row a voxel: direct tracing, equivalent points, factorised, counted."""
    from matplotlib.figure import Figure

    names = [name for name in SHOWN if any(name in column.images for column in columns)]
    figure = Figure(figsize=(2.6 * len(names), 2.6 * len(columns)), layout="constrained")
    axes = figure.subplots(len(columns), len(names), squeeze=False)
    for row, column in zip(axes, columns, strict=True):
        brightest = column.images["ert"].max()
        for axis, name in zip(row, names, strict=True):
            axis.set_axis_off()
            if name in column.images:
                axis.imshow(column.images[name], cmap="gray", vmin=0.0, vmax=brightest, interpolation="nearest")
            axis.set_title(f"{SHOWN[name]}\n({', '.join(f'{value:.3g}' for value in column.centre_mm)}) mm", fontsize=7)
    return figure


def similarity_figure(figures: dict[str, Any], shown: int) -> Figure:
    """Return SSIM, RMSE and L1 of the first voxels, by comparison."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    voxels = figures["voxels"][:shown]
    names = [name for name in figures if name != "voxels" and figures[name] is not None]
    for axis, (key, label) in zip(
        figure.subplots(1, 3), {"ssim": "SSIM", "rmse_grey": "RMSE (grey levels)", "l1": "L1"}.items(), strict=True
    ):
        for name in names:
            values = [voxel.get(name, {}).get(key, np.nan) for voxel in voxels]
            axis.plot(np.arange(1, len(voxels) + 1), values, "o-", markersize=4, label=name.replace("_", " "))
        axis.set(xlabel="voxel", ylabel=label, xticks=np.arange(1, len(voxels) + 1))
        if key != "ssim":
            axis.set_ylim(bottom=0.0)
    axis.legend(fontsize=6)
    return figure


def column_figure(
    rows: NDArray[np.int64], columns: NDArray[np.int64], weights: NDArray[np.float32], title: str
) -> Figure:
    """Return one voxel's column as the sensor would see it, with the pixels' numbers along the edges."""
    from matplotlib.figure import Figure

    picture = np.zeros((int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1))
    picture[rows - rows.min(), columns - columns.min()] = weights
    left, right, top, bottom = columns.min() - 0.5, columns.max() + 0.5, rows.min() - 0.5, rows.max() + 0.5
    figure = Figure(figsize=(6.5, 5.5), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(picture, cmap="gray", extent=(left, right, bottom, top), interpolation="nearest")
    figure.colorbar(image, ax=axis, label="weight (share of the voxel's light)")
    axis.set(xlabel="column", ylabel="row")
    axis.set_title(title, fontsize=8)
    return figure
