"""Peaks of correlation maps: place to a fraction of a voxel, width, and the second peak.

Maps are (2r + 1) cubed, indexed by the shift along (z, y, x) plus r; offsets and widths come back as (x, y, z) in
voxels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.grid import Reference, Scale
from lfpiv_cli.kernels import njit
from lfpiv_cli.threads import share_out

# Locking: near the focal plane volumes draw lateral displacements towards whole microlenses.
#
# A tracer in focus lights one microlens, wherever in it the tracer is; only from about `Scale.depth_mm` on is its
# light shared by several, whose shares tell where it is. In between, a displacement of a fraction f of a microlens is
# measured with an error of about -amplitude sin(2 pi f), the same in all windows at that depth, so that no scatter
# shows it. It is stated as an uncertainty. Particles, which are fitted to the pixels behind each lens, do not lock.

# Root mean square of the error in the focal plane over all fractions of a microlens, in microlenses.
LOCKING_LENSES = 0.1


def with_locking(field: VectorField, reference: Reference, scale: Scale) -> VectorField:
    """Return vectors from volumes with locking in the uncertainty of their lateral components.

    It is the root mean square of the error over all fractions of a microlens, by the depth from the focal plane.
    """
    if field.uncertainty_voxel is None:
        return field
    z_mm = np.array([reference.depth_to_focal_point(z) for z in field.grid.axis_mm(2)])
    error_mm = np.zeros((len(z_mm), 1, 1, 3))
    error_mm[..., :2] = (
        LOCKING_LENSES * scale.lens_mm * np.exp(-0.5 * (z_mm / scale.depth_mm) ** 2)[:, None, None, None]
    )
    return replace(field, uncertainty_voxel=np.hypot(field.uncertainty_voxel, error_mm / field.voxel_mm))


# A ratio beyond this says only that there is no second peak; it keeps the stored numbers finite.
LARGEST_PEAK_RATIO = 100.0
# Standard deviation in voxels of a correlation peak from which on an axis counts as elongated and takes Gauss-Newton
# steps. Particles of 1 voxel make peaks of 1.4; three points of a peak of 2.2 span less than a tenth of its height.
ELONGATED_WIDTH = 2.2


@dataclass(frozen=True, eq=False)
class Peaks:
    """What one map per window says; all arrays (nz, ny, nx) with a last axis of 3 for vectors.

    Attributes
    ----------
    offset : place of the highest peak; 0 where the map is empty
    height : its correlation, that of the highest whole shift; 0 where the map is empty
    second_offset, second_height : the second highest local maximum; height 0 where there is none
    ratio : height over that of the second maximum or, where there is none, of the highest shift that is no neighbour
    width : standard deviation of the Gaussian through the peak along each axis; NaN where three points do not bend down
    """

    offset: Floats
    height: Floats
    second_offset: Floats
    second_height: Floats
    ratio: Floats
    width: Floats

    @property
    def found(self) -> Flags:
        """Where there is a peak at all."""
        return self.height > 0.0


def find_peaks(maps: Floats) -> Peaks:
    """Return the peaks of maps of shape (nz, ny, nx, 2r + 1, 2r + 1, 2r + 1)."""
    windows, shifts = maps.shape[:3], maps.shape[3]
    flat = np.ascontiguousarray(maps).reshape(-1, shifts, shifts, shifts)
    count = flat.shape[0]
    offset, second_offset, heights = np.zeros((3, count, 3))
    width = np.full((count, 3), np.nan)
    share_out(write_peaks, count, flat, offset, second_offset, width, heights)
    height, second_height, beyond = (heights[:, i].reshape(windows) for i in range(3))
    rival = np.where(second_height > 0.0, second_height, beyond)
    ratio = np.full(windows, LARGEST_PEAK_RATIO)
    np.divide(height, rival, out=ratio, where=rival > 0.0)
    ratio = np.where(height > 0.0, np.minimum(ratio, LARGEST_PEAK_RATIO), 0.0)
    vectors = (*windows, 3)
    return Peaks(
        offset.reshape(vectors), height, second_offset.reshape(vectors), second_height, ratio, width.reshape(vectors)
    )


def typical_width(width: Floats) -> Floats:
    """Return the median of widths (..., 3) along each axis, leaving out NaN; the square root of 2 where all are NaN.

    That is the width for Gaussian particle images with a standard deviation of 1 voxel.
    """
    typical = np.full(3, np.sqrt(2.0))
    for axis in range(3):
        known = width[..., axis][np.isfinite(width[..., axis])]
        if known.size:
            typical[axis] = np.median(known)
    return typical


def undiluted(width: Floats) -> Floats:
    """Return the widths of peaks without the pedestal of dense seeding, which widens all axes by about one factor.

    Taken as undiluted where the narrowest is that of particles of up to 1 voxel, which volumes are made for.
    """
    return width * min(1.0, float(np.sqrt(2.0) / width.min()))


def absolute(peaks: Peaks, predictor: Floats) -> tuple[Floats, Floats]:
    """Return the displacements of the first and the second peak, NaN where there is none."""
    first = np.where(peaks.found[..., np.newaxis], predictor + peaks.offset, np.nan)
    has_second = (peaks.second_height > 0.0)[..., np.newaxis]
    return first, np.where(has_second, predictor + peaks.second_offset, np.nan)


@njit(cache=True)
def vertex(before: float, at: float, after: float) -> tuple[float, float]:
    """Return place and standard deviation of the Gaussian through three values at -1, 0, 1.

    The place is kept within one step. Where a value is not positive a parabola takes the Gaussian's place (and the
    width is that of the Gaussian with the same curvature at its top); where the three do not bend down, the place is
    that of the highest one and the width NaN.
    """
    if before > 0.0 and at > 0.0 and after > 0.0:
        slope = 0.5 * np.log(after / before)
        bend = 2.0 * np.log(at) - np.log(before) - np.log(after)
    elif at > 0.0:
        slope = 0.5 * (after - before) / at
        bend = (2.0 * at - before - after) / at
    else:
        slope = after - before
        bend = 0.0
    if bend <= 0.0:
        if at >= before and at >= after:
            return 0.0, np.nan
        return (1.0 if after > before else -1.0), np.nan
    return min(1.0, max(-1.0, slope / bend)), 1.0 / np.sqrt(bend)


@njit(cache=True)
def fit_peak(shifts: Floats, iz: int, iy: int, ix: int) -> tuple[float, float, float, float, float, float]:
    """Return offset (x, y, z) and width (x, y, z) of the peak at one node, by three points along each axis.

    At the map's border the three outermost points are used: the offset then stays within the map.
    """
    last = shifts.shape[0] - 1
    radius = last // 2
    cz, cy, cx = min(max(iz, 1), last - 1), min(max(iy, 1), last - 1), min(max(ix, 1), last - 1)
    x, width_x = vertex(shifts[iz, iy, cx - 1], shifts[iz, iy, cx], shifts[iz, iy, cx + 1])
    y, width_y = vertex(shifts[iz, cy - 1, ix], shifts[iz, cy, ix], shifts[iz, cy + 1, ix])
    z, width_z = vertex(shifts[cz - 1, iy, ix], shifts[cz, iy, ix], shifts[cz + 1, iy, ix])
    return cx + x - radius, cy + y - radius, cz + z - radius, width_x, width_y, width_z


@njit(cache=True)
def is_local_maximum(shifts: Floats, iz: int, iy: int, ix: int) -> bool:
    """Tell whether no neighbour of a node is higher (of equals, the first in memory counts)."""
    last = shifts.shape[0] - 1
    value = shifts[iz, iy, ix]
    for jz in range(max(iz - 1, 0), min(iz + 1, last) + 1):
        for jy in range(max(iy - 1, 0), min(iy + 1, last) + 1):
            for jx in range(max(ix - 1, 0), min(ix + 1, last) + 1):
                earlier = (jz, jy, jx) < (iz, iy, ix)
                if shifts[jz, jy, jx] > value or (earlier and shifts[jz, jy, jx] == value):
                    return False
    return True


@njit(cache=True, nogil=True)
def write_peaks(
    part: tuple[int, int], maps: Floats, offset: Floats, second_offset: Floats, width: Floats, heights: Floats
) -> None:
    """Write for maps `part` of (n, s, s, s): offset (n, 3), second offset (n, 3), width (n, 3), and heights (n, 3).

    The heights are those of the peak, of the second local maximum, and of the highest node that is no neighbour of the
    peak. Where there is no peak nothing is written; the heights are zero before.
    """
    size = maps.shape[1]
    for n in range(part[0], part[1]):
        shifts = maps[n]
        # Nodes by their place in memory: numba would compile `fit_peak` once more for indices that begin as constants.
        best = 0
        for iz in range(size):
            for iy in range(size):
                for ix in range(size):
                    if shifts[iz, iy, ix] > heights[n, 0]:
                        heights[n, 0] = shifts[iz, iy, ix]
                        best = (iz * size + iy) * size + ix
        if heights[n, 0] <= 0.0:
            continue
        best_z, best_y, best_x = best // (size * size), best // size % size, best % size
        x, y, z, width_x, width_y, width_z = fit_peak(shifts, best_z, best_y, best_x)
        offset[n, 0], offset[n, 1], offset[n, 2] = x, y, z
        width[n, 0], width[n, 1], width[n, 2] = width_x, width_y, width_z
        second = -1
        for iz in range(size):
            for iy in range(size):
                for ix in range(size):
                    value = shifts[iz, iy, ix]
                    near = abs(iz - best_z) <= 1 and abs(iy - best_y) <= 1 and abs(ix - best_x) <= 1
                    if near:
                        continue
                    heights[n, 2] = max(heights[n, 2], value)
                    if value > heights[n, 1] and is_local_maximum(shifts, iz, iy, ix):
                        heights[n, 1] = value
                        second = (iz * size + iy) * size + ix
        if second >= 0:
            x, y, z, _, _, _ = fit_peak(shifts, second // (size * size), second // size % size, second % size)
            second_offset[n, 0], second_offset[n, 1], second_offset[n, 2] = x, y, z
