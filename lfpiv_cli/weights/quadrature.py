"""The weights of single voxels by quadrature, for any lattice and any refraction (Eq. 13 as an integral).

The aperture is tiled by small squares, those at the rim counted by their area inside, and the voxel's depth by
Gauss-Legendre nodes. From the middle of a tile a voxel's face is seen on the array as a rectangle, whose areas over the
lenses are exact; under each lens the light of tile and face spreads over a known width of the sensor and is shared out
among the pixels exactly too. What is left is of second order in the tile's side; halving it shows what it is worth.

Axes: everything here is in image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.arrays import Floats, Integers, Singles
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera, KernelCamera
from lfpiv_cli.optics.curved_space import CurvedSpace, aim
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.optics.tracing import ObjectSpace, slope_ratio, struck_pixel, trace_ray
from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.lens_cells import MOST_CORNERS, shared_rectangle
from lfpiv_cli.weights.scene import NO_FACES, Scene, Source, kernel_scene, on_array, on_sensor, rays_at_depth, rays_from

# Tiles across the aperture: with 32 a tile is seen as half a pixel of Table 2's camera and columns are off by 0.01 to
# 0.02 in L1 (0.04 at 11 mm from focus), with 64 by 0.003 to 0.005, with 256 by 0.0002 (0.0008).
TILES = 32
REFERENCE_TILES = 256
DEPTH_NODES = 3
REFERENCE_DEPTH_NODES = 8
# Memory for the pictures of the voxels that are worked on at once.
BLOCK_BYTES = 64 * 2**20
# What a pixel gets below this share of its voxel's light is left out, as rounding of the column's sum.
SMALLEST_SHARE = 1e-7


# Rays along the rim by which the lit part of the sensor is bounded.
RIM_RAYS = 24
# Pixels across that one tile can light under one lens: the spreads are those of a tile and of a micro-image.
MOST_PIXELS = 512
# An even spread narrower than this share of the other changes nothing.
NARROW = 1e-9


class Columns(NamedTuple):
    """Columns of the weight matrix in compressed form.

    Attributes
    ----------
    start : (voxels + 1,) int64
    pixel : int32, row * columns + column of the sensor, ascending within a voxel
    share : float32 share of the voxel's light
    """

    start: Integers
    pixel: NDArray[np.int32]
    share: Singles

    def dimmed(self, transmission: Singles) -> Columns:
        """Return the columns behind pixels that pass a share (rows, columns) of the light."""
        return Columns(self.start, self.pixel, self.share * transmission.ravel()[self.pixel])

    def image(self, voxel: int, shape: tuple[int, int]) -> Floats:
        """Return one column as an image (rows, columns)."""
        part = slice(self.start[voxel], self.start[voxel + 1])
        image = np.zeros(shape[0] * shape[1])
        image[self.pixel[part]] = self.share[part]
        return image.reshape(shape)


def integrate_columns(
    camera: Camera,
    source: Source,
    centres_mm: ArrayLike,
    voxel_mm: ArrayLike,
    tiles: int = TILES,
    depth_nodes: int = DEPTH_NODES,
) -> Columns:
    """Return the weights of voxels, each integrated on its own.

    Parameters
    ----------
    centres_mm : (n, 3) their centres, image axes
    voxel_mm : (3,) their sides, image axes
    tiles : across the aperture
    depth_nodes : along z

    Raises
    ------
    ConfigError : a voxel in front of the fluid, or no window where one is needed
    """
    centres = np.ascontiguousarray(centres_mm, dtype=np.float64).reshape(-1, 3)
    sides = np.asarray(voxel_mm, dtype=np.float64)
    scene = kernel_scene(camera, source, centres, sides, tiles, depth_nodes)
    boxes = np.empty((len(centres), 4), np.int64)
    share_out(_set_boxes, len(centres), scene, boxes)
    pixels, shares, counts = [], [], []
    first = 0
    while first < len(centres):
        # The run of voxels whose pictures fit into the memory.
        height, width = np.maximum.accumulate(boxes[first:, 2:] - boxes[first:, :2], axis=0).T
        bytes_needed = 8 * height * width * np.arange(1, height.size + 1)
        last = first + max(1, int(np.searchsorted(bytes_needed, BLOCK_BYTES)))
        pictures = np.zeros((last - first, *(boxes[first:last, 2:] - boxes[first:last, :2]).max(axis=0)))
        share_out(_fill, len(pictures), scene, boxes, first, pictures)
        voxel, row, column = np.nonzero(pictures > SMALLEST_SHARE)
        shares.append(pictures[voxel, row, column].astype(np.float32))
        pixels.append((row + boxes[first + voxel, 0]) * camera.columns + column + boxes[first + voxel, 1])
        counts.append(np.bincount(voxel, minlength=last - first))
        first = last
    start = np.concatenate([[0], np.cumsum(np.concatenate([*counts, []]))]).astype(np.int64)
    pixel, share = np.concatenate([*pixels, []]), np.concatenate([*shares, np.zeros(0, np.float32)])
    return Columns(start, pixel.astype(np.int32), share)


@njit(cache=True)
def _half_face(scene: Scene, point: Floats, plane: int, node: int) -> tuple[float, float]:
    """Return half the widths on the array of a voxel's face at the depth of `point`, seen from the lens's middle.

    Of a side outside the fluid the other half is taken; of both, what the focal plane would show.
    """
    half = np.empty(2)
    nominal = scene.camera.image_distance_mm / scene.camera.focus_distance_mm
    for axis in range(2):
        ends, sides = np.zeros(2), 0
        for side in range(2):
            shifted = point.copy()
            shifted[axis] += (side - 0.5) * scene.sides_mm[axis]
            rays = rays_from(scene, shifted, plane, node)
            if rays.shape[1] > 0:
                ends[side] = on_array(scene, shifted, rays, 0.0, 0.0)[axis]
                sides += side + 1
        if sides == 3:
            half[axis] = 0.5 * abs(ends[1] - ends[0])
        elif sides > 0:
            middle = on_array(scene, point, rays_from(scene, point, plane, node), 0.0, 0.0)[axis]
            half[axis] = abs(ends[sides - 1] - middle)
        else:
            half[axis] = 0.5 * scene.sides_mm[axis] * nominal
    return half[0], half[1]


@njit(cache=True, nogil=True)
def _set_boxes(part: tuple[int, int], scene: Scene, boxes: Integers) -> None:
    """Set what of the sensor voxels `part` can light: (n, 4) first row and column, and those behind.

    Found from the rays through the rim: light under a lens stays within the aperture's image about its centre. That of
    a voxel whose middle lies outside the fluid is empty.
    """
    camera = scene.camera
    radius, cell, pixel = camera.aperture_radius_mm, scene.cell_radius_mm, camera.pixel_mm
    tilt = camera.microlens_distance_mm / camera.image_distance_mm
    # One pixel more than the geometry asks for covers rays between those followed, and the distortion's bend.
    spread = abs(1.0 + tilt - camera.microlens_distance_mm / camera.microlens_focal_length_mm)
    beyond = tilt * radius + spread * cell + pixel
    for n in range(part[0], part[1]):
        centre, plane, box = scene.centres_mm[n], scene.plane[n], boxes[n]
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        point = centre.copy()
        if rays_from(scene, centre, plane, np.int64(0)).shape[1] == 0:
            box[:] = 0
            continue
        for k in range(scene.depth_share.size):
            rays = rays_at_depth(scene, centre, plane, k, point)
            half = _half_face(scene, point, plane, k)
            for m in range(RIM_RAYS):
                angle = 2.0 * np.pi * m / RIM_RAYS
                x, y = on_array(scene, point, rays, radius * np.cos(angle), radius * np.sin(angle))
                distorted = 1.0 + camera.distortion_per_mm2 * (x * x + y * y)
                low[0], high[0] = min(low[0], x * distorted - half[0]), max(high[0], x * distorted + half[0])
                low[1], high[1] = min(low[1], y * distorted - half[1]), max(high[1], y * distorted + half[1])
        for axis in range(2):
            size = camera.columns if axis == 0 else camera.rows
            first = int(np.floor(((low[axis] - cell) * (1.0 + tilt) - beyond) / pixel + 0.5 * size))
            last = int(np.floor(((high[axis] + cell) * (1.0 + tilt) + beyond) / pixel + 0.5 * size)) + 1
            box[1 - axis] = min(max(first, 0), size)
            box[3 - axis] = min(max(last, 0), size)


@njit(cache=True, nogil=True)
def _fill(part: tuple[int, int], scene: Scene, boxes: Integers, first: int, pictures: Floats) -> None:
    """Add up the light of the voxels from `first` on in pictures `part` of (voxels, rows, columns of their boxes)."""
    tiles, work = scene.tiles, np.empty((2, MOST_CORNERS, 2))
    lines = np.empty((2, MOST_PIXELS))
    for n in range(part[0], part[1]):
        voxel, box = first + n, boxes[first + n]
        plane, point = scene.plane[voxel], scene.centres_mm[voxel].copy()
        for k in range(0 if box[0] == box[2] or box[1] == box[3] else scene.depth_share.size):
            rays = rays_at_depth(scene, scene.centres_mm[voxel], plane, k, point)
            half = _half_face(scene, point, plane, k)
            for t in range(tiles.share.size):
                x, y = on_array(scene, point, rays, tiles.middle_mm[t, 0], tiles.middle_mm[t, 1])
                tile = (tiles.middle_mm[t, 0], tiles.middle_mm[t, 1], tiles.share[t] * scene.depth_share[k])
                _add_tile(scene, (x, y, half[0], half[1]), tile, box, work, lines, pictures[n])


@njit(cache=True)
def _add_tile(
    scene: Scene,
    face: tuple[float, float, float, float],
    tile: tuple[float, float, float],
    box: Integers,
    work: Floats,
    lines: Floats,
    picture: Floats,
) -> None:
    """Add the light that a voxel's face sends through one tile.

    Parameters
    ----------
    face : the middle and half the sides of the rectangle as which the face is seen on the array
    tile : its middle on the main lens, and the share of the voxel's light that passes it
    work, lines : scratch
    """
    camera, cell = scene.camera, scene.cell_radius_mm
    x, y, half_x, half_y = face
    origin, basis = camera.origin_mm, camera.basis_mm
    s_i, f_m, s_mu = camera.image_distance_mm, camera.microlens_focal_length_mm, camera.microlens_distance_mm
    distorted = 1.0 + camera.distortion_per_mm2 * (x * x + y * y)
    array_x, array_y = x * distorted, y * distorted
    low, high = (array_x - half_x, array_y - half_y), (array_x + half_x, array_y + half_y)
    spread = abs(1.0 + s_mu / s_i - s_mu / f_m) / camera.pixel_mm
    width = scene.tiles.side_mm * s_mu / s_i / camera.pixel_mm
    determinant = basis[0, 0] * basis[1, 1] - basis[0, 1] * basis[1, 0]
    dx, dy = array_x - origin[0], array_y - origin[1]
    i0 = np.rint((dx * basis[1, 1] - dy * basis[1, 0]) / determinant)
    j0 = np.rint((dy * basis[0, 0] - dx * basis[0, 1]) / determinant)
    reach_i = int(np.ceil((abs(half_x * basis[1, 1]) + abs(half_y * basis[1, 0])) / abs(determinant) + 0.5))
    reach_j = int(np.ceil((abs(half_y * basis[0, 0]) + abs(half_x * basis[0, 1])) / abs(determinant) + 0.5))
    for i in range(-reach_i, reach_i + 1):
        for j in range(-reach_j, reach_j + 1):
            centre_x = origin[0] + (i0 + i) * basis[0, 0] + (j0 + j) * basis[1, 0]
            centre_y = origin[1] + (i0 + i) * basis[0, 1] + (j0 + j) * basis[1, 1]
            if abs(array_x - centre_x) >= half_x + cell or abs(array_y - centre_y) >= half_y + cell:
                continue
            area, m_x, m_y, wide, tall = shared_rectangle(low, high, centre_x, centre_y, scene.neighbours_mm, work)
            if area <= 0.0:
                continue
            sensor_x = on_sensor(camera, x + m_x - array_x, tile[0], m_x, centre_x)
            sensor_y = on_sensor(camera, y + m_y - array_y, tile[1], m_y, centre_y)
            # In pixels from the sensor's corner.
            column = sensor_x / camera.pixel_mm + 0.5 * camera.columns
            row = sensor_y / camera.pixel_mm + 0.5 * camera.rows
            share = tile[2] * area / (4.0 * half_x * half_y)
            first_column, columns = _line(column, width, spread * wide, box[1], box[3], lines[0])
            first_row, rows = _line(row, width, spread * tall, box[0], box[2], lines[1])
            for r in range(rows):
                for c in range(columns):
                    picture[first_row + r - box[0], first_column + c - box[1]] += share * lines[1, r] * lines[0, c]


@njit(cache=True)
def _line(
    middle: float, first_width: float, second_width: float, low: int, high: int, shares: Floats
) -> tuple[int, int]:
    """Fill in the shares of pixels low to high of light spread about `middle`; return the first pixel and their number.

    The spread is the sum of two even ones, of the tile and of the lens's part of the face.
    """
    reach = 0.5 * (first_width + second_width)
    first = max(int(np.floor(middle - reach)), low)
    last = min(int(np.floor(middle + reach)), high - 1, first + shares.size - 1)
    below = _share_below(first - middle, first_width, second_width)
    for k in range(last - first + 1):
        upto = _share_below(first + k + 1 - middle, first_width, second_width)
        shares[k] = upto - below
        below = upto
    return first, max(last - first + 1, 0)


@njit(cache=True)
def _share_below(t: float, first_width: float, second_width: float) -> float:
    """Return the share below t of the sum of two even spreads about 0."""
    if second_width < NARROW * first_width:
        return min(max(t / first_width + 0.5, 0.0), 1.0)
    return (_ramp(t + 0.5 * second_width, first_width) - _ramp(t - 0.5 * second_width, first_width)) / second_width


@njit(cache=True)
def _ramp(t: float, width: float) -> float:
    """Return the integral up to t of the share below of one even spread."""
    if t <= -0.5 * width:
        return 0.0
    return t if t >= 0.5 * width else (t + 0.5 * width) ** 2 / (2.0 * width)


# The weights of one voxel by counting rays (Eq. 13), as the paper does.
#
# Random points of the voxel each send random rays through the aperture; the share of the rays that strike a pixel is
# its weight. Rays follow `optics.tracing` in every detail: any lattice, distortion and refraction. A count of n rays
# over k pixels is off by about sqrt(2 k / (pi n)) in L1; more rays of few points do not make up for the points.

# Points are counted in this many parts side by side, each into an image of its own.
PARTS = 8

# splitmix64 (Steele, Lea and Flood 2014): a counter's step and two mixing factors; every ray has numbers of its own,
# whoever computes it.
STEP = np.uint64(0x9E3779B97F4A7C15)
TWO_STEPS = np.uint64(0x3C6EF372FE94F82A)
MIX_A = np.uint64(0xBF58476D1CE4E5B9)
MIX_B = np.uint64(0x94D049BB133111EB)
TO_UNIT = 2.0**-53


@dataclass(frozen=True)
class RayCount:
    """How many rays are counted: from each of some random points of a voxel; by default the paper's numbers."""

    points: int = 500
    rays_per_point: int = 10_000

    @property
    def rays(self) -> int:
        """All rays of a voxel."""
        return self.points * self.rays_per_point


PAPERS_COUNT = RayCount()


def count_rays(
    camera: Camera,
    space: ObjectSpace | CurvedSpace,
    centre_mm: ArrayLike,
    voxel_mm: ArrayLike,
    rng: np.random.Generator,
    count: RayCount = PAPERS_COUNT,
) -> Floats:
    """Return the image (rows, columns) of the shares of a voxel's rays that strike each pixel.

    Parameters
    ----------
    centre_mm, voxel_mm : (3,) its centre and its sides, image axes; what of it lies outside the fluid sends no light

    Raises
    ------
    ConfigError : a voxel in front of the fluid, or no window where one is needed
    """
    centre, sides = np.asarray(centre_mm, dtype=np.float64), np.asarray(voxel_mm, dtype=np.float64)
    starts = centre + (rng.random((count.points, 3)) - 0.5) * sides
    seeds = rng.integers(0, 2**64, count.points, dtype=np.uint64)
    counts = np.zeros((PARTS, camera.rows * camera.columns), np.int64)
    rays = (starts, seeds, count.rays_per_point)
    faces, nodes, factors = NO_FACES, np.zeros((count.points, 1)), np.zeros((count.points, 1))
    if isinstance(space, CurvedSpace):
        faces = space.for_kernels(camera)
    else:
        reach = camera.aperture_radius_mm + float(np.hypot(*(np.abs(centre[:2]) + sides[:2])))
        nodes, factors = space.slope_polynomials(camera, starts[:, 2], reach)
    share_out(_count, PARTS, rays, faces, nodes, factors, camera.for_kernels(), counts)
    return counts.sum(axis=0).reshape(camera.rows, camera.columns) / count.rays


def count_columns(
    camera: Camera,
    space: ObjectSpace | CurvedSpace,
    centres_mm: Floats,
    voxel_mm: ArrayLike,
    rng: np.random.Generator,
    count: RayCount = PAPERS_COUNT,
    progress: Callable[[int], None] | None = None,
) -> Columns:
    """Return the counted columns of voxels at `centres_mm` (n, 3); the other arguments are those of `count_rays`."""
    start, pixels, shares = [0], [], []
    for centre in centres_mm:
        image = count_rays(camera, space, centre, voxel_mm, rng, count).ravel()
        lit = np.flatnonzero(image)
        pixels.append(lit.astype(np.int32))
        shares.append(image[lit].astype(np.float32))
        start.append(start[-1] + lit.size)
        if progress:
            progress(1)
    return Columns(np.array(start, np.int64), np.concatenate(pixels), np.concatenate(shares))


def sampling_error(weights: NDArray[np.floating], rays: int) -> float:
    """Return the L1 error to expect of a count of independent rays: the sum of sqrt(2 w (1 - w) / (pi n))."""
    w = np.asarray(weights, dtype=np.float64)
    return float(np.sum(np.sqrt(2.0 * w * (1.0 - w) / (np.pi * rays))))


@njit(cache=True)
def unit_random(state: np.uint64) -> float:
    """Return the number in [0, 1) that belongs to a counter."""
    z = state
    z = (z ^ (z >> np.uint64(30))) * MIX_A
    z = (z ^ (z >> np.uint64(27))) * MIX_B
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * TO_UNIT


@njit(cache=True, nogil=True)
def _count(
    parts: tuple[int, int],
    rays: tuple[Floats, NDArray[np.uint64], int],
    faces: Faces,
    nodes: Floats,
    factors: Floats,
    camera: KernelCamera,
    counts: Integers,
) -> None:
    """Add up the rays that strike each pixel, `parts` of (parts, rows * columns).

    `rays` holds the points that they start from, a seed for each, and how many each sends.
    """
    starts, seeds, rays_each = rays
    radius = camera.aperture_radius_mm
    for part in range(parts[0], parts[1]):
        for n in range(part, starts.shape[0], PARTS):
            x, y, z, state = starts[n, 0], starts[n, 1], starts[n, 2], seeds[n]
            for _ in range(rays_each):
                # A point of the main lens that belongs to the counter.
                r, angle = radius * np.sqrt(unit_random(state + STEP)), 2.0 * np.pi * unit_random(state + TWO_STEPS)
                lens_x, lens_y = r * np.cos(angle), r * np.sin(angle)
                state += TWO_STEPS
                if faces.ratios.size > 0:
                    slope_x, slope_y, seen = aim(faces, x, y, z, lens_x, lens_y)
                else:
                    dx, dy = lens_x - x, lens_y - y
                    ratio = slope_ratio(dx * dx + dy * dy, nodes[n], factors[n])
                    slope_x, slope_y, seen = ratio * dx, ratio * dy, True
                if seen:
                    sensor_x, sensor_y = trace_ray(camera, lens_x, lens_y, slope_x, slope_y)
                    pixel = struck_pixel(camera, sensor_x, sensor_y)
                    if pixel >= 0:
                        counts[part, pixel] += 1
