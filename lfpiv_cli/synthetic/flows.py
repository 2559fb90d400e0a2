"""Known flows, made by small factories, and the way of what they carry.

Axes: world (x, y, z), z away from the camera, in the frame of the points that are passed in; each flow is placed by its
`centre_mm` in that frame. Points in mm, velocities in m/s, rates per second. A new flow is one factory and one line of
`FLOWS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.synthetic.vortices import (
    MM_PER_M,
    ORIGIN,
    Axis,
    Flow,
    KnownFlow,
    abc,
    axis_index,
    dynamic_pressure,
    source,
    taylor_green,
    vortex_ring,
)

# The terms of the duct's series fall as n^-3 exp(-n pi (1/2 - |z|/D)): 40 odd ones leave 1e-6 of the peak at the wall
# itself and nothing a window's width away from it.
DUCT_TERMS = 40

# A tracer turns by a fraction of a radian in a pair; over a quarter of a radian four Runge-Kutta steps of order 4 leave
# 5e-8 of its distance from the vortex's centre.
ADVECTION_STEPS = 4


def square_duct(
    width_mm: float, mean_velocity_m_s: float, centre_mm: Sequence[float] = ORIGIN, axis: Literal["x", "y"] = "x"
) -> KnownFlow:
    """Return the fully developed laminar flow along `axis` through a square duct, zero outside it.

    Notes
    -----
    Solves u'' = const with u = 0 on the walls: a parabola across y (or x) less a Fourier series of functions that are
    harmonic, so that the equation holds exactly however few terms are kept. The mean over the section scales it.
    """
    along = axis_index(axis)
    across = 1 - along
    scale = mean_velocity_m_s / _duct_section_mean()

    def flow(points_mm: Floats) -> Floats:
        relative = (points_mm - np.asarray(centre_mm, dtype=np.float64)) / (0.5 * width_mm)
        velocity = np.zeros_like(relative)
        velocity[:, along] = scale * _duct_profile(relative[:, across], relative[:, 2])
        return velocity

    def gradient(points_mm: Floats) -> Floats:
        relative = (points_mm - np.asarray(centre_mm, dtype=np.float64)) / (0.5 * width_mm)
        found = np.zeros((len(points_mm), 3, 3))
        slopes = _duct_slopes(relative[:, across], relative[:, 2])
        found[:, along, across], found[:, along, 2] = (scale * MM_PER_M / (0.5 * width_mm) * slope for slope in slopes)
        return found

    return KnownFlow(flow, gradient)


def _duct_profile(across: Floats, depth: Floats) -> Floats:
    """Return u on the square [-1, 1]^2 for u'' = -2, zero on its edge and outside."""
    profile = 1.0 - across**2
    outside = (np.abs(across) >= 1.0) | (np.abs(depth) >= 1.0)
    inner_depth = np.minimum(np.abs(depth), 1.0)
    for order in _duct_orders():
        wave = 0.5 * np.pi * order
        # cosh(wave z)/cosh(wave) in exponentials that cannot overflow
        decay = np.exp(wave * (inner_depth - 1.0)) * (1.0 + np.exp(-2.0 * wave * inner_depth))
        decay /= 1.0 + np.exp(-2.0 * wave)
        profile -= 4.0 * np.sin(wave) / wave**3 * np.cos(wave * across) * decay
    return np.where(outside, 0.0, profile)


def _duct_slopes(across: Floats, depth: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives of `_duct_profile` across and along the depth, zero on its edge and outside."""
    by_across, by_depth = -2.0 * across, np.zeros_like(depth)
    inside = (np.abs(across) < 1.0) & (np.abs(depth) < 1.0)
    inner_depth = np.minimum(np.abs(depth), 1.0)
    for order in _duct_orders():
        wave = 0.5 * np.pi * order
        grown, shrunk = np.exp(wave * (inner_depth - 1.0)), np.exp(-2.0 * wave * inner_depth)
        factor = 4.0 * np.sin(wave) / wave**2 * grown / (1.0 + np.exp(-2.0 * wave))
        by_across += factor * np.sin(wave * across) * (1.0 + shrunk)
        by_depth -= factor * np.cos(wave * across) * (1.0 - shrunk)
    return np.where(inside, by_across, 0.0), np.where(inside, np.sign(depth) * by_depth, 0.0)


def _duct_section_mean() -> float:
    """Return the mean of `_duct_profile` over the square."""
    wave = 0.5 * np.pi * _duct_orders()
    return float(2.0 / 3.0 - np.sum(4.0 * np.tanh(wave) / wave**5))


def _duct_orders() -> NDArray[np.int64]:
    return 2 * np.arange(DUCT_TERMS) + 1


def pipe(
    radius_mm: float,
    mean_velocity_m_s: float,
    centre_mm: Sequence[float] = ORIGIN,
    axis: Literal["x", "y"] | Sequence[float] = "x",
) -> KnownFlow:
    """Return Poiseuille's flow along `axis` through a round pipe, u = 2 U (1 - r^2/R^2), zero outside it.

    The axis is x, y or a direction of any length, towards which the fluid flows.
    """
    along = np.eye(3)[axis_index(axis)] if axis in ("x", "y") else _unit(np.asarray([axis], dtype=np.float64))[0]

    def across(points_mm: Floats) -> tuple[Floats, Floats]:
        """Return places from the axis over the radius, (n, 3), and 1 - r^2/R^2, (n,)."""
        relative = (points_mm - np.asarray(centre_mm, dtype=np.float64)) / radius_mm
        relative -= (relative @ along)[:, np.newaxis] * along
        return relative, 1.0 - np.sum(relative**2, axis=1)

    def flow(points_mm: Floats) -> Floats:
        speed = 2.0 * mean_velocity_m_s * np.maximum(across(points_mm)[1], 0.0)
        return np.asarray(speed[:, np.newaxis] * along)

    def gradient(points_mm: Floats) -> Floats:
        relative, profile = across(points_mm)
        slope = -4.0 * mean_velocity_m_s * MM_PER_M / radius_mm * relative
        slope = np.where(profile[:, np.newaxis] > 0.0, slope, 0.0)
        return np.asarray(along[:, np.newaxis] * slope[:, np.newaxis, :])

    return KnownFlow(flow, gradient)


def rigid_rotation(
    angular_velocity_rad_s: Sequence[float],
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Return omega x (r - centre) + velocity, omega in rad/s (right-handed about x, y, z), and its pressure."""
    omega = np.asarray(angular_velocity_rad_s, dtype=np.float64)

    def flow(points_mm: Floats) -> Floats:
        return np.cross(omega, points_mm - np.asarray(centre_mm)) / MM_PER_M + np.asarray(velocity_m_s)

    def pressure(points_mm: Floats, density_kg_m3: float) -> Floats:
        return dynamic_pressure(flow(points_mm), density_kg_m3)

    return KnownFlow(flow, _constant(np.cross(omega, np.eye(3)).T), pressure)


def _constant(gradient: Floats) -> Flow:
    """Return the same gradient (3, 3) everywhere."""
    return lambda points_mm: np.tile(gradient, (len(points_mm), 1, 1))


def shear(
    rate_per_s: float,
    along: Axis = "x",
    across: Axis = "z",
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Return a velocity along one axis that grows by `rate_per_s` per length across, plus a uniform velocity."""
    component, coordinate = axis_index(along), axis_index(across)

    def flow(points_mm: Floats) -> Floats:
        velocity = np.tile(np.asarray(velocity_m_s, dtype=np.float64), (len(points_mm), 1))
        velocity[:, component] += rate_per_s * (points_mm[:, coordinate] - centre_mm[coordinate]) / MM_PER_M
        return velocity

    gradient = np.zeros((3, 3))
    gradient[component, coordinate] = rate_per_s
    return KnownFlow(flow, _constant(gradient))


def uniform(velocity_m_s: Sequence[float]) -> KnownFlow:
    """Return the same velocity everywhere."""

    def flow(points_mm: Floats) -> Floats:
        return np.tile(np.asarray(velocity_m_s, dtype=np.float64), (len(points_mm), 1))

    return KnownFlow(flow, _constant(np.zeros((3, 3))))


def random_modes(
    rms_m_s: float,
    longest_mm: float = 20.0,
    shortest_mm: float = 0.7,
    modes: int = 200,
    seed: int = 0,
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Return a frozen picture of turbulence: solenoidal waves in random directions, plus a uniform velocity.

    Wave numbers are evenly spread in their logarithm and energies follow Kolmogorov's spectrum, E(k) ~ k^(-5/3);
    `rms_m_s` is that of each component, over all space and all seeds.
    """
    rng = np.random.default_rng(seed)
    wave = 2.0 * np.pi * np.exp(rng.uniform(-np.log(longest_mm), -np.log(shortest_mm), modes))
    direction, other = _unit(rng.normal(size=(modes, 3))), rng.normal(size=(modes, 3))
    polarisation = _unit(np.cross(direction, other))
    phase = rng.uniform(0.0, 2.0 * np.pi, modes)
    # the energy of an interval of ln k is k E(k); a wave of amplitude a has a^2 / 2, over three components
    amplitude = wave ** (-1.0 / 3.0)
    amplitude *= rms_m_s * np.sqrt(6.0 / np.sum(amplitude**2))

    def flow(points_mm: Floats) -> Floats:
        relative = points_mm - np.asarray(centre_mm, dtype=np.float64)
        waves = np.cos(relative @ (wave[:, np.newaxis] * direction).T + phase)
        return waves @ (amplitude[:, np.newaxis] * polarisation) + np.asarray(velocity_m_s, dtype=np.float64)

    def gradient(points_mm: Floats) -> Floats:
        relative = points_mm - np.asarray(centre_mm, dtype=np.float64)
        along = wave[:, np.newaxis] * direction
        slopes = -np.sin(relative @ along.T + phase)
        by_mode = amplitude[:, np.newaxis, np.newaxis] * polarisation[:, :, np.newaxis] * along[:, np.newaxis]
        return np.asarray(MM_PER_M * np.tensordot(slopes, by_mode, axes=1))

    return KnownFlow(flow, gradient)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


FLOWS: dict[str, Callable[..., KnownFlow]] = {
    "square_duct": square_duct,
    "pipe": pipe,
    "rigid_rotation": rigid_rotation,
    "taylor_green": taylor_green,
    "shear": shear,
    "uniform": uniform,
    "random_modes": random_modes,
    "abc": abc,
    "vortex_ring": vortex_ring,
    "source": source,
}


@dataclass(frozen=True)
class Pulsation:
    """How a flow changes in time, everywhere alike: its velocity times 1 + amplitude sin(2 pi frequency_hz t).

    At t = 0 the flow is as it is given, and its acceleration, 2 pi frequency_hz amplitude of its velocity, is largest.
    """

    amplitude: float = 0.0
    frequency_hz: float = 0.0

    def carried_s(self, time_s: float) -> float:
        """Return for how long the steady flow would carry a tracer as far as this one has from t = 0 to `time_s`.

        It is the integral of the factor, which is the same everywhere: tracers keep the steady flow's paths.
        """
        turns = self.frequency_hz * time_s
        return float(time_s * (1.0 + self.amplitude * np.sin(np.pi * turns) * np.sinc(turns)))


STEADY = Pulsation()


def advect(flow: Flow, points_mm: ArrayLike, duration_s: float) -> Floats:
    """Return where points, (n, 3) in mm, are carried in `duration_s` (negative: where they came from)."""
    points = np.array(points_mm, dtype=np.float64)
    step_s = duration_s / ADVECTION_STEPS

    def moved(by: Floats, share: float) -> Floats:
        return points + MM_PER_M * share * step_s * by

    for _ in range(ADVECTION_STEPS):
        k1 = flow(points)
        k2 = flow(moved(k1, 0.5))
        k3 = flow(moved(k2, 0.5))
        k4 = flow(moved(k3, 1.0))
        points = moved((k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0, 1.0)
    return points
