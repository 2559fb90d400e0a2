"""Figures of turbulence: fluctuations, dissipation and the spectrum of the kinetic energy.

A fitted field has little noise, and lacks what the fit has smoothed away: the flow lies about it with errors that are
independent of the fit, whose variance is put on. What a field does not resolve at all, as the scales below its knots,
it does not tell.

Axes: arrays `[z, y, x]` or (n,), vectors (u, v, w) along (x, y, z) last, gradients (component, direction) last.
Units: m/s and 1/s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv_cli.arrays import Floats

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


@dataclass(frozen=True)
class Dissipation:
    """The rate at which friction takes kinetic energy, m^2/s^3.

    Attributes
    ----------
    rate : of the flow, errors put right
    sigma : standard error of the mean over the volume
    """

    rate: float
    sigma: float


def dissipation(gradient: Floats, covariance: Floats, viscosity_m2_s: float, independent: float) -> Dissipation:
    """Return 2 nu <s_ij s_ij> of the rate of strain s.

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
    return Dissipation(double * put_right, double * sigma)


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
