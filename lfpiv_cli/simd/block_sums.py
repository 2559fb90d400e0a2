"""Sums over the planes and rows of blocks, written for the vector unit: many neighbours along x at once.

Plain loops do the same (`products_reference`, `moments_reference`); the compiler does not find these forms in them and
keeps the sums in memory rather than in registers. Arrays are flat, float32 but for flags; places and strides count
elements; sums run in the order of the loops with fused multiply-adds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
    FLAGS,
    LANES,
    VECTOR,
    ZERO,
    add_product,
    constant,
    for_each,
    in_place_of,
    index,
    integers,
    load,
    pointers,
    registers,
    store,
)

Floats = NDArray[np.float32]

# Shifts along x that share their loads: with five of them all sums of a radius of 2 stay in registers.
FEW_SHIFTS, MANY_SHIFTS = 3, 5
# Products of three derivatives, a mean and a difference: ten among the first four, and four with the difference.
MOMENTS = 14


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
        shift, begin = shifts[0] + m, to[0] + m * to[1]
        for lane in range(LANES):
            forward, back = np.float32(0.0), np.float32(0.0)
            for z in range(extent[0]):
                for y in range(extent[1]):
                    here = at + z * plane + y * row + lane
                    forward += a[here] * b[here + shift]
                    back += a[here - shift] * b[here]
            out[begin + lane] = forward + back


@in_place_of(products_reference)
def products(typing_context: Any, out: Any, to: Any, a: Any, b: Any, places: Any, extent: Any, shifts: Any) -> Any:
    """Sum products for several shifts; see `products_reference`."""
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
    triangle of the products q q, row by row, then q r. Voxels with a neighbour that is not valid are left out.

    Parameters
    ----------
    out, to : where the first moment goes, `LANES` lanes, and the step to the next
    a, b, valid, places : (at, plane step, row step), lane l of the first row lies at element at + l
    extent : planes, rows
    """
    at, plane, row = places
    known = np.zeros(4, np.float32)
    for lane in range(LANES):
        sums = np.zeros(MOMENTS, np.float32)
        for z in range(extent[0]):
            for y in range(extent[1]):
                here = at + z * plane + y * row + lane
                kept = valid[here]
                for axis, step in enumerate((1, row, plane)):
                    before, after = here - step, here + step
                    kept &= valid[before] & valid[after]
                    slope = (a[after] + b[after]) - (a[before] + b[before])
                    known[axis] = np.float32(0.25) * slope
                known[3] = np.float32(0.5) * (a[here] + b[here])
                rest = b[here] - a[here]
                m = 0
                for i in range(4):
                    known[i] *= np.float32(kept)
                    sums[MOMENTS - 4 + i] += known[i] * rest
                for i in range(4):
                    for j in range(i, 4):
                        sums[m] += known[i] * known[j]
                        m += 1
        for m in range(MOMENTS):
            out[to[0] + m * to[1] + lane] = sums[m]


@in_place_of(moments_reference)
def moments(typing_context: Any, out: Any, to: Any, a: Any, b: Any, valid: Any, places: Any, extent: Any) -> Any:
    """Sum products of gradient, mean and difference; see `moments_reference`."""
    two, three = integers(2), integers(3)
    return types.void(out, two, a, b, valid, three, two), _generate_moments


def _generate_moments(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, a, b, valid = pointers(context, builder, signature, arguments, (0, 2, 3, 4))
    out_at, out_step = cgutils.unpack_tuple(builder, arguments[1], 2)
    at, plane, row = cgutils.unpack_tuple(builder, arguments[5], 3)
    planes, rows = cgutils.unpack_tuple(builder, arguments[6], 2)
    sums = registers(builder, [ZERO] * MOMENTS)

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
    for m, slot in enumerate(sums):
        store(builder, builder.load(slot), out, builder.add(out_at, builder.mul(out_step, index(m))))
    return context.get_dummy_value()
