"""Rays as a polynomial has them: where they meet the microlens array, fitted instead of traced.

Direct light-field calibration (DLFC, Hall et al. 2018) knows no main lens and no window: it has seen dots at known
places through known points of the aperture, and a polynomial of both tells where any other ray goes.

Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

# x, y, z of where a ray starts, X, Y of where it crosses the main lens.
VARIABLES = 5
# Of degree 3 a polynomial has 56 terms, and lenses need no more.
LARGEST_DEGREE = 3


@dataclass(frozen=True, eq=False)
class PolynomialRays:
    """Where rays meet the array, as polynomials of where they come from and cross the main lens.

    Attributes
    ----------
    scale_mm : (5,) what x, y, z, X, Y are divided by
    exponents : (terms, 5) int64
    coefficients_mm : (terms, 2) of both coordinates on the array
    """

    scale_mm: NDArray[np.float64]
    exponents: NDArray[np.int64]
    coefficients_mm: NDArray[np.float64]

    @property
    def degree(self) -> int:
        """Largest sum of exponents."""
        return int(self.exponents.sum(axis=1).max(initial=0))

    def to_tree(self) -> dict[str, Any]:
        """Return the arrays by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> PolynomialRays:
        """Return the rays that `to_tree` took apart.

        Raises
        ------
        KeyError, ValueError : something is missing or cannot be
        """
        rays = cls(**{field.name: tree[field.name] for field in fields(cls)})
        terms = len(rays.exponents)
        shapes = rays.scale_mm.shape, rays.exponents.shape, rays.coefficients_mm.shape
        if shapes != ((VARIABLES,), (terms, VARIABLES), (terms, 2)) or not terms:
            raise ValueError(f"polynomials of {shapes}")
        if not np.isin(rays.exponents, range(LARGEST_DEGREE + 1)).all() or rays.degree > LARGEST_DEGREE:
            raise ValueError(f"polynomials with exponents up to {rays.exponents.max()}")
        if not np.isfinite(rays.coefficients_mm).all() or not np.all(rays.scale_mm > 0.0):
            raise ValueError("polynomials with coefficients that are no numbers")
        return rays

    def on_array(self, start_mm: ArrayLike, crossing_mm: ArrayLike) -> NDArray[np.float64]:
        """Return where rays from (n, 3) through (n, 2) meet the array, (n, 2)."""
        return polynomial_terms(start_mm, crossing_mm, self.scale_mm, self.exponents) @ self.coefficients_mm


def polynomial_terms(
    start_mm: ArrayLike, crossing_mm: ArrayLike, scale_mm: NDArray[np.float64], exponents: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return each term (n, terms) for rays from (n, 3) through (n, 2)."""
    rays = np.concatenate([np.atleast_2d(start_mm), np.atleast_2d(crossing_mm)], axis=1) / scale_mm
    terms = np.ones((len(rays), len(exponents)))
    for variable in range(VARIABLES):
        powers = rays[:, variable, np.newaxis] ** np.arange(int(exponents[:, variable].max(initial=0)) + 1)
        terms *= powers[:, exponents[:, variable]]
    return terms


def complete_exponents(degree: int) -> NDArray[np.int64]:
    """Return the exponents (terms, 5) of all terms up to a degree: 21 of degree 2, 56 of degree 3."""
    all_of_them = product(range(degree + 1), repeat=VARIABLES)
    return np.array([powers for powers in all_of_them if sum(powers) <= degree], dtype=np.int64)
