"""How unlike the velocities at two places are, as vectors: an isotropic model of the structure function.

D_ij(r) = <(u_i(x + r) - u_i(x)) (u_j(x + r) - u_j(x))> = A(s) delta_ij + B(s) r_i r_j of s = r^2. One function g(s)
makes both: of the solenoidal part it is the longitudinal structure function, and incompressibility gives the
transverse one, g + s g'; of the potential part it is the transverse one, and that the curl is zero gives the
longitudinal one, g + 2 s g'. A share k of potential flow then has A = g + (1 - k) s g', B = (3 k - 1) g': with
k = 1/3 the components are independent of each other.

g(s) = a s (1 + s/l^2)^(p/2 - 1) (1 + s/L^2)^(-p/2): smooth at no distance, with the power p of r between l and L,
level beyond. It is a complete Bernstein function of s, so that the model is a valid one in space whatever a, l, L > 0
and 0 < p < 2 are.

Axes: offsets (..., 3) in mm, displacements in mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

# The share of potential flow with which components are independent.
INDEPENDENT = 1.0 / 3.0


@dataclass(frozen=True)
class VectorStructure:
    """A structure function, and what the stated errors of the samples leave to add.

    Attributes
    ----------
    factor : a of g, without unit: mm^2 over mm^2
    power : p, between the two lengths
    inner_mm, outer_mm : l and L
    nugget_mm2 : variance of each component of each sample that neither the flow nor the stated errors explain
    error_factor : how large the samples' variances are over the stated ones
    potential_share : k
    """

    factor: float
    power: float
    inner_mm: float
    outer_mm: float
    nugget_mm2: float
    error_factor: float
    potential_share: float

    def parts(self, square: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return A and B at squared distances, mm^2 and without unit."""
        over, share = self._over_square(square)
        slope = over * share
        kappa = self.potential_share
        return square * (over + (1.0 - kappa) * slope), (3.0 * kappa - 1.0) * slope

    def slopes(self, square: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the derivatives of A and B with the squared distance."""
        over, share = self._over_square(square)
        inner, outer = self.inner_mm**2, self.outer_mm**2
        first, second = self._exponents()
        curved = over * (
            -(first / (inner + square) + second / (outer + square)) * share
            - first * inner / (inner + square) ** 2
            - second * outer / (outer + square) ** 2
        )
        slope, kappa = over * share, self.potential_share
        return slope + (1.0 - kappa) * (slope + square * curved), (3.0 * kappa - 1.0) * curved

    def scaled(self, times: float) -> VectorStructure:
        """Return the one of a flow whose mean squares are so many times as large."""
        return replace(self, factor=float(self.factor * times))

    def steepness(self, distance_mm: float) -> float:
        """Return the power of the distance with which g grows at one."""
        return float(2.0 * self._over_square(np.array(distance_mm**2))[1])

    def mean_at(self, distance_mm: float) -> float:
        """Return the mean square difference of a component over a distance, all directions alike, mm^2."""
        square = np.array(distance_mm**2)
        level, along = self.parts(square)
        return float(level + along * square / 3.0)

    def _exponents(self) -> tuple[float, float]:
        return 1.0 - 0.5 * self.power, 0.5 * self.power

    def _over_square(self, square: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return g / s and s g' / g."""
        inner, outer = self.inner_mm**2, self.outer_mm**2
        first, second = self._exponents()
        over = self.factor * np.exp(-first * np.log1p(square / inner) - second * np.log1p(square / outer))
        return over, 1.0 - square * (first / (inner + square) + second / (outer + square))
