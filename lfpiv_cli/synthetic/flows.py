"""Known flows, made by small factories, and the way of what they carry.

Axes: world (x, y, z), z away from the camera, in the frame of the points that are passed in; each flow is placed by its
`centre_mm` in that frame. Points in mm, velocities in m/s, rates and gradients per second, pressures in Pa. A new flow
is one factory, which says it about the origin, and one line of `FLOWS`: `files.sections_work.flow_section` makes the
section of the configuration from the factory's parameters, and says of it what the factory's docstring says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Floats

Flow = Callable[[Floats], Floats]
"""Velocities in m/s, (n, 3), at points in mm, (n, 3)."""

Pressure = Callable[[Floats, float], Floats]
"""Pressures in Pa, (n,), up to a constant, at points in mm, (n, 3), of a fluid of a density in kg/m^3."""

Axis = Literal["x", "y", "z"]

MM_PER_M = 1000.0

ORIGIN = (0.0, 0.0, 0.0)

# The terms of the duct's series fall as n^-3 exp(-n pi (1/2 - |z|/D)): 40 odd ones leave 1e-6 of the peak at the wall
# itself and nothing a window's width away from it.
DUCT_ORDERS = 2 * np.arange(40) + 1

# A tracer turns by a fraction of a radian in a pair; over a quarter of a radian four Runge-Kutta steps of order 4 leave
# 5e-8 of its distance from the vortex's centre.
ADVECTION_STEPS = 4

# Over waves of 1 mm differences miss 5e-11 of a slope, and the rounding of places makes 1e-11 of it.
SLOPE_STEP_MM = 1e-3


@dataclass(frozen=True, eq=False)
class KnownFlow:
    """A steady flow, called like its velocities.

    Attributes
    ----------
    velocity : (n, 3) in m/s at points (n, 3) in mm
    pressure : that of an inviscid fluid, whose gradient is what accelerates this one; None where it has no closed form
    """

    velocity: Flow
    pressure: Pressure | None = None

    def __call__(self, points_mm: Floats) -> Floats:
        """Return the velocities (n, 3) in m/s at points (n, 3) in mm."""
        return self.velocity(points_mm)

    def gradient(self, points_mm: Floats) -> Floats:
        """Return the gradients (n, 3, 3) in 1/s, of component i along axis j, at points (n, 3) in mm.

        By differences of fourth order: right to 1e-9 of the largest where the flow is smooth over `SLOPE_STEP_MM`, as
        it is but at a wall.
        """
        columns = []
        for step in SLOPE_STEP_MM * np.eye(3):
            near, far = (self.velocity(points_mm + k * step) - self.velocity(points_mm - k * step) for k in (1, 2))
            columns.append((8.0 * near - far) * (MM_PER_M / (12.0 * SLOPE_STEP_MM)))
        return np.stack(columns, axis=2)


def _placed(
    flow: Flow,
    centre_mm: Sequence[float],
    velocity_m_s: Sequence[float] | None = None,
    pressure: Pressure | None = None,
) -> KnownFlow:
    """Return a flow about the origin moved to a centre, plus a uniform velocity."""
    centre = np.asarray(centre_mm, dtype=np.float64)
    uniform_m_s = np.zeros(3) if velocity_m_s is None else np.asarray(velocity_m_s, dtype=np.float64)

    def velocity(points_mm: Floats) -> Floats:
        own = flow(points_mm - centre)
        return own if velocity_m_s is None else np.asarray(own + uniform_m_s)

    if pressure is None:
        return KnownFlow(velocity)
    return KnownFlow(velocity, lambda points_mm, density_kg_m3: pressure(points_mm - centre, density_kg_m3))


def dynamic_pressure(velocity_m_s: Floats, density_kg_m3: float) -> Floats:
    """Return rho |v|^2 / 2, (n,) in Pa, of velocities (n, 3)."""
    return np.asarray(0.5 * density_kg_m3 * np.sum(velocity_m_s**2, axis=1))


def square_duct(
    width_mm: float, mean_velocity_m_s: float, centre_mm: Sequence[float] = ORIGIN, axis: Literal["x", "y"] = "x"
) -> KnownFlow:
    """Fully developed laminar flow along `axis` (x or y) through a square duct of `width_mm`, zero outside it.

    mean_velocity_m_s: the mean over its section. centre_mm: of every flow, in the volume's coordinates (default: 0).

    Notes
    -----
    Solves u'' = const with u = 0 on the walls: a parabola across y (or x) less a Fourier series of functions that are
    harmonic, so that the equation holds exactly however few terms are kept. The mean over the section scales it.
    """
    along = "xyz".index(axis)
    across = 1 - along
    waves = 0.5 * np.pi * DUCT_ORDERS
    # over the mean over the square [-1, 1]^2 of u for u'' = -2
    scale = mean_velocity_m_s / float(2.0 / 3.0 - np.sum(4.0 * np.tanh(waves) / waves**5))

    def flow(relative_mm: Floats) -> Floats:
        places = relative_mm / (0.5 * width_mm)
        beside, depth = places[:, across], places[:, 2]
        profile = 1.0 - beside**2
        inner_depth = np.minimum(np.abs(depth), 1.0)
        for wave in waves:
            # cosh(wave z)/cosh(wave) in exponentials that cannot overflow
            decay = np.exp(wave * (inner_depth - 1.0)) * (1.0 + np.exp(-2.0 * wave * inner_depth))
            decay /= 1.0 + np.exp(-2.0 * wave)
            profile -= 4.0 * np.sin(wave) / wave**3 * np.cos(wave * beside) * decay
        velocity = np.zeros_like(places)
        velocity[:, along] = scale * np.where((np.abs(beside) >= 1.0) | (np.abs(depth) >= 1.0), 0.0, profile)
        return velocity

    return _placed(flow, centre_mm)


def pipe(
    radius_mm: float,
    mean_velocity_m_s: float,
    centre_mm: Sequence[float] = ORIGIN,
    axis: Literal["x", "y"] | Sequence[float] = "x",
) -> KnownFlow:
    """Poiseuille's flow along `axis` through a round pipe of `radius_mm`, u = 2 U (1 - r^2/R^2), zero outside it.

    axis: x, y or a direction [x, y, z] of any length, towards which the fluid flows. mean_velocity_m_s: U, the mean
    over its section, half of that on its axis.
    """
    along = np.eye(3)["xyz".index(axis)] if axis in ("x", "y") else _unit(np.asarray([axis], dtype=np.float64))[0]

    def flow(relative_mm: Floats) -> Floats:
        relative = relative_mm / radius_mm
        relative -= (relative @ along)[:, np.newaxis] * along
        speed = 2.0 * mean_velocity_m_s * np.maximum(1.0 - np.sum(relative**2, axis=1), 0.0)
        return np.asarray(speed[:, np.newaxis] * along)

    return _placed(flow, centre_mm)


def rigid_rotation(
    angular_velocity_rad_s: Sequence[float], centre_mm: Sequence[float] = ORIGIN, velocity_m_s: Sequence[float] = ORIGIN
) -> KnownFlow:
    """Rotation as a rigid body: angular_velocity_rad_s x (r - centre_mm) + velocity_m_s, right-handed about x, y, z."""
    omega = np.asarray(angular_velocity_rad_s, dtype=np.float64)

    def flow(relative_mm: Floats) -> Floats:
        return np.cross(omega, relative_mm) / MM_PER_M

    def pressure(relative_mm: Floats, density_kg_m3: float) -> Floats:
        return dynamic_pressure(flow(relative_mm) + np.asarray(velocity_m_s), density_kg_m3)

    return _placed(flow, centre_mm, velocity_m_s, pressure)


def shear(
    rate_per_s: float,
    along: Axis = "x",
    across: Axis = "z",
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """A velocity along one axis that grows by `rate_per_s` across another, zero at centre_mm, plus velocity_m_s."""
    component, coordinate = "xyz".index(along), "xyz".index(across)

    def flow(relative_mm: Floats) -> Floats:
        velocity = np.zeros((len(relative_mm), 3))
        velocity[:, component] = rate_per_s * relative_mm[:, coordinate] / MM_PER_M
        return velocity

    return _placed(flow, centre_mm, velocity_m_s)


def uniform(velocity_m_s: Sequence[float]) -> KnownFlow:
    """The same velocity_m_s everywhere."""
    return _placed(lambda relative_mm: np.zeros((len(relative_mm), 3)), ORIGIN, velocity_m_s)


def random_modes(
    rms_m_s: float,
    longest_mm: float = 20.0,
    shortest_mm: float = 0.7,
    modes: int = 200,
    seed: int = 0,
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """A frozen picture of turbulence: so many solenoidal modes of random direction and phase, plus velocity_m_s.

    Wavelengths are evenly spread in their logarithm from longest_mm to shortest_mm, and energies follow Kolmogorov's
    spectrum, E(k) ~ k^(-5/3); rms_m_s: of each component, over all space and all seeds; seed: of the modes.
    """
    rng = np.random.default_rng(seed)
    wave = 2.0 * np.pi * np.exp(rng.uniform(-np.log(longest_mm), -np.log(shortest_mm), modes))
    direction, other = _unit(rng.normal(size=(modes, 3))), rng.normal(size=(modes, 3))
    polarisation = _unit(np.cross(direction, other))
    phase, along = rng.uniform(0.0, 2.0 * np.pi, modes), wave[:, np.newaxis] * direction
    # the energy of an interval of ln k is k E(k); a wave of amplitude a has a^2 / 2, over three components
    amplitude = wave ** (-1.0 / 3.0)
    amplitude *= rms_m_s * np.sqrt(6.0 / np.sum(amplitude**2))

    def flow(relative_mm: Floats) -> Floats:
        return np.asarray(np.cos(relative_mm @ along.T + phase) @ (amplitude[:, np.newaxis] * polarisation))

    return _placed(flow, centre_mm, velocity_m_s)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def taylor_green(
    amplitude_m_s: float,
    wavelength_mm: float,
    centre_mm: Sequence[float] = ORIGIN,
    plane: Literal["xy", "xz", "yz"] = "xz",
    third_amplitude_m_s: float | None = None,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Taylor-Green vortices of amplitude_m_s and wavelength_mm, plus velocity_m_s; at centre_mm four of them meet.

    Plane ones, in `plane` (xy, xz or yz: a, b): v_a = A sin(k a) cos(k b), v_b = -A cos(k a) sin(k b), k = 2 pi /
    wavelength. With third_amplitude_m_s C, along the axis across the plane (null: plane ones), they are
    three-dimensional: v_a = A sin(k a) cos(k b) cos(k c), v_b = -(A + C) cos(k a) sin(k b) cos(k c), v_c = C cos(k a)
    cos(k b) sin(k c). Plane ones have a closed form of the pressure, if the uniform velocity lies along the third axis.
    """
    first, second = ("xyz".index(axis) for axis in plane)
    third, wave = 3 - first - second, 2.0 * np.pi / wavelength_mm
    # amplitudes add up to nothing; plane vortices do not change along the third axis
    amplitudes, waves = np.zeros(3), np.full(3, wave)
    if third_amplitude_m_s is None:
        waves[third] = 0.0
    else:
        amplitudes[third] = third_amplitude_m_s
    amplitudes[first], amplitudes[second] = amplitude_m_s, -(amplitude_m_s + amplitudes[third])

    def flow(relative_mm: Floats) -> Floats:
        sine, cosine = np.sin(waves * relative_mm), np.cos(waves * relative_mm)
        others = np.stack([np.prod(np.delete(cosine, i, axis=1), axis=1) for i in range(3)], axis=1)
        return np.asarray(amplitudes * sine * others)

    def pressure(relative_mm: Floats, density_kg_m3: float) -> Floats:
        a, b = wave * relative_mm[:, first], wave * relative_mm[:, second]
        return 0.25 * density_kg_m3 * amplitude_m_s**2 * (np.cos(2.0 * a) + np.cos(2.0 * b))

    at_rest = velocity_m_s[first] == 0.0 and velocity_m_s[second] == 0.0
    closed = third_amplitude_m_s is None and at_rest
    return _placed(flow, centre_mm, velocity_m_s, pressure if closed else None)


def abc(
    amplitudes_m_s: Sequence[float],
    wavelength_mm: float,
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """The flow of Arnold, Beltrami and Childress, of amplitudes_m_s (A, B, C) and wavelength_mm, plus velocity_m_s.

    About centre_mm: u = A sin(k z) + C cos(k y), v = B sin(k x) + A cos(k z), w = C sin(k y) + B cos(k x). Its
    vorticity is k times its velocity; without the uniform velocity its pressure is Bernoulli's.
    """
    of_x, of_y, of_z = amplitudes_m_s[1], amplitudes_m_s[2], amplitudes_m_s[0]
    wave = 2.0 * np.pi / wavelength_mm
    # of component i the amplitude of the cosine or sine of k times coordinate j
    cosines = np.array([[0.0, of_y, 0.0], [0.0, 0.0, of_z], [of_x, 0.0, 0.0]])
    sines = np.array([[0.0, 0.0, of_z], [of_x, 0.0, 0.0], [0.0, of_y, 0.0]])

    def flow(relative_mm: Floats) -> Floats:
        return np.asarray(np.cos(wave * relative_mm) @ cosines.T + np.sin(wave * relative_mm) @ sines.T)

    def pressure(relative_mm: Floats, density_kg_m3: float) -> Floats:
        return -dynamic_pressure(flow(relative_mm), density_kg_m3)

    return _placed(flow, centre_mm, velocity_m_s, None if np.any(velocity_m_s) else pressure)


def vortex_ring(
    speed_m_s: float,
    radius_mm: float = 3.0,
    core_mm: float = 1.5,
    axis: Axis = "z",
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """A frozen vortex ring of radius_mm about `axis`, its core core_mm thick, plus velocity_m_s.

    The fluid in its middle moves along the axis. It is the curl of the azimuthal vector potential
    a rho exp(-(p^2 + z^2) / (2 core^2)), p = (rho^2 - R^2) / (2 R), near the ring its distance: smooth on the axis, and
    gone a few cores off. At one core's distance from the middle of a thin core the fluid turns with speed_m_s; where R
    is two cores, this is the speed in the ring's middle.
    """
    along = "xyz".index(axis)
    order = [(along + 1) % 3, (along + 2) % 3, along]
    strength = speed_m_s * np.exp(0.5) * core_mm / radius_mm

    def flow(relative_mm: Floats) -> Floats:
        # x, y and z about the ring's axis, and the potential over rho, g, with its slopes along s = rho^2 and z
        x, y, z = relative_mm[:, order].T
        p = (x**2 + y**2 - radius_mm**2) / (2.0 * radius_mm)
        g = strength * np.exp(-(p**2 + z**2) / (2.0 * core_mm**2))
        by_s, by_z = -p / (2.0 * radius_mm * core_mm**2) * g, -z / core_mm**2 * g
        velocity = np.empty_like(relative_mm, dtype=np.float64)
        velocity[:, order] = np.stack([-x * by_z, -y * by_z, 2.0 * (g + (x**2 + y**2) * by_s)], axis=1)
        return velocity

    return _placed(flow, centre_mm, velocity_m_s)


def source(
    rate_per_s: float,
    radius_mm: float = 2.0,
    centre_mm: Sequence[float] = ORIGIN,
    velocity_m_s: Sequence[float] = ORIGIN,
) -> KnownFlow:
    """Fluid out of a Gaussian cloud of radius_mm around centre_mm, q exp(-r^2 / (2 radius^2)) r, plus velocity_m_s.

    It is not solenoidal, unlike all others: rate_per_s is its divergence at the centre, 3 q; beyond 1.7 radii sinks
    take up the fluid.
    """

    def flow(r: Floats) -> Floats:
        rate = rate_per_s / 3.0 * np.exp(-np.sum(r**2, axis=1, keepdims=True) / (2.0 * radius_mm**2))
        return np.asarray(rate * r / MM_PER_M)

    return _placed(flow, centre_mm, velocity_m_s)


_FACTORIES = (square_duct, pipe, rigid_rotation, taylor_green, shear, uniform, random_modes, abc, vortex_ring, source)
FLOWS: dict[str, Callable[..., KnownFlow]] = {factory.__name__: factory for factory in _FACTORIES}


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
