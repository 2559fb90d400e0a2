"""What the kernels that follow rays one by one need of camera, scene and voxels, and a ray's way to the sensor.

Any lattice, any refraction, or rays as a polynomial has them. Behind curved faces some rays are traced from each point,
and a polynomial through them tells the others.

Axes: everything but grids is in image axes (x along the columns), mm, z away from the camera from the nominal focal
point.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.grid import Grid
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera, KernelCamera
from lfpiv_cli.optics.curved_space import CurvedSpace, aim
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.optics.tracing import (
    SLOPE_NODES,
    ObjectSpace,
    PolynomialRays,
    behind_microlens,
    disc_points,
    slope_ratio,
)
from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.lens_cells import disc_area_below, neighbours

# Where rays behind curved faces meet the array, and which voxels are seen at all.

# Rays by which a voxel is judged to lie in the fluid and to be seen through the whole aperture: the middle and the rim.
RIM = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def places_on_array(camera: Camera, space: CurvedSpace, points_mm: Floats, crossing_mm: Floats) -> tuple[Floats, Flags]:
    """Return where rays from (n, 3) through (n, 2) meet the array, without the distortion, and whether they do."""
    slopes, valid = space.slopes(camera, points_mm, crossing_mm)
    return crossing_mm + camera.image_distance_mm * (slopes - crossing_mm / camera.focal_length_mm), valid


def lit_voxels(camera: Camera, space: CurvedSpace, grid: Grid) -> Flags:
    """Return which voxels (planes, row voxels, column voxels) have their middle in the fluid, wholly in view."""
    first, second = (0, 1) if camera.column_axis == "x" else (1, 0)
    axes = (grid.axis_mm(first), grid.axis_mm(second), grid.axis_mm(2))
    lit = np.empty(tuple(axis.size for axis in axes[::-1]), np.bool_)
    rim = camera.aperture_radius_mm * RIM
    share_out(_write_lit, axes[2].size, space.for_kernels(camera), axes, rim, lit)
    return lit


@njit(cache=True, nogil=True)
def _write_lit(
    part: tuple[int, int], faces: Faces, axes: tuple[Floats, Floats, Floats], rim: Floats, lit: Flags
) -> None:
    """Write planes `part` of `lit_voxels`."""
    for plane in range(part[0], part[1]):
        for row in range(axes[1].size):
            for column in range(axes[0].size):
                seen = True
                for k in range(rim.shape[0]):
                    if seen:
                        crossing = rim[k, 0], rim[k, 1]
                        seen = aim(faces, axes[0][column], axes[1][row], axes[2][plane], crossing[0], crossing[1])[2]
                lit[plane, row, column] = seen


# Points per side by which the part of a tile inside the rim is averaged to find its middle.
RIM_SAMPLES = 16

# Behind curved faces rays from one point are traced on rings about the middle of the aperture, more than a polynomial
# of this degree in X and Y needs. It is off by 1 nm on the array near the wall of a tube of 10 mm, one of degree 3 by
# 10.
AIMED_DEGREE = 4
AIMED_RINGS = (0.4, 0.75, 1.0)
AIMED_A_RING = 9

# What scenes have that have no curved faces.
NO_FACES = Faces(0.0, 1.0, 1.0, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))

# Where rays meet the array: traced through the object space, or as fitted.
Source = ObjectSpace | PolynomialRays | CurvedSpace


class Tiles(NamedTuple):
    """Squares on the main lens: middles (n, 2) of their parts inside the aperture, shares (n,) of it, their side."""

    middle_mm: Floats
    share: Floats
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
    degree : of the polynomial; 0 where there is none
    faces, aimed_mm, aimed_fit : behind curved faces these, the crossings (m, 2) of the rays traced from each point, and
        what takes their places on the array to the polynomial in X and Y, ((degree + 1)^2, m); else no rays
    tiles : of the main lens
    cell_radius_mm, neighbours_mm : of a microlens's region, and (k, 2) the steps to the lenses around
    """

    camera: KernelCamera
    centres_mm: Floats
    sides_mm: Floats
    plane: Integers
    depth_mm: Floats
    depth_share: Floats
    slopes: Floats
    scale_mm: Floats
    exponents: Integers
    coefficients_mm: Floats
    degree: int
    faces: Faces
    aimed_mm: Floats
    aimed_fit: Floats
    tiles: Tiles
    cell_radius_mm: float
    neighbours_mm: Floats


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
    camera: Camera, source: Source, centres: Floats, sides: Floats, tiles_per_side: int, depth_nodes: int
) -> Scene:
    """Return what the kernels take for voxels at (n, 3) with sides (3,), image axes.

    Raises
    ------
    ConfigError : a voxel in front of the fluid, or no window where one is needed
    """
    # A lens's region reaches as far as half the basis cell's long diagonal.
    first, second = camera.lattice.basis
    depth, plane = np.unique(centres[:, 2], return_inverse=True)
    place, weight = np.polynomial.legendre.leggauss(depth_nodes)
    z = depth[:, np.newaxis] + 0.5 * sides[2] * place
    slopes = np.zeros((*z.shape, 2, SLOPE_NODES))
    fitted = PolynomialRays(np.ones(5), np.zeros((0, 5), np.int64), np.zeros((0, 2)))
    seen, degree = camera.for_kernels(), 0
    faces, aimed, aimed_fit = NO_FACES, np.zeros((0, 2)), np.zeros((0, 0))
    if isinstance(source, CurvedSpace):
        faces, degree = source.for_kernels(camera), AIMED_DEGREE
        aimed, aimed_fit = aimed_rays(camera.aperture_radius_mm)
        fitted = replace(fitted, scale_mm=np.full(5, camera.aperture_radius_mm))
    elif isinstance(source, ObjectSpace):
        reach = camera.aperture_radius_mm + float(np.hypot(*(np.abs(centres[:, :2]) + sides[:2]).max(axis=0)))
        slopes = np.stack(source.slope_polynomials(camera, z.ravel(), reach), axis=1).reshape(slopes.shape)
    else:
        fitted, seen, degree = source, seen._replace(distortion_per_mm2=0.0), source.degree
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
        degree=degree,
        faces=faces,
        aimed_mm=aimed,
        aimed_fit=aimed_fit,
        tiles=aperture_tiles(camera.aperture_radius_mm, tiles_per_side),
        cell_radius_mm=0.5 * float(max(np.hypot(*(first + second)), np.hypot(*(first - second)))),
        neighbours_mm=neighbours(camera.lattice),
    )


def aimed_rays(radius_mm: float) -> tuple[Floats, Floats]:
    """Return crossings (m, 2) of an aperture, and what gives the polynomial through values there, (powers, m).

    Row a (AIMED_DEGREE + 1) + b belongs to the powers a of X and b of Y, both in radii.
    """
    rings = [
        ring * np.exp(2j * np.pi * (np.arange(AIMED_A_RING) + 0.5 * k) / AIMED_A_RING)
        for k, ring in enumerate(AIMED_RINGS)
    ]
    crossing = np.stack([np.concatenate(rings).real, np.concatenate(rings).imag], axis=1)
    powers = [(a, b) for a in range(AIMED_DEGREE + 1) for b in range(AIMED_DEGREE + 1 - a)]
    terms = np.stack([crossing[:, 0] ** a * crossing[:, 1] ** b for a, b in powers], axis=1)
    fit = np.zeros(((AIMED_DEGREE + 1) ** 2, len(crossing)))
    fit[[a * (AIMED_DEGREE + 1) + b for a, b in powers]] = np.linalg.pinv(terms)
    return radius_mm * crossing, fit


@njit(cache=True)
def rays_from(scene: Scene, point: Floats, plane: int, node: int) -> Floats:
    """Return what `on_array` needs of a point (3,) at one of its plane's depths.

    Traced rays: nodes and factors of `slope_ratio`, (2, 1, SLOPE_NODES). Fitted ones, and those behind curved faces:
    for both coordinates on the array the polynomial in X and Y alone, (2, degree + 1, degree + 1) by the powers of X
    and Y; (2, 0, 0) for a point outside the fluid, or not seen through the whole aperture.
    """
    size = scene.degree + 1
    if scene.aimed_mm.shape[0] > 0:
        rays = np.zeros((2, size, size))
        f_m, s_i = scene.camera.focal_length_mm, scene.camera.image_distance_mm
        for m in range(scene.aimed_mm.shape[0]):
            lens_x, lens_y = scene.aimed_mm[m, 0], scene.aimed_mm[m, 1]
            slope_x, slope_y, seen = aim(scene.faces, point[0], point[1], point[2], lens_x, lens_y)
            if not seen:
                return np.zeros((2, 0, 0))
            x, y = lens_x + s_i * (slope_x - lens_x / f_m), lens_y + s_i * (slope_y - lens_y / f_m)
            for a in range(size):
                for b in range(size - a):
                    share = scene.aimed_fit[a * size + b, m]
                    rays[0, a, b] += share * x
                    rays[1, a, b] += share * y
        return rays
    if scene.degree == 0:
        rays = np.empty((2, 1, SLOPE_NODES))
        for table in range(2):
            for k in range(SLOPE_NODES):
                rays[table, 0, k] = scene.slopes[plane, node, table, k]
        return rays
    rays = np.zeros((2, size, size))
    for k in range(scene.exponents.shape[0]):
        term = 1.0
        for m in range(3):
            term *= (point[m] / scene.scale_mm[m]) ** scene.exponents[k, m]
        for axis in range(2):
            rays[axis, scene.exponents[k, 3], scene.exponents[k, 4]] += scene.coefficients_mm[k, axis] * term
    return rays


@njit(cache=True)
def rays_at_depth(scene: Scene, voxel: Floats, plane: int, node: int, point: Floats) -> Floats:
    """Set a point (3,) to one of the depths of the voxel about `voxel` (3,), and return its rays.

    A depth outside the fluid counts as the voxel's middle.
    """
    point[0], point[1], point[2] = voxel[0], voxel[1], scene.depth_mm[plane, node]
    rays = rays_from(scene, point, plane, node)
    if rays.shape[1] == 0:
        point[2] = voxel[2]
        rays = rays_from(scene, point, plane, node)
    return rays


# Inlined: to hand over all of a scene at each ray costs as much as the ray itself.
@njit(cache=True, inline="always")
def on_array(scene: Scene, point: Floats, rays: Floats, lens_x: float, lens_y: float) -> tuple[float, float]:
    """Return where the ray from a point through (lens_x, lens_y) meets the array, without the distortion."""
    if scene.degree == 0:
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


# How far light spreads behind curved faces, and how well rays made for single voxels follow the traced ones.

# Places along each axis of a volume at which the spread is looked at: it is largest at the volume's faces.
SAMPLES = 5
# Rays along the rim of the aperture.
RIM_RAYS = 16
# Places along each axis of a layer of voxels at which fluid is looked for.
LAYER_SAMPLES = 15
# Points of a volume from which rays are compared.
MISFIT_POINTS = 200


def curved_padding(camera: Camera, space: CurvedSpace, grid: Grid) -> tuple[int, int, int]:
    """Return how many voxels to solve for beyond each side of a grid: as far as light spreads, up to the fluid's end.

    Laterally, as `build.default_padding`, with rays that are traced from a sample of the grid.
    """
    sides = camera.to_image_axes(np.asarray(grid.spacing_mm))
    x, y = camera.to_image_axes(np.ceil(spread_mm(camera, space, grid) / sides[:2])).astype(int)
    return _within_fluid(camera, space, grid, 0, int(x)), _within_fluid(camera, space, grid, 1, int(y)), 0


def spread_mm(camera: Camera, space: CurvedSpace, grid: Grid) -> Floats:
    """Return how far from its own line of sight a point shares pixels with others, along both image axes (2,), in mm.

    Half a lens and the spread on the array, taken back to the flow by how far apart neighbouring voxels are seen.
    """
    points = sample(camera, grid)
    sides = camera.to_image_axes(np.asarray(grid.spacing_mm))
    angle = 2.0 * np.pi * np.arange(RIM_RAYS) / RIM_RAYS
    rim = camera.aperture_radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    through_middle = np.zeros((len(points), 2))
    middle, seen = places_on_array(camera, space, points, through_middle)
    spread = np.zeros(2)
    for axis in range(2):
        beside = points.copy()
        # Towards the optical axis, so not out of the fluid.
        beside[:, axis] -= np.copysign(sides[axis], beside[:, axis])
        shown, also = places_on_array(camera, space, beside, through_middle)
        for crossing in rim:
            place, passes = places_on_array(camera, space, points, np.broadcast_to(crossing, (len(points), 2)))
            good = seen & also & passes
            on_array = np.abs(place - middle)[good, axis] + 0.5 * float(camera.lattice.pitch.max())
            back = sides[axis] / np.abs(shown - middle)[good, axis]
            spread[axis] = max(spread[axis], np.max(on_array * back, initial=0.0))
    return spread


def sample(camera: Camera, grid: Grid) -> Floats:
    """Return the middles (n, 3) of some voxels of a grid, those of its faces among them, image axes."""
    axes = [np.linspace(grid.axis_mm(k)[0], grid.axis_mm(k)[-1], SAMPLES) for k in range(3)]
    return camera.to_image_axes(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3))


def _within_fluid(camera: Camera, space: CurvedSpace, grid: Grid, axis: int, most: int) -> int:
    """Return how many layers of voxels, at most so many, have fluid in them on either side of a grid along an axis."""
    low, high = grid.bounds_mm(axis)
    for layer in range(most):
        beyond = (layer + 0.5) * grid.spacing_mm[axis]
        axes = [np.linspace(*grid.bounds_mm(k), LAYER_SAMPLES) for k in range(3)]
        axes[axis] = np.array([low - beyond, high + beyond])
        points = camera.to_image_axes(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3))
        if not space.slopes(camera, points, np.zeros((len(points), 2)))[1].any():
            return layer
    return most


def seen_depths_mm(camera: Camera, space: CurvedSpace, grid: Grid) -> Floats:
    """Return the depths in the fluid at which plane windows would show a sample of a grid, along both axes; 0 if none.

    Behind a cylinder a point has two, which differ.
    """
    _, distance, seen = space.equivalent(camera, sample(camera, grid))
    depths = (distance[seen].ravel() - camera.focus_distance_mm) / space.media.depth_ratio
    return np.append(depths, 0.0)


def aimed_misfit_mm(camera: Camera, space: CurvedSpace, grid: Grid) -> float:
    """Return how far on the array, rms, rays made for single voxels are from traced ones; 0 where none are seen."""
    rng = np.random.default_rng(0)
    bounds = np.array([grid.bounds_mm(axis) for axis in range(3)])
    points = camera.to_image_axes(rng.uniform(bounds[:, 0], bounds[:, 1], (MISFIT_POINTS, 3)))
    aimed, fit = aimed_rays(camera.aperture_radius_mm)
    other = disc_points(len(aimed), camera.aperture_radius_mm, rng)
    powers = (other / camera.aperture_radius_mm)[:, :, np.newaxis] ** np.arange(AIMED_DEGREE + 1)
    terms = (powers[:, 0, :, np.newaxis] * powers[:, 1, np.newaxis]).reshape(len(other), -1)
    squares = []
    for point in points:
        start = np.broadcast_to(point, (len(aimed), 3))
        (known, seen), (truth, also) = (places_on_array(camera, space, start, each) for each in (aimed, other))
        if seen.all() and also.all():
            squares.append(np.mean((terms @ fit @ known - truth) ** 2))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0
