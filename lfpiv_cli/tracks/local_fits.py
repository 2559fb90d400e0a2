"""Robust polynomials through the tracks around many places at once.

Each component is fitted for itself. A fit is linear in the displacements once outliers are weighed down,
so that its noise, and that of the difference of two fits, follow from the tracks' stated errors.

Axes: m places, k tracks around each, nearest first; points and displacements in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.robust import MAD_TO_SIGMA

# The furthest track of a fit still counts for a quarter: a Gaussian whose deviation is this share of the radius.
KERNEL_WIDTH = 0.6
# First rounds that no outlier can mislead (Cauchy's weights never vanish), then Tukey's biweight, which drops outliers.
CAUCHY_ROUNDS, TUKEY_ROUNDS = 3, 5
TUKEY = 4.685
# The biweight takes its weighted mean square from the middle of a normal distribution: this share of the variance.
TUKEY_VARIANCE = 0.827
# A share of the mean of the diagonal that keeps the equations of tracks in one plane solvable.
RIDGE = 1e-10
# No particle is known better than this share of the distance of those around it; guards against a standard error of
# zero, and a fit that leaves nothing.
SMALLEST_SIGMA_SHARE = 1e-6
SMALLEST_SPREAD = 1e-12


@dataclass(frozen=True, eq=False)
class LocalFits:
    """Polynomials of one degree through the k nearest tracks of m places.

    Attributes
    ----------
    value : (m, 3) at the places, mm
    weights : (m, 3, k) what a stated standard error of each track adds to the value, mm
    scatter2 : (m, 3) mean square of the tracks' residuals over that of their stated errors
    radius_mm : (m,) distance of the furthest track
    """

    value: NDArray[np.float64]
    weights: NDArray[np.float64]
    scatter2: NDArray[np.float64]
    radius_mm: NDArray[np.float64]


def fit_around(
    offset_mm: NDArray[np.float64], values: NDArray[np.float64], sigma: NDArray[np.float64], degree: int
) -> LocalFits:
    """Fit polynomials of degree 1 or 2.

    Parameters
    ----------
    offset_mm : (m, k, 3) from a place to its tracks, nearest first
    values, sigma : (m, k, 3) their displacements and stated standard errors, mm
    """
    distance = np.linalg.norm(offset_mm, axis=2)
    radius = np.where(distance[:, -1:] > 0.0, distance[:, -1:], 1.0)
    terms = _terms(offset_mm / radius[..., np.newaxis], degree)
    kernel = np.exp(-0.5 * (distance / (KERNEL_WIDTH * radius)) ** 2)
    each = [
        _fit_component(terms, values[..., axis], np.maximum(sigma[..., axis], SMALLEST_SIGMA_SHARE * radius), kernel)
        for axis in range(3)
    ]
    value, weights, scatter2 = (np.stack(parts, axis=1) for parts in zip(*each, strict=True))
    return LocalFits(value, weights, scatter2, radius[:, 0])


def _terms(offset: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return the monomials up to a degree of one or two, last axis, the constant first."""
    x, y, z = np.moveaxis(offset, -1, 0)
    terms = [np.ones_like(x), x, y, z]
    if degree == 2:
        terms += [x * x, y * y, z * z, x * y, x * z, y * z]
    return np.stack(terms, axis=-1)


def _fit_component(
    terms: NDArray[np.float64], values: NDArray[np.float64], sigma: NDArray[np.float64], kernel: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return value (m,), weights (m, k) and scatter2 (m,) of one component, whose arrays are (m, k)."""
    robust = np.ones_like(values)
    for number in range(CAUCHY_ROUNDS + TUKEY_ROUNDS):
        weighted, matrix = _equations(terms, kernel * robust / sigma**2)
        coefficients = np.linalg.solve(matrix, weighted @ values[..., np.newaxis])
        off = np.abs(values - (terms @ coefficients)[..., 0]) / sigma
        spread = np.maximum(MAD_TO_SIGMA * np.median(off, axis=1, keepdims=True), SMALLEST_SPREAD)
        if number < CAUCHY_ROUNDS:
            robust = 1.0 / (1.0 + (off / spread) ** 2)
        else:
            robust = np.clip(1.0 - (off / (TUKEY * spread)) ** 2, 0.0, None) ** 2
    weighted, matrix = _equations(terms, kernel * robust / sigma**2)
    inverse = np.linalg.inv(matrix)
    left = TUKEY_VARIANCE * _left_by_fit(terms @ inverse, weighted, sigma)
    expected = np.maximum(np.sum(kernel * robust * left, axis=1), SMALLEST_SPREAD)
    scatter2 = np.asarray(np.sum(kernel * robust * off**2, axis=1) / expected)
    weights = np.asarray((inverse[:, :1] @ weighted)[:, 0] * sigma)
    return np.asarray(coefficients[:, 0, 0]), weights, scatter2


def _equations(
    terms: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted terms (m, p, k) and the matrix (m, p, p) of the normal equations."""
    weighted = (terms * weight[..., np.newaxis]).swapaxes(1, 2)
    matrix = weighted @ terms
    diagonal = np.arange(matrix.shape[1])
    matrix[:, diagonal, diagonal] += RIDGE * np.trace(matrix, axis1=1, axis2=2)[:, np.newaxis] / len(diagonal)
    return weighted, matrix


def _left_by_fit(
    solved: NDArray[np.float64], weighted: NDArray[np.float64], sigma: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the share (m, k) of each track's variance that a fit leaves in its residual, fit = solved @ weighted @ v.

    The kernel lets the tracks next to a place draw the polynomial to them, where their number alone says little.
    """
    own = np.einsum("mkp,mpk->mk", solved, weighted)
    noise = (weighted * sigma[:, np.newaxis] ** 2) @ weighted.swapaxes(1, 2)
    from_all = np.einsum("mkp,mkp->mk", solved @ noise, solved) / sigma**2
    return np.asarray(1.0 - 2.0 * own + from_all)
