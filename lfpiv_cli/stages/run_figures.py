"""What `run` tells of the vectors of each method, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lfpiv_cli.files.atomic import without_nan
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.flow.field import REJECTED, VALID
from lfpiv_cli.interface.vectors_checks import quality_of, quality_of_all

# A range of displacements leaves out so many percent at either end, where a few are false.
LEFT_OUT_PERCENT = 5.0


def figures_of(fields: Mapping[str, Sequence[Path]]) -> dict[str, dict[str, float | int | None]]:
    """Return how many vectors each method gives, how good they are and what they range over: figures by method."""
    by_method = {method: _figures_of(paths) for method, paths in fields.items() if paths}
    names = next(iter(by_method.values()), {})
    return {name: {method: figures[name] for method, figures in by_method.items()} for name in names}


def _figures_of(paths: Sequence[Path]) -> dict[str, float | int | None]:
    """Return the figures of a method's fields, which are read one after the other."""
    qualities, displacements, valid = [], [], 0
    for path in paths:
        field = open_vectors(path)
        qualities.append(quality_of(field))
        displacements.append(field.displacement_voxel[field.flag < REJECTED])
        valid += int(np.count_nonzero(field.flag == VALID))
    quality, moved = quality_of_all(qualities), np.concatenate(displacements)
    ends = LEFT_OUT_PERCENT, 100.0 - LEFT_OUT_PERCENT
    low, high = np.percentile(moved, ends, axis=0) if len(moved) else np.full((2, 3), np.nan)
    sigma = np.median(quality.sigma, axis=0) if len(quality.sigma) else np.full(3, np.nan)
    told: dict[str, float | int | None] = {"vectors": quality.vectors, "valid": valid}
    for k, name in enumerate("uvw"):
        told |= {
            f"{name}_from_voxel": without_nan(low[k]),
            f"{name}_to_voxel": without_nan(high[k]),
            f"{name}_sigma_voxel": without_nan(sigma[k]),
        }
    return told
