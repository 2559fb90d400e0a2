"""The paper's channel flow: its six slices (Figs. 15 and 16) and their errors beside its own (Table 4).

The paper's slices lie across the depth, z/D counted from the camera's side of the duct, and across the lateral axis,
x/D. Its flow runs along its y; ours along x or y, so that its x is our other lateral axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.validation.flow import compare, streamwise_mean_error_at

# Places and mean velocity errors in per cent: DLFC's, ERT's.
PAPER_SLICES = {
    "z/D": {0.3: (4.35, 3.51), 0.54: (4.46, 1.42), 0.78: (0.13, 0.73)},
    "x/D": {0.24: (7.28, 10.43), 0.48: (2.06, 4.00), 0.72: (12.01, 12.37)},
}
PAPER_OVERALL = (6.25, 6.77)
# The paper's duct: its width, and its mean velocity, which its 40 L/h through 1 cm2 meet to 3 %.
PAPER_WIDTH_MM, PAPER_MEAN_VELOCITY_M_S, VELOCITY_TOLERANCE = 10.0, 0.1082, 0.03


@dataclass(frozen=True)
class Duct:
    """A square duct: its width, its centre in the vectors' coordinates, the axis that the flow follows, its mean."""

    width_mm: float
    centre_mm: tuple[float, float, float]
    axis: Literal["x", "y"]
    mean_velocity_m_s: float

    @property
    def is_the_papers(self) -> bool:
        """Whether the paper's figures are of this duct."""
        return math.isclose(self.width_mm, PAPER_WIDTH_MM) and math.isclose(
            abs(self.mean_velocity_m_s), PAPER_MEAN_VELOCITY_M_S, rel_tol=VELOCITY_TOLERANCE
        )

    @property
    def across(self) -> dict[str, int]:
        """The axes (0 for x) of the paper's slices by their names in Table 4."""
        return {"z/D": 2, "x/D": 1 if self.axis == "x" else 0}

    def position_mm(self, axis: int, share: float) -> float:
        """Return where a slice lies along an axis, given as a share of the width."""
        return self.centre_mm[axis] + (share - 0.5) * self.width_mm


def table_4(
    field: VectorField, truth_velocity: NDArray[np.float64], inside: NDArray[np.bool_], duct: Duct
) -> dict[str, Any]:
    """Return the sizes of the mean velocity errors in per cent, of the six slices and of the whole, beside the paper's.

    By the slice (`overall`, `z/D 0.3` ...): `ours`, `paper_dlfc` and `paper_ert`. A slice between planes of windows is
    interpolated; ours is None where it has none.
    """
    pairs = compare(field, truth_velocity, inside)
    found = pairs.measured[pairs.found].sum(axis=0), pairs.true[pairs.found].sum(axis=0)
    overall = None
    if pairs.direction is not None and pairs.found.any():
        overall = float(found[0] @ pairs.direction / (found[1] @ pairs.direction) - 1.0)
    table = {"overall": _row(overall, *PAPER_OVERALL)}
    for name, axis in duct.across.items():
        for share, paper in PAPER_SLICES[name].items():
            error = streamwise_mean_error_at(field, pairs, axis, duct.position_mm(axis, share))
            table[f"{name} {share}"] = _row(error, *paper)
    return table


def worst_slice(table: Mapping[str, Mapping[str, float | None]]) -> float | None:
    """Return the largest mean velocity error of the six slices (a share, not per cent); None where one is unknown."""
    errors = [row["ours_percent"] for name, row in table.items() if name != "overall"]
    return None if None in errors else 0.01 * max(error for error in errors if error is not None)


def _row(error: float | None, paper_dlfc: float, paper_ert: float) -> dict[str, float | None]:
    ours = None if error is None else 100.0 * abs(error)
    return {"ours_percent": ours, "paper_dlfc_percent": paper_dlfc, "paper_ert_percent": paper_ert}
