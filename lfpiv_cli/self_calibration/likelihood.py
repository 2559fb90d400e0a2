"""Maximum likelihood of a few parameters by the particles of a flow, and their standard errors by its slopes.

Parameters are packed so that any number is possible; their `units` are by how much each may change before the slope of
the likelihood does.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

# Steps of the numerical slopes, in units of the parameters.
SLOPE_STEP = 1e-4

LogLikelihood = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""The logarithm (n,) of each particle's density, from packed parameters."""


def improved(
    start: NDArray[np.float64], free: list[int], units: NDArray[np.float64], log_likelihood: LogLikelihood
) -> NDArray[np.float64]:
    """Return the parameters with the free ones made most likely."""
    unit = units[free]

    def cost(change: NDArray[np.float64]) -> float:
        packed = start.copy()
        packed[free] += change * unit
        return -float(np.mean(log_likelihood(packed)))

    found = minimize(cost, np.zeros(len(free)), method="BFGS")
    best = start.copy()
    best[free] += found.x * unit
    return best


def covariance_of(
    best: NDArray[np.float64], units: NDArray[np.float64], log_likelihood: LogLikelihood
) -> NDArray[np.float64]:
    """Return the covariance of packed parameters, from the scatter of the single particles' slopes."""
    step = SLOPE_STEP * units
    slopes = []
    for change in np.diag(step):
        slopes.append((log_likelihood(best + change) - log_likelihood(best - change)) / 2.0)
    design = np.stack(slopes, axis=1)
    return np.asarray(np.linalg.pinv(design.T @ design) * np.outer(step, step), dtype=np.float64)
