"""Smooth known flows in all three dimensions: Taylor-Green vortices, the ABC flow, a vortex ring, a source.

All but the source are solenoidal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lfpiv_cli.arrays import Floats

# What is known of a flow: its velocities, their gradients and, where it has a closed form, its pressure.
#
# Axes: world (x, y, z), z away from the camera. Points in mm, velocities in m/s, gradients per second, pressures in
# Pa.


Flow = Callable[[Floats], Floats]
"""Velocities in m/s, (n, 3), at points in mm, (n, 3)."""

Pressure = Callable[[Floats, float], Floats]
"""Pressures in Pa, (n,), up to a constant, at points in mm, (n, 3), of a fluid of a density in kg/m^3."""

Axis = Literal["x", "y", "z"]

MM_PER_M = 1000.0

ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class KnownFlow:
    """A steady flow, called like its velocities.

    Attributes
    ----------
    velocity : (n, 3) in m/s at points (n, 3) in mm
    gradient : (n, 3, 3) in 1/s, of component i along axis j
    pressure : that of an inviscid fluid, whose gradient is what accelerates this one; None where it has no closed form
    """

    velocity: Flow
    gradient: Callable[[Floats], Floats]
    pressure: Pressure | None = None

    def __call__(self, points_mm: Floats) -> Floats:
        """Return the velocities (n, 3) in m/s at points (n, 3) in mm."""
        return self.velocity(points_mm)


def axis_index(axis: Axis) -> int:
    """Return 0, 1 or 2."""
    return "xyz".index(axis)


def dynamic_pressure(velocity_m_s: Floats, density_kg_m3: float) -> Floats:
    """Return rho |v|^2 / 2, (n,) in Pa, of velocities (n, 3)."""
    return np.asarray(0.5 * density_kg_m3 * np.sum(velocity_m_s**2, axis=1))


def taylor_green(
    amplitude_m_s: float,
    wavelength_mm: float,
    centre_mm: Sequence[float] = ORIGIN,
    plane: Literal["xy", "xz", "yz"] = "xz",
    third_amplitude_m_s: float | None = None,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Return Taylor-Green vortices plus a uniform velocity; the corner where the vortices meet is the centre.

    Plane ones, in `plane` (a, b): v_a = A sin(k a) cos(k b), v_b = -A cos(k a) sin(k b), k = 2 pi / wavelength. With a
    third amplitude C they are three-dimensional: v_a = A sin(k a) cos(k b) cos(k c), v_b = -(A + C) cos(k a) sin(k b)
    cos(k c), v_c = C cos(k a) cos(k b) sin(k c). Plane ones have a closed form of the pressure, if the uniform velocity
    lies along the third axis.
    """
    if third_amplitude_m_s is not None:
        return _cellular(amplitude_m_s, third_amplitude_m_s, wavelength_mm, centre_mm, plane, velocity_m_s)
    first, second = (axis_index(axis) for axis in plane)  # type: ignore[arg-type]
    wave = 2.0 * np.pi / wavelength_mm

    def phases(points_mm: Floats) -> tuple[Floats, Floats]:
        relative = wave * (points_mm - np.asarray(centre_mm, dtype=np.float64))
        return relative[:, first], relative[:, second]

    def flow(points_mm: Floats) -> Floats:
        a, b = phases(points_mm)
        velocity = np.tile(np.asarray(velocity_m_s, dtype=np.float64), (len(points_mm), 1))
        velocity[:, first] += amplitude_m_s * np.sin(a) * np.cos(b)
        velocity[:, second] -= amplitude_m_s * np.cos(a) * np.sin(b)
        return velocity

    def gradient(points_mm: Floats) -> Floats:
        a, b = phases(points_mm)
        found = np.zeros((len(points_mm), 3, 3))
        rate = MM_PER_M * wave * amplitude_m_s
        found[:, first, first] = rate * np.cos(a) * np.cos(b)
        found[:, second, second] = -found[:, first, first]
        found[:, second, first] = rate * np.sin(a) * np.sin(b)
        found[:, first, second] = -found[:, second, first]
        return found

    def pressure(points_mm: Floats, density_kg_m3: float) -> Floats:
        a, b = phases(points_mm)
        return 0.25 * density_kg_m3 * amplitude_m_s**2 * (np.cos(2.0 * a) + np.cos(2.0 * b))

    at_rest = velocity_m_s[first] == 0.0 and velocity_m_s[second] == 0.0
    return KnownFlow(flow, gradient, pressure if at_rest else None)


def _cellular(
    amplitude_m_s: float,
    third_amplitude_m_s: float,
    wavelength_mm: float,
    centre_mm: Sequence[float],
    plane: Literal["xy", "xz", "yz"],
    velocity_m_s: Sequence[float],
) -> KnownFlow:
    """Return three-dimensional Taylor-Green vortices, whose three amplitudes add up to nothing."""
    first, second = (axis_index(axis) for axis in plane)  # type: ignore[arg-type]
    amplitudes = np.empty(3)
    amplitudes[first], amplitudes[second] = amplitude_m_s, -(amplitude_m_s + third_amplitude_m_s)
    amplitudes[3 - first - second] = third_amplitude_m_s
    wave = 2.0 * np.pi / wavelength_mm

    def waves(points_mm: Floats) -> tuple[Floats, Floats]:
        relative = wave * (points_mm - np.asarray(centre_mm, dtype=np.float64))
        return np.sin(relative), np.cos(relative)

    def flow(points_mm: Floats) -> Floats:
        sine, cosine = waves(points_mm)
        others = np.stack([np.prod(np.delete(cosine, i, axis=1), axis=1) for i in range(3)], axis=1)
        return amplitudes * sine * others + np.asarray(velocity_m_s, dtype=np.float64)

    def gradient(points_mm: Floats) -> Floats:
        sine, cosine = waves(points_mm)
        found = np.empty((len(points_mm), 3, 3))
        for i in range(3):
            for j in range(3):
                third = cosine[:, 3 - i - j] if i != j else np.prod(cosine, axis=1)
                found[:, i, j] = third if i == j else -sine[:, i] * sine[:, j] * third
        return MM_PER_M * wave * amplitudes[:, np.newaxis] * found

    return KnownFlow(flow, gradient)


def abc(
    amplitudes_m_s: Sequence[float],
    wavelength_mm: float,
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Return the flow of Arnold, Beltrami and Childress plus a uniform velocity.

    For A, B, C: u = A sin(k z) + C cos(k y), v = B sin(k x) + A cos(k z), w = C sin(k y) + B cos(k x). Its vorticity is
    k times its velocity; without the uniform velocity its pressure is Bernoulli's.
    """
    of_x, of_y, of_z = amplitudes_m_s[1], amplitudes_m_s[2], amplitudes_m_s[0]
    wave = 2.0 * np.pi / wavelength_mm
    # of component i the amplitude of the cosine or sine of k times coordinate j
    cosines = np.array([[0.0, of_y, 0.0], [0.0, 0.0, of_z], [of_x, 0.0, 0.0]])
    sines = np.array([[0.0, 0.0, of_z], [of_x, 0.0, 0.0], [0.0, of_y, 0.0]])

    def flow(points_mm: Floats) -> Floats:
        relative = wave * (points_mm - np.asarray(centre_mm, dtype=np.float64))
        waves = np.cos(relative) @ cosines.T + np.sin(relative) @ sines.T
        return np.asarray(waves + np.asarray(velocity_m_s, dtype=np.float64))

    def gradient(points_mm: Floats) -> Floats:
        relative = wave * (points_mm - np.asarray(centre_mm, dtype=np.float64))[:, np.newaxis]
        return np.asarray(MM_PER_M * wave * (sines * np.cos(relative) - cosines * np.sin(relative)))

    def pressure(points_mm: Floats, density_kg_m3: float) -> Floats:
        return -dynamic_pressure(flow(points_mm), density_kg_m3)

    return KnownFlow(flow, gradient, None if np.any(velocity_m_s) else pressure)


def vortex_ring(
    speed_m_s: float,
    radius_mm: float = 3.0,
    core_mm: float = 1.5,
    axis: Axis = "z",
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Return a frozen vortex ring about `axis` plus a uniform velocity; the fluid in its middle moves along the axis.

    It is the curl of the azimuthal vector potential a rho exp(-(p^2 + z^2) / (2 core^2)), p = (rho^2 - R^2) / (2 R),
    near the ring its distance: smooth on the axis, and gone a few cores off. At one core's distance from the middle of
    a thin core the fluid turns with `speed_m_s`; where R is two cores, this is the speed in the ring's middle.
    """
    along = axis_index(axis)
    order = [(along + 1) % 3, (along + 2) % 3, along]
    strength = speed_m_s * np.exp(0.5) * core_mm / radius_mm

    def local(points_mm: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        x, y, z = (points_mm - np.asarray(centre_mm, dtype=np.float64))[:, order].T
        return x, y, z, (x**2 + y**2 - radius_mm**2) / (2.0 * radius_mm)

    def potential(p: Floats, z: Floats) -> Floats:
        return np.asarray(strength * np.exp(-(p**2 + z**2) / (2.0 * core_mm**2)))

    def flow(points_mm: Floats) -> Floats:
        x, y, z, p = local(points_mm)
        g = potential(p, z)
        by_s, by_z = -p / (2.0 * radius_mm * core_mm**2) * g, -z / core_mm**2 * g
        velocity = np.empty_like(points_mm, dtype=np.float64)
        velocity[:, order] = np.stack([-x * by_z, -y * by_z, 2.0 * (g + (x**2 + y**2) * by_s)], axis=1)
        return velocity + np.asarray(velocity_m_s, dtype=np.float64)

    def gradient(points_mm: Floats) -> Floats:
        x, y, z, p = local(points_mm)
        s, core2, g = x**2 + y**2, core_mm**2, potential(p, z)
        # s = rho^2: the potential's derivatives along s and z, p rising with s by 1 / (2 R)
        by_s, by_z = -p / (2.0 * radius_mm * core2) * g, -z / core2 * g
        by_ss = (p**2 / core2 - 1.0) / (4.0 * radius_mm**2 * core2) * g
        by_sz, by_zz = p * z / (2.0 * radius_mm * core2**2) * g, (z**2 / core2 - 1.0) / core2 * g
        twist, lift = -2.0 * x * y * by_sz, 4.0 * (2.0 * by_s + s * by_ss)
        rows = [
            [-by_z - 2.0 * x**2 * by_sz, twist, -x * by_zz],
            [twist, -by_z - 2.0 * y**2 * by_sz, -y * by_zz],
            [x * lift, y * lift, 2.0 * (by_z + s * by_sz)],
        ]
        found = np.empty((len(points_mm), 3, 3))
        found[np.ix_(range(len(found)), order, order)] = np.moveaxis(np.array(rows), 2, 0)
        return MM_PER_M * found

    return KnownFlow(flow, gradient)


def source(
    rate_per_s: float,
    radius_mm: float = 2.0,
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Return the flow out of a Gaussian cloud, q exp(-r^2 / (2 radius^2)) r, plus a uniform velocity.

    It is not solenoidal: `rate_per_s` is its divergence at the centre, 3 q; beyond 1.7 radii sinks take up the fluid.
    """
    third = rate_per_s / 3.0

    def spread(points_mm: Floats) -> tuple[Floats, Floats]:
        r = points_mm - np.asarray(centre_mm, dtype=np.float64)
        return r, third * np.exp(-np.sum(r**2, axis=1, keepdims=True) / (2.0 * radius_mm**2))

    def flow(points_mm: Floats) -> Floats:
        r, q = spread(points_mm)
        return q * r / MM_PER_M + np.asarray(velocity_m_s, dtype=np.float64)

    def gradient(points_mm: Floats) -> Floats:
        r, q = spread(points_mm)
        outer = r[:, :, np.newaxis] * r[:, np.newaxis]
        return np.asarray(q[:, :, np.newaxis] * (np.eye(3) - outer / radius_mm**2))

    return KnownFlow(flow, gradient)
