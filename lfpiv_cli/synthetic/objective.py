"""What a real objective, and an array that is not parallel to the sensor, do to rays; see `optics.camera.Objective`.

Axes: image axes, mm about the optical axis.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.optimize import brentq

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera, KernelCamera, Objective
from lfpiv_cli.optics.tracing import trace_ray


def objective_of(
    camera: Camera,
    *,
    vignetting: float = 0.0,
    falloff: float = 0.0,
    field_curvature_mm: float = 0.0,
    astigmatism_mm: float = 0.0,
    array_tilt_deg: tuple[float, float] = (0.0, 0.0),
) -> Objective:
    """Return an objective by what it does in the corners of the sensor.

    Parameters
    ----------
    vignetting, falloff : shares of the aperture that is cut off, and of the light that is lost besides
    field_curvature_mm, astigmatism_mm : how far behind the array the image lies, and how much further the one of the
        aperture's radial diameter
    array_tilt_deg : angles by which the microlenses' distance grows along the columns and the rows
    """
    corner = 0.5 * camera.pixel_mm * float(np.hypot(camera.columns, camera.rows))
    per_mm2 = 1.0 / corner**2
    along_columns, along_rows = np.tan(np.deg2rad(array_tilt_deg)).tolist()
    return Objective(
        stop_shift=camera.aperture_mm * _apart(1.0 - vignetting) / corner,
        falloff_per_mm2=falloff * per_mm2,
        curvature_per_mm2=field_curvature_mm / camera.image_distance_mm * per_mm2,
        astigmatism_per_mm2=astigmatism_mm / camera.image_distance_mm * per_mm2,
        tilt=(along_columns, along_rows),
    )


def _apart(share: float) -> float:
    """Return how far apart, in diameters, two circles are that have a share of their area in common."""
    if share == 1.0:
        return 0.0
    return float(brentq(lambda u: 2.0 / np.pi * (np.arccos(u) - u * np.sqrt(1.0 - u * u)) - share, 0.0, 1.0))


def passed_light(camera: Camera) -> Floats:
    """Return the share (rows, columns) of the light that falloff leaves."""
    x, y = camera.px_to_mm(np.stack(np.meshgrid(np.arange(camera.columns), np.arange(camera.rows)), axis=-1)).T
    return np.asarray(np.maximum(1.0 - camera.objective.falloff_per_mm2 * (x**2 + y**2), 0.0).T)


@njit(cache=True)
def passes_barrel(camera: KernelCamera, objective: Objective, X: float, Y: float, x: float, y: float) -> bool:
    """Return whether a ray through (X, Y) of the main lens to the place (x, y) on the array passes both apertures."""
    beside_x, beside_y = X + objective.stop_shift * x, Y + objective.stop_shift * y
    furthest2 = max(X * X + Y * Y, beside_x * beside_x + beside_y * beside_y)
    return furthest2 <= camera.aperture_radius_mm * camera.aperture_radius_mm


@njit(cache=True)
def trace_real_ray(
    camera: KernelCamera, objective: Objective, X: float, Y: float, slope_x: float, slope_y: float
) -> tuple[float, float, bool]:
    """Return where a ray that crosses the main lens at (X, Y) strikes the sensor, mm, and whether it passes."""
    x = X + camera.image_distance_mm * (slope_x - X / camera.focal_length_mm)
    y = Y + camera.image_distance_mm * (slope_y - Y / camera.focal_length_mm)
    curved = objective.curvature_per_mm2 * (x * x + y * y)
    along = objective.astigmatism_per_mm2 * (X * x + Y * y)
    off_x, off_y = curved * X + along * x, curved * Y + along * y
    on_x, on_y = trace_ray(
        camera, X, Y, slope_x + off_x / camera.image_distance_mm, slope_y + off_y / camera.image_distance_mm
    )
    x, y = x + off_x, y + off_y
    passes = passes_barrel(camera, objective, X, Y, x, y)
    stretch = 1.0 + camera.distortion_per_mm2 * (x * x + y * y)
    x, y = stretch * x, stretch * y
    further = (objective.tilt[0] * x + objective.tilt[1] * y) / camera.microlens_distance_mm
    return on_x + further * (on_x - x), on_y + further * (on_y - y), passes
