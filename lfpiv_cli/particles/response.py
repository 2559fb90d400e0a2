"""The point-spread function: the light of one particle on the raw image, with analytic derivatives.

A particle is an evenly glowing ball. Through lens n, centred at s, a ray that crosses the main lens at X meets the
array at x_m = alpha X - beta x, beta = s_i/s_o, and the sensor at

    x_s = (1 - bend) s + bend x_m + (s_mu/s_i)(x_m - X)            (Eq. 1, bend = 1 - s_mu/f_m)

so every pixel sees a patch of X. Seen from there, the share P(X) of the ball whose light falls into the lens's cell
is, along each axis of a square cell, a difference of two of the ball's marginal distributions (cubics); mean and slope
of P over the patch come from a three-point Gauss rule, and the two axes are joined by the patch's covered share and its
first moments (`covered_share`). In a hexagonal cell P does not separate; it is taken from a table of its means over
patches (`cells`).

Faces between media bend the rays (`refraction`). What that moves x_m by in the middle of a lens's patches moves the
lens's profiles; what it moves x_m by more in each patch enters by the profiles' slopes. On the sensor rays stay where
they were: what moves x_m by a pixel moves x_s by s_mu/s_i of it.

Axes: image axes, mm; see `view`. An *entry* is the meeting of a pixel with one lens; a pixel between two micro-images
can have two.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, IN_PLACE, njit
from lfpiv_cli.particles.cells import BALL_VARIANCE, covered_share, level_at, share_at
from lfpiv_cli.particles.micro_images import LONGEST
from lfpiv_cli.particles.pencil import rises_at
from lfpiv_cli.particles.refraction import Bend, displaced, largest_displacement
from lfpiv_cli.particles.view import View


class Along(NamedTuple):
    """How the main lens shows one particle on the array along one image axis.

    Attributes
    ----------
    x : the particle's centre, as seen in air
    alpha, beta, slope : see above, and d alpha/dz = d beta/dz, z the depth as seen through planes
    at : where the middle of the main lens shows the centre
    stretch : the distortion's local scale: array points are at + stretch alpha X
    scale, lever : x_s changes by `scale` with X, by -`lever` with beta x
    ball : the ball's radius as seen in air
    radius, growth : the ball's on the array as a pixel sees it, and its relative change with z
    half : half the rectangle that holds a lens's cell
    pixels : of the sensor
    """

    x: float
    alpha: float
    beta: float
    slope: float
    at: float
    stretch: float
    scale: float
    lever: float
    ball: float
    radius: float
    growth: float
    half: float
    pixels: int


class Projection(NamedTuple):
    """How the main lens shows one particle on the array: along both image axes."""

    x: Along
    y: Along


class Bent(NamedTuple):
    """What bent rays through one lens are moved by on the array along both axes, x + gain_x X: the tangent to it."""

    x: float
    y: float
    gain_x: float
    gain_y: float


@njit(**IN_PLACE)
def project(view: View, bend: Bend) -> Projection:
    """Return how the main lens shows a particle."""
    camera = view.camera
    x, y = bend.seen_x, bend.seen_y
    beta_x, beta_y = camera.image_distance_mm / bend.distance_x, camera.image_distance_mm / bend.distance_y
    r2 = (beta_x * x) ** 2 + (beta_y * y) ** 2
    # Curved faces show a ball wider, by how its points move along an axis with their places, depths among them.
    wide = tall = 1.0
    if bend.line_moves.shape[0] > 0:
        wide, tall = _length(bend.line_moves[0, 0]), _length(bend.line_moves[1, 0])
    return Projection(
        _along(view, x, beta_x, bend.distance_x, r2, wide, (view.half_x_mm, camera.columns)),
        _along(view, y, beta_y, bend.distance_y, r2, tall, (view.half_y_mm, camera.rows)),
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def _length(vector: Floats) -> float:
    """Return the length of a vector (3,)."""
    return float(np.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]))


@njit(**IN_PLACE)
def _along(
    view: View, x: float, beta: float, distance: float, r2: float, wide: float, cell: tuple[float, int]
) -> Along:
    """Return `Along` of a particle that would be seen at r without distortion, its ball so many times as wide."""
    camera, x0 = view.camera, -beta * x
    alpha = 1.0 + beta - camera.image_distance_mm / camera.focal_length_mm
    tilt = camera.microlens_distance_mm / camera.image_distance_mm
    scale, lever = camera.bend * alpha + tilt * (alpha - 1.0), camera.bend + tilt
    slope = -beta * view.depth_ratio / distance
    ball = wide * view.particle_radius_mm
    return Along(
        x=x,
        alpha=alpha,
        beta=beta,
        slope=slope,
        at=x0 * (1.0 + camera.distortion_per_mm2 * r2),
        stretch=1.0 + camera.distortion_per_mm2 * (r2 + 2.0 * x0 * x0),
        scale=scale,
        lever=lever,
        ball=ball,
        # Of rays that strike one place, those from one side of the ball crossed the lens elsewhere than the others.
        radius=abs(1.0 - alpha * lever / scale) * beta * ball + view.lines.margin_mm,
        growth=slope * (1.0 / beta - lever / scale),
        half=cell[0],
        pixels=cell[1],
    )


@njit(**IN_PLACE)
def bent_at(view: View, projection: Projection, bend: Bend, s_x: float, s_y: float) -> Bent:
    """Return what bent rays are moved by on the array through the lens at s: as in the middle of its patches.

    Behind curved faces it changes enough over these patches for its slope to count.
    """
    if bend.nodes.size == 0 and bend.cubic.shape[0] == 0:
        return Bent(0.0, 0.0, 0.0, 0.0)
    radius, x, y = view.camera.aperture_radius_mm, projection.x, projection.y
    at_x = _middle_of_part(x.stretch * x.alpha, x.at - s_x, x.half + x.radius, radius)
    at_y = _middle_of_part(y.stretch * y.alpha, y.at - s_y, y.half + y.radius, radius)
    slope_x, slope_y = displaced(bend, at_x, at_y)
    rise_x = rise_y = 0.0
    if bend.cubic.shape[0] > 0:
        rise_x, rise_y = rises_at(bend.cubic, at_x, at_y)
        slope_x, slope_y = slope_x - rise_x * at_x, slope_y - rise_y * at_y
    far_x, far_y = x.stretch * view.camera.image_distance_mm, y.stretch * view.camera.image_distance_mm
    return Bent(far_x * slope_x, far_y * slope_y, far_x * rise_x, far_y * rise_y)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _middle_of_part(gain: float, offset: float, reach: float, radius: float) -> float:
    """Return the middle of `part_of_lens`; where there is none, a place on the main lens all the same."""
    low, high = part_of_lens(gain, offset, reach, radius)
    return min(max(0.5 * (low + high), -radius), radius)


@njit(**IN_PLACE)
def part_of_lens(gain: float, offset: float, reach: float, radius: float) -> tuple[float, float]:
    """Return between which X of -radius to radius `offset` + `gain` X is within `reach` of 0.

    The first is not below the second where it nowhere is.
    """
    if abs(gain) * radius > 1e-3 * reach:
        one, other = (-offset - reach) / gain, (-offset + reach) / gain
        return max(-radius, min(one, other)), min(radius, max(one, other))
    if abs(offset) > reach + abs(gain) * radius:
        return 0.0, 0.0
    return -radius, radius


@njit(**IN_PLACE)
def lenses_of(view: View, projection: Projection, bend: Bend) -> tuple[int, int, int, int]:
    """Return the ranges of lens indices, first and last along i and j, whose cells the light can reach."""
    camera, x, y = view.camera, projection.x, projection.y
    widest = max(x.stretch, y.stretch)
    bent = camera.image_distance_mm * largest_displacement(bend, camera.aperture_radius_mm)
    reach_x = (abs(x.alpha) * camera.aperture_radius_mm + bent) * widest + x.radius
    reach_y = (abs(y.alpha) * camera.aperture_radius_mm + bent) * widest + y.radius
    basis = view.inverse_basis
    dx, dy = x.at - camera.origin_mm[0], y.at - camera.origin_mm[1]
    i = dx * basis[0, 0] + dy * basis[1, 0]
    j = dx * basis[0, 1] + dy * basis[1, 1]
    reach_i = reach_x * abs(basis[0, 0]) + reach_y * abs(basis[1, 0])
    reach_j = reach_x * abs(basis[0, 1]) + reach_y * abs(basis[1, 1])
    rows, columns = view.centres_mm.shape[0], view.centres_mm.shape[1]
    low_i = max(int(np.ceil(i - reach_i - view.cell_reach)) - view.first_i, 0)
    high_i = min(int(np.floor(i + reach_i + view.cell_reach)) - view.first_i, columns - 1)
    low_j = max(int(np.ceil(j - reach_j - view.cell_reach)) - view.first_j, 0)
    high_j = min(int(np.floor(j + reach_j + view.cell_reach)) - view.first_j, rows - 1)
    return low_i, high_i, low_j, high_j


@njit(**IN_PLACE)
def lit_pixels(
    view: View, gain: float, offset: float, reach: float, scale: float, shift: float, pixels: int
) -> tuple[int, int]:
    """Return the first pixel that a lens can light along one axis, and how many.

    A crossing X of the main lens meets the array at `offset` + `gain` X from the lens, within `reach` of it, and the
    sensor at `scale` X + `shift`.
    """
    camera = view.camera
    low, high = part_of_lens(gain, offset, reach, camera.aperture_radius_mm)
    if low >= high:
        return 0, 0
    one, other = scale * low + shift, scale * high + shift
    first = int(np.floor(min(one, other) / camera.pixel_mm + 0.5 * pixels))
    last = int(np.floor(max(one, other) / camera.pixel_mm + 0.5 * pixels))
    first, last = max(first, 0), min(last, pixels - 1)
    return first, max(min(last - first + 1, LONGEST), 0)


@njit(**IN_PLACE)
def mean_width(view: View, projection: Projection) -> float:
    """Return the side of a square as large as a pixel's patch on the main lens."""
    return float(view.camera.pixel_mm / np.sqrt(projection.x.scale * projection.y.scale))


@njit(cache=True, **COUNT_NO_REFERENCES)
def seen_moves(view: View, bend: Bend, axis: int) -> tuple[float, float, float, float]:
    """Return how the point in air moves with x, y or z: its places and its depths along both image axes.

    These depths count as those behind planes do, where both are z.
    """
    moves, per_depth = bend.line_moves, 1.0 / view.depth_ratio
    if moves.shape[0] > 0:
        to_x, to_y = moves[0, 0, axis], moves[1, 0, axis]
        return to_x, to_y, per_depth * moves[0, 1, axis], per_depth * moves[1, 1, axis]
    deeper = 1.0 if axis == 2 else 0.0
    return 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, deeper, deeper


# Blur by less than this share of the ball's radius is not seen.
STEEP = 0.3


@njit(cache=True, **COUNT_NO_REFERENCES)
def join_cell(
    view: View, projection: Projection, bend: Bend, lens: tuple[float, float], pixels: NDArray[np.int32], values: Floats
) -> int:
    """Write the entries of one lens whose cell's shares are tabulated; return their number."""
    camera = view.camera
    count = 0
    bent = camera.image_distance_mm * largest_displacement(bend, camera.aperture_radius_mm)
    # Behind planes, where alone these cells are, the same along both axes but for places and the distortion.
    x, alpha, beta, slope, at_x, stretch_x, scale, whole_lever, _, radius, growth, _, _ = projection.x
    y, at_y, stretch_y = projection.y.x, projection.y.at, projection.y.stretch
    s_x, s_y = lens
    off_x, off_y = at_x - s_x, at_y - s_y
    lever = whole_lever / scale
    gain_x, gain_y = stretch_x * alpha, stretch_y * alpha
    shift_x = (1.0 - camera.bend) * s_x - lever * scale * beta * x
    shift_y = (1.0 - camera.bend) * s_y - lever * scale * beta * y
    reach = view.corner_mm + radius
    column, columns = lit_pixels(view, gain_x, off_x, reach + stretch_x * bent, scale, shift_x, camera.columns)
    row, rows = lit_pixels(view, gain_y, off_y, reach + stretch_y * bent, scale, shift_y, camera.rows)
    width = abs(camera.pixel_mm / scale)
    norm = width * width / (np.pi * camera.aperture_radius_mm**2)
    inside = max(camera.aperture_radius_mm - 0.71 * width, 0.0) ** 2
    outside = (camera.aperture_radius_mm + 0.71 * width) ** 2
    # Across a patch, what a cubic moves rays by changes by up to thrice its share of the radius.
    steep = 3.0 * bent * width / camera.aperture_radius_mm
    is_steep = steep > STEEP * radius
    # No ray of a patch further from the lens than this meets its cell.
    furthest = (reach + 0.71 * (width * max(abs(gain_x), abs(gain_y)) + steep)) ** 2
    move_x, move_y = (lever * alpha - 1.0) * beta * stretch_x, (lever * alpha - 1.0) * beta * stretch_y
    # The patch on the array. It blurs the ball; so does more of a radius, and the variance of either is what counts.
    stretch = 0.5 * (stretch_x + stretch_y)
    side = stretch * abs(alpha) * width
    side_z = stretch * slope * width * (np.sign(alpha) - abs(alpha) * lever)
    square = side * side + 12.0 * BALL_VARIANCE * (radius * radius - view.cell_ball_mm**2)
    level, blend = level_at(square, view.cell_side2_mm2)
    wider = 0.5 / 12.0 * min(square - view.cell_side2_mm2[0], 0.0)
    wider_z = BALL_VARIANCE * radius * radius * growth + side * side_z / 12.0
    low, high = view.cell_table[level], view.cell_table[level + 1]
    half_x, half_y = 0.5 * width * gain_x, 0.5 * width * gain_y
    for m in range(rows):
        patch_y = ((row + m + 0.5 - 0.5 * camera.rows) * camera.pixel_mm - shift_y) / scale
        v_z = stretch_y * slope * (patch_y - y) * (1.0 - alpha * lever)
        for n in range(columns):
            patch_x = ((column + n + 0.5 - 0.5 * camera.columns) * camera.pixel_mm - shift_x) / scale
            r2 = patch_x * patch_x + patch_y * patch_y
            if r2 >= outside or count >= pixels.size:
                continue
            slope_x, slope_y = displaced(bend, patch_x, patch_y)
            u = off_x + gain_x * patch_x + stretch_x * camera.image_distance_mm * slope_x
            v = off_y + gain_y * patch_y + stretch_y * camera.image_distance_mm * slope_y
            if u * u + v * v >= furthest:
                continue
            if is_steep:
                next_x, next_y = (
                    displaced(bend, patch_x + width, patch_y)[0],
                    displaced(bend, patch_x, patch_y + width)[1],
                )
                side_x = gain_x * width + stretch_x * camera.image_distance_mm * (next_x - slope_x)
                side_y = gain_y * width + stretch_y * camera.image_distance_mm * (next_y - slope_y)
                lit = 0.5 * (side_x * side_x + side_y * side_y) + square - side * side
                level, blend = level_at(lit, view.cell_side2_mm2)
                wider = 0.5 / 12.0 * min(lit - view.cell_side2_mm2[0], 0.0)
                low, high = view.cell_table[level], view.cell_table[level + 1]
                half_x, half_y = 0.5 * side_x, 0.5 * side_y
            part, by_u, by_v, by_uu, by_uv, by_vv = share_at(u, v, low, high, blend, view.cell_step_mm)
            part += wider * (by_uu + by_vv)
            u_z = stretch_x * slope * (patch_x - x) * (1.0 - alpha * lever)
            by_z = by_u * u_z + by_v * v_z + wider_z * (by_uu + by_vv)
            by_x, by_y = by_u * move_x, by_v * move_y
            light = part
            if r2 > inside:
                # As in `_join`; the moment of what is seen of the ball is a fifth of the slope of P, nearly, its
                # middle no further away than the ball's edge.
                moment = BALL_VARIANCE * radius
                away = -lever * beta * view.particle_radius_mm * moment / max(part, moment * np.hypot(by_u, by_v), 1e-9)
                share, mean_x, mean_y, share_x, share_y = covered_share(
                    patch_x + away * by_u,
                    patch_y + away * by_v,
                    width,
                    camera.aperture_radius_mm,
                )
                lean_x, lean_y = mean_x * half_x, mean_y * half_y
                light = share * part + lean_x * by_u + lean_y * by_v
                by_x = (share * by_u + lean_x * by_uu + lean_y * by_uv) * move_x + share_x * lever * beta * part
                by_y = (share * by_v + lean_x * by_uv + lean_y * by_vv) * move_y + share_y * lever * beta * part
                by_z *= share
                by_z += lean_x * (by_uu * u_z + by_uv * v_z) + lean_y * (by_uv * u_z + by_vv * v_z)
                by_z += (share_x * (x - patch_x) + share_y * (y - patch_y)) * lever * slope * part
            if light <= 0.0:
                continue
            pixels[count] = (row + m) * camera.columns + column + n
            values[count, 0] = norm * light
            values[count, 1] = norm * by_x
            values[count, 2] = norm * by_y
            values[count, 3] = norm * (by_z - 2.0 * lever * slope * light)
            count += 1
    return count
