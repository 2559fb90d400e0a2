"""The response of `response`, for fits: neighbouring pixels of a row at once, and each pixel lit only once.

Where micro-images overlap a pixel is lit through two lenses. Its light is squared in chi-squared, so that its two parts
must be added first: near the focal plane depths would be wrong by half a millimetre otherwise. The sum stands where the
pixel is named first; named again, it has no light.

Axes and entries: see `response`. Values are held as rows (4, capacity): light, and its derivatives by x, y and z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.particles.micro_images import (
    CURVED_NUMBERS,
    DOWN,
    JOIN_NUMBERS,
    OF_CUBIC,
    PATCH,
    TABLE_SIZE,
    WIDTH,
    cover_row,
    fill_profile,
    join_curved_row,
    join_row,
    take_row,
)
from lfpiv_cli.particles.pencil import in_row
from lfpiv_cli.particles.refraction import Bend, is_seen
from lfpiv_cli.particles.response import (
    Along,
    Projection,
    bent_at,
    join_cell,
    lenses_of,
    lit_pixels,
    mean_width,
    project,
    seen_moves,
)
from lfpiv_cli.particles.view import View
from lfpiv_cli.threads import COUNT_NO_REFERENCES

# A row of a micro-image is written up to a whole `WIDTH`: so many entries more than there are.
SLACK = WIDTH


class Scratch(NamedTuple):
    """Room for what one lens shows: the table of `micro_images` and its numbers; and for where each lens does."""

    table: Floats
    numbers: Floats
    lenses: NDArray[np.int64]


class Entries(NamedTuple):
    """What is written, see `respond_rows`, and the room to work it out."""

    pixels: NDArray[np.int32]
    values: Floats
    room: Scratch


@njit(cache=True)
def scratch(capacity: int) -> Scratch:
    """Return the room for so many entries."""
    numbers = np.zeros(max(JOIN_NUMBERS, CURVED_NUMBERS))
    return Scratch(np.zeros(TABLE_SIZE), numbers, np.empty((capacity + 1, 5), np.int64))


@njit(cache=True, **COUNT_NO_REFERENCES)
def respond_rows(view: View, bend: Bend, pixels: NDArray[np.int32], values: Floats, room: Scratch) -> int:
    """Write the entries of a particle of unit light; return their number.

    Parameters
    ----------
    bend : of its rays, see `bend_of`
    pixels : (capacity,) flat pixel numbers, written
    values : (4, capacity) light and its derivatives by x, y, z, written
    """
    if not is_seen(bend):
        return 0
    projection, entries = project(view, bend), Entries(pixels, values, room)
    if bend.cubic.shape[0] > 0:
        _set_curved_numbers(view, projection, bend, room.numbers)
    else:
        _set_numbers(view, projection, bend, room.numbers)
    low_i, high_i, low_j, high_j = lenses_of(view, projection, bend)
    # Of each lens: end of its entries, first and last row, first and last column.
    ends = room.lenses
    ends[0, 0] = 0
    shown = 0
    for j in range(low_j, high_j + 1):
        for i in range(low_i, high_i + 1):
            lens = (view.centres_mm[j, i, 0], view.centres_mm[j, i, 1])
            begin = ends[shown, 0]
            if view.cell_table.shape[0] > 0:
                count = join_cell(view, projection, bend, lens, pixels[begin:], values.T[begin:])
                _set_rectangle(pixels[begin : begin + count], view.camera.columns, ends[shown + 1])
            else:
                count = _write_lens(view, projection, bend, lens, begin, entries, ends[shown + 1])
            if count == 0:
                continue
            shown += 1
            ends[shown, 0] = begin + count
            for other in range(1, shown):
                if (
                    ends[other, 1] <= ends[shown, 2]
                    and ends[shown, 1] <= ends[other, 2]
                    and ends[other, 3] <= ends[shown, 4]
                    and ends[shown, 3] <= ends[other, 4]
                ):
                    _join_twice_lit((ends[other - 1, 0], ends[other, 0]), (begin, ends[shown, 0]), pixels, values)
    return int(ends[shown, 0])


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_numbers(view: View, projection: Projection, bend: Bend, numbers: Floats) -> None:
    """Set the numbers of `join_row` of a particle, but for those that each lens has of its own."""
    camera, x, y = view.camera, projection.x, projection.y
    ratio = x.lever / x.scale
    width = mean_width(view, projection)
    numbers[0] = ratio * x.beta
    numbers[1], numbers[2] = x.x, y.x
    numbers[3] = ratio * x.slope
    numbers[4] = width * width / (np.pi * camera.aperture_radius_mm**2)
    numbers[5] = -2.0 * ratio * x.slope
    for n in range(6, numbers.size):
        numbers[n] = 0.0
    if bend.nodes.size > 0:
        numbers[6], numbers[7], numbers[8], numbers[9] = bend.x, bend.y, bend.seen_x, bend.seen_y
        numbers[10] = 1.0 / bend.distance_x
        for n in range(4):
            numbers[11 + n] = bend.nodes[n]
        for n in range(5):
            numbers[15 + n] = bend.factors[n]
        # What a profile changes by with x, over what the array point does, times what that moves by.
        more = camera.image_distance_mm / (x.alpha * numbers[0] - x.beta)
        numbers[20] = numbers[21] = more


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_curved_numbers(view: View, projection: Projection, bend: Bend, numbers: Floats) -> None:
    """Set the numbers of `join_curved_row` of a particle, but for those that each lens and each row has of its own."""
    camera, x, y = view.camera, projection.x, projection.y
    width = mean_width(view, projection)
    numbers[0], numbers[1] = x.x, y.x
    for k in range(2):
        along = x if k == 0 else y
        ratio = along.lever / along.scale
        numbers[2 + 3 * k] = ratio * along.beta
        numbers[3 + 3 * k] = ratio * along.slope
        numbers[4 + 3 * k] = -ratio * along.slope
    numbers[8] = width * width / (np.pi * camera.aperture_radius_mm**2)
    for j in range(3):
        moves = seen_moves(view, bend, j)
        for k in range(4):
            numbers[9 + 4 * j + k] = moves[k]


@njit(cache=True, **COUNT_NO_REFERENCES)
def _write_lens(
    view: View,
    projection: Projection,
    bend: Bend,
    lens: tuple[float, float],
    begin: int,
    entries: Entries,
    rectangle: NDArray[np.int64],
) -> int:
    """Write the entries of one lens with a rectangular cell from `begin` on; return their number.

    Sets the rectangle of pixels that they lie in: first and last row, first and last column, from the second number on.
    """
    camera, room, x, y = view.camera, entries.room, projection.x, projection.y
    numbers = room.numbers
    bent = bent_at(view, projection, bend, lens[0], lens[1])
    gain_x, gain_y = x.stretch * x.alpha + bent.gain_x, y.stretch * y.alpha + bent.gain_y
    offset_x, offset_y = x.at + bent.x - lens[0], y.at + bent.y - lens[1]
    shift_x = (1.0 - camera.bend) * lens[0] - x.lever * x.beta * x.x
    shift_y = (1.0 - camera.bend) * lens[1] - y.lever * y.beta * y.x
    column, columns = lit_pixels(view, gain_x, offset_x, x.half + x.radius, x.scale, shift_x, camera.columns)
    if columns == 0:
        return 0
    row, rows = lit_pixels(view, gain_y, offset_y, y.half + y.radius, y.scale, shift_y, camera.rows)
    if rows == 0:
        return 0
    step_x, step_y = camera.pixel_mm / x.scale, camera.pixel_mm / y.scale
    first_x = ((column + 0.5 - 0.5 * camera.columns) * camera.pixel_mm - shift_x) / x.scale
    first_y = ((row + 0.5 - 0.5 * camera.rows) * camera.pixel_mm - shift_y) / y.scale
    width = mean_width(view, projection)
    if _nearest(first_x, step_x, columns) + _nearest(first_y, step_y, rows) >= _far(view, width):
        return 0
    _fill(view, x, (first_x, offset_x, gain_x), columns, room.table)
    _fill(view, y, (first_y, offset_y, gain_y), rows, room.table[DOWN:])
    if bend.cubic.shape[0] > 0:
        _set_bent(view, x, bent.x, bent.gain_x, numbers[CURVED_NUMBERS - 4 :])
        _set_bent(view, y, bent.y, bent.gain_y, numbers[CURVED_NUMBERS - 3 :])
    elif bend.nodes.size > 0:
        per_array = numbers[20] / camera.image_distance_mm
        numbers[22] = per_array / x.stretch * bent.x
        numbers[23] = per_array / y.stretch * bent.y
    lit = (row, rows), (column, columns)
    far = camera.image_distance_mm
    rises = bent.gain_x / (x.stretch * far), bent.gain_y / (y.stretch * far)
    # How far from a patch the edge of the ball is seen from, at most.
    away = np.hypot(x.lever * x.beta * x.ball / x.scale, y.lever * y.beta * y.ball / y.scale)
    patches = step_x, width, away
    return _write_rows(view, (bend.cubic, rises), lit, patches, begin, entries, rectangle)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_bent(view: View, along: Along, bent: float, gain: float, numbers: Floats) -> None:
    """Set along one axis what profiles change by with rays' slopes, and did already; see `join_row`."""
    place = along.lever / along.scale * along.beta
    by_x = along.stretch * (along.alpha * place - along.beta) + gain * place
    numbers[0] = along.stretch * view.camera.image_distance_mm / by_x
    numbers[2] = bent / by_x


@njit(cache=True, **COUNT_NO_REFERENCES)
def _nearest(first: float, step: float, count: int) -> float:
    """Return the square of the smallest of |first + n step|."""
    last = first + (count - 1) * step
    return 0.0 if first * last <= 0.0 else min(abs(first), abs(last)) ** 2


@njit(cache=True, **COUNT_NO_REFERENCES)
def _far(view: View, width: float) -> float:
    """Return the square of how far from the axis a patch is that the rim does not touch, from outside."""
    return float((view.camera.aperture_radius_mm + 0.71 * width) ** 2)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _fill(view: View, along: Along, patches: tuple[float, float, float], count: int, out: Floats) -> None:
    """Fill the profile of one lens along an axis.

    `patches` are the first patch, and what the array is off by and how that grows with X.
    """
    first, offset, gain = patches
    camera = view.camera
    step = camera.pixel_mm / along.scale
    ratio = along.lever / along.scale
    numbers = (
        first,
        step,
        abs(step),
        offset,
        gain,
        gain * ratio * along.beta - along.beta * along.stretch,
        along.x,
        along.slope * (along.stretch - gain * ratio),
        along.half,
        1.0 / along.radius,
        along.growth,
        ratio * along.beta * along.ball,
    )
    fill_profile(out, count, numbers)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _write_rows(
    view: View,
    bent: tuple[Floats, tuple[float, float]],
    lit: tuple[tuple[int, int], tuple[int, int]],
    patches: tuple[float, float, float],
    begin: int,
    entries: Entries,
    rectangle: NDArray[np.int64],
) -> int:
    """Write the entries of one lens whose profiles are known, row by row; see `_write_lens`.

    Parameters
    ----------
    bent : `Bend.cubic`, and the slopes of its tangents that profiles follow already
    lit : first row and their number, first column and their number
    patches : the step along x from one to the next, their mean width, and how far from them a ball is seen from at most
    """
    camera, (pixels, values, room) = view.camera, entries
    (row, rows), (column, columns) = lit
    cubic, tangent = bent
    step, width, away = patches
    outside = _far(view, width)
    # Of patches that the rim, with its sagitta, does not touch, seen from wherever they are.
    inside = max(camera.aperture_radius_mm - 0.75 * width - away, 0.0) ** 2
    table, first = room.table, room.table[PATCH]
    at = begin
    rectangle[1], rectangle[2], rectangle[3], rectangle[4] = row + rows, -1, column + columns, -1
    for m in range(rows):
        y = table[DOWN + PATCH + m]
        low, high = _columns_within(outside - y * y, first, step, columns)
        if low >= high or at + high - low + SLACK > pixels.size:
            continue
        chosen, whole = (low, high - low), _columns_within(inside - y * y, first, step, columns)
        cover_row(table, chosen, m, whole, width, camera.aperture_radius_mm)
        if cubic.shape[0] > 0:
            _set_row(cubic, tangent, y, room.numbers)
            join_curved_row(table, chosen, m, room.numbers)
        else:
            join_row(table, chosen, m, room.numbers)
        take_row(table, chosen, (at, (row + m) * camera.columns + column + low), pixels, values)
        at += high - low
        rectangle[1], rectangle[2] = min(rectangle[1], row + m), row + m
        rectangle[3], rectangle[4] = min(rectangle[3], column + low), max(rectangle[4], column + high - 1)
    return at - begin


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_row(cubic: Floats, tangent: tuple[float, float], y: float, numbers: Floats) -> None:
    """Set the cubics of X that a row has, of `join_curved_row`, without the tangents that profiles follow."""
    for k in range(2):
        at = OF_CUBIC + 4 * k
        numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3] = in_row(cubic[k], y)
    numbers[OF_CUBIC + 1] -= tangent[0]
    numbers[OF_CUBIC + 4] -= tangent[1] * y


@njit(cache=True, **COUNT_NO_REFERENCES)
def _columns_within(square: float, first: float, step: float, columns: int) -> tuple[int, int]:
    """Return the first n of those whose (first + n step)^2 is below `square`, and the one behind the last."""
    if square <= 0.0:
        return 0, 0
    reach = np.sqrt(square)
    one, other = (-reach - first) / step, (reach - first) / step
    low, high = int(np.ceil(min(one, other))), int(np.floor(max(one, other))) + 1
    return max(low, 0), min(high, columns)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_rectangle(pixels: NDArray[np.int32], columns: int, rectangle: NDArray[np.int64]) -> None:
    """Set the rectangle of pixels: first and last row, first and last column, from the second number on."""
    rectangle[1], rectangle[2], rectangle[3], rectangle[4] = pixels.size, -1, columns, -1
    if pixels.size == 0:
        return
    rectangle[1], rectangle[2] = pixels[0] // columns, pixels[-1] // columns
    for pixel in pixels:
        column = pixel % columns
        rectangle[3], rectangle[4] = min(rectangle[3], column), max(rectangle[4], column)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _join_twice_lit(one: tuple[int, int], other: tuple[int, int], pixels: NDArray[np.int32], values: Floats) -> None:
    """Move what a lens lights of another's pixels to that one's entries; either's (first, end) ascend."""
    a, b = one[0], other[0]
    while a < one[1] and b < other[1]:
        if pixels[a] < pixels[b]:
            a += 1
        elif pixels[b] < pixels[a]:
            b += 1
        else:
            for k in range(values.shape[0]):
                values[k, a] += values[k, b]
                values[k, b] = 0.0
            a += 1
            b += 1
