"""The innermost loops of the operators, written for the vector unit.

    out[m] (+)= sum_k share[k, m] source[line[k]]

Some lines of the output are kept in registers over the whole sum, so each number that is loaded is used for all of them
and nothing is stored in between. Where each line has terms of its own, and few, as many lines as a register holds are
summed and stored turned (`combine_turned`). Plain loops do the same (`combine_reference` and its like); the compiler
does not find these forms in them. The sums run over k in order, with fused multiply-adds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
    LANES,
    ZERO,
    add_product,
    in_place_of,
    index,
    integers,
    load,
    load_one,
    pointers,
    registers,
    shuffle,
    splat,
    store,
)

# Lines of the output that share every load, and vectors a line: 8 independent sums keep two fused multiply-add units
# of latency 4 busy and fit the 16 registers of machines with 8 lanes. Two lines, as few terms are shared by more of
# them (a third of the products of four would be with zero).
GROUP, VECTORS = 2, 4
TILE = VECTORS * LANES

Floats = NDArray[np.float32]


def combine_reference(
    shape: tuple[int, int],
    out: Floats,
    to: tuple[int, int, int],
    source: Floats,
    line: NDArray[np.int32],
    terms: tuple[int, int, int, int],
    share: Floats,
    shares: tuple[int, int, int],
) -> None:
    """Set lines to sums of lines, or add these to them: the readable twin of `combine_long`
    and those below.

    Parameters
    ----------
    shape : how many lines are written, and the length of all lines
    out, to : flat; where the first line starts, the step to the next, and 0 where what they hold is overwritten
    source, line, terms : flat; (at, step, first, count), term k is line number `line[first + k]` of those that begin
        `step` apart from `at` on
    share, shares : flat; (at, term step, line step), term k in line m is taken `share[at + k term step + m line step]`
        times
    """
    lines, length = shape
    at, step, first, count = terms
    share_at, term_step, line_step = shares
    for m in range(lines):
        begin = to[0] + m * to[1]
        target = out[begin : begin + length]
        if to[2] == 0:
            target[:] = 0.0
        for k in range(count):
            here = at + step * line[first + k]
            taken, weight = source[here : here + length], share[share_at + k * term_step + m * line_step]
            for lane in range(length):
                target[lane] += weight * taken[lane]


def _combine(lines: int, vectors: int) -> Any:
    """Return what combines into some lines of some vectors; see `combine_reference`."""

    def twin(out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, shares: Any) -> None:
        combine_reference((lines, vectors * LANES), out, to, source, line, terms, share, shares)

    @in_place_of(twin)
    def combine(
        typing_context: Any, out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, shares: Any
    ) -> Any:
        three, four = integers(3), integers(4)
        return types.void(out, three, source, line, four, share, three), _generator(lines, vectors)

    return combine


def _generator(lines: int, vectors: int) -> Callable[..., Any]:
    """Return the code generator for some lines of some vectors."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        out, source, line, share = pointers(context, builder, signature, arguments, (0, 2, 3, 5))
        at, step, kept = cgutils.unpack_tuple(builder, arguments[1], 3)
        source_at, source_step, first, count = cgutils.unpack_tuple(builder, arguments[4], 4)
        share_at, term_step, line_step = cgutils.unpack_tuple(builder, arguments[6], 3)
        places = []
        for m in range(lines):
            begin = builder.add(at, builder.mul(step, index(m)))
            places += [builder.add(begin, index(v * LANES)) for v in range(vectors)]
        onto = builder.icmp_signed("!=", kept, index(0))
        sums = registers(builder, [builder.select(onto, load(builder, out, place), ZERO) for place in places])
        with cgutils.for_range(builder, count) as k:
            number = builder.sext(load_one(builder, line, builder.add(first, k.index)), count.type)
            begin = builder.add(source_at, builder.mul(number, source_step))
            taken = [load(builder, source, builder.add(begin, index(v * LANES))) for v in range(vectors)]
            weight_at = builder.add(share_at, builder.mul(k.index, term_step))
            for m in range(lines):
                weight = splat(
                    builder, load_one(builder, share, builder.add(weight_at, builder.mul(line_step, index(m))))
                )
                for v in range(vectors):
                    add_product(builder, sums[m * vectors + v], taken[v], weight)
        for slot, place in zip(sums, places, strict=True):
            store(builder, builder.load(slot), out, place)
        return context.get_dummy_value()

    return generate


# Times faster than the twin as a plain loop, with 16 lanes and with 8: 6 and 15.
combine_long = _combine(GROUP, VECTORS)
# 4 and 17 times.
combine_line = _combine(1, VECTORS)
# 9 and 7 times.
combine_vector = _combine(1, 1)
# Rows of a lens's pixels: as many as a lens of 18 has, in three steps.
ROWS = 6
combine_rows = _combine(ROWS, 1)


def turn_reference(out: Floats, to: tuple[int, int], source: Floats, lines: tuple[int, int]) -> None:
    """Exchange the rows and columns of `LANES` x `LANES` numbers: the readable twin of `turn`.

    Parameters
    ----------
    out, to, source, lines : flat; where the first line starts, and the step to the next
    """
    for m in range(LANES):
        for n in range(LANES):
            out[to[0] + n * to[1] + m] = source[lines[0] + m * lines[1] + n]


@in_place_of(turn_reference)
def turn(typing_context: Any, out: Any, to: Any, source: Any, lines: Any) -> Any:
    """Exchange rows and columns; see `turn_reference`.

    Times faster than this as a plain loop: 13 with 16 lanes, 10 with 8.
    """
    return types.void(out, integers(2), source, integers(2)), _generate_turn


def _generate_turn(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, source = pointers(context, builder, signature, arguments, (0, 2))
    at, step = cgutils.unpack_tuple(builder, arguments[1], 2)
    source_at, source_step = cgutils.unpack_tuple(builder, arguments[3], 2)
    lines = [load(builder, source, step_on(builder, source_at, source_step, m)) for m in range(LANES)]
    for n, line in enumerate(transposed(builder, lines)):
        store(builder, line, out, step_on(builder, at, step, n))
    return context.get_dummy_value()


def combine_turned_reference(
    out: Floats,
    to: tuple[int, int],
    source: Floats,
    line: NDArray[np.int32],
    terms: tuple[int, int, int, int],
    share: Floats,
    share_at: int,
) -> None:
    """Sum neighbouring lines for each of `LANES` columns: the readable twin of `combine_turned`.

    Parameters
    ----------
    out, to : flat; where the first of `LANES` lines starts, and the step to the next
    source, line, terms : flat; (at, step, first, count), lines begin `step` apart from `at` on, those of column m are
        the `count` from number `line[first + m]` on
    share, share_at : flat; term k in column m is taken `share[share_at + k LANES + m]` times
    """
    at, step, first, count = terms
    for m in range(LANES):
        for n in range(LANES):
            total = np.float32(0.0)
            for k in range(count):
                total += share[share_at + k * LANES + m] * source[at + step * (line[first + m] + k) + n]
            out[to[0] + n * to[1] + m] = total


@in_place_of(combine_turned_reference)
def combine_turned(
    typing_context: Any, out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, share_at: Any
) -> Any:
    """Sum lines into columns; see `combine_turned_reference`.

    Times faster than this as a plain loop: 27 with 16 lanes, 24 with 8.
    """
    return types.void(out, integers(2), source, line, integers(4), share, types.int64), _generate_combine_turned


def _generate_combine_turned(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, source, line, share = pointers(context, builder, signature, arguments, (0, 2, 3, 5))
    at, step = cgutils.unpack_tuple(builder, arguments[1], 2)
    source_at, source_step, first, count = cgutils.unpack_tuple(builder, arguments[4], 4)
    sums = registers(builder, [ZERO] * LANES)
    numbers = [load_one(builder, line, builder.add(first, index(m))) for m in range(LANES)]
    numbers = [builder.sext(number, count.type) for number in numbers]
    with cgutils.for_range(builder, count) as k:
        begin = builder.add(source_at, builder.mul(k.index, source_step))
        shares = builder.add(arguments[6], builder.mul(k.index, index(LANES)))
        for m in range(LANES):
            taken = load(builder, source, builder.add(begin, builder.mul(numbers[m], source_step)))
            weight = splat(builder, load_one(builder, share, builder.add(shares, index(m))))
            add_product(builder, sums[m], taken, weight)
    for n, row in enumerate(transposed(builder, [builder.load(one) for one in sums])):
        store(builder, row, out, step_on(builder, at, step, n))
    return context.get_dummy_value()


def step_on(builder: ir.IRBuilder, at: Any, step: Any, times: int) -> Any:
    return builder.add(at, builder.mul(step, index(times)))


def transposed(builder: ir.IRBuilder, lines: Sequence[Any]) -> list[Any]:
    """Return the columns of `LANES` vectors, exchanging halves, then quarters of these, down to single numbers."""
    rows, half = list(lines), LANES // 2
    while half:
        lanes = range(LANES)
        low = [lane if not lane & half else LANES + lane - half for lane in lanes]
        high = [lane + half if not lane & half else LANES + lane for lane in lanes]
        for m in (m for m in lanes if not m & half):
            pair = rows[m], rows[m + half]
            rows[m], rows[m + half] = (shuffle(builder, *pair, order) for order in (low, high))
        half //= 2
    return rows


# Sums of lines whose shares change from lane to lane: with a polynomial of the second degree in a lane's place.
#
#     out[n] (+)= sum_k w[k, n] source[line[k]][n],     w[k, n] = max(0, c[k, 0] + t[n] (c[k, 1] + t[n] c[k, 2]))
#
# As `combine` otherwise, with its readable twins.


# Coefficients of a share.
COEFFICIENTS = 3


def combine_turned_varying_reference(
    out: Floats,
    to: tuple[int, int],
    source: Floats,
    line: NDArray[np.int32],
    terms: tuple[int, int, int, int],
    share: Floats,
    share_at: int,
    places: Floats,
    places_at: int,
) -> None:
    """Sum neighbouring lines for each of `LANES` columns: the readable twin of `combine_turned_varying`.

    Parameters
    ----------
    out, to, source, line, terms : as of `combine_turned_reference`
    share, share_at : flat; coefficient c of term k in column m is `share[share_at + (k COEFFICIENTS + c) LANES + m]`
    places, places_at : flat; lane n has the place `places[places_at + n]`
    """
    at, step, first, count = terms
    for m in range(LANES):
        for n in range(LANES):
            total, t = np.float32(0.0), places[places_at + n]
            for k in range(count):
                c = share_at + k * COEFFICIENTS * LANES + m
                weight = share[c] + t * (share[c + LANES] + t * share[c + 2 * LANES])
                if weight > 0.0:
                    total += weight * source[at + step * (line[first + m] + k) + n]
            out[to[0] + n * to[1] + m] = total


@in_place_of(combine_turned_varying_reference)
def combine_turned_varying(
    typing_context: Any,
    out: Any,
    to: Any,
    source: Any,
    line: Any,
    terms: Any,
    share: Any,
    share_at: Any,
    places: Any,
    places_at: Any,
) -> Any:
    """Sum lines into columns; see `combine_turned_varying_reference`."""
    kinds = out, integers(2), source, line, integers(4), share, types.int64, places, types.int64
    return types.void(*kinds), _generate_turned


def _generate_turned(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, source, line, share, places = pointers(context, builder, signature, arguments, (0, 2, 3, 5, 7))
    at, step = cgutils.unpack_tuple(builder, arguments[1], 2)
    source_at, source_step, first, count = cgutils.unpack_tuple(builder, arguments[4], 4)
    sums = registers(builder, [ZERO] * LANES)
    place = load(builder, places, arguments[8])
    numbers = [load_one(builder, line, builder.add(first, index(m))) for m in range(LANES)]
    numbers = [builder.sext(number, count.type) for number in numbers]
    with cgutils.for_range(builder, count) as k:
        begin = builder.add(source_at, builder.mul(k.index, source_step))
        shares = builder.add(arguments[6], builder.mul(k.index, index(COEFFICIENTS * LANES)))
        for m in range(LANES):
            taken = load(builder, source, builder.add(begin, builder.mul(numbers[m], source_step)))
            weight = _weight(builder, share, builder.add(shares, index(m)), LANES, place)
            add_product(builder, sums[m], taken, weight)
    for n, row in enumerate(transposed(builder, [builder.load(one) for one in sums])):
        store(builder, row, out, step_on(builder, at, step, n))
    return context.get_dummy_value()


def combine_varying_reference(
    out: Floats,
    at: int,
    source: Floats,
    line: NDArray[np.int32],
    terms: tuple[int, int, int, int],
    share: Floats,
    share_at: int,
    places: Floats,
    places_at: int,
) -> None:
    """Add a sum of `LANES` numbers of each of some lines: the readable twin of `combine_varying`.

    Parameters
    ----------
    out, at, source, line, terms : of `combine_reference`
    share, share_at : flat; coefficient c of term k is `share[share_at + k COEFFICIENTS + c]`
    places, places_at : flat; lane n has the place `places[places_at + n]`
    """
    begin, step, first, count = terms
    for n in range(LANES):
        t = places[places_at + n]
        for k in range(count):
            c = share_at + k * COEFFICIENTS
            weight = share[c] + t * (share[c + 1] + t * share[c + 2])
            if weight > 0.0:
                out[at + n] += weight * source[begin + step * line[first + k] + n]


@in_place_of(combine_varying_reference)
def combine_varying(
    typing_context: Any,
    out: Any,
    at: Any,
    source: Any,
    line: Any,
    terms: Any,
    share: Any,
    share_at: Any,
    places: Any,
    places_at: Any,
) -> Any:
    """Add a sum of parts of lines; see `combine_varying_reference`."""
    kinds = out, types.int64, source, line, integers(4), share, types.int64, places, types.int64
    return types.void(*kinds), _generate


def _generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    out, source, line, share, places = pointers(context, builder, signature, arguments, (0, 2, 3, 5, 7))
    source_at, source_step, first, count = cgutils.unpack_tuple(builder, arguments[4], 4)
    (total,) = registers(builder, [load(builder, out, arguments[1])])
    place = load(builder, places, arguments[8])
    with cgutils.for_range(builder, count) as k:
        number = builder.sext(load_one(builder, line, builder.add(first, k.index)), count.type)
        taken = load(builder, source, builder.add(source_at, builder.mul(number, source_step)))
        shares = builder.add(arguments[6], builder.mul(k.index, index(COEFFICIENTS)))
        add_product(builder, total, taken, _weight(builder, share, shares, 1, place))
    store(builder, builder.load(total), out, arguments[1])
    return context.get_dummy_value()


def _weight(builder: ir.IRBuilder, share: Any, at: Any, step: int, place: Any) -> Any:
    """Return the share of each lane, from coefficients `step` apart."""
    first, *higher = (
        splat(builder, load_one(builder, share, builder.add(at, index(c * step)))) for c in range(COEFFICIENTS)
    )
    inner = registers(builder, [higher[0]])[0]
    add_product(builder, inner, place, higher[1])
    weight = registers(builder, [first])[0]
    add_product(builder, weight, place, builder.load(inner))
    found = builder.load(weight)
    return builder.select(builder.fcmp_ordered(">", found, ZERO), found, ZERO)
