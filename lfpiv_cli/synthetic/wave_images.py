"""Expected images of glowing balls and of uniform light by waves: what `render` does by rays.

Axes: points in world axes (mm, z away from the camera from the nominal focal point); images `[row, column]` of expected
counts, float64, without noise. The balls' light is added up in their order: the same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import fft
from scipy.ndimage import map_coordinates
from scipy.special import ndtri

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.waves import Waves, WavesInCamera, samples_per_pixel
from lfpiv_cli.synthetic.ray_sequence import blur_numbers, in_pairs
from lfpiv_cli.synthetic.render import RAYS, Balls, Space, render_points, render_white
from lfpiv_cli.threads import blocks, in_threads

# Patches of light that are held before they are added up, each of up to some 0.5 MB.
PATCHES_AT_ONCE = 64
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
# Lenses around one that can bound it.
NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
# For uniform light samples are so much finer than for tracers: the table of a lens image is read linearly.
LENS_SAMPLES = 2
# Samples of a lens image are this many pitches wide in all.
TABLE_PITCHES = 4.0
# Rows of pixels whose lens images are looked up at once.
ROWS_AT_ONCE = 64


def render_balls(
    camera: Camera,
    space: Space,
    balls: Balls,
    rng: np.random.Generator,
    waves: Waves | None,
    *,
    rays: int = RAYS,
    progress: Callable[[int], None] | None = None,
) -> Floats:
    """Render small glowing balls by waves, or where there are none by `render.render_points`."""
    if waves is None:
        return render_points(camera, space, balls, rng, rays=rays, progress=progress)
    return points_by_waves(camera, space, balls, waves, progress=progress)


def points_by_waves(
    camera: Camera,
    space: Space,
    balls: Balls,
    waves: Waves,
    *,
    progress: Callable[[int], None] | None = None,
) -> Floats:
    """Render small glowing balls as points that glow independently of each other.

    Parameters
    ----------
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
    radii = np.broadcast_to(0.5 * np.asarray(balls.diameter_mm, dtype=np.float64), len(points))
    inside = points_in_ball(waves.points)
    seen = WavesInCamera(camera, space, waves)
    image = np.zeros((camera.rows, camera.columns))
    for part in blocks(len(points), PATCHES_AT_ONCE):
        numbers = range(len(points))[part]
        patches = in_threads(
            lambda i: seen.patch(points[i] + radii[i] * inside if radii[i] > 0.0 else points[i]), numbers
        )
        for i, patch in zip(numbers, patches, strict=True):
            if patch is not None:
                patch.add_to(image, light[i])
        if progress is not None:
            progress(len(numbers))
    return image


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


def white_image(camera: Camera, waves: Waves | None, level: float) -> Floats:
    """Render uniform light by waves, or where there are none by `render.render_white`."""
    return render_white(camera, level) if waves is None else white_by_waves(camera, waves, level)


def white_by_waves(camera: Camera, waves: Waves, level: float) -> Floats:
    """Render uniform light: the disc of the aperture, as each microlens throws it, spread by what a lens diffracts.

    The places of the aperture glow independently of each other. What reaches a pixel through two lenses at once
    interferes, but comes from places so far apart on the aperture that nothing of it is seen.

    Parameters
    ----------
    level : expected counts of a pixel whose light is not cut by the aperture

    Returns
    -------
    (rows, columns) float64, expected counts
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
    return level * _sum_of_lens_images(camera, table, step)


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


def _sum_of_lens_images(camera: Camera, table: Floats, step_mm: float) -> Floats:
    """Return the image (rows, columns) of lens images that a table tells beside their middle, those of nine lenses."""
    lattice, middle, per_px = camera.micro_image_lattice_px(), len(table) // 2, camera.pixel_mm / step_mm
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
