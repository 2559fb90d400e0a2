"""Figures of a measured flow through a round pipe by the distance from its axis, and their picture.

Axes: those of the field; arrays `[z, y, x]`, velocities in m/s.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.masks import RoundWall
from lfpiv_cli.pictures.style import BLACK, COLOURS, COMPONENT_NAMES, GREY, MARKERS, new_figure, styled
from lfpiv_cli.validation.flow import TOLERANCE, compare, relative_errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Rings of nearly as many windows each, the outer ones thinner: beyond the last but one edge windows of a tenth of the
# diameter reach beyond the wall.
RING_EDGES = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0)
# Figures of the inner pipe leave out the last ring.
INNER = RING_EDGES[-2]


def pipe_figures(
    field: VectorField, truth_velocity: NDArray[np.float64], inside: NDArray[np.bool_], pipe: RoundWall
) -> dict[str, Any]:
    """Return the figures of windows by their distance from the axis, ready for JSON.

    Returns
    -------
    dict
        `within_25_percent_vector_inner`, the share of the windows up to 0.9 of the radius whose whole vector errs by
        less than a quarter; `rings`, for each two edges (shares of the radius) their `vectors`, `streamwise_mean_error`
        (sum v / sum u - 1) and `within_25_percent_vector`. None where there is no window.
    """
    pairs = compare(field, truth_velocity, inside)
    share = (pipe.distances_mm(field.grid.centres_mm()) / pipe.radius_mm)[inside]
    right = relative_errors(pairs)[1] < TOLERANCE
    inner = share <= INNER
    ring, rings = np.searchsorted(RING_EDGES[1:-1], share), []
    for number, edges in enumerate(zip(RING_EDGES, RING_EDGES[1:], strict=False)):
        chosen = ring == number
        found = chosen & pairs.found
        measured, true = (float(each[found, pipe.along].sum()) for each in (pairs.measured, pairs.true))
        rings.append(
            {
                "radius_shares": list(edges),
                "vectors": int(chosen.sum()),
                "streamwise_mean_error": measured / true - 1.0 if true else None,
                "within_25_percent_vector": _share(right[chosen]),
            }
        )
    return {"within_25_percent_vector_inner": _share(right[inner]), "rings": rings}


def _share(right: NDArray[np.bool_]) -> float | None:
    """Return how many of some are right, None of none."""
    return float(right.mean()) if right.size else None


@styled
def radius_figure(fields: Mapping[str, VectorField], pipe: RoundWall, mean_velocity_m_s: float) -> Figure:
    """Return each component of vectors over their distance from the axis, beside Poiseuille's parabola."""
    figure = new_figure(11.0, 4.0)
    radius = np.linspace(0.0, pipe.radius_mm, 101)
    for component, panel in enumerate(figure.subplots(1, 3)):
        for (name, field), colour, marker in zip(fields.items(), cycle(COLOURS), cycle(MARKERS), strict=False):
            distance = pipe.distances_mm(field.grid.centres_mm())
            seen = np.isfinite(field.velocity[..., component]) & (distance < pipe.radius_mm)
            panel.plot(
                distance[seen], field.velocity[seen][:, component], marker, color=colour, markersize=2.0, label=name
            )
        axial = 2.0 * mean_velocity_m_s * (1.0 - (radius / pipe.radius_mm) ** 2)
        panel.plot(radius, axial if component == pipe.along else 0.0 * radius, color=BLACK, label="true, analytic")
        panel.axvline(INNER * pipe.radius_mm, color=GREY, linewidth=0.8)
        panel.set(xlabel="distance from the axis (mm)", ylabel=f"{COMPONENT_NAMES[component]} (m/s)")
    figure.axes[0].legend()
    return figure
