"""How well depth can be told: by reconstructed volumes, by the views' geometry, and at best by the light there is.

Axes: z away from the camera from the nominal focal point, mm in the fluid.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.validation.board import elongation_mm
from lfpiv_cli.validation.bounds import cramer_rao_bound, errors_alone_mm, expected_image, pixel_variance, slopes
from lfpiv_cli.weights.build import default_padding, factorise

# Counts of a whole tracer, as `simulate particles` has them.
LIGHT_COUNTS = 500_000.0
RADIUS_MM = 0.025
# A tracer beside the middle of a lens, as most are.
BESIDE_MM = (0.023, -0.017)
VOXEL_MM = 0.1
# Room for a reconstructed point before and behind it, mm: half of the paper's longest dots and as much again.
ROOM_MM = 4.0
POINT_VOXELS = 5
# A median of so many is right to a sixth of their spread.
FEWEST_TRACERS = 40


def geometric_depth_mm(camera: Camera, media: Media) -> float:
    """Return the depth over which the views from opposite ends of the aperture move by one microlens, mm."""
    scale = camera.scale(media)
    return float(scale.lens_mm * camera.focus_distance_mm / (2.0 * camera.aperture_radius_mm) / media.depth_ratio)


def smallest_errors_mm(
    camera: Camera, media: Media, depths_mm: Sequence[float], readout: Readout
) -> NDArray[np.float64]:
    """Return the Cramer-Rao bound (n, 3) of x, y and z of a tracer alone, by its depth."""
    particles = np.array([[*BESIDE_MM, depth, LIGHT_COUNTS] for depth in depths_mm])
    return errors_alone_mm(raw_view(camera, media, RADIUS_MM), particles, readout)


def smallest_errors_crowded_mm(
    camera: Camera, media: Media, per_lens: float, deepest_mm: float, readout: Readout, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the median bound (3,) of x, y and z of a tracer among others that are to be found as well.

    Parameters
    ----------
    per_lens : tracers per microlens, in a slab up to `deepest_mm` before and behind the focal plane
    """
    view = raw_view(camera, media, RADIUS_MM)
    scale = camera.scale(media)
    side = np.array([camera.columns, camera.rows]) * camera.pixel_mm * scale.lens_mm / float(camera.lattice.pitch[0])
    count = max(round(per_lens * float(np.prod(side)) / scale.lens_mm**2), 1)
    errors: list[NDArray[np.float64]] = []
    while len(errors) < FEWEST_TRACERS:
        places = rng.uniform([*(-0.5 * side), -deepest_mm], [*(0.5 * side), deepest_mm], (count, 3))
        particles = np.column_stack([places, np.full(count, LIGHT_COUNTS)])
        slope = slopes(view, particles)
        bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, particles), readout))
        # whose light lies on the sensor
        inner = np.all(np.abs(places[:, :2]) < 0.25 * side, axis=1)
        errors.extend(bound.sigma_mm(joint=True)[inner])
    return np.asarray(np.median(errors, axis=0))


def elongations_mm(
    camera: Camera, media: Media, depths_mm: Sequence[float], settings: SolverSettings
) -> NDArray[np.float64]:
    """Return how long a reconstructed tracer is in depth (n,), each alone in an image without noise."""
    view = raw_view(camera, media, RADIUS_MM)
    found = []
    for depth in depths_mm:
        particle = np.array([[*BESIDE_MM, depth, LIGHT_COUNTS]])
        image = expected_image(slopes(view, particle), particle).reshape(camera.rows, camera.columns)
        cells = round(2.0 * ROOM_MM / VOXEL_MM)
        grid = Grid.centred((POINT_VOXELS, POINT_VOXELS, cells), (VOXEL_MM,) * 3, (0.0, 0.0, float(depth)))
        padding = default_padding(camera, media, grid)
        padded = grid.padded(padding)
        volume = reconstruct(factorise(camera, media, padded), image.astype(np.float32), settings).volume
        found.append(elongation_mm(padded.axis_mm(2), volume.max(axis=(1, 2)).astype(np.float64)))
    return np.array(found)
