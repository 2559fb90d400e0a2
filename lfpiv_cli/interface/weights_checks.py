"""Whether weights can be right: the data sheet beside itself, the calibration and the angles, before any work."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.sheet import check_f_numbers, check_pitch, f_number_notices
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.config import Config
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.optics.paraxial import LARGEST_ERROR_PX, refraction_error_mm, rim_tangent, sine_error_mm
from lfpiv_cli.weights.curved_reach import seen_depths_mm
from lfpiv_cli.weights.scene import Source

# Of the angle under which the rim of the lens is seen: beyond 45 degrees a thin lens is far from any real one.
LARGEST_TANGENT = 1.0
DEPTHS = 9


def check_rig(settings: Config, found: Calibration | None) -> None:
    """Refuse a camera that cannot be as the data sheet has it, by itself or beside a calibration.

    Raises
    ------
    ConfigError, InputError
    """
    sheet = settings.camera_model()
    check_f_numbers(sheet)
    if found is not None:
        check_pitch(found.fit, settings.micro_image_pitch_px())
    if settings.weights.method != "dlfc" and rim_tangent(sheet) > LARGEST_TANGENT:
        raise ConfigError(
            f"camera.main_lens.aperture_mm: the rim of the lens is seen under a tangent of {rim_tangent(sheet):.2f} "
            f"(NA {_na(sheet):.2f}) from the focal point, at most {LARGEST_TANGENT:g} may be with traced rays; boards "
            "at several depths and weights.method: dlfc fit the rays of such an objective"
        )


def rig_notices(
    settings: Config, found: Calibration | None, camera: Camera, source: Source, grid: Grid
) -> list[Notice]:
    """Return what speaks against the weights of a grid, z from the focal point, behind a camera."""
    notices = f_number_notices(settings.camera_model())
    depths = np.linspace(*grid.bounds_mm(2), DEPTHS)
    if isinstance(source, CurvedSpace):
        return [*notices, *_of_sines(camera, source.media, seen_depths_mm(camera, source, grid))]
    if not isinstance(source, ObjectSpace):
        return notices
    return [
        *notices,
        *_of_refraction(settings, found, camera, source, depths),
        *_of_sines(camera, source.media, depths),
    ]


def _of_refraction(
    settings: Config, found: Calibration | None, camera: Camera, source: ObjectSpace, depths: NDArray[np.float64]
) -> Iterator[Notice]:
    if source.refraction == "exact" or source.media == source.media.in_air():
        return
    try:
        window = settings.window_model(found.mid_plane_z_mm if found else None)
    except ConfigError:
        window = None
    error_px = refraction_error_mm(camera, source.media, window, depths) / camera.pixel_mm
    if error_px <= LARGEST_ERROR_PX:
        return
    least = "" if window else "at least "
    remedy = "--refraction exact" if window else "give the section window, or channel, and --refraction exact"
    yield Notice(
        "paraxial-refraction",
        "weights.refraction",
        f"is paraxial, and Snell's law moves light at the rim of the aperture by {least}{written(error_px, 2)} px on "
        f"the array, at most {LARGEST_ERROR_PX:g} px without harm",
        remedy,
        error_px,
        f"at most {LARGEST_ERROR_PX:g} px",
    )


def _of_sines(camera: Camera, media: Media, depths: NDArray[np.float64]) -> Iterator[Notice]:
    error_px = sine_error_mm(camera, media, depths) / camera.pixel_mm
    if error_px <= LARGEST_ERROR_PX:
        return
    yield Notice(
        "paraxial-lens",
        "camera.main_lens.aperture_mm",
        f"NA {_na(camera):.2f}: the rays of a thin lens are off by {written(error_px, 2)} px on the array at the "
        f"volume's faces, at most {LARGEST_ERROR_PX:g} px without harm; depths will be wrong",
        "a smaller aperture or a thinner volume, or boards at several depths and weights.method: dlfc",
        error_px,
        f"at most {LARGEST_ERROR_PX:g} px",
    )


def _na(camera: Camera) -> float:
    """Return the numerical aperture towards the scene, in air."""
    tangent = rim_tangent(camera)
    return float(tangent / np.hypot(1.0, tangent))
