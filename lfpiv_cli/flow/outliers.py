"""Finding vectors that do not fit their neighbours, and replacing them.

The normalised median test of Westerweel and Scarano (2005), each component for itself, after the neighbours have been
carried to the vector's place by robust slopes: without that step the test flags a large part of any clean shear flow.

Fields are (nz, ny, nx, 3); neighbours are the up to 26 around a vector.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

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
# Values that a median is taken of at most, rounded up to whole vectors of the processor: 26 neighbours, 25 slopes.
ROOM = 32


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
    usable = np.ones(measured.shape, dtype=np.bool_)
    predicted, spread, share = np.zeros(raw.shape), np.zeros(raw.shape), np.zeros(measured.shape)
    for round_number in range(ROUNDS):
        before, usable = usable, flag == VALID
        # In a later round only what has lost or won a neighbour.
        again = _around(before != usable) if round_number else np.ones(measured.shape, dtype=np.bool_)
        told = predict(np.where(usable[..., np.newaxis], displacement, 0.0), usable, ~masked, again)
        for kept, new in zip((predicted, spread, share), told, strict=True):
            kept[again] = new[again]
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
        predicted, _, share = predict(filled, known, everywhere, ~known)
        # The best known first; without the tolerance a flat rim would be closed from its ends, one vector a round.
        needed = min(NEEDED_SHARE, FILL_TOLERANCE * float(np.max(share[~known])))
        rim = ~known & (share >= needed)
        filled[rim] = predicted[rim]
        known |= rim
    return filled


@njit(cache=True)
def median(values: NDArray[np.float64], count: int) -> float:
    """Return the median of the first `count` values, 1 or more; infinity must stand in the other ones of `ROOM`.

    By counting what is below each value, which takes no branches: three times faster than sorting so few.
    """
    low = high = np.nan
    for i in range(count):
        value = values[i]
        below = np.int32(0)
        not_above = np.int32(0)
        for j in range(ROOM):
            below += np.int32(values[j] < value)
            not_above += np.int32(values[j] <= value)
        if below <= (count - 1) // 2 < not_above:
            low = value
        if below <= count // 2 < not_above:
            high = value
        if low == low and high == high:
            break
    return 0.5 * (low + high)


@njit(cache=True)
def robust_slope(
    cube: NDArray[np.float64], known: NDArray[np.bool_], stride: int, slopes: NDArray[np.float64]
) -> float:
    """Return the median slope along an axis over pairs of neighbours that lie on one line along it; 0 without a pair.

    Parameters
    ----------
    cube, known : (27,) the vector's neighbourhood [z, y, x] and which of it may be used
    stride : 9, 3, 1 for the axes z, y, x
    slopes : (ROOM,) room to work
    """
    slopes[:] = np.inf
    pairs = 0
    for first in range(27):
        # The first of three on a line along the axis.
        if (first // stride) % 3:
            continue
        middle, last = first + stride, first + 2 * stride
        if known[first] and known[middle]:
            slopes[pairs] = cube[middle] - cube[first]
            pairs += 1
        if known[middle] and known[last]:
            slopes[pairs] = cube[last] - cube[middle]
            pairs += 1
        if known[first] and known[last]:
            slopes[pairs] = 0.5 * (cube[last] - cube[first])
            pairs += 1
    return median(slopes, pairs) if pairs else 0.0


@njit(cache=True, parallel=True)
def predict(
    field: NDArray[np.float64], usable: NDArray[np.bool_], counted: NDArray[np.bool_], wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what the usable neighbours of each wanted vector predict for it.

    Parameters
    ----------
    field : (nz, ny, nx, 3) finite where `usable`
    usable : (nz, ny, nx) vectors that may serve as neighbours
    counted : (nz, ny, nx) vectors that count in the share
    wanted : (nz, ny, nx) vectors to predict; for others everything is 0

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
        cube, carried = np.zeros((3, 27)), np.empty(ROOM)
        known = np.empty(27, dtype=np.bool_)
        for x in range(nx):
            if not wanted[z, y, x]:
                continue
            used = possible = 0
            for place in range(27):
                jz, jy, jx = z + place // 9 - 1, y + place // 3 % 3 - 1, x + place % 3 - 1
                known[place] = False
                inside = 0 <= jz < nz and 0 <= jy < ny and 0 <= jx < nx
                if not inside or place == 13 or not counted[jz, jy, jx]:
                    continue
                possible += 1
                if usable[jz, jy, jx]:
                    known[place] = True
                    used += 1
                    for component in range(3):
                        cube[component, place] = field[jz, jy, jx, component]
            if used == 0:
                continue
            share[z, y, x] = used / possible
            for component in range(3):
                values = cube[component]
                slope_z, slope_y, slope_x = (
                    robust_slope(values, known, 9, carried),
                    robust_slope(values, known, 3, carried),
                    robust_slope(values, known, 1, carried),
                )
                carried[:] = np.inf
                count = 0
                for place in range(27):
                    if known[place]:
                        away = slope_z * (place // 9 - 1) + slope_y * (place // 3 % 3 - 1) + slope_x * (place % 3 - 1)
                        carried[count] = values[place] - away
                        count += 1
                middle = median(carried, count)
                for i in range(count):
                    carried[i] = abs(carried[i] - middle)
                predicted[z, y, x, component] = middle
                spread[z, y, x, component] = median(carried, count)
    return predicted, spread, share


def _around(chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which vectors have a chosen one among their 26 neighbours (or are one)."""
    return np.asarray(binary_dilation(chosen, np.ones((3, 3, 3), dtype=np.bool_)))
