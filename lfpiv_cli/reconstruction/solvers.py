"""Iterative solvers of sum_j w_ij E_j = I_i (Eq. 11) for a non-negative volume E.

A solver is a function `step(problem, volume, projection, relaxation) -> volume`; the loop in `reconstruct` owns the
iterations and hands each step the projection of the current volume, which also gives the residual. To add a solver:
write its step, name it in `registry.SOLVERS`, and test it; that a true volume is a fixed point and that the residual
falls is tested for all.

Axes: volumes [z, y, x], images [row, column], float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.kernels import njit
from lfpiv_cli.names import Start
from lfpiv_cli.neighbourhoods import with_neighbours
from lfpiv_cli.reconstruction.images import noise_residual
from lfpiv_cli.reconstruction.registry import SOLVERS
from lfpiv_cli.robust import BRIGHTEST_PERCENTILE, LIT_SHARE
from lfpiv_cli.threads import share_out

Volume = Singles
Image = Singles

# The equations of one image, and who takes part in them.
#
# A pixel is left out by a row sum of zero, a voxel by a column sum of zero: saturated pixels, those behind a
# reflection, voxels that no light can have come from. Solvers then give what they would give with those rows and
# columns deleted.

# Row and column sums below this share of the largest one belong to pixels or voxels that are all but unseen (a sliver
# of the sensor or of the aperture's rim); they stay out of the equations instead of being divided by.
SMALLEST_SUM = 1e-4


class Operator(Protocol):
    """What a solver needs of the weights."""

    @property
    def shape(self) -> tuple[int, int, int]: ...

    def forward(self, volume: Volume) -> Image: ...

    def adjoint(self, image: Image) -> Volume: ...


@dataclass(frozen=True, eq=False)
class Normalisers:
    """Guarded inverses of the row and column sums, the denominators of Eq. 12.

    Attributes
    ----------
    inverse_row_sum : (rows, columns) 1 / sum_n w_in over the voxels that take part, 0 for pixels that take no part
    inverse_column_sum : (z, y, x) 1 / sum_i w_ij over the pixels that take part, 0 for voxels that take no part
    """

    inverse_row_sum: Image
    inverse_column_sum: Volume

    def without(self, operator: Operator, excluded: Flags) -> Normalisers:
        """Return the sums with more pixels (rows, columns) left out."""
        inverse_row_sum = np.where(excluded, np.float32(0.0), self.inverse_row_sum)
        return _with_columns(operator, inverse_row_sum, self.inverse_column_sum > 0.0)

    def within(self, operator: Operator, support: Flags) -> Normalisers:
        """Return the sums with only the voxels of a support (z, y, x), and with the pixels that these reach."""
        support = support & (self.inverse_column_sum > 0.0)
        inverse_row_sum = _guarded_inverse(operator.forward(support.astype(np.float32)))
        inverse_row_sum[self.inverse_row_sum == 0.0] = 0.0
        return _with_columns(operator, inverse_row_sum, support)


@dataclass(frozen=True, eq=False)
class Problem:
    """The equations of one image.

    Attributes
    ----------
    operator : the weights
    image : (rows, columns) >= 0, in the weights' frame; 0 where a pixel takes no part
    sums : who takes part
    """

    operator: Operator
    image: Image
    sums: Normalisers

    @classmethod
    def of(cls, operator: Operator, image: Image, sums: Normalisers) -> Problem:
        """Return the problem of an image whose noise may be negative and whose pixels may not all take part."""
        taking_part = sums.inverse_row_sum > 0.0
        lit = np.maximum(image, 0.0, dtype=np.float32)
        lit[~taking_part] = 0.0
        return cls(operator, lit, sums)


def normalisers(operator: Operator, excluded: Flags | None = None) -> Normalisers:
    """Return the sums of the weights, without the pixels (rows, columns) that are excluded."""
    inverse_row_sum = _guarded_inverse(operator.forward(np.ones(operator.shape, np.float32)))
    if excluded is not None:
        inverse_row_sum[excluded] = 0.0
    return _with_columns(operator, inverse_row_sum, np.ones(operator.shape, np.bool_))


def _with_columns(operator: Operator, inverse_row_sum: Image, voxels: Flags) -> Normalisers:
    """Return the sums for pixels that take part as `inverse_row_sum` says, and for voxels (z, y, x) that may."""
    column_sum = operator.adjoint((inverse_row_sum > 0.0).astype(np.float32))
    return Normalisers(inverse_row_sum, np.where(voxels, _guarded_inverse(column_sum), np.float32(0.0)))


def _guarded_inverse(sums: Singles) -> Singles:
    """Return 1 / sums, 0 where a sum is negligible beside the largest."""
    limit = SMALLEST_SUM * float(sums.max(initial=0.0))
    return np.divide(np.float32(1.0), sums, out=np.zeros_like(sums), where=sums > limit)


# Volumes to start from: uniform, or what the lines of sight allow.

# A voxel can be lit when this share of its weights lies on lit pixels or their neighbours. Noise and a voxel's width
# cost some: of nine tenths, voxels as wide as a microlens keep so few that a twentieth more of the image is left
# unexplained.
SEEN_SHARE = 0.8


def uniform_start(problem: Problem) -> Volume:
    """Return the constant volume (z, y, x) that has the image's light, 0 for voxels that take no part."""
    return scaled_to_light(problem, (problem.sums.inverse_column_sum > 0.0).astype(np.float32))


def line_of_sight_start(problem: Problem) -> Volume:
    """Return the geometric mean of what a voxel's pixels allow it (z, y, x), with the image's light.

    What pixel i allows is I_i over its row sum; dark pixels count as lit by `LIT_SHARE` of the brightest, or a single
    one of noise would put out every voxel that it sees.
    """
    level = problem.image * problem.sums.inverse_row_sum
    floor = np.float32(LIT_SHARE * _brightest(level, problem.sums))
    if floor <= 0.0:
        return np.zeros(problem.operator.shape, np.float32)
    exponent = np.where(problem.sums.inverse_row_sum > 0.0, np.log(np.maximum(level / floor, 1.0)), np.float32(0.0))
    mean = problem.operator.adjoint(exponent) * problem.sums.inverse_column_sum
    return scaled_to_light(problem, np.where(problem.sums.inverse_column_sum > 0.0, np.exp(mean), np.float32(0.0)))


def lit_support(operator: Operator, image: Image, sums: Normalisers) -> Flags:
    """Return which voxels (z, y, x) have nearly all of their weight on lit pixels or their neighbours."""
    taking_part = sums.inverse_row_sum > 0.0
    lit = taking_part & with_neighbours(image > LIT_SHARE * _brightest(image, sums))
    return np.asarray(operator.adjoint(lit.astype(np.float32)) * sums.inverse_column_sum >= SEEN_SHARE)


def scaled_to_light(problem: Problem, volume: Volume) -> Volume:
    """Return a volume (z, y, x) scaled so that it sends as much light to the pixels that take part as they show."""
    seen = problem.sums.inverse_column_sum > 0.0
    sent = np.sum(volume[seen] / problem.sums.inverse_column_sum[seen], dtype=np.float64)
    factor = np.sum(problem.image, dtype=np.float64) / sent if sent > 0.0 else 0.0
    return volume * np.float32(factor)


def _brightest(image: Image, sums: Normalisers) -> float:
    """Return the brightness of the brightest pixels that take part, 0 where there are none."""
    values = image[sums.inverse_row_sum > 0.0]
    return float(np.percentile(values, BRIGHTEST_PERCENTILE)) if values.size else 0.0


# What solvers do with whole images, in one pass over the pixels each.
#
# An image has more pixels than a small volume has voxels; array by array these passes cost more than its weights.
# Pixels whose inverse row sum is 0 take no part.


@njit(cache=True, nogil=True)
def write_correction(
    part: tuple[int, int], image: Image, projection: Image, inverse_row_sum: Image, result: Image
) -> None:
    """Write rows `part` of (I - W E) / sum_n w_in, the correction of Eq. 12."""
    for row in range(part[0], part[1]):
        for column in range(image.shape[1]):
            difference = image[row, column] - projection[row, column]
            result[row, column] = difference * inverse_row_sum[row, column]


@njit(cache=True, nogil=True)
def write_ratio(part: tuple[int, int], image: Image, projection: Image, inverse_row_sum: Image, result: Image) -> None:
    """Write rows `part` of I / W E, 0 where the volume does not light a pixel or it takes no part."""
    for row in range(part[0], part[1]):
        for column in range(image.shape[1]):
            seen = projection[row, column] > 0.0 and inverse_row_sum[row, column] > 0.0
            result[row, column] = image[row, column] / projection[row, column] if seen else np.float32(0.0)


@njit(cache=True, nogil=True)
def write_square_differences(
    part: tuple[int, int], image: Image, projection: Image, inverse_row_sum: Image, result: Floats
) -> None:
    """Write the sums of (I - W E)^2 of rows `part`, so that their sum has the same bits for any threads."""
    for row in range(part[0], part[1]):
        total = 0.0
        for column in range(image.shape[1]):
            if inverse_row_sum[row, column] > 0.0:
                difference = np.float64(image[row, column] - projection[row, column])
                total += difference * difference
        result[row] = total


# MART takes the pixels in this many by this many interleaved blocks; neighbours, which see the same voxels, apart.
MART_BLOCKS = 4
# A pixel darker than this share of what the volume sends it counts as so dark: one of zero would put out, at once and
# for good, every voxel that it sees.
SMALLEST_RATIO = 1e-2


@dataclass(frozen=True)
class Stopping:
    """When to end before all iterations are done.

    Attributes
    ----------
    change : end when an iteration lowers the residual by less than this share of it; None: never
    residual : end when the relative residual is this small; None: never
    noise : end when the residual is this many times that of an image's noise, as what remains is noise; None: never
    photons_per_count : to know light's own noise; None: only read noise is known
    """

    change: float | None = None
    residual: float | None = None
    noise: float | None = None
    photons_per_count: float | None = None

    def for_image(self, image: Image) -> Stopping:
        """Return when to end with an image (rows, columns), its noise told as a residual."""
        if self.noise is None:
            return self
        return replace(self, residual=self.noise * noise_residual(image, self.photons_per_count), noise=None)

    def reached(self, residual: Floats) -> bool:
        """Return whether the residuals (n,) of the iterations so far are the last ones needed."""
        if self.residual is not None and residual[-1] <= self.residual:
            return True
        if self.change is None or residual.size < 2:
            return False
        return bool(residual[-2] - residual[-1] <= self.change * residual[-2])


ALL_ITERATIONS = Stopping()


@dataclass(frozen=True)
class SolverSettings:
    """How to solve.

    Attributes
    ----------
    solver : name in `registry.SOLVERS`
    iterations : at most
    relaxation : of each step
    accelerate : step from points that are `extrapolated`, at the cost of three passes over the volume
    start : `uniform` (the paper), or `line_of_sight`, which also leaves voxels out for good
    stopping : when to end before all iterations are done
    """

    solver: str
    iterations: int
    relaxation: float = 1.0
    accelerate: bool = False
    start: Start = "uniform"
    stopping: Stopping = ALL_ITERATIONS


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A volume (z, y, x) and how it came about.

    Attributes
    ----------
    residual : (iterations + 1,) relative residual ||I - W E|| / ||I||, at the start of each step and of the volume
    support_voxels : how many voxels took part
    """

    volume: Volume
    residual: Floats
    support_voxels: int


def sart_step(problem: Problem, volume: Volume, projection: Image, relaxation: float) -> Volume:
    """Return the volume after one step of SART, all pixels at once (Eq. 12), kept non-negative."""
    image, change = problem.image, np.empty(problem.image.shape, np.float32)
    share_out(write_correction, len(image), image, projection, problem.sums.inverse_row_sum, change)
    update = problem.operator.adjoint(change) * problem.sums.inverse_column_sum
    return np.maximum(volume + np.float32(relaxation) * update, np.float32(0.0))


def em_step(problem: Problem, volume: Volume, projection: Image, relaxation: float) -> Volume:
    """Return the volume after one multiplicative step of expectation maximisation (Richardson-Lucy).

    E <- E (W^T (I / W E) / W^T 1)^relaxation. A pixel that the volume does not light explains nothing and is left out.
    """
    image, missing = problem.image, np.empty(problem.image.shape, np.float32)
    share_out(write_ratio, len(image), image, projection, problem.sums.inverse_row_sum, missing)
    factor = problem.operator.adjoint(missing)
    factor *= problem.sums.inverse_column_sum
    if relaxation != 1.0:
        # Of one half a power is a root, which takes a fifth of the time.
        factor *= factor ** (relaxation - 1.0)
    factor *= volume
    return factor


def smart_step(problem: Problem, volume: Volume, projection: Image, relaxation: float) -> Volume:
    """Return the volume after one step of MART with all pixels at once (SMART).

    E <- E exp(relaxation W^T log(I / W E) / W^T 1).
    """
    exponent = problem.operator.adjoint(_log_ratio(problem, projection)) * problem.sums.inverse_column_sum
    return volume * np.exp(np.float32(relaxation) * exponent)


def mart_step(problem: Problem, volume: Volume, projection: Image, relaxation: float) -> Volume:
    """Return the volume after one step of MART, block by block: of `MART_BLOCKS` squared sets of pixels in turn.

    E <- E exp(relaxation W_b^T log(I / W E) / max(W_b^T 1)) for the pixels b of each block. It costs as many passes
    over the volume as there are blocks, and is there to compare with.
    """
    taking_part = problem.sums.inverse_row_sum > 0.0
    for number in range(MART_BLOCKS**2):
        block = np.zeros_like(taking_part)
        row, column = divmod(number, MART_BLOCKS)
        block[row::MART_BLOCKS, column::MART_BLOCKS] = taking_part[row::MART_BLOCKS, column::MART_BLOCKS]
        current = projection if number == 0 else problem.operator.forward(volume)
        largest = float(problem.operator.adjoint(block.astype(np.float32)).max())
        if largest > 0.0:
            exponent = problem.operator.adjoint(np.where(block, _log_ratio(problem, current), np.float32(0.0)))
            volume = volume * np.exp(exponent * np.float32(relaxation / largest))
    return volume


def _log_ratio(problem: Problem, projection: Image) -> Image:
    """Return log(I / W E) of each pixel (rows, columns), 0 where it takes no part or the volume does not light it."""
    lit = (projection > 0.0) & (problem.sums.inverse_row_sum > 0.0)
    ratio = np.divide(problem.image, projection, out=np.ones_like(projection), where=lit)
    return np.log(np.maximum(ratio, np.float32(SMALLEST_RATIO)))


def reconstruct(
    operator: Operator,
    image: Image,
    settings: SolverSettings,
    *,
    sums: Normalisers | None = None,
    progress: Callable[[int], None] | None = None,
) -> Reconstruction:
    """Solve for the volume that gives an image.

    Parameters
    ----------
    image : (rows, columns) in the weights' frame, dark and background taken off; negative values count as 0
    sums : `normalisers(operator)`, where several images share it; tells which pixels take part
    progress : called with 1 after each iteration
    """
    stopping = settings.stopping.for_image(image)
    problem = Problem.of(operator, image, sums or normalisers(operator))
    if settings.start == "line_of_sight":
        support = lit_support(operator, problem.image, problem.sums)
        problem = Problem.of(operator, image, problem.sums.within(operator, support))
    volume = point = line_of_sight_start(problem) if settings.start == "line_of_sight" else uniform_start(problem)
    step, pace = SOLVERS[settings.solver].step(), 1.0
    norm = float(np.sqrt(np.sum(np.square(problem.image, dtype=np.float64))))
    residual: list[float] = []
    for _ in range(settings.iterations):
        projection = operator.forward(point)
        residual.append(_relative_residual(problem, projection, norm))
        if stopping.reached(np.array(residual)):
            residual.pop()
            break
        previous, volume = volume, step(problem, point, projection, settings.relaxation)
        if settings.accelerate:
            pace, point = extrapolated(pace, point, previous, volume)
        else:
            point = volume
        if progress:
            progress(1)
    residual.append(_relative_residual(problem, operator.forward(volume), norm))
    taking_part = int(np.count_nonzero(problem.sums.inverse_column_sum))
    return Reconstruction(volume, np.array(residual), taking_part)


def extrapolated(pace: float, point: Volume, previous: Volume, volume: Volume) -> tuple[float, Volume]:
    """Return the pace and the point to step from next, when a step from `point` led from `previous` to `volume`.

    Nesterov's extrapolation with restart (B. O'Donoghue and E. Candes, Found. Comput. Math. 15, 2015): the pace is the
    t of the recursion t' = (1 + sqrt(1 + 4 t^2))/2, from 1 on; the next point lies (t - 1)/t' of the last change beyond
    the volume. Where a step points back against the change, the memory is dropped.
    """
    change = volume - previous
    if np.sum((point - volume) * change, dtype=np.float64) > 0.0:
        pace = 1.0
    following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * pace**2))
    change *= np.float32((pace - 1.0) / following)
    change += volume
    return following, np.maximum(change, np.float32(0.0))


def _relative_residual(problem: Problem, projection: Image, norm: float) -> float:
    """Return ||I - W E|| / ||I|| over the pixels that take part, 0 for a dark image."""
    image, squares = problem.image, np.empty(len(problem.image), np.float64)
    share_out(write_square_differences, len(image), image, projection, problem.sums.inverse_row_sum, squares)
    return float(np.sqrt(squares.sum())) / norm if norm > 0.0 else 0.0
