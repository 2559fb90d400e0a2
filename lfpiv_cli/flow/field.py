"""The vector field that two volumes yield: displacements at window centres, with what is known of their quality.

Axes: arrays are indexed `[z, y, x]`; the last axis of a vector holds its components (u, v, w) along (x, y, z). A
particle that moves towards +x from the first volume to the second has u > 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as field_of
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import FOCAL_POINT, Grid, Reference
from lfpiv_cli.results import ArrayResult
from lfpiv_cli.robust import HALF_NORMAL_MEDIAN

# Flags, in the order of decreasing trust. A velocity is finite up to SECOND_PEAK and NaN from REJECTED on.
VALID = 0
REPLACED = 1
SECOND_PEAK = 2
REJECTED = 3
MASKED = 4

FLAG_NAMES = {VALID: "valid", SECOND_PEAK: "second peak", REPLACED: "replaced", REJECTED: "rejected", MASKED: "masked"}

MM_TO_M = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class VectorField(ArrayResult):
    """Displacements between two volumes at the centres of the correlation windows.

    Attributes
    ----------
    grid : the window centres, mm
    displacement_voxel : (nz, ny, nx, 3) float64, after validation and without what long particles mix
    displacement_raw_voxel : (nz, ny, nx, 3) float64, as the correlation peak gave it, before validation
    correlation : (nz, ny, nx) normalised correlation at the peak, 1 for identical windows
    peak_ratio : (nz, ny, nx) height of the peak over that of the second one
    valid_fraction : (nz, ny, nx) share of the window inside both volumes and the mask, 0 to 1
    flag : (nz, ny, nx) uint8, one of VALID, REPLACED, SECOND_PEAK, REJECTED, MASKED
    uncertainty_voxel : (nz, ny, nx, 3) standard deviation of each component, or None where it is not known
    voxel_mm : size of a voxel along x, y, z
    dt_s : time between the volumes, or None where it is not known
    window_voxel : size of the final windows along x, y, z
    reference : the origin of its coordinates
    provenance : the record of how it was made
    """

    grid: Grid
    displacement_voxel: Floats
    displacement_raw_voxel: Floats
    correlation: Floats
    peak_ratio: Floats
    valid_fraction: Floats
    flag: NDArray[np.uint8]
    uncertainty_voxel: Floats | None
    voxel_mm: tuple[float, float, float]
    dt_s: float | None
    window_voxel: tuple[int, int, int]
    reference: Reference = FOCAL_POINT
    provenance: dict[str, Any] = field_of(default_factory=dict)

    @property
    def flag_counts(self) -> dict[str, int]:
        """How many vectors have each flag, by its name."""
        return {name: int(np.count_nonzero(self.flag == flag)) for flag, name in FLAG_NAMES.items()}

    @property
    def velocity(self) -> Floats:
        """Velocity in m/s, shape (nz, ny, nx, 3): NaN where the vector is rejected or masked, or the time unknown."""
        if self.dt_s is None:
            return np.full(self.displacement_voxel.shape, np.nan)
        velocity = self.displacement_voxel * (np.asarray(self.voxel_mm) * MM_TO_M / self.dt_s)
        velocity[self.flag >= REJECTED] = np.nan
        return velocity


# What follows from the gradients of a velocity field; rates in 1/s.


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

    vorticity: Floats
    divergence: Floats
    strain_rate: Floats
    q_criterion: Floats

    @property
    def divergence_rms(self) -> float | None:
        """The rms of the divergence in 1/s, None where it is known nowhere."""
        known = self.divergence[np.isfinite(self.divergence)]
        return float(np.sqrt(np.mean(known**2))) if known.size else None


def derived_fields(field: VectorField) -> Derived:
    """Return the derived fields by central differences, one-sided at the faces and exact for quadratic flows there."""
    velocity = field.velocity
    gradient = np.full((*velocity.shape, 3), np.nan)
    for axis, spacing_mm in enumerate(field.grid.spacing_mm):
        planes = field.grid.shape_xyz[axis]
        if planes > 1:
            step_m = spacing_mm * MM_TO_M
            gradient[..., axis] = np.gradient(velocity, step_m, axis=2 - axis, edge_order=2 if planes > 2 else 1)
    return derived_from(gradient)


def derived_from(gradient: Floats) -> Derived:
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


# What a flow says against its own vectors, no truth known: its divergence, and another measurement of it.
#
# A liquid has no divergence, so that what is found comes from errors, and from what windows cannot resolve. Beside
# the divergence that the stated standard deviations make, a ratio of 1 confirms them; a large one says that they are
# too small. Two measurements of one flow by different ways differ likewise by what their standard deviations let
# expect.

# Fewer places than this tell no ratio.
FEWEST_PLACES = 20


def divergence_over_stated(field: VectorField) -> float | None:
    """Return how large the divergence is over the one that the stated standard deviations make; None: not known.

    By central differences, where all six vectors around a place are there: these are two apart, and windows that
    overlap by half share nothing there.
    """
    sigma = _sigma_mm(field)
    if sigma is None or min(field.grid.shape_xyz) < 3:
        return None
    moved = np.where((field.flag < REJECTED)[..., np.newaxis], field.displacement_voxel * field.voxel_mm, np.nan)
    inner = tuple(n - 2 for n in field.flag.shape)
    divergence, variance = np.zeros(inner), np.zeros(inner)
    for axis, spacing_mm in enumerate(field.grid.spacing_mm):
        divergence = divergence + _beside(moved[..., axis], axis, -1.0) / (2.0 * spacing_mm)
        variance = variance + _beside(sigma[..., axis] ** 2, axis, 1.0) / (2.0 * spacing_mm) ** 2
    return _ratio(divergence, np.sqrt(variance))


def difference_over_stated(one: VectorField, other: VectorField) -> list[float] | None:
    """Return how large the differences of two fields on one grid are over those expected, by component.

    None where the grids are not the same, or too few vectors are in both.
    """
    sigma_one, sigma_other = _sigma_mm(one), _sigma_mm(other)
    same = one.grid.shape_xyz == other.grid.shape_xyz and np.allclose(
        [one.grid.spacing_mm, one.grid.origin_mm], [other.grid.spacing_mm, other.grid.origin_mm]
    )
    if not same or sigma_one is None or sigma_other is None:
        return None
    both = (one.flag < REJECTED) & (other.flag < REJECTED)
    off = one.displacement_voxel * one.voxel_mm - other.displacement_voxel * other.voxel_mm
    ratios = [_ratio(off[both, k], np.hypot(sigma_one, sigma_other)[both, k]) for k in range(3)]
    known = [ratio for ratio in ratios if ratio is not None]
    return known if len(known) == len(ratios) else None


def _sigma_mm(field: VectorField) -> Floats | None:
    return None if field.uncertainty_voxel is None else field.uncertainty_voxel * field.voxel_mm


def _beside(values: Floats, axis: int, sign: float) -> Floats:
    """Return the values one further along x, y or z (0, 1, 2) and sign times those one back, of the inner places."""
    inner = [slice(1, -1)] * 3
    ahead, back = list(inner), list(inner)
    ahead[2 - axis], back[2 - axis] = slice(2, None), slice(None, -2)
    return np.asarray(values[tuple(ahead)] + sign * values[tuple(back)])


def _ratio(errors: Floats, sigma: Floats) -> float | None:
    """Return the usual size of errors in stated standard deviations."""
    known = np.isfinite(errors) & np.isfinite(sigma) & (sigma > 0.0)
    if np.count_nonzero(known) < FEWEST_PLACES:
        return None
    return float(np.median(np.abs(errors[known]) / sigma[known]) / HALF_NORMAL_MEDIAN)


# Figures of turbulence: fluctuations, dissipation and the spectrum of the kinetic energy.
#
# A fitted field has little noise, and lacks what the fit has smoothed away: the flow lies about it with errors that are
# independent of the fit, whose variance is put on. What a field does not resolve at all, as the scales below its knots,
# it does not tell.
#
# Axes: arrays `[z, y, x]` or (n,), gradients (component, direction) last. Units: m/s and 1/s.

MM_PER_M = 1000.0
# A window has a shape from so many on.
FEWEST_PLANES = 4


def fluctuations(velocity: Floats, over: tuple[int, ...]) -> Floats:
    """Return velocities less their mean over some axes, those of a homogeneous direction or of time; NaN is left out.

    Parameters
    ----------
    velocity : (..., 3), as (nz, ny, nx, 3) or (frames, nz, ny, nx, 3)
    over : the axes
    """
    return velocity - np.nanmean(velocity, axis=over, keepdims=True)


def reynolds_stresses(fluctuation: Floats, variance: Floats) -> Floats:
    """Return <u_i' u_j'>, (3, 3) in m^2/s^2.

    Parameters
    ----------
    fluctuation : (..., 3) m/s
    variance : (..., 3) of its errors, m^2/s^2
    """
    flat = fluctuation.reshape(-1, 3)
    known = np.isfinite(flat).all(axis=1)
    stresses = flat[known].T @ flat[known] / max(int(np.count_nonzero(known)), 1)
    return np.asarray(stresses + np.diag(np.nanmean(variance.reshape(-1, 3)[known], axis=0)))


def kinetic_energy(stresses: Floats) -> float:
    """Return the kinetic energy of the fluctuations, (<u'^2> + <v'^2> + <w'^2>) / 2 in m^2/s^2."""
    return 0.5 * float(np.trace(stresses))


def dissipation(gradient: Floats, covariance: Floats, viscosity_m2_s: float, independent: float) -> tuple[float, float]:
    """Return the rate at which friction takes kinetic energy, 2 nu <s_ij s_ij>, m^2/s^3, and its standard error.

    Errors are put right; s is the rate of strain.

    Parameters
    ----------
    gradient : (n, 3, 3) 1/s
    covariance : (n, 9, 9) of the gradients' errors, 1/s^2, the gradient's elements in C order
    independent : number of points that err independently of each other, as that of the fit's knots
    """
    strain = 0.5 * (gradient + gradient.swapaxes(-1, -2))
    flat = strain.reshape(-1, 9)
    # What makes the symmetric part of a gradient.
    through = 0.5 * (np.eye(9) + np.eye(9).reshape(9, 3, 3).swapaxes(1, 2).reshape(9, 9))
    of_errors = through @ covariance @ through
    noise = np.trace(of_errors, axis1=-2, axis2=-1)
    each = np.sum(flat**2, axis=1)
    # Of a Gaussian vector's square: 4 m' C m + 2 tr C^2.
    variance = 4.0 * np.einsum("ni,nij,nj->n", flat, of_errors, flat) + 2.0 * np.sum(of_errors**2, axis=(1, 2))
    sigma = float(np.sqrt(np.mean(variance) / max(independent, 1.0)))
    put_right = float(np.mean(each) + np.mean(noise))
    double = 2.0 * viscosity_m2_s
    return double * put_right, double * sigma


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The kinetic energy by wavenumber.

    Attributes
    ----------
    wavenumber : (k,) rad/m, middles of shells of equal width
    energy : (k,) m^3/s^2 per unit of mass: its sum times the shells' width is the kinetic energy
    width : of a shell, rad/m
    """

    wavenumber: Floats
    energy: Floats
    width: float


def spectrum(fluctuation: Floats, spacing_mm: Sequence[float]) -> Spectrum:
    """Return the spectrum of the kinetic energy in shells of wavenumbers, of fluctuations on a regular grid.

    A Hann window along each axis, of mean square 1, lets the faces not speak: the box is not periodic. The sum over all
    shells is the kinetic energy of the windowed fluctuations, which differs from that of all by chance alone.

    Parameters
    ----------
    fluctuation : (nz, ny, nx, 3) m/s, finite
    spacing_mm : of the nodes along x, y, z

    Raises
    ------
    ValueError
        The grid has fewer planes than four along an axis.
    """
    shape = fluctuation.shape[:3]
    if min(shape) < FEWEST_PLANES:
        raise ValueError(f"a spectrum needs {FEWEST_PLANES} planes along each axis, and the grid has {min(shape)}")
    window = np.ones(shape)
    for axis, count in enumerate(shape):
        along = np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2
        window *= np.expand_dims(along / np.sqrt(np.mean(along**2)), tuple({0, 1, 2} - {axis}))
    modes = np.fft.fftn(fluctuation * window[..., np.newaxis], axes=(0, 1, 2)) / np.prod(shape)
    energy = 0.5 * np.sum(np.abs(modes) ** 2, axis=-1)
    steps_m = np.asarray(spacing_mm)[::-1] / MM_PER_M
    waves = [2.0 * np.pi * np.fft.fftfreq(count, step) for count, step in zip(shape, steps_m, strict=True)]
    size = np.sqrt(np.sum(np.square(np.meshgrid(*waves, indexing="ij")), axis=0))
    width = float(2.0 * np.pi / np.min(np.multiply(shape, steps_m)))
    shell = np.rint(size / width).astype(np.int64)
    by_shell = np.bincount(shell.ravel(), energy.ravel())
    wavenumbers = np.asarray(width * np.arange(len(by_shell)), dtype=np.float64)
    return Spectrum(wavenumbers, np.asarray(by_shell / width, dtype=np.float64), width)
