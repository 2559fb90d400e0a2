"""The normal equations of all particles of an image together, block by block.

With J the slopes of all pixels by all unknowns and W the weights, J^T W J is sparse: particles share pixels with their
neighbours alone.

Axes: image axes, mm; see `fitting`. A particle's unknowns are x, y, z and light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.particles.least_squares import SUMS, UNKNOWNS, Observation, lit_by, room_for
from lfpiv_cli.particles.view import footprint_radius_mm, on_array_mm
from lfpiv_cli.threads import blocks, in_threads

# Neighbours that are left free: with twice as many the errors of 8,300 particles change by a thousandth.
FREE_NEIGHBOURS = 12
# Particles that one thread takes at a time.
BLOCK = 64


class Slopes(NamedTuple):
    """What each particle's unknowns do to the pixels.

    Attributes
    ----------
    start : (n + 1,) where each particle's entries begin
    row, column : (entries,) of the pixel
    slope : (entries, 4) change of the pixel by x, y, z and light, over its standard error
    """

    start: NDArray[np.int64]
    row: NDArray[np.int32]
    column: NDArray[np.int32]
    slope: NDArray[np.float32]


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
    alone : (n, 4, 4) the blocks of single particles
    block : (2 pairs, 4, 4) those of particles and their neighbours
    inverses : (n, 4, 4) of `alone`
    """

    slopes: Slopes
    neighbours: Neighbours
    alone: Floats
    block: Floats
    inverses: Floats


def equations_of(observation: Observation, particles: Floats) -> Equations:
    """Return the normal matrix of all particles."""
    slopes = all_slopes(observation, particles)

    # Particles whose footprints may overlap: light that touches a lens's cell spreads over it.
    view = observation.optics
    on_array = on_array_mm(view, particles)
    reach = footprint_radius_mm(view, particles) + 2.0 * max(view.half_x_mm, view.half_y_mm)
    first, second = KDTree(on_array).query_pairs(2.0 * float(reach.max(initial=0.0)), p=np.inf, output_type="ndarray").T
    near = np.abs(on_array[first] - on_array[second]).max(axis=1) < reach[first] + reach[second]
    pairs = np.concatenate([np.stack([first, second]), np.stack([second, first])], axis=1)[:, np.tile(near, 2)]
    pairs = pairs[:, np.lexsort(pairs[::-1])]
    start = np.searchsorted(pairs[0], np.arange(len(particles) + 1))
    neighbours = Neighbours(start.astype(np.int64), pairs[1].astype(np.int64))

    alone = np.zeros((len(particles), UNKNOWNS, UNKNOWNS))
    block = np.zeros((neighbours.other.size, UNKNOWNS, UNKNOWNS))
    in_threads(
        lambda part: _fill_blocks(slopes, neighbours, part.start, alone[part], block),
        blocks(len(particles), BLOCK),
    )
    return Equations(slopes, neighbours, alone, block, np.asarray(np.linalg.inv(alone), np.float64))


def all_slopes(observation: Observation, particles: Floats) -> Slopes:
    """Return what the unknowns of particles (n, 4) do to the pixels."""
    parts = in_threads(lambda part: _slopes_of(observation, particles[part]), blocks(len(particles), BLOCK))
    counts, row, column, slope = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Slopes(np.concatenate([[0], np.cumsum(counts)]), row, column, slope)


@njit(cache=True, nogil=True)
def _slopes_of(
    observation: Observation, particles: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Return the number of entries of each particle, and rows, columns and slopes of all."""
    count, capacity, columns = particles.shape[0], observation.capacity, observation.optics.camera.columns
    responses = room_for(1, capacity, 0)
    counts = np.zeros(count, np.int64)
    row, column = np.empty(count * capacity, np.int32), np.empty(count * capacity, np.int32)
    slope = np.empty((count * capacity, UNKNOWNS), np.float32)
    end = 0
    for n in range(count):
        observation.respond(observation.optics, particles[n : n + 1], responses)
        pixels, values = lit_by(responses, 0)
        for k in range(pixels.size):
            # A pixel that is named again has no light.
            if values[0, k] > 0.0:
                root = np.sqrt(observation.weight[pixels[k]])
                row[end], column[end] = divmod(pixels[k], columns)
                for unknown in range(3):
                    slope[end, unknown] = root * particles[n, 3] * values[1 + unknown, k]
                slope[end, 3] = root * values[0, k]
                counts[n] += 1
                end += 1
    return counts, row[:end].copy(), column[:end].copy(), slope[:end].copy()


@njit(cache=True, **COUNT_NO_REFERENCES)
def rectangle_of(slopes: Slopes, n: int) -> tuple[int, int, int, int]:
    """Return first row, first column, rows and columns of the rectangle of pixels that a particle lights."""
    begin, end = slopes.start[n], slopes.start[n + 1]
    if begin == end:
        return 0, 0, 0, 0
    top, left = slopes.row[begin], slopes.column[begin]
    bottom, right = top, left
    for k in range(begin, end):
        top, bottom = min(top, slopes.row[k]), max(bottom, slopes.row[k])
        left, right = min(left, slopes.column[k]), max(right, slopes.column[k])
    return top, left, bottom - top + 1, right - left + 1


@njit(cache=True, nogil=True)
def _fill_blocks(slopes: Slopes, neighbours: Neighbours, first: int, alone: Floats, block: Floats) -> None:
    """Fill J_n^T W J_n (n, 4, 4) of the particles from `first` on, and J_n^T W J_m of neighbours m > n, either way.

    Both from whole pixels: a pixel that two lenses light has one error, and with two it would be less than its
    neighbours' blocks ask for.
    """
    # Footprints have holes, and hardly half of the neighbours share a pixel: first which, then what they do to them.
    room = np.empty(0, np.int32)
    for k in range(alone.shape[0]):
        n = first + k
        top, left, rows, columns = rectangle_of(slopes, n)
        if room.size < rows * columns:
            room = np.empty(rows * columns, np.int32)
        number = room[: rows * columns].reshape(rows, columns)
        number[:] = -1
        for entry in range(slopes.start[n], slopes.start[n + 1]):
            number[slopes.row[entry] - top, slopes.column[entry] - left] = entry - slopes.start[n]
        # One more, as the last may be written in vain.
        common = np.empty((2, slopes.start[n + 1] - slopes.start[n] + 1), np.int64)
        _set_products(slopes, n, n, common[:, : _find_common(slopes, n, number, top, left, common)], alone[k])
        for at in range(neighbours.start[n], neighbours.start[n + 1]):
            m = neighbours.other[at]
            if m > n:
                count = _find_common(slopes, m, number, top, left, common)
                _set_products(slopes, n, m, common[:, :count], block[at])
                back = neighbours.start[m]
                while neighbours.other[back] != n:
                    back += 1
                for a in range(UNKNOWNS):
                    for b in range(UNKNOWNS):
                        block[back, a, b] = block[at, b, a]


@njit(cache=True, **COUNT_NO_REFERENCES)
def _find_common(
    slopes: Slopes, m: int, number: NDArray[np.int32], top: int, left: int, common: NDArray[np.int64]
) -> int:
    """Fill in which entries of one particle and of m share a pixel; return how many.

    `number` (rows, columns) are those of the first one's entries on a rectangle of pixels, -1 where it has none.
    """
    rows, columns = number.shape
    count = 0
    for k in range(slopes.start[m + 1] - slopes.start[m]):
        i, j = slopes.row[slopes.start[m] + k] - top, slopes.column[slopes.start[m] + k] - left
        if 0 <= i < rows and 0 <= j < columns:
            # Written before it is known whether it counts: whether a pixel is lit is hard to foresee.
            common[0, count], common[1, count] = number[i, j], k
            count += int(number[i, j] >= 0)
    return count


@njit(cache=True, fastmath=SUMS, **COUNT_NO_REFERENCES)
def _set_products(slopes: Slopes, n: int, m: int, common: NDArray[np.int64], block: Floats) -> None:
    """Set a block (4, 4) to J_n^T J_m, from the entries (2, k) that share a pixel."""
    # Kept out of arrays, sums stay in registers.
    m00 = m01 = m02 = m03 = m10 = m11 = m12 = m13 = 0.0
    m20 = m21 = m22 = m23 = m30 = m31 = m32 = m33 = 0.0
    of_n, of_m = slopes.slope[slopes.start[n] :], slopes.slope[slopes.start[m] :]
    for k in range(common.shape[1]):
        at, other = common[0, k], common[1, k]
        a, b = np.float64(of_n[at, 0]), np.float64(of_n[at, 1])
        c, d = np.float64(of_n[at, 2]), np.float64(of_n[at, 3])
        e, f = np.float64(of_m[other, 0]), np.float64(of_m[other, 1])
        g, h = np.float64(of_m[other, 2]), np.float64(of_m[other, 3])
        m00 += a * e
        m01 += a * f
        m02 += a * g
        m03 += a * h
        m10 += b * e
        m11 += b * f
        m12 += b * g
        m13 += b * h
        m20 += c * e
        m21 += c * f
        m22 += c * g
        m23 += c * h
        m30 += d * e
        m31 += d * f
        m32 += d * g
        m33 += d * h
    block[0, 0], block[0, 1], block[0, 2], block[0, 3] = m00, m01, m02, m03
    block[1, 0], block[1, 1], block[1, 2], block[1, 3] = m10, m11, m12, m13
    block[2, 0], block[2, 1], block[2, 2], block[2, 3] = m20, m21, m22, m23
    block[3, 0], block[3, 1], block[3, 2], block[3, 3] = m30, m31, m32, m33


@njit(cache=True)
def most_tied(equations: Equations, n: int) -> NDArray[np.int64]:
    """Return a particle's number and those of the neighbours that it is tied to most."""
    begin, end = equations.neighbours.start[n], equations.neighbours.start[n + 1]
    strength = np.zeros(end - begin)
    for k in range(end - begin):
        block = equations.block[begin + k]
        strength[k] = _tie(equations.inverses[n], block, equations.inverses[equations.neighbours.other[begin + k]])
    members = np.empty(1 + min(FREE_NEIGHBOURS, strength.size), np.int64)
    members[0] = n
    # One after the other: sorting takes seconds to compile.
    for place in range(1, members.size):
        strongest = 0
        for k in range(1, strength.size):
            if strength[k] > strength[strongest]:
                strongest = k
        members[place] = equations.neighbours.other[begin + strongest]
        strength[strongest] = -np.inf
    return members


@njit(cache=True, **COUNT_NO_REFERENCES)
def _tie(one: Floats, block: Floats, other: Floats) -> float:
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
def normal_matrix(equations: Equations, members: NDArray[np.int64]) -> Floats:
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
def _put(whole: Floats, a: int, b: int, block: Floats) -> None:
    """Put the block (4, 4) of two particles into the matrix of some."""
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            whole[UNKNOWNS * a + i, UNKNOWNS * b + j] = block[i, j]
