"""Expected images of glowing points and of uniform light: by rays, or by waves; and their recording.

Axes: points in world axes (mm, z away from the camera from the nominal focal point); images `[row, column]` of expected
counts, float64, without noise. The rays are those of `optics.tracing`, so a rotated, shifted or hexagonal array and the
distortion come from the camera.

Every point has its own shift of one sequence of rays, drawn before any work is shared out, and light is added up in the
order of the points, by waves too: the same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.ndimage import map_coordinates
from scipy.special import ndtr, ndtri

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera, KernelCamera, Objective, nearest_point
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Layers
from lfpiv_cli.optics.tracing import SLOPE_NODES, ObjectSpace, set_slope_polynomial, slope_ratio, struck_pixel
from lfpiv_cli.optics.waves import DIFFUSION_REACH, Patch, Waves, WavesInCamera, samples_per_pixel
from lfpiv_cli.synthetic.rays import (
    GOLDEN_ANGLE,
    SEQUENCE,
    blur_numbers,
    blur_place,
    diffused_mm,
    fit_of_slopes,
    in_ball,
    in_pairs,
    on_disc,
    passes_barrel,
    ray_places,
    trace_curved,
    trace_real_ray,
)
from lfpiv_cli.threads import blocks, in_threads, share_out

Space = ObjectSpace | CurvedSpace
"""What lies in front of the lens: plane layers or curved faces."""

# Rays that are held as pixel numbers before they are added up: 40 MB.
RAYS_AT_ONCE = 10_000_000

# Rays per point. The noise of their sum is about the shot noise of a tracer of 2.5e5 photons on its 5,000 pixels.
RAYS = 40_000

# A pixel of a white image is sampled on a grid this wide: a micro-image's edge is known to 1 % of a pixel's light, and
# the grid's symmetry keeps its centre in place.
WHITE_SAMPLES_PER_SIDE = 8

# Places along an axis that tell from where a pixel collects charge.
QUANTILE_PLACES = 2001

# Points of a ball lie so many widths of a point in focus apart: 0.5 % of their light (L1) is elsewhere. Of 50 um and 16
# points, three widths apart, that is 1 to 2 %, and one particle may be found as two. Of small balls there are so many.
POINTS_APART, FEWEST_POINTS = 1.5, 16
# Patches of waves' light that are held before they are added up, each of up to some 0.5 MB.
PATCHES_AT_ONCE = 64
# Lenses around one that can bound it.
NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
# For uniform light samples are so much finer than for tracers: the table of a lens image is read linearly.
LENS_SAMPLES = 2
# Samples of a lens image are this many pitches wide in all.
TABLE_PITCHES = 4.0
# Rows of pixels whose lens images are looked up at once.
ROWS_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class Balls:
    """Small balls that glow evenly and send light through the whole aperture: tracers.

    Attributes
    ----------
    points_mm : (n, 3) centres, world axes
    light : (n,) or one number, expected counts of each that pass the aperture; those that miss the sensor are lost
    diameter_mm : (n,) or one number, 0 for points; their depth does not count
    """

    points_mm: ArrayLike
    light: ArrayLike
    diameter_mm: ArrayLike


def render_points(
    camera: Camera,
    space: Space,
    balls: Balls,
    rng: np.random.Generator,
    *,
    waves: Waves | None = None,
    rays: int = RAYS,
    blur_mm: Floats | None = None,
    progress: Callable[[int], None] | None = None,
) -> Floats:
    """Render small glowing balls, by rays or, as points that glow independently of each other, by waves.

    Parameters
    ----------
    waves : what light is made of; default: rays
    rays : rays per ball
    blur_mm : (n, 2) places beside where rays would end on the sensor, which they take in turn; default: as charge
        diffuses
    progress : called with the number of balls done

    Returns
    -------
    (rows, columns) float64, expected counts

    Raises
    ------
    ConfigError : a ball in front of the fluid, or no window for exact refraction; through curved faces a ball that is
        not in the fluid is dark
    """
    points = camera.to_image_axes(balls.points_mm).reshape(-1, 3)
    light = np.broadcast_to(np.asarray(balls.light, dtype=np.float64), len(points))
    radii = np.broadcast_to(0.5 * np.asarray(balls.diameter_mm, dtype=np.float64), len(points)).copy()
    image, advance = np.zeros((camera.rows, camera.columns)), progress or (lambda done: None)
    if waves is not None:
        seen = WavesInCamera(camera, space, waves)

        def patch(number: int) -> Patch | None:
            if radii[number] == 0.0:
                return seen.patch(points[number])
            count = waves.points or enough_points(camera, waves, 2.0 * radii[number])
            return seen.patch(points[number] + radii[number] * points_in_ball(count))

        for part in blocks(len(points), PATCHES_AT_ONCE):
            numbers = range(len(points))[part]
            for i, lit in zip(numbers, in_threads(patch, numbers), strict=True):
                if lit is not None:
                    lit.add_to(image, light[i])
            advance(len(numbers))
        return image

    blur, shifts = diffused_mm(camera) if blur_mm is None else blur_mm, rng.random((len(points), 4))
    kernel: Callable[..., None] = trace_curved
    placed: tuple[Floats, ...] = (points, radii, shifts)
    if isinstance(space, CurvedSpace):
        between: Any = (space.for_kernels(camera), fit_of_slopes())
    else:
        last_layers = space.last_layers_mm(camera, points[:, 2])
        if np.any(last_layers <= 0.0):
            nearest = points[:, 2].min()
            raise ConfigError(f"a point at z = {nearest:g} mm lies {-last_layers.min():g} mm in front of the fluid")
        kernel, placed, between = _trace_points, (points, radii, last_layers, shifts), space.layers(camera)
    for part in blocks(len(points), max(RAYS_AT_ONCE // rays, 1)):
        pixels = np.empty((len(points[part]), rays), dtype=np.int32)
        of_part = tuple(each[part] for each in placed)
        share_out(kernel, len(pixels), of_part, between, camera.for_kernels(), camera.objective, blur, pixels)
        _add_light(image.ravel(), pixels, light[part] / rays)
        advance(len(pixels))
    return image


def enough_points(camera: Camera, waves: Waves, diameter_mm: float) -> int:
    """Return how many points a ball is seen as that glows evenly."""
    width = 0.5 * waves.wavelength_mm * camera.focus_distance_mm / camera.aperture_radius_mm
    return max(FEWEST_POINTS, int(np.ceil((diameter_mm / (POINTS_APART * width)) ** 2)))


def points_in_ball(count: int) -> Floats:
    """Return points (count, 3) of a ball of radius 1, seen along the axis, that stand for an even glow.

    They have its mean and its mean squares, a fifth of the radius's along each axis; their depth does not count.
    """
    within = (np.arange(count) + 0.5) / count
    radius, turn = np.sqrt(1.0 - within ** (2.0 / 3.0)), GOLDEN_ANGLE * np.arange(count)
    places = radius[:, np.newaxis] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    places -= places.mean(axis=0)
    spread = np.linalg.cholesky(np.linalg.inv(5.0 * places.T @ places / count))
    return np.column_stack([places @ spread, np.zeros(count)])


@njit(cache=True, nogil=True)
def _trace_points(
    part: tuple[int, int],
    placed: tuple[Floats, Floats, Floats, Floats],
    layers: Layers,
    camera: KernelCamera,
    objective: Objective,
    blur_mm: Floats,
    pixels: NDArray[np.int32],
) -> None:
    """Write the flat pixel number that each ray of the points `part` strikes, (n, rays), -1 where it strikes none.

    `placed` holds all points, the balls' radii, their last layers' thicknesses and the shifts of their rays; rays end
    beside where they would by each of `blur_mm` (m, 2) in turn.
    """
    points, radii, last_layers, shifts = placed
    aperture_radius, nodes, factors = camera.aperture_radius_mm, np.empty(SLOPE_NODES), np.empty(SLOPE_NODES)
    for i in range(part[0], part[1]):
        ball_radius = radii[i]
        reach = aperture_radius + ball_radius + np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
        set_slope_polynomial(reach, layers, last_layers[i] - layers.thicknesses_mm[-1], nodes, factors)
        for k in range(pixels.shape[1]):
            radial, turn, ball_radial, ball_turn = ray_places(shifts, i, k)
            lens_x, lens_y = on_disc(aperture_radius, radial, turn)
            ball_x, ball_y = in_ball(ball_radius, ball_radial, ball_turn)
            dx = lens_x - points[i, 0] - ball_x
            dy = lens_y - points[i, 1] - ball_y
            ratio = slope_ratio(dx * dx + dy * dy, nodes, factors)
            x, y, passes = trace_real_ray(camera, objective, lens_x, lens_y, ratio * dx, ratio * dy)
            beside = blur_place(shifts, i, k, blur_mm.shape[0])
            struck = struck_pixel(camera, x + blur_mm[beside, 0], y + blur_mm[beside, 1])
            pixels[i, k] = struck if passes else -1


@njit(cache=True)
def _add_light(image: Floats, pixels: NDArray[np.int32], weights: Floats) -> None:
    """Add each point's weight to the pixels of its rays, in order."""
    for i in range(pixels.shape[0]):
        for k in range(pixels.shape[1]):
            if pixels[i, k] >= 0:
                image[pixels[i, k]] += weights[i]


def render_white(
    camera: Camera, level: float, samples_per_side: int = WHITE_SAMPLES_PER_SIDE, waves: Waves | None = None
) -> Floats:
    """Render uniform light, by rays or by waves: every microlens shows the aperture disc.

    Traced backwards from a grid of points of each pixel, through evenly spread points of each near microlens, to the
    main lens. Only the nearest lens and its eight neighbours are asked, enough while micro-images overlap less than
    half. The distortion moves light on the array, which uniform light does not show.

    Parameters
    ----------
    level : expected counts of a pixel whose light is not cut by the aperture
    waves : what light is made of; default: rays

    Returns
    -------
    (rows, columns) float64, expected counts
    """
    if waves is not None:
        return level * _white_by_waves(camera, waves)
    # charge comes from further around, and less evenly
    across = samples_per_side if camera.diffusion_px == 0.0 else 2 * samples_per_side
    samples = across**2
    line = pixel_places(across, camera.diffusion_px)
    positions = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    # offsets within a lens's cell: points of the basis cell, moved to the lens that they are nearest to
    lattice = camera.lattice
    cell = (np.arange(samples)[:, np.newaxis] * SEQUENCE[:2] % 1.0) @ lattice.basis + lattice.origin
    offsets = cell - lattice.points(lattice.nearest(cell))
    # the sequence's mean is not the lens's centre: it would move the micro-images by 0.002 px
    offsets = offsets - offsets.mean(axis=0)
    centres = camera.micro_image_lattice_px()
    lit = np.empty((camera.rows, camera.columns), dtype=np.int64)
    seen = camera.for_kernels(), camera.objective
    share_out(_backtrack_white, camera.rows, positions, offsets, *seen, (centres.origin, centres.basis), lit)
    return lit * np.float64(level / samples)


def pixel_places(count: int, diffusion_px: float) -> Floats:
    """Return places along an axis about a pixel's middle, in pixels, each of which sends it as much charge."""
    share = (np.arange(count) + 0.5) / count
    if diffusion_px == 0.0:
        return share - 0.5
    reach = 0.5 + DIFFUSION_REACH * diffusion_px
    places = np.linspace(-reach, reach, QUANTILE_PLACES)
    from_pixel = ndtr((places + 0.5) / diffusion_px) - ndtr((places - 0.5) / diffusion_px)
    below = np.cumsum(from_pixel) - 0.5 * from_pixel
    return np.interp(share, below / from_pixel.sum(), places)


@njit(cache=True, nogil=True)
def _backtrack_white(
    part: tuple[int, int],
    positions_px: Floats,
    offsets: Floats,
    camera: KernelCamera,
    objective: Objective,
    centres_px: tuple[Floats, Floats],
    lit: Integers,
) -> None:
    """Write how many samples of each pixel, rows `part`, come from the aperture, summed over the lenses."""
    (origin_px, basis_px), columns, pixel = centres_px, camera.columns, camera.pixel_mm
    middle_x, middle_y = 0.5 * (columns - 1.0), 0.5 * (camera.rows - 1.0)
    to_lens = pixel / (1.0 + camera.microlens_distance_mm / camera.image_distance_mm)
    # Eq. 1 for a ray that meets the array q beside the centre s_u of a lens, solved for X:
    # x_s = s_u + q (1 - s_mu/f_m) + s_mu (s_u + q - X)/s_i
    for row in range(part[0], part[1]):
        for column in range(columns):
            near_x, near_y = nearest_point(float(column), float(row), origin_px, basis_px)
            count = 0
            for i in (-1, 0, 1):
                for j in (-1, 0, 1):
                    centre_x = near_x + i * basis_px[0, 0] + j * basis_px[1, 0]
                    centre_y = near_y + i * basis_px[0, 1] + j * basis_px[1, 1]
                    s_x, s_y = (centre_x - middle_x) * to_lens, (centre_y - middle_y) * to_lens
                    further = objective.tilt[0] * s_x + objective.tilt[1] * s_y
                    distance, moved = camera.microlens_distance_mm + further, further / camera.image_distance_mm
                    lever = camera.image_distance_mm / distance
                    straight = 1.0 - distance / camera.microlens_focal_length_mm
                    for k in range(offsets.shape[0]):
                        beside_x = (column + positions_px[k, 0] - centre_x) * pixel - moved * s_x
                        beside_y = (row + positions_px[k, 1] - centre_y) * pixel - moved * s_y
                        q_x, q_y = offsets[k, 0], offsets[k, 1]
                        x = q_x - lever * (beside_x - q_x * straight)
                        y = q_y - lever * (beside_y - q_y * straight)
                        if passes_barrel(camera, objective, x, y, s_x + q_x, s_y + q_y):
                            count += 1
            lit[row, column] = count


def _white_by_waves(camera: Camera, waves: Waves) -> Floats:
    """Return uniform light (rows, columns): the aperture's disc behind each microlens, spread by what it diffracts.

    The places of the aperture glow independently of each other. What reaches a pixel through two lenses at once
    interferes, but comes from places so far apart on the aperture that nothing of it is seen.
    """
    beside = _beside(camera, waves)
    step = float(beside[1] - beside[0])
    radius = camera.aperture_radius_mm * camera.microlens_distance_mm / camera.image_distance_mm
    disc = np.clip((radius - np.hypot(beside[:, np.newaxis], beside)) / step + 0.5, 0.0, 1.0)
    frequency = fft.fftfreq(len(beside), step)
    blurred = np.exp(-2.0 * (np.pi * camera.diffusion_px * camera.pixel_mm * frequency) ** 2)
    pixel = np.sinc(frequency * camera.pixel_mm) * blurred
    spread = fft.fft2(fft.ifftshift(lens_spread(camera, waves, beside))) * pixel[:, np.newaxis] * pixel
    table = fft.fftshift(fft.ifft2(fft.fft2(fft.ifftshift(disc)) * spread).real)
    # a pixel has the lens images of nine lenses, which the table tells beside their middle
    lattice, middle, per_px = camera.micro_image_lattice_px(), len(table) // 2, camera.pixel_mm / step
    image = np.zeros((camera.rows, camera.columns))

    def write(rows: slice) -> None:
        row, column = np.mgrid[rows, : camera.columns]
        places = np.stack([column, row], axis=-1).astype(np.float64)
        near = lattice.nearest(places)
        for neighbour in [(0, 0), *NEIGHBOURS]:
            beside = (places - lattice.points(near + np.array(neighbour))) * per_px + middle
            image[rows] += map_coordinates(table, [beside[..., 1], beside[..., 0]], order=1, mode="constant")

    in_threads(write, blocks(camera.rows, ROWS_AT_ONCE))
    return image


def lens_spread(camera: Camera, waves: Waves, beside_mm: Floats) -> Floats:
    """Return the light of a place on the main lens behind the microlens at 0, its sum 1, on samples (y, x) about it."""
    step = beside_mm[1] - beside_mm[0]
    inside = np.ones((len(beside_mm), len(beside_mm)))
    for neighbour in NEIGHBOURS:
        x, y = np.array(neighbour) @ camera.lattice.basis
        apart = np.hypot(x, y)
        beyond = (x * beside_mm + y * beside_mm[:, np.newaxis]) / apart - 0.5 * apart
        inside = np.minimum(inside, np.clip(0.5 - beyond / step, 0.0, 1.0))
    bend = 1.0 / camera.image_distance_mm - 1.0 / camera.microlens_focal_length_mm
    along = np.exp(1j * np.pi / waves.wavelength_mm * bend * beside_mm**2)
    way = np.exp(
        -1j * np.pi * waves.wavelength_mm * camera.microlens_distance_mm * fft.fftfreq(len(beside_mm), step) ** 2
    )
    field = fft.ifft2(fft.fft2(inside * along[:, np.newaxis] * along) * way[:, np.newaxis] * way)
    light = field.real**2 + field.imag**2
    return np.asarray(light / light.sum(), dtype=np.float64)


def lens_blur_mm(camera: Camera, waves: Waves) -> Floats:
    """Return places (n, 2) beside a ray's end on the sensor: what one lens diffracts, in focus, and charge diffuses.

    Rays that take them in turn show an extended source nearly as waves do: of a dot two microlenses wide 3, 6 and 8 %
    of the light (L1) is elsewhere at a depth of 0.3, 2.2 and 4 mm with Table 2's camera, where of plain rays 6, 11 and
    15 % is. What is left comes from lenses that light reaches in part, and from the main lens's rim.
    """
    distance = 1.0 / (1.0 / camera.microlens_distance_mm + 1.0 / camera.image_distance_mm)
    beside = _beside(camera, waves)
    light = lens_spread(replace(camera, microlens_focal_length_mm=distance), waves, beside)
    numbers, step = blur_numbers(), beside[1] - beside[0]
    row = np.searchsorted(np.cumsum(light.sum(axis=1)), numbers[:, 2])
    of_row = np.cumsum(light, axis=1)
    column = [np.searchsorted(of_row[i], share * of_row[i, -1]) for i, share in zip(row, numbers[:, 3], strict=True)]
    places = beside[np.stack([column, row], axis=-1)] + step * (numbers[:, 4:] - 0.5)
    return in_pairs(places + camera.diffusion_px * camera.pixel_mm * ndtri(numbers[:, :2]))


def _beside(camera: Camera, waves: Waves) -> Floats:
    """Return samples along an axis about the middle of a lens image, mm."""
    step = camera.pixel_mm / (LENS_SAMPLES * samples_per_pixel(camera, waves))
    half = fft.next_fast_len(int(np.ceil(0.5 * TABLE_PITCHES * float(camera.lattice.pitch.max()) / step)))
    return np.asarray(step * np.arange(-half, half), dtype=np.float64)


# From expected counts to what the sensor records: shot noise, read noise, dark level, quantisation.


@dataclass(frozen=True)
class Readout:
    """How the sensor turns light into counts.

    Attributes
    ----------
    photons_per_count : photons that make one count; None leaves shot noise out
    read_noise_counts : standard deviation of the noise that does not depend on light
    dark_level_counts : counts without light
    bits : counts end at 2^bits - 1; 12-bit counts are stored unshifted
    """

    photons_per_count: float | None = 0.5
    read_noise_counts: float = 6.0
    dark_level_counts: float = 96.0
    bits: int = 16

    def record(self, expected_counts: Floats, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return the recorded image of expected counts (without the dark level), rounded and clipped."""
        counts = expected_counts
        if self.photons_per_count is not None:
            counts = rng.poisson(expected_counts * self.photons_per_count) / self.photons_per_count
        counts = counts + self.dark_level_counts
        if self.read_noise_counts > 0.0:
            counts = counts + rng.normal(0.0, self.read_noise_counts, counts.shape)
        return np.clip(np.rint(counts), 0, 2**self.bits - 1).astype(np.uint16)
