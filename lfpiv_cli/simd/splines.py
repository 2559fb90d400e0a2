"""Interpolation by cubic B-splines, written for the vector unit: 16 neighbours along x at once.

Plain loops do the same (`interpolate_reference`, `spline_weights_reference`); the compiler does not find these forms in
them, keeps the sums in memory rather than in registers, and is five times slower. All arrays are flat float32, places
and strides count elements, sums run in the order of the loops with fused multiply-adds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
    LANES,
    VECTOR,
    ZERO,
    add_product,
    call,
    constant,
    for_each,
    index,
    load,
    pointers,
    registers,
    splat,
    store,
    store_vector,
)

# Neighbours along x are interpolated together with the taps of all of them, so many along an axis at most.
MOST_TAPS = 8

TWO_THIRDS = ir.Constant(VECTOR, [2.0 / 3.0] * LANES)


def interpolate_reference(
    out_a: NDArray[np.float32],
    out_b: NDArray[np.float32],
    out_at: int,
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    at: int,
    plane: int,
    row: int,
    weights: NDArray[np.float32],
    low_z: int,
    low_y: int,
    low_x: int,
    taps_z: int,
    taps_y: int,
    taps_x: int,
) -> None:
    """Interpolate two volumes at mirrored places: the readable twin of `interpolate`.

    Lane l lies at element at + l. `out_b[out_at + l]` becomes the sum over the taps (k, j, i) of the weights of its
    lane times b at k planes, j rows and i elements from there; `out_a[out_at + l]` that of a as far in the opposite
    direction. Taps count from the lowest one, `low`, and are at most `MOST_TAPS`; `weights` holds those along z, then
    y, then x, LANES for each tap.
    """
    along_z, along_y, along_x = np.split(weights.reshape(-1, LANES), [taps_z, taps_z + taps_y])
    target_a, target_b = (out[out_at : out_at + LANES] for out in (out_a, out_b))
    target_a[:] = target_b[:] = 0.0
    for k in range(taps_z):
        for j in range(taps_y):
            for i in range(taps_x):
                away = (low_z + k) * plane + (low_y + j) * row + low_x + i
                weight = along_z[k] * along_y[j] * along_x[i]
                target_a += weight * a[at - away : at - away + LANES]
                target_b += weight * b[at + away : at + away + LANES]


@intrinsic
def interpolate(
    typing_context: Any,
    out_a: Any,
    out_b: Any,
    out_at: Any,
    a: Any,
    b: Any,
    at: Any,
    plane: Any,
    row: Any,
    weights: Any,
    low_z: Any,
    low_y: Any,
    low_x: Any,
    taps_z: Any,
    taps_y: Any,
    taps_x: Any,
) -> Any:
    """Interpolate two volumes at mirrored places; see `interpolate_reference`."""
    i = types.int64
    return types.void(out_a, out_b, i, a, b, i, i, i, weights, i, i, i, i, i, i), _generate_interpolation


def _generate_interpolation(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out_a, out_b, a, b, weights = pointers(context, builder, signature, arguments, (0, 1, 3, 4, 8))
    out_at = arguments[2]
    at, plane, row = arguments[5:8]
    low, taps = arguments[9:12], arguments[12:15]
    tables = [weights]
    for count in taps[:2]:
        tables.append(builder.gep(tables[-1], [builder.mul(count, index(LANES))]))
    whole = registers(builder, 2)

    def add_planes(taps_x: int) -> None:
        """Sum over all taps where there are `taps_x` along x, whose loop is written out and weights stay at hand."""
        along_x = [load(builder, tables[2], index(i * LANES)) for i in range(taps_x)]
        with cgutils.for_range(builder, taps[0]) as k:
            planes = registers(builder, 2)
            away_z = builder.mul(builder.add(low[0], k.index), plane)
            with cgutils.for_range(builder, taps[1]) as j:
                away = builder.add(builder.mul(builder.add(low[1], j.index), row), builder.add(away_z, low[2]))
                weight = load(builder, tables[1], builder.mul(j.index, index(LANES)))
                places = (builder.sub(at, away), builder.add(at, away))
                for total, source, place, sign in zip(planes, (a, b), places, (-1, 1), strict=True):
                    line = builder.fmul(load(builder, source, place), along_x[0])
                    for i in range(1, taps_x):
                        there = load(builder, source, builder.add(place, index(sign * i)))
                        line = call(builder, "fma", there, along_x[i], line)
                    add_product(builder, total, line, weight)
            weight = load(builder, tables[0], builder.mul(k.index, index(LANES)))
            for total, part in zip(whole, planes, strict=True):
                add_product(builder, total, builder.load(part), weight)

    for_each(builder, taps[2], range(1, MOST_TAPS + 1), add_planes)
    store(builder, whole[:1], out_a, [out_at])
    store(builder, whole[1:], out_b, [out_at])
    return context.get_dummy_value()


def spline_weights_reference(
    weights: NDArray[np.float32], at: int, places: NDArray[np.float32], places_at: int, low: int, taps: int
) -> None:
    """Write the cubic B-splines B centred on each tap at `LANES` places: the readable twin of `spline_weights`.

    B(s) = [max(0, 2 - |s|)^3 - 4 max(0, 1 - |s|)^3] / 6. Those of the tap `low` go to elements at + l of `weights`,
    those of the next to at + LANES + l, and so on. With four taps the places lie between the middle two, or hardly
    beyond these.
    """
    here = places[places_at : places_at + LANES]
    for tap in range(taps):
        away = np.abs(here - np.float32(low + tap))
        outer, inner = np.maximum(2.0 - away, 0.0), np.maximum(1.0 - away, 0.0)
        weights[at + tap * LANES : at + (tap + 1) * LANES] = (outer**3 - 4.0 * inner**3) / 6.0


@intrinsic
def spline_weights(typing_context: Any, weights: Any, at: Any, places: Any, places_at: Any, low: Any, taps: Any) -> Any:
    """Write the cubic B-splines centred on each tap; see `spline_weights_reference`."""
    i = types.int64
    return types.void(weights, i, places, i, i, i), _generate_weights


def _generate_weights(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    weights, places = pointers(context, builder, signature, arguments, (0, 2))
    _, at, _, places_at, low, taps = arguments
    here = load(builder, places, places_at)
    with builder.if_else(builder.icmp_signed("==", taps, index(4))) as (four, other):
        with four:
            # All places lie between the two middle taps, where each B-spline is one cubic.
            after = builder.fsub(here, splat(builder, builder.sitofp(builder.add(low, index(1)), ir.FloatType())))
            before = builder.fsub(constant(1.0), after)
            outer_after, inner_after = _cubic_pieces(builder, after)
            outer_before, inner_before = _cubic_pieces(builder, before)
            for tap, value in enumerate((outer_before, inner_after, inner_before, outer_after)):
                store_vector(builder, value, weights, builder.add(at, index(tap * LANES)))
        with other, cgutils.for_range(builder, taps) as tap:
            centre = splat(builder, builder.sitofp(builder.add(low, tap.index), ir.FloatType()))
            away = call(builder, "fabs", builder.fsub(here, centre))
            outer, inner = (call(builder, "maxnum", builder.fsub(constant(r), away), ZERO) for r in (2.0, 1.0))
            outer_cubed, inner_cubed = (builder.fmul(reach, builder.fmul(reach, reach)) for reach in (outer, inner))
            value = builder.fmul(call(builder, "fma", inner_cubed, constant(-4.0), outer_cubed), constant(1.0 / 6.0))
            place = builder.add(at, builder.mul(tap.index, index(LANES)))
            store_vector(builder, value, weights, place)
    return context.get_dummy_value()


def _cubic_pieces(builder: ir.IRBuilder, away: Any) -> tuple[Any, Any]:
    """Return t^3 / 6 and t^3 / 2 - t^2 + 2 / 3: the cubic B-spline at distances of 2 - t and of t, 0 <= t <= 1."""
    squared = builder.fmul(away, away)
    outer = builder.fmul(builder.fmul(away, constant(1.0 / 6.0)), squared)
    inner = call(builder, "fma", squared, builder.fsub(builder.fmul(away, constant(0.5)), constant(1.0)), TWO_THIRDS)
    return outer, inner


@intrinsic
def lowest(typing_context: Any, places: Any, at: Any) -> Any:
    """Return the lowest of the `LANES` numbers from element `at` on."""
    return types.float32(places, types.int64), _extreme_generator("<")


@intrinsic
def highest(typing_context: Any, places: Any, at: Any) -> Any:
    """Return the highest of the `LANES` numbers from element `at` on."""
    return types.float32(places, types.int64), _extreme_generator(">")


def _extreme_generator(order: str) -> Any:
    """Return the code generator of `lowest` or `highest`: halves are compared until one lane is left."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        (places,) = pointers(context, builder, signature, arguments, (0,))
        best = load(builder, places, arguments[1])
        half = LANES // 2
        while half:
            first, second = (_lanes(builder, best, start, half) for start in (0, half))
            best = builder.select(builder.fcmp_ordered(order, first, second), first, second)
            half //= 2
        return builder.extract_element(best, ir.Constant(ir.IntType(32), 0))

    return generate


def _lanes(builder: ir.IRBuilder, vector: Any, start: int, count: int) -> Any:
    """Return some neighbouring lanes of a vector."""
    chosen = ir.Constant(ir.VectorType(ir.IntType(32), count), list(range(start, start + count)))
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), chosen)
