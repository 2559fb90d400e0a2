"""Light as waves: scalar Fresnel diffraction of a point's light through main lens, microlenses and sensor.

The field on the array is the Fourier transform of the pupil, whose phase has the traced rays for normals; each
microlens adds its own phase; a transfer function leads to the sensor, where the intensities of a tracer's points, which
do not interfere, are added up and summed over pixels.

Axes: image axes, mm about the optical axis (see `camera`). Samples are fractions of a pixel, aligned with the pixels.

Notes
-----
A ray through X of the main lens meets the array at x(X), distortion included. With k = 2 pi / wavelength the wave has
there, but for factors of size 1,

    u(x) = exp(i k |x|^2 / 2 s_i)  integral over the pupil of  exp(i phi(X) - i k x X / s_i),   grad phi = k x(X) / s_i

so that the phase is stationary where the ray crosses. Lengths on the array count from the middle c of the light: phi
has k (x(X) - c) / s_i for gradient, and of the first factor exp(i k |x - c|^2 / 2 s_i) is left and a tilt, which moves
the light on the sensor outwards by s_mu c / s_i. The microlens at s adds exp(-i k |x - s|^2 / 2 f_m), the way s_mu to
the sensor exp(-i pi wavelength s_mu nu^2) at the frequency nu.

References
----------
Goodman, Introduction to Fourier Optics, chapters 4 and 5; Broxton et al., Optics Express 21, 25418 (2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.special import ndtr

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera, nearest_point, undistorted
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace

# The pupil's phase is a polynomial of this degree in both coordinates together: what refraction and distortion leave
# of it is below a thousandth of a wavelength for lenses up to f/2.
DEGREE = 8
# Places on the pupil that it is fitted to: the polynomial has 44 coefficients, each place tells two of its slopes.
PUPIL_PLACES = 160
# The samples follow a wave that is so much steeper than the steepest ray: what edges diffract further is weak.
STEEPNESS = 1.5
# Around what rays light, so many microlenses are left for what edges diffract; what goes further comes back on the
# other side, some 0.5 % of the light in focus.
MARGIN_PITCHES = 1.0
UNDISTORT_ROUNDS = 20
# Charge is followed for so many standard deviations of its diffusion.
DIFFUSION_REACH = 5.0

_TERMS = np.array([(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j > 0])

Complex = NDArray[np.complex64]


@dataclass(frozen=True)
class Waves:
    """Light of one wavelength.

    Attributes
    ----------
    wavelength_mm : in air
    points : of a tracer, which glow independently of each other, one where it has no size; None: as many as are needed
    """

    wavelength_mm: float
    points: int | None = None


@dataclass(frozen=True, eq=False)
class Patch:
    """Light on a part of the sensor; `first` is its (row, column) on the sensor, which may lie beyond it."""

    first: tuple[int, int]
    light: Floats

    def add_to(self, image: Floats, counts: float) -> None:
        """Add `counts` times the light to what lies on the sensor."""
        (row, column), (height, width) = self.first, self.light.shape
        top, bottom = np.clip([row, row + height], 0, image.shape[0])
        left, right = np.clip([column, column + width], 0, image.shape[1])
        image[top:bottom, left:right] += counts * self.light[top - row : bottom - row, left - column : right - column]


class WavesInCamera:
    """What waves of points in the scene make of the sensor; may be asked by several threads."""

    def __init__(self, camera: Camera, space: ObjectSpace | CurvedSpace, waves: Waves) -> None:
        """Take the camera, what lies in front of it, and the light."""
        self.camera, self.space, self.waves = camera, space, waves
        self.samples = samples_per_pixel(camera, waves)
        self.step_mm = camera.pixel_mm / self.samples
        self._wave_number = 2.0 * np.pi / waves.wavelength_mm
        # In a sunflower's order they fill the pupil evenly, its rim included.
        turn, places = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(PUPIL_PLACES), np.arange(PUPIL_PLACES)
        radius = np.sqrt(places / (PUPIL_PLACES - 1.0))
        disc = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
        self._pupil_places = camera.aperture_radius_mm * disc
        self._to_pixels = pixel_response(self.samples, camera.diffusion_px)
        self._windows: dict[int, _Window] = {}

    def patch(self, points_mm: ArrayLike) -> Patch | None:
        """Return the light of points that glow alike and do not interfere: 1 in all, less what faces hide.

        Parameters
        ----------
        points_mm : (n, 3), close to each other, image axes

        Returns
        -------
        None where no light reaches the lens, or none the sensor.

        Raises
        ------
        ConfigError : a point in front of the fluid
        """
        camera, radius = self.camera, self.camera.aperture_radius_mm
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
        rays = [(point, *self._rays(point)) for point in points]
        lit = [ray for ray in rays if ray[2].any()]
        if not lit:
            return None

        # The samples hold the light of all rays, and what edges diffract.
        spot = np.concatenate([array[seen] for _, array, seen in lit])
        behind = camera.microlens_distance_mm * steepest(camera) + MARGIN_PITCHES * float(camera.lattice.pitch.max())
        pixels = int(np.ceil((0.5 * float(np.ptp(spot, axis=0).max()) + behind) / camera.pixel_mm)) + 1
        size = 2 * self.samples * fft.next_fast_len(pixels)
        if size not in self._windows:
            self._windows[size] = _Window.of(camera, self.waves, size, self.step_mm)
        window, side = self._windows[size], size // self.samples
        first, middle = self._place(0.5 * (spot.min(axis=0) + spot.max(axis=0)), window)
        if not all(-side < low < full for low, full in zip(first, (camera.rows, camera.columns), strict=True)):
            return None

        # What the array does to the light, with the curvature of light from the main lens.
        lenses = np.empty((size, size), dtype=np.complex64)
        half = 0.5 * self._wave_number
        curvatures = half / camera.image_distance_mm, half / camera.microlens_focal_length_mm
        _write_lenses(window.beside, middle, curvatures, camera.lattice.origin, camera.lattice.basis, lenses)
        light = np.zeros((size, size), dtype=np.float32)
        for point, array, seen in lit:
            amplitude = window.amplitude
            if not seen.all():
                places = np.stack(np.meshgrid(window.pupil, window.pupil), axis=-1).reshape(-1, 2)
                amplitude = amplitude * self.space.slopes(camera, point, places)[1].reshape(amplitude.shape)
            phase = self._phase(array - middle - 0.5 * self.step_mm, seen)
            spectrum = fft.fft2(window.on_array(amplitude, phase, radius) * lenses, overwrite_x=True)
            spectrum *= window.transfer[:, None]
            spectrum *= window.transfer
            _add_intensity(np.asarray(fft.ifft2(spectrum, overwrite_x=True), dtype=np.complex64), light)
        collected = np.zeros((side, side))
        _write_pixels(light, self.samples, self._to_pixels, collected)
        return Patch(first, collected / len(points))

    def _rays(self, point_mm: Floats) -> tuple[Floats, Flags]:
        """Return where a point's rays through places of the pupil meet the array (places, 2), and which there are."""
        crossing = self._pupil_places
        slopes, seen = self.space.slopes(self.camera, point_mm, crossing)
        array = crossing + self.camera.image_distance_mm * (slopes - crossing / self.camera.focal_length_mm)
        array = array + self.camera.objective.aberration(crossing, array)
        return array * (1.0 + self.camera.distortion_per_mm2 * np.sum(array**2, axis=1, keepdims=True)), seen

    @cached_property
    def _terms(self) -> tuple[Floats, Floats]:
        """Slopes (2 places, terms) of each term of the phase on the pupil of radius 1, along x, then y; and back."""
        x, y = (self._pupil_places / self.camera.aperture_radius_mm).T
        i, j = _TERMS[:, 0], _TERMS[:, 1]
        along_x = i * x[:, None] ** np.maximum(i - 1, 0) * y[:, None] ** j
        along_y = j * y[:, None] ** np.maximum(j - 1, 0) * x[:, None] ** i
        slopes = np.concatenate([along_x, along_y])
        return slopes, np.linalg.pinv(slopes)

    def _phase(self, array_mm: Floats, seen: Flags) -> Floats:
        """Return the coefficients (y, x) of the phase, on the pupil of radius 1, whose normals meet the array there."""
        slopes = self._wave_number * self.camera.aperture_radius_mm / self.camera.image_distance_mm * array_mm
        if seen.all():
            terms = self._terms[1] @ slopes.T.ravel()
        else:
            rows = np.concatenate([seen, seen])
            terms = np.linalg.lstsq(self._terms[0][rows], slopes[seen].T.ravel(), rcond=None)[0]
        coefficients = np.zeros((DEGREE + 1, DEGREE + 1))
        coefficients[_TERMS[:, 1], _TERMS[:, 0]] = terms
        return coefficients

    def _place(self, spot_mm: Floats, window: _Window) -> tuple[tuple[int, int], Floats]:
        """Return the window's first (row, column) on the sensor, and its middle on the array.

        The middle is seen at the corner of pixels that is nearest to the spot, with as many samples on either side.
        """
        camera, lever = self.camera, self.camera.microlens_distance_mm / self.camera.image_distance_mm
        axis_px = camera.sensor_centre_px + 0.5
        ideal = undistorted(spot_mm, camera.distortion_per_mm2, rounds=UNDISTORT_ROUNDS)
        corner = np.rint((spot_mm + lever * ideal) / camera.pixel_mm + axis_px).astype(np.int64)
        on_sensor = (corner - axis_px) * camera.pixel_mm
        tilt = undistorted(on_sensor, camera.distortion_per_mm2, 1.0 + lever, UNDISTORT_ROUNDS)
        half = window.size // (2 * self.samples)
        return (int(corner[1]) - half, int(corner[0]) - half), on_sensor - lever * tilt


def steepest(camera: Camera) -> float:
    """Return the steepest slope of a ray behind the array: from the main lens's rim through a microlens's corner."""
    (a, b), area = camera.lattice.basis, camera.lattice.cell_area
    corner = float(np.linalg.norm(a) * np.linalg.norm(b) * np.linalg.norm(a - b)) / (2.0 * area)
    return corner / camera.microlens_focal_length_mm + camera.aperture_radius_mm / camera.image_distance_mm


def samples_per_pixel(camera: Camera, waves: Waves) -> int:
    """Return how many samples along a pixel follow the phase of the steepest wave, two to a turn."""
    return int(np.ceil(2.0 * STEEPNESS * steepest(camera) * camera.pixel_mm / waves.wavelength_mm))


def pixel_response(samples: int, diffusion_px: float) -> Floats:
    """Return the share of the charge of samples about a pixel that it collects; `samples` of them lie on the pixel.

    Charge diffuses as a Gaussian before the pixel adds it up.
    """
    if diffusion_px == 0.0:
        return np.ones(samples)
    beside = int(np.ceil(DIFFUSION_REACH * diffusion_px * samples))
    places = (np.arange(-beside, samples + beside) + 0.5) / samples - 0.5
    return np.asarray(ndtr((places + 0.5) / diffusion_px) - ndtr((places - 0.5) / diffusion_px), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Window:
    """Samples of the array and of the sensor, and those of the pupil that belong to them.

    Attributes
    ----------
    size : samples along each axis
    pupil : (n,) places of the pupil's samples along each axis, mm
    amplitude : (n, n) of the light on them, whose squares sum to 1 over `size`^2, alternating in sign as the middle of
        the array's samples asks for
    beside : (size,) places of the samples from the window's middle, half a sample beside it and further out, mm
    transfer : (size,) phases of the way to the sensor along each axis, by frequency
    """

    size: int
    pupil: Floats
    amplitude: Floats
    beside: Floats
    transfer: Complex

    @classmethod
    def of(cls, camera: Camera, waves: Waves, size: int, step_mm: float) -> _Window:
        """Return the window of so many samples."""
        radius = camera.aperture_radius_mm
        pupil_step = waves.wavelength_mm * camera.image_distance_mm / (size * step_mm)
        half = int(np.ceil(radius / pupil_step)) + 1
        number = np.arange(-half, half + 1)
        pupil = np.asarray(pupil_step * number, dtype=np.float64)
        inside = np.clip((radius - np.hypot(pupil[:, None], pupil)) / pupil_step + 0.5, 0.0, 1.0)
        sign = 1.0 - 2.0 * (number % 2)
        return cls(
            size,
            pupil,
            inside * sign[:, None] * sign / (size * np.sqrt(np.sum(inside**2))),
            np.asarray(step_mm * (np.arange(size) - size // 2 + 0.5), dtype=np.float64),
            np.exp(
                -1j * np.pi * waves.wavelength_mm * camera.microlens_distance_mm * fft.fftfreq(size, step_mm) ** 2
            ).astype(np.complex64),
        )

    def on_array(self, amplitude: Floats, phase: Floats, radius_mm: float) -> Complex:
        """Return the field on the array (y, x), without the lenses, of this amplitude and phase on the pupil."""
        half = len(self.pupil) // 2
        numbers = np.arange(-half, half + 1) % self.size
        field = np.zeros((len(self.pupil), self.size), dtype=np.complex64)
        _write_pupil(amplitude, phase, self.pupil / radius_mm, field)
        whole = np.zeros((self.size, self.size), dtype=np.complex64)
        whole[numbers] = fft.fft(field, axis=1, overwrite_x=True)
        return np.asarray(fft.fft(whole, axis=0, overwrite_x=True), dtype=np.complex64)


@njit(cache=True, nogil=True)
def _write_pupil(amplitude: Floats, phase: Floats, places: Floats, field: Complex) -> None:
    """Write the field of each sample of the pupil (n, size), those left of the middle at the end, by frequency."""
    count, degree = places.size, phase.shape[0] - 1
    along_x = np.empty(degree + 1)
    for row in range(count):
        for i in range(degree + 1):
            value = 0.0
            for j in range(degree, -1, -1):
                value = value * places[row] + phase[j, i]
            along_x[i] = value
        for column in range(count):
            if amplitude[row, column] != 0.0:
                turn = 0.0
                for i in range(degree, -1, -1):
                    turn = turn * places[column] + along_x[i]
                place = column - count // 2
                light = amplitude[row, column] * complex(np.cos(turn), np.sin(turn))
                field[row, place if place >= 0 else place + field.shape[1]] = light


@njit(cache=True, nogil=True)
def _write_lenses(
    beside: Floats, middle: Floats, curvatures: tuple[float, float], origin: Floats, basis: Floats, found: Complex
) -> None:
    """Write the phase factor of each sample on the array: the converging light's, less that of the nearest lens.

    Along the part of a row that lies under one lens the phase is a square, so that each factor follows from the last.
    """
    of_camera, of_lens = curvatures
    step = beside[1] - beside[0]
    bend = np.exp(2.0j * (of_camera - of_lens) * step**2)
    for row in range(beside.size):
        y, first = middle[1] + beside[row], 0
        while first < beside.size:
            lens_x, lens_y = nearest_point(middle[0] + beside[first], y, origin, basis)
            last, beyond = first, beside.size
            while beyond - last > 1:
                column = (last + beyond) // 2
                if nearest_point(middle[0] + beside[column], y, origin, basis) == (lens_x, lens_y):
                    last = column
                else:
                    beyond = column
            x = beside[first]
            off_x, off_y = middle[0] + x - lens_x, y - lens_y
            factor = np.exp(1j * (of_camera * (x**2 + beside[row] ** 2) - of_lens * (off_x**2 + off_y**2)))
            turn = np.exp(1j * step * (of_camera * (2.0 * x + step) - of_lens * (2.0 * off_x + step)))
            for column in range(first, beyond):
                found[row, column] = factor
                factor *= turn
                turn *= bend
            first = beyond


@njit(cache=True, nogil=True)
def _add_intensity(field: Complex, light: Singles) -> None:
    """Add the light of a field."""
    for row in range(field.shape[0]):
        for column in range(field.shape[1]):
            light[row, column] += field[row, column].real ** 2 + field[row, column].imag ** 2


@njit(cache=True, nogil=True)
def _write_pixels(light: Singles, samples: int, response: Floats, pixels: Floats) -> None:
    """Add up what pixels collect of the light of samples, those of `pixel_response`."""
    size, beside = light.shape[0], (response.size - samples) // 2
    of_rows = np.zeros(size)
    for row in range(pixels.shape[0]):
        of_rows[:] = 0.0
        first = row * samples - beside
        for k in range(max(-first, 0), min(response.size, size - first)):
            for column in range(size):
                of_rows[column] += response[k] * light[first + k, column]
        for column in range(pixels.shape[1]):
            first = column * samples - beside
            for k in range(max(-first, 0), min(response.size, size - first)):
                pixels[row, column] += response[k] * of_rows[first + k]
