"""Pairs of volumes of Gaussian particles in a known flow, for judging the correlation alone.

Axes: volumes `[z, y, x]`; points and displacements in voxels, (x, y, z).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.validation.volume import add_gaussians

Flow = Callable[[NDArray[np.float64]], NDArray[np.float64]]
Triple = tuple[int, int, int]

PEAK_DISPLACEMENT = 4.0
PEAK_SWIRL = 2.0
# Particles beyond the faces, in voxels, so that some come and go.
MARGIN = 10.0
REFERENCE_WINDOW = 16**3


@dataclass(frozen=True)
class Seeding:
    """How the particles look: number in 16^3 voxels, standard deviations in voxels, noise of a peak, share lost."""

    per_window: float
    sigma: tuple[float, float, float]
    noise: float = 0.0
    lost: float = 0.0


def channel(shape_xyz: Triple) -> Flow:
    """Return a parabola along y across the depth, with walls at the volume's faces."""
    middle, half = 0.5 * (shape_xyz[2] - 1), 0.5 * shape_xyz[2]

    def flow(points: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = np.zeros_like(points)
        moved[:, 1] = PEAK_DISPLACEMENT * np.maximum(0.0, 1.0 - ((points[:, 2] - middle) / half) ** 2)
        return moved

    return flow


def ring(shape_xyz: Triple) -> Flow:
    """Return a vortex ring about the y axis: radius a quarter of the shortest side, core 0.8 of it, peak 2 voxels.

    From the stream function r^2 g, g = exp(-[(r - radius)^2 + y^2] / 2 core^2): divergence-free, and single-valued on
    the axis, where a swirl about the core alone would point in all directions at once.
    """
    middle = 0.5 * (np.array(shape_xyz) - 1.0)
    radius = 0.25 * min(shape_xyz)
    core = 0.8 * radius

    def parts(away: NDArray[np.float64], along: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the radial component over the distance from the axis, and the one along the axis."""
        g = np.exp(-0.5 * ((away - radius) ** 2 + along**2) / core**2)
        return g * along / core**2, g * (2.0 - away * (away - radius) / core**2)

    distances = np.linspace(0.0, 2.0 * radius, 200)
    outwards, upwards = parts(*np.meshgrid(distances, distances))
    scale = PEAK_SWIRL / float(np.hypot(outwards * distances, upwards).max())

    def flow(points: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = (points - middle).T
        radial, axial = parts(np.hypot(x, z), y)
        return scale * np.stack([radial * x, axial, radial * z], axis=-1)

    return flow


def taylor_green(shape_xyz: Triple) -> Flow:
    """Return Taylor-Green vortices in the x-z plane: one wavelength over the shortest side, 2 voxels."""
    wave = 2.0 * np.pi / min(shape_xyz)

    def flow(points: NDArray[np.float64]) -> NDArray[np.float64]:
        x, z = wave * points[:, 0], wave * points[:, 2]
        zero = np.zeros(len(points))
        return PEAK_SWIRL * np.stack([np.sin(x) * np.cos(z), zero, -np.cos(x) * np.sin(z)], axis=-1)

    return flow


FLOWS: dict[str, Callable[[Triple], Flow]] = {"channel": channel, "ring": ring, "taylor_green": taylor_green}


def volume_pair(
    flow: Flow, shape_xyz: Triple, seeding: Seeding, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return two volumes, half a displacement before and after; a particle lost is another in the second."""
    sides = np.array(shape_xyz) + 2.0 * MARGIN
    count = round(seeding.per_window * float(np.prod(sides)) / REFERENCE_WINDOW)
    centres = rng.random((count, 3)) * sides - MARGIN
    half = 0.5 * flow(centres)
    volumes = []
    for moved, lost in ((centres - half, 0.0), (centres + half, seeding.lost)):
        strange = rng.random(count) < lost
        seen = np.where(strange[:, np.newaxis], rng.random((count, 3)) * sides - MARGIN, moved)
        volume = np.zeros(shape_xyz[::-1], dtype=np.float32)
        add_gaussians(volume, seen, np.ones(len(seen)), np.array(seeding.sigma))
        volumes.append(volume + (seeding.noise * rng.standard_normal(volume.shape)).astype(np.float32))
    return volumes[0], volumes[1]
