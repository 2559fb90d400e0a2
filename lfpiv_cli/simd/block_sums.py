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
