"""Columns behind curved faces: in strips, on demand and counted, beside converged integrals over traced rays.

Axes: voxels [plane, row voxel, column voxel] of a grid; centres in world axes (x, y, z), z away from the camera from
the nominal focal point; images [row, column].
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.validation.weights import RAYS_PER_POINT_LONG, Column, cut_to_lit
from lfpiv_cli.weights.columns import operator_of
from lfpiv_cli.weights.curved import lit_voxels
from lfpiv_cli.weights.quadrature import (
    DEPTH_NODES,
    REFERENCE_DEPTH_NODES,
    REFERENCE_TILES,
    TILES,
    integrate_columns,
)
from lfpiv_cli.weights.rays import RayCount, count_rays
from lfpiv_cli.weights.strip_making import sample_lit, voxel_centres
from lfpiv_cli.weights.strips import StripOperator


def seen_voxels(
    camera: Camera, space: CurvedSpace, grid: Grid, count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return (n, 3) random voxels of a grid that lie wholly in the fluid, at most so many.

    Raises
    ------
    ConfigError : there are none
    """
    found = sample_lit(camera, space, grid, lit_voxels(camera, space, grid), count, rng)
    if not len(found):
        raise ConfigError("validation: no voxel of the volume lies wholly in the fluid behind the scene")
    return found


def make_curved_columns(
    camera: Camera,
    space: CurvedSpace,
    grid: Grid,
    voxels: NDArray[np.int64],
    rng: np.random.Generator,
    long_count: NDArray[np.int64],
    progress: Callable[[int], None] | None = None,
) -> list[Column]:
    """Return the columns of voxels (n, 3) by every way there is behind curved faces.

    Parameters
    ----------
    long_count : (n,) rays of long counts of each voxel; 0: none
    progress : called with 1 after each voxel
    """
    operator, shape = operator_of(camera, space, grid), (camera.rows, camera.columns)
    sides = camera.to_image_axes(np.asarray(grid.spacing_mm))
    columns = []
    for voxel, point, rays in zip(voxels, voxel_centres(camera, grid, voxels), long_count, strict=True):
        integrated = partial(integrate_columns, camera, space, point, sides)
        images = {
            "ert": integrated(REFERENCE_TILES, REFERENCE_DEPTH_NODES).image(0, shape),
            "coarser": integrated(REFERENCE_TILES // 2, REFERENCE_DEPTH_NODES).image(0, shape),
            "on_demand": integrated(TILES, DEPTH_NODES).image(0, shape),
            "ray_count": count_rays(camera, space, point, sides, rng),
        }
        if isinstance(operator, StripOperator):
            images["factorised"] = np.zeros(shape)
            rows, cells, weights = operator.column(*voxel.tolist())
            images["factorised"][rows, cells] = weights
        if rays:
            per_point = min(RAYS_PER_POINT_LONG, int(rays))
            number = RayCount(int(rays) // per_point, per_point)
            images["long_count"] = count_rays(camera, space, point, sides, rng, number)
        x, y, z = camera.to_image_axes(point)
        columns.append(Column((float(x), float(y), float(z)), cut_to_lit(images)))
        if progress:
            progress(1)
    return columns
