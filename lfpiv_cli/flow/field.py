"""The vector field that two volumes yield: displacements at window centres, with what is known of their quality.

Axes: arrays are indexed `[z, y, x]`; the last axis of a vector holds its components (u, v, w) along (x, y, z). A
particle that moves towards +x from the first volume to the second has u > 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid

# Flags, in the order of decreasing trust. A velocity is finite up to SECOND_PEAK and NaN from REJECTED on.
VALID = 0
REPLACED = 1
SECOND_PEAK = 2
REJECTED = 3
MASKED = 4

FLAG_NAMES = {VALID: "valid", SECOND_PEAK: "second peak", REPLACED: "replaced", REJECTED: "rejected", MASKED: "masked"}

MM_TO_M = 1e-3


@dataclass(frozen=True, eq=False)
class VectorField:
    """Displacements between two volumes at the centres of the correlation windows.

    Attributes
    ----------
    grid : the window centres, mm
    displacement_voxel : (nz, ny, nx, 3) float64, after validation and without what long particles mix
    displacement_raw_voxel : (nz, ny, nx, 3) float64, as the correlation peak gave it, before validation
    correlation : (nz, ny, nx) normalised correlation at the peak, 1 for identical windows
    peak_ratio : (nz, ny, nx) height of the peak over that of the second one
    valid_fraction : (nz, ny, nx) share of the window inside both volumes and the mask, 0 to 1
    flag : (nz, ny, nx) uint8, one of VALID, REPLACED, SECOND_PEAK, REJECTED, MASKED
    uncertainty_voxel : (nz, ny, nx, 3) standard deviation of each component, or None where it is not known
    voxel_mm : size of a voxel along x, y, z
    dt_s : time between the volumes, or None where it is not known
    window_voxel : size of the final windows along x, y, z
    """

    grid: Grid
    displacement_voxel: NDArray[np.float64]
    displacement_raw_voxel: NDArray[np.float64]
    correlation: NDArray[np.float64]
    peak_ratio: NDArray[np.float64]
    valid_fraction: NDArray[np.float64]
    flag: NDArray[np.uint8]
    uncertainty_voxel: NDArray[np.float64] | None
    voxel_mm: tuple[float, float, float]
    dt_s: float | None
    window_voxel: tuple[int, int, int]

    @property
    def flag_counts(self) -> dict[str, int]:
        """How many vectors have each flag, by its name."""
        return {name: int(np.count_nonzero(self.flag == flag)) for flag, name in FLAG_NAMES.items()}

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity in m/s, shape (nz, ny, nx, 3): NaN where the vector is rejected or masked, or the time unknown."""
        if self.dt_s is None:
            return np.full(self.displacement_voxel.shape, np.nan)
        velocity = self.displacement_voxel * (np.asarray(self.voxel_mm) * MM_TO_M / self.dt_s)
        velocity[self.flag >= REJECTED] = np.nan
        return velocity
