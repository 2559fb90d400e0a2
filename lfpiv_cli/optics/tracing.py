"""Ray-by-ray tracing from a point in the scene to the sensor: the reference for everything that is computed otherwise.

Axes: image axes (x along the columns, y along the rows, see `camera`), z away from the camera from the nominal focal
point. A ray is named by the point it starts from and by where it crosses the main lens; it fails by flag, never by
exception.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.optics.camera import Camera, KernelCamera
from lfpiv_cli.optics.media import (
    Media,
    Window,
    equivalent_object_distance,
    fluid_path_to_focus,
    object_space_matrix,
    snell_invariant,
)
from lfpiv_cli.optics.microlenses import nearest_point


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays ended.

    Attributes
    ----------
    sensor_mm : (n, 2) on the sensor, image axes
    array_mm : (n, 2) on the microlens array
    lens_mm : (n, 2) centre of the microlens that was struck
    valid : (n,) the ray passes the aperture
    """

    sensor_mm: NDArray[np.float64]
    array_mm: NDArray[np.float64]
    lens_mm: NDArray[np.float64]
    valid: NDArray[np.bool_]


def slopes_equivalent(
    points: NDArray[np.float64], lens: NDArray[np.float64], camera: Camera, media: Media
) -> NDArray[np.float64]:
    """Return the slopes (n, 2) at the main lens of the rays from the points' equivalents in air (Eqs. 6, 9, 10)."""
    distance = equivalent_object_distance(points[:, 2], camera.focus_distance_mm, media)
    return (lens - points[:, :2]) / distance[:, np.newaxis]


def slopes_direct(
    points: NDArray[np.float64], lens: NDArray[np.float64], camera: Camera, media: Media, window: Window
) -> NDArray[np.float64]:
    """Return the slopes (n, 2) at the main lens of rays traced through window and fluid, paraxially (Eqs. 14, 15)."""
    slopes = np.empty_like(lens)
    for i, (point, crossing) in enumerate(zip(points, lens, strict=True)):
        matrix = object_space_matrix(point[2], window, camera.focus_distance_mm, media)
        start = (crossing - matrix[0, 0] * point[:2]) / matrix[0, 1]
        slopes[i] = matrix[1, 0] * point[:2] + matrix[1, 1] * start
    return slopes


def slopes_exact(
    points: NDArray[np.float64], lens: NDArray[np.float64], camera: Camera, media: Media, window: Window
) -> NDArray[np.float64]:
    """Return the slopes (n, 2) at the main lens of rays refracted by Snell's law at the window's two faces (Eq. 4)."""
    path = fluid_path_to_focus(window, camera.focus_distance_mm, media)
    indices = np.array([media.air, media.window, media.fluid])
    slopes = np.empty_like(lens)
    for i, (point, crossing) in enumerate(zip(points, lens, strict=True)):
        layers = np.array([window.distance_mm, window.thickness_mm, path + point[2]])
        slopes[i] = exact_slope(crossing[0] - point[0], crossing[1] - point[1], layers, indices)
    return slopes


@njit(cache=True)
def exact_slope(
    dx: float, dy: float, thicknesses_mm: NDArray[np.float64], indices: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the slopes in the first layer of the ray that moves (dx, dy) sideways through the layers."""
    lateral = np.sqrt(dx * dx + dy * dy)
    if lateral == 0.0:
        return 0.0, 0.0
    invariant = snell_invariant(lateral, thicknesses_mm, indices)
    tangent = invariant / np.sqrt(indices[0] * indices[0] - invariant * invariant)
    return tangent * dx / lateral, tangent * dy / lateral


def trace(camera: Camera, lens: ArrayLike, slopes: ArrayLike) -> Hits:
    """Trace rays from the main lens to the sensor (Eq. 1).

    Parameters
    ----------
    lens : (n, 2) where the rays cross the main lens, mm
    slopes : (n, 2) their tangents in air in front of it, from one of the `slopes_...` functions

    Notes
    -----
    The main lens turns the slope by -X/F_m; at the array the microlens that is struck, the nearest one, turns it by
    -(x_m - s_u)/f_m. The distortion moves the point on the array before the lens is chosen and leaves directions alone.
    """
    crossing = np.asarray(lens, dtype=np.float64)
    behind = np.asarray(slopes, dtype=np.float64) - crossing / camera.focal_length_mm
    array = crossing + camera.image_distance_mm * behind
    array = array * (1.0 + camera.distortion_per_mm2 * np.sum(array**2, axis=1, keepdims=True))
    centre = camera.lattice.points(camera.lattice.nearest(array))
    sensor = array + camera.microlens_distance_mm * (behind - (array - centre) / camera.microlens_focal_length_mm)
    valid = np.hypot(crossing[:, 0], crossing[:, 1]) <= camera.aperture_radius_mm
    return Hits(sensor, array, centre, valid)


@njit(cache=True)
def trace_ray(
    camera: KernelCamera, lens_x: float, lens_y: float, slope_x: float, slope_y: float
) -> tuple[float, float]:
    """Return where one ray strikes the sensor, mm: `trace` for kernels."""
    behind_x = slope_x - lens_x / camera.focal_length_mm
    behind_y = slope_y - lens_y / camera.focal_length_mm
    x = lens_x + camera.image_distance_mm * behind_x
    y = lens_y + camera.image_distance_mm * behind_y
    stretch = 1.0 + camera.distortion_per_mm2 * (x * x + y * y)
    x *= stretch
    y *= stretch
    centre_x, centre_y = nearest_point(x, y, camera.origin_mm, camera.basis_mm)
    return behind_microlens(camera, x, centre_x, behind_x), behind_microlens(camera, y, centre_y, behind_y)


@njit(cache=True)
def behind_microlens(camera: KernelCamera, place: float, centre: float, slope: float) -> float:
    """Return one coordinate on the sensor of a ray that meets the array at `place` under the microlens at `centre`.

    The last part of Eq. 1; `slope` is the ray's between main lens and array.
    """
    return place + camera.microlens_distance_mm * (slope - (place - centre) / camera.microlens_focal_length_mm)


@njit(cache=True)
def struck_pixel(camera: KernelCamera, x: float, y: float) -> int:
    """Return the flat number of the pixel at a place on the sensor, mm; -1 off the sensor."""
    column = int(np.floor(x / camera.pixel_mm + 0.5 * camera.columns))
    row = int(np.floor(y / camera.pixel_mm + 0.5 * camera.rows))
    return row * camera.columns + column if 0 <= column < camera.columns and 0 <= row < camera.rows else -1


def disc_points(count: int, radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return `count` random points (n, 2), uniform over a disc."""
    r = radius * np.sqrt(rng.random(count))
    angle = 2.0 * np.pi * rng.random(count)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
