"""Pictures of reconstructed boards by several methods side by side, after the paper's Figs. 8 to 13.

Each function takes a mapping from a method's name, as it is to be read, to what was measured by it; all methods are
drawn on one scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures.style import BLUE, GREEN, SEQUENTIAL, VERMILION, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours that people with any kind of colour vision tell apart; marks and lines differ as well, for print in grey.
STYLES: tuple[dict[str, Any], ...] = (
    {"color": VERMILION, "marker": "s", "linestyle": "--"},
    {"color": BLUE, "marker": "o", "linestyle": "-"},
    {"color": GREEN, "marker": "^", "linestyle": "-."},
)
BAND = {"color": "#BBBBBB", "alpha": 0.5, "linewidth": 0.0}
# Of a board in three dimensions voxels are shown that are brighter than this share of the brightest: 1/e, as for e_z.
SHOWN_SHARE = float(1.0 / np.e)
# A board is shown in this many times the depth that its dots reach.
SHOWN_DEPTHS = 2.0
# Numbers kept of pictures: as many as a printed page shows.
DECIMALS = 3


@dataclass(frozen=True, eq=False)
class BoardView:
    """A reconstructed board as seen from the front and from the side, its brightest voxel 1, and its bright voxels.

    Attributes
    ----------
    front : (y, x), the maximum along z
    side : (z, x), the maximum along y
    bounds_mm : (3, 2), of the volume along x, y and z
    bright_mm : (n, 3), where voxels are brighter than `SHOWN_SHARE`
    """

    front: NDArray[np.float64]
    side: NDArray[np.float64]
    bounds_mm: NDArray[np.float64]
    bright_mm: NDArray[np.float64]

    @classmethod
    def of(cls, volume: NDArray[np.float32], grid: Grid) -> BoardView:
        """Return the view of a volume [z, y, x]."""
        shares = volume / volume.max()
        inside = np.argwhere(shares > SHOWN_SHARE)
        x, y, z = (grid.axis_mm(axis)[inside[:, 2 - axis]] for axis in range(3))
        bounds = np.array([grid.bounds_mm(axis) for axis in range(3)])
        return cls(shares.max(axis=0), shares.max(axis=1), bounds, np.stack([x, y, z], axis=1))

    def to_plain(self) -> dict[str, Any]:
        """Return the view as lists of numbers."""
        arrays = {field.name: np.asarray(getattr(self, field.name), np.float64) for field in fields(self)}
        return {name: np.round(each, DECIMALS).tolist() for name, each in arrays.items()}

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> BoardView:
        """Return the view that lists of numbers hold."""
        return cls(**{name: np.array(each, np.float64) for name, each in values.items()})


@styled
def views_figure(views: Mapping[str, BoardView]) -> Figure:
    """Return boards in the focal plane, a row for each method: front, side and in three dimensions (Fig. 8)."""
    figure = new_figure(11.0, 3.7 * len(views))
    drawn = None
    # as much of the depth for each as shows the longest dots and their surroundings
    reach = SHOWN_DEPTHS * max(float(np.abs(view.bright_mm[:, 2]).max()) for view in views.values())
    for row, (label, view) in enumerate(views.items()):
        x, y, z = ((low, high) for low, high in view.bounds_mm)
        front, side = (figure.add_subplot(len(views), 3, 3 * row + column) for column in (1, 2))
        drawn = front.imshow(view.front, origin="lower", extent=(*x, *y), cmap=SEQUENTIAL, vmin=0.0, vmax=1.0)
        front.set(title=f"{label}: maximum along z", xlabel="x (mm)", ylabel="y (mm)")
        side.imshow(view.side, origin="lower", extent=(*x, *z), cmap=SEQUENTIAL, vmin=0.0, vmax=1.0, aspect="auto")
        side.set(title=f"{label}: maximum along y", xlabel="x (mm)", ylabel="z (mm)", ylim=(-reach, reach))
        space: Any = figure.add_subplot(len(views), 3, 3 * row + 3, projection="3d")
        space.scatter(
            *view.bright_mm.T, c=view.bright_mm[:, 2], cmap=SEQUENTIAL, s=1.5, linewidths=0.0, rasterized=True
        )
        space.set(title=f"{label}: brighter than 1/e", xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
        space.set(zlim=(-reach, reach))
        space.set_box_aspect((1.0, 1.0, 1.2), zoom=0.85)
        _tidy(space)
    if drawn is not None:
        figure.colorbar(drawn, ax=figure.axes, shrink=0.5, label="intensity / largest", location="bottom")
    return figure


@styled
def elongation_figure(
    methods: Mapping[str, Mapping[str, Any]], paper_mm: tuple[float, float], paper_sigma_mm: float
) -> Figure:
    """Return the elongation of dots and its spread by depth (Figs. 9 and 12).

    Parameters
    ----------
    methods : what `board_figures` returns
    paper_mm : lowest and highest elongation that the paper has
    paper_sigma_mm : what its spread stays below
    """
    figure = new_figure(10.0, 3.8)
    length, spread = figure.subplots(1, 2)
    length.axhspan(*paper_mm, label=f"paper: {paper_mm[0]:g} to {paper_mm[1]:g} mm", **BAND)
    spread.axhspan(0.0, paper_sigma_mm, label=f"paper: below {paper_sigma_mm:g} mm", **BAND)
    for (label, figures), style in zip(methods.items(), STYLES, strict=False):
        table = figures["by_depth"]
        length.plot(table["depth_mm"], table["elongation_mm"], label=label, **style)
        spread.plot(table["depth_mm"], table["elongation_sigma_mm"], label=label, **style)
    length.set(title="mean over the dots", ylabel="elongation $e_z$ (mm)", ylim=(0.0, None))
    spread.set(title="standard deviation over the dots", ylabel=r"$\sigma$ (mm)", ylim=(0.0, None))
    _finish(length, spread)
    for panel in (length, spread):
        panel.legend(fontsize=8)
    return figure


@styled
def location_figure(
    methods: Mapping[str, Mapping[str, Any]], spacing_mm: float, paper_steps_mm: tuple[float, float] | None
) -> Figure:
    """Return lateral and depth separations and their errors by depth (Figs. 11 and 13).

    Parameters
    ----------
    methods : what `board_figures` returns
    spacing_mm : x_g of Eq. 19
    paper_steps_mm : shortest and longest depth separation that the paper has, where it says
    """
    figure = new_figure(10.0, 6.6)
    (lateral, depth), (lateral_error, depth_error) = figure.subplots(2, 2)
    lateral.axhline(spacing_mm, color="black", linewidth=0.8, label="true")
    depth.axhline(1.0, color="black", linewidth=0.8, label="true")
    if paper_steps_mm is not None:
        depth.axhspan(*paper_steps_mm, label="paper: separations of {:g} to {:g} mm".format(*paper_steps_mm), **BAND)
    for (label, figures), style in zip(methods.items(), STYLES, strict=False):
        table = figures["by_depth"]
        at, spacing = np.array(table["depth_mm"]), np.array(table["spacing_mm"])
        middle, steps = 0.5 * (at[1:] + at[:-1]), np.diff(table["centre_mm"]) / np.diff(at)
        lateral.plot(at, spacing, label=label, **style)
        depth.plot(middle, steps, label=label, **style)
        lateral_error.plot(at, 100.0 * np.abs(spacing - spacing_mm) / spacing_mm, label=label, **style)
        depth_error.plot(middle, 100.0 * np.abs(steps - 1.0), label=label, **style)
    # a spacing that is right within a hundredth of a per cent is to look so
    reach = max(0.01 * spacing_mm, 1.2 * float(np.abs(np.subtract(lateral.get_ylim(), spacing_mm)).max()))
    lateral.set(title="lateral spacing", ylabel="mm", ylim=(spacing_mm - reach, spacing_mm + reach))
    depth.set(title="separation of neighbouring boards in depth", ylabel="measured / true")
    lateral_error.set(title=r"lateral error $\delta_x$", ylabel="%", ylim=(0.0, None))
    depth_error.set(title=r"depth error $\delta_z$", ylabel="%", ylim=(0.0, None))
    _finish(lateral, depth, lateral_error, depth_error)
    # below the panels: in them it would hide the largest errors
    figure.legend(*depth.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


@styled
def centres_figure(centres_mm: Mapping[str, NDArray[np.float64]]) -> Figure:
    """Return the centres of all dots of all boards, (n, 3) for each method, coloured by depth (Fig. 10)."""
    figure = new_figure(5.2 * len(centres_mm) + 0.8, 4.2)
    deepest = max(float(np.abs(each[:, 2]).max()) for each in centres_mm.values())
    drawn = None
    for number, (label, each) in enumerate(centres_mm.items(), start=1):
        space: Any = figure.add_subplot(1, len(centres_mm), number, projection="3d")
        # depth along the page, as the boards were moved
        drawn = space.scatter(
            each[:, 2], each[:, 0], each[:, 1], c=each[:, 2], cmap=SEQUENTIAL, vmin=-deepest, vmax=deepest, s=6.0
        )
        space.set(title=label, xlabel="z (mm)", ylabel="x (mm)", zlabel="y (mm)")
        space.set_box_aspect((2.0, 1.0, 1.0), zoom=1.1)
        _tidy(space)
    if drawn is not None:
        figure.colorbar(drawn, ax=figure.axes, shrink=0.6, label="measured depth z (mm)", location="bottom")
    return figure


def _finish(*panels: Axes) -> None:
    for panel in panels:
        panel.set_xlabel("z (mm)")
        panel.grid(alpha=0.3)


def _tidy(space: Any) -> None:
    """Keep the numbers of a three-dimensional drawing readable."""
    space.tick_params(labelsize=7, pad=0)
    space.locator_params(nbins=5)
