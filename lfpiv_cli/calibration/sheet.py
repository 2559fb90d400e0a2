"""The data sheet beside the measured lattice: do the pitches agree, and what image distance does their ratio tell?

The lens images are projected from the exit pupil: their pitch is that of the lenses times 1 + s_mu/s_i.
"""

from __future__ import annotations

import numpy as np

from lfpiv_cli.calibration.lattice import EXPONENTS, LatticeFit
from lfpiv_cli.errors import InputError
from lfpiv_cli.optics.camera import Camera

# A lattice further from the data sheet than this is another camera, a binned sensor or a slip in the sheet: the
# projection itself makes up to 4 % where the main lens is not known.
LARGEST_DIFFERENCE = 0.05
# The ratio 1 + s_mu/s_i is a few per mille above 1 and sheets give pitches to a few digits: image distances closer than
# this are no contradiction.
IMAGE_DISTANCE_TOLERANCE = 0.1
IMAGE_DISTANCE_SIGMAS = 3.0


def check_pitch(fit: LatticeFit, sheet_pitch_px: float) -> None:
    """Refuse a lattice whose pitch is not the data sheet's.

    Raises
    ------
    InputError
        when they differ by more than 5 %
    """
    pitch = float(fit.lattice_px.pitch.mean())
    if abs(pitch / sheet_pitch_px - 1.0) > LARGEST_DIFFERENCE:
        raise InputError(
            f"the lens images are {pitch:.4g} px apart and {sheet_pitch_px:.4g} px by the data sheet, "
            f"{100 * abs(pitch / sheet_pitch_px - 1.0):.0f} % off, at most {100 * LARGEST_DIFFERENCE:.0f} % may be; "
            "check camera.microlenses.pitch_mm, camera.sensor.pixel_um and that the sensor is not binned"
        )


def sheet_fit(camera: Camera) -> LatticeFit:
    """Return the lattice that the data sheet promises, with no lens found and nothing known about its errors."""
    lattice = camera.micro_image_lattice_px()
    coefficients = np.zeros((len(EXPONENTS), 2))
    coefficients[0], coefficients[1:3] = lattice.origin, lattice.basis
    unknown = np.full(2, np.nan)
    return LatticeFit(
        lattice_px=lattice,
        indices=np.zeros((0, 2), dtype=np.int64),
        centres_px=np.zeros((0, 2)),
        cubic_px=coefficients,
        cubic_used=False,
        residual_px=unknown,
        residual_affine_px=unknown,
        pitch_sigma_px=unknown,
        origin_sigma_px=unknown,
        rotation_sigma_rad=float("nan"),
    )


def image_distance_mm(fit: LatticeFit, camera: Camera) -> tuple[float, float] | None:
    """Return s_i from the ratio of the pitches and its standard error, the sheet's pitch taken for exact.

    None where the lens images are not further apart than the lenses, within their error: the ratio then tells nothing.
    """
    sheet_mm = float(np.sqrt(abs(np.linalg.det(camera.lattice.basis))))
    measured_mm = float(np.sqrt(abs(np.linalg.det(fit.lattice_px.basis)))) * camera.pixel_mm
    sigma = float(np.hypot(*fit.pitch_sigma_px)) / 2.0 / float(fit.lattice_px.pitch.mean())
    excess = measured_mm / sheet_mm - 1.0
    if not np.isfinite(sigma) or excess <= IMAGE_DISTANCE_SIGMAS * sigma:
        return None
    distance = camera.microlens_distance_mm / excess
    return distance, distance * sigma / excess


def image_distance_doubt(fit: LatticeFit, camera: Camera) -> str | None:
    """Return a sentence when the pitch of the lens images contradicts the data sheet's image distance, else None."""
    found = image_distance_mm(fit, camera)
    sheet = camera.image_distance_mm
    if found is not None:
        difference = abs(found[0] - sheet)
        if difference <= max(IMAGE_DISTANCE_TOLERANCE * sheet, IMAGE_DISTANCE_SIGMAS * found[1]):
            return None
    elif fit.lenses == 0:
        return None
    told = "no image distance" if found is None else f"an image distance of {found[0]:.4g} mm"
    return (
        f"the pitch of the lens images tells {told}, the data sheet {sheet:.4g} mm; one of microlenses.pitch_mm, "
        "sensor.pixel_um, sensor.microlens_distance_mm and main_lens is off"
    )
