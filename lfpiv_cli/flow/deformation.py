"""Deforming two volumes towards each other by a predicted displacement.

The first volume is sampled at x - d/2, the second at x + d/2 (symmetric, second order in time), by cubic B-splines: a
trilinear interpolation costs five times the error. Both are zero wherever either source lies outside the volume or is
masked, so that a particle is never compared with a place where its partner could not have been seen.

Axes: volumes `[z, y, x]`, displacements in voxels with components (u, v, w) along (x, y, z).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import spline_filter

# Sources lie between the first and the last voxel's centre; the four taps of a cubic B-spline at the last one reach two
# coefficients beyond it.
SPLINE_PAD = 2
# The prefilter sees the volume continued by odd reflection, which keeps its slope at the faces: the usual even one
# makes a kink in every particle that a face cuts, and costs 0.1 voxel there. Its response decays by 3.7 a voxel.
FACE_PAD = 8


def spline_coefficients(volume: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the cubic B-spline coefficients of a volume, with `SPLINE_PAD` of them beyond each face.

    Scaled to a largest magnitude of 1 in the volume: the correlation is normalised anyway, and products stay far from
    the limits of float32.
    """
    largest = float(np.max(np.abs(volume)))
    scaled = volume / np.float32(largest) if largest > 0.0 else volume
    continued = np.pad(scaled, FACE_PAD, mode="reflect", reflect_type="odd")
    coefficients = spline_filter(continued, order=3, output=np.float32, mode="mirror")
    kept = slice(FACE_PAD - SPLINE_PAD, SPLINE_PAD - FACE_PAD)
    return np.ascontiguousarray(coefficients[kept, kept, kept])


def spline_matrix(nodes: NDArray[np.float64], positions: NDArray[np.float64]) -> NDArray[np.float64]:
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


def resample_field(
    field: NDArray[np.float64], matrices_xyz: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return a field (nz, ny, nx, 3) carried to other positions by one spline matrix for each of x, y, z."""
    along_x, along_y, along_z = matrices_xyz
    return np.einsum("ck,bj,ai,kjid->cbad", along_z, along_y, along_x, field, optimize=True)


def expand_lateral(
    field: NDArray[np.float64], along_x: NDArray[np.float64], along_y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a field (nz, ny, nx, 3) at every voxel of the x-y planes through the windows: (nz, 3, rows y, columns x).

    The expansion in depth is left to `deform_pair`, plane by plane: a whole volume of vectors would take several times
    the memory of the volumes.
    """
    return np.ascontiguousarray(np.einsum("bj,ai,kjid->kdba", along_y, along_x, field, optimize=True))


@njit(cache=True)
def cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Return the weights of the four cubic B-splines around a point at 0 <= t < 1 past the second of them."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    )


@njit(cache=True)
def sample(coefficients: NDArray[np.float32], z: float, y: float, x: float) -> float:
    """Return the spline's value at a point given in voxel indices, between the outermost voxel centres."""
    iz = int(np.floor(z))
    iy = int(np.floor(y))
    ix = int(np.floor(x))
    x0, x1, x2, x3 = cubic_weights(x - ix)
    weights_y = cubic_weights(y - iy)
    weights_z = cubic_weights(z - iz)
    # The first tap lies one voxel before the floor and the padding two voxels before the volume: an offset of one.
    column = ix + SPLINE_PAD - 1
    total = 0.0
    for k in range(4):
        plane = 0.0
        for j in range(4):
            row = coefficients[iz + SPLINE_PAD - 1 + k, iy + SPLINE_PAD - 1 + j]
            plane += weights_y[j] * (
                (x0 * row[column] + x1 * row[column + 1]) + (x2 * row[column + 2] + x3 * row[column + 3])
            )
        total += weights_z[k] * plane
    return total


@njit(cache=True)
def is_seen(mask: NDArray[np.bool_], shape: tuple[int, int, int], z: float, y: float, x: float) -> bool:
    """Tell whether a point lies in the volume and, where there is a mask (any size but 0), in a voxel that it keeps."""
    # Not to the outer faces of the outermost voxels: beyond their centres a value would be extrapolated.
    inside = (0.0 <= z <= shape[0] - 1) and (0.0 <= y <= shape[1] - 1) and (0.0 <= x <= shape[2] - 1)
    if not inside or mask.size == 0:
        return inside
    return mask[int(np.floor(z + 0.5)), int(np.floor(y + 0.5)), int(np.floor(x + 0.5))]


@njit(cache=True, parallel=True)
def deform_pair(
    coefficients_a: NDArray[np.float32],
    coefficients_b: NDArray[np.float32],
    mask: NDArray[np.bool_],
    lateral: NDArray[np.float64],
    along_z: NDArray[np.float64],
    before: tuple[int, int, int],
    after: tuple[int, int, int],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Return both volumes deformed half-way towards each other, and where they are valid, with a margin of zeros.

    Parameters
    ----------
    coefficients_a, coefficients_b : of `spline_coefficients`
    mask : (z, y, x) True where the volumes are to be used, or of size 0 for everywhere
    lateral : (nz, 3, rows y, columns x) the predictor in voxels, of `expand_lateral`
    along_z : (planes z, nz) its spline matrix in depth
    before, after : widths of the margin before and after the volume along (z, y, x)
    """
    nz, ny, nx = along_z.shape[0], lateral.shape[2], lateral.shape[3]
    shape = (nz, ny, nx)
    padded = (before[0] + nz + after[0], before[1] + ny + after[1], before[2] + nx + after[2])
    deformed_a = np.zeros(padded, dtype=np.float32)
    deformed_b = np.zeros(padded, dtype=np.float32)
    valid = np.zeros(padded, dtype=np.uint8)
    for z in prange(nz):
        half = np.empty((3, nx))
        for y in range(ny):
            half[:] = 0.0
            for k in range(lateral.shape[0]):
                weight = 0.5 * along_z[z, k]
                for component in range(3):
                    row = lateral[k, component, y]
                    for x in range(nx):
                        half[component, x] += weight * row[x]
            for x in range(nx):
                u, v, w = half[0, x], half[1, x], half[2, x]
                if is_seen(mask, shape, z - w, y - v, x - u) and is_seen(mask, shape, z + w, y + v, x + u):
                    target = (z + before[0], y + before[1], x + before[2])
                    deformed_a[target] = sample(coefficients_a, z - w, y - v, x - u)
                    deformed_b[target] = sample(coefficients_b, z + w, y + v, x + u)
                    valid[target] = 1
    return deformed_a, deformed_b, valid
