"""Pictures of the report on the paper that belong to no other comparison.

matplotlib is imported inside: it is an optional extra, and slow to load.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def focal_plane_figure(focal_error_mm: NDArray, off_mm: NDArray, sigma_mm: NDArray) -> Figure:
    """Return the error of the mid plane's place (n,) with its standard error over how far the focus was off, mm."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.errorbar(focal_error_mm, 1e3 * off_mm, 1e3 * sigma_mm, fmt="o", color="#0072B2", capsize=3)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="board behind the focal plane (mm)", ylabel="mid plane, measured - true (µm)")
    return figure
