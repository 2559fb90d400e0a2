"""The one style of all figures: colours that the colour-blind tell apart, sizes, and names with their units.

A function that draws is decorated with `styled` and begins with `new_figure`; settings of matplotlib are the caller's
again once it returns. matplotlib is imported inside: it is an optional extra, and slow to load.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial, wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Floats

# For signatures: what draws has them from here, and nothing is loaded before something is drawn.
if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    Axes = Figure = Any

P = ParamSpec("P")
R = TypeVar("R")

COMPONENT_NAMES = ("u", "v", "w")
AXIS_NAMES = ("x", "y", "z")

# M. Okabe and K. Ito, "Color Universal Design" (2008); their yellow is too pale for lines on white.
BLACK, ORANGE, SKY_BLUE, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
COLOURS = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY_BLUE, BLACK)
# As many as colours, so that curves are told apart in print too.
MARKERS = ("o", "s", "^", "D", "v", "P", "x")
GREY = "0.6"

SEQUENTIAL = "viridis"
# For what has a sign; its scale is symmetric about zero (`symmetric_limit`).
DIVERGING = "RdBu_r"

SETTINGS: dict[str, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "legend.framealpha": 0.85,
    "figure.titlesize": 11.0,
    "image.cmap": SEQUENTIAL,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.0,
    "savefig.facecolor": "white",
}


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Let a function draw in the style, whatever settings of matplotlib the caller has."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> R:
        from cycler import cycler
        from matplotlib import rc_context, rcParamsDefault

        style = dict(rcParamsDefault) | SETTINGS | {"axes.prop_cycle": cycler(color=COLOURS)}
        for name in ("backend", "backend_fallback", "interactive"):
            style.pop(name, None)
        with rc_context(style):
            return draw(*args, **kwargs)

    return drawn


def caption_of(draw: Callable[..., Any]) -> str:
    """Return what a figure shows, as the function that draws it says in its first paragraph."""
    said = inspect.getdoc(draw.func if isinstance(draw, partial) else draw) or ""
    return " ".join(said.split("\n\n")[0].split())


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, whose parts keep clear of each other; for what is `styled`."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def new_panels(width: float, height: float, rows: int = 1, columns: int = 1, **how: Any) -> tuple[Figure, Any]:
    """Return an empty figure as `new_figure` does, and its axes, one or an array; `how` as `subplots` has it."""
    figure = new_figure(width, height)
    return figure, figure.subplots(rows, columns, **how)


def symmetric_limit(*values: ArrayLike) -> float:
    """Return the largest finite size among values, at which a scale about zero ends; 1 where there is none."""
    finite = [np.abs(array[np.isfinite(array)]) for array in map(np.asarray, values)]
    largest = max((float(sizes.max()) for sizes in finite if sizes.size), default=0.0)
    return largest if largest > 0.0 else 1.0


# Of a bar beside a panel, in widths of that; in heights where it is so many times as high as wide.
BAR_GAP, BAR_WIDTH, NARROW = 0.05, 0.05, 2.0


def colour_bar(figure: Figure, drawn: Any, panel: Axes, label: str, **how: Any) -> Any:
    """Draw the bar of colours of what is `drawn` beside a panel, as high as that is; `how` as `colorbar` has it."""
    (left, right), (low, high) = panel.get_xlim(), panel.get_ylim()
    height = abs(high - low) / abs(right - left)
    tall = height if panel.get_aspect() == 1.0 and height > NARROW else 1.0
    place = panel.inset_axes((1.0 + BAR_GAP * tall, 0.0, BAR_WIDTH * tall, 1.0))
    return figure.colorbar(drawn, cax=place, label=label, **how)


def scale_of(*values: ArrayLike) -> dict[str, Any]:
    """Return the colours of values: about zero where they have both signs, else from the least to the largest."""
    known = np.concatenate([array[np.isfinite(array)] for array in map(np.asarray, values)])
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    if low < 0.0 < high:
        limit = symmetric_limit(known)
        return {"cmap": DIVERGING, "vmin": -limit, "vmax": limit}
    return {"cmap": SEQUENTIAL, "vmin": low, "vmax": high if high > low else low + 1.0}


SLABS = 20
# A median of fewer points says little.
FEWEST_POINTS = 3
DEPTH_LABEL = "z (mm)"


def slab_edges(z_mm: Floats) -> Floats:
    """Return the faces of slabs (SLABS + 1,) between the first and the last point; of unit thickness without any."""
    if not z_mm.size or np.ptp(z_mm) == 0.0:
        middle = float(z_mm[0]) if z_mm.size else 0.0
        return np.linspace(middle - 0.5, middle + 0.5, SLABS + 1)
    return np.linspace(float(z_mm.min()), float(z_mm.max()), SLABS + 1)


def percentiles_by_depth(z_mm: Floats, values: Floats, percent: float) -> tuple[Floats, Floats]:
    """Return the middles of slabs, and a percentile (100 for the largest) of the known values in each, else NaN."""
    edges = slab_edges(z_mm)
    slab = np.clip(np.searchsorted(edges, z_mm, side="right") - 1, 0, SLABS - 1)
    found = np.full(SLABS, np.nan)
    for k in range(SLABS):
        inside = values[(slab == k) & np.isfinite(values)]
        if inside.size >= FEWEST_POINTS:
            found[k] = np.percentile(inside, percent)
    return 0.5 * (edges[:-1] + edges[1:]), found


def draw_medians(axes: Axes, z_mm: Floats, quantities: dict[str, Floats], label: str) -> None:
    """Draw medians by depth, a curve for each quantity, on a logarithmic scale."""
    for (name, values), colour, marker in zip(quantities.items(), COLOURS, MARKERS, strict=False):
        axes.plot(*percentiles_by_depth(z_mm, values, 50.0), f"{marker}-", color=colour, label=name)
    axes.set(xlabel=DEPTH_LABEL, ylabel=label)
    axes.set_yscale("log")
    if len(quantities) > 1:
        axes.legend()
