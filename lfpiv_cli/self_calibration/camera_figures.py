"""What the images of particles tell of the camera, as figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import known
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.self_calibration.nuisances import Nuisances


def shift_px(camera: Camera, change: Nuisances) -> NDArray[np.float64]:
    """Return how far (2,) all lens images have moved since the white image, (columns, rows)."""
    shift = np.array([change.shift_x_mm, change.shift_y_mm])
    return np.asarray(shift * camera.micro_image_scale / camera.pixel_mm, dtype=np.float64)


def camera_figures(camera: Camera, particle_diameter_mm: float, change: Nuisances, error: Nuisances) -> dict[str, Any]:
    """Return the figures of a camera and its particles with what was found, and their standard errors."""
    return {
        "lattice_shift_px": shift_px(camera, change).tolist(),
        "lattice_shift_px_sigma": shift_px(camera, error).tolist(),
        "aperture_mm": camera.aperture_mm + 2.0 * change.aperture_radius_mm,
        "aperture_mm_sigma": known(2.0 * error.aperture_radius_mm),
        "particle_diameter_mm": particle_diameter_mm + 2.0 * change.particle_radius_mm,
        "particle_diameter_mm_sigma": 2.0 * error.particle_radius_mm,
        "k1_per_mm2": camera.distortion_per_mm2 + change.distortion_per_mm2,
        "k1_per_mm2_sigma": error.distortion_per_mm2,
    }
