"""What a block of lenses shows of a glowing ball, eight pixels of a row at once.

`response` has the theory. Lit pixels of all of a block's columns of lenses stand side by side, as do those of its rows:
a *column* below is a column of pixels of one column of lenses. All numbers of a block stand in the rows, `STRIDE` long,
of one flat table, and loops run over `WIDTH` neighbours, so that the compiler makes vector code of them: it need not
ask whether arrays overlap, nor what to do with a rest. More columns than are asked for are filled in therefore, up to a
whole `WIDTH`.

Lenses of a column do not stand exactly above one another where the array is turned. Along x all follow from the
profile in the block's middle row, at second order in how much further along x they stand (the row's `DRIFT`); and
along y from that in its middle column.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Real, Singles
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.particles.cells import HALF, ONE, QUARTER, THREE, TWO, ZERO, covered_share

# Columns that a block may have, and how many are worked on together.
LONGEST, WIDTH = 96, 8
STRIDE = LONGEST + WIDTH
# Three-point Gauss-Legendre on (-1, 1), of each of a patch's parts: exact for the cubic profile wherever it has no kink
# within. Of small balls far from focus a whole patch sees the cell's edge as a step: 6 % of the light was elsewhere of
# one six times as wide as their radius. Parts are as wide as so many radii at most.
GAUSS_AT = tuple(np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)], np.float32))
GAUSS_WEIGHT = tuple(np.array([5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0], np.float32))
WIDEST_PART = 1.0
# Of the ball's marginal density, and of its moment.
DENSE, MOMENT = np.float32(0.75), np.float32(0.1875)
# Rows of a profile: mean and slope of the share P of the ball that is seen, their derivatives by x and by z, those of
# the mean's by x, and where what is seen of the ball is seen from; the patch's middle, by how much the middle of the
# main lens shows the ball off the lens, what the profile was moved by for bent rays, how much further the lens stands
# along the other axis, how far from the axis the patch lies, or its twin (`rows`) where that is nearer, by how much
# profiles along the other axis are moved, over their derivative by x or y, and `set_furthest`.
MEAN, SLOPE, MEAN_X, SLOPE_X, MEAN_Z, SLOPE_Z, MEAN_XX, MEAN_XZ, SEEN_FROM = (row * STRIDE for row in range(9))
PATCH, OFFSET, MOVED, DRIFT, AWAY, LEAN, FURTHEST = (row * STRIDE for row in range(9, 16))
# In the table: the profile along x; of a row of pixels light and its derivatives; the profile along y.
SHOWN, DOWN = 16 * STRIDE, 20 * STRIDE
TABLE_SIZE = 36 * STRIDE
# Of a ball; what sees less sees nothing.
SMALLEST_SHARE = np.float32(1e-9)
# What the rim leaves of a patch that it does not touch: all; see `cells.covered_share`.
WHOLE = (ONE, ZERO, ZERO, ZERO, ZERO)

# Of fastmath nothing but fused products and sums: a kernel is optimised again in each that calls it, and in another
# order its sums would have other last digits. Fits take it by one address.
VECTORISED: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": {"contract"}, **COUNT_NO_REFERENCES}
Four: TypeAlias = tuple[Real, Real, Real, Real]


class Plane(NamedTuple):
    """What pixels follow from beside profiles, of particles behind plane faces; all in single precision.

    Attributes
    ----------
    place, tilt : the place on the main lens that a pixel sees moves by `place` with x and y, and by `tilt` (x - X) with
        z
    own_x, own_y : x and y
    norm, widen : light of a whole patch that sees the whole ball, and its relative change with z
    true_x, ..., per_distance : true x and y, and those seen, of bent rays, and 1/distance, see `refraction.Bend`
    node_0, ..., factor_4 : of the polynomial of their slopes
    more : what a profile changes by with these rays' slopes, over its derivative by x or y
    lean_x, lean_y : of the cell's sides, see `view.View`
    turn : by how much the ball is seen further along x or y with z, of (X - x), over what it is with x
    """

    place: Real
    own_x: Real
    own_y: Real
    tilt: Real
    norm: Real
    widen: Real
    true_x: Real
    true_y: Real
    seen_x: Real
    seen_y: Real
    per_distance: Real
    node_0: Real
    node_1: Real
    node_2: Real
    node_3: Real
    factor_0: Real
    factor_1: Real
    factor_2: Real
    factor_3: Real
    factor_4: Real
    more: Real
    lean_x: Real
    lean_y: Real
    turn: Real


class Curved(NamedTuple):
    """What pixels of a row follow from beside profiles, of particles behind curved faces; all in single precision.

    Attributes
    ----------
    own_x, own_y : the place in air
    place_x, tilt_x, widen_x : along x the place on the main lens that a pixel sees moves by `place_x` with x, and by
        `tilt_x` (x - X) with the depth that is seen along x, and what light of a whole patch changes by with that depth
    place_y, tilt_y, widen_y : the same along y
    norm : light of a whole patch that sees the whole ball
    moves : how the place in air and its two depths move with x, with y and with z
    more_x, more_y, bent_x, bent_y : what a profile changes by with rays' slopes, over its derivative by x or y, and
        what it was moved by already
    lean_x, lean_y : of the cell's sides, see `view.View`
    turn_x, turn_y : of `Plane.turn`, with the depths that are seen along x and along y
    """

    own_x: Real
    own_y: Real
    place_x: Real
    tilt_x: Real
    widen_x: Real
    place_y: Real
    tilt_y: Real
    widen_y: Real
    norm: Real
    moves: tuple[Four, Four, Four]
    more_x: Real
    more_y: Real
    bent_x: Real
    bent_y: Real
    lean_x: Real
    lean_y: Real
    turn_x: Real
    turn_y: Real


@njit(**VECTORISED)
def fill_profile(out: Singles, count: int, numbers: tuple[Real, ...]) -> None:
    """Fill the rows of a profile for `count` columns whose patches and offsets stand there; see `response`.

    Parameters
    ----------
    numbers : the patches' width; a crossing X of the main lens meets the array at offset + gain X from the lens; a
        point there moves by `by_x` with x, and with z by turn (X - x); half the cell, 1/radius of the ball on the
        array, its relative change with z; and by how many X the ball's edge is seen from elsewhere than its middle
    """
    width, gain, by_x, x, turn, half, per_radius, growth, away = numbers
    parts = parts_of(gain * width * per_radius)
    per_part = ONE / np.float32(parts)
    for begin in range(0, count, WIDTH):
        rows = out[begin:]
        for row in range(MEAN, PATCH, STRIDE):
            for n in range(WIDTH):
                rows[row + n] = ZERO
        for part in range(parts):
            left = np.float32(2 * part + 1) * per_part - ONE
            for n in range(WIDTH):
                middle, offset = rows[PATCH + n], rows[OFFSET + n]
                mean = slope = mean_x = slope_x = mean_z = slope_z = mean_xx = mean_xz = moment = ZERO
                for node in range(3):
                    xi, weight = left + per_part * GAUSS_AT[node], per_part * GAUSS_WEIGHT[node]
                    lean = THREE * weight * xi
                    place = middle + HALF * xi * width
                    u = offset + gain * place
                    upper = min(max((u + half) * per_radius, -ONE), ONE)
                    lower = min(max((u - half) * per_radius, -ONE), ONE)
                    upper2, lower2 = upper * upper, lower * lower
                    share = QUARTER * (upper * (THREE - upper2) - lower * (THREE - lower2))
                    dense_upper, dense_lower = DENSE - DENSE * upper2, DENSE - DENSE * lower2
                    # Densities end at the ball's edge, and their slopes.
                    steep_upper = -TWO * DENSE * upper if upper2 < ONE else ZERO
                    steep_lower = -TWO * DENSE * lower if lower2 < ONE else ZERO
                    by_u, by_uu = (
                        (dense_upper - dense_lower) * per_radius,
                        (steep_upper - steep_lower) * per_radius * per_radius,
                    )
                    wider = dense_upper + steep_upper * upper - dense_lower - steep_lower * lower
                    turned = (place - x) * turn
                    by_z = by_u * turned - (dense_upper * upper - dense_lower * lower) * growth
                    by_uz = by_uu * turned - wider * per_radius * growth
                    moment += MOMENT * weight * (upper2 * (TWO - upper2) - lower2 * (TWO - lower2))
                    mean, slope = mean + weight * share, slope + lean * share
                    mean_x, slope_x = mean_x + weight * by_u * by_x, slope_x + lean * by_u * by_x
                    mean_z, slope_z = mean_z + weight * by_z, slope_z + lean * by_z
                    mean_xx, mean_xz = mean_xx + weight * by_uu * by_x * by_x, mean_xz + weight * by_uz * by_x
                rows[MEAN + n] += mean
                rows[SLOPE + n] += slope
                rows[MEAN_XX + n] += mean_xx
                rows[MEAN_XZ + n] += mean_xz
                rows[MEAN_X + n] += mean_x
                rows[SLOPE_X + n] += slope_x
                rows[MEAN_Z + n] += mean_z
                rows[SLOPE_Z + n] += slope_z
                rows[SEEN_FROM + n] += moment
        for n in range(WIDTH):
            rows[SEEN_FROM + n] = rows[PATCH + n] + away * rows[SEEN_FROM + n] / max(rows[MEAN + n], SMALLEST_SHARE)


@njit(**VECTORISED)
def parts_of(side: Real) -> int:
    """Return into how many parts a patch is cut whose side on the array is so many radii of the ball."""
    return max(int(np.ceil(np.abs(side) / WIDEST_PART)), 1)


class Line(NamedTuple):
    """What a row of pixels has for all its columns.

    Attributes
    ----------
    mean, ..., moved : of its profile
    move, across, down : by how much profiles along x are moved, over their derivative by x, and patches are; and how
        much further along y patches lie where a column's lens does
    """

    mean: Real
    slope: Real
    mean_y: Real
    slope_y: Real
    mean_z: Real
    slope_z: Real
    mean_yy: Real
    mean_yz: Real
    seen_from: Real
    patch: Real
    moved: Real
    move: Real
    across: Real
    down: Real


@njit(inline="always", **VECTORISED)
def _line(table: Singles, row: int, per_drift: Singles) -> Line:
    """Return what a row of pixels has for all its columns."""
    down = table[DOWN + row :]
    return Line(
        down[MEAN],
        down[SLOPE],
        down[MEAN_X],
        down[SLOPE_X],
        down[MEAN_Z],
        down[SLOPE_Z],
        down[MEAN_XX],
        down[MEAN_XZ],
        down[SEEN_FROM],
        down[PATCH],
        down[MOVED],
        down[LEAN],
        per_drift[0] * down[DRIFT],
        per_drift[1],
    )


@njit(**VECTORISED)
def join_row(
    table: Singles, columns: tuple[int, int], row: int, rim: tuple[Real, Real, Real], per_drift: Singles, of: Plane
) -> None:
    """Fill in light and derivatives of some columns of one row from their profiles; see `response`.

    Parameters
    ----------
    columns : the first and their number
    rim : the width of a patch, the main lens's radius, and the square of the distance from its axis within which the
        rim leaves all of a patch, wherever its lens stands
    per_drift : (2,) how much further patches lie along x and y where lenses do
    """
    line = _line(table, row, per_drift)
    for begin in range(0, columns[1], WIDTH):
        rows = table[columns[0] + begin :]
        if rows[FURTHEST] * rows[FURTHEST] + line.patch * line.patch < rim[2]:
            for n in range(WIDTH):
                _join(rows, n, line, WHOLE, of)
        else:
            for n in range(WIDTH):
                _join(rows, n, line, _covered(rows, n, line, rim), of)


@njit(**VECTORISED)
def set_furthest(table: Singles, columns: int) -> None:
    """Set how far from the axis any of `WIDTH` patches from each column on lies at most."""
    for n in range(columns):
        furthest = ZERO
        for k in range(min(WIDTH, columns - n)):
            furthest = max(furthest, abs(table[PATCH + n + k]))
        table[FURTHEST + n] = furthest


@njit(inline="always", **VECTORISED)
def _covered(rows: Singles, n: int, line: Line, rim: tuple[Real, Real, Real]) -> tuple[Real, Real, Real, Real, Real]:
    """Return what the rim leaves of a patch, see `cells.covered_share`."""
    x, y = rows[SEEN_FROM + n] + line.across, line.seen_from + line.down * rows[DRIFT + n]
    return covered_share(x, y, rim[0], rim[1])


@njit(inline="always", **VECTORISED)
def _moved(rows: Singles, n: int, line: Line) -> tuple[Four, Four]:
    """Return mean, slope, and the mean's derivatives of one column's profiles where they are moved to."""
    move_x, move_y, h0_xx = line.move, rows[LEAN + n], rows[MEAN_XX + n]
    across = (
        rows[MEAN + n] + move_x * (rows[MEAN_X + n] + HALF * move_x * h0_xx),
        rows[SLOPE + n] + move_x * rows[SLOPE_X + n],
        rows[MEAN_X + n] + move_x * h0_xx,
        rows[MEAN_Z + n] + move_x * rows[MEAN_XZ + n],
    )
    down = (
        line.mean + move_y * (line.mean_y + HALF * move_y * line.mean_yy),
        line.slope + move_y * line.slope_y,
        line.mean_y + move_y * line.mean_yy,
        line.mean_z + move_y * line.mean_yz,
    )
    return across, down


@njit(inline="always", **VECTORISED)
def _join(rows: Singles, n: int, line: Line, cover: tuple[Real, Real, Real, Real, Real], of: Plane) -> None:
    """Fill in light and derivatives of one column."""
    share, mean_x, mean_y, share_x, share_y = cover
    h1_x, h1_z, v1_y, v1_z = rows[SLOPE_X + n], rows[SLOPE_Z + n], line.slope_y, line.slope_z
    (h0, h1, h0_x, h0_z), (v0, v1, v0_y, v0_z) = _moved(rows, n, line)
    patch_x, patch_y = rows[PATCH + n] + line.across, line.patch + line.down * rows[DRIFT + n]
    whole = h0 * v0
    # Profiles with what the rim leaves of their slopes.
    across, down = share * h0 + mean_x * h1, share * v0 + mean_y * v1
    light = across * v0 + mean_y * (h0 * v1)
    # With profiles' places alone; where cells lean, these follow the other axis.
    own_x, own_y = h0_x * down + mean_x * (h1_x * v0), v0_y * across + mean_y * (h0 * v1_y)
    led_x, led_y = of.lean_x * own_x, of.lean_y * own_y
    by_x, by_y = own_x + led_y + share_x * (of.place * whole), own_y + led_x + share_y * (of.place * whole)
    by_z = h0_z * down + v0_z * across + mean_x * (h1_z * v0) + mean_y * (h0 * v1_z)
    by_z += (led_y * (patch_x - of.own_x) + led_x * (patch_y - of.own_y)) * of.turn
    by_z += (share_x * (of.own_x - patch_x) + share_y * (of.own_y - patch_y)) * (of.tilt * whole)
    dx, dy = patch_x - of.true_x, patch_y - of.true_y
    d2 = dx * dx + dy * dy
    slope = of.factor_2 + (d2 - of.node_2) * (of.factor_3 + (d2 - of.node_3) * of.factor_4)
    slope = of.factor_0 + (d2 - of.node_0) * (of.factor_1 + (d2 - of.node_1) * slope)
    light += by_x * (of.more * (slope * dx - (patch_x - of.seen_x) * of.per_distance) - rows[MOVED + n])
    light += by_y * (of.more * (slope * dy - (patch_y - of.seen_y) * of.per_distance) - line.moved)
    shown = of.norm if light > ZERO else ZERO
    rows[SHOWN + n], rows[SHOWN + STRIDE + n] = shown * light, shown * by_x
    rows[SHOWN + 2 * STRIDE + n], rows[SHOWN + 3 * STRIDE + n] = shown * by_y, shown * (by_z + of.widen * light)


@njit(**VECTORISED)
def join_curved_row(
    table: Singles,
    columns: tuple[int, int],
    row: int,
    rim: tuple[Real, Real, Real],
    per_drift: Singles,
    of: Curved,
    slopes: tuple[Four, Four],
) -> None:
    """Fill in light and derivatives of some columns of one row behind curved faces; see `join_row`.

    `slopes` is what rays' slopes along x and along y differ by from straight ones' in this row: cubics of X.
    """
    line = _line(table, row, per_drift)
    for begin in range(0, columns[1], WIDTH):
        rows = table[columns[0] + begin :]
        if rows[FURTHEST] * rows[FURTHEST] + line.patch * line.patch < rim[2]:
            for n in range(WIDTH):
                _join_curved(rows, n, line, WHOLE, of, slopes)
        else:
            for n in range(WIDTH):
                _join_curved(rows, n, line, _covered(rows, n, line, rim), of, slopes)


@njit(inline="always", **VECTORISED)
def _join_curved(
    rows: Singles,
    n: int,
    line: Line,
    cover: tuple[Real, Real, Real, Real, Real],
    of: Curved,
    slopes: tuple[Four, Four],
) -> None:
    """Fill in light and derivatives of one column behind curved faces, where each lens has its own profiles."""
    share, mean_x, mean_y, share_x, share_y = cover
    (a0, a1, a2, a3), (b0, b1, b2, b3) = slopes
    (h0, h1, h0_x, h0_z), (v0, v1, v0_y, v0_z) = _moved(rows, n, line)
    patch_x = rows[PATCH + n]
    share_x, share_y = share_x * (h0 * v0), share_y * (h0 * v0)
    # Profiles with what the rim leaves of their slopes.
    across, down = share * h0 + mean_x * h1, share * v0 + mean_y * v1
    light = across * v0 + mean_y * (h0 * v1)
    own_x = h0_x * down + mean_x * (rows[SLOPE_X + n] * v0)
    own_y = v0_y * across + mean_y * (h0 * line.slope_y)
    led_x, led_y = of.lean_x * own_x, of.lean_y * own_y
    by_x, by_y = own_x + led_y + share_x * of.place_x, own_y + led_x + share_y * of.place_y
    light += by_x * (of.more_x * (a0 + patch_x * (a1 + patch_x * (a2 + patch_x * a3))) - of.bent_x)
    light += by_y * (of.more_y * (b0 + patch_x * (b1 + patch_x * (b2 + patch_x * b3))) - of.bent_y)
    deep_x = h0_z * down + mean_x * (rows[SLOPE_Z + n] * v0)
    deep_x += share_x * ((of.own_x - patch_x) * of.tilt_x) + of.widen_x * light
    deep_x += led_y * ((patch_x - of.own_x) * of.turn_x)
    deep_y = v0_z * across + mean_y * (h0 * line.slope_z)
    deep_y += share_y * ((of.own_y - line.patch) * of.tilt_y) + of.widen_y * light
    deep_y += led_x * ((line.patch - of.own_y) * of.turn_y)
    shown = of.norm if light > ZERO else ZERO
    rows[SHOWN + n] = shown * light
    x, y, z = of.moves
    rows[SHOWN + STRIDE + n] = shown * (x[0] * by_x + x[1] * by_y + x[2] * deep_x + x[3] * deep_y)
    rows[SHOWN + 2 * STRIDE + n] = shown * (y[0] * by_x + y[1] * by_y + y[2] * deep_x + y[3] * deep_y)
    rows[SHOWN + 3 * STRIDE + n] = shown * (z[0] * by_x + z[1] * by_y + z[2] * deep_x + z[3] * deep_y)


@njit(**VECTORISED)
def take_row(
    table: Singles,
    columns: tuple[int, int],
    to: tuple[int, NDArray[np.int64], int],
    pixels: NDArray[np.int32],
    values: Singles,
) -> None:
    """Write what `join_row` filled in to the entries from a number on.

    `to` is this number, the columns' pixels in a row, and the flat number of the row's first pixel.
    """
    (first, count), (at, places, pixel) = columns, to
    named, placed = pixels[at : at + count], places[first : first + count]
    for n in range(count):
        named[n] = pixel + placed[n]
    for k in range(values.shape[0]):
        source = table[SHOWN + k * STRIDE + first : SHOWN + k * STRIDE + first + count]
        target = values[k, at : at + count]
        for n in range(count):
            target[n] = source[n]
