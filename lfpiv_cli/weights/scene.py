"""What the kernels that follow rays one by one need of camera, scene and voxels, and a ray's way to the sensor.

Any lattice, any refraction, or rays as a polynomial has them.

Axes: everything here is in image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera, KernelCamera
from lfpiv_cli.optics.object_space import SLOPE_NODES, ObjectSpace, slope_ratio
from lfpiv_cli.optics.polynomial_rays import PolynomialRays
from lfpiv_cli.optics.tracing import behind_microlens
from lfpiv_cli.weights.aperture import disc_area_below
from lfpiv_cli.weights.lens_cells import cell_radius, neighbours

# Points per side by which the part of a tile inside the rim is averaged to find its middle.
RIM_SAMPLES = 16

# Where rays meet the array: traced through the object space, or as fitted.
Source = ObjectSpace | PolynomialRays


@dataclass(frozen=True, eq=False)
class Tiles:
    """Squares on the main lens: middles (n, 2) of their parts inside the aperture, shares (n,) of it, their side."""

    middle_mm: NDArray[np.float64]
    share: NDArray[np.float64]
    side_mm: float


class Scene(NamedTuple):
    """Voxels, main lens and array as the kernels take them.

    Attributes
    ----------
    camera : without the distortion where rays are fitted, as it is in the polynomial
    centres_mm, sides_mm : (n, 3) of the voxels, (3,)
    plane : (n,) which depths are a voxel's
    depth_mm, depth_share : (planes, nodes) and (nodes,), the depths along a voxel and the share of light from each
    slopes : (planes, nodes, 2, SLOPE_NODES), nodes and factors of `slope_ratio` where rays are traced
    scale_mm, exponents, coefficients_mm : of `PolynomialRays` where they are fitted; no exponents where traced
    degree : of the polynomial
    tile_mm, tile_share, tile_side_mm : of `Tiles`
    cell_radius_mm, neighbours_mm : of a microlens's region, and (k, 2) the steps to the lenses around
    """

    camera: KernelCamera
    centres_mm: NDArray[np.float64]
    sides_mm: NDArray[np.float64]
    plane: NDArray[np.int64]
    depth_mm: NDArray[np.float64]
    depth_share: NDArray[np.float64]
    slopes: NDArray[np.float64]
    scale_mm: NDArray[np.float64]
    exponents: NDArray[np.int64]
    coefficients_mm: NDArray[np.float64]
    degree: int
    tile_mm: NDArray[np.float64]
    tile_share: NDArray[np.float64]
    tile_side_mm: float
    cell_radius_mm: float
    neighbours_mm: NDArray[np.float64]


def aperture_tiles(radius_mm: float, per_side: int) -> Tiles:
    """Cut the round aperture into squares."""
    side = 2.0 * radius_mm / per_side
    edges = side * np.arange(per_side + 1) - radius_mm
    below = np.array([[disc_area_below(x, y, radius_mm) for x in edges] for y in edges])
    area = np.diff(np.diff(below, axis=0), axis=1)
    row, column = np.nonzero(area > 1e-9 * side**2)  # what is left of corners that only touch the rim
    middle = np.stack([edges[column], edges[row]], axis=1) + 0.5 * side
    cut = np.hypot(*np.abs(middle).T + 0.5 * side) > radius_mm
    fine = side * ((np.arange(RIM_SAMPLES) + 0.5) / RIM_SAMPLES - 0.5)
    points = middle[cut, np.newaxis] + np.stack(np.meshgrid(fine, fine), axis=-1).reshape(-1, 2)
    inside = np.hypot(points[..., 0], points[..., 1]) <= radius_mm
    count = inside.sum(axis=1)
    means = np.sum(points * inside[..., np.newaxis], axis=1) / np.maximum(count, 1)[:, np.newaxis]
    middle[cut] = np.where(count[:, np.newaxis] > 0, means, middle[cut])
    return Tiles(middle, area[row, column] / (np.pi * radius_mm**2), side)


def kernel_scene(
    camera: Camera,
    source: Source,
    centres: NDArray[np.float64],
    sides: NDArray[np.float64],
    tiles_per_side: int,
    depth_nodes: int,
) -> Scene:
    """Return what the kernels take for voxels at (n, 3) with sides (3,), image axes.

    Raises
    ------
    ConfigError : a voxel in front of the fluid, or no window where one is needed
    """
    tiles = aperture_tiles(camera.aperture_radius_mm, tiles_per_side)
    depth, plane = np.unique(centres[:, 2], return_inverse=True)
    place, weight = np.polynomial.legendre.leggauss(depth_nodes)
    z = depth[:, np.newaxis] + 0.5 * sides[2] * place
    slopes = np.zeros((*z.shape, 2, SLOPE_NODES))
    fitted = PolynomialRays(np.ones(5), np.zeros((0, 5), np.int64), np.zeros((0, 2)))
    seen = camera.for_kernels()
    if isinstance(source, ObjectSpace):
        reach = camera.aperture_radius_mm + float(np.hypot(*(np.abs(centres[:, :2]) + sides[:2]).max(axis=0)))
        slopes = np.stack(source.slope_polynomials(camera, z.ravel(), reach), axis=1).reshape(slopes.shape)
    else:
        fitted, seen = source, seen._replace(distortion_per_mm2=0.0)
    return Scene(
        camera=seen,
        centres_mm=centres,
        sides_mm=sides,
        plane=plane.astype(np.int64),
        depth_mm=z,
        depth_share=weight / 2.0,
        slopes=slopes,
        scale_mm=fitted.scale_mm,
        exponents=fitted.exponents,
        coefficients_mm=fitted.coefficients_mm,
        degree=fitted.degree,
        tile_mm=tiles.middle_mm,
        tile_share=tiles.share,
        tile_side_mm=tiles.side_mm,
        cell_radius_mm=cell_radius(camera.lattice),
        neighbours_mm=neighbours(camera.lattice),
    )


@njit(cache=True)
def rays_from(scene: Scene, point: NDArray[np.float64], plane: int, node: int) -> NDArray[np.float64]:
    """Return what `on_array` needs of a point (3,) at one of its plane's depths.

    Traced rays: nodes and factors of `slope_ratio`, (2, 1, SLOPE_NODES). Fitted ones: for both coordinates on the array
    the polynomial in X and Y alone, (2, degree + 1, degree + 1) by the powers of X and Y.
    """
    if scene.exponents.shape[0] == 0:
        rays = np.empty((2, 1, SLOPE_NODES))
        for table in range(2):
            for k in range(SLOPE_NODES):
                rays[table, 0, k] = scene.slopes[plane, node, table, k]
        return rays
    rays = np.zeros((2, scene.degree + 1, scene.degree + 1))
    for k in range(scene.exponents.shape[0]):
        term = 1.0
        for m in range(3):
            term *= (point[m] / scene.scale_mm[m]) ** scene.exponents[k, m]
        for axis in range(2):
            rays[axis, scene.exponents[k, 3], scene.exponents[k, 4]] += scene.coefficients_mm[k, axis] * term
    return rays


# Inlined: to hand over all of a scene at each ray costs as much as the ray itself.
@njit(cache=True, inline="always")
def on_array(
    scene: Scene, point: NDArray[np.float64], rays: NDArray[np.float64], lens_x: float, lens_y: float
) -> tuple[float, float]:
    """Return where the ray from a point through (lens_x, lens_y) meets the array, without the distortion."""
    if scene.exponents.shape[0] == 0:
        dx, dy = lens_x - point[0], lens_y - point[1]
        ratio = slope_ratio(dx * dx + dy * dy, rays[0, 0], rays[1, 0])
        f_m, s_i = scene.camera.focal_length_mm, scene.camera.image_distance_mm
        return lens_x + s_i * (ratio * dx - lens_x / f_m), lens_y + s_i * (ratio * dy - lens_y / f_m)
    across, down = lens_x / scene.scale_mm[3], lens_y / scene.scale_mm[4]
    x, y = 0.0, 0.0
    for a in range(scene.degree, -1, -1):
        part_x, part_y = 0.0, 0.0
        for b in range(scene.degree - a, -1, -1):
            part_x = part_x * down + rays[0, a, b]
            part_y = part_y * down + rays[1, a, b]
        x = x * across + part_x
        y = y * across + part_y
    return x, y


@njit(cache=True)
def on_sensor(camera: KernelCamera, ideal: float, crossing: float, place: float, centre: float) -> float:
    """Return one coordinate on the sensor of a ray that meets the array at `place` under the microlens at `centre`.

    `ideal` is where the ray from `crossing` of the main lens would meet it without the main lens's distortion.
    """
    return behind_microlens(camera, place, centre, (ideal - crossing) / camera.image_distance_mm)
