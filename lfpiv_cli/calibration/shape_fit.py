"""The place of a small shape in the scene that explains the light of pixels best, by least squares.

Rays are followed backwards: a place on the sensor under a microlens names one point of the main lens per point of the
microlens, and all of a microlens is, seen in the scene, a small polygon. A pixel's light is the share of this polygon
that the shape covers, exactly, times what the pixel passes.

Axes: image axes (x along the columns, y along the rows), mm about the optical axis, z away from the camera from the
focal plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera, Lattice, nearest_point, undistorted
from lfpiv_cli.optics.media import Media, equivalent_object_distance

# Gauss-Newton starts within the shape and settles in about five rounds, to a hundredth of what noise leaves; a step
# that raises the misfit is halved.
FIT_ROUNDS = 20
FIT_HALVINGS = 6
FIT_TOLERANCE = 1e-4

# A pixel's own width is sampled at its middle while the light it stands for is narrower than this share of half a
# shape's width in the scene, else at 3 x 3 places, which leaves a tenth of the spread out.
SHARP_SHARE = 0.2
BLURRED_SAMPLES = 3

# Shares of what pixels see (n,), and their derivatives (n, k).
SharesAndSlopes = tuple[Floats, Floats]


class Strips(NamedTuple):
    """Strips (n,) of a shape: where along x they begin and end, how far aside they lie, and how wide they are.

    Lengths in the scene, mm, from the shape's place.
    """

    begin_mm: Floats
    end_mm: Floats
    aside_mm: Floats
    width_mm: Floats


class PointShape(NamedTuple):
    """What lies about a point of a target: a disc, or the two squares that meet in a corner.

    Attributes
    ----------
    step_mm : in what steps a fit moves it
    half_mm : half its width, about
    covered : compiled; gives shares and slopes for the middles (n, 2) of what is seen, about the point, the corners of
        a microlens as seen there (k, 2), `figure`, the width of a pixel, and its samples along each axis; the slopes
        (n, 4) are by the middle's x and y, the logarithm of the microlens's size, and the width
    figure : what `covered` is told of the shape
    strips : gives its strips where a lens sees so many mm of the scene
    """

    step_mm: float
    half_mm: float
    covered: Callable[..., SharesAndSlopes]
    figure: float | Floats
    strips: Callable[[float], Strips]


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A shape fitted to pixels.

    Attributes
    ----------
    position_mm : (3,) x, y in image axes, z in the medium
    covariance_mm2 : (3, 3) of the position
    brightness : light of the shape, in the image's unit at full transmission
    converged : the steps became small before the rounds were used up
    """

    position_mm: Floats
    covariance_mm2: Floats
    brightness: float
    converged: bool


def fit_shape(
    near: NearPixels,
    start_mm: Floats,
    steps_mm: Floats,
    beside_mm: Floats,
    shares_at: Callable[[Floats], SharesAndSlopes],
) -> ShapeFit:
    """Fit a shape to pixels by least squares: x, y, z, brightness and a sloping background are free.

    Parameters
    ----------
    near : light on the pixels and the share of light that each passes
    start_mm : (3,) first guess, in image axes, within about a step
    steps_mm : (3,) by which moves are measured, such that each changes the light alike
    beside_mm : (n, 2) where in the plane of the first guess pixels see, about it
    shares_at : gives for a position (3,) the share (n,) of what pixels see that the shape covers, and slopes (n, 3)
    """
    signal, passed = near.signal, near.passed
    ground = passed[:, np.newaxis] * np.column_stack([np.ones(len(passed)), beside_mm / steps_mm[0]])

    def linear_fit(position: Floats) -> tuple[Floats, float, Floats, float]:
        """Return what moves and levels put on the pixels (n, 7), the brightness, what is left (n,), and its square."""
        shares, moves = shares_at(position)
        design = np.column_stack([passed * shares, ground])
        levels = solved(design, signal)
        residual = signal - design @ levels
        full = np.column_stack([levels[0] * passed[:, np.newaxis] * moves * steps_mm, design])
        return full, float(levels[0]), residual, float(residual @ residual)

    position = start_mm
    design, brightness, residual, misfit = linear_fit(position)
    converged = False
    for _ in range(FIT_ROUNDS):
        move = solved(design, residual)[:3] * steps_mm
        for _ in range(FIT_HALVINGS):
            trial = linear_fit(position + move)
            if trial[-1] <= misfit:
                break
            move = 0.5 * move
        converged = bool(np.all(np.abs(move) <= FIT_TOLERANCE * steps_mm))
        if trial[-1] > misfit:
            break
        position, (design, brightness, residual, misfit) = position + move, trial
        if converged:
            break
    variance = misfit / max(1, signal.size - design.shape[1])
    covariance = np.linalg.pinv(design.T @ design)[:3, :3] * variance * np.outer(steps_mm, steps_mm)
    return ShapeFit(position, covariance, brightness, converged)


def solved(design: Floats, values: Floats) -> Floats:
    """Return the coefficients of the design's columns that explain the values best."""
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)


class PixelRays(NamedTuple):
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


def pixel_rays(
    camera: Camera, column: NDArray[np.integer | np.floating], row: NDArray[np.integer | np.floating]
) -> PixelRays:
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


def scene_shares(
    rays: PixelRays, camera: Camera, media: Media, shape: PointShape, position_mm: Floats
) -> SharesAndSlopes:
    """Return the shares (n,) of what pixels see at depth z that a shape there covers, and its slopes.

    `position_mm` is (x, y, z) in image axes; the slopes (n, 3) are the share's derivatives by it, per mm.
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
    samples = 1 if width < SHARP_SHARE * shape.half_mm else BLURRED_SAMPLES
    shares, slopes = shape.covered(middle, lens_cell(camera.lattice) * cell_scale, shape.figure, width, samples)
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
    """Return the area shared by a disc about (0, 0) and the polygon `cell` moved by (x, y), with the polygon's sign.

    It is the sum over the triangles of the origin and an edge, a to b.
    """
    area = 0.0
    for k in range(cell.shape[0]):
        following = (k + 1) % cell.shape[0]
        ax, ay, bx, by = x + cell[k, 0], y + cell[k, 1], x + cell[following, 0], y + cell[following, 1]
        dx, dy = bx - ax, by - ay
        length2 = dx * dx + dy * dy
        along = ax * dx + ay * dy
        inside = along * along - length2 * (ax * ax + ay * ay - radius * radius)
        enter, leave = 1.0, 0.0
        if inside > 0.0:
            enter = (-along - np.sqrt(inside)) / length2
            leave = (-along + np.sqrt(inside)) / length2
        if enter >= 1.0 or leave <= 0.0:
            area += sector_area(ax, ay, bx, by, radius)
            continue
        enter, leave = max(enter, 0.0), min(leave, 1.0)
        px, py = ax + enter * dx, ay + enter * dy
        qx, qy = ax + leave * dx, ay + leave * dy
        area += sector_area(ax, ay, px, py, radius) + 0.5 * (px * qy - py * qx) + sector_area(qx, qy, bx, by, radius)
    return area


@njit(cache=True)
def sector_area(ax: float, ay: float, bx: float, by: float, radius: float) -> float:
    """Return the signed area of the disc's sector between the directions of a and b."""
    return 0.5 * radius * radius * np.arctan2(ax * by - ay * bx, ax * bx + ay * by)


# Pixels at the rim of a micro-image are lit in part, by light that does not come from where their middle sees, and
# rectification mixes neighbours; a pixel is used when the main lens's rim is more than half its patch's diagonal and a
# pixel away. Without that pixel depths are 0.2 % too large.
RIM_PER_PATCH = np.sqrt(0.5) + 1.0
# Fewer pixels than these are a point at the sensor's edge: five unknowns need several times as many.
FEWEST_PIXELS = 50


class NearPixels(NamedTuple):
    """Pixels (n,): their light, the share of it that they pass, and their rays."""

    signal: Floats
    passed: Floats
    rays: PixelRays


def pixels_near(
    picture: tuple[Floats, Singles],
    camera: Camera,
    media: Media,
    start_mm: Floats,
    reach_mm: float,
    most: int,
    off_px: Singles | None = None,
) -> NearPixels | None:
    """Return the pixels that see the plane of a point within `reach_mm` of it; None where the sensor holds too few.

    Parameters
    ----------
    picture : light and the share of it that pixels pass, (rows, columns) each
    start_mm : (3,) the point, image axes
    off_px : (rows, columns, 2) where pixels lie beside their places in the picture, column first; None: there
    """
    z = float(start_mm[2])
    signal, passed = picture
    distance = float(equivalent_object_distance(z, camera.focus_distance_mm, media))
    forward = camera.image_distance_mm / distance
    pitch = float(camera.lattice.pitch.max())
    blur = abs(float(camera.defocus(distance))) * camera.aperture_radius_mm
    half = (forward * reach_mm + blur + pitch) / camera.pixel_mm
    middle = camera.mm_to_px(-forward * start_mm[:2])
    low = np.maximum(np.floor(middle - half), 0).astype(np.int64)
    high = np.minimum(np.ceil(middle + half) + 1, [camera.columns, camera.rows]).astype(np.int64)
    row, column = (axis.ravel() for axis in np.mgrid[low[1] : high[1], low[0] : high[0]])
    beside = np.zeros(2) if off_px is None else off_px[row, column]
    rays = pixel_rays(camera, column + beside[..., 0], row + beside[..., 1])
    near = np.hypot(*(scene_points(rays, camera, media, z) - start_mm[:2]).T) <= reach_mm
    rim = RIM_PER_PATCH * camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
    through = np.hypot(*lens_crossings(rays, camera).T) <= camera.aperture_radius_mm - rim
    kept = np.nonzero(near & through & (passed[row, column] > 0.0))[0]
    if len(kept) < FEWEST_PIXELS:
        return None
    kept = kept[:: -(-len(kept) // most)]
    chosen = PixelRays(*(each[kept] for each in rays))
    return NearPixels(signal[row, column][kept], passed[row, column][kept].astype(np.float64), chosen)
