"""Known flows: functions from points to velocities, made by small factories.

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

Flow = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Velocities in m/s, (n, 3), at points in mm, (n, 3)."""

Axis = Literal["x", "y", "z"]

MM_PER_M = 1000.0

# The terms of the duct's series fall as n^-3 exp(-n pi (1/2 - |z|/D)): 40 odd ones leave 1e-6 of the peak at the wall
# itself and nothing a window's width away from it.
DUCT_TERMS = 40

# A tracer turns by a fraction of a radian in a pair; over a quarter of a radian four Runge-Kutta steps of order 4 leave
# 5e-8 of its distance from the vortex's centre.
ADVECTION_STEPS = 4

ORIGIN = (0.0, 0.0, 0.0)


def _axis_index(axis: Axis) -> int:
    return "xyz".index(axis)


def square_duct(
    width_mm: float, mean_velocity_m_s: float, centre_mm: Sequence[float] = ORIGIN, axis: Literal["x", "y"] = "x"
) -> Flow:
    """Return the fully developed laminar flow along `axis` through a square duct, zero outside it.

    Notes
    -----
    Solves u'' = const with u = 0 on the walls: a parabola across y (or x) less a Fourier series of functions that are
    harmonic, so that the equation holds exactly however few terms are kept. The mean over the section scales it.
    """
    along = _axis_index(axis)
    across = 1 - along
    scale = mean_velocity_m_s / _duct_section_mean()

    def flow(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        relative = (points_mm - np.asarray(centre_mm, dtype=np.float64)) / (0.5 * width_mm)
        velocity = np.zeros_like(relative)
        velocity[:, along] = scale * _duct_profile(relative[:, across], relative[:, 2])
        return velocity

    return flow


def _duct_profile(across: NDArray[np.float64], depth: NDArray[np.float64]) -> NDArray[np.float64]:
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


def _duct_section_mean() -> float:
    """Return the mean of `_duct_profile` over the square."""
    wave = 0.5 * np.pi * _duct_orders()
    return float(2.0 / 3.0 - np.sum(4.0 * np.tanh(wave) / wave**5))


def _duct_orders() -> NDArray[np.int64]:
    return 2 * np.arange(DUCT_TERMS) + 1


def rigid_rotation(
    angular_velocity_rad_s: Sequence[float],
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> Flow:
    """Return omega x (r - centre) + velocity, omega in rad/s (right-handed about x, y, z)."""
    omega = np.asarray(angular_velocity_rad_s, dtype=np.float64)

    def flow(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.cross(omega, points_mm - np.asarray(centre_mm)) / MM_PER_M + np.asarray(velocity_m_s)

    return flow


def taylor_green(
    amplitude_m_s: float,
    wavelength_mm: float,
    centre_mm: Sequence[float] = ORIGIN,
    plane: Literal["xy", "xz", "yz"] = "xz",
    velocity_m_s: Sequence[float] = ORIGIN,
) -> Flow:
    """Return plane Taylor-Green vortices plus a uniform velocity; the corner where four vortices meet is the centre.

    In `plane` (a, b): v_a = A sin(k a) cos(k b), v_b = -A cos(k a) sin(k b), k = 2 pi / wavelength.
    """
    first, second = (_axis_index(axis) for axis in plane)  # type: ignore[arg-type]
    wave = 2.0 * np.pi / wavelength_mm

    def flow(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        relative = wave * (points_mm - np.asarray(centre_mm, dtype=np.float64))
        a, b = relative[:, first], relative[:, second]
        velocity = np.tile(np.asarray(velocity_m_s, dtype=np.float64), (len(points_mm), 1))
        velocity[:, first] += amplitude_m_s * np.sin(a) * np.cos(b)
        velocity[:, second] -= amplitude_m_s * np.cos(a) * np.sin(b)
        return velocity

    return flow


def shear(
    rate_per_s: float,
    along: Axis = "x",
    across: Axis = "z",
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> Flow:
    """Return a velocity along one axis that grows by `rate_per_s` per length across, plus a uniform velocity."""
    component, coordinate = _axis_index(along), _axis_index(across)

    def flow(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        velocity = np.tile(np.asarray(velocity_m_s, dtype=np.float64), (len(points_mm), 1))
        velocity[:, component] += rate_per_s * (points_mm[:, coordinate] - centre_mm[coordinate]) / MM_PER_M
        return velocity

    return flow


def uniform(velocity_m_s: Sequence[float]) -> Flow:
    """Return the same velocity everywhere."""

    def flow(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.tile(np.asarray(velocity_m_s, dtype=np.float64), (len(points_mm), 1))

    return flow


def random_modes(
    rms_m_s: float,
    longest_mm: float = 20.0,
    shortest_mm: float = 0.7,
    modes: int = 200,
    seed: int = 0,
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> Flow:
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

    def flow(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        relative = points_mm - np.asarray(centre_mm, dtype=np.float64)
        waves = np.cos(relative @ (wave[:, np.newaxis] * direction).T + phase)
        return waves @ (amplitude[:, np.newaxis] * polarisation) + np.asarray(velocity_m_s, dtype=np.float64)

    return flow


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


FLOWS: dict[str, Callable[..., Flow]] = {
    "square_duct": square_duct,
    "rigid_rotation": rigid_rotation,
    "taylor_green": taylor_green,
    "shear": shear,
    "uniform": uniform,
    "random_modes": random_modes,
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


def advect(flow: Flow, points_mm: ArrayLike, duration_s: float) -> NDArray[np.float64]:
    """Return where points, (n, 3) in mm, are carried in `duration_s` (negative: where they came from)."""
    points = np.array(points_mm, dtype=np.float64)
    step_s = duration_s / ADVECTION_STEPS

    def moved(by: NDArray[np.float64], share: float) -> NDArray[np.float64]:
        return points + MM_PER_M * share * step_s * by

    for _ in range(ADVECTION_STEPS):
        k1 = flow(points)
        k2 = flow(moved(k1, 0.5))
        k3 = flow(moved(k2, 0.5))
        k4 = flow(moved(k3, 1.0))
        points = moved((k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0, 1.0)
    return points
