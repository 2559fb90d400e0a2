"""What falls on one microlens, for any lattice: areas shared by a rectangle and the region nearest to a lens.

Axes: image axes on the array, mm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Integers, Singles
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera, KernelCamera, Lattice
from lfpiv_cli.threads import share_out

# The cells of one axis: where its lenses and its pixels meet.
#
# A pixel at the border of two micro-images sees the main lens through both, at opposite ends of the aperture. So
# weights are kept by *cell*, the meeting of one lens and one pixel.
#
# Axes: one image axis at a time (columns or rows), in mm about the optical axis.

# Width given to a patch that lies outside the aperture, in radii: small beside the patch of a whole pixel (a tenth).
SMALLEST_PATCH = 1e-3


class AxisOptics(NamedTuple):
    """One axis of the camera; its square aperture is as wide as the round one.

    Attributes
    ----------
    camera : what both axes share
    lens_origin_mm, lens_pitch_mm : a lens centre on the array and the pitch along this axis
    lens_width_mm : what of the pitch a lens takes in, half of it to either side
    pixels : of the sensor along this axis
    """

    camera: KernelCamera
    lens_origin_mm: float
    lens_pitch_mm: float
    lens_width_mm: float
    pixels: int


# Along the columns, and along the rows.
Optics = tuple[AxisOptics, AxisOptics]


# A lattice counts as aligned with the sensor when over its whole width it strays by less than a hundredth of a pixel.
ALIGNED_PX = 0.01


def aligned(camera: Camera) -> bool:
    """Return whether the array is square and stands upright on the sensor."""
    basis = camera.lattice.basis
    stray_px = np.abs([basis[1, 0], basis[0, 1]]) / camera.lattice.pitch[::-1] * [camera.rows, camera.columns]
    return camera.lattice.layout == "square" and bool(stray_px.max() <= ALIGNED_PX)


def axis_optics(camera: Camera, widths_mm: tuple[float, float] | None = None) -> Optics:
    """Return the camera's two axes, (columns, rows); the widths of the lenses are their pitches if not given."""
    basis = camera.lattice.basis
    pixels = np.array([camera.columns, camera.rows])
    if not aligned(camera):
        raise ConfigError(
            f"camera.microlenses: a {camera.lattice.layout} array turned by "
            f"{np.degrees(camera.lattice.rotation_rad):z.4f} degrees against the sensor does not separate into columns "
            "and rows; a square one aligned with it is needed (a calibration aligns it)"
        )
    widths = widths_mm or (float(basis[0, 0]), float(basis[1, 1]))
    first, second = (
        AxisOptics(
            camera=camera.for_kernels(),
            lens_origin_mm=float(camera.lattice.origin[axis]),
            lens_pitch_mm=float(basis[axis, axis]),
            lens_width_mm=widths[axis],
            pixels=int(pixels[axis]),
        )
        for axis in (0, 1)
    )
    return first, second


class Cells(NamedTuple):
    """The cells of one axis, lens by lens and pixel by pixel.

    Attributes
    ----------
    first_lens : number n of the first lens, centred at lens_origin + n lens_pitch
    start : (lenses + 1,) int64, the first cell of each lens
    pixel : (cells,) int32, the pixel of each cell, ascending within a lens
    patch_mm : (cells, 2) the interval of the main lens that the cell sees through its lens's centre, inside the
    aperture
    """

    first_lens: int
    start: Integers
    pixel: NDArray[np.int32]
    patch_mm: Floats


def micro_image_cells(optics: AxisOptics) -> Cells:
    """Return the cells of all lenses whose micro-image meets the sensor."""
    camera = optics.camera
    tilt = camera.microlens_distance_mm / camera.image_distance_mm
    reach = tilt * camera.aperture_radius_mm + (tilt + abs(camera.bend)) * 0.5 * optics.lens_width_mm
    half = 0.5 * optics.pixels * camera.pixel_mm
    edge = np.array([-half - reach, half + reach]) / (1.0 + tilt)
    first, last = np.rint((edge - optics.lens_origin_mm) / optics.lens_pitch_mm).astype(int)
    number = np.arange(first, last + 1)
    lens = optics.lens_origin_mm + number * optics.lens_pitch_mm
    low = np.floor((lens * (1.0 + tilt) - reach + half) / camera.pixel_mm).astype(int).clip(0, optics.pixels)
    high = np.floor((lens * (1.0 + tilt) + reach + half) / camera.pixel_mm).astype(int).clip(-1, optics.pixels - 1)
    counts = np.maximum(high - low + 1, 0)
    start = np.concatenate([[0], np.cumsum(counts)])
    owner = np.repeat(np.arange(lens.size), counts)
    pixel = low[owner] + np.arange(start[-1]) - start[owner]
    magnify, radius = camera.image_distance_mm / camera.microlens_distance_mm, camera.aperture_radius_mm
    centre = lens[owner]
    edges = (pixel[:, np.newaxis] + np.array([1, 0]) - 0.5 * optics.pixels) * camera.pixel_mm
    patch = np.clip(centre[:, np.newaxis] - (edges - centre[:, np.newaxis]) * magnify, -radius, radius)
    # A cell that only rays away from the lens's centre reach sees the very edge of the aperture.
    sliver = SMALLEST_PATCH * radius
    patch = np.stack([np.minimum(patch[:, 0], radius - sliver), np.maximum(patch[:, 1], sliver - radius)], axis=1)
    return Cells(int(first), start.astype(np.int64), pixel.astype(np.int32), patch)


# Convex polygons as corners in order (n, 2), in kernels: cut by half planes, and their areas.


@njit(cache=True)
def cut(polygon: Floats, a: float, b: float, limit: float, out: Floats) -> int:
    """Write the part of a polygon where a x + b y <= limit to `out`; return its number of corners."""
    kept, corners = 0, len(polygon)
    for k in range(corners):
        x0, y0 = polygon[k, 0], polygon[k, 1]
        after = k + 1 if k + 1 < corners else 0
        x1, y1 = polygon[after, 0], polygon[after, 1]
        over0 = a * x0 + b * y0 - limit
        over1 = a * x1 + b * y1 - limit
        if over0 <= 0.0:
            out[kept, 0] = x0
            out[kept, 1] = y0
            kept += 1
        if (over0 < 0.0 < over1) or (over1 < 0.0 < over0):
            t = over0 / (over0 - over1)
            out[kept, 0] = x0 + t * (x1 - x0)
            out[kept, 1] = y0 + t * (y1 - y0)
            kept += 1
    return kept


@njit(cache=True)
def set_rectangle(out: Floats, left: float, right: float, bottom: float, top: float) -> None:
    """Write the four corners of a rectangle to `out`."""
    for k, (x, y) in enumerate(((left, bottom), (right, bottom), (right, top), (left, top))):
        out[k, 0] = x
        out[k, 1] = y


@njit(cache=True)
def polygon_area(polygon: Floats) -> float:
    """Return the area of a polygon."""
    twice = 0.0
    for k in range(1, len(polygon) - 1):
        ax, ay = polygon[k, 0] - polygon[0, 0], polygon[k, 1] - polygon[0, 1]
        bx, by = polygon[k + 1, 0] - polygon[0, 0], polygon[k + 1, 1] - polygon[0, 1]
        twice += ax * by - ay * bx
    return 0.5 * abs(twice)


# A rectangle cut by eight half planes has at most twelve corners.
MOST_CORNERS = 16


def neighbours(lattice: Lattice) -> Floats:
    """Return the steps (8, 2) to the surrounding lattice points; half-way to them ends a lens's region."""
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    return np.array(steps, dtype=np.float64) @ lattice.basis


@njit(cache=True)
def shared_rectangle(
    low: tuple[float, float], high: tuple[float, float], centre_x: float, centre_y: float, steps: Floats, work: Floats
) -> tuple[float, float, float, float, float]:
    """Return the area that a rectangle shares with the region of a lens, its centroid (x, y) and its widths (x, y).

    Parameters
    ----------
    low, high : (2,) corners of the rectangle
    centre_x, centre_y : the lens
    steps : from `neighbours`
    work : (2, MOST_CORNERS, 2) scratch
    """
    now, after = work[0], work[1]
    left, right = low[0] - centre_x, high[0] - centre_x
    bottom, top = low[1] - centre_y, high[1] - centre_y
    set_rectangle(now, left, right, bottom, top)
    corners = 4
    for k in range(steps.shape[0]):
        a, b = steps[k, 0], steps[k, 1]
        limit = 0.5 * (a * a + b * b)
        if max(a * left, a * right) + max(b * bottom, b * top) <= limit:
            continue
        if min(a * left, a * right) + min(b * bottom, b * top) >= limit:
            return 0.0, 0.0, 0.0, 0.0, 0.0
        corners = cut(now[:corners], a, b, limit, after)
        now, after = after, now
        if corners < 3:
            return 0.0, 0.0, 0.0, 0.0, 0.0
    twice, sum_x, sum_y = 0.0, 0.0, 0.0
    x0, y0 = now[0, 0], now[0, 1]
    left, right, bottom, top = x0, x0, y0, y0
    for k in range(1, corners):
        x1, y1 = now[k, 0], now[k, 1]
        left, right, bottom, top = min(left, x1), max(right, x1), min(bottom, y1), max(top, y1)
        if k + 1 < corners:
            x2, y2 = now[k + 1, 0], now[k + 1, 1]
            area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
            twice += area
            sum_x += area * (x0 + x1 + x2) / 3.0
            sum_y += area * (y0 + y1 + y2) / 3.0
    if twice <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return 0.5 * twice, sum_x / twice + centre_x, sum_y / twice + centre_y, right - left, top - bottom


# The round aperture seen through the pixels.
#
# Every cell (a pixel under a microlens) sees its own patch of the main lens, pixel * s_i/s_mu wide. Where a patch
# straddles the rim of the aperture, the cell gets only the share of it that lies inside; divided by the disc's share
# of its square (pi/4), these shares turn the weights of the square aperture into those of the disc.
#
# Axes: patches are intervals of X (columns) and Y (rows) on the main lens, in mm about the axis.

DISC_SHARE_OF_SQUARE = np.pi / 4.0


def aperture_mask(columns: Cells, rows: Cells, radius_mm: float) -> Singles:
    """Return C (row cells, column cells): the share of each cell's patch inside the disc, over the square's share."""
    mask = np.empty((len(rows.patch_mm), len(columns.patch_mm)), np.float32)
    share_out(_write_mask, len(mask), columns.patch_mm, rows.patch_mm, radius_mm, mask)
    return mask


@njit(cache=True)
def _chord_integral(a: float, b: float, radius: float) -> float:
    """Return the integral of sqrt(R^2 - x^2) from a to b, both clipped to the disc."""
    a = min(max(a, -radius), radius)
    b = min(max(b, -radius), radius)
    upper = b * np.sqrt(radius * radius - b * b) + radius * radius * np.arcsin(b / radius)
    lower = a * np.sqrt(radius * radius - a * a) + radius * radius * np.arcsin(a / radius)
    return 0.5 * (upper - lower)


@njit(cache=True)
def disc_area_below(x: float, y: float, radius: float) -> float:
    """Return the area of the part of a disc about 0 that lies at X <= x and Y <= y."""
    if x <= -radius or y <= -radius:
        return 0.0
    x = min(x, radius)
    if y >= radius:
        return 2.0 * _chord_integral(-radius, x, radius)
    flat = np.sqrt(radius * radius - y * y)
    inner = min(x, flat)
    area = 0.0
    if inner > -flat:
        area += _chord_integral(-flat, inner, radius) + y * (inner + flat)
    if y > 0.0:
        area += 2.0 * _chord_integral(-radius, min(x, -flat), radius)
        if x > flat:
            area += 2.0 * _chord_integral(flat, x, radius)
    return area


@njit(cache=True, nogil=True)
def _write_mask(part: tuple[int, int], columns: Floats, rows: Floats, radius: float, mask: Singles) -> None:
    """Write rows `part` of `aperture_mask`, from the patches (n, 2) of columns and rows."""
    for r in range(part[0], part[1]):
        y0, y1 = rows[r]
        for c in range(columns.shape[0]):
            x0, x1 = columns[c]
            area = (x1 - x0) * (y1 - y0)
            if max(x1, -x0) ** 2 + max(y1, -y0) ** 2 <= radius * radius:
                inside = area
            else:
                inside = (
                    disc_area_below(x1, y1, radius)
                    - disc_area_below(x0, y1, radius)
                    - disc_area_below(x1, y0, radius)
                    + disc_area_below(x0, y0, radius)
                )
            mask[r, c] = max(inside, 0.0) / area / DISC_SHARE_OF_SQUARE
