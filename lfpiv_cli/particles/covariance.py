"""How sure a particle is when its neighbours are not: the joint fit's covariance, one particle at a time.

Particles whose light overlaps give way to each other, so that the inverse of a particle's own normal matrix is too
small an error. The normal matrix of all particles together is sparse; a particle's part of its inverse is taken from
the particle and the neighbours it is tied to most, these free and the others held.

What is left of an image is not white either: a particle that was not found, or found wrongly, leaves the same sign in
pixels side by side. With H the normal matrix, K = H^-1 J^T W^(1/2) is how far each pixel's error moves a particle,
and errors with the correlation R move it by the covariance K R K^T. What a particle's chi-squared exceeds 1 by is not
noise but such a sign: it counts as errors that are all alike.

What the model of light gets wrong is alike within a lens and other in the next. Each lens moves a particle by what it
leaves, sum_p K_p r_p over its pixels; these add up to nothing, and the sum of their squares is the variance that errors
of any kind make which lenses do not share. The more of a lens's errors a fit takes up, the less it leaves to tell them
by: each is divided by the share that it leaves of white noise (cluster-robust errors, as leaving out one lens after the
other makes them: Cameron and Miller, J. Human Resources 50, 2015).

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

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.particles.least_squares import SUMS, UNKNOWNS, Observation, factored, substitute
from lfpiv_cli.particles.noise import Correlation
from lfpiv_cli.particles.normal_equations import (
    BLOCK,
    Equations,
    Slopes,
    all_slopes,
    equations_of,
    most_tied,
    normal_matrix,
    rectangle_of,
)
from lfpiv_cli.particles.view import lens_numbers
from lfpiv_cli.threads import blocks, in_threads

# What of a change particles can make is known to this share.
SMALL_REST = 1e-4
# Of a lens's errors fits are taken to leave this share at least: of fewer hardly any is there to tell.
LEAST_LEFT = 0.25
# What lenses show counts where it exceeds what is stated by more than so many of the standard errors that white noise
# makes it uncertain by, in the mean over x, y and z: of a few lenses it is hardly known.
LENS_SIGMAS = 3.0


class Leftover(NamedTuple):
    """What particles leave of an image, and in which lens.

    Attributes
    ----------
    error : (pixels,) the residual over its standard error
    lens : (rows, columns) number of the lens whose image a pixel is in
    lenses : how many there are
    """

    error: Floats
    lens: NDArray[np.int32]
    lenses: int


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
    equations = equations_of(observation, particles)
    shared = np.zeros((0, observation.weight.size)) if changes is None else np.sqrt(observation.weight) * changes
    pulls = _pulls(equations.slopes, shared, observation.optics.camera.columns)
    lens = lens_numbers(observation.optics)
    rest = Leftover(np.sqrt(observation.weight) * observation.residual, lens, int(lens.max()) + 1)
    result = np.empty_like(equations.alone)
    in_threads(
        lambda part: _covariances(equations, particles, correlation, rest, chi2, pulls, part.start, result[part]),
        blocks(len(particles), BLOCK),
    )
    return result


def change_shown(observation: Observation, particles: Floats, change: Floats) -> tuple[float, float]:
    """Return how much of a change (pixels,) is in what particles (n, 4) leave of an image, and its standard error.

    By least squares with all of them free; 0 and infinite where they can make all of it.
    """
    start, row, column, slope = all_slopes(observation, particles)
    pixel, counts = row.astype(np.int64) * observation.optics.camera.columns + column, np.diff(start)
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


@njit(cache=True, nogil=True)
def _covariances(
    equations: Equations,
    particles: Floats,
    correlation: Correlation,
    rest: Leftover,
    chi2: Floats,
    pulls: Floats,
    first: int,
    result: Floats,
) -> None:
    """Fill in the covariances of the particles from `first` on.

    Each is the particle's part of the inverse of the normal matrix of itself and its strongest neighbours.
    """
    room, places = np.empty(0), np.full((2, rest.lenses), -1)
    for k in range(result.shape[0]):
        n = first + k
        members = most_tied(equations, n)
        whole = normal_matrix(equations, members)
        # Millimetres beside counts: inverted with a diagonal of ones.
        scale = np.empty(whole.shape[0])
        for i in range(scale.size):
            scale[i] = 1.0 / np.sqrt(whole[i, i])
        _rescale(whole, scale)
        lower = np.empty_like(whole)
        inverse = _first_columns(whole, lower)
        _rescale(inverse, scale)
        excess = max(chi2[n] - 1.0, 0.0)
        for a in range(UNKNOWNS):
            for b in range(UNKNOWNS):
                result[k, a, b] = (1.0 + excess) * inverse[a, b]
        top, left, rows, columns = rectangle_of(equations.slopes, n)
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
        on_pixels = (moved_by, (top, left), rest, places)
        result[k] *= _shown_by_lenses(equations.slopes, members, (lower, scale), *on_pixels, result[k])


@njit(cache=True)
def _shown_by_lenses(
    slopes: Slopes,
    members: NDArray[np.int64],
    matrix: tuple[Floats, Floats],
    moved_by: Floats,
    corner: tuple[int, int],
    rest: Leftover,
    places: NDArray[np.int64],
    stated: Floats,
) -> float:
    """Return by what factor what lenses leave shows the variance of a place to be larger than stated, or 1.

    Parameters
    ----------
    matrix : L (4 members, 4 members) of the members' normal matrix, and what its rows and columns are multiplied by
    moved_by : (rows, columns, 4) K on the rectangle of pixels that begins at `corner`
    places : (2, lenses) -1 each, and room for as many numbers
    stated : (4, 4) covariance
    """
    if not stated[0, 0] > 0.0:
        # Not a number, where the matrix has no L.
        return 1.0
    (top, left), (rows, columns, _), count = corner, moved_by.shape, 0
    for i in range(rows):
        for j in range(columns):
            lens = rest.lens[top + i, left + j]
            if moved_by[i, j, 3] != 0.0 and places[0, lens] < 0:
                places[0, lens], places[1, count] = count, lens
                count += 1
    shifts, squares = np.zeros((count, 3)), np.zeros((count, 3))
    for i in range(rows):
        for j in range(columns):
            if moved_by[i, j, 3] != 0.0:
                place = places[0, rest.lens[top + i, left + j]]
                error = rest.error[(top + i) * rest.lens.shape[1] + left + j]
                for a in range(3):
                    shifts[place, a] += moved_by[i, j, a] * error
                    squares[place, a] += moved_by[i, j, a] ** 2
    left_over = squares - _taken_up(slopes, members, matrix, moved_by, corner, rest.lens, places[0], count)
    shown = scatter2 = 0.0
    for a in range(3):
        whole = fourth = 0.0
        for place in range(count):
            square = squares[place, a]
            if square > 0.0:
                shift = shifts[place, a] / max(left_over[place, a] / square, LEAST_LEFT)
                shown += shift * shift / stated[a, a] / 3.0
                whole, fourth = whole + square, fourth + square * square
        if whole > 0.0:
            scatter2 += 2.0 * fourth / whole**2 / 9.0
    for place in range(count):
        places[0, places[1, place]] = -1
    return shown if shown > 1.0 + LENS_SIGMAS * np.sqrt(scatter2) else 1.0


@njit(cache=True)
def _taken_up(
    slopes: Slopes,
    members: NDArray[np.int64],
    matrix: tuple[Floats, Floats],
    moved_by: Floats,
    corner: tuple[int, int],
    lens: NDArray[np.int32],
    places: NDArray[np.int64],
    count: int,
) -> Floats:
    """Return the variance (lenses, 3) by white noise of a place that the fit takes up of each of so many lenses.

    Of lens c with J_c and K_c it is K_c J_c H^-1 J_c^T K_c^T = |L^-1 J_c^T K_c^T|^2. `places` are the lenses' numbers.
    """
    (lower, scale), (top, left), (rows, columns, _) = matrix, corner, moved_by.shape
    carried = np.zeros((scale.size, 3 * count))
    for m in range(members.size):
        for entry in range(slopes.start[members[m]], slopes.start[members[m] + 1]):
            i, j = slopes.row[entry] - top, slopes.column[entry] - left
            if 0 <= i < rows and 0 <= j < columns and moved_by[i, j, 3] != 0.0:
                first = 3 * places[lens[top + i, left + j]]
                for b in range(UNKNOWNS):
                    slope = scale[UNKNOWNS * m + b] * slopes.slope[entry, b]
                    for a in range(3):
                        carried[UNKNOWNS * m + b, first + a] += slope * moved_by[i, j, a]
    taken = np.zeros((count, 3))
    for i in range(scale.size):
        for j in range(i):
            for k in range(carried.shape[1]):
                carried[i, k] -= lower[i, j] * carried[j, k]
        for k in range(carried.shape[1]):
            carried[i, k] /= lower[i, i]
            taken[k // 3, k % 3] += carried[i, k] ** 2
    return taken


@njit(cache=True)
def _first_columns(matrix: Floats, lower: Floats) -> Floats:
    """Return the first columns of a matrix's inverse as rows (4, n), and fill its L; NaN if not positive definite."""
    size = matrix.shape[0]
    one, columns = np.zeros(size), np.full((UNKNOWNS, size), np.nan)
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
