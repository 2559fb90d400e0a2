"""How far paraxial optics is from the truth at the rim of the aperture, in light's place on the array.

Two things bend the outer rays more than the equivalent point does: Snell's law at the faces of window and fluid, and
the lens itself, which images a volume's points only if it keeps the sines of the angles, not the tangents of a thin
lens (Abbe's condition). Both are worst for points off the focal plane, or deep in the fluid; here they lie on the axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, Window, equivalent_object_distance
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.optics.tracing import exact_slope

# Light that is further off falls into another pixel. The paper's channel and the sample are off by a tenth of this, its
# simulation behind 134 mm of water by twice this.
LARGEST_ERROR_PX = 0.5


def refraction_error_mm(camera: Camera, media: Media, window: Window | None, depths_mm: NDArray[np.float64]) -> float:
    """Return how far from a paraxial ray's the place of a refracted one on the array is at most, at the rim.

    Parameters
    ----------
    window : what is before the fluid; None: not known, the fluid begins at the nearest of the depths
    depths_mm : of points on the axis; those in front of the fluid do not count
    """
    if window is None:
        window = Window(camera.focus_distance_mm + depths_mm.min() * media.depth_ratio, 0.0)
    exact = ObjectSpace(media, window, "exact")
    rim, layers = camera.aperture_radius_mm, exact.layers(camera)
    thicknesses, last = layers.thicknesses_mm.copy(), exact.last_layers_mm(camera, depths_mm)
    paraxial = rim / equivalent_object_distance(depths_mm, camera.focus_distance_mm, media)
    error = 0.0
    for thickness, slope in zip(last, paraxial, strict=True):
        if thickness > 0.0:
            thicknesses[-1] = thickness
            error = max(error, abs(exact_slope(rim, 0.0, thicknesses, layers.indices)[0] - slope))
    return camera.image_distance_mm * error


def rim_tangent(camera: Camera) -> float:
    """Return the tangent of the angle under which the rim of the lens is seen from the focal point, in air."""
    return camera.aperture_radius_mm / camera.focus_distance_mm


def sine_error_mm(camera: Camera, media: Media, depths_mm: NDArray[np.float64]) -> float:
    """Return how far a thin lens is at most from one that keeps sines, in the place of a rim ray on the array."""
    tangent = rim_tangent(camera)
    defocus = media.depth_ratio * float(np.abs(depths_mm).max())
    return abs(camera.magnification) * defocus * (tangent - tangent / np.hypot(1.0, tangent))
