"""Deforming two volumes towards each other by a predicted displacement.

The first volume is sampled at x - d/2, the second at x + d/2 (symmetric, second order in time), by cubic B-splines: a
trilinear interpolation costs five times the error. Both are zero wherever either source lies outside the volume or is
masked, so that a particle is never compared with a place where its partner could not have been seen.

Axes: volumes `[z, y, x]`, displacements in voxels with components (u, v, w) along (x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.flow.windows import Triple, WindowLayout
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.threads import share_out

# Sources lie between the first and the last voxel's centre: the four taps of a cubic B-spline reach one coefficient
# beyond these, and a fifth of weight zero another.
SPLINE_PAD = 2
# Neighbours along x are interpolated together with the taps of all of them, so many along an axis at most: theirs
# along x are taken four at a time.
NEIGHBOURS = 16
MOST_TAPS, TAPS_AT_ONCE = 8, 4
# Neighbours beyond the end of a row are interpolated and dropped; so far they may read.
SLACK = 2 * NEIGHBOURS
# A tap whose B-spline ends closer than this to a place weighs less than 2e-7 there and is left out: in fluid at rest,
# where displacements scatter around zero, five taps become three.
NEGLIGIBLE = 0.01


@dataclass(frozen=True, eq=False)
class Spline:
    """The cubic B-spline coefficients of a volume.

    Attributes
    ----------
    flat : float32, the coefficients [z, y, x] with `SPLINE_PAD` beyond each face, and `SLACK` zeros before and after
    shape_zyx : voxels of the volume
    """

    flat: Singles
    shape_zyx: Triple


def spline_coefficients(volume: Singles) -> Spline:
    """Return the cubic B-spline through a volume's voxels, scaled to a largest magnitude of 1.

    The correlation is normalised anyway, and products stay far from the limits of float32. Beyond the faces the volume
    is continued by odd reflection, which keeps its slope: the usual even one makes a kink in every particle that a face
    cuts, and costs 0.1 voxel there.
    """
    largest = float(max(np.max(volume), -np.min(volume)))
    padded = tuple(n + 2 * SPLINE_PAD for n in volume.shape)
    flat = np.zeros(int(np.prod(padded)) + 2 * SLACK, dtype=np.float32)
    inside = (slice(SPLINE_PAD, -SPLINE_PAD),) * 3
    coefficients = flat[SLACK:-SLACK].reshape(padded)
    scale = np.float32(1.0 / largest if largest > 0.0 else 1.0)
    share_out(filter_planes, volume.shape[0], volume, scale, coefficients[inside])
    share_out(filter_depth, volume.shape[1], coefficients[inside])
    for axis in range(3):
        moved = np.moveaxis(coefficients, axis, 0)
        first, last = moved[SPLINE_PAD], moved[-SPLINE_PAD - 1]
        moved[SPLINE_PAD - 1] = 2.0 * first - moved[min(SPLINE_PAD + 1, moved.shape[0] - SPLINE_PAD - 1)]
        moved[-SPLINE_PAD] = 2.0 * last - moved[max(-SPLINE_PAD - 2, SPLINE_PAD - moved.shape[0])]
    return Spline(flat, (volume.shape[0], volume.shape[1], volume.shape[2]))


@njit(cache=True)
def pivots(count: int) -> Singles:
    """Return the factors of the elimination of c[i - 1] + 4 c[i] + c[i + 1] = 6 s[i] with both ends given."""
    factors = np.zeros(count, dtype=np.float32)
    for i in range(1, count - 1):
        factors[i] = np.float32(1.0 / (4.0 - factors[i - 1]))
    return factors


@njit(cache=True)
def filter_lines(lines: Singles, factors: Singles) -> None:
    """Replace samples by B-spline coefficients along the first axis of (n, lines), in place.

    With odd reflection the outermost coefficients are the outermost samples; between them a tridiagonal system remains.
    """
    count = lines.shape[0]
    six = np.float32(6.0)
    for i in range(1, count - 1):
        here, before, factor = lines[i], lines[i - 1], factors[i]
        for x in range(here.size):
            here[x] = (six * here[x] - before[x]) * factor
    for i in range(count - 2, 0, -1):
        here, after, factor = lines[i], lines[i + 1], factors[i]
        for x in range(here.size):
            here[x] -= factor * after[x]


@njit(cache=True, nogil=True)
def filter_planes(part: tuple[int, int], volume: Singles, scale: np.float32, coefficients: Singles) -> None:
    """Write the B-spline coefficients along x and y of a volume times planes `part` of them."""
    along_y, along_x = pivots(volume.shape[1]), pivots(volume.shape[2])
    for z in range(part[0], part[1]):
        plane = volume[z] * scale
        filter_lines(plane, along_y)
        turned = plane.T.copy()
        filter_lines(turned, along_x)
        # Element by element: an assignment of whole arrays takes seconds to compile, for the words of its error.
        for y in range(plane.shape[0]):
            for x in range(plane.shape[1]):
                coefficients[z, y, x] = turned[x, y]


@njit(cache=True, nogil=True)
def filter_depth(part: tuple[int, int], volume: Singles) -> None:
    """Replace samples by B-spline coefficients along z, rows `part` of each plane, in place."""
    factors = pivots(volume.shape[0])
    for y in range(part[0], part[1]):
        filter_lines(volume[:, y], factors)


def spline_matrix(nodes: Floats, positions: Floats) -> Floats:
    """Return the matrix (positions, nodes) that evaluates the cubic spline through values at `nodes`.

    Between the nodes the spline is exact for cubics (not-a-knot); beyond them it goes on in a straight line, for a
    cubic would multiply the noise of the outermost values.
    """
    if nodes.size == 1:
        return np.ones((positions.size, 1))
    spline = CubicSpline(nodes, np.eye(nodes.size), axis=0)
    inside = np.clip(positions, nodes[0], nodes[-1])
    beyond = (positions - inside)[:, np.newaxis]
    return spline(inside) + beyond * spline(inside, 1)


@lru_cache(maxsize=4)
def matrices_to_voxels(layout: WindowLayout, shape_xyz: Triple) -> tuple[Singles, Singles, Singles]:
    """Return the spline matrices (voxels, windows) along x, y, z from window centres to all voxels.

    Most passes have the same ones.
    """
    along_x, along_y, along_z = (
        spline_matrix(layout.centres_voxel(k), np.arange(shape_xyz[k], dtype=np.float64)).astype(np.float32)
        for k in range(3)
    )
    return along_x, along_y, along_z


def deform_pair(
    a: Spline,
    b: Spline,
    mask: Flags,
    predictor: Floats,
    to_voxels: tuple[Singles, Singles, Singles],
    before: Triple,
    after: Triple,
) -> tuple[Singles, Singles, NDArray[np.uint8]]:
    """Return both volumes deformed half-way towards each other, and where they are valid, with a margin of zeros.

    Parameters
    ----------
    a, b : of `spline_coefficients`
    mask : (z, y, x) True where the volumes are to be used, or of size 0 for everywhere
    predictor : (nz, ny, nx, 3) displacements at the windows, voxels
    to_voxels : of `matrices_to_voxels`
    before, after : widths of the margin before and after the volume along (z, y, x)
    """
    padded = tuple(m + n + k for m, n, k in zip(before, a.shape_zyx, after, strict=True))
    deformed_a, deformed_b = np.zeros((2, *padded), dtype=np.float32)
    valid = np.zeros(padded, dtype=np.uint8)
    half = np.ascontiguousarray(0.5 * predictor.transpose(0, 3, 1, 2), dtype=np.float32)
    along_x, along_y, along_z = to_voxels
    matrices = (np.ascontiguousarray(along_x.T), along_y, along_z)
    out = (deformed_a, deformed_b, valid)
    share_out(deform_planes, a.shape_zyx[0], (a.flat, b.flat), mask, half, matrices, before, out)
    return deformed_a, deformed_b, valid


@njit(cache=True, nogil=True)
def deform_planes(
    part: tuple[int, int],
    flat: tuple[Singles, Singles],
    mask: Flags,
    half: Singles,
    to_voxels: tuple[Singles, Singles, Singles],
    before: Triple,
    out: tuple[Singles, Singles, NDArray[np.uint8]],
) -> None:
    """Deform planes `part` by half displacements (nz, 3, ny, nx) that the matrices carry to the voxels.

    The matrix along x is (windows, voxels), those along y and z are (voxels, windows). `out` takes both volumes and
    where they are valid, all with a margin `before` them.
    """
    flat_a, flat_b = flat
    along_x, along_y, along_z = to_voxels
    deformed_a, deformed_b, valid = out
    shape = (along_z.shape[0], along_y.shape[0], along_x.shape[1])
    row = shape[2] + 2 * SPLINE_PAD
    plane = row * (shape[1] + 2 * SPLINE_PAD)
    for z in range(part[0], part[1]):
        at_windows = np.dot(along_z[z], half.reshape(half.shape[0], half[0].size)).reshape(half.shape[1:])
        half_here = np.empty((3, shape[1], shape[2]), dtype=np.float32)
        for axis in range(3):
            np.dot(np.dot(along_y, at_windows[axis]), along_x, half_here[axis])
        moved = np.empty((3, shape[2] + NEIGHBOURS), dtype=np.float32)
        weights = np.empty((3, MOST_TAPS * NEIGHBOURS), dtype=np.float32)
        sums = np.empty((2, NEIGHBOURS), dtype=np.float32)
        for y in range(shape[1]):
            target = (z + before[0], y + before[1])
            here = slice(before[2], before[2] + shape[2])
            seen = valid[target][here]
            bound_row(half_here[:, y], shape, z, y, moved, seen)
            if mask.size:
                # A voxel for which either source lies nearest to a voxel that the mask leaves out.
                for x in range(shape[2]):
                    u, v, w = moved[0, x], moved[1, x], moved[2, x]
                    seen_a = mask[int(np.floor(z - w + 0.5)), int(np.floor(y - v + 0.5)), int(np.floor(x - u + 0.5))]
                    seen_b = mask[int(np.floor(z + w + 0.5)), int(np.floor(y + v + 0.5)), int(np.floor(x + u + 0.5))]
                    seen[x] &= np.uint8(seen_a and seen_b)
            begin = SLACK + (z + SPLINE_PAD) * plane + (y + SPLINE_PAD) * row + SPLINE_PAD
            row_a, row_b, x = deformed_a[target][here], deformed_b[target][here], 0
            while x < shape[2]:
                width, taps = gather_taps(moved, x, weights)
                interpolate(sums, (flat_a, flat_b), (begin + x, plane, row), weights, taps)
                for k in range(min(width, shape[2] - x)):
                    row_a[x + k] = sums[0, k] * np.float32(seen[x + k])
                    row_b[x + k] = sums[1, k] * np.float32(seen[x + k])
                x += width


@njit(cache=True, **COUNT_NO_REFERENCES)
def gather_taps(moved: Singles, x: int, weights: Singles) -> tuple[int, tuple[int, int, int, int, int, int]]:
    """Write the weights of the taps that the neighbours from `x` on need; return how many neighbours, and the taps.

    These are the lowest along z, y, x and how many follow along each. As many neighbours as `MOST_TAPS` serve: where
    displacements differ too much for all, fewer are taken at once.

    Parameters
    ----------
    moved, weights : along x, y, z
    """
    width = 2 * NEIGHBOURS
    while True:
        width //= 2
        low_x, taps_x = taps_of(moved[0, x : x + width])
        low_y, taps_y = taps_of(moved[1, x : x + width])
        low_z, taps_z = taps_of(moved[2, x : x + width])
        taps_x = -(-taps_x // TAPS_AT_ONCE) * TAPS_AT_ONCE
        if max(taps_x, taps_y, taps_z) <= MOST_TAPS:
            break
    write_splines(moved[0, x:], low_x, taps_x, weights[0])
    write_splines(moved[1, x:], low_y, taps_y, weights[1])
    write_splines(moved[2, x:], low_z, taps_z, weights[2])
    return width, (low_z, low_y, low_x, taps_z, taps_y, taps_x)


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def taps_of(places: Singles) -> tuple[int, int]:
    """Return the lowest tap whose B-spline matters at some of the places, and how many there are from it on."""
    low = high = places[0]
    for k in range(places.size):
        low, high = min(low, places[k]), max(high, places[k])
    first = int(np.floor(low + np.float32(NEGLIGIBLE))) - 1
    return first, int(np.ceil(high - np.float32(NEGLIGIBLE))) + 2 - first


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def write_splines(places: Singles, low: int, taps: int, weights: Singles) -> None:
    """Write the cubic B-splines B centred on each tap at `NEIGHBOURS` places, tap after tap from `low` on.

    B(s) = [max(0, 2 - |s|)^3 - 4 max(0, 1 - |s|)^3] / 6.
    """
    for tap in range(taps):
        centre, value = np.float32(low + tap), weights[tap * NEIGHBOURS :]
        for k in range(NEIGHBOURS):
            away = abs(places[k] - centre)
            outer, inner = max(np.float32(2.0) - away, np.float32(0.0)), max(np.float32(1.0) - away, np.float32(0.0))
            value[k] = (outer * outer * outer - np.float32(4.0) * inner * inner * inner) * np.float32(1.0 / 6.0)


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def interpolate(
    sums: Singles,
    volumes: tuple[Singles, Singles],
    place: tuple[int, int, int],
    weights: Singles,
    taps: tuple[int, int, int, int, int, int],
) -> None:
    """Interpolate two volumes a and b at mirrored places: b towards the taps, a as far away in the opposite direction.

    Parameters
    ----------
    sums : (2, NEIGHBOURS) of a and b, written
    volumes, place : flat; element of the first neighbour, and the steps to the next plane and row
    weights, taps : of `gather_taps`
    """
    a, b = volumes
    at, plane, row = place
    low_z, low_y, low_x, taps_z, taps_y, taps_x = taps
    total = sums.reshape(sums.size)
    for k in range(2 * NEIGHBOURS):
        total[k] = 0.0
    for tap_z in range(taps_z):
        of_z = weights[2, tap_z * NEIGHBOURS :]
        for tap_y in range(taps_y):
            of_y = weights[1, tap_y * NEIGHBOURS :]
            for tap_x in range(0, taps_x, TAPS_AT_ONCE):
                of_x = weights[0, tap_x * NEIGHBOURS :]
                away = (low_z + tap_z) * plane + (low_y + tap_y) * row + low_x + tap_x
                ahead, back = b[at + away :], a[at - away - 3 :]
                for k in range(NEIGHBOURS):
                    both = of_z[k] * of_y[k]
                    first, second = both * of_x[k], both * of_x[NEIGHBOURS + k]
                    third, fourth = both * of_x[2 * NEIGHBOURS + k], both * of_x[3 * NEIGHBOURS + k]
                    total[k] += first * back[k + 3] + second * back[k + 2] + third * back[k + 1] + fourth * back[k]
                    total[NEIGHBOURS + k] += (
                        first * ahead[k] + second * ahead[k + 1] + third * ahead[k + 2] + fourth * ahead[k + 3]
                    )


@njit(cache=True)
def bound_row(half: Singles, shape: Triple, z: int, y: int, moved: Singles, valid: NDArray[np.uint8]) -> None:
    """Write the half displacements of a row cut off where a source would leave the volume, and which ones are whole.

    The neighbours beyond its end repeat its last voxel. Cut off at the centres of the outermost voxels, not at their
    outer faces: beyond the centres a value would be extrapolated.
    """
    columns = shape[2]
    reach_z = np.float32(min(z, shape[0] - 1 - z))
    reach_y = np.float32(min(y, shape[1] - 1 - y))
    along_x, along_y, along_z = half[0], half[1], half[2]
    moved_x, moved_y, moved_z = moved[0], moved[1], moved[2]
    for x in range(columns):
        reach_x = min(np.float32(x), np.float32(columns - 1 - x))
        u, v, w = along_x[x], along_y[x], along_z[x]
        moved_x[x] = min(max(u, -reach_x), reach_x)
        moved_y[x] = min(max(v, -reach_y), reach_y)
        moved_z[x] = min(max(w, -reach_z), reach_z)
        valid[x] = (abs(u) <= reach_x) & (abs(v) <= reach_y) & (abs(w) <= reach_z)
    for axis in range(3):
        moved[axis, columns:] = moved[axis, columns - 1]
