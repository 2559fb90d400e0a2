"""How far light spreads behind curved faces, and how well rays made for single voxels follow the traced ones.

Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point; grids in world axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import disc_points
from lfpiv_cli.weights.curved import places_on_array
from lfpiv_cli.weights.scene import AIMED_DEGREE, aimed_rays

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


def spread_mm(camera: Camera, space: CurvedSpace, grid: Grid) -> NDArray[np.float64]:
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
        beside[:, axis] -= np.copysign(
            sides[axis], beside[:, axis]
        )  # towards the optical axis, so not out of the fluid
        shown, also = places_on_array(camera, space, beside, through_middle)
        for crossing in rim:
            place, passes = places_on_array(camera, space, points, np.broadcast_to(crossing, (len(points), 2)))
            good = seen & also & passes
            on_array = np.abs(place - middle)[good, axis] + 0.5 * float(camera.lattice.pitch.max())
            back = sides[axis] / np.abs(shown - middle)[good, axis]
            spread[axis] = max(spread[axis], np.max(on_array * back, initial=0.0))
    return spread


def sample(camera: Camera, grid: Grid) -> NDArray[np.float64]:
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


def seen_depths_mm(camera: Camera, space: CurvedSpace, grid: Grid) -> NDArray[np.float64]:
    """Return the depths in the fluid at which plane windows would show a sample of a grid, along both axes; 0 if none.

    Behind a cylinder a point has two, which differ.
    """
    seen = space.equivalent(camera, sample(camera, grid))
    depths = (seen.distance_mm[seen.valid].ravel() - camera.focus_distance_mm) / space.media.depth_ratio
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
