"""The innermost loops of the correlation, written for the vector unit: 16 neighbours along x at once.

Plain loops do the same (`interpolate_reference`, `spline_weights_reference`, `products_reference`); the compiler does
not find these forms in them, keeps the sums in memory rather than in registers, and is five times slower. All arrays
are flat float32, places and strides count elements, sums run in the order of the loops with fused multiply-adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

LANES = 16
# Shifts along x that share their loads: with five of them all sums of a radius of 2 stay in registers.
FEW_SHIFTS, MANY_SHIFTS = 3, 5

INDEX = ir.IntType(64)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
ZERO = ir.Constant(VECTOR, [0.0] * LANES)


def interpolate_reference(
    out: NDArray[np.float32],
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

    Lane l lies at element at + l. `out[LANES + l]` becomes the sum over the taps (k, j, i) of the weights of its lane
    times b at k planes, j rows and i elements from there; `out[l]` that of a as far in the opposite direction. Taps
    count from the lowest one, `low`; `weights` holds those along z, then y, then x, LANES for each tap.
    """
    along_z, along_y, along_x = np.split(weights.reshape(-1, LANES), [taps_z, taps_z + taps_y])
    out[: 2 * LANES] = 0.0
    for k in range(taps_z):
        for j in range(taps_y):
            for i in range(taps_x):
                away = (low_z + k) * plane + (low_y + j) * row + low_x + i
                weight = along_z[k] * along_y[j] * along_x[i]
                out[:LANES] += weight * a[at - away : at - away + LANES]
                out[LANES : 2 * LANES] += weight * b[at + away : at + away + LANES]


@intrinsic
def interpolate(
    typing_context: Any,
    out: Any,
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
    return types.void(out, a, b, i, i, i, weights, i, i, i, i, i, i), _generate_interpolation


def _generate_interpolation(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, a, b, weights = _pointers(context, builder, signature, arguments, (0, 1, 2, 6))
    at, plane, row = arguments[3:6]
    low, taps = arguments[7:10], arguments[10:13]
    tables = [weights]
    for count in taps[:2]:
        tables.append(builder.gep(tables[-1], [builder.mul(count, _index(LANES))]))
    whole = _registers(builder, 2)
    with cgutils.for_range(builder, taps[0]) as k:
        planes = _registers(builder, 2)
        away_z = builder.mul(builder.add(low[0], k.index), plane)
        with cgutils.for_range(builder, taps[1]) as j:
            lines = _registers(builder, 2)
            away_y = builder.add(builder.mul(builder.add(low[1], j.index), row), builder.add(away_z, low[2]))
            with cgutils.for_range(builder, taps[2]) as i:
                away = builder.add(away_y, i.index)
                weight = _load(builder, tables[2], builder.mul(i.index, _index(LANES)))
                for line, source, place in zip(
                    lines, (a, b), (builder.sub(at, away), builder.add(at, away)), strict=True
                ):
                    _add_product(builder, line, _load(builder, source, place), weight)
            weight = _load(builder, tables[1], builder.mul(j.index, _index(LANES)))
            for total, line in zip(planes, lines, strict=True):
                _add_product(builder, total, builder.load(line), weight)
        weight = _load(builder, tables[0], builder.mul(k.index, _index(LANES)))
        for total, part in zip(whole, planes, strict=True):
            _add_product(builder, total, builder.load(part), weight)
    _store(builder, whole, out, [_index(0), _index(LANES)])
    return context.get_dummy_value()


def spline_weights_reference(
    weights: NDArray[np.float32], at: int, places: NDArray[np.float32], places_at: int, low: int, taps: int
) -> None:
    """Write the cubic B-splines B centred on each tap at `LANES` places: the readable twin of `spline_weights`.

    B(s) = [max(0, 2 - |s|)^3 - 4 max(0, 1 - |s|)^3] / 6. Those of the tap `low` go to elements at + l of `weights`,
    those of the next to at + LANES + l, and so on.
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
    weights, places = _pointers(context, builder, signature, arguments, (0, 2))
    _, at, _, places_at, low, taps = arguments
    here = _load(builder, places, places_at)
    with cgutils.for_range(builder, taps) as tap:
        centre = _splat(builder, builder.sitofp(builder.add(low, tap.index), ir.FloatType()))
        away = _call(builder, "fabs", builder.fsub(here, centre))
        outer, inner = (_call(builder, "maxnum", builder.fsub(_constant(r), away), ZERO) for r in (2.0, 1.0))
        outer_cubed, inner_cubed = (builder.fmul(reach, builder.fmul(reach, reach)) for reach in (outer, inner))
        value = builder.fmul(_call(builder, "fma", inner_cubed, _constant(-4.0), outer_cubed), _constant(1.0 / 6.0))
        place = builder.add(at, builder.mul(tap.index, _index(LANES)))
        _store_vector(builder, value, weights, place)
    return context.get_dummy_value()


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
        (places,) = _pointers(context, builder, signature, arguments, (0,))
        best = _load(builder, places, arguments[1])
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


def products_reference(
    out: NDArray[np.float32],
    out_at: int,
    out_step: int,
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    at: int,
    shift: int,
    plane: int,
    row: int,
    planes: int,
    rows: int,
    shifts: int,
) -> None:
    """Sum a(x) b(x + s) + a(x - s) b(x) over planes and rows: the readable twin of `few_products`, `many_products`.

    Lane l of the first row lies at element at + l; the sum for the shift s = shift + m goes to element out_at + m
    out_step + l of `out`, m = 0 ... shifts - 1.
    """
    for m in range(shifts):
        target = out[out_at + m * out_step : out_at + m * out_step + LANES]
        target[:] = 0.0
        for z in range(planes):
            for y in range(rows):
                here = at + z * plane + y * row
                there, back = here + shift + m, here - shift - m
                target += a[here : here + LANES] * b[there : there + LANES]
                target += a[back : back + LANES] * b[here : here + LANES]


@intrinsic
def few_products(
    typing_context: Any,
    out: Any,
    out_at: Any,
    out_step: Any,
    a: Any,
    b: Any,
    at: Any,
    shift: Any,
    plane: Any,
    row: Any,
    planes: Any,
    rows: Any,
) -> Any:
    """Sum products for `FEW_SHIFTS` shifts; see `products_reference`."""
    i = types.int64
    return types.void(out, i, i, a, b, i, i, i, i, i, i), _products_generator(FEW_SHIFTS)


@intrinsic
def many_products(
    typing_context: Any,
    out: Any,
    out_at: Any,
    out_step: Any,
    a: Any,
    b: Any,
    at: Any,
    shift: Any,
    plane: Any,
    row: Any,
    planes: Any,
    rows: Any,
) -> Any:
    """Sum products for `MANY_SHIFTS` shifts; see `products_reference`."""
    i = types.int64
    return types.void(out, i, i, a, b, i, i, i, i, i, i), _products_generator(MANY_SHIFTS)


def _products_generator(shifts: int) -> Any:
    """Return the code generator of `few_products` or `many_products`."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        out, a, b = _pointers(context, builder, signature, arguments, (0, 3, 4))
        out_at, out_step = arguments[1:3]
        at, shift, plane, row, planes, rows = arguments[5:]
        sums = _registers(builder, shifts)
        with cgutils.for_range(builder, planes) as z:
            begin = builder.add(at, builder.mul(z.index, plane))
            with cgutils.for_range(builder, rows) as y:
                here = builder.add(begin, builder.mul(y.index, row))
                a_here, b_here = _load(builder, a, here), _load(builder, b, here)
                for m, total in enumerate(sums):
                    away = builder.add(shift, _index(m))
                    _add_product(builder, total, a_here, _load(builder, b, builder.add(here, away)))
                    _add_product(builder, total, _load(builder, a, builder.sub(here, away)), b_here)
        places = [builder.add(out_at, builder.mul(out_step, _index(m))) for m in range(shifts)]
        _store(builder, sums, out, places)
        return context.get_dummy_value()

    return generate


def _pointers(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any, positions: Sequence[int]) -> Any:
    """Return where the arrays among the arguments begin."""
    return [context.make_array(signature.args[p])(context, builder, arguments[p]).data for p in positions]


def _index(value: int) -> ir.Constant:
    return ir.Constant(INDEX, value)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [value] * LANES)


def _splat(builder: ir.IRBuilder, value: Any) -> Any:
    """Return a vector with one number in every lane."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def _call(builder: ir.IRBuilder, name: str, *vectors: Any) -> Any:
    """Return what one of LLVM's functions of whole vectors gives."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * len(vectors))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), vectors)


def _registers(builder: ir.IRBuilder, count: int) -> list[Any]:
    """Return sums that start at zero; the compiler keeps them in registers."""
    slots = [cgutils.alloca_once(builder, VECTOR) for _ in range(count)]
    for slot in slots:
        builder.store(ZERO, slot)
    return slots


def _load(builder: ir.IRBuilder, array: Any, place: Any) -> Any:
    loaded = builder.load(builder.bitcast(builder.gep(array, [place]), VECTOR.as_pointer()))
    loaded.align = 4
    return loaded


def _store(builder: ir.IRBuilder, sums: Sequence[Any], array: Any, places: Sequence[Any]) -> None:
    for slot, place in zip(sums, places, strict=True):
        _store_vector(builder, builder.load(slot), array, place)


def _store_vector(builder: ir.IRBuilder, vector: Any, array: Any, place: Any) -> None:
    pointer = builder.bitcast(builder.gep(array, [place]), VECTOR.as_pointer())
    builder.store(vector, pointer).align = 4


def _add_product(builder: ir.IRBuilder, slot: Any, a: Any, b: Any) -> None:
    """Add a product to a sum, rounding once."""
    builder.store(_call(builder, "fma", a, b, builder.load(slot)), slot)
