"""Figures of merit of particles that were found against those that were there.

Axes: points (x, y, z) in mm; errors in units of a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.robust import MAD_TO_SIGMA

# A particle counts as found within so many voxels laterally and in depth.
LATERAL_VOXEL, DEPTH_VOXEL = 0.5, 2.0
# Of normal errors 95 % lie within so many standard deviations.
COVERED_SIGMAS = 1.96


@dataclass(frozen=True, eq=False)
class Matches:
    """Numbers of found and true particles that belong together, (n,) each, and their errors (n, 3) in voxels."""

    found: NDArray[np.int64]
    true: NDArray[np.int64]
    error_voxel: NDArray[np.float64]


def match(found_mm: NDArray[np.float64], true_mm: NDArray[np.float64], voxel_mm: float) -> Matches:
    """Pair found with true particles, nearest first, each at most once."""
    scale = voxel_mm * np.array([LATERAL_VOXEL, LATERAL_VOXEL, DEPTH_VOXEL])
    near = KDTree(true_mm / scale).query_ball_point(found_mm / scale, np.sqrt(2.0), return_sorted=True)
    found = np.repeat(np.arange(len(found_mm)), [len(k) for k in near])
    true = np.array([k for some in near for k in some], dtype=np.int64)
    offset = (found_mm[found] - true_mm[true]) / scale
    lateral2, depth2 = np.sum(offset[:, :2] ** 2, axis=1), offset[:, 2] ** 2
    free_found, free_true = np.ones(len(found_mm), dtype=bool), np.ones(len(true_mm), dtype=bool)
    kept = []
    for k in np.argsort(lateral2 + depth2, kind="stable"):
        if lateral2[k] < 1.0 and depth2[k] < 1.0 and free_found[found[k]] and free_true[true[k]]:
            free_found[found[k]] = free_true[true[k]] = False
            kept.append(k)
    error = (found_mm[found[kept]] - true_mm[true[kept]]) / voxel_mm
    return Matches(found[kept], true[kept], error)


def particle_figures(
    found_mm: NDArray[np.float64],
    true_mm: NDArray[np.float64],
    low_mm: NDArray[np.float64],
    high_mm: NDArray[np.float64],
    voxel_mm: float,
    sigma_mm: NDArray[np.float64] | None = None,
    distances_mm: tuple[float, float] = (0.0, np.inf),
) -> dict[str, float]:
    """Return recall, precision, and per component bias, rms and robust spread (1.48 median deviation) in voxels.

    Parameters
    ----------
    found_mm, true_mm : (n, 3), (m, 3)
    low_mm, high_mm : (3,) of the volume that is judged; what lies outside may be matched and is not counted
    sigma_mm : (n, 3) standard errors; they add the share of errors within 1.96 of them
    distances_mm : only what lies this far from z = 0, the focal plane, on either side is judged
    """

    def inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        distance = np.abs(points[:, 2])
        band = (distance >= distances_mm[0]) & (distance < distances_mm[1])
        return np.asarray(band & np.all((points >= low_mm) & (points <= high_mm), axis=1))

    pairs = match(found_mm, true_mm, voxel_mm)
    figures = {
        "recall": inside(true_mm[pairs.true]).sum() / max(inside(true_mm).sum(), 1),
        "precision": inside(found_mm[pairs.found]).sum() / max(inside(found_mm).sum(), 1),
    }
    judged = inside(true_mm[pairs.true])
    error = pairs.error_voxel[judged]
    for axis, (name, values) in enumerate(zip("xyz", error.T, strict=True)):
        if values.size:
            middle = np.median(values)
            figures[f"bias_{name}_voxel"] = middle
            figures[f"rms_{name}_voxel"] = np.sqrt(np.mean(values**2))
            figures[f"spread_{name}_voxel"] = MAD_TO_SIGMA * np.median(np.abs(values - middle))
            if sigma_mm is not None:
                covered = COVERED_SIGMAS * sigma_mm[pairs.found[judged], axis] / voxel_mm
                figures[f"coverage_{name}"] = np.mean(np.abs(values) <= covered)
    return {name: float(value) for name, value in figures.items()}
