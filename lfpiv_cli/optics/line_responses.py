"""The light of a point under a lens, by waves, as a sum of products of two line responses.

It depends on where the spot on the array lies about the lens (xi, eta), on the point's depth and on the place (u, v)
under the lens, nothing else. In a square array the field on the sensor is a bilinear form of the field on the array, U,
so that a decomposition into products, U(x, y) = sum_k g_k(x) g_k(y), makes the field a sum of products, too, each
factor a one-dimensional diffraction integral over three neighbouring lenses:

    G_k(xi, u) = int g_k(x) exp i k [x^2 / 2 s_i - (x - s(x))^2 / 2 f + (u - x)^2 / 2 s_mu] dx

with s(x) the lens before x. The light of a pixel is sum_kl H_kl(xi, u) H_kl(eta, v) with H_kl the integral of
G_k conj(G_l) over the pixel. A few eigenvectors of that form hold all but a hundredth of it:

    light(xi, eta; u, v) = sum_r sign_r A_r(xi, u) A_r(eta, v).

Within the spot one of them would do; the others are its round rim, where the axes are not independent. They are turned
so that they change smoothly with depth, and can be interpolated. What spreads light along each axis by itself, a
tracer's extent and charge diffusion, is a convolution of A.

Axes: image axes. xi, eta: the spot's middle from the lens; u, v: from the middle of the lens image; mm or pixels.

References
----------
Goodman, Introduction to Fourier Optics, chapter 5. Broxton et al., Optics Express 21, 25418 (2013).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import spline_filter1d
from scipy.special import j0

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.tracing import ObjectSpace, shallowest_mm, slope_ratios
from lfpiv_cli.threads import in_threads

# Spots' places per pitch at which responses are known, and samples of the array between two of them: lenses' edges lie
# between samples. With half as many places tracers within half a depth unit of focus are off by three times as much.
OFFSETS, SAMPLES = 64, 2
# Samples of the sensor per pixel that are added up, and responses per pixel that are kept.
FINE, PHASES = 4, 2
# Offsets that are worked on together, and of so many one tells what all are like.
BATCH, ALIKE = 32, 4
# Lenses about a pixel whose light reaches it: one further away still adds a hundredth of its field.
LENSES = 5
# Depths between which responses are interpolated, in depths over which light spreads by one lens.
DEPTH_STEP = 0.12
# Products of the field, and of the light.
FIELD_TERMS, TERMS = 16, 24
# Beyond the geometric spot the field is followed for so many Fresnel lengths, and so many widths of a point in focus.
# Where it ends sooner, by half of these widths, what is left of many tracers doubles the errors of each.
FRESNEL_LENGTHS, FOCUS_WIDTHS = 3.0, 36.0
# How far charge diffuses in many sensors, .2 to .4 pixel.
USUAL_DIFFUSION_PX = 0.3
# Places along the spot's radius per period of the steepest phase, for a spline through them.
PER_PERIOD = 17.0

Lines = Singles


class LineResponses(NamedTuple):
    """Line responses of a camera, as kernels take them.

    Attributes
    ----------
    table : (depths, offsets, PHASES, terms, pixels) coefficients of cubic splines through A along depth, offset and
        place under the lens, float32; pixel n of phase p lies n + p / PHASES - pixels / 2 from the middle of the lens
        image; no depths where light goes by rays
    signs, ones : (terms,) of the products; ones
    first_depth_mm, depth_step_mm, offset_step_mm : of the table; its offsets are symmetric about 0
    margin_mm : by how much a spot on the array is larger than by rays
    """

    table: Lines
    signs: Singles
    ones: Singles
    first_depth_mm: float
    depth_step_mm: float
    offset_step_mm: float
    margin_mm: float


NO_LINES = LineResponses(
    np.zeros((0, 0, PHASES, 0, 0), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32), 0.0, 1.0, 1.0, 0.0
)


def line_responses(
    camera: Camera, space: ObjectSpace, wavelength_mm: float, depths_mm: tuple[float, float]
) -> LineResponses:
    """Return the line responses of points between two depths.

    Parameters
    ----------
    space : of plane faces; its aberration is that of points on the axis; those in a window light as just behind it
    """
    step = DEPTH_STEP * camera.scale(space.media).depth_mm
    # A spline's ends, where its slopes are not known, reach half so far.
    low, high = int(np.floor(depths_mm[0] / step)) - 2, int(np.ceil(depths_mm[1] / step)) + 2
    pupil = _Pupil(camera, space, wavelength_mm, step * np.arange(low, high + 1, dtype=np.float64))
    planes: list[Lines] = []
    for number in range(len(pupil.depths_mm)):
        lines = _compressed(_pixel_products(pupil, number))
        planes.append(_turned(lines, planes[-1]) if planes else lines)
    widest = max(len(plane) for plane in planes)
    half = np.stack([np.pad(plane, ((0, widest - len(plane)), (0, 0), (0, 0))) for plane in planes])
    # The field is the same on both sides of the axis, so that light at (-xi, -u) is that at (xi, u).
    whole = np.concatenate([half[:, :0:-1, ::-1], half], axis=1)[:, :, :-1]
    positive = np.arange(TERMS) < (TERMS + 1) // 2
    depths, offsets, responses, terms = whole.shape
    by_phase = whole.reshape(depths, offsets, responses // PHASES, PHASES, terms).transpose(0, 1, 3, 4, 2)
    spline, table = _spline_of_places(pupil.pixels), np.empty(by_phase.shape, np.float32)
    for plane, places in zip(table, by_phase, strict=True):
        plane[:] = _mixed(places, spline)
    for axis in (0, 1):
        spline_filter1d(table, axis=axis, output=table)
    return LineResponses(
        table,
        np.where(positive, 1.0, -1.0).astype(np.float32),
        np.ones(TERMS, np.float32),
        float(pupil.depths_mm[0]),
        step,
        float(camera.lattice.pitch.mean()) / OFFSETS,
        pupil.margin_mm,
    )


def of_tracers(points: LineResponses, radius_mm: float, diffusion_px: float) -> LineResponses:
    """Return the responses of balls on pixels that integrate where samples were summed.

    Parameters
    ----------
    radius_mm : on the array; the light of a ball is a product of both axes' distributions
    diffusion_px : standard deviation of the Gaussian by which charge diffuses
    """
    count = int(np.ceil(radius_mm / points.offset_step_mm))
    edges = np.clip((np.arange(-count, count + 2) - 0.5) * points.offset_step_mm / max(radius_mm, 1e-9), -1.0, 1.0)
    share = np.diff(0.25 * (2.0 + 3.0 * edges - edges**3)).astype(np.float32)
    pixels = points.table.shape[-1]
    places = PHASES * pixels
    frequency = np.fft.rfftfreq(2 * places, 1.0 / PHASES)
    damping = np.sinc(frequency / FINE) * np.exp(-2.0 * (np.pi * diffusion_px * frequency) ** 2)
    blur = np.fft.irfft(np.fft.rfft(np.eye(places), 2 * places) * damping)[:, :places]
    spline = _spline_of_places(pixels)
    mix = np.asarray(np.linalg.solve(spline, blur @ spline))
    found = np.empty_like(points.table)
    in_threads(lambda depth: _average(_mixed(points.table[depth], mix), share, found[depth]), range(len(found)))
    return points._replace(table=found)


@njit(cache=True, nogil=True)
def _average(plane: Lines, share: Lines, found: Lines) -> None:
    """Fill in the means over neighbouring offsets, of these shares, of (offsets, PHASES, terms, pixels)."""
    offsets, half = plane.shape[0], share.size // 2
    source, target = plane.reshape(offsets, -1), found.reshape(offsets, -1)
    for offset in range(offsets):
        target[offset] = np.float32(0.0)
        for n in range(max(0, half - offset), min(share.size, offsets + half - offset)):
            for place in range(target.shape[1]):
                target[offset, place] += share[n] * source[offset + n - half, place]


def _spline_of_places(pixels: int) -> Floats:
    """Return what makes coefficients of a spline of values at places under the lens, (from, to)."""
    return np.asarray(spline_filter1d(np.eye(PHASES * pixels)), dtype=np.float64)


@njit(cache=True, **COUNT_NO_REFERENCES)
def spline_weights(t: float) -> tuple[float, float, float, float]:
    """Return the weights of four coefficients of a cubic spline at t, 0 to 1, behind the second's place."""
    u = 1.0 - t
    return u * u * u / 6.0, 2.0 / 3.0 - t * t * (1.0 - 0.5 * t), 2.0 / 3.0 - u * u * (1.0 - 0.5 * u), t * t * t / 6.0


@njit(cache=True, **COUNT_NO_REFERENCES)
def spline_slopes(t: float) -> tuple[float, float, float, float]:
    """Return the derivatives of `spline_weights`."""
    u = 1.0 - t
    return -0.5 * u * u, t * (1.5 * t - 2.0), u * (2.0 - 1.5 * u), 0.5 * t * t


def _mixed(plane: Lines, shares: Floats) -> Lines:
    """Return (offsets, PHASES, terms, pixels) with each place under the lens a sum of all, `shares` (from, to)."""
    offsets, phases, terms, pixels = plane.shape
    # Places by phases: of one phase those of all pixels.
    order = np.arange(phases * pixels).reshape(pixels, phases).T.ravel()
    # Small products, each on one thread.
    mixed = plane.swapaxes(1, 2).reshape(offsets, terms, -1) @ shares[np.ix_(order, order)].astype(np.float32)
    return np.ascontiguousarray(mixed.reshape(offsets, terms, phases, pixels).swapaxes(1, 2))


class _Pupil:
    """What all depths have in common: the aperture's nodes, samples of array and sensor, and the way between them."""

    def __init__(self, camera: Camera, space: ObjectSpace, wavelength_mm: float, depths_mm: Floats) -> None:
        s_i, s_mu, radius = camera.image_distance_mm, camera.microlens_distance_mm, camera.aperture_radius_mm
        pitch, wave_number = float(camera.lattice.pitch.mean()), 2.0 * np.pi / wavelength_mm
        self.camera, self.depths_mm, self.pitch_mm = camera, depths_mm, pitch
        self.step_mm = pitch / (OFFSETS * SAMPLES)
        self.spots_mm = np.abs(_on_array(camera, space, depths_mm, np.array([radius]))[:, 0])
        focus = 0.5 * wavelength_mm * s_i / radius
        fresnel = np.sqrt(wavelength_mm * s_i * self.spots_mm / radius)
        self.reaches_mm = self.spots_mm + FRESNEL_LENGTHS * fresnel + FOCUS_WIDTHS * focus
        self.margin_mm = float(FOCUS_WIDTHS * focus)
        # Of half the phase's range, and what a polynomial lacks.
        furthest = float(self.reaches_mm.max()) * np.sqrt(2.0)
        count = int(200 + wave_number * radius * furthest / s_i)
        nodes, weights = np.polynomial.legendre.leggauss(count)
        nodes, weights = 0.5 * radius * (nodes + 1.0), 0.5 * radius * weights
        # The phase whose normals are the rays: its slope is k x_m / s_i, and x_m is an odd polynomial of degree 9.
        few, shares = np.polynomial.legendre.leggauss(6)
        inner = np.outer(0.5 * (few + 1.0), nodes)
        array = _on_array(camera, space, depths_mm, inner.ravel()).reshape(len(depths_mm), len(few), -1)
        phase = wave_number / s_i * (0.5 * nodes * np.einsum("n,dnp->dp", shares, array))
        self.amplitude = np.exp(1j * phase) * nodes * weights
        self.amplitude *= wave_number / s_i / (np.sqrt(np.pi) * radius)
        self.radii_mm = np.arange(0.0, furthest + 4.0 * self.step_mm, wavelength_mm * s_i / (radius * PER_PERIOD))
        self.bessel = j0(wave_number / s_i * np.outer(self.radii_mm, nodes))
        # Pixels of a cell, and one more on either side.
        self.pixels = int(np.ceil(pitch * camera.micro_image_scale / camera.pixel_mm)) + 3
        across = self.step_mm * (np.arange(LENSES * OFFSETS * SAMPLES) - 0.5 * (LENSES * OFFSETS * SAMPLES - 1))
        beside = across - pitch * np.rint(across / pitch)
        u = camera.pixel_mm / FINE * (np.arange((self.pixels + 1) * FINE) - 0.5 * ((self.pixels + 1) * FINE - 1))
        lens = across**2 / s_i - beside**2 / camera.microlens_focal_length_mm
        phase = 0.5 * wave_number * (lens + (u[:, np.newaxis] - across) ** 2 / s_mu)
        scale = self.step_mm / np.sqrt(wavelength_mm * s_mu)
        self.to_sensor = (scale * np.exp(1j * phase)).astype(np.complex64)

    def field(self, number: int) -> NDArray[np.complex128]:
        """Return factors g_k (terms, n) of the field on the array at a depth, on samples x >= 0; it is even."""
        x = self.step_mm * (np.arange(int(np.ceil(self.reaches_mm[number] / self.step_mm))) + 0.5)
        along = CubicSpline(self.radii_mm, self.bessel @ self.amplitude[number])
        field = along(np.hypot(x[:, np.newaxis], x))
        # The range of a symmetric matrix by a few products, then the small one's own factors (Takagi's).
        basis = np.random.default_rng(0).standard_normal((len(x), min(FIELD_TERMS + 10, len(x)))) + 0j
        for _ in range(3):
            basis, _ = np.linalg.qr(field @ basis.conj())
        small = basis.conj().T @ field @ basis.conj()
        left, values, right = np.linalg.svd(small)
        turn = np.einsum("ij,ij->j", left.conj(), right.T)
        return np.asarray(((basis @ left) * np.sqrt(turn * values))[:, :FIELD_TERMS].T)


def _on_array(camera: Camera, space: ObjectSpace, depths_mm: Floats, pupil_mm: Floats) -> Floats:
    """Return where rays of points on the axis through places of the pupil meet the array (depths, places)."""
    seen = np.maximum(depths_mm, shallowest_mm(space.layers(camera), camera.scale(space.media).depth_mm))
    nodes, factors = space.slope_polynomials(camera, seen, camera.aperture_radius_mm)
    s_i, ratio = camera.image_distance_mm, slope_ratios(pupil_mm**2, nodes, factors)
    return np.asarray(pupil_mm * (1.0 - s_i / camera.focal_length_mm + s_i * ratio))


def _pixel_products(pupil: _Pupil, number: int) -> Singles:
    """Return H (offsets >= 0, responses along u, 2 products) at a depth, real: sums of squares, then differences.

    The light is the sum of products of the first half's columns at (xi, u) and (eta, v), less that of the second's.
    """
    half = pupil.field(number).astype(np.complex64)
    whole = np.concatenate([half[:, ::-1], half], axis=1)
    lenses = int(np.ceil(pupil.reaches_mm[number] / pupil.pitch_mm + 0.5))
    per_pitch = OFFSETS * SAMPLES
    # Room for the lenses about each place, the spot in the middle.
    room = (lenses + (LENSES + 1) // 2) * per_pitch
    short = room - half.shape[1]
    field = np.pad(whole, ((0, 0), (short, short)))
    first, second = np.triu_indices(len(half))
    twice = np.where(first == second, 1.0, np.sqrt(2.0)).astype(np.float32)
    width, places = LENSES * per_pitch, lenses * OFFSETS + 1
    responses, step = PHASES * pupil.pixels + 1, FINE // PHASES
    found = np.empty((places, responses, 2, len(first)), np.float32)
    windows = sliding_window_view(field, width, axis=1)
    for begin in range(0, places, BATCH):
        # The lens lies at -xi from the spot.
        starts = room - width // 2 - SAMPLES * np.arange(begin, min(begin + BATCH, places))
        at_sensor = (windows[:, starts].reshape(-1, width) @ pupil.to_sensor.T).reshape(len(half), len(starts), -1)
        product = at_sensor[first] * at_sensor[second].conj()
        parts = product.reshape(*product.shape[:2], -1, step).sum(axis=-1)
        of_pixels = sum(parts[..., n : n + responses] for n in range(PHASES)).transpose(1, 2, 0) * twice
        found[begin : begin + BATCH, :, 0] = of_pixels.real
        found[begin : begin + BATCH, :, 1] = of_pixels.imag
    found *= pupil.camera.pixel_mm / FINE
    return found


def _compressed(products: Singles) -> Lines:
    """Return the A (offsets >= 0, responses, TERMS) closest to the whole form: half of them count positive."""
    offsets, responses, _, terms = products.shape
    signs = np.repeat([1.0, -1.0], terms)
    # Neighbouring offsets are alike; those beside 0 stand for their mirror images, too.
    some = products[::ALIKE].reshape(-1, 2 * terms)
    weight = np.repeat(np.where(np.arange(0, offsets, ALIKE) > 0, 2.0, 1.0), responses)[:, np.newaxis]
    gram = ((some * weight.astype(np.float32)).T @ some).astype(np.float64)
    values, vectors = np.linalg.eigh(gram)
    kept = values > 1e-7 * values[-1]
    roots, vectors = np.sqrt(values[kept]), vectors[:, kept]
    core = (vectors * roots).T @ (signs[:, np.newaxis] * (vectors * roots))
    strengths, turned = np.linalg.eigh(core)
    positive = (TERMS + 1) // 2
    chosen = np.r_[np.argsort(-strengths)[:positive], np.argsort(strengths)[: TERMS - positive]]
    to_lines = (vectors / roots) @ turned[:, chosen] * np.sqrt(np.abs(strengths[chosen]))
    lines = products.reshape(-1, 2 * terms) @ to_lines.astype(np.float32)
    return lines.reshape(offsets, responses, TERMS)


def _turned(lines: Lines, before: Lines) -> Lines:
    """Return the lines of one depth, turned among those of a sign to be closest to those of the depth before."""
    found = np.empty_like(lines)
    both = min(len(lines), len(before))
    for chosen in (slice(None, (TERMS + 1) // 2), slice((TERMS + 1) // 2, None)):
        here, there = (np.asarray(each[:both, :, chosen], np.float64) for each in (lines, before))
        left, _, right = np.linalg.svd(np.einsum("ouk,oul->kl", here, there))
        found[..., chosen] = lines[..., chosen] @ (left @ right).astype(np.float32)
    return found
