"""A view of tracks or vectors in three dimensions that a reader of a page can turn: HTML that loads nothing.

Axes: lines are places (k, 3) in mm along x, y, z; z is the depth. plotly is imported inside: it is an optional extra,
and slow to load; its JavaScript, 4.5 MB, goes into the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

# More lines make a page slow to turn.
MOST_LINES = 4000
HEIGHT_PX = 640


def has_views() -> bool:
    """Return whether views can be made: plotly is installed."""
    return find_spec("plotly") is not None


def lines_view(lines: Sequence[NDArray[np.float64]], values: Sequence[NDArray[np.float64]], label: str) -> str:
    """Return a view of lines, a dot at the end of each.

    Parameters
    ----------
    lines : places (k, 3) of each; of more than `MOST_LINES`, some from all over the list are shown
    values : (k,) what each place is coloured by
    label : of the colours, with their unit
    """
    from plotly.graph_objects import Figure, Scatter3d

    shown = np.linspace(0, len(lines) - 1, min(MOST_LINES, len(lines))).astype(int).tolist()
    gap, nothing = np.full((1, 3), np.nan), np.full(1, np.nan)
    path = np.concatenate([np.zeros((0, 3)), *(part for k in shown for part in (lines[k], gap))]).astype(np.float32)
    value = np.concatenate([np.zeros(0), *(part for k in shown for part in (values[k], nothing))])
    ends = np.array([lines[k][-1] for k in shown], dtype=np.float32).reshape(-1, 3)
    last = np.array([values[k][-1] for k in shown])
    known = value[np.isfinite(value)]
    low, high = float(known.min(initial=0.0)), float(known.max(initial=np.finfo(np.float32).tiny))
    colours = {"colorscale": "Viridis", "cmin": low, "cmax": high}
    # A line has no colour between two places where one is NaN: there the next one's is not seen.
    along = {**colours, "color": np.nan_to_num(value), "width": 3}
    dots = {**colours, "color": last, "size": 2, "colorbar": {"title": label}}
    figure = Figure(
        [
            Scatter3d(x=path[:, 0], y=path[:, 1], z=path[:, 2], mode="lines", line=along, hoverinfo="skip"),
            Scatter3d(x=ends[:, 0], y=ends[:, 1], z=ends[:, 2], mode="markers", marker=dots, customdata=last).update(
                hovertemplate="x %{x:.2f}, y %{y:.2f}, z %{z:.2f} mm<br>%{customdata:.4g}<extra></extra>"
            ),
        ]
    )
    axes = {f"{axis}axis": {"title": f"{axis} (mm)"} for axis in "xyz"}
    figure.update_layout(
        scene={**axes, "aspectmode": "data"},
        height=HEIGHT_PX,
        showlegend=False,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
    )
    return str(figure.to_html(full_html=False, include_plotlyjs=True, div_id="view", config={"displaylogo": False}))
