"""The one style of all figures: colours that the colour-blind tell apart, sizes, and names with their units.

A function that draws is decorated with `styled` and begins with `new_figure`; settings of matplotlib are the caller's
again once it returns. matplotlib is imported inside: it is an optional extra, and slow to load.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")

COMPONENT_NAMES = ("u", "v", "w")
AXIS_NAMES = ("x", "y", "z")

# M. Okabe and K. Ito, "Color Universal Design" (2008); their yellow is too pale for lines on white.
BLACK, ORANGE, SKY_BLUE, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
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


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, whose parts keep clear of each other; for what is `styled`."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def symmetric_limit(*values: ArrayLike) -> float:
    """Return the largest finite size among values, at which a scale about zero ends; 1 where there is none."""
    finite = [np.abs(array[np.isfinite(array)]) for array in map(np.asarray, values)]
    largest = max((float(sizes.max()) for sizes in finite if sizes.size), default=0.0)
    return largest if largest > 0.0 else 1.0
