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
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.particles.least_squares import UNKNOWNS, Observation
from lfpiv_cli.particles.noise import Correlation
from lfpiv_cli.particles.response import entries_of
from lfpiv_cli.particles.view import View, footprint_radius_mm, on_array_mm
from lfpiv_cli.threads import COUNT_NO_REFERENCES, blocks, in_threads

# Neighbours that are left free: with twice as many the errors of 8,300 particles change by a thousandth.
FREE_NEIGHBOURS = 12
# Particles that one thread takes at a time.
BLOCK = 64


class Slopes(NamedTuple):
    """What each particle's unknowns do to the pixels.

    Attributes
    ----------
    start : (n + 1,) where each particle's entries begin
    pixel : flat numbers
    slope : (entries, 4) change of the pixel by x, y, z and light
    columns : of the image
    """

    start: NDArray[np.int64]
    pixel: NDArray[np.int32]
    slope: NDArray[np.float32]
    columns: int


class Neighbours(NamedTuple):
    """Which particles share pixels, each pair named once for either.

    Attributes
    ----------
    start, other : (n + 1,) and (2 pairs,), the neighbours of each, ascending
    """

    start: NDArray[np.int64]
    other: NDArray[np.int64]


class Equations(NamedTuple):
    """The normal matrix of all particles together, block by block.

    Attributes
    ----------
    slopes, neighbours : see there
    weight : (pixels,) 1/variance
    alone : (n, 4, 4) the blocks of single particles
    block : (2 pairs, 4, 4) those of particles and their neighbours
    inverses : (n, 4, 4) of `alone`
    """

    slopes: Slopes
    neighbours: Neighbours
    weight: NDArray[np.float64]
    alone: NDArray[np.float64]
    block: NDArray[np.float64]
    inverses: NDArray[np.float64]


def joint_covariance(
    observation: Observation, particles: NDArray[np.float64], correlation: Correlation, chi2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (n, 4, 4) of each particle with its neighbours free.

    Parameters
    ----------
    particles : (n, 4)
    correlation : of the pixels' errors, and how it falls with distance for errors that are alike
    chi2 : (n,) local chi-squared, 1 where the weights say all
    """
    equations = _equations(observation, particles)
    result = np.empty_like(equations.alone)
    in_threads(
        lambda part: _covariances(equations, correlation, chi2, part.start, result[part]),
        blocks(len(particles), BLOCK),
    )
    return result


def _equations(observation: Observation, particles: NDArray[np.float64]) -> Equations:
    """Return the normal matrix of all particles."""
    slopes = _slopes(observation.optics, particles, observation.capacity)
    neighbours = _overlapping(observation.optics, particles)
    alone = np.zeros((len(particles), UNKNOWNS, UNKNOWNS))
    block = np.zeros((neighbours.other.size, UNKNOWNS, UNKNOWNS))
    in_threads(
        lambda part: _fill_blocks(slopes, neighbours, observation.weight, part.start, alone[part], block),
        blocks(len(particles), BLOCK),
    )
    return Equations(slopes, neighbours, observation.weight, alone, block, np.asarray(np.linalg.inv(alone), np.float64))


def _slopes(view: View, particles: NDArray[np.float64], capacity: int) -> Slopes:
    """Return what each particle's unknowns do to the pixels."""

    def of(part: slice) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
        counts, pixels, values = entries_of(view, particles[part], capacity)
        slope = np.empty(values.shape, np.float32)
        slope[:, :3] = np.repeat(particles[part, 3], counts)[:, np.newaxis] * values[:, 1:]
        slope[:, 3] = values[:, 0]
        return counts, pixels, slope

    parts = in_threads(of, blocks(len(particles), BLOCK))
    counts, pixel, slope = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Slopes(np.concatenate([[0], np.cumsum(counts)]), pixel, slope, view.camera.columns)


def _overlapping(view: View, particles: NDArray[np.float64]) -> Neighbours:
    """Return the particles whose footprints may overlap."""
    on_array = on_array_mm(view, particles)
    # Light that touches a lens's cell spreads over it.
    reach = footprint_radius_mm(view, particles[:, 2]) + 2.0 * max(view.half_x_mm, view.half_y_mm)
    first, second = KDTree(on_array).query_pairs(2.0 * float(reach.max(initial=0.0)), p=np.inf, output_type="ndarray").T
    near = np.abs(on_array[first] - on_array[second]).max(axis=1) < reach[first] + reach[second]
    pairs = np.concatenate([np.stack([first, second]), np.stack([second, first])], axis=1)[:, np.tile(near, 2)]
    pairs = pairs[:, np.lexsort(pairs[::-1])]
    start = np.searchsorted(pairs[0], np.arange(len(particles) + 1))
    return Neighbours(start.astype(np.int64), pairs[1].astype(np.int64))


@njit(cache=True, **COUNT_NO_REFERENCES)
def _rectangle(slopes: Slopes, n: int) -> tuple[int, int, int, int]:
    """Return first row, first column, rows and columns of the rectangle of pixels that a particle lights."""
    begin, end = slopes.start[n], slopes.start[n + 1]
    if begin == end:
        return 0, 0, 0, 0
    top = bottom = slopes.pixel[begin] // slopes.columns
    left = right = slopes.pixel[begin] % slopes.columns
    for k in range(begin, end):
        row, column = slopes.pixel[k] // slopes.columns, slopes.pixel[k] % slopes.columns
        top, bottom, left, right = min(top, row), max(bottom, row), min(left, column), max(right, column)
    return top, left, bottom - top + 1, right - left + 1


@njit(cache=True, nogil=True)
def _fill_blocks(
    slopes: Slopes,
    neighbours: Neighbours,
    weight: NDArray[np.float64],
    first: int,
    alone: NDArray[np.float64],
    block: NDArray[np.float64],
) -> None:
    """Fill J_n^T W J_n (n, 4, 4) of the particles from `first` on, and J_n^T W J_m of neighbours m > n, either way.

    Both from whole pixels: a pixel that two lenses light has one error, and with two it would be less than its
    neighbours' blocks ask for.
    """
    for k in range(alone.shape[0]):
        n = first + k
        top, left, rows, columns = _rectangle(slopes, n)
        own = np.zeros((rows, columns, UNKNOWNS))
        for entry in range(slopes.start[n], slopes.start[n + 1]):
            pixel = slopes.pixel[entry]
            row, column = pixel // slopes.columns - top, pixel % slopes.columns - left
            for a in range(UNKNOWNS):
                own[row, column, a] += weight[pixel] * slopes.slope[entry, a]
        _add_products(slopes, n, own, top, left, alone[k])
        for at in range(neighbours.start[n], neighbours.start[n + 1]):
            m = neighbours.other[at]
            if m > n:
                _add_products(slopes, m, own, top, left, block[at])
                back = neighbours.start[m]
                while neighbours.other[back] != n:
                    back += 1
                block[back] = block[at].T


@njit(cache=True, **COUNT_NO_REFERENCES)
def _add_products(
    slopes: Slopes, m: int, own: NDArray[np.float64], top: int, left: int, block: NDArray[np.float64]
) -> None:
    """Add own^T J_m to a block (4, 4), with `own` on a rectangle of pixels."""
    for k in range(slopes.start[m], slopes.start[m + 1]):
        i, j = slopes.pixel[k] // slopes.columns - top, slopes.pixel[k] % slopes.columns - left
        if 0 <= i < own.shape[0] and 0 <= j < own.shape[1]:
            for a in range(UNKNOWNS):
                for b in range(UNKNOWNS):
                    block[a, b] += own[i, j, a] * slopes.slope[k, b]


@njit(cache=True, nogil=True)
def _covariances(
    equations: Equations, correlation: Correlation, chi2: NDArray[np.float64], first: int, result: NDArray[np.float64]
) -> None:
    """Fill in the covariances of the particles from `first` on.

    Each is the particle's part of the inverse of the normal matrix of itself and its strongest neighbours.
    """
    for k in range(result.shape[0]):
        n = first + k
        members = _strongest(equations, n)
        whole = _normal_matrix(equations, members)
        # Millimetres beside counts: inverted with a diagonal of ones.
        scale = 1.0 / np.sqrt(np.diag(whole))
        _rescale(whole, scale)
        inverse = np.linalg.inv(whole)
        _rescale(inverse, scale)
        excess = max(chi2[n] - 1.0, 0.0)
        for a in range(UNKNOWNS):
            for b in range(UNKNOWNS):
                result[k, a, b] = (1.0 + excess) * inverse[a, b]
        if correlation.share + excess > 0.0:
            moved_by = _moved_by(equations, members, inverse)
            _add_excess(moved_by, correlation.decay, correlation.share + excess, result[k])


@njit(cache=True, **COUNT_NO_REFERENCES)
def _rescale(matrix: NDArray[np.float64], scale: NDArray[np.float64]) -> None:
    """Multiply rows and columns of a matrix by the scales of its unknowns."""
    for i in range(scale.size):
        for j in range(scale.size):
            matrix[i, j] = matrix[i, j] * scale[j] * scale[i]


@njit(cache=True)
def _strongest(equations: Equations, n: int) -> NDArray[np.int64]:
    """Return a particle's number and those of the neighbours that it is tied to most."""
    begin, end = equations.neighbours.start[n], equations.neighbours.start[n + 1]
    strength = np.zeros(end - begin)
    for k in range(end - begin):
        block = equations.block[begin + k]
        strength[k] = _tie(equations.inverses[n], block, equations.inverses[equations.neighbours.other[begin + k]])
    chosen = np.argsort(-strength)[:FREE_NEIGHBOURS]
    members = np.empty(chosen.size + 1, np.int64)
    members[0] = n
    for k in range(chosen.size):
        members[k + 1] = equations.neighbours.other[begin + chosen[k]]
    return members


@njit(cache=True, **COUNT_NO_REFERENCES)
def _tie(one: NDArray[np.float64], block: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return trace(A B C B^T) of matrices (4, 4)."""
    trace = 0.0
    for a in range(UNKNOWNS):
        for d in range(UNKNOWNS):
            left = right = 0.0
            for b in range(UNKNOWNS):
                left += one[a, b] * block[b, d]
                right += other[d, b] * block[a, b]
            trace += left * right
    return trace


@njit(cache=True)
def _moved_by(equations: Equations, members: NDArray[np.int64], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return K (4, rows, columns) of the first member on the rectangle that it lights, its neighbours free."""
    slopes = equations.slopes
    top, left, rows, columns = _rectangle(slopes, members[0])
    moved_by = np.zeros((UNKNOWNS, rows, columns))
    for m in range(members.size):
        for k in range(slopes.start[members[m]], slopes.start[members[m] + 1]):
            i, j = slopes.pixel[k] // slopes.columns - top, slopes.pixel[k] % slopes.columns - left
            if 0 <= i < rows and 0 <= j < columns:
                root = np.sqrt(equations.weight[slopes.pixel[k]])
                for a in range(UNKNOWNS):
                    for b in range(UNKNOWNS):
                        moved_by[a, i, j] += inverse[a, UNKNOWNS * m + b] * slopes.slope[k, b] * root
    return moved_by


@njit(cache=True)
def _add_excess(moved_by: NDArray[np.float64], decay: float, factor: float, result: NDArray[np.float64]) -> None:
    """Add factor K (R - 1) K^T (4, 4) for errors whose correlation falls by `decay` from pixel to pixel."""
    _, rows, columns = moved_by.shape
    for b in range(UNKNOWNS):
        alike = _correlated(_correlated(moved_by[b], decay), decay)
        for a in range(UNKNOWNS):
            total = 0.0
            for i in range(rows):
                for j in range(columns):
                    total += moved_by[a, i, j] * (alike[i, j] - moved_by[b, i, j])
            result[a, b] += factor * total


@njit(cache=True)
def _correlated(values: NDArray[np.float64], decay: float) -> NDArray[np.float64]:
    """Return sum_k decay^|j - k| values[i, k] in row j and column i, by one pass each way."""
    rows, columns = values.shape
    result = np.empty((columns, rows))
    for i in range(rows):
        carried = 0.0
        for j in range(columns):
            carried = carried * decay + values[i, j]
            result[j, i] = carried
        carried = 0.0
        for j in range(columns - 1, -1, -1):
            carried *= decay
            result[j, i] += carried
            carried += values[i, j]
    return result


@njit(cache=True)
def _normal_matrix(equations: Equations, members: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the normal matrix of some particles together."""
    neighbours = equations.neighbours
    size = UNKNOWNS * members.size
    whole = np.zeros((size, size))
    for a in range(members.size):
        n = members[a]
        _put(whole, a, a, equations.alone[n])
        for at in range(neighbours.start[n], neighbours.start[n + 1]):
            for b in range(members.size):
                if neighbours.other[at] == members[b]:
                    _put(whole, a, b, equations.block[at])
    return whole


@njit(cache=True, **COUNT_NO_REFERENCES)
def _put(whole: NDArray[np.float64], a: int, b: int, block: NDArray[np.float64]) -> None:
    """Put the block (4, 4) of two particles into the matrix of some."""
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            whole[UNKNOWNS * a + i, UNKNOWNS * b + j] = block[i, j]
