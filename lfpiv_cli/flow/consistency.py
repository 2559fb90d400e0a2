"""What a flow says against its own vectors, no truth known: its divergence, and another measurement of it.

A liquid has no divergence, so that what is found comes from errors, and from what windows cannot resolve. Beside the
divergence that the stated standard deviations make, a ratio of 1 confirms them; a large one says that they are too
small. Two measurements of one flow by different ways differ likewise by what their standard deviations let expect.

Axes: arrays `[z, y, x]`, components last.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import REJECTED, VectorField
from lfpiv_cli.robust import HALF_NORMAL_MEDIAN

# Fewer places than this tell no ratio.
FEWEST_PLACES = 20


def divergence_over_stated(field: VectorField) -> float | None:
    """Return how large the divergence is over the one that the stated standard deviations make; None: not known.

    By central differences, where all six vectors around a place are there: these are two apart, and windows that
    overlap by half share nothing there.
    """
    sigma = _sigma_mm(field)
    if sigma is None or min(field.grid.shape_xyz) < 3:
        return None
    moved = np.where((field.flag < REJECTED)[..., np.newaxis], field.displacement_voxel * field.voxel_mm, np.nan)
    inner = tuple(n - 2 for n in field.flag.shape)
    divergence, variance = np.zeros(inner), np.zeros(inner)
    for axis, spacing_mm in enumerate(field.grid.spacing_mm):
        divergence = divergence + _difference(moved[..., axis], axis, 1.0, -1.0) / (2.0 * spacing_mm)
        variance = variance + _difference(sigma[..., axis] ** 2, axis, 1.0, 1.0) / (2.0 * spacing_mm) ** 2
    return _ratio(divergence, np.sqrt(variance))


def difference_over_stated(one: VectorField, other: VectorField) -> list[float] | None:
    """Return how large the differences of two fields on one grid are over those expected, by component.

    None where the grids are not the same, or too few vectors are in both.
    """
    sigma_one, sigma_other = _sigma_mm(one), _sigma_mm(other)
    same = one.grid.shape_xyz == other.grid.shape_xyz and np.allclose(
        [one.grid.spacing_mm, one.grid.origin_mm], [other.grid.spacing_mm, other.grid.origin_mm]
    )
    if not same or sigma_one is None or sigma_other is None:
        return None
    both = (one.flag < REJECTED) & (other.flag < REJECTED)
    off = one.displacement_voxel * one.voxel_mm - other.displacement_voxel * other.voxel_mm
    ratios = [_ratio(off[both, k], np.hypot(sigma_one, sigma_other)[both, k]) for k in range(3)]
    known = [ratio for ratio in ratios if ratio is not None]
    return known if len(known) == len(ratios) else None


def _sigma_mm(field: VectorField) -> NDArray[np.float64] | None:
    return None if field.uncertainty_voxel is None else field.uncertainty_voxel * field.voxel_mm


def _difference(values: NDArray[np.float64], axis: int, after: float, before: float) -> NDArray[np.float64]:
    """Return after * values one further along x, y or z (0, 1, 2) + before * values one back, of the inner places."""
    inner = [slice(1, -1)] * 3
    ahead, back = list(inner), list(inner)
    ahead[2 - axis], back[2 - axis] = slice(2, None), slice(None, -2)
    return np.asarray(after * values[tuple(ahead)] + before * values[tuple(back)])


def _ratio(errors: NDArray[np.float64], sigma: NDArray[np.float64]) -> float | None:
    """Return the usual size of errors in stated standard deviations."""
    known = np.isfinite(errors) & np.isfinite(sigma) & (sigma > 0.0)
    if np.count_nonzero(known) < FEWEST_PLACES:
        return None
    return float(np.median(np.abs(errors[known]) / sigma[known]) / HALF_NORMAL_MEDIAN)
