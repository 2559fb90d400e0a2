"""Pictures of the report on the paper that belong to no other comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING

from numpy.typing import NDArray

from lfpiv_cli.pictures.style import BLUE, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def focal_plane_figure(focal_error_mm: NDArray, off_mm: NDArray, sigma_mm: NDArray) -> Figure:
    """Return the error of the mid plane's place (n,) with its standard error over how far the focus was off, mm."""
    figure = new_figure(6.5, 3.6)
    axes = figure.subplots()
    axes.errorbar(focal_error_mm, 1e3 * off_mm, 1e3 * sigma_mm, fmt="o", color=BLUE, capsize=3)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="board behind the focal plane (mm)", ylabel="mid plane, measured - true (µm)")
    return figure
