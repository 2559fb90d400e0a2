"""Iterative solvers of sum_j w_ij E_j = I_i (Eq. 11) for a non-negative volume E.

A solver is a function `step(problem, volume, projection, relaxation) -> volume`; the loop in `reconstruct` owns the
iterations and hands each step the projection of the current volume, which also gives the residual. To add a solver:
write its step, name it in `SOLVERS`, and test that a true volume is a fixed point and that the residual falls.

Axes: volumes [z, y, x], images [row, column], float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Volume = NDArray[np.float32]
Image = NDArray[np.float32]

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
class Problem:
    """The equations of one image.

    Attributes
    ----------
    operator : the weights
    image : (rows, columns) >= 0, in the weights' frame; 0 where a pixel takes no part
    inverse_row_sum : (rows, columns) 1 / sum_n w_in, 0 for pixels that take no part
    inverse_column_sum : (z, y, x) 1 / sum_i w_ij over the pixels that take part, 0 for voxels that none of them sees
    """

    operator: Operator
    image: Image
    inverse_row_sum: Image
    inverse_column_sum: Volume


@dataclass(frozen=True, eq=False)
class Normalisers:
    """Guarded inverses of the row and column sums; the same for all images of one set of weights."""

    inverse_row_sum: Image
    inverse_column_sum: Volume


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A volume (z, y, x) and the relative residual ||I - W E|| / ||I||, at the start of each step and of the volume."""

    volume: Volume
    residual: NDArray[np.float64]


def normalisers(operator: Operator) -> Normalisers:
    """Return the guarded inverse row and column sums of the weights (the denominators of Eq. 12)."""
    row_sum = operator.forward(np.ones(operator.shape, np.float32))
    inverse_row_sum = _guarded_inverse(row_sum)
    column_sum = operator.adjoint((inverse_row_sum > 0.0).astype(np.float32))
    return Normalisers(inverse_row_sum, _guarded_inverse(column_sum))


def sart_step(problem: Problem, volume: Volume, projection: Image, relaxation: float) -> Volume:
    """Return the volume after one step of SART, all pixels at once (Eq. 12), kept non-negative."""
    correction = (problem.image - projection) * problem.inverse_row_sum
    update = problem.operator.adjoint(correction) * problem.inverse_column_sum
    return np.maximum(volume + np.float32(relaxation) * update, np.float32(0.0))


def em_step(problem: Problem, volume: Volume, projection: Image, relaxation: float) -> Volume:
    """Return the volume after one multiplicative step of expectation maximisation (Richardson-Lucy).

    E <- E (W^T (I / W E) / W^T 1)^relaxation. A pixel that the volume does not light explains nothing and is left out.
    """
    ratio = np.divide(
        problem.image,
        projection,
        out=np.zeros_like(projection),
        where=(projection > 0.0) & (problem.inverse_row_sum > 0.0),
    )
    factor = problem.operator.adjoint(ratio) * problem.inverse_column_sum
    if relaxation != 1.0:
        factor **= np.float32(relaxation)
    return volume * factor


SOLVERS: dict[str, Callable[[Problem, Volume, Image, float], Volume]] = {"sart": sart_step, "em": em_step}


def reconstruct(
    operator: Operator,
    image: Image,
    solver: str,
    iterations: int,
    relaxation: float = 1.0,
    accelerate: bool = False,
    sums: Normalisers | None = None,
    progress: Callable[[int], None] | None = None,
) -> Reconstruction:
    """Solve for the volume that gives an image, from a uniform start.

    Parameters
    ----------
    image : (rows, columns) in the weights' frame, dark and background taken off; negative values count as 0
    solver : name in `SOLVERS`
    accelerate : step from points extrapolated by `Momentum`, at the cost of three passes over the volume
    sums : `normalisers(operator)`, where several images share it
    progress : called with 1 after each iteration
    """
    sums = sums or normalisers(operator)
    taking_part = sums.inverse_row_sum > 0.0
    image = np.where(taking_part, np.maximum(image, 0.0), 0.0).astype(np.float32)
    problem = Problem(operator, image, sums.inverse_row_sum, sums.inverse_column_sum)
    volume = point = uniform_start(problem)
    momentum = Momentum()
    norm = np.sqrt(_square_sum(image))
    residual = np.zeros(iterations + 1)
    for k in range(iterations):
        projection = operator.forward(point)
        residual[k] = _relative_residual(image, projection, taking_part, norm)
        previous, volume = volume, SOLVERS[solver](problem, point, projection, relaxation)
        if accelerate:
            momentum, point = momentum.extrapolated(point, previous, volume)
        else:
            point = volume
        if progress:
            progress(1)
    residual[iterations] = _relative_residual(image, operator.forward(volume), taking_part, norm)
    return Reconstruction(volume, residual)


@dataclass(frozen=True)
class Momentum:
    """Nesterov's extrapolation with restart (B. O'Donoghue and E. Candes, Found. Comput. Math. 15, 2015).

    `pace` is the t of the recursion t' = (1 + sqrt(1 + 4 t^2))/2; the next point lies (t - 1)/t' of the last change
    beyond the volume. Where a step points back against the change, the memory is dropped.
    """

    pace: float = 1.0

    def extrapolated(self, point: Volume, previous: Volume, volume: Volume) -> tuple[Momentum, Volume]:
        """Return the momentum and the point to step from next, when a step from `point` led to `volume`."""
        change = volume - previous
        pace = 1.0 if np.sum((point - volume) * change, dtype=np.float64) > 0.0 else self.pace
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * pace**2))
        change *= np.float32((pace - 1.0) / following)
        change += volume
        return Momentum(following), np.maximum(change, np.float32(0.0))


def uniform_start(problem: Problem) -> Volume:
    """Return the constant volume (z, y, x) that has the image's light, 0 where no pixel sees it."""
    seen = problem.inverse_column_sum > 0.0
    gain = np.sum(1.0 / problem.inverse_column_sum[seen], dtype=np.float64)
    level = np.sum(problem.image, dtype=np.float64) / gain if gain > 0.0 else 0.0
    return np.where(seen, np.float32(level), np.float32(0.0))


def _guarded_inverse(sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return 1 / sums, 0 where a sum is negligible beside the largest."""
    limit = SMALLEST_SUM * float(sums.max(initial=0.0))
    return np.divide(np.float32(1.0), sums, out=np.zeros_like(sums), where=sums > limit)


def _square_sum(image: Image) -> float:
    return float(np.sum(np.square(image, dtype=np.float64)))


def _relative_residual(image: Image, projection: Image, taking_part: NDArray[np.bool_], norm: float) -> float:
    difference = np.where(taking_part, image - projection, np.float32(0.0))
    return float(np.sqrt(_square_sum(difference))) / norm if norm > 0.0 else 0.0
