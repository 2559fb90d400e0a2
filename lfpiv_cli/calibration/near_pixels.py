"""The pixels that see the surroundings of a point in the scene, to fit what is there to them.

Axes: image axes (x along the columns, y along the rows), mm, z away from the camera from the focal plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.dot_model import PixelRays, lens_crossings, pixel_rays, scene_points
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, equivalent_object_distance

# Pixels at the rim of a micro-image are lit in part, by light that does not come from where their middle sees, and
# rectification mixes neighbours; a pixel is used when the main lens's rim is more than half its patch's diagonal and a
# pixel away. Without that pixel depths are 0.2 % too large.
RIM_PER_PATCH = np.sqrt(0.5) + 1.0
# Fewer pixels than these are a point at the sensor's edge: five unknowns need several times as many.
FEWEST_PIXELS = 50
# More pixels than these make a fit slower and hardly better: the model's own errors are larger than their noise.
MOST_PIXELS = 10_000


@dataclass(frozen=True, eq=False)
class NearPixels:
    """Pixels (n,): their light, the share of it that they pass, and their rays."""

    signal: NDArray[np.float64]
    passed: NDArray[np.float64]
    rays: PixelRays


def pixels_near(
    picture: tuple[NDArray[np.float64], NDArray[np.float32]],
    camera: Camera,
    media: Media,
    start_mm: tuple[float, float, float],
    reach_mm: float,
    most: int = MOST_PIXELS,
) -> NearPixels | None:
    """Return the pixels that see the plane of a point within `reach_mm` of it; None where the sensor holds too few.

    Parameters
    ----------
    picture : light and the share of it that pixels pass, (rows, columns) each
    """
    x, y, z = start_mm
    signal, passed = picture
    distance = float(equivalent_object_distance(z, camera.focus_distance_mm, media))
    forward = camera.image_distance_mm / distance
    pitch = float(camera.lattice.pitch.max())
    blur = abs(float(camera.defocus(distance))) * camera.aperture_radius_mm
    half = (forward * reach_mm + blur + pitch) / camera.pixel_mm
    middle = camera.mm_to_px(-forward * np.array([x, y]))
    low = np.maximum(np.floor(middle - half), 0).astype(np.int64)
    high = np.minimum(np.ceil(middle + half) + 1, [camera.columns, camera.rows]).astype(np.int64)
    row, column = (axis.ravel() for axis in np.mgrid[low[1] : high[1], low[0] : high[0]])
    rays = pixel_rays(camera, column, row)
    near = np.hypot(*(scene_points(rays, camera, media, z) - (x, y)).T) <= reach_mm
    rim = RIM_PER_PATCH * camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
    through = np.hypot(*lens_crossings(rays, camera).T) <= camera.aperture_radius_mm - rim
    kept = np.nonzero(near & through & (passed[row, column] > 0.0))[0]
    if len(kept) < FEWEST_PIXELS:
        return None
    kept = kept[:: -(-len(kept) // most)]
    chosen = replace(rays, place_mm=rays.place_mm[kept], lens_mm=rays.lens_mm[kept], ideal_mm=rays.ideal_mm[kept])
    return NearPixels(signal[row, column][kept], passed[row, column][kept].astype(np.float64), chosen)
