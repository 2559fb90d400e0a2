"""From scattered tracks to vectors on a grid: local polynomials, each with its uncertainty.

Axes: points (n, 3) and displacements in mm, at the middle of each track.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

# Tracks for a local quadratic: four and a half for each of its ten unknowns. With fewer at hand, or with all on one
# side, a linear one through at least three for each of its four unknowns.
QUADRATIC_TRACKS = 45
LINEAR_TRACKS = 12
QUADRATIC_TERMS = 10
LINEAR_TERMS = 4
# No particle is known better than this; guards against a standard error of zero.
SMALLEST_SIGMA_MM = 1e-6
# Tukey's biweight drops tracks that stray; settled after a few rounds.
TUKEY = 4.685
TUKEY_ROUNDS = 5
MAD_TO_SIGMA = 1.4826
# The biweight takes its weighted mean square from the middle of a normal distribution: this share of the variance.
TUKEY_VARIANCE = 0.827


def on_grid(
    middle_mm: NDArray[np.float64],
    displacement_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    nodes_mm: NDArray[np.float64],
    reach_mm: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return displacements (m, 3) at nodes and their standard errors (m, 3), mm; NaN where too few tracks are near.

    Parameters
    ----------
    middle_mm, displacement_mm, sigma_mm : (n, 3) the tracks and their standard errors
    nodes_mm : (m, 3)
    reach_mm : a node whose twelfth track lies further away gets no vector
    """
    value, error = (np.full(nodes_mm.shape, np.nan) for _ in range(2))
    if len(middle_mm) < LINEAR_TRACKS:
        return value, error
    count = min(QUADRATIC_TRACKS, len(middle_mm))
    distance, near = KDTree(middle_mm).query(nodes_mm, k=count)
    for node in np.flatnonzero(distance[:, LINEAR_TRACKS - 1] <= reach_mm):
        radius = distance[node, -1]
        terms = _terms((middle_mm[near[node]] - nodes_mm[node]) / radius)
        # A Gaussian on which the furthest track still counts for a quarter.
        kernel = np.exp(-0.5 * (distance[node] / (0.6 * radius)) ** 2)
        for axis in range(3):
            sigma = np.maximum(sigma_mm[near[node], axis], SMALLEST_SIGMA_MM)
            value[node, axis], error[node, axis] = _robust_value(
                terms, displacement_mm[near[node], axis], sigma, kernel
            )
    return value, error


def _terms(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the monomials up to degree two (n, 10), the constant and the linear ones first."""
    x, y, z = offset.T
    return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], axis=1)


def _robust_value(
    terms: NDArray[np.float64],
    values: NDArray[np.float64],
    sigma: NDArray[np.float64],
    kernel: NDArray[np.float64],
) -> tuple[float, float]:
    """Return the polynomial's value at the node and its standard error.

    The stated errors weigh the tracks; how large they really are is taken from the scatter about the polynomial.
    """
    used = terms if len(values) >= QUADRATIC_TRACKS else terms[:, :LINEAR_TERMS]
    robust = np.ones(len(values))
    for _ in range(TUKEY_ROUNDS):
        root = np.sqrt(kernel * robust) / sigma
        coefficients = np.linalg.lstsq(root[:, np.newaxis] * used, root * values, rcond=None)[0]
        off = np.abs(values - used @ coefficients) / sigma
        spread = MAD_TO_SIGMA * float(np.median(off))
        if spread == 0.0:
            break
        robust = np.clip(1.0 - (off / (TUKEY * spread)) ** 2, 0.0, None) ** 2
    weight = kernel * robust / sigma**2
    inverse = np.linalg.pinv(used.T @ (weight[:, np.newaxis] * used))
    expected = TUKEY_VARIANCE * _left_by_fit(used @ inverse @ used.T * weight, sigma)
    scatter2 = float(np.sum(kernel * robust * off**2) / np.sum(kernel * robust * expected))
    # The kernel favours what is near, which is no statement about noise: the sandwich of weighted least squares.
    meat = used.T @ (((weight * sigma) ** 2)[:, np.newaxis] * used)
    return float(coefficients[0]), float(np.sqrt(scatter2 * max((inverse @ meat @ inverse)[0, 0], 0.0)))


def _left_by_fit(hat: NDArray[np.float64], sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share (n,) of each track's variance that a fit leaves in its residual, with fit = hat @ values.

    The kernel lets the tracks next to the node draw the polynomial to them, where their number alone tells little.
    """
    from_all = (hat * sigma / sigma[:, np.newaxis]) ** 2
    return np.asarray(1.0 - 2.0 * np.diag(hat) + from_all.sum(axis=1))
