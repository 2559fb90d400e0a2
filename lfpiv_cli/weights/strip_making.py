"""From camera, curved faces and a grid to the weights in strips: which way the strips run, and how good they are.

Axes: grids in world axes, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.weights.aperture import aperture_mask
from lfpiv_cli.weights.axis_cells import AxisOptics
from lfpiv_cli.weights.curved import lit_voxels
from lfpiv_cli.weights.quadrature import integrate_columns
from lfpiv_cli.weights.strip_blocks import (
    StripScene,
    fits_across,
    fits_along,
    make_blocks,
    places_of,
    rays_of,
    strip_scene,
)
from lfpiv_cli.weights.strip_factors import joined
from lfpiv_cli.weights.strip_kernels import SLAB, STRIP
from lfpiv_cli.weights.strips import StripOperator

# Share of the light that may go astray with as many parts as there can be, by each axis; where more does, rays do not
# separate even in strips.
LARGEST_STRAY_LEFT = 0.04
# Parts of strips, across and in depth, and rays of each, by which that is judged.
PARTS_JUDGED, RAYS_JUDGED = (5, 3), 2048
# Voxels whose columns are held against those of traced rays, and tiles across the aperture for these: their own error
# is then 0.003 to 0.005.
SAMPLE, SAMPLE_TILES = 48, 64

Optics = tuple[AxisOptics, AxisOptics]


class StripLayout(NamedTuple):
    """How a volume is cut into strips.

    Attributes
    ----------
    turned : into strips of columns of voxels, not of rows
    strips, parts : how many, and how many pairs of factors each has, on average
    """

    turned: bool
    strips: int
    parts: float


def strip_layout(camera: Camera, space: CurvedSpace, grid: Grid, optics: Optics) -> StripLayout | None:
    """Return strips of rows of voxels or of columns, what needs fewer parts; None where rays separate in neither."""
    lit = lit_voxels(camera, space, grid)
    found = []
    for turned in (False, True):
        scene = strip_scene(camera, space, grid, optics, lit, turned)
        off, parts = _judged(scene)
        if off < LARGEST_STRAY_LEFT:
            found.append(StripLayout(turned, -(-scene.lit.shape[1] // STRIP), parts))
    return min(found, key=lambda layout: layout.parts, default=None)


def _judged(scene: StripScene) -> tuple[float, float]:
    """Return the share of light that goes astray with as many parts as are needed, and their mean number."""
    off, parts = 0.0, []
    for planes, lines in _some_parts(scene.lit.shape):
        if not scene.lit[planes, lines].any():
            continue
        rays = rays_of(scene, planes, lines, RAYS_JUDGED)
        if rays is None:
            continue
        along, off_along = fits_along(scene, rays)
        across = fits_across(scene, rays)
        mixed = 1 if across.places_mm is None else 2  # places that a voxel's light is shared among
        parts.append(len(along) * len(across.fits) * mixed)
        off = max(off, off_along, across.off)
    return (off, float(np.mean(parts))) if parts else (np.inf, 0.0)


def _some_parts(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Return some parts of strips (planes, lines), all over the volume."""
    firsts = [
        np.unique(np.linspace(0, size - 1, most).astype(int) // step * step)
        for size, step, most in zip((shape[1], shape[0]), (STRIP, SLAB), PARTS_JUDGED, strict=True)
    ]
    return [
        (slice(plane, min(plane + SLAB, shape[0])), slice(line, min(line + STRIP, shape[1])))
        for line in firsts[0]
        for plane in firsts[1]
    ]


def factorise_strips(camera: Camera, space: CurvedSpace, grid: Grid, optics: Optics, turned: bool) -> StripOperator:
    """Return the weights of all voxels of a grid in strips."""
    lit = lit_voxels(camera, space, grid).copy()
    scene = strip_scene(camera, space, grid, optics, lit, turned)
    blocks = make_blocks(scene)
    columns = joined([each.columns for each in blocks], optics[scene.along], scene.cells[scene.along])
    rows = joined([each.rows for each in blocks], optics[scene.across], scene.cells[scene.across])
    mask = aperture_mask(columns.cells, rows.cells, camera.aperture_radius_mm)
    operator = StripOperator(columns, rows, places_of(blocks), mask, scene.order, lit, turned, np.zeros(0))
    sample = sample_lit(camera, space, grid, lit, SAMPLE, np.random.default_rng(0))
    return replace(operator, misfit_l1=misfits_l1(operator, camera, space, grid, sample))


def sample_lit(
    camera: Camera,
    space: CurvedSpace,
    grid: Grid,
    lit: NDArray[np.bool_],
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Return (n, 3) random voxels [plane, row voxel, column voxel], at most so many, all corners of which are seen."""
    inside = np.argwhere(lit)
    some = inside[rng.permutation(len(inside))[: 4 * count]]
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * camera.to_image_axes(np.asarray(grid.spacing_mm))
    points = (voxel_centres(camera, grid, some)[:, np.newaxis] + corners).reshape(-1, 3)
    seen = space.slopes(camera, points, np.zeros((len(points), 2)))[1].reshape(-1, len(corners)).all(axis=1)
    return np.asarray(some[seen][:count])


def voxel_centres(camera: Camera, grid: Grid, voxels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the centres (n, 3), image axes, of voxels [plane, row voxel, column voxel]."""
    first, second = (0, 1) if camera.column_axis == "x" else (1, 0)
    axes = (grid.axis_mm(first)[voxels[:, 2]], grid.axis_mm(second)[voxels[:, 1]], grid.axis_mm(2)[voxels[:, 0]])
    return np.stack(axes, axis=1)


def misfits_l1(
    operator: StripOperator,
    camera: Camera,
    space: CurvedSpace,
    grid: Grid,
    voxels: NDArray[np.int64],
    tiles: int = SAMPLE_TILES,
) -> NDArray[np.float64]:
    """Return how far the columns of voxels (n, 3) are from those of traced rays, in L1."""
    sides = camera.to_image_axes(np.asarray(grid.spacing_mm))
    found = []
    for voxel, centre in zip(voxels, voxel_centres(camera, grid, voxels), strict=True):
        image = integrate_columns(camera, space, [centre], sides, tiles).image(0, operator.image_shape)
        rows, columns, weights = operator.column(*voxel.tolist())
        image[rows, columns] -= weights
        found.append(np.abs(image).sum())
    return np.array(found)
