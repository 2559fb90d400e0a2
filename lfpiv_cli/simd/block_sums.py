"""Sums over the planes and rows of blocks, written for the vector unit: many neighbours along x at once.

Plain loops do the same (`products_reference`, `moments_reference`); the compiler does not find these forms in them and
keeps the sums in memory rather than in registers. Arrays are flat, float32 but for flags; places and strides count
elements; sums run in the order of the loops with fused multiply-adds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit
from numba.core import cgutils, types
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
    FLAGS,
    LANES,
    VECTOR,
    ZERO,
    add_product,
    call,
    constant,
    for_each,
    in_place_of,
    index,
    integers,
    load,
    pointers,
    registers,
    splat,
    store,
)

# Interpolation by cubic B-splines, written for the vector unit: 16 neighbours along x at once.
#
# Plain loops do the same (`interpolate_reference`, `spline_weights_reference`, `range_reference`); the compiler does
# not find these forms in them and keeps the sums in memory rather than in registers. All arrays are flat float32,
# places and strides count elements, sums run in the order of the loops with fused multiply-adds. Neighbours share
# their taps, so that there are as many of them whatever a register holds: results must not depend on that.


# Neighbours along x are interpolated together with the taps of all of them, so many along an axis at most.
NEIGHBOURS = 16
MOST_TAPS = 8

TWO_THIRDS = ir.Constant(VECTOR, [2.0 / 3.0] * LANES)


def interpolate_reference(
    out: Floats,
    to: tuple[int, int],
    a: Floats,
    b: Floats,
    places: tuple[int, int, int],
    weights: Floats,
    taps: tuple[int, int, int, int, int, int],
) -> None:
    """Interpolate two volumes at mirrored places: the readable twin of `interpolate`.

    For each neighbour, b is summed over the taps times their weights, and a as far away in the opposite direction.

    Parameters
    ----------
    out, to : where the `NEIGHBOURS` sums of a go, and the step to those of b
    a, b, places : (at, plane step, row step), neighbour l lies at element at + l
    weights : of the taps along z, then y, then x, NEIGHBOURS for each
    taps : the lowest along z, y, x, in planes, rows and elements from the neighbours, and how many follow along each
        axis, at most `MOST_TAPS`
    """
    at, plane, row = places
    low_z, low_y, low_x, taps_z, taps_y, taps_x = taps
    along_z, along_y, along_x = 0, taps_z, taps_z + taps_y
    weight = weights[: (along_x + taps_x) * NEIGHBOURS].reshape(-1, NEIGHBOURS)
    sum_a, sum_b = out[to[0] : to[0] + NEIGHBOURS], out[to[0] + to[1] : to[0] + to[1] + NEIGHBOURS]
    sum_a[:] = 0.0
    sum_b[:] = 0.0
    row_a, row_b = np.empty(NEIGHBOURS, np.float32), np.empty(NEIGHBOURS, np.float32)
    for k in range(taps_z):
        for j in range(taps_y):
            row_a[:] = 0.0
            row_b[:] = 0.0
            away = (low_z + k) * plane + (low_y + j) * row + low_x
            for i in range(taps_x):
                back, there = at - away - i, at + away + i
                taken_a, taken_b = a[back : back + NEIGHBOURS], b[there : there + NEIGHBOURS]
                for lane in range(NEIGHBOURS):
                    row_a[lane] += weight[along_x + i, lane] * taken_a[lane]
                    row_b[lane] += weight[along_x + i, lane] * taken_b[lane]
            for lane in range(NEIGHBOURS):
                both = weight[along_z + k, lane] * weight[along_y + j, lane]
                sum_a[lane] += both * row_a[lane]
                sum_b[lane] += both * row_b[lane]


@in_place_of(interpolate_reference)
def interpolate(typing_context: Any, out: Any, to: Any, a: Any, b: Any, places: Any, weights: Any, taps: Any) -> Any:
    """Interpolate two volumes at mirrored places; see `interpolate_reference`.

    Times faster than this as a plain loop: 23 with 16 lanes, 17 with 8.
    """
    two, three, six = integers(2), integers(3), integers(6)
    return types.void(out, two, a, b, three, weights, six), _generate_interpolation


def _generate_interpolation(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, a, b, weights = pointers(context, builder, signature, arguments, (0, 2, 3, 5))
    out_at, out_step = cgutils.unpack_tuple(builder, arguments[1], 2)
    at, plane, row = cgutils.unpack_tuple(builder, arguments[4], 3)
    low_z, low_y, low_x, taps_z, taps_y, taps_x = cgutils.unpack_tuple(builder, arguments[6], 6)
    with cgutils.for_range(builder, index(NEIGHBOURS // LANES)) as part:
        first = builder.mul(part.index, index(LANES))
        here = builder.add(at, first)
        tables = [builder.gep(weights, [first])]
        for count in (taps_z, taps_y):
            tables.append(builder.gep(tables[-1], [builder.mul(count, index(NEIGHBOURS))]))
        whole = registers(builder, [ZERO, ZERO])

        def add_planes(count_x: int, here: Any = here, tables: Any = tables, whole: Any = whole) -> None:
            """Sum over all taps where there are `count_x` along x: their loop written out, their weights at hand."""
            along_x = [load(builder, tables[2], index(i * NEIGHBOURS)) for i in range(count_x)]
            with cgutils.for_range(builder, taps_z) as k:
                planes = registers(builder, [ZERO, ZERO])
                away_z = builder.mul(builder.add(low_z, k.index), plane)
                with cgutils.for_range(builder, taps_y) as j:
                    away = builder.add(builder.mul(builder.add(low_y, j.index), row), builder.add(away_z, low_x))
                    weight = load(builder, tables[1], builder.mul(j.index, index(NEIGHBOURS)))
                    ends = (builder.sub(here, away), builder.add(here, away))
                    for total, source, place, sign in zip(planes, (a, b), ends, (-1, 1), strict=True):
                        line = builder.fmul(load(builder, source, place), along_x[0])
                        for i in range(1, count_x):
                            there = load(builder, source, builder.add(place, index(sign * i)))
                            line = call(builder, "fma", there, along_x[i], line)
                        add_product(builder, total, line, weight)
                weight = load(builder, tables[0], builder.mul(k.index, index(NEIGHBOURS)))
                for total, part_sum in zip(whole, planes, strict=True):
                    add_product(builder, total, builder.load(part_sum), weight)

        for_each(builder, taps_x, range(1, MOST_TAPS + 1), add_planes)
        begin = builder.add(out_at, first)
        for slot, place in zip(whole, (begin, builder.add(begin, out_step)), strict=True):
            store(builder, builder.load(slot), out, place)
    return context.get_dummy_value()


def spline_weights_reference(weights: Floats, at: int, places: Floats, places_at: int, low: int, taps: int) -> None:
    """Write the cubic B-splines B centred on each tap at `NEIGHBOURS` places: the readable twin of `spline_weights`.

    B(s) = [max(0, 2 - |s|)^3 - 4 max(0, 1 - |s|)^3] / 6. Those of the tap `low` go to elements at + l of `weights`,
    those of the next to at + NEIGHBOURS + l, and so on. With four taps the places lie between the middle two, or hardly
    beyond these.
    """
    here = places[places_at : places_at + NEIGHBOURS]
    for tap in range(taps):
        begin = at + tap * NEIGHBOURS
        value, centre = weights[begin : begin + NEIGHBOURS], np.float32(low + tap)
        for lane in range(NEIGHBOURS):
            away = abs(here[lane] - centre)
            outer = max(np.float32(2.0) - away, np.float32(0.0))
            inner = max(np.float32(1.0) - away, np.float32(0.0))
            cubes = outer * outer * outer - np.float32(4.0) * (inner * inner * inner)
            value[lane] = cubes * np.float32(1.0 / 6.0)


@in_place_of(spline_weights_reference)
def spline_weights(typing_context: Any, weights: Any, at: Any, places: Any, places_at: Any, low: Any, taps: Any) -> Any:
    """Write the cubic B-splines centred on each tap; see `spline_weights_reference`.

    Times faster than this as a plain loop: 8 for four taps with 16 lanes and 5 with 8; 2 and 1.2 for more, which are
    rare.
    """
    i = types.int64
    return types.void(weights, i, places, i, i, i), _generate_weights


def _generate_weights(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    weights, places = pointers(context, builder, signature, arguments, (0, 2))
    _, at, _, places_at, low, taps = arguments
    with cgutils.for_range(builder, index(NEIGHBOURS // LANES)) as part:
        first = builder.mul(part.index, index(LANES))
        here, begin = load(builder, places, builder.add(places_at, first)), builder.add(at, first)
        with builder.if_else(builder.icmp_signed("==", taps, index(4))) as (four, other):
            with four:
                # All places lie between the two middle taps, where each B-spline is one cubic.
                after = builder.fsub(here, splat(builder, builder.sitofp(builder.add(low, index(1)), ir.FloatType())))
                before = builder.fsub(constant(1.0), after)
                outer_after, inner_after = _cubic_pieces(builder, after)
                outer_before, inner_before = _cubic_pieces(builder, before)
                for tap, value in enumerate((outer_before, inner_after, inner_before, outer_after)):
                    store(builder, value, weights, builder.add(begin, index(tap * NEIGHBOURS)))
            with other, cgutils.for_range(builder, taps) as tap:
                centre = splat(builder, builder.sitofp(builder.add(low, tap.index), ir.FloatType()))
                away = call(builder, "fabs", builder.fsub(here, centre))
                outer, inner = (call(builder, "maxnum", builder.fsub(constant(r), away), ZERO) for r in (2.0, 1.0))
                outer_cubed, inner_cubed = (builder.fmul(reach, builder.fmul(reach, reach)) for reach in (outer, inner))
                value = call(builder, "fma", inner_cubed, constant(-4.0), outer_cubed)
                place = builder.add(begin, builder.mul(tap.index, index(NEIGHBOURS)))
                store(builder, builder.fmul(value, constant(1.0 / 6.0)), weights, place)
    return context.get_dummy_value()


def _cubic_pieces(builder: ir.IRBuilder, away: Any) -> tuple[Any, Any]:
    """Return t^3 / 6 and t^3 / 2 - t^2 + 2 / 3: the cubic B-spline at distances of 2 - t and of t, 0 <= t <= 1."""
    squared = builder.fmul(away, away)
    outer = builder.fmul(builder.fmul(away, constant(1.0 / 6.0)), squared)
    inner = call(builder, "fma", squared, builder.fsub(builder.fmul(away, constant(0.5)), constant(1.0)), TWO_THIRDS)
    return outer, inner


@njit(cache=True)
def range_reference(places: Floats, at: int, count: int) -> tuple[float, float]:
    """Return the lowest and the highest of `count` numbers from element `at` on; `range_of_all` in readable form."""
    low = high = places[at]
    for place in places[at + 1 : at + count]:
        low, high = min(low, place), max(high, place)
    return low, high


@in_place_of(lambda places, at: range_reference(places, at, NEIGHBOURS))
def range_of_all(typing_context: Any, places: Any, at: Any) -> Any:
    """Return the lowest and the highest of `NEIGHBOURS` numbers; see `range_reference`.

    Times faster than this as a plain loop: 4 with 16 lanes and with 8.
    """
    return types.containers.UniTuple(types.float32, 2)(places, types.int64), _generate_range


def _generate_range(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    """Halves are compared until one lane is left."""
    (places,) = pointers(context, builder, signature, arguments, (0,))
    parts = [load(builder, places, builder.add(arguments[1], index(first))) for first in range(0, NEIGHBOURS, LANES)]
    found = []
    for order in "<>":
        best = parts[0]
        for other in parts[1:]:
            best = builder.select(builder.fcmp_ordered(order, best, other), best, other)
        half = LANES // 2
        while half:
            first, second = (_lanes(builder, best, start, half) for start in (0, half))
            best = builder.select(builder.fcmp_ordered(order, first, second), first, second)
            half //= 2
        found.append(builder.extract_element(best, ir.Constant(ir.IntType(32), 0)))
    return context.make_tuple(builder, signature.return_type, found)


def _lanes(builder: ir.IRBuilder, vector: Any, start: int, count: int) -> Any:
    """Return some neighbouring lanes of a vector."""
    chosen = ir.Constant(ir.VectorType(ir.IntType(32), count), list(range(start, start + count)))
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), chosen)


Floats = NDArray[np.float32]

# Shifts along x that share their loads: with five of them all sums of a radius of 2 stay in registers.
FEW_SHIFTS, MANY_SHIFTS = 3, 5
# Products of three derivatives, a mean and a difference: ten among the first four, four with the difference, and the
# squares of the difference's three derivatives.
MOMENTS = 17


def products_reference(
    out: Floats,
    to: tuple[int, int],
    a: Floats,
    b: Floats,
    places: tuple[int, int, int],
    extent: tuple[int, int],
    shifts: tuple[int, int],
) -> None:
    """Sum a(x) b(x + s) + a(x - s) b(x) over planes and rows: the readable twin of `products`.

    Parameters
    ----------
    out, to : where the sum of the first shift goes, `LANES` lanes, and the step to that of the next
    a, b, places : (at, plane step, row step), lane l of the first row lies at element at + l
    extent : planes, rows
    shifts : the first s, and how many follow each other; `FEW_SHIFTS` or `MANY_SHIFTS`
    """
    at, plane, row = places
    for m in range(shifts[1]):
        begin = to[0] + m * to[1]
        target = out[begin : begin + LANES]
        target[:] = 0.0
        for z in range(extent[0]):
            for y in range(extent[1]):
                here = at + z * plane + y * row
                there, back = here + shifts[0] + m, here - shifts[0] - m
                a_here, b_here = a[here : here + LANES], b[here : here + LANES]
                a_back, b_there = a[back : back + LANES], b[there : there + LANES]
                for lane in range(LANES):
                    target[lane] += a_here[lane] * b_there[lane] + a_back[lane] * b_here[lane]


@in_place_of(products_reference)
def products(typing_context: Any, out: Any, to: Any, a: Any, b: Any, places: Any, extent: Any, shifts: Any) -> Any:
    """Sum products for several shifts; see `products_reference`.

    Times faster than this as a plain loop: 13 for three shifts and 17 for five, with 16 lanes and with 8.
    """
    two, three = integers(2), integers(3)
    return types.void(out, two, a, b, three, two, two), _generate_products


def _generate_products(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, a, b = pointers(context, builder, signature, arguments, (0, 2, 3))
    out_at, out_step = cgutils.unpack_tuple(builder, arguments[1], 2)
    at, plane, row = cgutils.unpack_tuple(builder, arguments[4], 3)
    planes, rows = cgutils.unpack_tuple(builder, arguments[5], 2)
    shift, count = cgutils.unpack_tuple(builder, arguments[6], 2)

    def sum_products(shifts: int) -> None:
        # Two sums a shift: the next product need not wait for the last one.
        forward, back = (registers(builder, [ZERO] * shifts) for _ in range(2))
        with cgutils.for_range(builder, planes) as z:
            begin = builder.add(at, builder.mul(z.index, plane))
            with cgutils.for_range(builder, rows) as y:
                here = builder.add(begin, builder.mul(y.index, row))
                a_here, b_here = load(builder, a, here), load(builder, b, here)
                for m in range(shifts):
                    away = builder.add(shift, index(m))
                    add_product(builder, forward[m], a_here, load(builder, b, builder.add(here, away)))
                    add_product(builder, back[m], load(builder, a, builder.sub(here, away)), b_here)
        for m in range(shifts):
            both = builder.fadd(builder.load(forward[m]), builder.load(back[m]))
            store(builder, both, out, builder.add(out_at, builder.mul(out_step, index(m))))

    for_each(builder, count, (FEW_SHIFTS, MANY_SHIFTS), sum_products)
    return context.get_dummy_value()


def moments_reference(
    out: Floats,
    to: tuple[int, int],
    a: Floats,
    b: Floats,
    valid: NDArray[np.uint8],
    places: tuple[int, int, int],
    extent: tuple[int, int],
) -> None:
    """Sum products of gradient, mean and difference over planes and rows: the readable twin of `moments`.

    Of the mean M = (a + b) / 2 and its central differences, q = (dM/dx, dM/dy, dM/dz, M), and of r = b - a: the upper
    triangle of the products q q, row by row, then q r, then the squares of (dr/dx, dr/dy, dr/dz) / 2. Voxels with a
    neighbour that is not valid are left out.

    Parameters
    ----------
    out, to : where the first moment goes, `LANES` lanes, and the step to the next
    a, b, valid, places : (at, plane step, row step), lane l of the first row lies at element at + l
    extent : planes, rows
    """
    at, plane, row = places
    q, slope = np.empty((4, LANES), np.float32), np.empty((3, LANES), np.float32)
    r, kept = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    sums = np.zeros((MOMENTS, LANES), np.float32)
    for z in range(extent[0]):
        for y in range(extent[1]):
            here = at + z * plane + y * row
            kept[:] = 1.0
            _strike_out(valid[here : here + LANES], kept)
            for axis, step in enumerate((1, row, plane)):
                before, after = slice(here - step, here - step + LANES), slice(here + step, here + step + LANES)
                _write_slopes(a[before], a[after], b[before], b[after], q[axis], slope[axis])
                _strike_out(valid[before], kept)
                _strike_out(valid[after], kept)
            a_here, b_here = a[here : here + LANES], b[here : here + LANES]
            for lane in range(LANES):
                q[3, lane] = np.float32(0.5) * (a_here[lane] + b_here[lane])
                r[lane] = (b_here[lane] - a_here[lane]) * kept[lane]
            m = 0
            for i in range(4):
                for j in range(i, 4):
                    for lane in range(LANES):
                        sums[m, lane] += kept[lane] * q[i, lane] * q[j, lane]
                    m += 1
            for i in range(4):
                for lane in range(LANES):
                    sums[m + i, lane] += q[i, lane] * r[lane]
            m += 4
            for i in range(3):
                for lane in range(LANES):
                    sums[m + i, lane] += kept[lane] * slope[i, lane] * slope[i, lane]
    for m in range(MOMENTS):
        out[to[0] + m * to[1] : to[0] + m * to[1] + LANES] = sums[m]


@njit(cache=True)
def _write_slopes(
    a_before: Floats, a_after: Floats, b_before: Floats, b_after: Floats, of_mean: Floats, of_difference: Floats
) -> None:
    """Write the central differences of the mean of a and b, and of half their difference."""
    for lane in range(of_mean.size):
        of_mean[lane] = np.float32(0.25) * ((a_after[lane] + b_after[lane]) - (a_before[lane] + b_before[lane]))
        of_difference[lane] = np.float32(0.25) * ((b_after[lane] - a_after[lane]) - (b_before[lane] - a_before[lane]))


@njit(cache=True)
def _strike_out(valid: NDArray[np.uint8], kept: Floats) -> None:
    """Multiply by flags."""
    for lane in range(kept.size):
        kept[lane] *= np.float32(valid[lane])


@in_place_of(moments_reference)
def moments(typing_context: Any, out: Any, to: Any, a: Any, b: Any, valid: Any, places: Any, extent: Any) -> Any:
    """Sum products of gradient, mean and difference; see `moments_reference`.

    Times faster than this as a plain loop: 55 with 16 lanes, 48 with 8.
    """
    two, three = integers(2), integers(3)
    return types.void(out, two, a, b, valid, three, two), _generate_moments


def _generate_moments(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, a, b, valid = pointers(context, builder, signature, arguments, (0, 2, 3, 4))
    out_at, out_step = cgutils.unpack_tuple(builder, arguments[1], 2)
    at, plane, row = cgutils.unpack_tuple(builder, arguments[5], 3)
    planes, rows = cgutils.unpack_tuple(builder, arguments[6], 2)
    sums = registers(builder, [ZERO] * MOMENTS)

    def both(place: Any) -> tuple[Any, Any]:
        one, other = load(builder, a, place), load(builder, b, place)
        return builder.fadd(one, other), builder.fsub(other, one)

    with cgutils.for_range(builder, planes) as z:
        begin = builder.add(at, builder.mul(z.index, plane))
        with cgutils.for_range(builder, rows) as y:
            here = builder.add(begin, builder.mul(y.index, row))
            kept = load(builder, valid, here, FLAGS)
            known: list[Any] = []
            slopes: list[Any] = []
            for step in (index(1), row, plane):
                before, after = builder.sub(here, step), builder.add(here, step)
                for place in (before, after):
                    kept = builder.and_(kept, load(builder, valid, place, FLAGS))
                quarters = (
                    builder.fmul(constant(0.25), builder.fsub(one, other))
                    for one, other in zip(both(after), both(before), strict=True)
                )
                for found, slope in zip((known, slopes), quarters, strict=True):
                    found.append(slope)
            total, rest = both(here)
            known.append(builder.fmul(constant(0.5), total))
            kept = builder.uitofp(kept, VECTOR)
            known, slopes = ([builder.fmul(kept, one) for one in each] for each in (known, slopes))
            pairs = [(one, other) for i, one in enumerate(known) for other in known[i:]]
            pairs += [(one, rest) for one in known] + [(one, one) for one in slopes]
            for slot, (one, other) in zip(sums, pairs, strict=True):
                add_product(builder, slot, one, other)
    for m, slot in enumerate(sums):
        store(builder, builder.load(slot), out, builder.add(out_at, builder.mul(out_step, index(m))))
    return context.get_dummy_value()
