"""Vector fields made of a flow and of noise of stated size."""

from __future__ import annotations

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.flow.field import VALID, VectorField
from lfpiv_cli.grid import Grid

SHAPE = (9, 10, 11)
SPACING_MM = (0.8, 0.6, 1.1)
VOXEL_MM = (0.1, 0.2, 0.3)
# By component: depth is known worst.
SIGMA_VOXEL = np.array([0.05, 0.02, 0.4])


def field_of(moved_mm: Floats, sigma_voxel: Floats | None) -> VectorField:
    ones = np.ones(SHAPE)
    sigma = None if sigma_voxel is None else np.broadcast_to(sigma_voxel, (*SHAPE, 3)).copy()
    return VectorField(
        Grid(SHAPE[::-1], SPACING_MM, (-4.0, 1.0, 2.0)),
        moved_mm / VOXEL_MM,
        moved_mm / VOXEL_MM,
        ones,
        ones,
        ones,
        np.full(SHAPE, VALID, np.uint8),
        sigma,
        VOXEL_MM,
        1e-3,
        (8, 8, 8),
    )


def places_mm() -> Floats:
    z, y, x = np.meshgrid(*(np.arange(n) * d for n, d in zip(SHAPE, SPACING_MM[::-1], strict=True)), indexing="ij")
    return np.stack([x, y, z], axis=-1)


def noise_mm(seed: int) -> Floats:
    return np.random.default_rng(seed).normal(size=(*SHAPE, 3)) * SIGMA_VOXEL * VOXEL_MM


def rotation_mm() -> Floats:
    """Return a rigid rotation about an oblique axis: large gradients, no divergence."""
    return np.cross([0.02, -0.03, 0.05], places_mm())
