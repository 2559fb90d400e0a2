"""The weights of one voxel by counting rays (Eq. 13), as the paper does.

Random points of the voxel each send random rays through the aperture; the share of the rays that strike a pixel is its
weight. Rays follow `optics.tracing` in every detail: any lattice, distortion and refraction.
A count of n rays over k pixels is off by about sqrt(2 k / (pi n)) in L1; more rays of few points do not make
up for the points.

Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.optics.camera import Camera, KernelCamera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.object_space import ObjectSpace, slope_ratio
from lfpiv_cli.optics.ray_bundles import aim_all
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.optics.tracing import struck_pixel, trace_ray
from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.quadrature import Columns

# Points are counted in this many parts side by side, each into an image of its own.
PARTS = 8
# Rays of one point that are traced together behind curved faces: their arrays stay in the first-level cache.
RAYS_AT_ONCE = 256

# splitmix64 (Steele, Lea and Flood 2014): a counter's step and two mixing factors; every ray has numbers of its own,
# whoever computes it.
STEP = np.uint64(0x9E3779B97F4A7C15)
TWO_STEPS = np.uint64(0x3C6EF372FE94F82A)
MIX_A = np.uint64(0xBF58476D1CE4E5B9)
MIX_B = np.uint64(0x94D049BB133111EB)
TO_UNIT = 2.0**-53


@dataclass(frozen=True)
class RayCount:
    """How many rays are counted: from each of some random points of a voxel; by default the paper's numbers."""

    points: int = 500
    rays_per_point: int = 10_000

    @property
    def rays(self) -> int:
        """All rays of a voxel."""
        return self.points * self.rays_per_point


PAPERS_COUNT = RayCount()


def count_rays(
    camera: Camera,
    space: ObjectSpace | CurvedSpace,
    centre_mm: ArrayLike,
    voxel_mm: ArrayLike,
    rng: np.random.Generator,
    count: RayCount = PAPERS_COUNT,
) -> NDArray[np.float64]:
    """Return the image (rows, columns) of the shares of a voxel's rays that strike each pixel.

    Parameters
    ----------
    centre_mm, voxel_mm : (3,) its centre and its sides, image axes; what of it lies outside the fluid sends no light

    Raises
    ------
    ConfigError : a voxel in front of the fluid, or no window where one is needed
    """
    centre, sides = np.asarray(centre_mm, dtype=np.float64), np.asarray(voxel_mm, dtype=np.float64)
    starts = centre + (rng.random((count.points, 3)) - 0.5) * sides
    seeds = rng.integers(0, 2**64, count.points, dtype=np.uint64)
    counts = np.zeros((PARTS, camera.rows * camera.columns), np.int64)
    rays = (starts, seeds, count.rays_per_point)
    if isinstance(space, CurvedSpace):
        share_out(_count_curved, PARTS, rays, space.for_kernels(camera), camera.for_kernels(), counts)
        return counts.sum(axis=0).reshape(camera.rows, camera.columns) / count.rays
    reach = camera.aperture_radius_mm + float(np.hypot(*(np.abs(centre[:2]) + sides[:2])))
    nodes, factors = space.slope_polynomials(camera, starts[:, 2], reach)
    share_out(_count, PARTS, rays, nodes, factors, camera.for_kernels(), counts)
    return counts.sum(axis=0).reshape(camera.rows, camera.columns) / count.rays


def count_columns(
    camera: Camera,
    space: ObjectSpace | CurvedSpace,
    centres_mm: NDArray[np.float64],
    voxel_mm: ArrayLike,
    rng: np.random.Generator,
    count: RayCount = PAPERS_COUNT,
    progress: Callable[[int], None] | None = None,
) -> Columns:
    """Return the counted columns of voxels at `centres_mm` (n, 3); the other arguments are those of `count_rays`."""
    start, pixels, shares = [0], [], []
    for centre in centres_mm:
        image = count_rays(camera, space, centre, voxel_mm, rng, count).ravel()
        lit = np.flatnonzero(image)
        pixels.append(lit.astype(np.int32))
        shares.append(image[lit].astype(np.float32))
        start.append(start[-1] + lit.size)
        if progress:
            progress(1)
    return Columns(np.array(start, np.int64), np.concatenate(pixels), np.concatenate(shares))


def sampling_error(weights: NDArray[np.floating], rays: int) -> float:
    """Return the L1 error to expect of a count of independent rays: the sum of sqrt(2 w (1 - w) / (pi n))."""
    w = np.asarray(weights, dtype=np.float64)
    return float(np.sum(np.sqrt(2.0 * w * (1.0 - w) / (np.pi * rays))))


@njit(cache=True)
def unit_random(state: np.uint64) -> float:
    """Return the number in [0, 1) that belongs to a counter."""
    z = state
    z = (z ^ (z >> np.uint64(30))) * MIX_A
    z = (z ^ (z >> np.uint64(27))) * MIX_B
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * TO_UNIT


@njit(cache=True)
def random_crossing(state: np.uint64, radius: float) -> tuple[float, float]:
    """Return a point of the main lens that belongs to a counter, which goes on by `TWO_STEPS`."""
    r = radius * np.sqrt(unit_random(state + STEP))
    angle = 2.0 * np.pi * unit_random(state + TWO_STEPS)
    return r * np.cos(angle), r * np.sin(angle)


@njit(cache=True, nogil=True)
def _count_curved(
    parts: tuple[int, int],
    rays: tuple[NDArray[np.float64], NDArray[np.uint64], int],
    faces: Faces,
    camera: KernelCamera,
    counts: NDArray[np.int64],
) -> None:
    """Add up the rays behind curved faces that strike each pixel; the arguments are those of `_count`."""
    starts, seeds, rays_each = rays
    for part in range(parts[0], parts[1]):
        for n in range(part, starts.shape[0], PARTS):
            state = seeds[n]
            for first in range(0, rays_each, RAYS_AT_ONCE):
                count = min(RAYS_AT_ONCE, rays_each - first)
                start, crossing = np.empty((count, 3)), np.empty((count, 2))
                start[:] = starts[n]
                for k in range(count):
                    crossing[k, 0], crossing[k, 1] = random_crossing(state, camera.aperture_radius_mm)
                    state += TWO_STEPS
                slopes, seen = aim_all(faces, start, crossing)
                for k in range(count):
                    if seen[k]:
                        x, y = trace_ray(camera, crossing[k, 0], crossing[k, 1], slopes[k, 0], slopes[k, 1])
                        pixel = struck_pixel(camera, x, y)
                        if pixel >= 0:
                            counts[part, pixel] += 1


@njit(cache=True, nogil=True)
def _count(
    parts: tuple[int, int],
    rays: tuple[NDArray[np.float64], NDArray[np.uint64], int],
    nodes: NDArray[np.float64],
    factors: NDArray[np.float64],
    camera: KernelCamera,
    counts: NDArray[np.int64],
) -> None:
    """Add up the rays that strike each pixel, `parts` of (parts, rows * columns).

    `rays` holds the points that they start from, a seed for each, and how many each sends.
    """
    starts, seeds, rays_each = rays
    radius = camera.aperture_radius_mm
    for part in range(parts[0], parts[1]):
        for n in range(part, starts.shape[0], PARTS):
            state = seeds[n]
            for _ in range(rays_each):
                lens_x, lens_y = random_crossing(state, radius)
                state += TWO_STEPS
                dx, dy = lens_x - starts[n, 0], lens_y - starts[n, 1]
                ratio = slope_ratio(dx * dx + dy * dy, nodes[n], factors[n])
                x, y = trace_ray(camera, lens_x, lens_y, ratio * dx, ratio * dy)
                pixel = struck_pixel(camera, x, y)
                if pixel >= 0:
                    counts[part, pixel] += 1
