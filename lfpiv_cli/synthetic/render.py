"""Expected images of glowing points and of uniform light, ray by ray through the tracer's own functions.

Axes: points in world axes (mm, z away from the camera from the nominal focal point); images `[row, column]` of expected
counts, float64, without noise. The rays are those of `optics.tracing`, so a rotated, shifted or hexagonal array and the
distortion come from the camera.

Every point has its own shift of one sequence of rays, drawn before any work is shared out, and light is added up in the
order of the points: the same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, KernelCamera, Objective, nearest_point
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Layers
from lfpiv_cli.optics.tracing import ObjectSpace, slope_polynomial, slope_ratio, struck_pixel
from lfpiv_cli.optics.waves import DIFFUSION_REACH
from lfpiv_cli.synthetic.curved_rays import fit_of_slopes, trace_curved
from lfpiv_cli.synthetic.objective import passes_barrel, trace_real_ray
from lfpiv_cli.synthetic.ray_sequence import SEQUENCE, blur_place, diffused_mm, in_ball, on_disc, ray_places
from lfpiv_cli.threads import share_out

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
    rays: int = RAYS,
    blur_mm: Floats | None = None,
    progress: Callable[[int], None] | None = None,
) -> Floats:
    """Render small glowing balls.

    Parameters
    ----------
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
    weights = np.broadcast_to(np.asarray(balls.light, dtype=np.float64), len(points)) / rays
    radii = np.broadcast_to(0.5 * np.asarray(balls.diameter_mm, dtype=np.float64), len(points))
    blur = diffused_mm(camera) if blur_mm is None else blur_mm
    trace = _tracer_of(camera, space, points, radii.copy(), rng.random((len(points), 4)), blur)

    image = np.zeros((camera.rows, camera.columns))
    batch = max(RAYS_AT_ONCE // rays, 1)
    for start in range(0, len(points), batch):
        part = slice(start, start + batch)
        pixels = np.empty((len(points[part]), rays), dtype=np.int32)
        trace(part, pixels)
        _add_light(image.ravel(), pixels, weights[part])
        if progress is not None:
            progress(len(pixels))
    return image


def _tracer_of(
    camera: Camera,
    space: Space,
    points: Floats,
    radii: Floats,
    shifts: Floats,
    blur_mm: Floats,
) -> Callable[[slice, NDArray[np.int32]], None]:
    """Return what writes the pixels (n, rays) that the rays of a part of the balls strike, image axes."""
    seen = camera.for_kernels()
    if isinstance(space, CurvedSpace):
        faces, fit = space.for_kernels(camera), fit_of_slopes()

        def trace(part: slice, pixels: NDArray[np.int32]) -> None:
            placed = (points[part], radii[part], shifts[part])
            share_out(trace_curved, len(pixels), placed, faces, seen, camera.objective, fit, blur_mm, pixels)

        return trace
    last_layers, layers = space.last_layers_mm(camera, points[:, 2]), space.layers(camera)
    _check_depths(points, last_layers)

    def trace_plane(part: slice, pixels: NDArray[np.int32]) -> None:
        placed = (points[part], radii[part], last_layers[part], shifts[part])
        share_out(_trace_points, len(pixels), placed, layers, seen, camera.objective, blur_mm, pixels)

    return trace_plane


def _check_depths(points: Floats, last_layers_mm: Floats) -> None:
    """Raise where a point lies on the camera's side of the layer that it should be in."""
    if np.any(last_layers_mm <= 0.0):
        nearest = points[:, 2].min()
        raise ConfigError(f"a point at z = {nearest:g} mm lies {-last_layers_mm.min():g} mm in front of the fluid")


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
    aperture_radius = camera.aperture_radius_mm
    for i in range(part[0], part[1]):
        ball_radius = radii[i]
        thicknesses = layers.thicknesses_mm.copy()
        thicknesses[-1] = last_layers[i]
        reach = aperture_radius + ball_radius + np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
        nodes, factors = slope_polynomial(reach, thicknesses, layers.indices)
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


def render_white(camera: Camera, level: float, samples_per_side: int = WHITE_SAMPLES_PER_SIDE) -> Floats:
    """Render uniform light: every microlens shows the aperture disc.

    Traced backwards from a grid of points of each pixel, through evenly spread points of each near microlens, to the
    main lens. Only the nearest lens and its eight neighbours are asked, enough while micro-images overlap less than
    half. The distortion moves light on the array, which uniform light does not show.

    Parameters
    ----------
    level : expected counts of a pixel whose light is not cut by the aperture

    Returns
    -------
    (rows, columns) float64, expected counts
    """
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
    share_out(
        _backtrack_white,
        camera.rows,
        positions,
        offsets,
        camera.for_kernels(),
        camera.objective,
        centres.origin,
        centres.basis,
        lit,
    )
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
    origin_px: Floats,
    basis_px: Floats,
    lit: NDArray[np.int64],
) -> None:
    """Write how many samples of each pixel, rows `part`, come from the aperture, summed over the lenses."""
    columns, pixel = camera.columns, camera.pixel_mm
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
