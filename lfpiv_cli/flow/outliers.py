"""Finding vectors that do not fit their neighbours, and replacing them.

The normalised median test of Westerweel and Scarano (2005), each component for itself, after the neighbours have been
carried to the vector's place by robust slopes: without that step the test flags a large part of any clean shear flow.

Fields are (nz, ny, nx, 3); neighbours are the up to 26 around a vector.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, SECOND_PEAK, VALID
from lfpiv_cli.flow.peaks import typical_width

# Measurement noise that the test takes for granted, in voxels for particle images of 1 voxel standard deviation; it
# grows with their width. A smaller one flags clean vectors where the neighbours happen to agree.
EXPECTED_NOISE_VOXEL = 0.2
# Residual, in units of the neighbours' spread plus the expected noise, above which a component is an outlier.
THRESHOLD = 4.0
# A vector is judged, or replaced, by its neighbours only if at least this share of those in the grid can be used.
NEEDED_SHARE = 0.5
# A gap's vectors with almost as many neighbours as the best of them are filled in the same round.
FILL_TOLERANCE = 0.8
# Two rounds: outliers found in the first no longer count as neighbours in the second.
ROUNDS = 2


def expected_noise(width: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the noise that the test takes for granted, (3,) in voxels, from the widths of correlation peaks (..., 3).

    The correlation peak of Gaussian particle images is wider than they are by a factor of sqrt(2).
    """
    return EXPECTED_NOISE_VOXEL * np.maximum(1.0, typical_width(width) / np.sqrt(2.0))


def validate_vectors(
    raw: NDArray[np.float64],
    second: NDArray[np.float64],
    measured: NDArray[np.bool_],
    masked: NDArray[np.bool_],
    noise: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the validated displacements and their flags.

    An outlier takes its second peak if that one fits; otherwise it, and a window without a peak, takes the value that
    its neighbours predict if enough of them are sound; otherwise it is rejected. Rejected and masked vectors are NaN.

    Parameters
    ----------
    raw, second : (nz, ny, nx, 3) displacements of the first and second peak, voxels; NaN where there is none
    measured : (nz, ny, nx) there is a first peak
    masked : (nz, ny, nx) the window lies outside the mask or the volume
    noise : (3,) of `expected_noise`
    """
    displacement = np.where(masked[..., np.newaxis], np.nan, raw)
    flag = np.full(measured.shape, VALID, dtype=np.uint8)
    flag[~measured] = REJECTED
    flag[masked] = MASKED
    for _ in range(ROUNDS):
        usable = flag == VALID
        predicted, spread, share = predict(np.where(usable[..., np.newaxis], displacement, 0.0), usable, ~masked)
        limit = THRESHOLD * (spread + noise)
        judged = measured & ~masked & (share >= NEEDED_SHARE)
        fits = np.all(np.abs(raw - predicted) <= limit, axis=-1)
        flag[judged] = np.where(fits[judged], VALID, REJECTED)
    rescued = judged & (flag == REJECTED) & np.all(np.abs(second - predicted) <= limit, axis=-1)
    replaced = (flag == REJECTED) & ~rescued & (share >= NEEDED_SHARE)
    flag[rescued] = SECOND_PEAK
    flag[replaced] = REPLACED
    displacement[rescued] = second[rescued]
    displacement[replaced] = predicted[replaced]
    return displacement, flag


def fill_field(displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a field without NaN: gaps are closed from their rims inwards by what the neighbours predict.

    A field without a single vector becomes zero.
    """
    filled = np.where(np.isfinite(displacement), displacement, 0.0)
    known = np.all(np.isfinite(displacement), axis=-1)
    everywhere = np.ones(known.shape, dtype=np.bool_)
    while not known.all() and known.any():
        predicted, _, share = predict(filled, known, everywhere)
        # The best known first; without the tolerance a flat rim would be closed from its ends, one vector a round.
        needed = min(NEEDED_SHARE, FILL_TOLERANCE * float(np.max(share[~known])))
        rim = ~known & (share >= needed)
        filled[rim] = predicted[rim]
        known |= rim
    return filled


def smooth_field(displacement: NDArray[np.float64], strength: float) -> NDArray[np.float64]:
    """Return (1 - strength) of a field plus `strength` of it after a (1/4, 1/2, 1/4) filter along x, y and z.

    The first and the last value of a line become those of the straight line fitted to the outer three: linear flows
    pass unchanged, and noise at the ends does not.
    """
    smoothed = displacement
    for axis in range(3):
        if smoothed.shape[axis] > 2:
            moved = np.moveaxis(smoothed, axis, 0)
            filtered = np.empty_like(moved)
            filtered[1:-1] = 0.25 * moved[:-2] + 0.5 * moved[1:-1] + 0.25 * moved[2:]
            filtered[0] = (5.0 * moved[0] + 2.0 * moved[1] - moved[2]) / 6.0
            filtered[-1] = (5.0 * moved[-1] + 2.0 * moved[-2] - moved[-3]) / 6.0
            smoothed = np.moveaxis(filtered, 0, axis)
    return (1.0 - strength) * displacement + strength * smoothed


@njit(cache=True)
def robust_slope(values: NDArray[np.float64], places: NDArray[np.int64], axis: int) -> float:
    """Return the median slope along an axis over pairs of neighbours that lie on one line along it; 0 without a pair.

    `places` (n, 3) are the neighbours' offsets from the vector along (z, y, x).
    """
    slopes = np.empty(values.size * 2)
    pairs = 0
    for i in range(values.size):
        for j in range(values.size):
            run = places[j, axis] - places[i, axis]
            aligned = run > 0
            for other in range(3):
                aligned = aligned and (other == axis or places[i, other] == places[j, other])
            if aligned:
                slopes[pairs] = (values[j] - values[i]) / run
                pairs += 1
    return np.median(slopes[:pairs]) if pairs else 0.0


@njit(cache=True, parallel=True)
def predict(
    field: NDArray[np.float64], usable: NDArray[np.bool_], counted: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what the usable neighbours of each vector predict for it.

    Parameters
    ----------
    field : (nz, ny, nx, 3) finite where `usable`
    usable : (nz, ny, nx) vectors that may serve as neighbours
    counted : (nz, ny, nx) vectors that count in the share

    Returns
    -------
    predicted : (nz, ny, nx, 3) median of the neighbours, each carried to the vector's place by the robust slopes
    spread : (nz, ny, nx, 3) median distance of these from `predicted`
    share : (nz, ny, nx) usable neighbours over counted neighbours
    """
    nz, ny, nx = usable.shape
    predicted = np.zeros((nz, ny, nx, 3))
    spread = np.zeros((nz, ny, nx, 3))
    share = np.zeros((nz, ny, nx))
    for job in prange(nz * ny):
        z, y = job // ny, job % ny
        places = np.empty((26, 3), dtype=np.int64)
        values = np.empty((3, 26))
        for x in range(nx):
            used = 0
            possible = 0
            for jz in range(max(z - 1, 0), min(z + 2, nz)):
                for jy in range(max(y - 1, 0), min(y + 2, ny)):
                    for jx in range(max(x - 1, 0), min(x + 2, nx)):
                        if (jz == z and jy == y and jx == x) or not counted[jz, jy, jx]:
                            continue
                        possible += 1
                        if usable[jz, jy, jx]:
                            places[used, 0], places[used, 1], places[used, 2] = jz - z, jy - y, jx - x
                            for component in range(3):
                                values[component, used] = field[jz, jy, jx, component]
                            used += 1
            if used == 0:
                continue
            share[z, y, x] = used / possible
            for component in range(3):
                carried = values[component, :used].copy()
                for axis in range(3):
                    slope = robust_slope(values[component, :used], places[:used], axis)
                    for i in range(used):
                        carried[i] -= slope * places[i, axis]
                middle = np.median(carried)
                predicted[z, y, x, component] = middle
                spread[z, y, x, component] = np.median(np.abs(carried - middle))
    return predicted, spread, share
