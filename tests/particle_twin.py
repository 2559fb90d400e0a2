"""The readable twin of `particles.rows`: the light of one particle on the raw image, entry by entry and pixel by pixel.

Seen from a pixel's patch of the main lens, the share P(X) of the ball whose light falls into the lens's cell is, along
each axis of a square cell, a difference of two of the ball's marginal distributions (cubics); mean and slope of P over
the patch come from a three-point Gauss rule on each of its parts, and the two axes are joined by the patch's covered
share and its first moments (`covered_share`). Where the array is turned each row of pixels has a profile of its own
along x, moved by how far up in the cell it sees the ball, and each column one along y.

Axes: image axes, mm; see `particles.view`. An *entry* is the meeting of a pixel with one lens; a pixel between two
micro-images can have two.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, COUNT_REFERENCES
from lfpiv_cli.particles import response
from lfpiv_cli.particles.cells import covered_share
from lfpiv_cli.particles.micro_images import GAUSS_AT, GAUSS_WEIGHT, LONGEST, SMALLEST_SHARE, parts_of
from lfpiv_cli.particles.refraction import Bend, Rays, bend_of, displaced, is_seen, room_for_rays
from lfpiv_cli.particles.response import Along, Bent, Projection, bent_at, join_cell, lenses_of, lit_pixels, mean_width
from lfpiv_cli.particles.view import View, entry_capacity

# Rows of a profile: mean and slope of P, their derivatives by x and by z, the patch's middle, and how far from the
# ball's middle the part of it is that is seen, times P.
MEAN, SLOPE, MEAN_X, SLOPE_X, MEAN_Z, SLOPE_Z, PATCH, AWAY = range(8)
PROFILE_ROWS = 8
# Columns of the entries' values: light, and its derivatives by x, y and z.
VALUES = 4


class Lens(NamedTuple):
    """What one lens shows.

    Attributes
    ----------
    column, columns, row, rows : the first pixels along both axes, and their numbers
    across, down : (LONGEST, PROFILE_ROWS, LONGEST) of each row the profile along x, and of each column that along y
    bent : what these were moved by on the array for bent rays
    """

    column: int
    columns: int
    row: int
    rows: int
    across: Floats
    down: Floats
    bent: Bent


@njit(cache=True)
def ball_share(t: float) -> float:
    """Return the share of a ball of radius 1 that lies below t along one axis."""
    if t <= -1.0:
        return 0.0
    if t >= 1.0:
        return 1.0
    return 0.25 * (2.0 + 3.0 * t - t * t * t)


@njit(cache=True)
def ball_density(t: float) -> float:
    """Return the derivative of `ball_share`."""
    return 0.75 * (1.0 - t * t) if -1.0 < t < 1.0 else 0.0


@njit(cache=True)
def ball_moment(t: float) -> float:
    """Return the integral of t `ball_density` up to t, but for a constant."""
    t2 = min(t * t, 1.0)
    return 0.1875 * t2 * (2.0 - t2)


def respond(view: View, x: float, y: float, z: float, pixels: NDArray[np.int32], values: Floats) -> int:
    """Write the entries of a particle of unit light; return their number. Fits use `rows.respond_rows`.

    Parameters
    ----------
    x, y, z : its centre, image axes, mm
    pixels : (capacity,) flat pixel numbers, written
    values : (capacity, 4) light and its derivatives by x, y, z, written
    """
    return _respond_to((x, y, z), view, room_for_rays(), pixels, values)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _respond_to(
    place: tuple[float, float, float], view: View, rays: Rays, pixels: NDArray[np.int32], values: Floats
) -> int:
    """Do the work of `respond`."""
    return _write_entries(view, bend_of(view, place[0], place[1], place[2], rays), pixels, values)


@njit(cache=True, **COUNT_REFERENCES)
def _write_entries(view: View, bend: Bend, pixels: NDArray[np.int32], values: Floats) -> int:
    """Write the entries of a particle with these rays; return their number."""
    if not is_seen(bend):
        return 0
    projection = response.project(view, bend)
    low_i, high_i, low_j, high_j = lenses_of(view, projection, bend)
    x_along, y_along = projection
    across, down = np.zeros((2, LONGEST, PROFILE_ROWS, LONGEST))
    count = 0
    for j in range(low_j, high_j + 1):
        for i in range(low_i, high_i + 1):
            s_x, s_y = view.centres_mm[j, i]
            if view.cell_table.shape[0] > 0:
                count += join_cell(view, projection, bend, (s_x, s_y), pixels[count:], values[count:])
                continue
            bent = bent_at(view, projection, bend, s_x, s_y)
            of_x, of_y = (bent.x, bent.gain_x), (bent.y, bent.gain_y)
            # What leans is beyond the upright cell by so much at most.
            more_x, more_y = abs(view.lean_x) * view.half_y_mm, abs(view.lean_y) * view.half_x_mm
            column, columns = _lit(view, x_along, of_x, s_x, more_x)
            row, rows = _lit(view, y_along, of_y, s_y, more_y)
            for m in range(rows):
                up = _seen_at(view, y_along, of_y, s_y, row + m)
                _fill(view, x_along, (bent.x + view.lean_x * up, bent.gain_x), s_x, (column, columns), across[m])
            for n in range(columns):
                right = _seen_at(view, x_along, of_x, s_x, column + n)
                _fill(view, y_along, (bent.y + view.lean_y * right, bent.gain_y), s_y, (row, rows), down[n])
            lens = Lens(column, columns, row, rows, across, down, bent)
            count += _join(view, projection, bend, lens, pixels[count:], values[count:])
    return count


@njit(cache=True)
def _lit(view: View, along: Along, bent: tuple[float, float], s: float, more: float) -> tuple[int, int]:
    """Return the first pixel that the lens at s lights along one axis, and their number; bent rays moved as in `Bent`.

    Its cell reaches further by `more`.
    """
    at, gain, shift = along.at + bent[0], along.stretch * along.alpha + bent[1], _shift(view, along, s)
    return lit_pixels(view, gain, at - s, along.half + along.radius + more, along.scale, shift, along.pixels)


@njit(cache=True)
def _shift(view: View, along: Along, s: float) -> float:
    """Return where the lens at s shows the middle of the main lens on the sensor, along one axis."""
    return (1.0 - view.camera.bend) * s - along.lever * along.beta * along.x


@njit(cache=True)
def _patch(view: View, along: Along, s: float, pixel: int) -> float:
    """Return the middle of the main lens's patch that a pixel sees through the lens at s, along one axis."""
    return ((pixel + 0.5 - 0.5 * along.pixels) * view.camera.pixel_mm - _shift(view, along, s)) / along.scale


@njit(cache=True)
def _seen_at(view: View, along: Along, bent: tuple[float, float], s: float, pixel: int) -> float:
    """Return how far off the lens at s a pixel sees the middle of the ball on the array, along one axis."""
    patch = _patch(view, along, s, pixel)
    return along.at + bent[0] + (along.stretch * along.alpha + bent[1]) * patch - s


@njit(cache=True)
def _fill(view: View, along: Along, bent: tuple[float, float], s: float, lit: tuple[int, int], out: Floats) -> None:
    """Fill the profile (PROFILE_ROWS, LONGEST) of the lens at s along one axis; bent rays are moved as in `Bent`."""
    camera = view.camera
    x, beta, slope, stretch = along.x, along.beta, along.slope, along.stretch
    scale, lever, half, radius, growth = along.scale, along.lever, along.half, along.radius, along.growth
    at, gain = along.at + bent[0], stretch * along.alpha + bent[1]
    first, count = lit
    width = camera.pixel_mm / scale
    parts = parts_of(gain * width / radius)
    for k in range(count):
        middle = _patch(view, along, s, first + k)
        out[:, k] = 0.0
        out[PATCH, k] = middle
        for node in range(3 * parts):
            xi = (2 * (node // 3) + 1 + GAUSS_AT[node % 3]) / parts - 1.0
            # X of the node, its derivatives, and those of u, the array point relative to the lens.
            place = middle + 0.5 * abs(width) * xi
            place_x, place_z = lever * beta / scale, lever * slope * (x - place) / scale
            u = at + gain * place - s
            u_x = gain * place_x - beta * stretch
            u_z = stretch * (slope * place - slope * x) + gain * place_z
            upper, lower = (u + half) / radius, (u - half) / radius
            share = ball_share(upper) - ball_share(lower)
            dense_upper, dense_lower = ball_density(upper), ball_density(lower)
            by_u = (dense_upper - dense_lower) / radius
            by_z = by_u * u_z - (dense_upper * upper - dense_lower * lower) * growth
            weight = GAUSS_WEIGHT[node % 3] / parts
            out[MEAN, k] += weight * share
            out[SLOPE, k] += 3.0 * weight * xi * share
            out[MEAN_X, k] += weight * by_u * u_x
            out[SLOPE_X, k] += 3.0 * weight * xi * by_u * u_x
            out[MEAN_Z, k] += weight * by_z
            out[SLOPE_Z, k] += 3.0 * weight * xi * by_z
            out[AWAY, k] += weight * (ball_moment(upper) - ball_moment(lower))


@njit(cache=True)
def _join(view: View, projection: Projection, bend: Bend, lens: Lens, pixels: NDArray[np.int32], values: Floats) -> int:
    """Write the entries of one lens; return their number."""
    camera = view.camera
    count = 0
    of_x, of_y = projection
    column, columns, row, rows = lens.column, lens.columns, lens.row, lens.rows
    # Patches are a few per cent wider one way than the other at most.
    width = mean_width(view, projection)
    norm = width * width / (np.pi * camera.aperture_radius_mm**2)
    # The patch moves by these with x, y and by tilt (x - X) with z, and is widened with z.
    place_x, place_y = of_x.lever * of_x.beta / of_x.scale, of_y.lever * of_y.beta / of_y.scale
    tilt_x, tilt_y = of_x.lever * of_x.slope / of_x.scale, of_y.lever * of_y.slope / of_y.scale
    # What a profile changes by with x, over what the array point does.
    bent = lens.bent
    per_x = 1.0 / (of_x.stretch * (of_x.alpha * place_x - of_x.beta) + bent.gain_x * place_x)
    per_y = 1.0 / (of_y.stretch * (of_y.alpha * place_y - of_y.beta) + bent.gain_y * place_y)
    # What the array point moves by with z, of (X - x).
    turn_x = of_x.slope * of_x.stretch - (of_x.stretch * of_x.alpha + bent.gain_x) * tilt_x
    turn_y = of_y.slope * of_y.stretch - (of_y.stretch * of_y.alpha + bent.gain_y) * tilt_y
    outside = (camera.aperture_radius_mm + 0.71 * width) ** 2
    for m in range(rows):
        along_x = lens.across[m]
        for n in range(columns):
            along_y = lens.down[n]
            v0, v1, patch_y = along_y[MEAN, m], along_y[SLOPE, m], along_y[PATCH, m]
            v0_y, v1_y, v0_z, v1_z = along_y[MEAN_X, m], along_y[SLOPE_X, m], along_y[MEAN_Z, m], along_y[SLOPE_Z, m]
            patch_x = along_x[PATCH, n]
            r2 = patch_x * patch_x + patch_y * patch_y
            if r2 >= outside:
                continue
            h0, h0_x, h0_z = along_x[MEAN, n], along_x[MEAN_X, n], along_x[MEAN_Z, n]
            h1, h1_x, h1_z = along_x[SLOPE, n], along_x[SLOPE_X, n], along_x[SLOPE_Z, n]
            # Light from one side of the ball crossed the main lens elsewhere than light from its middle.
            rim_x = patch_x + place_x * of_x.ball * along_x[AWAY, n] / max(h0, SMALLEST_SHARE)
            rim_y = patch_y + place_y * of_y.ball * along_y[AWAY, m] / max(v0, SMALLEST_SHARE)
            share, mean_x, mean_y, share_x, share_y = covered_share(rim_x, rim_y, width, camera.aperture_radius_mm)
            light = share * h0 * v0 + mean_x * h1 * v0 + mean_y * h0 * v1
            # Profiles along x follow how far up the ball is seen, those along y how far right.
            own_x = share * h0_x * v0 + mean_x * h1_x * v0 + mean_y * h0_x * v1
            own_y = share * h0 * v0_y + mean_x * h1 * v0_y + mean_y * h0 * v1_y
            by_x = own_x + view.lean_y * own_y + share_x * place_x * h0 * v0
            by_y = own_y + view.lean_x * own_x + share_y * place_y * h0 * v0
            by_z_x = share * h0_z * v0 + mean_x * h1_z * v0 + mean_y * h0_z * v1
            by_z_x += share_x * (of_x.x - patch_x) * tilt_x * h0 * v0
            by_z_x += view.lean_y * own_y * per_y * (patch_x - of_x.x) * turn_x
            by_z_y = share * h0 * v0_z + mean_x * h1 * v0_z + mean_y * h0 * v1_z
            by_z_y += share_y * (of_y.x - patch_y) * tilt_y * h0 * v0
            by_z_y += view.lean_x * own_x * per_x * (patch_y - of_y.x) * turn_y
            slope_x, slope_y = displaced(bend, patch_x, patch_y)
            more_x = of_x.stretch * camera.image_distance_mm * slope_x - bent.x - bent.gain_x * patch_x
            more_y = of_y.stretch * camera.image_distance_mm * slope_y - bent.y - bent.gain_y * patch_y
            light += by_x * per_x * more_x + by_y * per_y * more_y
            if light <= 0.0 or count >= pixels.size:
                continue
            by_z_x, by_z_y = by_z_x - tilt_x * light, by_z_y - tilt_y * light
            pixels[count] = (row + m) * camera.columns + column + n
            values[count, 0] = norm * light
            for j in range(3):
                to_x, to_y, to_z_x, to_z_y = response.seen_moves(view, bend, j)
                values[count, 1 + j] = norm * (to_x * by_x + to_y * by_y + to_z_x * by_z_x + to_z_y * by_z_y)
            count += 1
    return count


def respond_once(view: View, x: float, y: float, z: float, pixels: NDArray[np.int32], values: Floats) -> int:
    """Write the response of a particle of unit light with each pixel named once; return the number of pixels.

    The readable twin of `respond_rows`.
    """
    entries = respond(view, x, y, z, pixels, values)
    named, place = np.unique(pixels[:entries], return_inverse=True)
    sums = np.zeros((named.size, VALUES))
    np.add.at(sums, place, values[:entries])
    pixels[: named.size], values[: named.size] = named, sums
    return int(named.size)


def twin_image(view: View, place: ArrayLike) -> Floats:
    """Return light and derivatives of a particle of unit light as images (pixels, 4), pixel by pixel."""
    capacity = entry_capacity(view, -5.0, 5.0)
    pixels, values = np.empty(capacity, np.int32), np.empty((capacity, VALUES))
    count = respond_once(view, *np.asarray(place, np.float64), pixels, values)
    assert count < capacity
    image = np.zeros((view.camera.rows * view.camera.columns, VALUES))
    image[pixels[:count]] = values[:count]
    return image
