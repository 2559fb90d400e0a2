"""Pictures of errors over what makes them, with the straight lines through them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.pictures.style import BLUE, GREEN, ORANGE, PURPLE, VERMILION, new_figure, styled
from lfpiv_cli.validation.place_errors import Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours that colour-blind people tell apart, and marks that a print in grey keeps apart.
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
MARKS, DASHES = ("o", "s", "^", "D", "v"), ("-", "--", "-.", ":", (0, (5, 1, 1, 1)))

# Names of so many curves find room among them.
ROOM = 3


@dataclass(frozen=True)
class Series:
    """A curve of a panel.

    Attributes
    ----------
    figure : name of what is drawn, `factor` turns it into the panel's unit
    fitted : its straight line is drawn, in this power of the influence
    """

    figure: str
    label: str
    factor: float = 1.0
    fitted: bool = False
    power: float = 1.0


@dataclass(frozen=True)
class Panel:
    """A panel of a picture; its axis shows errors of `at_least` this size, so that noise alone does not fill it."""

    label: str
    series: tuple[Series, ...]
    logarithmic: bool = False
    at_least: float = 0.0


@dataclass(frozen=True, eq=False)
class Curves:
    """What was measured: values (n,) of the influence, and figures (n, realisations) by name."""

    values: NDArray[np.float64]
    figures: Mapping[str, NDArray[np.float64]]

    def median(self, name: str) -> NDArray[np.float64]:
        """Return the median (n,) over the realisations of a figure; NaN where none has it."""
        table = self.figures[name]
        known = np.isfinite(table).any(axis=1)
        result = np.full(len(table), np.nan)
        result[known] = np.nanmedian(table[known], axis=1)
        return result


@styled
def influence_figure(
    curves: Curves,
    panels: tuple[Panel, Panel],
    label: str,
    lines: Mapping[str, Line],
    notes: tuple[str, ...],
    logarithmic: bool = False,
) -> Figure:
    """Return a picture of two panels.

    Parameters
    ----------
    lines : through the figures that have one
    notes : what is written into the first and the second panel; empty: nothing
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = new_figure(9.0, 3.8)
    for axes, panel, note in zip(figure.subplots(1, 2), panels, notes, strict=True):
        for number, series in enumerate(panel.series):
            _draw(axes, curves, series, number, lines.get(series.figure))
        axes.set_xlabel(label, fontsize=9)
        axes.set_ylabel(panel.label, fontsize=9)
        axes.tick_params(labelsize=8)
        if panel.logarithmic:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
        if panel.at_least:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, -panel.at_least), max(high, panel.at_least))
        if logarithmic:
            axes.set_xscale("log")
            axes.set_xticks(curves.values, [f"{value:g}" for value in curves.values])
            axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.set_title(note, fontsize=8, loc="left")
        if len(panel.series) > ROOM:
            axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
        else:
            axes.legend(fontsize=8)
    return figure


def _draw(axes: Axes, curves: Curves, series: Series, number: int, line: Line | None) -> None:
    """Draw a series: medians, the range over realisations, and its straight line or the points joined."""
    colour, mark, dash = COLOURS[number], MARKS[number], DASHES[number]
    middle, table = series.factor * curves.median(series.figure), series.factor * curves.figures[series.figure]
    is_line = series.fitted and line is not None and np.isfinite(line.slope)
    axes.plot(curves.values, middle, mark, color=colour, ls="" if is_line else dash, ms=5, label=series.label)
    if table.shape[1] > 1:
        axes.vlines(curves.values, table.min(axis=1), table.max(axis=1), color=colour, lw=1.5)
    if is_line and line is not None:
        known = curves.values[np.isfinite(middle)]
        x = np.linspace(known.min(), known.max(), 50)
        axes.plot(x, series.factor * (line.offset + line.slope * x**series.power), ls=dash, color=colour, lw=1.2)
