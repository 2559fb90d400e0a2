"""The place of a small shape in the scene that explains the light of pixels best, by least squares.

Axes: image axes (x along the columns, y along the rows), mm, z away from the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import InputError
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera, Lattice, nearest_point
from lfpiv_cli.optics.media import Media, equivalent_object_distance

# Gauss-Newton starts within the shape and settles in about five rounds, to a hundredth of what noise leaves; a step
# that raises the misfit is halved.
FIT_ROUNDS = 20
FIT_HALVINGS = 6
FIT_TOLERANCE = 1e-4

# Shares of what pixels see (n,), and their derivatives (n, k).
SharesAndSlopes = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A shape fitted to pixels.

    Attributes
    ----------
    position_mm : (3,) x, y in image axes, z in the medium
    covariance_mm2 : (3, 3) of the position
    brightness, background : light of the shape and around it, in the image's unit at full transmission
    rms : root mean square misfit, in the image's unit
    converged : the steps became small before the rounds were used up
    """

    position_mm: Floats
    covariance_mm2: Floats
    brightness: float
    background: float
    rms: float
    converged: bool


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Brightness and background (levels) that explain pixels best for a disc at a given place.

    `design` (n, 7) is what the disc's moves along x, y, z and a unit of each level put on the pixels, `residual` (n,)
    what is left, `misfit` its square.
    """

    design: Floats
    levels: Floats
    residual: Floats
    misfit: float


def fit_shape(
    signal: Floats,
    passed: Floats,
    beside_mm: Floats,
    start_mm: Floats,
    steps_mm: Floats,
    shares_at: Callable[[Floats], SharesAndSlopes],
) -> ShapeFit:
    """Fit a shape to pixels by least squares: x, y, z, brightness and a sloping background are free.

    Parameters
    ----------
    signal, passed : (n,) light on the pixels and the share of light that each passes
    beside_mm : (n, 2) where in the plane of the first guess pixels see, about it
    start_mm : (3,) first guess, in image axes, within about a step
    steps_mm : (3,) by which moves are measured, such that each changes the light alike
    shares_at : gives for a position (3,) the share (n,) of what pixels see that the shape covers, and slopes (n, 3)
    """
    ground = passed[:, np.newaxis] * np.column_stack([np.ones(len(passed)), beside_mm / steps_mm[0]])

    def linear_fit(position: Floats) -> LinearFit:
        shares, moves = shares_at(position)
        design = np.column_stack([passed * shares, ground])
        levels = solved(design, signal)
        residual = signal - design @ levels
        full = np.column_stack([levels[0] * passed[:, np.newaxis] * moves * steps_mm, design])
        return LinearFit(full, levels, residual, float(residual @ residual))

    position = np.asarray(start_mm, dtype=np.float64)
    best = linear_fit(position)
    converged = False
    for _ in range(FIT_ROUNDS):
        move = solved(best.design, best.residual)[:3] * steps_mm
        for _ in range(FIT_HALVINGS):
            trial = linear_fit(position + move)
            if trial.misfit <= best.misfit:
                break
            move = 0.5 * move
        converged = bool(np.all(np.abs(move) <= FIT_TOLERANCE * steps_mm))
        if trial.misfit > best.misfit:
            break
        position, best = position + move, trial
        if converged:
            break
    variance = best.misfit / max(1, signal.size - best.design.shape[1])
    covariance = np.linalg.pinv(best.design.T @ best.design)[:3, :3] * variance * np.outer(steps_mm, steps_mm)
    rms = float(np.sqrt(best.misfit / signal.size))
    return ShapeFit(position, covariance, float(best.levels[0]), float(best.levels[1]), rms, converged)


def solved(design: Floats, values: Floats) -> Floats:
    """Return the coefficients of the design's columns that explain the values best."""
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)


# The points of a calibration target as they were measured one by one.
#
# Axes: image axes (x along the columns, y along the rows), mm, z away from the camera in the medium of the target.


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """Points of a target.

    Attributes
    ----------
    places_mm, sigmas_mm : (n, 3) and their standard errors
    numbers : (n, 2) which point of the target each is, the target turned in any way; None where the grid tells
    """

    places_mm: Floats
    sigmas_mm: Floats
    numbers: NDArray[np.int64] | None = None


def measured_points(fits: Sequence[ShapeFit | None], numbers: NDArray[np.int64] | None = None) -> MeasuredPoints:
    """Return the points of the fits that came to an end."""
    kept = [k for k, fit in enumerate(fits) if fit is not None and fit.converged]
    good = [fit for fit in fits if fit is not None and fit.converged]
    places = np.array([fit.position_mm for fit in good]).reshape(-1, 3)
    sigmas = np.sqrt(np.array([np.diag(fit.covariance_mm2) for fit in good])).reshape(-1, 3)
    return MeasuredPoints(places, sigmas, None if numbers is None else numbers[kept])


# What a small bright disc in the scene looks like on the sensor, and the disc that explains given pixels best.
#
# Axes: image axes (x along the columns, y along the rows), lengths in mm about the optical axis, z away from the
# camera from the focal plane. Rays are followed backwards: a place on the sensor under a microlens names one point of
# the main lens per point of the microlens, and all of a microlens is, seen in the scene, a small polygon. A pixel's
# light is the share of this polygon that the disc covers, exactly, times what the pixel passes.


# A pixel's own width is sampled at its middle while the light it stands for is narrower than this share of the disc's
# radius in the scene, else at 3 x 3 places, which leaves a tenth of the spread out.
SHARP_SHARE = 0.2
BLURRED_SAMPLES = 3
# Undoing r' = r (1 + k1 r^2) by repetition: each round gains a factor 3 k1 r^2, below 0.01 for usable lenses.
UNDISTORT_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class PixelRays:
    """Pixels and the microlenses they lie under.

    Attributes
    ----------
    place_mm : (n, 2) the pixels' centres on the sensor
    lens_mm : (n, 2) centres of their microlenses on the array
    ideal_mm : (n, 2) where the main lens would have sent the rays to these centres without its distortion
    """

    place_mm: Floats
    lens_mm: Floats
    ideal_mm: Floats


def pixel_rays(camera: Camera, column: NDArray[np.int64], row: NDArray[np.int64]) -> PixelRays:
    """Return the rays of pixels: the microlens of a pixel is that of the nearest micro-image."""
    px = np.stack([column, row], axis=-1).astype(np.float64)
    micro_images = camera.micro_image_lattice_px()
    lens = camera.px_to_mm(nearest_points(px, micro_images.origin, micro_images.basis)) / camera.micro_image_scale
    return PixelRays(camera.px_to_mm(px), lens, undistorted(lens, camera.distortion_per_mm2))


@njit(cache=True)
def nearest_points(points: Floats, origin: Floats, basis: Floats) -> Floats:
    """Return the lattice points nearest to points, both (n, 2)."""
    found = np.empty_like(points)
    for n in range(len(points)):
        found[n, 0], found[n, 1] = nearest_point(points[n, 0], points[n, 1], origin, basis)
    return found


def undistorted(points_mm: Floats, distortion_per_mm2: float) -> Floats:
    """Return the points (n, 2) that r' = r (1 + k1 r^2) carries to the given ones."""
    ideal = points_mm
    for _ in range(UNDISTORT_ROUNDS if distortion_per_mm2 else 0):
        ideal = points_mm / (1.0 + distortion_per_mm2 * np.sum(ideal**2, axis=-1, keepdims=True))
    return ideal


def lens_crossings(rays: PixelRays, camera: Camera) -> Floats:
    """Return where on the main lens (n, 2) the light comes from that reaches each pixel through its lens's centre."""
    stretch = camera.image_distance_mm / camera.microlens_distance_mm
    return rays.ideal_mm - (rays.place_mm - rays.lens_mm) * stretch


def scene_points(rays: PixelRays, camera: Camera, media: Media, z_mm: float) -> Floats:
    """Return where in the plane z (n, 2) the light starts that reaches each pixel through its lens's centre.

    From x_m = alpha X - x s_i/s_o.
    """
    distance = float(equivalent_object_distance(z_mm, camera.focus_distance_mm, media))
    alpha = float(camera.defocus(distance))
    back = distance / camera.image_distance_mm
    return (alpha * lens_crossings(rays, camera) - rays.ideal_mm) * back


def lens_cell(lattice: Lattice) -> Floats:
    """Return the corners (4 or 6, 2) of the region nearest to one lattice point, about that point, in order."""
    first, second = lattice.basis
    if lattice.layout == "square":
        return np.array([-first - second, first - second, first + second, second - first]) / 2.0
    half = np.array([first + second, 2.0 * second - first, second - 2.0 * first]) / 3.0
    return np.concatenate([half, -half])


def disc_shares(
    rays: PixelRays, position_mm: Floats, radius_mm: float, camera: Camera, media: Media
) -> SharesAndSlopes:
    """Return for each pixel the share (n,) of the scene it sees at depth z that a disc there covers, and its slopes.

    `position_mm` is (x, y, z) in image axes; the slopes (n, 3) are the share's derivatives by it, per mm.
    """

    def covered(middle: Floats, cell: Floats, width: float) -> SharesAndSlopes:
        samples = 1 if width < SHARP_SHARE * radius_mm else BLURRED_SAMPLES
        return covered_shares(middle, cell, radius_mm, width, samples)

    return scene_shares(rays, position_mm, camera, media, covered)


def scene_shares(
    rays: PixelRays,
    position_mm: Floats,
    camera: Camera,
    media: Media,
    covered: Callable[[Floats, Floats, float], SharesAndSlopes],
) -> SharesAndSlopes:
    """Return the shares (n,) of what pixels see in the plane of `position_mm` that a shape there covers, and slopes.

    Parameters
    ----------
    covered : gives the shares for the middles (n, 2) of what is seen, about the position, the corners of a microlens as
        seen there (k, 2), and the width of a pixel; and their slopes (n, 4) by the middle's x and y, the logarithm of
        the microlens's size, and the width
    """
    distance = float(equivalent_object_distance(position_mm[2], camera.focus_distance_mm, media))
    back = distance / camera.image_distance_mm
    spread = float(camera.defocus(distance)) * back
    stretch = camera.image_distance_mm / camera.microlens_distance_mm
    # How the scene point moves as the ray moves over its microlens: X follows too where the sensor is out of its focus.
    lever = 1.0 + (1.0 - camera.microlens_distance_mm / camera.microlens_focal_length_mm) * stretch
    cell_scale = spread * lever - back
    pixel = stretch * camera.pixel_mm
    # Back, spread and what follows from them are linear in the depth.
    back_z = media.depth_ratio / camera.image_distance_mm
    spread_z = (1.0 - camera.image_distance_mm / camera.focal_length_mm) * back_z
    cell_z, width_z = (spread_z * lever - back_z) / cell_scale, float(np.sign(spread)) * pixel * spread_z
    crossings = lens_crossings(rays, camera)
    middle = spread * crossings - back * rays.ideal_mm - position_mm[:2]
    middle_z = spread_z * crossings - back_z * rays.ideal_mm
    width = abs(spread) * pixel
    shares, slopes = covered(middle, lens_cell(camera.lattice) * cell_scale, width)
    by_z = (
        slopes[:, 0] * middle_z[:, 0] + slopes[:, 1] * middle_z[:, 1] + slopes[:, 2] * cell_z + slopes[:, 3] * width_z
    )
    return shares, np.column_stack([-slopes[:, :2], by_z])


@njit(cache=True)
def covered_shares(middle: Floats, cell: Floats, radius: float, width: float, samples: int) -> tuple[Floats, Floats]:
    """Return the mean share of `cell`, moved to `middle` and over a square of `width` around it, inside the disc.

    The slopes (n, 4) are its derivatives by the middle's x and y, the logarithm of the cell's size, and the width.
    """
    area = 0.0
    reach = 0.0
    for k in range(cell.shape[0]):
        following = (k + 1) % cell.shape[0]
        area += 0.5 * (cell[k, 0] * cell[following, 1] - cell[k, 1] * cell[following, 0])
        reach = max(reach, np.sqrt(cell[k, 0] ** 2 + cell[k, 1] ** 2))
    shares = np.zeros(middle.shape[0])
    slopes = np.zeros((middle.shape[0], 4))
    growth = np.empty(3)
    weight = 1.0 / (samples * samples)
    for n in range(middle.shape[0]):
        for a in range(samples):
            for b in range(samples):
                off_x, off_y = (a + 0.5) / samples - 0.5, (b + 0.5) / samples - 0.5
                x = middle[n, 0] + width * off_x
                y = middle[n, 1] + width * off_y
                distance = np.sqrt(x * x + y * y)
                if distance + reach <= radius:
                    shares[n] += weight
                elif distance - reach < radius:
                    share = disc_polygon_area(x, y, cell, radius) / area
                    disc_polygon_growth(x, y, cell, radius, growth)
                    by_x, by_y = weight * growth[0] / area, weight * growth[1] / area
                    shares[n] += weight * share
                    slopes[n, 0] += by_x
                    slopes[n, 1] += by_y
                    slopes[n, 2] += weight * (growth[2] / area - 2.0 * share)
                    slopes[n, 3] += by_x * off_x + by_y * off_y
    return shares, slopes


@njit(cache=True)
def disc_polygon_growth(x: float, y: float, cell: Floats, radius: float, growth: Floats) -> None:
    """Write the derivatives of `disc_polygon_area` by x, by y, and by the logarithm of the cell's size.

    Every edge sweeps an area as long as its part inside the disc.
    """
    growth[:] = 0.0
    for k in range(cell.shape[0]):
        following = (k + 1) % cell.shape[0]
        dx, dy = cell[following, 0] - cell[k, 0], cell[following, 1] - cell[k, 1]
        ax, ay = x + cell[k, 0], y + cell[k, 1]
        length2 = dx * dx + dy * dy
        along = ax * dx + ay * dy
        inside = along * along - length2 * (ax * ax + ay * ay - radius * radius)
        if inside > 0.0:
            root = np.sqrt(inside)
            part = min((root - along) / length2, 1.0) - max((-along - root) / length2, 0.0)
            if part > 0.0:
                growth[0] += part * dy
                growth[1] -= part * dx
                growth[2] += part * (cell[k, 0] * dy - cell[k, 1] * dx)


@njit(cache=True)
def disc_polygon_area(x: float, y: float, cell: Floats, radius: float) -> float:
    """Return the area shared by a disc about (0, 0) and the polygon `cell` moved by (x, y), with the polygon's sign."""
    area = 0.0
    for k in range(cell.shape[0]):
        following = (k + 1) % cell.shape[0]
        area += disc_triangle_area(
            x + cell[k, 0], y + cell[k, 1], x + cell[following, 0], y + cell[following, 1], radius
        )
    return area


@njit(cache=True)
def sector_area(ax: float, ay: float, bx: float, by: float, radius: float) -> float:
    """Return the signed area of the disc's sector between the directions of a and b."""
    return 0.5 * radius * radius * np.arctan2(ax * by - ay * bx, ax * bx + ay * by)


@njit(cache=True)
def disc_triangle_area(ax: float, ay: float, bx: float, by: float, radius: float) -> float:
    """Return the signed area shared by a disc about the origin and the triangle origin, a, b."""
    dx, dy = bx - ax, by - ay
    length2 = dx * dx + dy * dy
    along = ax * dx + ay * dy
    inside = along * along - length2 * (ax * ax + ay * ay - radius * radius)
    if inside <= 0.0:
        return sector_area(ax, ay, bx, by, radius)
    enter = (-along - np.sqrt(inside)) / length2
    leave = (-along + np.sqrt(inside)) / length2
    if enter >= 1.0 or leave <= 0.0:
        return sector_area(ax, ay, bx, by, radius)
    enter, leave = max(enter, 0.0), min(leave, 1.0)
    px, py = ax + enter * dx, ay + enter * dy
    qx, qy = ax + leave * dx, ay + leave * dy
    return sector_area(ax, ay, px, py, radius) + 0.5 * (px * qy - py * qx) + sector_area(qx, qy, bx, by, radius)


def fit_disc(
    signal: Floats, passed: Floats, rays: PixelRays, start_mm: Floats, radius_mm: float, camera: Camera, media: Media
) -> ShapeFit:
    """Fit a disc of known radius to pixels by least squares.

    Parameters
    ----------
    signal, passed : (n,) light on the pixels and the share of light that each passes
    start_mm : (3,) first guess, in image axes, within about the radius
    """

    def shares_at(position: Floats) -> SharesAndSlopes:
        return disc_shares(rays, position, radius_mm, camera, media)

    beside = scene_points(rays, camera, media, float(start_mm[2])) - start_mm[:2]
    return fit_shape(signal, passed, beside, start_mm, fit_steps(radius_mm, camera, media), shares_at)


def fit_steps(size_mm: float, camera: Camera, media: Media) -> Floats:
    """Return moves (3,) that change a shape's light alike: its size sideways, and what moves the rim's rays as far."""
    deep = size_mm * camera.focus_distance_mm / (camera.aperture_radius_mm * media.depth_ratio)
    return np.array([size_mm, size_mm, deep])


def checked_disc_radius(radius_mm: float, camera: Camera) -> float:
    """Return the radius, or say that the camera cannot resolve such a dot."""
    seen = abs(camera.magnification) * radius_mm
    if seen < 0.25 * float(camera.lattice.pitch.min()):
        raise InputError(
            f"the board's dots are {written(2 * seen)} mm wide on the microlens array, less than half a microlens "
            f"({written(float(camera.lattice.pitch.min()))} mm); use a board with larger dots"
        )
    return radius_mm


# The pixels that see the surroundings of a point in the scene, to fit what is there to them.
#
# Axes: image axes (x along the columns, y along the rows), mm, z away from the camera from the focal plane.


# Pixels at the rim of a micro-image are lit in part, by light that does not come from where their middle sees, and
# rectification mixes neighbours; a pixel is used when the main lens's rim is more than half its patch's diagonal and a
# pixel away. Without that pixel depths are 0.2 % too large.
RIM_PER_PATCH = np.sqrt(0.5) + 1.0
# Fewer pixels than these are a point at the sensor's edge: five unknowns need several times as many.
FEWEST_PIXELS = 50
# More pixels than these make a fit slower and hardly better: the model's own errors are larger than their noise.
MOST_PIXELS = 10_000


@dataclass(frozen=True, eq=False)
class NearPixels:
    """Pixels (n,): their light, the share of it that they pass, and their rays."""

    signal: Floats
    passed: Floats
    rays: PixelRays


def pixels_near(
    picture: tuple[Floats, NDArray[np.float32]],
    camera: Camera,
    media: Media,
    start_mm: tuple[float, float, float],
    reach_mm: float,
    most: int = MOST_PIXELS,
) -> NearPixels | None:
    """Return the pixels that see the plane of a point within `reach_mm` of it; None where the sensor holds too few.

    Parameters
    ----------
    picture : light and the share of it that pixels pass, (rows, columns) each
    """
    x, y, z = start_mm
    signal, passed = picture
    distance = float(equivalent_object_distance(z, camera.focus_distance_mm, media))
    forward = camera.image_distance_mm / distance
    pitch = float(camera.lattice.pitch.max())
    blur = abs(float(camera.defocus(distance))) * camera.aperture_radius_mm
    half = (forward * reach_mm + blur + pitch) / camera.pixel_mm
    middle = camera.mm_to_px(-forward * np.array([x, y]))
    low = np.maximum(np.floor(middle - half), 0).astype(np.int64)
    high = np.minimum(np.ceil(middle + half) + 1, [camera.columns, camera.rows]).astype(np.int64)
    row, column = (axis.ravel() for axis in np.mgrid[low[1] : high[1], low[0] : high[0]])
    rays = pixel_rays(camera, column, row)
    near = np.hypot(*(scene_points(rays, camera, media, z) - (x, y)).T) <= reach_mm
    rim = RIM_PER_PATCH * camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
    through = np.hypot(*lens_crossings(rays, camera).T) <= camera.aperture_radius_mm - rim
    kept = np.nonzero(near & through & (passed[row, column] > 0.0))[0]
    if len(kept) < FEWEST_PIXELS:
        return None
    kept = kept[:: -(-len(kept) // most)]
    chosen = replace(rays, place_mm=rays.place_mm[kept], lens_mm=rays.lens_mm[kept], ideal_mm=rays.ideal_mm[kept])
    return NearPixels(signal[row, column][kept], passed[row, column][kept].astype(np.float64), chosen)
