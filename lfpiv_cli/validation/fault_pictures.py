"""Pictures of which figures give a mistake away."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from lfpiv_cli.pictures.style import new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Shown from a tenth of the limit to a thousand times it.
DECADES = (-1.0, 3.0)


@styled
def faults_figure(over: Mapping[str, Mapping[str, float]], words: Mapping[str, str]) -> Figure:
    """Return a table in colours of figures over their limits: a row for each measurement, a column for each figure."""
    names = list(words)
    table = np.array([[each[name] for name in names] for each in over.values()])
    shade = np.clip(np.log10(np.maximum(table, 10.0 ** DECADES[0])), *DECADES)
    figure = new_figure(10.0, 1.9 + 0.38 * len(table))
    axes = figure.subplots()
    image = axes.imshow(shade, cmap="cividis", vmin=DECADES[0], vmax=DECADES[1], aspect="auto")
    for (row, column), value in np.ndenumerate(table):
        missed = not value <= 1.0
        colour = "black" if shade[row, column] > 1.0 else "white"
        weight = "bold" if missed else "normal"
        axes.text(column, row, number(value), ha="center", va="center", fontsize=8, color=colour, fontweight=weight)
    axes.set_xticks(range(len(names)), [words[name] for name in names], rotation=40, ha="right", fontsize=8)
    axes.set_yticks(range(len(table)), list(over), fontsize=8)
    bar = figure.colorbar(image, ax=axes, ticks=range(int(DECADES[0]), int(DECADES[1]) + 1))
    bar.ax.set_yticklabels([f"{10.0**k:g}" for k in range(int(DECADES[0]), int(DECADES[1]) + 1)], fontsize=8)
    bar.set_label("error / limit (bold: missed)", fontsize=8)
    return figure


def number(value: float) -> str:
    """Return a ratio in few characters."""
    if value >= 1000.0:
        return f"{value:.0e}".replace("e+0", "e")
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}"
