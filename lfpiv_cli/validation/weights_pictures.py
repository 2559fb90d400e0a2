"""Pictures of single voxels' columns: beside each other (as the paper's Fig. 5) and their figures (as its Fig. 6)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv_cli.notice import written
from lfpiv_cli.pictures.style import COLOURS, MARKERS, new_figure, styled
from lfpiv_cli.validation.weights import Column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = {
    "drt_exact": "DRT, exact",
    "ert": "ERT, converged",
    "factorised": "ERT, factorised",
    "ray_count": "ERT, 500 x 10,000 rays",
}
SHOWN_BEHIND_FACES = {
    "ert": "traced, converged",
    "on_demand": "traced, on demand",
    "factorised": "in strips",
    "ray_count": "500 x 10,000 rays",
}


@styled
def columns_figure(columns: list[Column], shown: dict[str, str] = SHOWN) -> Figure:
    """Return the columns of voxels, one row a voxel: direct tracing, equivalent points, factorised, counted.

    Behind curved faces `SHOWN_BEHIND_FACES`. A row has one scale: the brightest pixel by equivalent points, or traced.
    """
    names = [name for name in shown if any(name in column.images for column in columns)]
    figure = new_figure(2.8 * len(names) + 0.6, 2.9 * len(columns))
    axes = figure.subplots(len(columns), len(names), squeeze=False)
    for row, column in zip(axes, columns, strict=True):
        brightest = column.images["ert"].max()
        for axis, name in zip(row, names, strict=True):
            if name not in column.images:
                axis.set_axis_off()
                continue
            picture = axis.imshow(column.images[name], cmap="gray", vmin=0.0, vmax=brightest, interpolation="nearest")
            axis.set_title(f"{shown[name]}\n({', '.join(written(value) for value in column.centre_mm)}) mm", fontsize=7)
            axis.set(xlabel="column (px)", ylabel="row (px)")
        figure.colorbar(picture, ax=row.tolist(), label="weight (1)", shrink=0.8)
    return figure


@styled
def similarity_figure(figures: dict[str, Any], shown: int) -> Figure:
    """Return SSIM, RMSE and L1 of the first voxels, by comparison; each has its colour and marker."""
    figure = new_figure(12.0, 4.2)
    voxels = figures["voxels"][:shown]
    names = [name for name in figures if name != "voxels" and figures[name] is not None]
    for axis, (key, label) in zip(
        figure.subplots(1, 3), {"ssim": "SSIM", "rmse_grey": "RMSE (grey levels)", "l1": "L1"}.items(), strict=True
    ):
        for number, name in enumerate(names):
            again, k = divmod(number, len(COLOURS))
            values = [voxel.get(name, {}).get(key, np.nan) for voxel in voxels]
            axis.plot(
                np.arange(1, len(voxels) + 1),
                values,
                MARKERS[k] + ("-", "--")[again],
                color=COLOURS[k],
                markerfacecolor="none",
                label=name.replace("_", " "),
            )
        axis.set(xlabel="voxel", ylabel=label, xticks=np.arange(1, len(voxels) + 1))
        if key != "ssim":
            axis.set_ylim(bottom=0.0)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
