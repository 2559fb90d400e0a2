"""Figures of tracks: of two frames, or trajectories of a sequence.

Axes: points and velocities (n, 3) in mm and m/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.pictures.depths import draw_medians
from lfpiv_cli.pictures.style import BLUE, COLOURS, COMPONENT_NAMES, SEQUENTIAL, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# More lines than this are a solid block.
MOST_LINES = 1500
HISTOGRAM_BARS, PROBABILITY_BARS = 40, 25
# Of displacements: the longest drawn is this share of the whole extent, so that all are seen.
LONGEST_SHARE = 0.12


def displacement_lines(
    position_mm: NDArray[np.float64], displacement_mm: NDArray[np.float64]
) -> tuple[list[NDArray[np.float64]], float]:
    """Return lines (2, 3) of displacements about their middles, and how many times longer than true they are.

    At most MOST_LINES, evenly chosen from the list.
    """
    extent = float(np.ptp(position_mm, axis=0).max()) if len(position_mm) else 0.0
    longest = float(np.linalg.norm(displacement_mm, axis=1).max()) if len(position_mm) else 0.0
    stretch = max(1.0, LONGEST_SHARE * extent / longest) if longest > 0.0 else 1.0
    half = 0.5 * stretch * displacement_mm
    return list(np.stack([position_mm - half, position_mm + half], axis=1)), stretch


def trajectory_lines(position_mm: NDArray[np.float64], track: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """Return the places (m, 3) of each track in time; rows are ordered by track, then by frame."""
    return np.split(position_mm, np.flatnonzero(np.diff(track)) + 1) if len(track) else []


@styled
def space_figure(lines: list[NDArray[np.float64]], speed_m_s: NDArray[np.float64], what: str) -> Figure:
    """Return lines in space coloured by their speed, the depth to the right; many are thinned out evenly.

    Parameters
    ----------
    lines : (m, 3) each, mm
    speed_m_s : of each line
    what : for the title
    """
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    every = max(1, -(-len(lines) // MOST_LINES))
    chosen, speeds = lines[::every], speed_m_s[::every]
    figure = new_figure(8.5, 6.5)
    axes = figure.add_subplot(projection="3d")
    # (z, x, y): the light comes from the right, y points up
    drawn = Line3DCollection([line[:, [2, 0, 1]] for line in chosen], cmap=SEQUENTIAL, linewidths=1.0)
    drawn.set_array(speeds)
    drawn.set_clim(0.0, float(speeds.max()) if len(speeds) else 1.0)
    axes.add_collection3d(drawn, autolim=False)
    points = np.concatenate(lines) if lines else np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    high = np.where(high > low, high, low + 1.0)
    axes.set(
        xlim=(low[2], high[2]),
        ylim=(low[0], high[0]),
        zlim=(low[1], high[1]),
        xlabel="z (mm)",
        ylabel="x (mm)",
        zlabel="y (mm)",
    )
    axes.set_box_aspect((high - low)[[2, 0, 1]])
    figure.colorbar(drawn, ax=axes, label="speed (m/s)", shrink=0.7)
    axes.set_title(what if every == 1 else f"{what}; one in {every} drawn")
    return figure


@styled
def velocities_figure(velocity_m_s: NDArray[np.float64]) -> Figure:
    """Return histograms of the velocity components."""
    figure = new_figure(10.0, 3.2)
    for component, axes in enumerate(figure.subplots(1, 3)):
        axes.hist(velocity_m_s[:, component], bins=HISTOGRAM_BARS, color=COLOURS[component])
        axes.set(xlabel=f"{COMPONENT_NAMES[component]} (m/s)", ylabel="tracks")
    return figure


@styled
def links_figure(link_probability: NDArray[np.float64]) -> Figure:
    """Return how probable the links are, of those whose probability is known."""
    known = link_probability[np.isfinite(link_probability)]
    figure = new_figure(6.0, 3.6)
    axes = figure.subplots()
    axes.hist(known, bins=PROBABILITY_BARS, range=(0.0, 1.0), color=BLUE)
    axes.set_yscale("log")
    wrong = float(np.sum(1.0 - known))
    axes.set(
        xlabel="probability that a link is right",
        ylabel="links",
        title=f"{known.size} links, {wrong:.1f} wrong ones expected",
        xlim=(0.0, 1.0),
    )
    return figure


@styled
def sigma_figure(z_mm: NDArray[np.float64], sigma_m_s: NDArray[np.float64]) -> Figure:
    """Return the stated standard deviations of the velocity's components by depth (medians)."""
    figure = new_figure(6.0, 3.6)
    along = {f"σ of {name}": sigma_m_s[:, k] for k, name in enumerate(COMPONENT_NAMES)}
    draw_medians(figure.subplots(), z_mm, along, "standard deviation (m/s), median")
    return figure


@styled
def lengths_figure(track: NDArray[np.int64]) -> Figure:
    """Return how many frames the trajectories span."""
    lengths = np.unique(track, return_counts=True)[1]
    figure = new_figure(6.0, 3.6)
    axes = figure.subplots()
    most = int(lengths.max()) if lengths.size else 1
    axes.hist(lengths, bins=(np.arange(most + 1) + 0.5).tolist(), color=BLUE, rwidth=0.9)
    axes.set(xlabel="frames in a trajectory", ylabel="trajectories", title=f"{lengths.size} trajectories")
    return figure
