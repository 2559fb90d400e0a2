"""What one lens shows of a glowing ball, written for the vector unit: neighbouring pixels of a row at once.

`particles.response` has the same formulas for a pixel at a time. Arrays are flat float64, the rows of a table `STRIDE`
apart; more than is asked for is written, up to a whole register.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.types.containers import UniTuple
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
    DOUBLES,
    Lanes,
    any_above,
    at_least,
    at_most,
    counted_from,
    gather,
    groups_of_lanes,
    in_place_of,
    index,
    integers,
    integers_in_lanes,
    lanes,
    load_lanes,
    load_one,
    pointers,
    root,
    store_count,
    store_lanes,
    where_above,
    whole_part,
)

Doubles = NDArray[np.float64]

# Pixels of a row that one lens may show, and the widest register.
LONGEST = 96
STRIDE = LONGEST + 8
# Three-point Gauss-Legendre on (-1, 1): exact for the cubic profile wherever it has no kink within the patch.
GAUSS_AT = float(np.sqrt(0.6))
GAUSS_WEIGHT = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)
# Rows of a profile's table: mean and slope of the share P of the ball that is seen, their derivatives by x and by z,
# the patch's middle, and where what is seen of the ball is seen from.
MEAN, SLOPE, MEAN_X, SLOPE_X, MEAN_Z, SLOPE_Z, PATCH, SEEN_FROM = range(8)
PROFILE_ROWS = 8
# Of a ball; what sees less sees nothing.
SMALLEST_SHARE = 1e-9
# Of areas that divide, mm^2: a patch on the axis.
TINY = 1e-12


class ProfileNumbers(NamedTuple):
    """What the profile of one lens along one axis follows from; each a number, or `Lanes` of it.

    Attributes
    ----------
    first, step, width : the first patch's middle on the main lens, the step to the next, and their width
    offset, gain : a crossing X of the main lens meets the array at offset + gain X from the lens
    by_x : what a point on the array moves by with x
    x, turn : with z by turn (X - x)
    half, per_radius, growth : half the cell, 1/radius of the ball on the array, its relative change with z
    away : by how many X the ball's edge is seen from elsewhere than its middle
    """

    first: Any
    step: Any
    width: Any
    offset: Any
    gain: Any
    by_x: Any
    x: Any
    turn: Any
    half: Any
    per_radius: Any
    growth: Any
    away: Any


class JoinNumbers(NamedTuple):
    """What the pixels of one lens follow from beside its profiles; each a number, or `Lanes` of it.

    Attributes
    ----------
    place_x, x, y, tilt : the place on the main lens that a pixel sees moves by place_x with x and y, and by
        tilt (x - X) with z
    norm, widen : light of a whole patch that sees the whole ball, and its relative change with z
    true_x, true_y, seen_x, seen_y, per_distance : of bent rays, see `refraction.Bend`
    node_0 ... factor_4 : of the polynomial of their slopes
    more_x, more_y : what a profile changes by with these rays' slopes, over its derivative by x and y
    bent_x, bent_y : the same for what the profile was moved by already
    """

    place_x: Any
    x: Any
    y: Any
    tilt: Any
    norm: Any
    widen: Any
    true_x: Any
    true_y: Any
    seen_x: Any
    seen_y: Any
    per_distance: Any
    node_0: Any
    node_1: Any
    node_2: Any
    node_3: Any
    factor_0: Any
    factor_1: Any
    factor_2: Any
    factor_3: Any
    factor_4: Any
    more_x: Any
    more_y: Any
    bent_x: Any
    bent_y: Any


class RimNumbers(NamedTuple):
    """What the rim leaves of a patch follows from; each a number, or `Lanes` of it.

    Attributes
    ----------
    radius : of the main lens
    width, per_width : of a patch, and 1/width
    distances, directions : steps of the table to a patch's width, and to a quadrant times the width
    middle : of the table's distances, in steps: the rim itself
    last_distance, last_direction : places just before the last entries
    inside : square of how far from the axis patches are whole
    """

    radius: Any
    width: Any
    per_width: Any
    distances: Any
    directions: Any
    middle: Any
    last_distance: Any
    last_direction: Any
    inside: Any


class CurvedNumbers(NamedTuple):
    """What the pixels of one lens follow from behind curved faces; each a number, or `Lanes` of it.

    Attributes
    ----------
    x, y : the place in air
    place_x, tilt_x, widen_x : the place on the main lens that a pixel sees moves by place_x with x, and by tilt_x (x -
        X) with the depth that is seen along x; what light of a whole patch changes by with that depth
    place_y, tilt_y, widen_y : the same along y
    norm : light of a whole patch that sees the whole ball
    x_by_x ... depth_y_by_z : how the place in air and its two depths move with x, y and z
    cubic_x_0 ... cubic_y_3 : what rays' slopes differ by from straight ones', in a row: cubics of X
    more_x, more_y, bent_x, bent_y : see `JoinNumbers`
    """

    x: Any
    y: Any
    place_x: Any
    tilt_x: Any
    widen_x: Any
    place_y: Any
    tilt_y: Any
    widen_y: Any
    norm: Any
    x_by_x: Any
    y_by_x: Any
    depth_x_by_x: Any
    depth_y_by_x: Any
    x_by_y: Any
    y_by_y: Any
    depth_x_by_y: Any
    depth_y_by_y: Any
    x_by_z: Any
    y_by_z: Any
    depth_x_by_z: Any
    depth_y_by_z: Any
    cubic_x_0: Any
    cubic_x_1: Any
    cubic_x_2: Any
    cubic_x_3: Any
    cubic_y_0: Any
    cubic_y_1: Any
    cubic_y_2: Any
    cubic_y_3: Any
    more_x: Any
    more_y: Any
    bent_x: Any
    bent_y: Any


JOIN_NUMBERS = len(JoinNumbers._fields)
CURVED_NUMBERS = len(CurvedNumbers._fields)
# Where the numbers that a row has of its own begin.
OF_CUBIC = CurvedNumbers._fields.index("cubic_x_0")
# What the rim leaves of patches: covered share, means of xi and eta, slopes of the share. Of whole ones first, then of
# those of a row.
RIM_ROWS = 5
WHOLE, OF_ROW = 0, RIM_ROWS * STRIDE
WHOLE_PATCH = (1.0, 0.0, 0.0, 0.0, 0.0)


def _profile(k: Any, c: ProfileNumbers) -> tuple[Any, ...]:
    """Return the rows of a profile in column k; see `response._profile`."""
    middle = c.first + c.step * k
    rows: list[Any] = [0.0] * PATCH
    moment = 0.0
    for xi, weight in zip((-GAUSS_AT, 0.0, GAUSS_AT), GAUSS_WEIGHT, strict=True):
        place = middle + 0.5 * xi * c.width
        u = c.offset + c.gain * place
        upper, lower = _clipped((u + c.half) * c.per_radius), _clipped((u - c.half) * c.per_radius)
        upper2, lower2 = upper * upper, lower * lower
        share = 0.25 * (upper * (3.0 - upper2) - lower * (3.0 - lower2))
        dense_upper, dense_lower = 0.75 - 0.75 * upper2, 0.75 - 0.75 * lower2
        by_u = (dense_upper - dense_lower) * c.per_radius
        by_z = by_u * (place - c.x) * c.turn - (dense_upper * upper - dense_lower * lower) * c.growth
        moment = moment + 0.1875 * weight * (upper2 * (2.0 - upper2) - lower2 * (2.0 - lower2))
        for row, value in ((MEAN, share), (MEAN_X, by_u * c.by_x), (MEAN_Z, by_z)):
            rows[row] = rows[row] + weight * value
            if xi != 0.0:
                rows[row + 1] = rows[row + 1] + 3.0 * weight * xi * value
    return *rows, middle, middle + c.away * moment / at_least(rows[MEAN], SMALLEST_SHARE)


def _clipped(t: Any) -> Any:
    """Return a place along an axis of a ball of radius 1, or its nearer end."""
    return at_most(at_least(t, -1.0), 1.0)


def _covered(x: Any, y: Any, c: RimNumbers, corners: Sequence[Any], place: RimPlace) -> tuple[Any, ...]:
    """Return what the rim leaves of a patch between four entries of the table; see `cells.covered_share`."""
    p, q = place.p, place.q
    ka, kb, kc, kd = (1.0 - p) * (1.0 - q), p * (1.0 - q), (1.0 - p) * q, p * q
    share, mean_x, mean_y = (
        ka * corners[n] + kb * corners[n + 3] + kc * corners[n + 6] + kd * corners[n + 9] for n in range(3)
    )
    outwards = ((1.0 - q) * (corners[3] - corners[0]) + q * (corners[9] - corners[6])) * place.outwards
    turning = ((1.0 - p) * (corners[6] - corners[0]) + p * (corners[9] - corners[3])) * place.turning
    # Of the first quadrant; the others are its mirror images.
    left, above = where_above(0.0 - x, 0.0, -1.0, 1.0), where_above(0.0 - y, 0.0, -1.0, 1.0)
    right, down = left * x, above * y
    slope_x, slope_y = outwards * right - turning * down, outwards * down + turning * right
    return share, left * mean_x, above * mean_y, left * slope_x, above * slope_y


class RimPlace(NamedTuple):
    """Where in the rim's table a patch is found, and what it moves by there; each a number, or `Lanes` of it.

    Attributes
    ----------
    p, q : along distances and directions, in steps
    outwards, turning : distances change by `outwards` x with x, directions by `turning` x with y
    """

    p: Any
    q: Any
    outwards: Any
    turning: Any


def _place(x: Any, y: Any, c: RimNumbers) -> RimPlace:
    """Return where in the rim's table a patch is found: what counts is how many of its widths it is from the rim."""
    right, down = (where_above(one, 0.0, one, 0.0 - one) for one in (x, y))
    away, around = root(x * x + y * y), right + down
    # One division: widths over both.
    per = c.per_width / at_least(away * around, TINY)
    per_away, per_around = per * around, per * away
    p = (away - c.radius) * c.per_width * c.distances + c.middle
    q = down * per_around * c.directions
    return RimPlace(
        at_most(at_least(p, 0.0), c.last_distance),
        at_most(q, c.last_direction),
        per_away * c.distances,
        per_around * per_around * c.directions * c.width,
    )


def _join(x: Sequence[Any], y: Sequence[Any], rim: Sequence[Any], c: JoinNumbers) -> tuple[Any, Any, Any, Any]:
    """Return light and derivatives of a pixel from its column's and its row's profile; see `response._join`."""
    h0, h1, h0_x, h1_x, h0_z, h1_z, patch_x = x
    v0, v1, v0_y, v1_y, v0_z, v1_z, patch_y = y
    share, mean_x, mean_y, share_x, share_y = rim
    whole = h0 * v0
    # Profiles with what the rim leaves of their slopes.
    across, down = share * h0 + mean_x * h1, share * v0 + mean_y * v1
    light = across * v0 + mean_y * (h0 * v1)
    by_x = h0_x * down + mean_x * (h1_x * v0) + share_x * (c.place_x * whole)
    by_y = v0_y * across + mean_y * (h0 * v1_y) + share_y * (c.place_x * whole)
    by_z = h0_z * down + v0_z * across + mean_x * (h1_z * v0) + mean_y * (h0 * v1_z)
    by_z = by_z + (share_x * (c.x - patch_x) + share_y * (c.y - patch_y)) * (c.tilt * whole)
    dx, dy = patch_x - c.true_x, patch_y - c.true_y
    d2 = dx * dx + dy * dy
    slope = c.factor_3 + (d2 - c.node_3) * c.factor_4
    for factor, node in ((c.factor_2, c.node_2), (c.factor_1, c.node_1), (c.factor_0, c.node_0)):
        slope = factor + (d2 - node) * slope
    more_x = c.more_x * (slope * dx - (patch_x - c.seen_x) * c.per_distance) - c.bent_x
    more_y = c.more_y * (slope * dy - (patch_y - c.seen_y) * c.per_distance) - c.bent_y
    light = light + by_x * more_x + by_y * more_y
    return c.norm * light, c.norm * by_x, c.norm * by_y, c.norm * (by_z + c.widen * light)


def _join_curved(x: Sequence[Any], y: Sequence[Any], rim: Sequence[Any], c: CurvedNumbers) -> tuple[Any, Any, Any, Any]:
    """Return light and derivatives of a pixel behind curved faces; see `response._join`."""
    h0, h1, h0_x, h1_x, h0_z, h1_z, patch_x = x
    v0, v1, v0_y, v1_y, v0_z, v1_z, patch_y = y
    share, mean_x, mean_y, share_x, share_y = rim
    # Profiles with what the rim leaves of their slopes.
    across, down = share * h0 + mean_x * h1, share * v0 + mean_y * v1
    by_share_x, by_share_y = share_x * (h0 * v0), share_y * (h0 * v0)
    light = across * v0 + mean_y * (h0 * v1)
    by_x = h0_x * down + mean_x * (h1_x * v0) + by_share_x * c.place_x
    by_y = v0_y * across + mean_y * (h0 * v1_y) + by_share_y * c.place_y
    more_x = c.cubic_x_0 + patch_x * (c.cubic_x_1 + patch_x * (c.cubic_x_2 + patch_x * c.cubic_x_3))
    more_y = c.cubic_y_0 + patch_x * (c.cubic_y_1 + patch_x * (c.cubic_y_2 + patch_x * c.cubic_y_3))
    light = light + by_x * (c.more_x * more_x - c.bent_x) + by_y * (c.more_y * more_y - c.bent_y)
    by_depth_x = h0_z * down + mean_x * (h1_z * v0) + by_share_x * ((c.x - patch_x) * c.tilt_x) + c.widen_x * light
    by_depth_y = v0_z * across + mean_y * (h0 * v1_z) + by_share_y * ((c.y - patch_y) * c.tilt_y) + c.widen_y * light
    return (
        c.norm * light,
        c.norm * (c.x_by_x * by_x + c.y_by_x * by_y + c.depth_x_by_x * by_depth_x + c.depth_y_by_x * by_depth_y),
        c.norm * (c.x_by_y * by_x + c.y_by_y * by_y + c.depth_x_by_y * by_depth_x + c.depth_y_by_y * by_depth_y),
        c.norm * (c.x_by_z * by_x + c.y_by_z * by_y + c.depth_x_by_z * by_depth_x + c.depth_y_by_z * by_depth_y),
    )


def fill_profile_reference(out: Doubles, count: int, numbers: tuple[float, ...]) -> None:
    """Fill the table of a profile (PROFILE_ROWS, STRIDE), flat, for `count` columns: twin of `fill_profile`."""
    for k in range(count):
        for row, value in enumerate(_profile(k, ProfileNumbers(*numbers))):
            out[row * STRIDE + k] = value


@in_place_of(fill_profile_reference)
def fill_profile(typing_context: Any, out: Any, count: Any, numbers: Any) -> Any:
    """Fill the table of a profile; see `fill_profile_reference`."""
    known = UniTuple(types.float64, len(ProfileNumbers._fields))
    return types.void(out, types.int64, known), _generate_profile


def _generate_profile(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    (out,) = pointers(context, builder, signature, arguments, (0,))
    members = cgutils.unpack_tuple(builder, arguments[2], len(ProfileNumbers._fields))
    numbers = ProfileNumbers(*(lanes(builder, member) for member in members))
    with groups_of_lanes(builder, arguments[1]) as group:
        first = builder.mul(group.index, index(DOUBLES))
        for row, value in enumerate(_profile(counted_from(builder, first), numbers)):
            store_lanes(builder, value, out, builder.add(first, index(row * STRIDE)))
    return context.get_dummy_value()


def cover_row_reference(
    rim: Doubles,
    across: Doubles,
    columns: tuple[int, int],
    down: Doubles,
    row: int,
    table: Doubles,
    numbers: tuple[float, ...],
) -> None:
    """Fill what the rim leaves of the patches of some columns of one row, from `OF_ROW` on: twin of `cover_row`.

    Parameters
    ----------
    rim : two tables (RIM_ROWS, STRIDE), flat, by columns of `across`
    across, columns : profile along x; first column and their number
    down, row : profile along y, its column
    table : see `particles.cells.rim_table`
    numbers : `RimNumbers`
    """
    known = RimNumbers(*numbers)
    for n in range(columns[0], columns[0] + columns[1]):
        x, y = (float(of[SEEN_FROM * STRIDE + k]) for of, k in ((across, n), (down, row)))
        place = _place(x, y, known)
        i, j = int(place.p), int(place.q)
        corners = table[j : j + 2, i : i + 2, :3].ravel().tolist()
        away2 = across[PATCH * STRIDE + n] ** 2 + down[PATCH * STRIDE + row] ** 2
        left = _covered(x, y, known, corners, place._replace(p=place.p - i, q=place.q - j))
        for k, (value, whole) in enumerate(zip(left, WHOLE_PATCH, strict=True)):
            rim[OF_ROW + k * STRIDE + n] = value if away2 > known.inside else whole


@in_place_of(cover_row_reference)
def cover_row(
    typing_context: Any, rim: Any, across: Any, columns: Any, down: Any, row: Any, table: Any, numbers: Any
) -> Any:
    """Fill what the rim leaves of the patches of a row; see `cover_row_reference`."""
    known = UniTuple(types.float64, len(RimNumbers._fields))
    return types.void(rim, across, integers(2), down, types.int64, table, known), _generate_cover


def _generate_cover(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    rim, across, down, table = pointers(context, builder, signature, arguments, (0, 1, 3, 5))
    first, count = cgutils.unpack_tuple(builder, arguments[2], 2)
    members = cgutils.unpack_tuple(builder, arguments[6], len(RimNumbers._fields))
    known = RimNumbers(*(lanes(builder, member) for member in members))
    entries = context.make_array(signature.args[5])(context, builder, arguments[5])
    _, columns, entry = cgutils.unpack_tuple(builder, entries.shape, 3)
    each, lines = (integers_in_lanes(builder, number) for number in (entry, builder.mul(columns, entry)))
    y, patch_y = (
        lanes(builder, load_one(builder, down, builder.add(arguments[4], index(k * STRIDE))))
        for k in (SEEN_FROM, PATCH)
    )
    with groups_of_lanes(builder, count) as group:
        column = builder.add(first, builder.mul(group.index, index(DOUBLES)))
        patch_x = load_lanes(builder, across, builder.add(column, index(PATCH * STRIDE)))
        away2 = patch_x * patch_x + patch_y * patch_y
        to = [builder.add(column, index(OF_ROW + k * STRIDE)) for k in range(RIM_ROWS)]
        with builder.if_else(any_above(away2, known.inside)) as (cut, whole_all):
            with cut:
                x = load_lanes(builder, across, builder.add(column, index(SEEN_FROM * STRIDE)))
                place = _place(x, y, known)
                (whole_p, i), (whole_q, j) = whole_part(place.p), whole_part(place.q)
                corner = builder.add(builder.mul(i, each), builder.mul(j, lines))
                # An entry is shares of three kinds and an empty one.
                read = (gather(builder, table, at, 8) for at in (corner, builder.add(corner, lines)))
                corners = [line[k] for line in read for k in (0, 1, 2, 4, 5, 6)]
                left = _covered(x, y, known, corners, place._replace(p=place.p - whole_p, q=place.q - whole_q))
                for value, whole, at in zip(left, WHOLE_PATCH, to, strict=True):
                    store_lanes(builder, where_above(away2, known.inside, value, whole), rim, at)
            with whole_all:
                for whole, at in zip(WHOLE_PATCH, to, strict=True):
                    store_lanes(builder, lanes(builder, whole), rim, at)
    return context.get_dummy_value()


def join_row_reference(
    pixels: NDArray[np.int32],
    values: Doubles,
    to: tuple[int, int],
    across: Doubles,
    columns: tuple[int, int, int],
    down: Doubles,
    row: int,
    rim: Doubles,
    numbers: Doubles,
) -> None:
    """Write the entries of some columns of one row of a lens: readable twin of `join_row`.

    Parameters
    ----------
    pixels, values, to : values are rows (4, capacity); entries go from the first number of `to` on, and the first of
        them is of the flat pixel that the second names
    across, columns : profile along x; first column, their number, and where what is left of them begins in `rim`:
        `WHOLE` or `OF_ROW`
    down, row : profile along y, its column
    rim : see `cover_row_reference`
    numbers : `JoinNumbers`
    """
    _write_row(_join, JoinNumbers, pixels, values, to, across, columns, down, row, rim, numbers)


def join_curved_row_reference(
    pixels: NDArray[np.int32],
    values: Doubles,
    to: tuple[int, int],
    across: Doubles,
    columns: tuple[int, int, int],
    down: Doubles,
    row: int,
    rim: Doubles,
    numbers: Doubles,
) -> None:
    """Write the entries of one row of a lens behind curved faces: readable twin of `join_curved_row`.

    As `join_row_reference`, but `numbers` : `CurvedNumbers`
    """
    _write_row(_join_curved, CurvedNumbers, pixels, values, to, across, columns, down, row, rim, numbers)


def _write_row(
    join: Callable[..., tuple[Any, Any, Any, Any]],
    kind: type[JoinNumbers | CurvedNumbers],
    pixels: NDArray[np.int32],
    values: Doubles,
    to: tuple[int, int],
    across: Doubles,
    columns: tuple[int, int, int],
    down: Doubles,
    row: int,
    rim: Doubles,
    numbers: Doubles,
) -> None:
    """Write the entries of one row by a formula and the numbers that it takes; see `join_row_reference`."""
    at, pixel = to
    below = [float(down[k * STRIDE + row]) for k in range(PATCH + 1)]
    for n in range(columns[1]):
        column = columns[0] + n
        beside = [float(across[k * STRIDE + column]) for k in range(PATCH + 1)]
        covered = [float(rim[columns[2] + k * STRIDE + column]) for k in range(RIM_ROWS)]
        joined = join(beside, below, covered, kind(*(float(number) for number in numbers[: len(kind._fields)])))
        pixels[at + n] = pixel + n
        for k in range(4):
            values[k, at + n] = where_above(joined[0], 0.0, joined[k], 0.0)


@in_place_of(join_row_reference)
def join_row(
    typing_context: Any,
    pixels: Any,
    values: Any,
    to: Any,
    across: Any,
    columns: Any,
    down: Any,
    row: Any,
    rim: Any,
    numbers: Any,
) -> Any:
    """Write the entries of some columns of one row of a lens; see `join_row_reference`."""
    return types.void(pixels, values, integers(2), across, integers(3), down, types.int64, rim, numbers), _generate_join


@in_place_of(join_curved_row_reference)
def join_curved_row(
    typing_context: Any,
    pixels: Any,
    values: Any,
    to: Any,
    across: Any,
    columns: Any,
    down: Any,
    row: Any,
    rim: Any,
    numbers: Any,
) -> Any:
    """Write the entries of one row of a lens behind curved faces; see `join_curved_row_reference`."""
    arrays = (pixels, values, integers(2), across, integers(3), down, types.int64, rim, numbers)
    return types.void(*arrays), _generate_curved_join


def _generate_join(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    return _generate_row(context, builder, signature, arguments, _join, JoinNumbers)


def _generate_curved_join(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    return _generate_row(context, builder, signature, arguments, _join_curved, CurvedNumbers)


def _generate_row(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any, join: Any, kind: Any) -> Any:
    pixels, values, across, down, rim, numbers = pointers(context, builder, signature, arguments, (0, 1, 3, 5, 7, 8))
    at, pixel = cgutils.unpack_tuple(builder, arguments[2], 2)
    rows = context.make_array(signature.args[1])(context, builder, arguments[1])
    _, step = cgutils.unpack_tuple(builder, rows.shape, 2)
    first, count, left = cgutils.unpack_tuple(builder, arguments[4], 3)

    def everywhere(array: Any, place: Any) -> Lanes:
        return lanes(builder, load_one(builder, array, place))

    below = [everywhere(down, builder.add(arguments[6], index(k * STRIDE))) for k in range(PATCH + 1)]
    known = kind(*(everywhere(numbers, index(k)) for k in range(len(kind._fields))))
    with groups_of_lanes(builder, count) as group:
        done = builder.mul(group.index, index(DOUBLES))
        column = builder.add(first, done)
        beside = [load_lanes(builder, across, builder.add(column, index(k * STRIDE))) for k in range(PATCH + 1)]
        of_rim = builder.add(left, column)
        covered = [load_lanes(builder, rim, builder.add(of_rim, index(k * STRIDE))) for k in range(RIM_ROWS)]
        joined = join(beside, below, covered, known)
        place = builder.add(at, done)
        store_count(builder, builder.add(pixel, done), pixels, place)
        for k, value in enumerate(joined):
            where = builder.add(place, builder.mul(step, index(k)))
            store_lanes(builder, where_above(joined[0], 0.0, value, 0.0), values, where)
    return context.get_dummy_value()
