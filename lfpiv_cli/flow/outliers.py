"""Finding vectors that do not fit their neighbours, and replacing them.

The normalised median test of Westerweel and Scarano (2005), each component for itself, after the neighbours have been
carried to the vector's place by robust slopes: without that step the test flags a large part of any clean shear flow.

Fields are (nz, ny, nx, 3); neighbours are the up to 26 around a vector.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, correlate1d, maximum_filter1d

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, SECOND_PEAK, VALID
from lfpiv_cli.flow.peaks import typical_width
from lfpiv_cli.flow.windows import Triple, WindowLayout
from lfpiv_cli.kernels import njit
from lfpiv_cli.threads import share_out

# The filter between passes, and what it says of the scales that a field does not resolve.
#
# Fields are (nz, ny, nx, 3) without NaN.

# The end of a straight line fitted to the outer three values. Linear flows pass unchanged, and noise does not.
LINE_END = np.array([5.0, 2.0, -1.0]) / 6.0
# Six tenths of the end of a parabola fitted to the outer four, the rest of that line: it keeps most of the curvature of
# a flow along a wall. The parabola alone lets more noise through, and where particle images are long even this does.
CURVED_END = 0.6 * np.array([19.0, 3.0, -3.0, 1.0]) / 20.0 + 0.4 * np.append(LINE_END, 0.0)
# Standard deviation of what cubic B-splines leave with the true predictor, .001 voxel where nothing moves to .003 where
# particles of 1 voxel move by 4.
INTERPOLATION_VOXEL = 0.002
# Windows nearer than the particles are long would tell the bend of the flow by differences of their noise.
LARGEST_MIXING = 0.25


def smooth_field(displacement: Floats, is_elongated: bool = False) -> Floats:
    """Return a field d without what differs from one window to the next; F d for long particles.

    F is a (1/4, 1/2, 1/4) filter along x, y and z; for short particles the result is 2 F d - F F d. Noise from one
    window to the next vanishes, as with F alone, but what F takes from a curved flow is given back to the second order.
    Measured on known volumes, it leaves half of the error of F at 0.7 of its strength in clean ones, and less noise in
    noisy ones. Particle images that are elongated are located so much less well that F alone is better.
    """
    if is_elongated:
        return _filter(displacement, LINE_END)
    once = _filter(displacement, CURVED_END)
    return 2.0 * once - _filter(once, CURVED_END)


def unresolved(displacement: Floats, is_elongated: bool = False) -> Floats:
    """Return what a window's own equations cannot know of its error: standard deviations (nz, ny, nx, 3) in voxels.

    The curvature within a window that the predictor missed, and the noise of the neighbours that deformed it, are as
    large as the part of a field that `smooth_field` takes away: its rms over a vector and its neighbours. And whatever
    the particles, splines err by `INTERPOLATION_VOXEL`.
    """
    mean = (displacement - smooth_field(displacement, is_elongated)) ** 2
    for axis in range(3):
        mean = correlate1d(mean, np.full(3, 1.0 / 3.0), axis=axis, mode="nearest")
    return np.sqrt(mean + INTERPOLATION_VOXEL**2)


def mixing(displacement: Floats, sigma_voxel: Floats, step: Triple) -> Floats:
    """Return by how much long particles change the flow that a correlation sees, (nz, ny, nx, 3) in voxels.

    A particle image moves as a whole, by the flow d at its centre; a voxel away from that sees it all the same. In the
    product of two Gaussian images of standard deviation s the distances have s / sqrt(2), and the mean of d over these
    is d + s^2 / 4 d'' to the second order, along the image's length. Nothing at the ends, where particles may lie on
    one side only.

    Parameters
    ----------
    displacement : (nz, ny, nx, 3) without NaN
    sigma_voxel : (3,) standard deviation of a particle image along x, y, z; 0 where it is short
    step : distance of the windows along x, y, z, voxels
    """
    smooth = _filter(displacement, LINE_END)
    change = np.zeros(displacement.shape)
    for axis, sigma, distance in zip((2, 1, 0), sigma_voxel, step, strict=True):
        share = min(0.25 * (sigma / distance) ** 2, LARGEST_MIXING)
        if share > 0.0 and displacement.shape[axis] > 2:
            bend = correlate1d(smooth, (1.0, -2.0, 1.0), axis=axis)
            moved = np.moveaxis(bend, axis, 0)
            moved[0] = moved[-1] = 0.0
            change += share * bend
    return change


def _filter(displacement: Floats, end: Floats) -> Floats:
    """Return a field after a (1/4, 1/2, 1/4) filter along x, y and z.

    The first and the last value of a line become those that `end` makes of the outer ones; of the straight line where
    there are too few.
    """
    filtered = displacement
    for axis in range(3):
        if filtered.shape[axis] >= LINE_END.size:
            moved = np.moveaxis(filtered, axis, 0)
            weights = end if moved.shape[0] >= end.size else LINE_END
            line = np.empty_like(moved)
            line[1:-1] = 0.25 * moved[:-2] + 0.5 * moved[1:-1] + 0.25 * moved[2:]
            line[0] = sum(weight * value for weight, value in zip(weights, moved[: weights.size], strict=True))
            line[-1] = sum(
                weight * value for weight, value in zip(weights, moved[: -weights.size - 1 : -1], strict=True)
            )
            filtered = np.moveaxis(line, 0, axis)
    return filtered


# Beside tracers a window without any holds the tails of their long images, which move as they do: what is measured
# there is the flow beside it, and looks as sure. Windows that hold many tracers have like amplitudes: all but so many
# of those beside each other across the particles have at least a share of their neighbour's. With so much less than
# that share, up to the largest, of one within so many standard deviations of a particle along it, one is a tail's.
TAIL_QUANTILE, TAIL_BELOW, LARGEST_TAIL, TAIL_SIGMAS = 0.02, 0.2, 0.5, 10.0


def in_tails(amplitude: Floats, sigma_voxel: Floats, layout: WindowLayout) -> Flags:
    """Return which windows (nz, ny, nx) hold no more than the tails of particles in windows beside them.

    Where few tracers in a window make amplitudes unlike, or none at all in some, nobody can tell.

    Parameters
    ----------
    amplitude : (nz, ny, nx) root of the mean square of the intensities in each window
    sigma_voxel : (3,) standard deviation of a particle image along x, y, z; 0 where it is short
    layout : the windows, in voxels
    """
    ratios = [np.zeros(0)]
    for axis in np.flatnonzero(sigma_voxel == 0.0):
        moved, apart = np.moveaxis(amplitude, 2 - axis, 0), -(-layout.size[axis] // layout.step[axis])
        pairs = moved[:-apart], moved[apart:]
        ratios.append((np.minimum(*pairs) / np.maximum(np.maximum(*pairs), np.finfo(np.float64).tiny)).ravel())
    beside, found = np.concatenate(ratios), np.zeros(amplitude.shape, dtype=np.bool_)
    alike = float(np.quantile(beside, TAIL_QUANTILE)) if len(beside) else 0.0
    for axis in np.flatnonzero(sigma_voxel > 0.0):
        windows = round(TAIL_SIGMAS * sigma_voxel[axis] / layout.step[axis])
        largest = maximum_filter1d(amplitude, 2 * windows + 1, axis=2 - axis)
        found |= amplitude < min(alike - TAIL_BELOW, LARGEST_TAIL) * largest
    return found


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
# A vector and its neighbours, [z, y, x]; as many slopes join them along an axis, which all medians are taken of.
NEIGHBOURHOOD = 27
# Vectors that are judged together.
LANES = 32


def sorting_network(count: int) -> Integers:
    """Return Batcher's odd-even merge sort of `count` values: pairs (n, 2) to be put in order one after the other."""
    pairs = []
    length = 1
    while length < count:
        distance = length
        while distance:
            for start in range(distance % length, count - distance, 2 * distance):
                for first in range(start, min(start + distance, count - distance)):
                    if first // (2 * length) == (first + distance) // (2 * length):
                        pairs.append((first, first + distance))
            distance //= 2
        length *= 2
    return np.array(pairs)


NETWORK = sorting_network(NEIGHBOURHOOD)


def expected_noise(width: Floats) -> Floats:
    """Return the noise that the test takes for granted, (3,) in voxels, from the widths of correlation peaks (..., 3).

    The correlation peak of Gaussian particle images is wider than they are by a factor of sqrt(2).
    """
    return EXPECTED_NOISE_VOXEL * np.maximum(1.0, typical_width(width) / np.sqrt(2.0))


def validate_vectors(
    raw: Floats, second: Floats, measured: Flags, masked: Flags, noise: Floats
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the validated displacements and their flags.

    An outlier takes its second peak if that one fits; otherwise the value that its neighbours predict if enough of them
    are sound; otherwise it is rejected, as is a window without a peak: it holds no tracers, and what neighbours predict
    for it would look measured. Rejected and masked vectors are NaN.

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
    flat = (predicted.reshape(-1, 3), spread.reshape(-1, 3), share.reshape(-1))
    for round_number in range(ROUNDS):
        before, usable = usable, flag == VALID
        again = np.arange(measured.size)
        if round_number:
            # Only what has lost or won a neighbour.
            again = np.flatnonzero(binary_dilation(before != usable, np.ones((3, 3, 3), dtype=np.bool_)))
        renewed = predict(displacement, usable, ~masked, again)
        for kept, new in zip(flat, renewed, strict=True):
            kept[again] = new
        limit = THRESHOLD * (spread + noise)
        judged = measured & ~masked & (share >= NEEDED_SHARE)
        fits = np.all(np.abs(raw - predicted) <= limit, axis=-1)
        flag[judged] = np.where(fits[judged], VALID, REJECTED)
    rescued = judged & (flag == REJECTED) & np.all(np.abs(second - predicted) <= limit, axis=-1)
    replaced = judged & (flag == REJECTED) & ~rescued
    flag[rescued] = SECOND_PEAK
    flag[replaced] = REPLACED
    displacement[rescued] = second[rescued]
    displacement[replaced] = predicted[replaced]
    return displacement, flag


def fill_field(displacement: Floats) -> Floats:
    """Return a field without NaN: gaps are closed from their rims inwards by what the neighbours predict.

    A field without a single vector becomes zero.
    """
    filled = np.where(np.isfinite(displacement), displacement, 0.0)
    known = np.all(np.isfinite(displacement), axis=-1)
    everywhere = np.ones(known.shape, dtype=np.bool_)
    while not known.all() and known.any():
        gaps = np.flatnonzero(~known)
        predicted, _, share = predict(filled, known, everywhere, gaps)
        # The best known first; without the tolerance a flat rim would be closed from its ends, one vector a round.
        rim = share >= min(NEEDED_SHARE, FILL_TOLERANCE * float(np.max(share)))
        filled.reshape(-1, 3)[gaps[rim]] = predicted[rim]
        known.reshape(-1)[gaps[rim]] = True
    return filled


@njit(cache=True)
def medians(rows: Floats, middle: Floats) -> None:
    """Write the median of the finite values of each column of (NEIGHBOURHOOD, LANES), 0 without any; sorts `rows`.

    Infinity stands for what is not known.
    """
    # The same comparisons for all columns, many at once.
    for pair in range(NETWORK.shape[0]):
        upper, lower = rows[NETWORK[pair, 0]], rows[NETWORK[pair, 1]]
        for lane in range(LANES):
            one, other = upper[lane], lower[lane]
            upper[lane], lower[lane] = min(one, other), max(one, other)
    for lane in range(LANES):
        count = 0
        for place in range(NEIGHBOURHOOD):
            count += rows[place, lane] < np.inf
        middle[lane] = 0.5 * (rows[(count - 1) // 2, lane] + rows[count // 2, lane]) if count else 0.0


@njit(cache=True)
def robust_slopes(values: Floats, stride: int, slopes: Floats, middle: Floats) -> None:
    """Write the median slope along an axis over pairs of neighbours that lie on one line along it; 0 without a pair.

    Parameters
    ----------
    values : (NEIGHBOURHOOD, LANES) neighbourhoods [z, y, x] of several vectors, infinite where they may not be used
    stride : 9, 3, 1 for the axes z, y, x
    slopes : (NEIGHBOURHOOD, LANES) room to work
    middle : (LANES,) the slopes
    """
    place = 0
    for start in range(NEIGHBOURHOOD):
        # The first of three on a line along the axis.
        if (start // stride) % 3:
            continue
        first, centre, last = values[start], values[start + stride], values[start + 2 * stride]
        for lane in range(LANES):
            # Differences with what is not known are infinite too, or nothing at all.
            before, after, across = centre[lane] - first[lane], last[lane] - centre[lane], last[lane] - first[lane]
            slopes[place, lane] = before if abs(before) < np.inf else np.inf
            slopes[place + 1, lane] = after if abs(after) < np.inf else np.inf
            slopes[place + 2, lane] = 0.5 * across if abs(across) < np.inf else np.inf
        place += 3
    medians(slopes, middle)


@njit(cache=True)
def gather(field: Floats, usable: Flags, counted: Flags, places: Integers, cubes: Floats, share: Floats) -> None:
    """Write the usable neighbours of up to `LANES` vectors, (3, NEIGHBOURHOOD, LANES), infinity for the others.

    Also their share among those that count; arguments as of `predict`, `places` being flat indices.
    """
    nz, ny, nx = usable.shape
    cubes[:] = np.inf
    for lane in range(places.size):
        z, y, x = places[lane] // (ny * nx), places[lane] // nx % ny, places[lane] % nx
        used = possible = 0
        for place in range(NEIGHBOURHOOD):
            jz, jy, jx = z + place // 9 - 1, y + place // 3 % 3 - 1, x + place % 3 - 1
            inside = 0 <= jz < nz and 0 <= jy < ny and 0 <= jx < nx
            if not inside or place == NEIGHBOURHOOD // 2 or not counted[jz, jy, jx]:
                continue
            possible += 1
            if usable[jz, jy, jx]:
                used += 1
                for component in range(3):
                    cubes[component, place, lane] = field[jz, jy, jx, component]
        share[lane] = used / possible if used else 0.0


def predict(field: Floats, usable: Flags, counted: Flags, wanted: Integers) -> tuple[Floats, Floats, Floats]:
    """Return what the usable neighbours of each wanted vector predict for it.

    Parameters
    ----------
    field : (nz, ny, nx, 3) finite where `usable`
    usable : (nz, ny, nx) vectors that may serve as neighbours
    counted : (nz, ny, nx) vectors that count in the share
    wanted : (n,) flat indices of the vectors to predict

    Returns
    -------
    predicted : (n, 3) median of the neighbours, each carried to the vector's place by the robust slopes; 0 without any
    spread : (n, 3) median distance of these from `predicted`
    share : (n,) usable neighbours over counted neighbours
    """
    tiles = -(-wanted.size // LANES)
    predicted, spread = np.zeros((2, tiles, 3, LANES))
    share = np.zeros((tiles, LANES))
    share_out(predict_tiles, tiles, field, usable, counted, wanted, (predicted, spread, share))
    by_vector = (predicted.transpose(0, 2, 1).reshape(-1, 3), spread.transpose(0, 2, 1).reshape(-1, 3))
    n = wanted.size
    return by_vector[0][:n], by_vector[1][:n], share.reshape(-1)[:n]


@njit(cache=True, nogil=True)
def predict_tiles(
    part: tuple[int, int],
    field: Floats,
    usable: Flags,
    counted: Flags,
    wanted: Integers,
    out: tuple[Floats, Floats, Floats],
) -> None:
    """Write what `predict` returns for tiles `part` of `LANES` wanted vectors each, (tiles, 3, LANES); see there."""
    predicted, spread, share = out
    for tile in range(part[0], part[1]):
        cubes = np.empty((3, NEIGHBOURHOOD, LANES))
        rows, slopes = np.empty((NEIGHBOURHOOD, LANES)), np.empty((3, LANES))
        gather(field, usable, counted, wanted[tile * LANES : (tile + 1) * LANES], cubes, share[tile])
        for component in range(3):
            values, middle = cubes[component], predicted[tile, component]
            for axis, stride in enumerate((9, 3, 1)):
                robust_slopes(values, stride, rows, slopes[axis])
            for place in range(NEIGHBOURHOOD):
                z, y, x = place // 9 - 1, place // 3 % 3 - 1, place % 3 - 1
                for lane in range(LANES):
                    away = slopes[0, lane] * z + slopes[1, lane] * y + slopes[2, lane] * x
                    values[place, lane] -= away
                    rows[place, lane] = values[place, lane]
            medians(rows, middle)
            for place in range(NEIGHBOURHOOD):
                for lane in range(LANES):
                    rows[place, lane] = abs(values[place, lane] - middle[lane])
            medians(rows, spread[tile, component])
