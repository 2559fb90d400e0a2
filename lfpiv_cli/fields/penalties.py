"""What a spline field is expected to be before any sample is seen: smooth, and of little divergence.

The field is thought of as Gaussian, with the inverse covariance: weight times integral of squared second derivatives,
plus the same of third ones, plus the same of the divergence. Second derivatives alone make the spectrum k^-2 of
turbulence nearly (k^-5/3), third ones that of smooth flows, k^-4; the weights say how much of each there is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lfpiv_cli.fields import stencils
from lfpiv_cli.fields.lattice import Lattice
from lfpiv_cli.fields.stencils import Stencil

SECOND, THIRD, DIVERGENCE = "second", "third", "divergence"
ORDERS = {SECOND: 2, THIRD: 3}
# Constants and linear fields are not penalised by derivatives; they are expected up to ten times the samples' spread.
SPREADS = 10.0


@dataclass(frozen=True)
class Expectation:
    """The weights of the penalties, and what is known of the samples' errors.

    Attributes
    ----------
    weights : of the integrals, by the penalty's name: mm^(2 order - 3) mm^-2 of squared displacements
    spread_mm : of the samples' values
    scale : by which stated standard errors are multiplied
    unresolved_mm : standard deviation, along each axis, of what the field does within less than a cell
    """

    weights: Mapping[str, float]
    spread_mm: float
    scale: float
    unresolved_mm: float


def penalty(lattice: Lattice, name: str, components: int = 3) -> Stencil:
    """Return the integral of the squares that a penalty is made of, over the box."""
    if name == DIVERGENCE:
        return stencils.divergence(lattice)
    matrix = stencils.empty(lattice, components)
    stencils.add_scalar(matrix, 1.0, stencils.smoothness(lattice, ORDERS[name]))
    return matrix


def bound(lattice: Lattice, spread_mm: float, components: int = 3) -> Stencil:
    """Return what keeps fields bounded that no other penalty sees."""
    matrix = stencils.empty(lattice, components)
    factor = 1.0 / ((SPREADS * spread_mm) ** 2 * lattice.volume_mm3)
    stencils.add_scalar(matrix, factor, stencils.smoothness(lattice, 0))
    return matrix


def expected_inverse(lattice: Lattice, expected: Expectation, components: int = 3) -> Stencil:
    """Return the inverse covariance of a field before any sample."""
    matrix = bound(lattice, expected.spread_mm, components)
    for name, weight in expected.weights.items():
        if name == DIVERGENCE:
            matrix += weight * stencils.divergence(lattice)
        else:
            stencils.add_scalar(matrix, weight, stencils.smoothness(lattice, ORDERS[name]))
    return matrix


def spread_of(values: np.ndarray) -> float:
    """Return by how much values (n, c) differ, 1.48 times the median distance from their median."""
    off = np.abs(values - np.median(values, axis=0))
    return max(float(1.4826 * np.median(off.max(axis=1))), np.finfo(np.float64).tiny)
