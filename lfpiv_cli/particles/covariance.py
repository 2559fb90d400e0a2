"""How sure a particle is when its neighbours are not: the joint fit's covariance, one particle at a time.

Particles whose light overlaps give way to each other, so that the inverse of a particle's own normal matrix is too
small an error. The normal matrix of all particles together is sparse; a particle's part of its inverse is taken from
the particle and the neighbours it is tied to most, these free and the others held.

What is left of an image is not white either: a particle that was not found, or found wrongly, leaves the same sign in
pixels side by side. With H the normal matrix, K = H^-1 J^T W^(1/2) is how far each pixel's error moves a particle,
and errors with the correlation R move it by the covariance K R K^T. What a particle's chi-squared exceeds 1 by is not
noise but such a sign: it counts as errors that are all alike.

Axes: image axes, mm; see `fitting`. A particle's unknowns are x, y, z and light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.particles.least_squares import UNKNOWNS
from lfpiv_cli.particles.noise import Correlation
from lfpiv_cli.particles.response import VALUES, respond
from lfpiv_cli.particles.view import View, footprint_radius_mm, on_array_mm, view_of

# Neighbours that are left free: with twice as many the errors of 8,300 particles change by a thousandth.
FREE_NEIGHBOURS = 12


class Slopes(NamedTuple):
    """What each particle's unknowns do to the pixels.

    Attributes
    ----------
    start : (n + 1,) where each particle's entries begin
    pixel : flat numbers
    slope : (entries, 4) change of the pixel by x, y, z and light
    """

    start: NDArray[np.int64]
    pixel: NDArray[np.int32]
    slope: NDArray[np.float32]


class Ties(NamedTuple):
    """Which particles share pixels, each pair named once for either.

    Attributes
    ----------
    start, other : (n + 1,) and (2 pairs,), the neighbours of each, ascending
    block : (2 pairs, 4, 4) the normal matrix's block of particle and neighbour
    """

    start: NDArray[np.int64]
    other: NDArray[np.int64]
    block: NDArray[np.float64]


def joint_covariance(
    view: View,
    particles: NDArray[np.float64],
    weight: NDArray[np.float64],
    correlation: Correlation,
    chi2: NDArray[np.float64],
    capacity: int,
) -> NDArray[np.float64]:
    """Return the covariance (n, 4, 4) of each particle with its neighbours free.

    Parameters
    ----------
    particles : (n, 4)
    weight : (rows * columns,) 1/variance of the pixels
    correlation : of their errors, and how it falls with distance for errors that are alike
    chi2 : (n,) local chi-squared, 1 where the weights say all
    capacity : entries that a particle can have at most
    """
    slopes = _slopes(view, particles, capacity)
    start, other = _overlapping(view, particles)
    alone, block = _blocks(slopes, weight, view.camera.columns, start, other)
    return _covariances(slopes, Ties(start, other, block), alone, weight, correlation, chi2, view.camera.columns)


def _slopes(view: View, particles: NDArray[np.float64], capacity: int) -> Slopes:
    counts = _count_entries(view, particles, capacity)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    pixel, slope = np.empty(start[-1], np.int32), np.empty((start[-1], UNKNOWNS), np.float32)
    _fill_slopes(view, particles, capacity, start, pixel, slope)
    return Slopes(start, pixel, slope)


def _overlapping(view: View, particles: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the particles whose footprints may overlap: where each one's neighbours begin, and their numbers."""
    on_array = on_array_mm(view, particles)
    # Light that touches a lens's cell spreads over it.
    reach = footprint_radius_mm(view, particles[:, 2]) + 2.0 * max(view.half_x_mm, view.half_y_mm)
    first, second = KDTree(on_array).query_pairs(2.0 * float(reach.max(initial=0.0)), p=np.inf, output_type="ndarray").T
    near = np.abs(on_array[first] - on_array[second]).max(axis=1) < reach[first] + reach[second]
    pairs = np.concatenate([np.stack([first, second]), np.stack([second, first])], axis=1)[:, np.tile(near, 2)]
    pairs = pairs[:, np.lexsort(pairs[::-1])]
    start = np.searchsorted(pairs[0], np.arange(len(particles) + 1))
    return start.astype(np.int64), pairs[1].astype(np.int64)


@njit(cache=True, parallel=True)
def _count_entries(view: View, particles: NDArray[np.float64], capacity: int) -> NDArray[np.int64]:
    counts = np.empty(particles.shape[0], np.int64)
    camera, rest = view.camera[:], view[1:]
    for n in prange(particles.shape[0]):
        whole = view_of(camera, rest)
        pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
        counts[n] = respond(whole, particles[n, 0], particles[n, 1], particles[n, 2], pixels, values)
    return counts


@njit(cache=True, parallel=True)
def _fill_slopes(
    view: View,
    particles: NDArray[np.float64],
    capacity: int,
    start: NDArray[np.int64],
    pixel: NDArray[np.int32],
    slope: NDArray[np.float32],
) -> None:
    """Fill in `pixel` and `slope` of `Slopes`; arrays of a tuple would not be written to from parallel loops."""
    camera, rest = view.camera[:], view[1:]
    for n in prange(particles.shape[0]):
        whole = view_of(camera, rest)
        pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
        count = respond(whole, particles[n, 0], particles[n, 1], particles[n, 2], pixels, values)
        for k in range(count):
            pixel[start[n] + k] = pixels[k]
            for m in range(3):
                slope[start[n] + k, m] = particles[n, 3] * values[k, 1 + m]
            slope[start[n] + k, 3] = values[k, 0]


@njit(cache=True, parallel=True)
def _blocks(
    slopes: Slopes, weight: NDArray[np.float64], columns: int, start: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return J_n^T W J_n (n, 4, 4) of every particle, and J_n^T W J_m (pairs, 4, 4) with each of its neighbours m.

    Both from whole pixels: a pixel that two lenses light has one error, and with two it would be less than its
    neighbours' blocks ask for.
    """
    alone = np.zeros((start.size - 1, UNKNOWNS, UNKNOWNS))
    blocks = np.zeros((other.size, UNKNOWNS, UNKNOWNS))
    for n in prange(start.size - 1):
        begin, end = slopes.start[n], slopes.start[n + 1]
        if begin == end:
            continue
        row, column = slopes.pixel[begin:end] // columns, slopes.pixel[begin:end] % columns
        top, left = row.min(), column.min()
        own = np.zeros((row.max() - top + 1, column.max() - left + 1, UNKNOWNS))
        for k in range(end - begin):
            own[row[k] - top, column[k] - left] += weight[slopes.pixel[begin + k]] * slopes.slope[begin + k]
        _add_products(slopes, n, own, top, left, columns, alone[n])
        for at in range(start[n], start[n + 1]):
            _add_products(slopes, other[at], own, top, left, columns, blocks[at])
    return alone, blocks


@njit(cache=True)
def _add_products(
    slopes: Slopes, m: int, own: NDArray[np.float64], top: int, left: int, columns: int, block: NDArray[np.float64]
) -> None:
    """Add own^T J_m to a block (4, 4), with `own` on a rectangle of pixels."""
    for k in range(slopes.start[m], slopes.start[m + 1]):
        i, j = slopes.pixel[k] // columns - top, slopes.pixel[k] % columns - left
        if 0 <= i < own.shape[0] and 0 <= j < own.shape[1]:
            for a in range(UNKNOWNS):
                for b in range(UNKNOWNS):
                    block[a, b] += own[i, j, a] * slopes.slope[k, b]


@njit(cache=True, parallel=True)
def _covariances(
    slopes: Slopes,
    ties: Ties,
    matrices: NDArray[np.float64],
    weight: NDArray[np.float64],
    correlation: Correlation,
    chi2: NDArray[np.float64],
    columns: int,
) -> NDArray[np.float64]:
    """Return each particle's part of the inverse of the normal matrix of itself and its strongest neighbours."""
    inverses = np.empty_like(matrices)
    for n in prange(matrices.shape[0]):
        inverses[n] = np.linalg.inv(matrices[n])
    result = inverses.copy()
    for n in prange(matrices.shape[0]):
        members = _strongest(ties, inverses, n)
        whole = _normal_matrix(ties, matrices, members)
        # Millimetres beside counts: inverted with a diagonal of ones.
        scale = 1.0 / np.sqrt(np.diag(whole))
        inverse = np.linalg.inv(whole * scale * scale.reshape(-1, 1)) * scale * scale.reshape(-1, 1)
        excess = max(chi2[n] - 1.0, 0.0)
        result[n] = (1.0 + excess) * inverse[:UNKNOWNS, :UNKNOWNS]
        if correlation.share + excess > 0.0:
            moved_by = _moved_by(slopes, members, inverse, weight, columns)
            result[n] += (correlation.share + excess) * _excess(moved_by, correlation.decay)
    return result


@njit(cache=True)
def _strongest(ties: Ties, inverses: NDArray[np.float64], n: int) -> NDArray[np.int64]:
    """Return a particle's number and those of the neighbours that it is tied to most."""
    begin, end = ties.start[n], ties.start[n + 1]
    strength = np.zeros(end - begin)
    for k in range(end - begin):
        block = ties.block[begin + k]
        strength[k] = np.trace(inverses[n] @ block @ inverses[ties.other[begin + k]] @ block.T)
    chosen = np.argsort(-strength)[:FREE_NEIGHBOURS]
    members = np.empty(chosen.size + 1, np.int64)
    members[0] = n
    for k in range(chosen.size):
        members[k + 1] = ties.other[begin + chosen[k]]
    return members


@njit(cache=True)
def _moved_by(
    slopes: Slopes, members: NDArray[np.int64], inverse: NDArray[np.float64], weight: NDArray[np.float64], columns: int
) -> NDArray[np.float64]:
    """Return K (4, rows, columns) of the first member on the rectangle that it lights, its neighbours free."""
    begin, end = slopes.start[members[0]], slopes.start[members[0] + 1]
    row, column = slopes.pixel[begin:end] // columns, slopes.pixel[begin:end] % columns
    top, left = row.min(), column.min()
    moved_by = np.zeros((UNKNOWNS, row.max() - top + 1, column.max() - left + 1))
    for m in range(members.size):
        for k in range(slopes.start[members[m]], slopes.start[members[m] + 1]):
            i, j = slopes.pixel[k] // columns - top, slopes.pixel[k] % columns - left
            if 0 <= i < moved_by.shape[1] and 0 <= j < moved_by.shape[2]:
                root = np.sqrt(weight[slopes.pixel[k]])
                for a in range(UNKNOWNS):
                    for b in range(UNKNOWNS):
                        moved_by[a, i, j] += inverse[a, UNKNOWNS * m + b] * slopes.slope[k, b] * root
    return moved_by


@njit(cache=True)
def _excess(moved_by: NDArray[np.float64], decay: float) -> NDArray[np.float64]:
    """Return K (R - 1) K^T (4, 4) for errors whose correlation falls by `decay` from pixel to pixel along each axis."""
    excess = np.empty((UNKNOWNS, UNKNOWNS))
    for b in range(UNKNOWNS):
        others = _correlated(_correlated(moved_by[b], decay).T, decay).T - moved_by[b]
        for a in range(UNKNOWNS):
            excess[a, b] = np.sum(moved_by[a] * others)
    return excess


@njit(cache=True)
def _correlated(values: NDArray[np.float64], decay: float) -> NDArray[np.float64]:
    """Return sum_k decay^|j - k| values[i, k], by one pass each way."""
    result = np.empty_like(values)
    for i in range(values.shape[0]):
        carried = 0.0
        for j in range(values.shape[1]):
            carried = carried * decay + values[i, j]
            result[i, j] = carried
        carried = 0.0
        for j in range(values.shape[1] - 1, -1, -1):
            carried *= decay
            result[i, j] += carried
            carried += values[i, j]
    return result


@njit(cache=True)
def _normal_matrix(ties: Ties, matrices: NDArray[np.float64], members: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the normal matrix of some particles together."""
    size = UNKNOWNS * members.size
    whole = np.zeros((size, size))
    for a in range(members.size):
        at_a = UNKNOWNS * a
        whole[at_a : at_a + UNKNOWNS, at_a : at_a + UNKNOWNS] = matrices[members[a]]
        others = ties.other[ties.start[members[a]] : ties.start[members[a] + 1]]
        for b in range(members.size):
            place = np.searchsorted(others, members[b])
            if place < others.size and others[place] == members[b]:
                at_b = UNKNOWNS * b
                block = ties.block[ties.start[members[a]] + place]
                whole[at_a : at_a + UNKNOWNS, at_b : at_b + UNKNOWNS] = block
    return whole
