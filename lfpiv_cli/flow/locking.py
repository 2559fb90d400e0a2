"""Locking: near the focal plane volumes draw lateral displacements towards whole microlenses.

A tracer in focus lights one microlens, wherever in it the tracer is; only from about `Scale.depth_mm` on is its light
shared by several, whose shares tell where it is. In between, a displacement of a fraction f of a microlens is measured
with an error of about -amplitude sin(2 pi f), the same in all windows at that depth, so that no scatter shows it. It is
stated as an uncertainty. Particles, which are fitted to the pixels behind each lens, do not lock.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.reference import Reference
from lfpiv_cli.scale import Scale

# Root mean square of the error in the focal plane over all fractions of a microlens, in microlenses.
LOCKING_LENSES = 0.1


def locking_mm(from_focal_plane_mm: NDArray[np.float64], scale: Scale) -> NDArray[np.float64]:
    """Return the root mean square of the error by locking at depths from the focal plane, mm, over all fractions."""
    return LOCKING_LENSES * scale.lens_mm * np.exp(-0.5 * (from_focal_plane_mm / scale.depth_mm) ** 2)


def with_locking(field: VectorField, reference: Reference, scale: Scale) -> VectorField:
    """Return vectors from volumes with locking in the uncertainty of their lateral components."""
    if field.uncertainty_voxel is None:
        return field
    z_mm = np.array([reference.depth_to_focal_point(z) for z in field.grid.axis_mm(2)])
    error_mm = np.zeros((len(z_mm), 1, 1, 3))
    error_mm[..., :2] = locking_mm(z_mm, scale)[:, np.newaxis, np.newaxis, np.newaxis]
    return replace(field, uncertainty_voxel=np.hypot(field.uncertainty_voxel, error_mm / field.voxel_mm))
