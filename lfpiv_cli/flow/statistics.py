"""Mean and fluctuations over the vector fields of a batch."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.flow.field import REJECTED, VALID, VectorField


@dataclass(frozen=True, eq=False)
class Statistics:
    """What the fields of a batch have in common and how far they stray from it.

    Attributes
    ----------
    mean : the mean displacements, over the fields in which a vector is neither rejected nor masked; its uncertainty is
        the standard error of the mean (NaN with fewer than two), its flag REJECTED where no field has a vector
    rms_voxel : (nz, ny, nx, 3) root of the mean square fluctuation about the mean, measurement noise included
    samples : (nz, ny, nx) in how many fields a vector was found
    """

    mean: VectorField
    rms_voxel: NDArray[np.float64]
    samples: NDArray[np.int64]


def statistics_of(fields: Iterable[VectorField]) -> Statistics:
    """Return the statistics of fields on one grid, read one by one.

    Raises
    ------
    InputError
        There are no fields, or one differs from the first in its grid, its time or its voxels.
    """
    first: VectorField | None = None
    for field in fields:
        if first is None:
            first, number = field, 0
            samples = np.zeros(field.flag.shape, dtype=np.int64)
            mean, spread = np.zeros((2, *field.displacement_voxel.shape))
            quality = np.zeros((3, *field.flag.shape))
        elif (field.grid, field.dt_s, field.voxel_mm) != (first.grid, first.dt_s, first.voxel_mm):
            raise InputError("the vector fields of a batch differ in grid, time or voxels, and have no mean")
        found = field.flag < REJECTED
        samples += found
        # Welford's sums: the squares of displacements themselves would drown small fluctuations in rounding.
        away = np.where(found[..., np.newaxis], field.displacement_voxel - mean, 0.0)
        mean += away / np.maximum(1, samples)[..., np.newaxis]
        spread += away * np.where(found[..., np.newaxis], field.displacement_voxel - mean, 0.0)
        quality += (field.correlation, field.peak_ratio, field.valid_fraction)
        number += 1
    if first is None:
        raise InputError("there are no vector fields to take a mean of")
    count = samples[..., np.newaxis].astype(np.float64)
    none = samples == 0
    mean[none] = np.nan
    rms = np.sqrt(np.divide(spread, count, out=np.full(mean.shape, np.nan), where=count > 0))
    error = np.divide(rms, np.sqrt(np.maximum(1.0, count - 1.0)), out=np.full(mean.shape, np.nan), where=count > 1)
    correlation, peak_ratio, valid_fraction = quality / number
    whole = replace(
        first,
        displacement_voxel=mean,
        displacement_raw_voxel=mean,
        correlation=correlation,
        peak_ratio=peak_ratio,
        valid_fraction=valid_fraction,
        flag=np.where(none, REJECTED, VALID).astype(np.uint8),
        uncertainty_voxel=error,
    )
    return Statistics(whole, rms, samples)
