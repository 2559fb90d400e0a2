"""The weights of single voxels by quadrature, for any lattice and any refraction (Eq. 13 as an integral).

The aperture is tiled by small squares, those at the rim counted by their area inside, and the voxel's depth by
Gauss-Legendre nodes. From the middle of a tile a voxel's face is seen on the array as a rectangle, whose areas over the
lenses are exact; under each lens the light of tile and face spreads over a known width of the sensor and is shared out
among the pixels exactly too. What is left is of second order in the tile's side; halving it shows what it is worth.

Axes: everything here is in image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.object_space import SLOPE_NODES, ObjectSpace, slope_ratio
from lfpiv_cli.weights.aperture import disc_area_below
from lfpiv_cli.weights.lens_cells import MOST_CORNERS, cell_radius, neighbours, shared_rectangle

# Tiles across the aperture: with 32 a tile is seen as half a pixel of Table 2's camera and columns are off by 0.01 to
# 0.02 in L1 (0.04 at 11 mm from focus), with 64 by 0.003 to 0.005, with 256 by 0.0002 (0.0008).
TILES = 32
REFERENCE_TILES = 256
DEPTH_NODES = 3
REFERENCE_DEPTH_NODES = 8
# Points per side by which the part of a tile inside the rim is averaged to find its middle.
RIM_SAMPLES = 16
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


@dataclass(frozen=True, eq=False)
class PolynomialRays:
    """Where rays meet the array, as polynomials of where they come from and cross the main lens.

    Attributes
    ----------
    scale : (5,) what x, y, z, X, Y (mm) are divided by
    exponents : (terms, 5) int64
    coefficients_mm : (terms, 2) of both coordinates on the array
    """

    scale: NDArray[np.float64]
    exponents: NDArray[np.int64]
    coefficients_mm: NDArray[np.float64]


# Where rays meet the array: traced through the object space, or as fitted.
Source = ObjectSpace | PolynomialRays


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of the weight matrix in compressed form.

    Attributes
    ----------
    start : (voxels + 1,) int64
    pixel : int32, row * columns + column of the sensor, ascending within a voxel
    share : float32 share of the voxel's light
    """

    start: NDArray[np.int64]
    pixel: NDArray[np.int32]
    share: NDArray[np.float32]

    def dimmed(self, transmission: NDArray[np.float32]) -> Columns:
        """Return the columns behind pixels that pass a share (rows, columns) of the light."""
        return Columns(self.start, self.pixel, self.share * transmission.ravel()[self.pixel])

    def image(self, voxel: int, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return one column as an image (rows, columns)."""
        part = slice(self.start[voxel], self.start[voxel + 1])
        image = np.zeros(shape[0] * shape[1])
        image[self.pixel[part]] = self.share[part]
        return image.reshape(shape)


@dataclass(frozen=True, eq=False)
class Tiles:
    """Squares on the main lens: middles (n, 2) of their parts inside the aperture, shares (n,) of it, their side."""

    middle_mm: NDArray[np.float64]
    share: NDArray[np.float64]
    side_mm: float


def aperture_tiles(radius_mm: float, per_side: int) -> Tiles:
    """Cut the round aperture into squares."""
    side = 2.0 * radius_mm / per_side
    edges = side * np.arange(per_side + 1) - radius_mm
    below = np.array([[disc_area_below(x, y, radius_mm) for x in edges] for y in edges])
    area = np.diff(np.diff(below, axis=0), axis=1)
    row, column = np.nonzero(area > 1e-9 * side**2)  # what is left of corners that only touch the rim
    middle = np.stack([edges[column], edges[row]], axis=1) + 0.5 * side
    cut = np.hypot(*np.abs(middle).T + 0.5 * side) > radius_mm
    fine = side * ((np.arange(RIM_SAMPLES) + 0.5) / RIM_SAMPLES - 0.5)
    points = middle[cut, np.newaxis] + np.stack(np.meshgrid(fine, fine), axis=-1).reshape(-1, 2)
    inside = np.hypot(points[..., 0], points[..., 1]) <= radius_mm
    count = inside.sum(axis=1)
    means = np.sum(points * inside[..., np.newaxis], axis=1) / np.maximum(count, 1)[:, np.newaxis]
    middle[cut] = np.where(count[:, np.newaxis] > 0, means, middle[cut])
    return Tiles(middle, area[row, column] / (np.pi * radius_mm**2), side)


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
    boxes = _boxes(*scene)
    pixels, shares, counts = [], [], []
    first = 0
    while first < len(centres):
        last = _block_end(boxes, first)
        pictures = np.zeros((last - first, *(boxes[first:last, 2:] - boxes[first:last, :2]).max(axis=0)))
        _fill(*scene, boxes, first, pictures)
        voxel, row, column = np.nonzero(pictures > SMALLEST_SHARE)
        shares.append(pictures[voxel, row, column].astype(np.float32))
        pixels.append((row + boxes[first + voxel, 0]) * camera.columns + column + boxes[first + voxel, 1])
        counts.append(np.bincount(voxel, minlength=last - first))
        first = last
    start = np.concatenate([[0], np.cumsum(np.concatenate([*counts, []]))]).astype(np.int64)
    return Columns(
        start,
        np.concatenate([*pixels, []]).astype(np.int32),
        np.concatenate([*shares, np.zeros(0, np.float32)]),
    )


def _block_end(boxes: NDArray[np.int64], first: int) -> int:
    """Return the end of the run of voxels from `first` whose pictures fit into `BLOCK_BYTES`."""
    height, width = np.maximum.accumulate(boxes[first:, 2:] - boxes[first:, :2], axis=0).T
    bytes_needed = 8 * height * width * np.arange(1, height.size + 1)
    return first + max(1, int(np.searchsorted(bytes_needed, BLOCK_BYTES)))


def kernel_scene(
    camera: Camera,
    source: Source,
    centres: NDArray[np.float64],
    sides: NDArray[np.float64],
    tiles_per_side: int,
    depth_nodes: int,
) -> tuple:
    """Return what the kernels take."""
    tiles = aperture_tiles(camera.aperture_radius_mm, tiles_per_side)
    depth, plane = np.unique(centres[:, 2], return_inverse=True)
    place, weight = np.polynomial.legendre.leggauss(depth_nodes)
    z = depth[:, np.newaxis] + 0.5 * sides[2] * place
    traced = isinstance(source, ObjectSpace)
    if isinstance(source, ObjectSpace):
        reach = camera.aperture_radius_mm + float(np.hypot(*(np.abs(centres[:, :2]) + sides[:2]).max(axis=0)))
        nodes, factors = source.slope_polynomials(camera, z.ravel(), reach)
        scale, exponents, coefficients = np.ones(5), np.zeros((0, 5), np.int64), np.zeros((0, 2))
    else:
        nodes, factors = np.zeros((2, z.size, SLOPE_NODES))
        scale, exponents, coefficients = source.scale, source.exponents, source.coefficients_mm
    lattice = camera.lattice
    optics = np.array(
        [
            camera.focal_length_mm,
            camera.image_distance_mm,
            camera.microlens_focal_length_mm,
            camera.microlens_distance_mm,
            camera.distortion_per_mm2 if traced else 0.0,
            camera.pixel_mm,
            camera.aperture_radius_mm,
            cell_radius(lattice),
        ]
    )
    return (
        centres,
        sides,
        plane.astype(np.int64),
        z,
        weight / 2.0,
        (nodes.reshape(*z.shape, -1), factors.reshape(*z.shape, -1)),
        (scale, exponents, coefficients),
        (tiles.middle_mm, tiles.share, tiles.side_mm),
        optics,
        (lattice.origin, lattice.basis, neighbours(lattice)),
        (camera.rows, camera.columns),
    )


@njit(cache=True)
def on_array(
    point: NDArray[np.float64],
    lens_x: float,
    lens_y: float,
    nodes: NDArray[np.float64],
    factors: NDArray[np.float64],
    fitted: tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]],
    optics: NDArray[np.float64],
) -> tuple[float, float]:
    """Return where the ray from a point (x, y, z) through (lens_x, lens_y) meets the array, without the distortion."""
    scale, exponents, coefficients = fitted
    if exponents.shape[0] == 0:
        dx, dy = lens_x - point[0], lens_y - point[1]
        ratio = slope_ratio(dx * dx + dy * dy, nodes, factors)
        bent_x, bent_y = ratio * dx - lens_x / optics[0], ratio * dy - lens_y / optics[0]
        return lens_x + optics[1] * bent_x, lens_y + optics[1] * bent_y
    x, y = 0.0, 0.0
    for k in range(exponents.shape[0]):
        term = (lens_x / scale[3]) ** exponents[k, 3] * (lens_y / scale[4]) ** exponents[k, 4]
        for m in range(3):
            term *= (point[m] / scale[m]) ** exponents[k, m]
        x += coefficients[k, 0] * term
        y += coefficients[k, 1] * term
    return x, y


@njit(cache=True)
def _half_face(
    point: NDArray[np.float64],
    sides: NDArray[np.float64],
    nodes: NDArray[np.float64],
    factors: NDArray[np.float64],
    fitted: tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]],
    optics: NDArray[np.float64],
) -> tuple[float, float]:
    """Return half the widths on the array of a voxel's face at the depth of `point`, seen from the lens's middle."""
    ends = np.empty(4)
    for k in range(2):
        shifted = point.copy()
        shifted[0] += (k - 0.5) * sides[0]
        ends[k] = on_array(shifted, 0.0, 0.0, nodes, factors, fitted, optics)[0]
        shifted = point.copy()
        shifted[1] += (k - 0.5) * sides[1]
        ends[2 + k] = on_array(shifted, 0.0, 0.0, nodes, factors, fitted, optics)[1]
    return 0.5 * abs(ends[1] - ends[0]), 0.5 * abs(ends[3] - ends[2])


@njit(cache=True, parallel=True)
def _boxes(
    centres: NDArray[np.float64],
    sides: NDArray[np.float64],
    plane: NDArray[np.int64],
    depth: NDArray[np.float64],
    depth_share: NDArray[np.float64],
    slopes: tuple[NDArray[np.float64], NDArray[np.float64]],
    fitted: tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]],
    tiles: tuple[NDArray[np.float64], NDArray[np.float64], float],
    optics: NDArray[np.float64],
    lattice: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    shape: tuple[int, int],
) -> NDArray[np.int64]:
    """Return the part of the sensor that each voxel can light: (n, 4) first row and column, and those after the last.

    Found from the rays through the rim: light under a lens stays within the aperture's image about its centre.
    """
    s_i, f_m, s_mu, stretch, pixel, radius, cell = (
        optics[1],
        optics[2],
        optics[3],
        optics[4],
        optics[5],
        optics[6],
        optics[7],
    )
    boxes = np.empty((centres.shape[0], 4), np.int64)
    tilt = s_mu / s_i
    for n in prange(centres.shape[0]):
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for k in range(depth.shape[1]):
            point = centres[n].copy()
            point[2] = depth[plane[n], k]
            nodes, factors = slopes[0][plane[n], k], slopes[1][plane[n], k]
            half = _half_face(point, sides, nodes, factors, fitted, optics)
            for m in range(RIM_RAYS):
                angle = 2.0 * np.pi * m / RIM_RAYS
                x, y = on_array(point, radius * np.cos(angle), radius * np.sin(angle), nodes, factors, fitted, optics)
                distorted = 1.0 + stretch * (x * x + y * y)
                low[0], high[0] = min(low[0], x * distorted - half[0]), max(high[0], x * distorted + half[0])
                low[1], high[1] = min(low[1], y * distorted - half[1]), max(high[1], y * distorted + half[1])
        # One pixel more than the geometry asks for covers rays between those followed, and the distortion's bend.
        beyond = tilt * radius + abs(1.0 + tilt - s_mu / f_m) * cell + pixel
        for axis in range(2):
            size = shape[1 - axis]
            first = int(np.floor(((low[axis] - cell) * (1.0 + tilt) - beyond) / pixel + 0.5 * size))
            last = int(np.floor(((high[axis] + cell) * (1.0 + tilt) + beyond) / pixel + 0.5 * size)) + 1
            boxes[n, 1 - axis] = min(max(first, 0), size)
            boxes[n, 3 - axis] = min(max(last, 0), size)
    return boxes


@njit(cache=True, parallel=True)
def _fill(
    centres: NDArray[np.float64],
    sides: NDArray[np.float64],
    plane: NDArray[np.int64],
    depth: NDArray[np.float64],
    depth_share: NDArray[np.float64],
    slopes: tuple[NDArray[np.float64], NDArray[np.float64]],
    fitted: tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]],
    tiles: tuple[NDArray[np.float64], NDArray[np.float64], float],
    optics: NDArray[np.float64],
    lattice: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    shape: tuple[int, int],
    boxes: NDArray[np.int64],
    first: int,
    pictures: NDArray[np.float64],
) -> None:
    """Add up the light of the voxels from `first` on in `pictures` (voxels, rows, columns of their boxes)."""
    middles, shares, side = tiles
    for n in prange(pictures.shape[0]):
        voxel = first + n
        work = np.empty((2, MOST_CORNERS, 2))
        lines = np.empty((2, MOST_PIXELS))
        for k in range(depth.shape[1]):
            point = centres[voxel].copy()
            point[2] = depth[plane[voxel], k]
            nodes, factors = slopes[0][plane[voxel], k], slopes[1][plane[voxel], k]
            half = _half_face(point, sides, nodes, factors, fitted, optics)
            for t in range(shares.size):
                x, y = on_array(point, middles[t, 0], middles[t, 1], nodes, factors, fitted, optics)
                light = shares[t] * depth_share[k]
                _add_tile(
                    x, y, half, middles[t], side, light, optics, lattice, shape, boxes[voxel], work, lines, pictures[n]
                )


@njit(cache=True)
def _add_tile(
    x: float,
    y: float,
    half: tuple[float, float],
    middle: NDArray[np.float64],
    side: float,
    light: float,
    optics: NDArray[np.float64],
    lattice: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    shape: tuple[int, int],
    box: NDArray[np.int64],
    work: NDArray[np.float64],
    lines: NDArray[np.float64],
    picture: NDArray[np.float64],
) -> None:
    """Add the light that a voxel's face sends through one tile, seen as a rectangle about (x, y) on the array."""
    origin, basis, steps = lattice
    s_i, f_m, s_mu, pixel, cell = optics[1], optics[2], optics[3], optics[5], optics[7]
    distorted = 1.0 + optics[4] * (x * x + y * y)
    array_x, array_y = x * distorted, y * distorted
    low, high = (array_x - half[0], array_y - half[1]), (array_x + half[0], array_y + half[1])
    spread = abs(1.0 + s_mu / s_i - s_mu / f_m) / pixel
    width = side * s_mu / s_i / pixel
    determinant = basis[0, 0] * basis[1, 1] - basis[0, 1] * basis[1, 0]
    dx, dy = array_x - origin[0], array_y - origin[1]
    i0 = np.rint((dx * basis[1, 1] - dy * basis[1, 0]) / determinant)
    j0 = np.rint((dy * basis[0, 0] - dx * basis[0, 1]) / determinant)
    reach_i = int(np.ceil((abs(half[0] * basis[1, 1]) + abs(half[1] * basis[1, 0])) / abs(determinant) + 0.5))
    reach_j = int(np.ceil((abs(half[1] * basis[0, 0]) + abs(half[0] * basis[0, 1])) / abs(determinant) + 0.5))
    for i in range(-reach_i, reach_i + 1):
        for j in range(-reach_j, reach_j + 1):
            centre_x = origin[0] + (i0 + i) * basis[0, 0] + (j0 + j) * basis[1, 0]
            centre_y = origin[1] + (i0 + i) * basis[0, 1] + (j0 + j) * basis[1, 1]
            if abs(array_x - centre_x) >= half[0] + cell or abs(array_y - centre_y) >= half[1] + cell:
                continue
            area, m_x, m_y, wide, tall = shared_rectangle(low, high, centre_x, centre_y, steps, work)
            if area <= 0.0:
                continue
            # Eq. 1 from the place on the array to the sensor, in pixels from its corner.
            behind_x = (x + m_x - array_x - middle[0]) / s_i - (m_x - centre_x) / f_m
            behind_y = (y + m_y - array_y - middle[1]) / s_i - (m_y - centre_y) / f_m
            column = (m_x + s_mu * behind_x) / pixel + 0.5 * shape[1]
            row = (m_y + s_mu * behind_y) / pixel + 0.5 * shape[0]
            share = light * area / (4.0 * half[0] * half[1])
            first_column, columns = _line(column, width, spread * wide, box[1], box[3], lines[0])
            first_row, rows = _line(row, width, spread * tall, box[0], box[2], lines[1])
            for r in range(rows):
                for c in range(columns):
                    picture[first_row + r - box[0], first_column + c - box[1]] += share * lines[1, r] * lines[0, c]


@njit(cache=True)
def _line(
    middle: float, first_width: float, second_width: float, low: int, high: int, shares: NDArray[np.float64]
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
