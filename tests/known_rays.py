"""Rays whose way is known, by other formulas than the program's; operators' columns as images, and their adjoints."""

import numpy as np
import pytest
from numba import njit
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import ROUNDING_MM, CurvedSpace, Face, in_fluid, refracted, trace_in
from lfpiv_cli.optics.media import Media, Window, equivalent_object_distance, fluid_path_to_focus
from lfpiv_cli.optics.shapes import Vector, dot, plus, scaled
from lfpiv_cli.optics.surfaces import Cylinder, Faces, meet
from lfpiv_cli.optics.tracing import disc_points, exact_slope, trace
from lfpiv_cli.weights.model import Weights


def tube_of(
    media: Media, axis: Vector = (1.0, 0.0, 0.0), centre_mm: Vector = (0.0, 0.0, 0.0), outer_mm: float = 7.0
) -> CurvedSpace:
    """Return a tube of 10 mm inside, by default with a wall of 2 mm, full of the fluid."""
    walls = ((outer_mm, media.window), (5.0, media.fluid))
    return CurvedSpace(media, tuple(Face(Cylinder(centre_mm, axis, radius), index) for radius, index in walls))


def slopes_equivalent(points: Floats, lens: Floats, camera: Camera, media: Media) -> Floats:
    """Return the slopes (n, 2) at the main lens of the rays from the points' equivalents in air (Eqs. 6, 9, 10)."""
    distance = equivalent_object_distance(points[:, 2], camera.focus_distance_mm, media)
    return (lens - points[:, :2]) / distance[:, np.newaxis]


def image_of(camera: Camera, sensor_mm: Floats, weights: float | Floats = 1.0) -> Floats:
    """Count rays that end at places (n, 2) of the sensor into pixels, c reaching from c - 1/2 to c + 1/2."""
    column, row = np.rint(camera.mm_to_px(sensor_mm)).astype(int).T
    inside = (column >= 0) & (column < camera.columns) & (row >= 0) & (row < camera.rows)
    image = np.zeros((camera.rows, camera.columns))
    np.add.at(image, (row[inside], column[inside]), np.broadcast_to(weights, len(inside))[inside])
    return image


def points_counted(points: Floats, camera: Camera, media: Media, rng: np.random.Generator) -> Floats:
    """Return the image of glowing points (n, 3), a ray of each, from the image's axes."""
    lens = disc_points(len(points), camera.aperture_radius_mm, rng)
    return image_of(camera, trace(camera, lens, slopes_equivalent(points, lens, camera, media)).sensor_mm)


def slopes_exact(points: Floats, lens: Floats, camera: Camera, media: Media, window: Window) -> Floats:
    """Return the slopes (n, 2) at the main lens of rays refracted by Snell's law at the window's two faces (Eq. 4)."""
    path = fluid_path_to_focus(window, camera.focus_distance_mm, media)
    indices = np.array([media.air, media.window, media.fluid])
    slopes = np.empty_like(lens)
    for i, (point, crossing) in enumerate(zip(points, lens, strict=True)):
        layers = np.array([window.distance_mm, window.thickness_mm, path + point[2]])
        slopes[i] = exact_slope(crossing[0] - point[0], crossing[1] - point[1], layers, indices)
    return slopes


def rays_from_air(
    space: CurvedSpace, camera: Camera, crossing_mm: ArrayLike, slopes: ArrayLike, z_mm: ArrayLike
) -> tuple[Floats, Flags]:
    """Follow rays from the lens (n, 2) with slopes (n, 2) there to a depth in the fluid.

    Returns places (n, 2), and (n,) whether the ray is there and in the fluid; NaN where it misses a face.
    """
    faces, crossing = space.for_kernels(camera), np.asarray(crossing_mm, dtype=np.float64).reshape(-1, 2)
    slopes, depth = np.asarray(slopes, dtype=np.float64).reshape(-1, 2), np.broadcast_to(z_mm, len(crossing))
    found = [trace_in(faces, *crossing[i], *slopes[i], float(depth[i])) for i in range(len(crossing))]
    return np.array([each[:2] for each in found]).reshape(-1, 2), np.array([each[2] for each in found], np.bool_)


def rays_to_air(
    space: CurvedSpace, camera: Camera, points_mm: ArrayLike, directions: ArrayLike
) -> tuple[Floats, Floats, Flags]:
    """Follow rays from points (n, 3) in directions (n, 3), towards the camera, to the main lens.

    Returns where they cross it (n, 2), their slopes there (n, 2), and (n,) whether they do; NaN where not.
    """
    faces, points = space.for_kernels(camera), np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    towards = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
    found = [trace_out(faces, tuple(p), tuple(d)) for p, d in zip(points, towards, strict=True)]
    numbers = np.array([each[:4] for each in found]).reshape(-1, 4)
    return numbers[:, :2], numbers[:, 2:], np.array([each[4] for each in found], np.bool_)


def assert_rays_go_back(space: CurvedSpace, camera: Camera, points: Floats, crossing: Floats) -> None:
    """Aim rays from points of the fluid, follow them there from the lens, and back along the way they came."""
    slopes, valid = space.slopes(camera, points, crossing)
    assert valid.all()
    places, valid = rays_from_air(space, camera, crossing, slopes, points[:, 2])
    # a step of Newton's from 1e-6 mm
    assert valid.all()
    np.testing.assert_allclose(places, points[:, :2], atol=1e-12)
    short, _ = rays_from_air(space, camera, crossing, slopes, points[:, 2] - 1e-3)
    towards = np.concatenate([short - places, np.full((len(points), 1), -1e-3)], axis=1)
    back, slopes_back, valid = rays_to_air(space, camera, points, towards)
    # the direction by a difference of 1e-3 mm, of which 1e-15 are lost: 1e-12, over 200 mm
    assert valid.all()
    np.testing.assert_allclose(back, crossing, atol=1e-9)
    np.testing.assert_allclose(slopes_back, slopes, atol=1e-11)
    again, valid = rays_from_air(space, camera, back, slopes_back, points[:, 2])
    # there and back in the same directions: roundings of 200 mm, of the slopes over as much, and of the rim's bending
    assert valid.all()
    np.testing.assert_allclose(again, points[:, :2], atol=1e-12)


@njit
def trace_out(faces: Faces, point: Vector, direction: Vector) -> tuple[float, float, float, float, bool]:
    """Return where a ray from the fluid crosses the main lens: X, Y, its slopes there, and whether it does.

    Parameters
    ----------
    point : where it starts
    direction : towards the camera, of any length
    """
    if not (direction[2] < 0.0 and in_fluid(faces, point)):
        return np.nan, np.nan, np.nan, np.nan, False
    direction = scaled(-1.0 / np.sqrt(dot(direction, direction)), direction)
    for k in range(faces.ratios.size - 1, -1, -1):
        path, normal, cosine = meet(faces.reliefs, faces, k, point, direction)
        if cosine == 0.0 or path > ROUNDING_MM:
            return np.nan, np.nan, np.nan, np.nan, False
        point = plus(point, path, direction)
        direction, cosine = refracted(direction, normal, cosine, 1.0 / faces.ratios[k])
        if cosine == 0.0 or direction[2] <= 0.0:
            return np.nan, np.nan, np.nan, np.nan, False
    path = (faces.lens_z_mm - point[2]) / direction[2]
    point = plus(point, path, direction)
    return point[0], point[1], -direction[0] / direction[2], -direction[1] / direction[2], path < 0.0


def column_image(operator: Weights, *index: int) -> Floats:
    """Return the image that the column of a voxel makes."""
    image = np.zeros(operator.image_shape)
    rows, columns, weights = operator.column(*index)
    image[rows, columns] = weights
    return image


def assert_adjoint(operator: Weights, rng: np.random.Generator) -> None:
    """The dot test: <A x, y> = <x, A* y>, to what float32 sums of some thousand terms leave."""
    volume, image = rng.random(operator.shape, np.float32), rng.random(operator.image_shape, np.float32)
    left = np.vdot(operator.forward(volume).astype(np.float64), image)
    assert left == pytest.approx(np.vdot(volume.astype(np.float64), operator.adjoint(image)), rel=1e-5)
