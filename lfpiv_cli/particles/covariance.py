"""How sure a particle is when its neighbours are not: the joint fit's covariance, one particle at a time.

Particles whose light overlaps give way to each other, so that the inverse of a particle's own normal matrix is too
small an error. The normal matrix of all particles together is sparse; a particle's part of its inverse is taken from
the particle and the neighbours it is tied to most, these free and the others held.

What is left of an image is not white either: a particle that was not found, or found wrongly, leaves the same sign in
pixels side by side. With H the normal matrix, K = H^-1 J^T W^(1/2) is how far each pixel's error moves a particle,
and errors with the correlation R move it by the covariance K R K^T. What a particle's chi-squared exceeds 1 by is not
noise but such a sign: it counts as errors that are all alike.

Two particles whose light is hardly distinguished may share it otherwise: with I the light of one, d how far they are
apart and c the covariance of their light, it moves by -c / I^2 d, of second order in what their light is uncertain by.

What is wrong with the light of all particles together, as their size is, moves each by -H^-1 J^T W d with d what the
image changes by.

Axes: image axes, mm; see `fitting`. A particle's unknowns are x, y, z and light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsmr
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.particles.least_squares import (
    SUMS,
    UNKNOWNS,
    Observation,
    factored,
    lit_by,
    room_for,
    substitute,
)
from lfpiv_cli.particles.noise import Correlation
from lfpiv_cli.particles.view import footprint_radius_mm, on_array_mm
from lfpiv_cli.threads import blocks, in_threads

# Neighbours that are left free: with twice as many the errors of 8,300 particles change by a thousandth.
FREE_NEIGHBOURS = 12
# Particles that one thread takes at a time.
BLOCK = 64
# What of a change particles can make is known to this share.
SMALL_REST = 1e-4


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


def joint_covariance(
    observation: Observation, particles: Floats, correlation: Correlation, chi2: Floats, changes: Floats | None = None
) -> Floats:
    """Return the covariance (n, 4, 4) of each particle with its neighbours free.

    Parameters
    ----------
    particles : (n, 4)
    correlation : of the pixels' errors, and how it falls with distance for errors that are alike
    chi2 : (n,) local chi-squared, 1 where the weights say all
    changes : (k, pixels) what the image changes by with each independent error that all particles share; None: there
        are none
    """
    equations = _equations(observation, particles)
    shared = np.zeros((0, observation.weight.size)) if changes is None else np.sqrt(observation.weight) * changes
    pulls = _pulls(equations.slopes, shared, observation.optics.camera.columns)
    result = np.empty_like(equations.alone)
    in_threads(
        lambda part: _covariances(equations, particles, correlation, chi2, pulls, part.start, result[part]),
        blocks(len(particles), BLOCK),
    )
    return result


def change_shown(observation: Observation, particles: Floats, change: Floats) -> tuple[float, float]:
    """Return how much of a change (pixels,) is in what particles (n, 4) leave of an image, and its standard error.

    By least squares with all of them free; 0 and infinite where they can make all of it.
    """
    counts, pixel, slope = _all_slopes(observation, particles)
    root, first = np.sqrt(observation.weight), UNKNOWNS * np.repeat(np.arange(len(counts)), counts)
    unknown = (first[:, np.newaxis] + np.arange(UNKNOWNS)).ravel()
    # Millimetres beside counts: columns of length one.
    length = np.sqrt(np.bincount(unknown, np.square(slope, dtype=np.float64).ravel(), UNKNOWNS * len(counts)))
    entries = slope.ravel() / np.maximum(length[unknown], np.finfo(np.float64).tiny)
    slopes = csr_array((entries, (np.repeat(pixel, UNKNOWNS), unknown)), (root.size, length.size))
    beside, rest = (
        each - slopes @ lsmr(slopes, each, atol=SMALL_REST, btol=SMALL_REST)[0]
        for each in (root * change, root * observation.residual)
    )
    information, freedom = float(beside @ beside), np.count_nonzero(root) - length.size - 1
    if not information > 0.0 or freedom < 1:
        return 0.0, np.inf
    scatter = max(float(rest @ rest) / freedom, 1.0)
    return float(beside @ rest) / information, float(np.sqrt(scatter / information))


def _equations(observation: Observation, particles: Floats) -> Equations:
    """Return the normal matrix of all particles."""
    counts, pixel, slope = _all_slopes(observation, particles)
    row, column = np.divmod(pixel, observation.optics.camera.columns, dtype=np.int32)
    slopes = Slopes(np.concatenate([[0], np.cumsum(counts)]), row, column, slope)

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


def _all_slopes(
    observation: Observation, particles: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """Return what `_slopes_of` does, particles shared out to threads."""
    parts = in_threads(lambda part: _slopes_of(observation, particles[part]), blocks(len(particles), BLOCK))
    counts, pixel, slope = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return counts, pixel, slope


@njit(cache=True, nogil=True)
def _slopes_of(
    observation: Observation, particles: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """Return the number of entries of each particle, and the pixels and slopes of all."""
    count, capacity = particles.shape[0], observation.capacity
    responses = room_for(1, capacity, 0)
    counts = np.zeros(count, np.int64)
    pixel, slope = np.empty(count * capacity, np.int32), np.empty((count * capacity, UNKNOWNS), np.float32)
    end = 0
    for n in range(count):
        observation.respond(observation.optics, particles[n : n + 1], responses)
        pixels, values = lit_by(responses, 0)
        for k in range(pixels.size):
            # A pixel that is named again has no light.
            if values[0, k] > 0.0:
                root = np.sqrt(observation.weight[pixels[k]])
                pixel[end] = pixels[k]
                for unknown in range(3):
                    slope[end, unknown] = root * particles[n, 3] * values[1 + unknown, k]
                slope[end, 3] = root * values[0, k]
                counts[n] += 1
                end += 1
    return counts, pixel[:end].copy(), slope[:end].copy()


@njit(cache=True)
def _pulls(slopes: Slopes, changes: Floats, columns: int) -> Floats:
    """Return J_n^T W^(1/2) d (n, 4, k) of each particle and each of the changes d (k, pixels), in standard errors."""
    pulls = np.zeros((slopes.start.size - 1, UNKNOWNS, changes.shape[0]))
    for n in range(pulls.shape[0]):
        for entry in range(slopes.start[n], slopes.start[n + 1]):
            pixel = np.int64(slopes.row[entry]) * columns + slopes.column[entry]
            for i in range(UNKNOWNS):
                for k in range(changes.shape[0]):
                    pulls[n, i, k] += slopes.slope[entry, i] * changes[k, pixel]
    return pulls


@njit(cache=True, **COUNT_NO_REFERENCES)
def _rectangle(slopes: Slopes, n: int) -> tuple[int, int, int, int]:
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
        top, left, rows, columns = _rectangle(slopes, n)
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


@njit(cache=True, nogil=True)
def _covariances(
    equations: Equations,
    particles: Floats,
    correlation: Correlation,
    chi2: Floats,
    pulls: Floats,
    first: int,
    result: Floats,
) -> None:
    """Fill in the covariances of the particles from `first` on.

    Each is the particle's part of the inverse of the normal matrix of itself and its strongest neighbours.
    """
    room = np.empty(0)
    for k in range(result.shape[0]):
        n = first + k
        members = _strongest(equations, n)
        whole = _normal_matrix(equations, members)
        # Millimetres beside counts: inverted with a diagonal of ones.
        scale = np.empty(whole.shape[0])
        for i in range(scale.size):
            scale[i] = 1.0 / np.sqrt(whole[i, i])
        _rescale(whole, scale)
        inverse = _first_columns(whole)
        _rescale(inverse, scale)
        excess = max(chi2[n] - 1.0, 0.0)
        for a in range(UNKNOWNS):
            for b in range(UNKNOWNS):
                result[k, a, b] = (1.0 + excess) * inverse[a, b]
        if correlation.share + excess > 0.0:
            top, left, rows, columns = _rectangle(equations.slopes, n)
            # Large arrays take long to make.
            if room.size < rows * columns * UNKNOWNS:
                room = np.empty(rows * columns * UNKNOWNS)
            moved_by = room[: rows * columns * UNKNOWNS].reshape(rows, columns, UNKNOWNS)
            moved_by[:] = 0.0
            for m in range(members.size):
                of_m = inverse[:, UNKNOWNS * m : UNKNOWNS * (m + 1)]
                _add_moves(equations.slopes, members[m], of_m, top, left, moved_by)
            _add_excess(moved_by, correlation.decay, correlation.share + excess, result[k])
        # Light that one particle has and may be another's takes its place along, which slopes do not show.
        for m in range(1, members.size):
            taken = min(max(-inverse[3, UNKNOWNS * m + 3], 0.0) / particles[n, 3] ** 2, 1.0)
            for a in range(3):
                for b in range(3):
                    far = (particles[members[m], a] - particles[n, a]) * (particles[members[m], b] - particles[n, b])
                    result[k, a, b] += taken * taken * far
        # What errors that all particles share move it by.
        for shared in range(pulls.shape[2]):
            moved = np.zeros(UNKNOWNS)
            for m in range(members.size):
                for a in range(UNKNOWNS):
                    for b in range(UNKNOWNS):
                        moved[a] += inverse[a, UNKNOWNS * m + b] * pulls[members[m], b, shared]
            for a in range(UNKNOWNS):
                for b in range(UNKNOWNS):
                    result[k, a, b] += moved[a] * moved[b]


@njit(cache=True)
def _first_columns(matrix: Floats) -> Floats:
    """Return the first columns of a matrix's inverse as rows (4, n); not numbers where it is not positive definite."""
    size = matrix.shape[0]
    lower, one, columns = np.empty((size, size)), np.zeros(size), np.full((UNKNOWNS, size), np.nan)
    if factored(matrix, 0.0, lower):
        for i in range(UNKNOWNS):
            one[i] = 1.0
            substitute(lower, one, columns[i])
            one[i] = 0.0
    return columns


@njit(cache=True, **COUNT_NO_REFERENCES)
def _rescale(matrix: Floats, scale: Floats) -> None:
    """Multiply the first rows and all columns of a matrix by the scales of its unknowns."""
    for i in range(matrix.shape[0]):
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


@njit(cache=True, **COUNT_NO_REFERENCES)
def _add_moves(slopes: Slopes, m: int, inverse: Floats, top: int, left: int, moved_by: Floats) -> None:
    """Add to K (rows, columns, 4) what one member's slopes do to it, by its part (4, 4) of the inverse."""
    rows, columns = moved_by.shape[0], moved_by.shape[1]
    for k in range(slopes.start[m], slopes.start[m + 1]):
        i, j = slopes.row[k] - top, slopes.column[k] - left
        if 0 <= i < rows and 0 <= j < columns:
            e, f, g, h = slopes.slope[k, 0], slopes.slope[k, 1], slopes.slope[k, 2], slopes.slope[k, 3]
            for a in range(UNKNOWNS):
                moved_by[i, j, a] += inverse[a, 0] * e + inverse[a, 1] * f + inverse[a, 2] * g + inverse[a, 3] * h


@njit(cache=True, fastmath=SUMS)
def _add_excess(moved_by: Floats, decay: float, factor: float, result: Floats) -> None:
    """Add factor K (R - 1) K^T (4, 4) for errors whose correlation falls by `decay` from pixel to pixel.

    Along an axis, sum_jk decay^|j - k| a_j b_k = (1 - decay^2) sum_n A_n B_n with A_n = sum_(k <= n) decay^(n - k) a_k,
    n going on behind the last pixel, where A falls by `decay` each step.
    """
    rows, columns, _ = moved_by.shape
    inner = 1.0 - decay * decay
    carried = np.zeros((columns, UNKNOWNS))
    m00 = m01 = m02 = m03 = m11 = m12 = m13 = m22 = m23 = m33 = 0.0
    for i in range(rows):
        of_row = 1.0 if i == rows - 1 else inner
        a = b = c = d = 0.0
        for j in range(columns):
            weight = of_row if j == columns - 1 else of_row * inner
            e, f, g, h = moved_by[i, j, 0], moved_by[i, j, 1], moved_by[i, j, 2], moved_by[i, j, 3]
            a, b, c, d = decay * a + e, decay * b + f, decay * c + g, decay * d + h
            p, q = decay * carried[j, 0] + a, decay * carried[j, 1] + b
            r, t = decay * carried[j, 2] + c, decay * carried[j, 3] + d
            carried[j, 0], carried[j, 1], carried[j, 2], carried[j, 3] = p, q, r, t
            m00 += weight * p * p - e * e
            m01 += weight * p * q - e * f
            m02 += weight * p * r - e * g
            m03 += weight * p * t - e * h
            m11 += weight * q * q - f * f
            m12 += weight * q * r - f * g
            m13 += weight * q * t - f * h
            m22 += weight * r * r - g * g
            m23 += weight * r * t - g * h
            m33 += weight * t * t - h * h
    excess = np.array([[m00, m01, m02, m03], [m01, m11, m12, m13], [m02, m12, m22, m23], [m03, m13, m23, m33]])
    result += factor * excess


@njit(cache=True)
def _normal_matrix(equations: Equations, members: NDArray[np.int64]) -> Floats:
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
