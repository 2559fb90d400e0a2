"""Sums over the planes and rows of blocks, written for the vector unit: 16 neighbours along x at once.

Plain loops do the same (`products_reference`, `moments_reference`); the compiler does not find these forms in them,
keeps the sums in memory rather than in registers, and is five times slower. Arrays are flat, float32 but for flags;
places and strides count elements; sums run in the order of the loops with fused multiply-adds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
    FLAGS,
    LANES,
    VECTOR,
    add_product,
    constant,
    for_each,
    index,
    load,
    pointers,
    registers,
    store,
    store_vector,
)

# Shifts along x that share their loads: with five of them all sums of a radius of 2 stay in registers.
FEW_SHIFTS, MANY_SHIFTS = 3, 5
# Products of three derivatives, a mean and a difference: ten among the first four, and four with the difference.
MOMENTS = 14


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
    """Sum a(x) b(x + s) + a(x - s) b(x) over planes and rows: the readable twin of `products`.

    Lane l of the first row lies at element at + l; the sum for the shift s = shift + m goes to element out_at + m
    out_step + l of `out`, m = 0 ... shifts - 1. There are `FEW_SHIFTS` or `MANY_SHIFTS`.
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
def products(
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
    shifts: Any,
) -> Any:
    """Sum products for several shifts; see `products_reference`."""
    i = types.int64
    return types.void(out, i, i, a, b, i, i, i, i, i, i, i), _generate_products


def _generate_products(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, a, b = pointers(context, builder, signature, arguments, (0, 3, 4))
    out_at, out_step = arguments[1:3]
    at, shift, plane, row, planes, rows, count = arguments[5:]

    def sum_products(shifts: int) -> None:
        # Two sums a shift: the next product need not wait for the last one.
        forward, back = registers(builder, shifts), registers(builder, shifts)
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
            store_vector(builder, both, out, builder.add(out_at, builder.mul(out_step, index(m))))

    for_each(builder, count, (FEW_SHIFTS, MANY_SHIFTS), sum_products)
    return context.get_dummy_value()


def moments_reference(
    out: NDArray[np.float32],
    out_at: int,
    out_step: int,
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    valid: NDArray[np.uint8],
    at: int,
    plane: int,
    row: int,
    planes: int,
    rows: int,
) -> None:
    """Sum products of gradient, mean and difference over planes and rows: the readable twin of `moments`.

    Of the mean M = (a + b) / 2 and its central differences, q = (dM/dx, dM/dy, dM/dz, M), and of r = b - a: the upper
    triangle of the products q q, row by row, then q r. Voxels with a neighbour that is not valid are left out. Lane l
    of the first row lies at element at + l; moment m goes to element out_at + m out_step + l of `out`.
    """

    def taken(volume: NDArray, place: int) -> NDArray:
        return volume[place : place + LANES]

    sums = np.zeros((MOMENTS, LANES), np.float32)
    for z in range(planes):
        for y in range(rows):
            here = at + z * plane + y * row
            steps = (1, row, plane)
            kept = taken(valid, here).copy()
            for step in steps:
                kept &= taken(valid, here - step) & taken(valid, here + step)
            mean = 0.5 * (a + b)
            q = [0.5 * (taken(mean, here + step) - taken(mean, here - step)) for step in steps] + [taken(mean, here)]
            r = taken(b, here) - taken(a, here)
            pairs = [(q[i], q[j]) for i in range(len(q)) for j in range(i, len(q))] + [(one, r) for one in q]
            for total, (one, other) in zip(sums, pairs, strict=True):
                total += kept * one * other
    for m, total in enumerate(sums):
        out[out_at + m * out_step : out_at + m * out_step + LANES] = total


@intrinsic
def moments(
    typing_context: Any,
    out: Any,
    out_at: Any,
    out_step: Any,
    a: Any,
    b: Any,
    valid: Any,
    at: Any,
    plane: Any,
    row: Any,
    planes: Any,
    rows: Any,
) -> Any:
    """Sum products of gradient, mean and difference; see `moments_reference`."""
    i = types.int64
    return types.void(out, i, i, a, b, valid, i, i, i, i, i), _generate_moments


def _generate_moments(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, a, b, valid = pointers(context, builder, signature, arguments, (0, 3, 4, 5))
    out_at, out_step = arguments[1:3]
    at, plane, row, planes, rows = arguments[6:]
    sums = registers(builder, MOMENTS)

    def total(place: Any) -> Any:
        return builder.fadd(load(builder, a, place), load(builder, b, place))

    with cgutils.for_range(builder, planes) as z:
        begin = builder.add(at, builder.mul(z.index, plane))
        with cgutils.for_range(builder, rows) as y:
            here = builder.add(begin, builder.mul(y.index, row))
            kept = load(builder, valid, here, FLAGS)
            known = []
            for step in (index(1), row, plane):
                before, after = builder.sub(here, step), builder.add(here, step)
                for place in (before, after):
                    kept = builder.and_(kept, load(builder, valid, place, FLAGS))
                known.append(builder.fmul(constant(0.25), builder.fsub(total(after), total(before))))
            known.append(builder.fmul(constant(0.5), total(here)))
            rest = builder.fsub(load(builder, b, here), load(builder, a, here))
            kept = builder.uitofp(kept, VECTOR)
            known = [builder.fmul(kept, one) for one in known]
            pairs = [(one, other) for i, one in enumerate(known) for other in known[i:]]
            for slot, (one, other) in zip(sums, pairs + [(one, rest) for one in known], strict=True):
                add_product(builder, slot, one, other)
    store(builder, sums, out, [builder.add(out_at, builder.mul(out_step, index(m))) for m in range(len(sums))])
    return context.get_dummy_value()
