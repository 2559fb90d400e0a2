"""The response of `response`, for fits: a block of lenses at once, and each pixel lit only once.

Where micro-images overlap a pixel is lit through two lenses. Its light is squared in chi-squared, so that its two parts
must be added first: near the focal plane depths would be wrong by half a millimetre otherwise. The sum stands where the
pixel is named first; named again, it has no light.

Axes and entries: see `response`. Values are held as rows (4, capacity): light, and its derivatives by x, y and z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, IN_PLACE, njit
from lfpiv_cli.particles.micro_images import (
    AWAY,
    DOWN,
    DRIFT,
    LEAN,
    LONGEST,
    MOVED,
    OFFSET,
    PATCH,
    SHOWN,
    STRIDE,
    TABLE_SIZE,
    Curved,
    Four,
    Plane,
    fill_profile,
    join_curved_row,
    join_row,
    set_furthest,
    take_row,
)
from lfpiv_cli.particles.pencil import in_row
from lfpiv_cli.particles.refraction import Bend, is_seen, largest_displacement
from lfpiv_cli.particles.response import (
    Along,
    Bent,
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


class Scratch(NamedTuple):
    """Room for what a block of lenses shows.

    Attributes
    ----------
    table : of `micro_images`
    per_drift : (2,) of `join_row`
    lines : (6, STRIDE) of each column and row of the table, see `PLACE`
    lenses : of each block, see `respond_rows`
    """

    table: Singles
    per_drift: Singles
    lines: NDArray[np.int64]
    lenses: NDArray[np.int64]


# In a block's lines: a column's place on the sensor, and the earlier one in the same place or -1; the same of rows; the
# first entry of a row, and its first column.
PLACE, TWIN = (0, 2), (1, 3)
ENTRY, LOW = 4, 5
# Lenses share profiles where that moves a profile by less than this share of the ball's radius: at second order up to
# 3e-3 of the light is elsewhere then, which moves places by 30 nm. What bent rays move profiles by is alike in all
# lenses of a column or a row, but for a third of it.
SHARED, BENT_UNLIKE = 0.05, 1.0 / 3.0
# Numbers that are no part of a type: for plain ones functions are compiled once each.
AXES = np.int64(0), np.int64(1), np.int64(2)
# Lenses on their own, see `_shared`.
ON_THEIR_OWN = np.int64(1), 0.0


class Entries(NamedTuple):
    """What is written, see `respond_rows`, and the room to work it out."""

    pixels: NDArray[np.int32]
    values: Singles
    room: Scratch


class Block(NamedTuple):
    """Lenses that share profiles.

    Attributes
    ----------
    i, j, columns, rows : the first, and how many along i and j
    more_mm : by how much profiles are moved at most
    alone : whether it has all lenses
    """

    i: int
    j: int
    columns: int
    rows: int
    more_mm: float
    alone: bool


@njit(cache=True)
def scratch(capacity: int) -> Scratch:
    """Return the room for so many entries."""
    table, per_drift = np.zeros(TABLE_SIZE, np.float32), np.zeros(2, np.float32)
    return Scratch(table, per_drift, np.zeros((6, STRIDE), np.int64), np.empty((capacity + 1, 5), np.int64))


@njit(**IN_PLACE)
def respond_rows(view: View, bend: Bend, pixels: NDArray[np.int32], values: Singles, room: Scratch) -> int:
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
    lenses = lenses_of(view, projection, bend)
    low_i, high_i, low_j, high_j = lenses
    side, more_mm = _shared(view, projection, bend, (high_i + low_i) // 2, (high_j + low_j) // 2)
    count = _write_blocks(view, projection, bend, lenses, (side, more_mm), entries)
    return count if count >= 0 else _write_blocks(view, projection, bend, lenses, ON_THEIR_OWN, entries)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _write_blocks(
    view: View,
    projection: Projection,
    bend: Bend,
    lenses: tuple[int, int, int, int],
    shared: tuple[int, float],
    entries: Entries,
) -> int:
    """Write the entries of some lenses, block by block; return their number.

    Where pixels are lit through two lenses of one block of several, their order is lost, by which those that other
    blocks light as well are found: -1.

    Parameters
    ----------
    lenses : the first and the last along i and along j
    shared : see `_shared`
    """
    (low_i, high_i, low_j, high_j), (side, more_mm), (pixels, values, room) = lenses, shared, entries
    # Of each block: end of its entries, first and last row, first and last column.
    ends = room.lenses
    ends[0, 0] = 0
    shown = 0
    for j in range(low_j, high_j + 1, side):
        for i in range(low_i, high_i + 1, side):
            begin = ends[shown, 0]
            if view.cell_table.shape[0] > 0:
                lens = (view.centres_mm[j, i, 0], view.centres_mm[j, i, 1])
                count = join_cell(view, projection, bend, lens, pixels[begin:], values.T[begin:])
                _set_rectangle(pixels[begin : begin + count], view.camera.columns, ends[shown + 1])
            else:
                alone = high_i - low_i < side and high_j - low_j < side
                block = Block(i, j, min(side, high_i + 1 - i), min(side, high_j + 1 - j), more_mm, alone)
                count = _write_block(view, projection, bend, block, begin, entries, ends[shown + 1])
            if count < 0:
                return -1
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


@njit(**IN_PLACE)
def _shared(view: View, projection: Projection, bend: Bend, i: int, j: int) -> tuple[int, float]:
    """Return how many lenses along a side of a block share profiles, and what moves these by how much at most, mm.

    Lenses that are not in line, by how much those next to lens (i, j) are not, and bent rays do; and cells that lean.
    """
    if view.cell_table.shape[0] > 0 or bend.cubic.shape[0] > 0:
        return 1, 0.0
    centres, x, y = view.centres_mm, projection.x, projection.y
    i, j = min(i, centres.shape[1] - 2), min(j, centres.shape[0] - 2)
    drift = max(abs(centres[j + 1, i, 0] - centres[j, i, 0]), abs(centres[j, i + 1, 1] - centres[j, i, 1]))
    bent = view.camera.image_distance_mm * largest_displacement(bend, view.camera.aperture_radius_mm)
    leaning = max(abs(view.lean_x) * y.half, abs(view.lean_y) * x.half)
    within = SHARED * min(x.radius, y.radius) - BENT_UNLIKE * bent - leaning
    if within < 0.0:
        return 1, 0.0
    # Pixels of one lens along a line at most.
    lit = 2
    for along in (x, y):
        gain = max(along.stretch * abs(along.alpha), 1e-12)
        crossed = min(view.camera.aperture_radius_mm, (along.half + along.radius + within) / gain)
        lit = max(lit, int(2.0 * crossed * abs(along.scale) / view.camera.pixel_mm) + 2)
    side = min(int(2.0 * within / max(drift, 1e-12)) + 1, max(LONGEST // lit, 1))
    return side, (bent + 0.5 * (side - 1) * drift) if side > 1 else 0.0


@njit(**IN_PLACE)
def _norm(view: View, projection: Projection) -> float:
    """Return the light of a whole patch that sees the whole ball."""
    width = mean_width(view, projection)
    return float(width * width / (np.pi * view.camera.aperture_radius_mm**2))


@njit(**IN_PLACE)
def _plane(view: View, projection: Projection, bend: Bend) -> Plane:
    """Return what the pixels of a particle behind plane faces follow from; without bends where rays are straight."""
    single, x, nodes, factors = np.float32, projection.x, bend.nodes, bend.factors
    ratio, bent = x.lever / x.scale, nodes.size > 0
    return Plane(
        single(ratio * x.beta),
        single(x.x),
        single(projection.y.x),
        single(ratio * x.slope),
        single(_norm(view, projection)),
        single(-2.0 * ratio * x.slope),
        single(bend.x),
        single(bend.y),
        single(bend.seen_x),
        single(bend.seen_y),
        single(1.0 / bend.distance_x),
        single(nodes[0] if bent else 0.0),
        single(nodes[1] if bent else 0.0),
        single(nodes[2] if bent else 0.0),
        single(nodes[3] if bent else 0.0),
        single(factors[0] if bent else 0.0),
        single(factors[1] if bent else 0.0),
        single(factors[2] if bent else 0.0),
        single(factors[3] if bent else 0.0),
        single(factors[4] if bent else 0.0),
        single(view.camera.image_distance_mm * x.stretch / _by_place(x, x.stretch * x.alpha) if bent else 0.0),
        single(view.lean_x),
        single(view.lean_y),
        single(_turn(x, x.stretch * x.alpha) / _by_place(x, x.stretch * x.alpha)),
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def _curved(view: View, projection: Projection, bend: Bend, bent: Bent) -> Curved:
    """Return what the pixels of a lens, bent by so much, of a particle behind curved faces follow from."""
    single, (x, y), far = np.float32, projection, view.camera.image_distance_mm
    ratio_x, ratio_y = x.lever / x.scale, y.lever / y.scale
    gain_x, gain_y = x.stretch * x.alpha + bent.gain_x, y.stretch * y.alpha + bent.gain_y
    by_x, by_y = _by_place(x, gain_x), _by_place(y, gain_y)
    return Curved(
        single(x.x),
        single(y.x),
        single(ratio_x * x.beta),
        single(ratio_x * x.slope),
        single(-ratio_x * x.slope),
        single(ratio_y * y.beta),
        single(ratio_y * y.slope),
        single(-ratio_y * y.slope),
        single(_norm(view, projection)),
        (_moves(view, bend, AXES[0]), _moves(view, bend, AXES[1]), _moves(view, bend, AXES[2])),
        single(far * x.stretch / by_x),
        single(far * y.stretch / by_y),
        single(bent.x / by_x),
        single(bent.y / by_y),
        single(view.lean_x),
        single(view.lean_y),
        single(_turn(x, gain_x) / by_x),
        single(_turn(y, gain_y) / by_y),
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def _moves(view: View, bend: Bend, axis: int) -> Four:
    """Return `seen_moves` in single precision."""
    x, y, deep_x, deep_y = seen_moves(view, bend, axis)
    return np.float32(x), np.float32(y), np.float32(deep_x), np.float32(deep_y)


@njit(**IN_PLACE)
def _write_block(
    view: View,
    projection: Projection,
    bend: Bend,
    block: Block,
    begin: int,
    entries: Entries,
    rectangle: NDArray[np.int64],
) -> int:
    """Write the entries of a block of lenses with rectangular cells from `begin` on; return their number.

    -1 where the block is not alone and two of its lenses light a pixel. Sets the rectangle of pixels that they lie in:
    first and last row, first and last column, from the second number on.
    """
    camera, room, x, y = view.camera, entries.room, projection.x, projection.y
    middle = view.centres_mm[block.j + block.rows // 2, block.i + block.columns // 2]
    bent = bent_at(view, projection, bend, middle[0], middle[1])
    columns = _line_up(view, projection, (bend, bent), block, AXES[0], room)
    if columns == 0:
        return 0
    _set_away(room, columns)
    if block.alone:
        _order_columns(room, columns, mean_width(view, projection))
    set_furthest(room.table, columns)
    rows = _line_up(view, projection, (bend, bent), block, AXES[1], room)
    if rows == 0:
        return 0
    if not block.alone and (_has_twins(room, AXES[0], columns) or _has_twins(room, AXES[1], rows)):
        return -1
    _fill(view, x, x.stretch * x.alpha + bent.gain_x, columns, room.table)
    _fill(view, y, y.stretch * y.alpha + bent.gain_y, rows, room.table[DOWN:])
    for k in range(2):
        along = x if k == 0 else y
        # With a lens that stands further along its image does.
        room.per_drift[k] = -(1.0 - camera.bend) / along.scale
    return _write_rows(view, projection, (bend, bent), (rows, columns), begin, entries, rectangle)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _by_place(along: Along, gain: float) -> float:
    """Return how what a lens is off the ball, as a pixel sees it, changes with the ball's place."""
    return along.beta * (gain * along.lever / along.scale - along.stretch)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _turn(along: Along, gain: float) -> float:
    """Return how what a lens is off the ball, as a pixel sees it, changes with the ball's depth, of (X - x)."""
    return along.slope * (along.stretch - gain * along.lever / along.scale)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _line_up(
    view: View, projection: Projection, rays: tuple[Bend, Bent], block: Block, axis: int, room: Scratch
) -> int:
    """Put the lit pixels of a block's lenses side by side along an axis, 0 for x; return their number.

    `rays` are the particle's, and what they are moved by through the middle lens. Sets the patches, offsets and drifts
    of a profile, and the lines' places.
    """
    camera, centres = view.camera, view.centres_mm
    along = projection.x if axis == 0 else projection.y
    table, places, twins = room.table[DOWN * axis :], room.lines[PLACE[axis]], room.lines[TWIN[axis]]
    middle_i, middle_j = block.i + block.columns // 2, block.j + block.rows // 2
    middle = centres[middle_j, middle_i, 1 - axis]
    by_place = _by_place(along, along.stretch * along.alpha)
    # Along the other axis a lens is further off the ball where it stands further, and its cell's sides where they lean.
    other, lean = (projection.y, view.lean_y) if axis == 0 else (projection.x, view.lean_x)
    leaning = abs(view.lean_x if axis == 0 else view.lean_y) * other.half
    other_gain = other.stretch * other.alpha + (rays[1].gain_y if axis == 0 else rays[1].gain_x)
    per_mm = 1.0 / _by_place(other, other_gain)
    per_drift = -(1.0 + other_gain * (1.0 - camera.bend) / other.scale) * per_mm
    count = 0
    for n in range(block.columns if axis == 0 else block.rows):
        i, j = (block.i + n, middle_j) if axis == 0 else (middle_i, block.j + n)
        s = centres[j, i, axis]
        bent = rays[1]
        if i != middle_i or j != middle_j:
            bent = bent_at(view, projection, rays[0], centres[j, i, 0], centres[j, i, 1])
        moved, gain = (bent.x, bent.gain_x) if axis == 0 else (bent.y, bent.gain_y)
        offset, gain = along.at + moved - s, along.stretch * along.alpha + gain
        shift = (1.0 - camera.bend) * s - along.lever * along.beta * along.x
        reach = along.half + along.radius + block.more_mm + leaning
        first, number = lit_pixels(view, gain, offset, reach, along.scale, shift, along.pixels)
        earlier = count - 1
        for place in range(first, first + min(number, LONGEST - count)):
            table[PATCH + count] = ((place + 0.5 - 0.5 * along.pixels) * camera.pixel_mm - shift) / along.scale
            drift = centres[j, i, 1 - axis] - middle
            table[OFFSET + count], table[DRIFT + count] = offset, drift
            table[LEAN + count] = per_drift * drift + lean * per_mm * (offset + gain * table[PATCH + count])
            table[MOVED + count] = moved / by_place
            places[count], twins[count] = place, -1
            before = earlier
            while before >= 0 and places[before] > place:
                before -= 1
            if before >= 0 and places[before] == place:
                twins[count] = before if twins[before] < 0 else twins[before]
            count += 1
    return count


@njit(cache=True, **COUNT_NO_REFERENCES)
def _has_twins(room: Scratch, axis: int, count: int) -> bool:
    """Return whether two lenses of a block light a pixel along an axis."""
    twice = False
    for n in range(count):
        twice = twice or room.lines[TWIN[axis], n] >= 0
    return twice


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_away(room: Scratch, columns: int) -> None:
    """Set how far from the axis the patches of columns lie, or those of their twins where these are nearer."""
    table, twins = room.table, room.lines[TWIN[0]]
    for n in range(columns):
        table[AWAY + n] = abs(table[PATCH + n])
        if twins[n] >= 0:
            table[AWAY + twins[n]] = min(table[AWAY + n], table[AWAY + twins[n]])
    for n in range(columns):
        if twins[n] >= 0:
            table[AWAY + n] = table[AWAY + twins[n]]


@njit(cache=True, **COUNT_NO_REFERENCES)
def _order_columns(room: Scratch, columns: int, width: float) -> None:
    """Order columns by how far from the axis their patches, of this width, lie, to a quarter of a patch; twins stay so.

    Of a row of pixels those that the main lens's rim cuts off come last then, those that it touches before them, and
    all others stand side by side.
    """
    table, lines = room.table, room.lines
    starts, targets, places, twins = lines[ENTRY], lines[LOW], lines[PLACE[1]], lines[TWIN[1]]
    per = 4.0 / width
    for n in range(STRIDE):
        starts[n] = 0
    for n in range(columns):
        places[n], twins[n] = lines[PLACE[0], n], lines[TWIN[0], n]
        starts[min(int(table[AWAY + n] * per) + 1, STRIDE - 1)] += 1
    for n in range(1, STRIDE):
        starts[n] += starts[n - 1]
    for n in range(columns):
        step = min(int(table[AWAY + n] * per), STRIDE - 2)
        targets[n] = starts[step]
        starts[step] += 1
    for k in range(6):
        for n in range(columns):
            table[n] = table[PATCH + k * STRIDE + n]
        for n in range(columns):
            table[PATCH + k * STRIDE + targets[n]] = table[n]
    for n in range(columns):
        lines[PLACE[0], targets[n]] = places[n]
        lines[TWIN[0], targets[n]] = targets[twins[n]] if twins[n] >= 0 else -1


@njit(cache=True, **COUNT_NO_REFERENCES)
def _fill(view: View, along: Along, gain: float, count: int, out: Singles) -> None:
    """Fill the profile of lenses along an axis; what the array is off by grows by `gain` with X."""
    ratio = along.lever / along.scale
    numbers = (
        np.float32(abs(view.camera.pixel_mm / along.scale)),
        np.float32(gain),
        np.float32(_by_place(along, gain)),
        np.float32(along.x),
        np.float32(_turn(along, gain)),
        np.float32(along.half),
        np.float32(1.0 / along.radius),
        np.float32(along.growth),
        np.float32(ratio * along.beta * along.ball),
    )
    fill_profile(out, count, numbers)


@njit(**IN_PLACE)
def _write_rows(
    view: View,
    projection: Projection,
    rays: tuple[Bend, Bent],
    lit: tuple[int, int],
    begin: int,
    entries: Entries,
    rectangle: NDArray[np.int64],
) -> int:
    """Write the entries of a block whose profiles are known, row by row; see `_write_block`.

    Parameters
    ----------
    rays : of the particle, and what they are moved by through the middle lens
    lit : the numbers of rows and of columns
    """
    camera, (pixels, values, room), (x, y), (bend, bent) = view.camera, entries, projection, rays
    (rows, columns), table, lines, per_drift = lit, room.table, room.lines, room.per_drift
    radius, width = camera.aperture_radius_mm, mean_width(view, projection)
    # Further from the axis, wherever its lens stands, a patch is that the rim does not touch from outside.
    drifts = _drifts(table, columns, rows, per_drift)
    outside = (radius + 0.71 * width + drifts) ** 2
    # Of patches that the rim, with its sagitta, does not touch, from wherever the edge of the ball is seen.
    away = np.hypot(x.lever * x.beta * x.ball / x.scale, y.lever * y.beta * y.ball / y.scale)
    inside = max(radius - 0.75 * width - away - drifts, 0.0) ** 2
    rim = np.float32(width), np.float32(radius), np.float32(inside)
    curved = bend.cubic.shape[0] > 0
    if curved:
        of_curved = _curved(view, projection, bend, bent)
    else:
        of_plane = _plane(view, projection, bend)
    at, twice_lit = begin, _has_twins(room, AXES[0], columns)
    rectangle[1], rectangle[2], rectangle[3], rectangle[4] = camera.rows, -1, camera.columns, -1
    for m in range(rows):
        low, high = _columns_within(table, columns, outside - table[DOWN + PATCH + m] ** 2)
        lines[ENTRY, m], lines[LOW, m] = at, low
        if low >= high or at + high - low > pixels.size:
            lines[LOW, m] = columns
            continue
        chosen = (low, high - low)
        if curved:
            slopes = _slopes(view, projection, bend.cubic, bent, table[DOWN + PATCH + m])
            join_curved_row(table, chosen, m, rim, per_drift, of_curved, slopes)
        else:
            join_row(table, chosen, m, rim, per_drift, of_plane)
        if twice_lit:
            _join_twin_columns(table, lines[TWIN[0]], low, high)
        row = lines[PLACE[1], m]
        take_row(table, chosen, (at, lines[PLACE[0]], row * camera.columns), pixels, values)
        at += high - low
        for earlier in range(lines[TWIN[1], m], m if lines[TWIN[1], m] >= 0 else -1):
            if lines[PLACE[1], earlier] == row:
                _join_twin_rows(lines, (earlier, lines[ENTRY, earlier + 1]), (m, at), values)
        rectangle[1], rectangle[2] = min(rectangle[1], row), max(rectangle[2], row)
        rectangle[3], rectangle[4] = min(rectangle[3], lines[0, low]), max(rectangle[4], lines[0, high - 1])
    return at - begin


@njit(cache=True, **COUNT_NO_REFERENCES)
def _slopes(view: View, projection: Projection, cubic: Floats, bent: Bent, y: float) -> tuple[Four, Four]:
    """Return the cubics of X that a row has, without the tangents that profiles follow already."""
    far, single = view.camera.image_distance_mm, np.float32
    rise_x, rise_y = bent.gain_x / (projection.x.stretch * far), bent.gain_y / (projection.y.stretch * far)
    a0, a1, a2, a3 = in_row(cubic[0], y)
    b0, b1, b2, b3 = in_row(cubic[1], y)
    return (
        (single(a0), single(a1 - rise_x), single(a2), single(a3)),
        (single(b0 - rise_y * y), single(b1), single(b2), single(b3)),
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def _join_twin_columns(table: Singles, twins: NDArray[np.int64], low: int, high: int) -> None:
    """Move what some columns show to earlier ones in the same places."""
    for n in range(low, high):
        if low <= twins[n] < high:
            for k in range(4):
                at = SHOWN + k * STRIDE
                table[at + twins[n]] += table[at + n]
                table[at + n] = 0.0


@njit(cache=True, **COUNT_NO_REFERENCES)
def _join_twin_rows(lines: NDArray[np.int64], one: tuple[int, int], other: tuple[int, int], values: Singles) -> None:
    """Move what a row's entries have to those of an earlier row in the same place: each a row, and its entries' end."""
    a, b = lines[ENTRY, one[0]] - lines[LOW, one[0]], lines[ENTRY, other[0]] - lines[LOW, other[0]]
    for n in range(max(lines[LOW, one[0]], lines[LOW, other[0]]), min(one[1] - a, other[1] - b)):
        for k in range(values.shape[0]):
            values[k, a + n] += values[k, b + n]
            values[k, b + n] = np.float32(0.0)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _drifts(table: Singles, columns: int, rows: int, per_drift: Singles) -> float:
    """Return by how much patches of a block may lie elsewhere than their column and their row have them."""
    across = down = np.float32(0.0)
    for n in range(columns):
        down = max(down, abs(per_drift[1] * table[DRIFT + n]))
    for m in range(rows):
        across = max(across, abs(per_drift[0] * table[DOWN + DRIFT + m]))
    return float(across + down)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _columns_within(table: Singles, columns: int, square: float) -> tuple[int, int]:
    """Return the first column whose patch is nearer to the axis than the root of `square`, and behind the last one."""
    low, high = 0, columns
    while low < high and table[AWAY + low] * table[AWAY + low] >= square:
        low += 1
    while high > low and table[AWAY + high - 1] * table[AWAY + high - 1] >= square:
        high -= 1
    return low, high


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
def _join_twice_lit(one: tuple[int, int], other: tuple[int, int], pixels: NDArray[np.int32], values: Singles) -> None:
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
