"""The structure function under which the samples are likeliest: what a field is kriged with.

The likelihood is that of some neighbourhoods spread over the samples, each with all its covariances about an unknown
constant: a few hundred samples, which know both what neighbours differ by and how much of it is error. First guesses
with wide standard deviations keep what few samples cannot tell where it is likely to be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import KDTree

from lfpiv_cli.fields.neighbourhood_equations import between, log_likelihood, unknown_variance
from lfpiv_cli.fields.samples import Samples
from lfpiv_cli.fields.structure import INDEPENDENT, VectorStructure

# So many neighbourhoods of so many samples, more of which change the estimates by less than their errors; and what
# is enough to tell outliers.
NEIGHBOURHOODS, FEW_NEIGHBOURHOODS = (20, 40), (12, 25)
# Shares of potential flow to choose from, and by how much the logarithm of the likelihood must grow for one that is
# not zero: twice that is exceeded by chi-squared of one degree of freedom once in seventy times.
POTENTIAL_SHARES = (0.0, 0.03, 0.1, INDEPENDENT, 0.7)
NEEDED_GROWTH = 3.0
# First guesses: the power of turbulence, between lengths of so many times the distance of neighbours; the mean square
# difference of neighbours and the nugget as shares of the variance; and the standard deviations of the logarithms (of
# the logit of half the power).
POWER, INNER_SPACINGS, OUTER_SPACINGS, DIFFERENCE_SHARE, NUGGET_SHARE = 2.0 / 3.0, 0.3, 10.0, 0.5, 1e-3
DEVIATIONS = np.array([3.0, 1.5, 1.0, 1.0, 3.0, 0.5])
# No parameter is further from its first guess, in these deviations: a search that went on would leave what is a number.
FARTHEST = 10.0
STEPS, ENOUGH = 25, 1e-5
# What stands for a likelihood of none.
IMPOSSIBLE = 1e12

Cost = Callable[[NDArray[np.float64], float], float]


def spacing_of(points: NDArray[np.float64]) -> float:
    """Return the median distance of a point's nearest neighbour, mm."""
    return float(np.median(KDTree(points).query(points, k=[2])[0]))


def likeliest_structure(
    samples: Samples, shares: Sequence[float], size: tuple[int, int] = NEIGHBOURHOODS
) -> VectorStructure:
    """Return the likeliest structure function.

    Parameters
    ----------
    samples : without outliers
    shares : of potential flow, to choose from: the first, unless another is clearly likelier
    size : number of neighbourhoods and of samples in each
    """
    spacing = spacing_of(samples.points_mm)
    cost, guess = _cost_of(samples, spacing, size), _first_guess(samples, spacing)
    found = _least(cost, guess, shares[0], guess)
    # what else is likeliest differs little from share to share
    other = min(shares, key=lambda share: cost(found, share))
    if other != shares[0]:
        better = _least(cost, found, other, guess)
        if cost(better, other) < cost(found, shares[0]) - NEEDED_GROWTH:
            return _structure(better, spacing, other)
    return _structure(found, spacing, shares[0])


def _least(cost: Cost, start: NDArray[np.float64], share: float, guess: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the parameters, near some and not too far from the first guess, at which the cost is the smallest."""
    bounds = list(zip(guess - FARTHEST * DEVIATIONS, guess + FARTHEST * DEVIATIONS, strict=True))
    options = {"maxiter": STEPS, "ftol": ENOUGH}
    found = minimize(cost, start, args=(share,), method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x)


def _neighbourhoods(points: NDArray[np.float64], number: int, samples_each: int) -> NDArray[np.int64]:
    """Return the samples (b, k) of neighbourhoods whose middles lie as far from each other as they can."""
    count = min(samples_each, len(points))
    middles = [int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[middles[0]], axis=1)
    while len(middles) < min(number, max(1, 2 * len(points) // count)):
        middles.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[middles[-1]], axis=1))
    return np.asarray(KDTree(points).query(points[middles], k=np.arange(1, count + 1))[1])


def _cost_of(samples: Samples, spacing: float, size: tuple[int, int]) -> Cost:
    """Return minus the logarithm of the likelihood, of parameters and the share of potential flow."""
    near = _neighbourhoods(samples.points_mm, *size)
    points, errors, values = samples.points_mm[near], samples.covariance_mm2[near], samples.value_mm[near]
    about = (values - values.mean(axis=1, keepdims=True)).swapaxes(1, 2).reshape(len(near), -1)
    guess, unknown = _first_guess(samples, spacing), unknown_variance(samples)

    def cost(parameters: NDArray[np.float64], share: float) -> float:
        found = log_likelihood(between(points, errors, _structure(parameters, spacing, share), unknown), about)
        unlikely = 0.5 * float(np.sum(((parameters - guess) / DEVIATIONS) ** 2))
        return unlikely - found if np.isfinite(found) else IMPOSSIBLE

    return cost


def _first_guess(samples: Samples, spacing: float) -> NDArray[np.float64]:
    variance = max(float(np.var(samples.value_mm, axis=0).mean()), np.finfo(np.float64).tiny)
    shares = np.log([DIFFERENCE_SHARE * variance, NUGGET_SHARE * variance])
    lengths = np.log([INNER_SPACINGS * spacing, OUTER_SPACINGS * spacing])
    return np.array([shares[0], np.log(POWER / (2.0 - POWER)), *lengths, shares[1], 0.0])


def _structure(parameters: NDArray[np.float64], spacing: float, share: float) -> VectorStructure:
    """Return the structure function of: ln D between neighbours, logit p/2, ln l, ln L, ln nugget, ln error factor."""
    difference, power, inner, outer, nugget, error = parameters.tolist()
    inner, outer, nugget, error = (math.exp(value) for value in (inner, outer, nugget, error))
    unit = VectorStructure(1.0, 2.0 / (1.0 + math.exp(-power)), inner, outer, nugget, error, share)
    return unit.scaled(math.exp(difference) / unit.mean_at(spacing))
