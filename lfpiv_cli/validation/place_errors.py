"""Errors of measured places as a map of space: shifted, stretched, turned, slanted, twisted, and what is left.

With e = measured - true at the true place (x, y, z), z from where depth is counted,

    e_k = b_k + B_kx x + B_ky y + B_kz z + C_kx x z + C_ky y z

is fitted for each component k, without outliers. A velocity is a difference of places, so that 1 + B is also what
happens to velocities: B_zz is the relative error of w, B_xz the share of w that leaks into u.

Axes: points (n, 3), x, y, z in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.validation.particles import DEPTH_VOXEL, LATERAL_VOXEL, Matches, match

Points = NDArray[np.float64]

# Depths may be wrong by so many times what lateral places may: an error of the focal plane is one of depth alone.
DEPTH_TO_LATERAL_GATE = 40.0
# Errors so many robust standard deviations from the fit are other tracers, or another depth that explains the light as
# well; looked for so many times.
OUTLIER_SIGMAS, OUTLIER_ROUNDS = 5.0, 3
TERMS, FEWEST = 6, 10


@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """The fitted map.

    Attributes
    ----------
    coefficients, sigma : (6, 3) b, B_x, B_y, B_z, C_x, C_y of each component, and standard errors
    spread_mm : (3,) standard deviation of what is left
    count : of the tracers fitted
    """

    coefficients: NDArray[np.float64]
    sigma: NDArray[np.float64]
    spread_mm: NDArray[np.float64]
    count: int

    def figures(self) -> dict[str, float]:
        """Return the figures by name, lengths in mm, stretches and angles as ratios (twist: per mm of depth)."""
        return self._named(self.coefficients, np.subtract) | {
            f"spread_{name}": float(value) for name, value in zip("xyz", self.spread_mm, strict=True)
        }

    def standard_errors(self) -> dict[str, float]:
        """Return the standard errors of the same figures."""
        return self._named(self.sigma, np.hypot) | {
            f"spread_{name}": float(value / np.sqrt(2.0 * max(self.count, 1)))
            for name, value in zip("xyz", self.spread_mm, strict=True)
        }

    @staticmethod
    def _named(table: NDArray[np.float64], combine: np.ufunc) -> dict[str, float]:
        """Return a table's entries by name; `combine` takes the two halves of a turn."""
        offset, along, twist = table[0], table[1:4], table[4:]
        named = {f"offset_{name}": offset[axis] for axis, name in enumerate("xyz")}
        named |= {f"stretch_{name}": along[axis, axis] for axis, name in enumerate("xyz")}
        named |= {"slant_x": along[2, 0], "slant_y": along[2, 1]}
        named |= {"turn": 0.5 * combine(along[0, 1], along[1, 0]), "twist": 0.5 * combine(twist[0, 1], twist[1, 0])}
        return {name: float(value) for name, value in named.items()}


def pairs_of(measured_mm: Points, true_mm: Points, gate_mm: float) -> Matches:
    """Pair measured with true tracers that stand apart: nearest first, laterally within a gate, nearly any depth.

    Errors are returned in mm.
    """
    scale = np.array([1.0, 1.0, DEPTH_VOXEL / LATERAL_VOXEL / DEPTH_TO_LATERAL_GATE])
    found = match(measured_mm * scale, true_mm * scale, gate_mm / LATERAL_VOXEL)
    return Matches(found.found, found.true, measured_mm[found.found] - true_mm[found.true])


def fit_errors(true_mm: Points, error_mm: Points) -> PlaceErrors:
    """Fit the map to errors (n, 3) at true places (n, 3); NaN where there are hardly more of them than terms."""
    if len(true_mm) < FEWEST:
        unknown = np.full((TERMS, 3), np.nan)
        return PlaceErrors(unknown, unknown, unknown[0], 0)
    x, y, z = true_mm.T
    design = np.stack([np.ones_like(x), x, y, z, x * z, y * z], axis=1)
    kept = np.ones(len(x), dtype=bool)
    for _ in range(OUTLIER_ROUNDS):
        coefficients = np.linalg.lstsq(design[kept], error_mm[kept], rcond=None)[0]
        left = np.abs(error_mm - design @ coefficients)
        width = MAD_TO_SIGMA * np.median(left[kept], axis=0)
        kept = np.all(left <= OUTLIER_SIGMAS * width, axis=1)
    coefficients = np.linalg.lstsq(design[kept], error_mm[kept], rcond=None)[0]
    left, count = (error_mm - design @ coefficients)[kept], int(kept.sum())
    spread = np.sqrt(np.sum(left**2, axis=0) / max(count - TERMS, 1))
    scatter = np.sqrt(np.diag(np.linalg.pinv(design[kept].T @ design[kept])))
    return PlaceErrors(coefficients, scatter[:, np.newaxis] * spread, spread, count)


@dataclass(frozen=True)
class Line:
    """A straight line through measured points, and how far the farthest of them lies from it."""

    slope: float
    offset: float
    largest_departure: float


def straight_line(x: NDArray[np.float64], y: NDArray[np.float64]) -> Line:
    """Fit a straight line to the points that are known; NaN where there are not two."""
    known = np.isfinite(y)
    if np.count_nonzero(known) < 2:
        return Line(np.nan, np.nan, np.nan)
    x, y = x[known], y[known]
    slope, offset = np.polynomial.polynomial.polyfit(x, y, 1)[::-1]
    return Line(float(slope), float(offset), float(np.abs(y - offset - slope * x).max()))
