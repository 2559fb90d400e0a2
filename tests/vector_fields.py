"""Vector fields made of a flow and of noise of stated size; and points of any format."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.files.particle_file import OPTIONAL, UNITS, Points
from lfpiv_cli.flow.field import VALID, VectorField
from lfpiv_cli.grid import FOCAL_POINT, Grid, Reference

SHAPE = (9, 10, 11)
SPACING_MM = (0.8, 0.6, 1.1)
VOXEL_MM = (0.1, 0.2, 0.3)
# By component: depth is known worst.
SIGMA_VOXEL = np.array([0.05, 0.02, 0.4])


def field_on(
    grid: Grid,
    displacement_voxel: Floats,
    flag: NDArray[np.uint8] | None = None,
    sigma_voxel: Floats | None = None,
    voxel_mm: tuple[float, ...] = (0.1,) * 3,
    dt_s: float = 1e-3,
) -> VectorField:
    """Return a field on a grid, of windows of 8 voxels; valid where nothing else is said."""
    ones, flag = np.ones(grid.shape_zyx), np.full(grid.shape_zyx, VALID, np.uint8) if flag is None else flag
    moved = displacement_voxel
    return VectorField(grid, moved, moved, ones, ones, ones, flag, sigma_voxel, voxel_mm, dt_s, (8, 8, 8))


def points_of(
    format_name: str,
    rng: np.random.Generator,
    count: int = 12,
    provenance: dict[str, Any] | None = None,
    **reported: Any,
) -> Points:
    """Return points with every array that their format has; three of each track or frame."""
    wide = {"covariance_mm2": 6, "displacement_covariance_mm2": 6, "velocity": 3, "velocity_sigma": 3}
    wide["displacement_mm"] = 3
    whole = {"flag", "particle_a", "particle_b", "track", "frame", "particle"}
    arrays = {
        name: np.arange(count) // 3 if name in whole else rng.random((count, wide[name]) if name in wide else count)
        for name in (*UNITS[format_name], *OPTIONAL.get(format_name, {}))
    }
    return Points(rng.random((count, 3)), arrays, FOCAL_POINT, reported, provenance or {})


def pair_tracks(
    position_mm: Floats, moved_mm: Floats, sigma_mm: ArrayLike, dt_s: float, made: dict[str, Any], reference: Reference
) -> Points:
    """Return tracks of a pair (n, 3) with independent errors of their displacements, of which all belong."""
    sigma, count = np.broadcast_to(sigma_mm, position_mm.shape), len(position_mm)
    arrays = {"velocity": moved_mm * 1e-3 / dt_s, "velocity_sigma": sigma * 1e-3 / dt_s, "displacement_mm": moved_mm}
    arrays |= {"displacement_covariance_mm2": np.pad(sigma**2, ((0, 0), (0, 3)))}
    arrays |= dict.fromkeys(("particle_a", "particle_b"), np.arange(count)) | {"link_probability": np.full(count, 0.99)}
    return Points(position_mm, arrays, reference, reference.attributes() | {"dt_s": dt_s}, made)


def field_of(moved_mm: Floats, sigma_voxel: Floats | None) -> VectorField:
    sigma = None if sigma_voxel is None else np.broadcast_to(sigma_voxel, (*SHAPE, 3)).copy()
    return field_on(Grid(SHAPE[::-1], SPACING_MM, (-4.0, 1.0, 2.0)), moved_mm / VOXEL_MM, None, sigma, VOXEL_MM)


def places_mm() -> Floats:
    z, y, x = np.meshgrid(*(np.arange(n) * d for n, d in zip(SHAPE, SPACING_MM[::-1], strict=True)), indexing="ij")
    return np.stack([x, y, z], axis=-1)


def noise_mm(seed: int) -> Floats:
    return np.random.default_rng(seed).normal(size=(*SHAPE, 3)) * SIGMA_VOXEL * VOXEL_MM


def rotation_mm() -> Floats:
    """Return a rigid rotation about an oblique axis: large gradients, no divergence."""
    return np.cross([0.02, -0.03, 0.05], places_mm())


def steady_mm(moved_mm: float = 1.0) -> Floats:
    """Return a flow that moves as a whole along x."""
    return np.broadcast_to([moved_mm, 0.0, 0.0], (*SHAPE, 3)).copy()
