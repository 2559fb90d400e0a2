"""Decoding: sub-aperture views, what the scene looks like from one point of the main lens, and refocused pictures.

Axes: images are [row, column]; places on the main lens are (X, Y) in mm in image axes, X along the columns. A view has
one sample per microlens; neighbouring microlenses are neighbours in it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from lfpiv_cli.calibration.refocusing import Refocusing
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media

# Refocused pictures have one sample per microlens, the detail that the array records, softened by half of that so that
# the gaps between microlenses do not beat with the samples.
REFOCUS_SMOOTHING = 0.5
# Samples that see less than this share of the usual light lie beyond the sensor.
LEAST_SEEN = 0.1


def lens_table(camera: Camera) -> NDArray[np.int64]:
    """Return the lattice indices (rows, columns, 2) of the lenses whose images are centred on the sensor.

    The table is rectangular: on hexagons, whose second vector leans, each row starts where the leaning has led it.
    """
    lattice = camera.micro_image_lattice_px()
    corners = np.array([(0, 0), (camera.columns - 1, 0), (0, camera.rows - 1), (camera.columns - 1, camera.rows - 1)])
    j = lattice.coordinates(corners)[:, 1]
    rows = np.arange(int(np.ceil(j.min())), int(np.floor(j.max())) + 1)
    lean = rows // 2 if lattice.layout == "hexagonal" else np.zeros_like(rows)
    left = (0.0 - lattice.points(np.stack([-lean, rows], axis=1))[:, 0]) / lattice.basis[0, 0]
    right = left + (camera.columns - 1) / lattice.basis[0, 0]
    columns = np.arange(int(np.ceil(left.max())), int(np.floor(right.min())) + 1)
    table = np.stack(np.broadcast_arrays(columns[np.newaxis, :] - lean[:, np.newaxis], rows[:, np.newaxis]), axis=-1)
    return table.astype(np.int64)


def view_places_px(camera: Camera, crossing_mm: ArrayLike) -> NDArray[np.float64]:
    """Return where on the sensor (column, row) the ray through (X, Y) and each lens's centre ends, (rows, columns, 2).

    With x_m = s_ux in Eq. 1 the microlens does not bend the ray: x_s = s_ux + s_mu (s_ux - X)/s_i.
    """
    lens = camera.lattice.points(lens_table(camera))
    step = (lens - np.asarray(crossing_mm, dtype=np.float64)) / camera.image_distance_mm
    return camera.mm_to_px(lens + camera.microlens_distance_mm * step)


def view_crossings(radius_mm: float, step_mm: float) -> NDArray[np.float64]:
    """Return points (n, 2) of the main lens, a square grid about its middle."""
    count = int(radius_mm / step_mm)
    line = step_mm * np.arange(-count, count + 1)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= radius_mm]


def sub_aperture_view(image: ArrayLike, camera: Camera, crossing_mm: ArrayLike) -> NDArray[np.float64]:
    """Return the view (lens rows, lens columns) from the point (X, Y) of the main lens, linearly interpolated.

    Parameters
    ----------
    image : (rows, columns), rectified
    camera : with the lattice of the rectified frame
    crossing_mm : (2,) X, Y
    """
    places = view_places_px(camera, crossing_mm)
    pixels = np.asarray(image, dtype=np.float64)
    return ndimage.map_coordinates(pixels, [places[..., 1], places[..., 0]], order=1, mode="nearest")


def views_across(
    image: ArrayLike, camera: Camera, views_per_side: int
) -> dict[tuple[int, int], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the points (X, Y) in mm and the views from a square grid of them, by its row and column.

    The grid's cells cover the main lens; a cell whose middle lies beyond the rim has no view. X grows with the columns
    and Y with the rows.
    """
    line = (2.0 * np.arange(views_per_side) - (views_per_side - 1)) / views_per_side * camera.aperture_radius_mm
    places = {(row, column): np.array([x, y]) for row, y in enumerate(line) for column, x in enumerate(line)}
    return {
        cell: (point, sub_aperture_view(image, camera, point))
        for cell, point in places.items()
        if np.hypot(*point) <= camera.aperture_radius_mm
    }


def refocused_stack(
    image: ArrayLike, camera: Camera, media: Media, depths_mm: ArrayLike, passed: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Return what the scene looks like when focused at depths: (depths, rows, columns), one sample per microlens.

    Every pixel's light is carried back along its ray to the plane and averaged there. The pictures are centred on the
    axis, x and y grow with columns and rows; samples that no pixel sees are 0.

    Parameters
    ----------
    image : (rows, columns), rectified
    camera : with the lattice of the rectified frame
    passed : (rows, columns) share of light that pixels pass, 0 where unusable; default: all the same
    """
    pixels = np.asarray(image, dtype=np.float64)
    share = np.ones(pixels.shape) if passed is None else np.asarray(passed, dtype=np.float64)
    row, column = np.nonzero(share > 0.0)
    planes = Refocusing.of(camera, media, (row, column), samples_per_lens=1, half_width=0.5)

    def refocused(z_mm: float) -> NDArray[np.float64]:
        light, passing = planes.pictures(z_mm, (pixels[row, column], share[row, column]), REFOCUS_SMOOTHING)
        enough = passing > LEAST_SEEN * np.median(passing)
        return np.where(enough, light / np.where(enough, passing, 1.0), 0.0)

    return np.stack([refocused(float(z)) for z in np.asarray(depths_mm, dtype=np.float64)])
