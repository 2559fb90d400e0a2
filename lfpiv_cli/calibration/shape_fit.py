"""The place of a small shape in the scene that explains the light of pixels best, by least squares.

Axes: image axes (x along the columns, y along the rows), mm, z away from the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Gauss-Newton starts within the shape and settles in about five rounds, to a hundredth of what noise leaves; a step
# that raises the misfit is halved.
FIT_ROUNDS = 20
FIT_HALVINGS = 6
FIT_TOLERANCE = 1e-4

# Shares of what pixels see (n,), and their derivatives (n, k).
SharesAndSlopes = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A shape fitted to pixels.

    Attributes
    ----------
    position_mm : (3,) x, y in image axes, z in the medium
    covariance_mm2 : (3, 3) of the position
    brightness, background : light of the shape and around it, in the image's unit at full transmission
    rms : root mean square misfit, in the image's unit
    converged : the steps became small before the rounds were used up
    """

    position_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64]
    brightness: float
    background: float
    rms: float
    converged: bool


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Brightness and background (levels) that explain pixels best for a disc at a given place.

    `design` (n, 7) is what the disc's moves along x, y, z and a unit of each level put on the pixels, `residual` (n,)
    what is left, `misfit` its square.
    """

    design: NDArray[np.float64]
    levels: NDArray[np.float64]
    residual: NDArray[np.float64]
    misfit: float


def fit_shape(
    signal: NDArray[np.float64],
    passed: NDArray[np.float64],
    beside_mm: NDArray[np.float64],
    start_mm: NDArray[np.float64],
    steps_mm: NDArray[np.float64],
    shares_at: Callable[[NDArray[np.float64]], SharesAndSlopes],
) -> ShapeFit:
    """Fit a shape to pixels by least squares: x, y, z, brightness and a sloping background are free.

    Parameters
    ----------
    signal, passed : (n,) light on the pixels and the share of light that each passes
    beside_mm : (n, 2) where in the plane of the first guess pixels see, about it
    start_mm : (3,) first guess, in image axes, within about a step
    steps_mm : (3,) by which moves are measured, such that each changes the light alike
    shares_at : gives for a position (3,) the share (n,) of what pixels see that the shape covers, and slopes (n, 3)
    """
    ground = passed[:, np.newaxis] * np.column_stack([np.ones(len(passed)), beside_mm / steps_mm[0]])

    def linear_fit(position: NDArray[np.float64]) -> LinearFit:
        shares, moves = shares_at(position)
        design = np.column_stack([passed * shares, ground])
        levels = solved(design, signal)
        residual = signal - design @ levels
        full = np.column_stack([levels[0] * passed[:, np.newaxis] * moves * steps_mm, design])
        return LinearFit(full, levels, residual, float(residual @ residual))

    position = np.asarray(start_mm, dtype=np.float64)
    best = linear_fit(position)
    converged = False
    for _ in range(FIT_ROUNDS):
        move = solved(best.design, best.residual)[:3] * steps_mm
        for _ in range(FIT_HALVINGS):
            trial = linear_fit(position + move)
            if trial.misfit <= best.misfit:
                break
            move = 0.5 * move
        converged = bool(np.all(np.abs(move) <= FIT_TOLERANCE * steps_mm))
        if trial.misfit > best.misfit:
            break
        position, best = position + move, trial
        if converged:
            break
    variance = best.misfit / max(1, signal.size - best.design.shape[1])
    covariance = np.linalg.pinv(best.design.T @ best.design)[:3, :3] * variance * np.outer(steps_mm, steps_mm)
    rms = float(np.sqrt(best.misfit / signal.size))
    return ShapeFit(position, covariance, float(best.levels[0]), float(best.levels[1]), rms, converged)


def solved(design: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coefficients of the design's columns that explain the values best."""
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)
