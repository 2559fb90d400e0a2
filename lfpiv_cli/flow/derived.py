"""What follows from the gradients of a velocity field.

Axes: arrays `[z, y, x]`, vectors (u, v, w) along (x, y, z) last; rates in 1/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.flow.field import MM_TO_M, VectorField


@dataclass(frozen=True, eq=False)
class Derived:
    """Fields derived from gradients; NaN where a vector that one needs is missing or an axis has one plane only.

    Attributes
    ----------
    vorticity : (nz, ny, nx, 3) curl of the velocity, 1/s
    divergence : (nz, ny, nx) 1/s; zero in a liquid, so that its rms tells the noise of the gradients without a truth
    strain_rate : (nz, ny, nx) sqrt(2 S : S) of the symmetric part S of the gradient, 1/s
    q_criterion : (nz, ny, nx) (W : W - S : S) / 2 with the antisymmetric part W, 1/s^2; positive in vortices
    """

    vorticity: NDArray[np.float64]
    divergence: NDArray[np.float64]
    strain_rate: NDArray[np.float64]
    q_criterion: NDArray[np.float64]

    @property
    def divergence_rms(self) -> float | None:
        """The rms of the divergence in 1/s, None where it is known nowhere."""
        known = self.divergence[np.isfinite(self.divergence)]
        return float(np.sqrt(np.mean(known**2))) if known.size else None


def derived_fields(field: VectorField) -> Derived:
    """Return the derived fields by central differences, one-sided at the faces and exact for quadratic flows there."""
    return derived_from(velocity_gradient(field))


def derived_from(gradient: NDArray[np.float64]) -> Derived:
    """Return what follows from gradients (nz, ny, nx, 3, 3) in 1/s: the component, then the direction."""
    turned = gradient.swapaxes(-1, -2)
    strain, rotation = 0.5 * (gradient + turned), 0.5 * (gradient - turned)
    strain_squared = np.sum(strain**2, axis=(-1, -2))
    vorticity = [gradient[..., k, j] - gradient[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))]
    return Derived(
        vorticity=np.stack(vorticity, axis=-1),
        divergence=np.trace(gradient, axis1=-2, axis2=-1),
        strain_rate=np.sqrt(2.0 * strain_squared),
        q_criterion=0.5 * (np.sum(rotation**2, axis=(-1, -2)) - strain_squared),
    )


def velocity_gradient(field: VectorField) -> NDArray[np.float64]:
    """Return d(u, v, w)/d(x, y, z), (nz, ny, nx, 3, 3) in 1/s: the component, then the direction."""
    velocity = field.velocity
    gradient = np.full((*velocity.shape, 3), np.nan)
    for axis, spacing_mm in enumerate(field.grid.spacing_mm):
        planes = field.grid.shape_xyz[axis]
        if planes > 1:
            step_m = spacing_mm * MM_TO_M
            gradient[..., axis] = np.gradient(velocity, step_m, axis=2 - axis, edge_order=2 if planes > 2 else 1)
    return gradient
