"""What one lens shows of a glowing ball, eight neighbouring pixels of a row at once.

`response` has the theory. All numbers of a lens stand in the rows, `STRIDE` long, of one flat table, and loops run over
`WIDTH` neighbours, so that the compiler makes vector code of them: it need not ask whether arrays overlap, nor what to
do with a rest. More pixels than are asked for are written therefore, up to a whole `WIDTH`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.particles.cells import covered_share
from lfpiv_cli.threads import COUNT_NO_REFERENCES

# Pixels of a row that one lens may show, and how many are worked on together.
LONGEST, WIDTH = 96, 8
STRIDE = LONGEST + WIDTH
# Three-point Gauss-Legendre on (-1, 1): exact for the cubic profile wherever it has no kink within the patch.
GAUSS_AT = float(np.sqrt(0.6))
GAUSS_WEIGHT = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)
# Rows of a profile: mean and slope of the share P of the ball that is seen, their derivatives by x and by z, the
# patch's middle, and where what is seen of the ball is seen from.
MEAN, SLOPE, MEAN_X, SLOPE_X, MEAN_Z, SLOPE_Z, PATCH, SEEN_FROM = (row * STRIDE for row in range(8))
# In the table: the profile along x; of a row of pixels what the rim leaves of patches (covered share, means of xi and
# eta, slopes of the share) and light and its derivatives; the profile along y.
RIM, SHOWN, DOWN = 8 * STRIDE, 13 * STRIDE, 17 * STRIDE
TABLE_SIZE = 25 * STRIDE
# Of a ball; what sees less sees nothing.
SMALLEST_SHARE = 1e-9
# Numbers that pixels follow from beside profiles, see `join_row` and `join_curved_row`.
JOIN_NUMBERS, CURVED_NUMBERS, OF_CUBIC = 24, 33, 21

VECTORISED: dict[str, Any] = {"cache": True, "fastmath": True, "error_model": "numpy", **COUNT_NO_REFERENCES}


@njit(**VECTORISED)
def fill_profile(out: Floats, count: int, numbers: tuple[float, ...]) -> None:
    """Fill the rows of a profile for `count` columns; see `response`.

    Parameters
    ----------
    numbers : the first patch's middle on the main lens, the step to the next, and their width; a crossing X of the main
        lens meets the array at offset + gain X from the lens; a point there moves by `by_x` with x, and with z by turn
        (X - x); half the cell, 1/radius of the ball on the array, its relative change with z; and by how many X the
        ball's edge is seen from elsewhere than its middle
    """
    first, step, width, offset, gain, by_x, x, turn, half, per_radius, growth, away = numbers
    for begin in range(0, count, WIDTH):
        rows = out[begin:]
        for n in range(WIDTH):
            middle = first + step * (begin + n)
            mean = slope = mean_x = slope_x = mean_z = slope_z = moment = 0.0
            for node in range(3):
                xi, weight = (node - 1) * GAUSS_AT, GAUSS_WEIGHT[node]
                lean = 3.0 * weight * xi
                place = middle + 0.5 * xi * width
                u = offset + gain * place
                upper = min(max((u + half) * per_radius, -1.0), 1.0)
                lower = min(max((u - half) * per_radius, -1.0), 1.0)
                upper2, lower2 = upper * upper, lower * lower
                share = 0.25 * (upper * (3.0 - upper2) - lower * (3.0 - lower2))
                dense_upper, dense_lower = 0.75 - 0.75 * upper2, 0.75 - 0.75 * lower2
                by_u = (dense_upper - dense_lower) * per_radius
                by_z = by_u * (place - x) * turn - (dense_upper * upper - dense_lower * lower) * growth
                moment += 0.1875 * weight * (upper2 * (2.0 - upper2) - lower2 * (2.0 - lower2))
                mean, slope = mean + weight * share, slope + lean * share
                mean_x, slope_x = mean_x + weight * by_u * by_x, slope_x + lean * by_u * by_x
                mean_z, slope_z = mean_z + weight * by_z, slope_z + lean * by_z
            rows[MEAN + n], rows[SLOPE + n] = mean, slope
            rows[MEAN_X + n], rows[SLOPE_X + n] = mean_x, slope_x
            rows[MEAN_Z + n], rows[SLOPE_Z + n] = mean_z, slope_z
            rows[PATCH + n] = middle
            rows[SEEN_FROM + n] = middle + away * moment / max(mean, SMALLEST_SHARE)


@njit(**VECTORISED)
def cover_row(
    table: Floats, columns: tuple[int, int], row: int, whole: tuple[int, int], width: float, radius: float
) -> None:
    """Fill in what the rim leaves of the patches of some columns of one row; see `cells.covered_share`.

    Parameters
    ----------
    columns : the first and their number
    whole : the first one of which it leaves all, and the one behind the last
    width, radius : of a patch, and of the main lens
    """
    y = table[DOWN + SEEN_FROM + row]
    for begin in range(columns[0], columns[0] + columns[1], WIDTH):
        rows = table[begin:]
        if whole[0] <= begin and min(begin + WIDTH, columns[0] + columns[1]) <= whole[1]:
            for n in range(WIDTH):
                rows[RIM + n] = 1.0
                rows[RIM + STRIDE + n] = rows[RIM + 2 * STRIDE + n] = 0.0
                rows[RIM + 3 * STRIDE + n] = rows[RIM + 4 * STRIDE + n] = 0.0
            continue
        for n in range(WIDTH):
            share, mean_x, mean_y, slope_x, slope_y = covered_share(rows[SEEN_FROM + n], y, width, radius)
            rows[RIM + n], rows[RIM + STRIDE + n], rows[RIM + 2 * STRIDE + n] = share, mean_x, mean_y
            rows[RIM + 3 * STRIDE + n], rows[RIM + 4 * STRIDE + n] = slope_x, slope_y


@njit(**VECTORISED)
def join_row(table: Floats, columns: tuple[int, int], row: int, numbers: Floats) -> None:
    """Fill in light and derivatives of some columns of one row from their profiles; see `response`.

    Parameters
    ----------
    columns : the first and their number
    numbers : the place on the main lens that a pixel sees moves by [0] with x and y, which are [1] and [2], and by [3]
        (x - X) with z; [4] light of a whole patch that sees the whole ball, [5] its relative change with z; [6] to [9]
        true x and y, and those seen, of bent rays, and [10] 1/distance, see `refraction.Bend`; [11] to [14] nodes and
        [15] to [19] factors of the polynomial of their slopes; [20] and [21] what a profile changes by with these rays'
        slopes, over its derivative by x and y; [22] and [23] the same for what the profile was moved by already
    """
    place_x, own_x, own_y, tilt, norm, widen = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5]
    true_x, true_y, seen_x, seen_y, per_distance = numbers[6], numbers[7], numbers[8], numbers[9], numbers[10]
    node_0, node_1, node_2, node_3 = numbers[11], numbers[12], numbers[13], numbers[14]
    factor_0, factor_1, factor_2, factor_3, factor_4 = numbers[15], numbers[16], numbers[17], numbers[18], numbers[19]
    more_x, more_y, bent_x, bent_y = numbers[20], numbers[21], numbers[22], numbers[23]
    v0, v1, v0_y, v1_y, v0_z, v1_z, patch_y = column_of(table, row)
    dy = patch_y - true_y
    for begin in range(0, columns[1], WIDTH):
        rows = table[columns[0] + begin :]
        for n in range(WIDTH):
            h0, h1, h0_x, h1_x = rows[MEAN + n], rows[SLOPE + n], rows[MEAN_X + n], rows[SLOPE_X + n]
            h0_z, h1_z, patch_x = rows[MEAN_Z + n], rows[SLOPE_Z + n], rows[PATCH + n]
            share, mean_x, mean_y = rows[RIM + n], rows[RIM + STRIDE + n], rows[RIM + 2 * STRIDE + n]
            share_x, share_y = rows[RIM + 3 * STRIDE + n], rows[RIM + 4 * STRIDE + n]
            whole = h0 * v0
            # Profiles with what the rim leaves of their slopes.
            across, down = share * h0 + mean_x * h1, share * v0 + mean_y * v1
            light = across * v0 + mean_y * (h0 * v1)
            by_x = h0_x * down + mean_x * (h1_x * v0) + share_x * (place_x * whole)
            by_y = v0_y * across + mean_y * (h0 * v1_y) + share_y * (place_x * whole)
            by_z = h0_z * down + v0_z * across + mean_x * (h1_z * v0) + mean_y * (h0 * v1_z)
            by_z += (share_x * (own_x - patch_x) + share_y * (own_y - patch_y)) * (tilt * whole)
            dx = patch_x - true_x
            d2 = dx * dx + dy * dy
            slope = factor_2 + (d2 - node_2) * (factor_3 + (d2 - node_3) * factor_4)
            slope = factor_0 + (d2 - node_0) * (factor_1 + (d2 - node_1) * slope)
            light += by_x * (more_x * (slope * dx - (patch_x - seen_x) * per_distance) - bent_x)
            light += by_y * (more_y * (slope * dy - (patch_y - seen_y) * per_distance) - bent_y)
            shown = norm if light > 0.0 else 0.0
            rows[SHOWN + n], rows[SHOWN + STRIDE + n] = shown * light, shown * by_x
            rows[SHOWN + 2 * STRIDE + n], rows[SHOWN + 3 * STRIDE + n] = shown * by_y, shown * (by_z + widen * light)


@njit(**VECTORISED)
def join_curved_row(table: Floats, columns: tuple[int, int], row: int, numbers: Floats) -> None:
    """Fill in light and derivatives of some columns of one row behind curved faces; see `response`.

    Parameters
    ----------
    columns : the first and their number
    numbers : [0], [1] the place in air; along x the place on the main lens that a pixel sees moves by [2] with x, and
        by [3] (x - X) with the depth that is seen along x, and what light of a whole patch changes by with that depth
        [4]; [5] to [7] the same along y; [8] light of a whole patch that sees the whole ball; how the place in air and
        its two depths move [9] to [12] with x, [13] to [16] with y and [17] to [20] with z; from `OF_CUBIC` on what
        rays' slopes along x and along y differ by from straight ones', in a row: cubics of X; the last four as of
        `join_row`
    """
    own_x, own_y, norm = numbers[0], numbers[1], numbers[8]
    place_x, tilt_x, widen_x = numbers[2], numbers[3], numbers[4]
    place_y, tilt_y, widen_y = numbers[5], numbers[6], numbers[7]
    x_by_x, y_by_x, deep_x_by_x, deep_y_by_x = numbers[9], numbers[10], numbers[11], numbers[12]
    x_by_y, y_by_y, deep_x_by_y, deep_y_by_y = numbers[13], numbers[14], numbers[15], numbers[16]
    x_by_z, y_by_z, deep_x_by_z, deep_y_by_z = numbers[17], numbers[18], numbers[19], numbers[20]
    a0, a1, a2, a3 = numbers[OF_CUBIC], numbers[OF_CUBIC + 1], numbers[OF_CUBIC + 2], numbers[OF_CUBIC + 3]
    b0, b1, b2, b3 = numbers[OF_CUBIC + 4], numbers[OF_CUBIC + 5], numbers[OF_CUBIC + 6], numbers[OF_CUBIC + 7]
    more_x, more_y, bent_x, bent_y = numbers[29], numbers[30], numbers[31], numbers[32]
    v0, v1, v0_y, v1_y, v0_z, v1_z, patch_y = column_of(table, row)
    for begin in range(0, columns[1], WIDTH):
        rows = table[columns[0] + begin :]
        for n in range(WIDTH):
            h0, h1, h0_x, h1_x = rows[MEAN + n], rows[SLOPE + n], rows[MEAN_X + n], rows[SLOPE_X + n]
            h0_z, h1_z, patch_x = rows[MEAN_Z + n], rows[SLOPE_Z + n], rows[PATCH + n]
            share, mean_x, mean_y = rows[RIM + n], rows[RIM + STRIDE + n], rows[RIM + 2 * STRIDE + n]
            share_x, share_y = rows[RIM + 3 * STRIDE + n] * (h0 * v0), rows[RIM + 4 * STRIDE + n] * (h0 * v0)
            # Profiles with what the rim leaves of their slopes.
            across, down = share * h0 + mean_x * h1, share * v0 + mean_y * v1
            light = across * v0 + mean_y * (h0 * v1)
            by_x = h0_x * down + mean_x * (h1_x * v0) + share_x * place_x
            by_y = v0_y * across + mean_y * (h0 * v1_y) + share_y * place_y
            light += by_x * (more_x * (a0 + patch_x * (a1 + patch_x * (a2 + patch_x * a3))) - bent_x)
            light += by_y * (more_y * (b0 + patch_x * (b1 + patch_x * (b2 + patch_x * b3))) - bent_y)
            deep_x = h0_z * down + mean_x * (h1_z * v0) + share_x * ((own_x - patch_x) * tilt_x) + widen_x * light
            deep_y = v0_z * across + mean_y * (h0 * v1_z) + share_y * ((own_y - patch_y) * tilt_y) + widen_y * light
            shown = norm if light > 0.0 else 0.0
            rows[SHOWN + n] = shown * light
            to_x = x_by_x * by_x + y_by_x * by_y + deep_x_by_x * deep_x + deep_y_by_x * deep_y
            to_y = x_by_y * by_x + y_by_y * by_y + deep_x_by_y * deep_x + deep_y_by_y * deep_y
            to_z = x_by_z * by_x + y_by_z * by_y + deep_x_by_z * deep_x + deep_y_by_z * deep_y
            rows[SHOWN + STRIDE + n], rows[SHOWN + 2 * STRIDE + n] = shown * to_x, shown * to_y
            rows[SHOWN + 3 * STRIDE + n] = shown * to_z


@njit(**VECTORISED)
def column_of(table: Floats, row: int) -> tuple[float, float, float, float, float, float, float]:
    """Return what the profile along y has for a row of pixels, up to the patch's middle."""
    down = table[DOWN + row :]
    return down[MEAN], down[SLOPE], down[MEAN_X], down[SLOPE_X], down[MEAN_Z], down[SLOPE_Z], down[PATCH]


@njit(**VECTORISED)
def take_row(
    table: Floats, columns: tuple[int, int], to: tuple[int, int], pixels: NDArray[np.int32], values: Floats
) -> None:
    """Write what `join_row` filled in to the entries from a number on, the first of a flat pixel: both in `to`."""
    at, pixel = to
    named, light, by_x, by_y, by_z = pixels[at:], values[0, at:], values[1, at:], values[2, at:], values[3, at:]
    for begin in range(0, columns[1], WIDTH):
        shown = table[SHOWN + columns[0] + begin :]
        for n in range(WIDTH):
            named[begin + n] = pixel + begin + n
        for n in range(WIDTH):
            light[begin + n] = shown[n]
        for n in range(WIDTH):
            by_x[begin + n] = shown[STRIDE + n]
        for n in range(WIDTH):
            by_y[begin + n] = shown[2 * STRIDE + n]
        for n in range(WIDTH):
            by_z[begin + n] = shown[3 * STRIDE + n]
