"""Where rays behind curved faces meet the array, and which voxels are seen at all.

Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.face_tracing import aim
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.threads import share_out

# Rays by which a voxel is judged to lie in the fluid and to be seen through the whole aperture: the middle and the rim.
RIM = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def places_on_array(
    camera: Camera, space: CurvedSpace, points_mm: NDArray[np.float64], crossing_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return where rays from (n, 3) through (n, 2) meet the array, without the distortion, and whether they do."""
    slopes, valid = space.slopes(camera, points_mm, crossing_mm)
    return crossing_mm + camera.image_distance_mm * (slopes - crossing_mm / camera.focal_length_mm), valid


def lit_voxels(camera: Camera, space: CurvedSpace, grid: Grid) -> NDArray[np.bool_]:
    """Return which voxels (planes, row voxels, column voxels) have their middle in the fluid, wholly in view."""
    first, second = (0, 1) if camera.column_axis == "x" else (1, 0)
    axes = (grid.axis_mm(first), grid.axis_mm(second), grid.axis_mm(2))
    lit = np.empty(tuple(axis.size for axis in axes[::-1]), np.bool_)
    rim = camera.aperture_radius_mm * RIM
    share_out(_write_lit, axes[2].size, space.for_kernels(camera), axes, rim, lit)
    return lit


@njit(cache=True, nogil=True)
def _write_lit(
    part: tuple[int, int],
    faces: Faces,
    axes: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    rim: NDArray[np.float64],
    lit: NDArray[np.bool_],
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
