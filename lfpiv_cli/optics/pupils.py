"""A main lens whose pupils differ in size, as the thin lens that stands for it.

Seen from behind, the aperture of a real lens is P times as wide as seen from the front, and elsewhere: P > 1 of
retrofocus lenses, P < 1 of telephoto ones; behind a lens that is telecentric towards the array the exit pupil is
infinitely far away. Of a ray from x, at a distance s before the entrance pupil, through X in that pupil, paraxial
optics makes

    x_m = (M + beta) X - beta x,   beta = L / s,   L = F_m (1 - M/P)       its place on the array
    (x_m / P - X) / L                                                      its slope there

with the exit pupil F_m (P - M) in front of the array and the focal plane F_m (1/P - 1/M) in front of the entrance
pupil. The first line is that of a thin lens in the place of the entrance pupil, of the same M and of the image distance
L; its slopes, (x_m - X) / L, differ from those of the second by (1 - 1/P) x_m / L. On a plane behind the array that is
a matter of scale: the thin lens throws the same picture on a sensor that is k times as large and k times as far away,

    k = 1 / (1 - (1 - 1/P) s_mu / L)

pixel by pixel. So a camera with a thin lens stands for the real one exactly, and nothing in the scene changes: depths,
refraction, the diameter of the entrance pupil. (What a distortion, which moves rays on the array and leaves their
directions alone, does on the sensor is off by k - 1 of itself.) All is written by 1/P, which is 0 for a telecentric
lens and 1 for a thin one.
"""

from __future__ import annotations

from dataclasses import replace

from lfpiv_cli.optics.camera import Camera


def thin_lens(real: Camera, entrance_over_exit: float) -> Camera:
    """Return the camera whose thin lens stands for a main lens with pupils.

    Parameters
    ----------
    real : with the lengths of the real lens, sensor and array
    entrance_over_exit : 1/P, diameter of the entrance pupil over that of the exit pupil
    """
    magnification = real.magnification
    narrowing = (1.0 - magnification * entrance_over_exit) / (1.0 - magnification)
    focal_length = real.focal_length_mm * narrowing
    lever = real.microlens_distance_mm / (focal_length * (1.0 - magnification))
    larger = 1.0 / (1.0 - (1.0 - entrance_over_exit) * lever)
    return replace(
        real,
        focal_length_mm=focal_length,
        microlens_distance_mm=real.microlens_distance_mm * larger,
        pixel_mm=real.pixel_mm * larger,
        entrance_over_exit=entrance_over_exit,
    )


def real_lens(thin: Camera) -> Camera:
    """Return the camera with the lengths of the real lens, sensor and array: the way back from `thin_lens`."""
    narrowing = (1.0 - thin.magnification * thin.entrance_over_exit) / (1.0 - thin.magnification)
    larger = 1.0 + (1.0 - thin.entrance_over_exit) * thin.microlens_distance_mm / thin.image_distance_mm
    return replace(
        thin,
        focal_length_mm=thin.focal_length_mm / narrowing,
        microlens_distance_mm=thin.microlens_distance_mm / larger,
        pixel_mm=thin.pixel_mm / larger,
    )


def with_entrance_pupil(camera: Camera, distance_mm: float) -> Camera:
    """Return the camera with its entrance pupil so far from the focal plane's equivalent in air: F_m (1/P - 1/M)."""
    real = real_lens(camera)
    return thin_lens(real, distance_mm / real.focal_length_mm + 1.0 / real.magnification)


def refocused(camera: Camera, magnification: float) -> Camera:
    """Return the camera with the same lens at another magnification."""
    return thin_lens(replace(real_lens(camera), magnification=magnification), camera.entrance_over_exit)
