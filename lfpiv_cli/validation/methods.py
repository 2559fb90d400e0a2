"""Several measurements of one flow side by side: their figures, and which of them errs less."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.masks import RoundWall
from lfpiv_cli.synthetic.flows import Flow
from lfpiv_cli.validation.channel import Duct, table_4, worst_slice
from lfpiv_cli.validation.flow import flow_figures
from lfpiv_cli.validation.pipe import pipe_figures

# Figures that are compared, by how their error follows from them.
ERROR_OF = {
    "size": ("streamwise_mean_error", "slice_mean_error", "rms_u_voxel", "rms_v_voxel", "rms_w_voxel"),
    "distance from one": (
        "within_25_percent_streamwise",
        "within_25_percent_vector",
        "within_25_percent_vector_inner",
        "slope_u",
        "slope_v",
        "slope_w",
    ),
}


@dataclass(frozen=True, eq=False)
class Measured:
    """A measured flow and what it is held against.

    Attributes
    ----------
    truth : (nz, ny, nx, 3) m/s at the window centres
    inside : (nz, ny, nx) True for the windows that are judged
    flow : the analytic flow that the truth is of, in the field's coordinates; None where it is of particles
    """

    field: VectorField
    truth: NDArray[np.float64]
    inside: NDArray[np.bool_]
    flow: Flow | None = None

    def figures(self, duct: Duct | None, pipe: RoundWall | None = None) -> dict[str, Any]:
        """Return the figures of `flow_figures`, with Table 4's for a duct, or those by radius for a pipe."""
        figures = flow_figures(self.field, self.truth, self.inside)
        if duct is not None:
            figures["table_4"] = table_4(self.field, self.truth, self.inside, duct)
            figures["slice_mean_error"] = worst_slice(figures["table_4"])
        if pipe is not None:
            figures |= pipe_figures(self.field, self.truth, self.inside, pipe)
        return figures


def lower_error(methods: Mapping[str, Measured], figures: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the method with the lower error: by figure, and (`whole_vector`) by the rms over windows all have found.

    Left out is a figure that a method does not know, or in which all err alike.
    """
    better = {"whole_vector": _lowest(_common_rms(methods))}
    for kind, names in ERROR_OF.items():
        for name in names:
            values = {method: found.get(name) for method, found in figures.items()}
            if kind != "size":
                values = {method: None if value is None else 1.0 - value for method, value in values.items()}
            better[name] = _lowest({method: None if value is None else abs(value) for method, value in values.items()})
    return {name: method for name, method in better.items() if method is not None}


def _common_rms(methods: Mapping[str, Measured]) -> dict[str, float | None]:
    """Return the rms of each method's error of the whole vector, m/s, over the windows that no method has missed."""
    found = np.all([m.inside & np.isfinite(m.field.velocity).all(axis=-1) for m in methods.values()], axis=0)
    if not found.any():
        return dict.fromkeys(methods)
    return {
        name: float(np.sqrt(np.mean(np.sum((m.field.velocity - m.truth)[found] ** 2, axis=-1))))
        for name, m in methods.items()
    }


def _lowest(errors: Mapping[str, float | None]) -> str | None:
    """Return whose error is the lowest, None where one is unknown or none is lower than the others."""
    known = {name: error for name, error in errors.items() if error is not None}
    if len(known) < len(errors) or len(set(known.values())) < 2:
        return None
    return min(known, key=lambda name: known[name])
