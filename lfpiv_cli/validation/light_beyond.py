"""Whether tracers shine outside the volume that is to be measured: before it or behind it, where no voxels are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.weights.build import default_padding, factorise

# What is looked at: the middle of an image, so many microlenses wide.
LENSES = 36
# Voxels in microlenses, and planes in depths of one lens: coarse, as only depths are asked for.
VOXEL_LENSES, PLANE_DEPTHS = 0.5, 0.5
# The volume is made longer at either end by this share of it, by two depths of one lens at least, and by ten at most.
LONGER, LEAST_DEPTHS, MOST_DEPTHS = 0.75, 3.0, 10.0
# Light this near to the volume, in depths of one lens, may be from within it.
NEAR_DEPTHS = 1.0
# Of the way to the lens volumes keep clear.
CLEAR = 0.5
SOLVER = SolverSettings("em", 8, accelerate=True)


def share_beyond(camera: Camera, media: Media, z_mm: tuple[float, float], light: NDArray[np.float32]) -> float:
    """Return the share of an image's light that a longer volume puts before or behind the volume.

    Parameters
    ----------
    camera : aligned with the image, as rectified
    z_mm : ends of the volume, from the focal point
    light : (rows, columns) without background and noise
    """
    side = int(round(LENSES * float(camera.micro_image_lattice_px().pitch.mean())))
    rows, columns = (min(size, side + (size - side) % 2) for size in light.shape)
    top, left = (light.shape[0] - rows) // 2, (light.shape[1] - columns) // 2
    small = replace(camera, rows=rows, columns=columns)
    image = np.ascontiguousarray(light[top : top + rows, left : left + columns])
    if not image.any():
        return 0.0
    grid = _longer(small, media, z_mm)
    volume = reconstruct(factorise(small, media, grid), image, SOLVER).volume
    by_depth, depths = volume.sum(axis=(1, 2), dtype=np.float64), grid.axis_mm(2)
    near = NEAR_DEPTHS * camera.scale(media).depth_mm
    beyond = (depths < z_mm[0] - near) | (depths > z_mm[1] + near)
    return float(by_depth[beyond].sum() / max(float(by_depth.sum()), np.finfo(np.float64).tiny))


def _longer(camera: Camera, media: Media, z_mm: tuple[float, float]) -> Grid:
    """Return coarse voxels in all that a camera sees, at the depths of a volume and beyond."""
    scale = camera.scale(media)
    length = z_mm[1] - z_mm[0]
    longer = float(np.clip(LONGER * length, LEAST_DEPTHS * scale.depth_mm, MOST_DEPTHS * scale.depth_mm))
    low = max(z_mm[0] - longer, -CLEAR * camera.focus_distance_mm / media.depth_ratio)
    high = z_mm[1] + longer
    lateral, plane = VOXEL_LENSES * scale.lens_mm, PLANE_DEPTHS * scale.depth_mm
    sides = np.array([camera.columns, camera.rows]) * camera.pixel_mm / abs(camera.magnification)
    if camera.column_axis == "y":
        sides = sides[::-1]
    nx, ny = (max(1, round(side / lateral)) for side in sides)
    nz = max(1, round((high - low) / plane))
    grid = Grid.centred((nx, ny, nz), (lateral, lateral, (high - low) / nz), (0.0, 0.0, 0.5 * (low + high)))
    return grid.padded(default_padding(camera, media, grid))
