"""Interpolation by cubic B-splines, written for the vector unit: 16 neighbours along x at once.

Plain loops do the same (`interpolate_reference`, `spline_weights_reference`, `range_reference`); the compiler does not
find these forms in them and keeps the sums in memory rather than in registers. All arrays are flat float32, places and
strides count elements, sums run in the order of the loops with fused multiply-adds. Neighbours share their taps, so
that there are as many of them whatever a register holds: results must not depend on that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit
from numba.core import cgutils, types
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
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

Floats = NDArray[np.float32]

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
