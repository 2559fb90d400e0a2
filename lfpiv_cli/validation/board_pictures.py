"""Pictures of reconstructed boards, after the paper's Figs. 8 to 11."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures.style import new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def board_figure(figures: dict[str, Any], volume: NDArray[np.float32], grid: Grid) -> Figure:
    """Return a figure of a board (its light in the plane and from the side) and of the errors by depth.

    `volume` [z, y, x] is the reconstruction of the board nearest the focal plane; `figures` are `board_figures`.
    """
    figure = new_figure(13.0, 8.0)
    axes = figure.subplots(2, 3).ravel()
    bounds = [grid.bounds_mm(axis) for axis in range(3)]
    axes[0].imshow(volume.max(axis=0), origin="lower", extent=(*bounds[0], *bounds[1]))
    axes[0].set(title="board nearest the focal plane, maximum along z", xlabel="x (mm)", ylabel="y (mm)")
    axes[1].imshow(volume.max(axis=1), origin="lower", extent=(*bounds[0], *bounds[2]), aspect="auto")
    axes[1].set(title="the same, maximum along y", xlabel="x (mm)", ylabel="z (mm)")
    table = figures["by_depth"]
    depth = np.array(table["depth_mm"])
    axes[2].errorbar(depth, table["elongation_mm"], table["elongation_sigma_mm"], fmt="o-", capsize=3)
    axes[2].set(title="elongation and its spread", xlabel="z (mm)", ylabel="mm", ylim=(0, None))
    axes[3].plot(depth, np.array(table["centre_mm"]) - depth, "o-", label="Gaussian")
    axes[3].plot(depth, np.array(table["centre_mass_mm"]) - depth, "s--", label="centre of mass")
    axes[3].set(title="centres, measured less true", xlabel="z (mm)", ylabel="mm")
    axes[3].legend()
    middle = 0.5 * (depth[1:] + depth[:-1])
    axes[4].plot(middle, np.diff(table["centre_mm"]) / np.diff(depth), "o-")
    axes[4].set(title="separation of neighbouring depths over the true one", xlabel="z (mm)")
    axes[5].plot(depth, table["spacing_mm"], "o-")
    axes[5].set(title="lateral spacing", xlabel="z (mm)", ylabel="mm")
    return figure
