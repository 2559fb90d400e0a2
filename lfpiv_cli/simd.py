"""The innermost loops of the weights' operators, written for the vector unit: as many numbers at once as it holds.

    out[m] (+)= sum_k share[k, m] source[line[k]]

Some lines of the output are kept in registers over the whole sum, so each number that is loaded is used for all of them
and nothing is stored in between. Where each line has terms of its own, and few, as many lines as a register holds are
summed and stored turned. The sums run over k in order, with fused multiply-adds, each lane a sum of its own, so the
number of lanes changes no result.

Every intrinsic has a readable twin, which stands in its place where compilation is switched off (`NUMBA_DISABLE_JIT`).
The compiler does not find these forms in plain loops, which it is told may sum in any order: a forward and an adjoint
product take 3.0 times as long by them (`python -m benchmarks simd` has each intrinsic's share in that). Loops for which
the like made less than 1.3 times of the whole work are plain ones.

A `place` counts elements from the start of a flat array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.core.types import int64, void
from numba.core.types.containers import UniTuple
from numba.extending import intrinsic
from numpy.typing import NDArray


def lanes_of(features: str) -> int:
    """Return how many float32 numbers a register holds, from LLVM's list of a processor's features.

    Elsewhere 8: LLVM halves these where registers are shorter still.
    """
    return 16 if "+avx512f" in features.split(",") else 8


# Of the processor that numba compiles for, which names its cached code as well.
LANES = lanes_of(cpu_target.target_context.codegen().magic_tuple()[2])
# Lines of the output that share every load, and vectors a line: 8 independent sums keep two fused multiply-add units
# of latency 4 busy and fit the 16 registers of machines with 8 lanes. Two lines, as few terms are shared by more of
# them (a third of the products of four would be with zero).
GROUP, VECTORS = 2, 4
TILE = VECTORS * LANES
# Rows of a lens's pixels: as many as a lens of 18 has, in three steps.
ROWS = 6
# Of a share that changes from lane to lane, a polynomial of the second degree in a lane's place t:
# w = max(0, c[0] + t (c[1] + t c[2])).
COEFFICIENTS = 3

Floats = NDArray[np.float32]
# Places, steps and counts that belong together.
TWO, THREE, FOUR = (UniTuple(int64, count) for count in (2, 3, 4))
VECTOR = ir.VectorType(ir.FloatType(), LANES)
ZERO = ir.Constant(VECTOR, [0.0] * LANES)


def in_place_of(twin: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make an intrinsic of the decorated typing function, or give its readable twin where nothing is compiled."""
    return lambda typing: twin if config.DISABLE_JIT else intrinsic(typing)


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
    """Set lines to sums of lines, or add these to them: the readable twin of `combine_long` and its like.

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
    def combine(typing: Any, out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, shares: Any) -> Any:
        return void(out, THREE, source, line, FOUR, share, THREE), generate

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        out, source, line, share = _pointers(context, builder, signature, arguments, (0, 2, 3, 5))
        at, step, kept = cgutils.unpack_tuple(builder, arguments[1], 3)
        source_at, source_step, first, count = cgutils.unpack_tuple(builder, arguments[4], 4)
        share_at, term_step, line_step = cgutils.unpack_tuple(builder, arguments[6], 3)
        begins = [_step_on(builder, at, step, m) for m in range(lines)]
        places = [builder.add(begin, _index(v * LANES)) for begin in begins for v in range(vectors)]
        onto = builder.icmp_signed("!=", kept, _index(0))
        sums = _registers(builder, [builder.select(onto, _load(builder, out, place), ZERO) for place in places])
        with cgutils.for_range(builder, count) as k:
            number = builder.sext(_load_one(builder, line, builder.add(first, k.index)), count.type)
            begin = builder.add(source_at, builder.mul(number, source_step))
            taken = [_load(builder, source, builder.add(begin, _index(v * LANES))) for v in range(vectors)]
            weight_at = builder.add(share_at, builder.mul(k.index, term_step))
            for m in range(lines):
                weight = _splat(builder, _load_one(builder, share, _step_on(builder, weight_at, line_step, m)))
                for v in range(vectors):
                    _add_product(builder, sums[m * vectors + v], taken[v], weight)
        for slot, place in zip(sums, places, strict=True):
            _store(builder, builder.load(slot), out, place)
        return context.get_dummy_value()

    return combine


# Times faster than the twin as a plain loop that may sum in any order, with 16 lanes: 2.7, 2.2, 3.6 and 10.
combine_long = _combine(GROUP, VECTORS)
combine_line = _combine(1, VECTORS)
combine_vector = _combine(1, 1)
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
def turn(typing: Any, out: Any, to: Any, source: Any, lines: Any) -> Any:
    """Exchange rows and columns; see `turn_reference`. 4.6 times faster than this as a plain loop."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        out, source = _pointers(context, builder, signature, arguments, (0, 2))
        at, step = cgutils.unpack_tuple(builder, arguments[3], 2)
        lines = [_load(builder, source, _step_on(builder, at, step, m)) for m in range(LANES)]
        _store_turned(builder, lines, out, cgutils.unpack_tuple(builder, arguments[1], 2))
        return context.get_dummy_value()

    return void(out, TWO, source, TWO), generate


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


@in_place_of(combine_turned_reference)
def combine_turned(typing: Any, out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, at: Any) -> Any:
    """Sum lines into columns; see `combine_turned_reference`. 9 times faster than this as a plain loop."""
    return void(out, TWO, source, line, FOUR, share, int64), _generate_turned


@in_place_of(combine_turned_varying_reference)
def combine_turned_varying(
    typing: Any, out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, at: Any, places: Any, places_at: Any
) -> Any:
    """Sum lines into columns; see `combine_turned_varying_reference`. 9 times faster than this as a plain loop."""
    return void(out, TWO, source, line, FOUR, share, int64, places, int64), _generate_turned


def _generate_turned(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    """Generate code for the sums into columns, of shares that vary where there are places."""
    out, source, line, share = _pointers(context, builder, signature, arguments, (0, 2, 3, 5))
    source_at, source_step, first, count = cgutils.unpack_tuple(builder, arguments[4], 4)
    coefficients, place = 1, None
    if len(arguments) > 7:
        (places,) = _pointers(context, builder, signature, arguments, (7,))
        coefficients, place = COEFFICIENTS, _load(builder, places, arguments[8])
    sums = _registers(builder, [ZERO] * LANES)
    numbers = [_load_one(builder, line, builder.add(first, _index(m))) for m in range(LANES)]
    numbers = [builder.sext(number, count.type) for number in numbers]
    with cgutils.for_range(builder, count) as k:
        begin = builder.add(source_at, builder.mul(k.index, source_step))
        shares = builder.add(arguments[6], builder.mul(k.index, _index(coefficients * LANES)))
        for m in range(LANES):
            taken = _load(builder, source, builder.add(begin, builder.mul(numbers[m], source_step)))
            weight = _weight(builder, share, builder.add(shares, _index(m)), LANES, place)
            _add_product(builder, sums[m], taken, weight)
    columns = [builder.load(one) for one in sums]
    _store_turned(builder, columns, out, cgutils.unpack_tuple(builder, arguments[1], 2))
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
    typing: Any, out: Any, at: Any, source: Any, line: Any, terms: Any, share: Any, by: Any, places: Any, places_at: Any
) -> Any:
    """Add a sum of parts of lines; see `combine_varying_reference`. 9 times faster than this as a plain loop."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        out, source, line, share, places = _pointers(context, builder, signature, arguments, (0, 2, 3, 5, 7))
        source_at, source_step, first, count = cgutils.unpack_tuple(builder, arguments[4], 4)
        (total,) = _registers(builder, [_load(builder, out, arguments[1])])
        place = _load(builder, places, arguments[8])
        with cgutils.for_range(builder, count) as k:
            number = builder.sext(_load_one(builder, line, builder.add(first, k.index)), count.type)
            taken = _load(builder, source, builder.add(source_at, builder.mul(number, source_step)))
            shares = builder.add(arguments[6], builder.mul(k.index, _index(COEFFICIENTS)))
            _add_product(builder, total, taken, _weight(builder, share, shares, 1, place))
        _store(builder, builder.load(total), out, arguments[1])
        return context.get_dummy_value()

    return void(out, int64, source, line, FOUR, share, int64, places, int64), generate


def _weight(builder: ir.IRBuilder, share: Any, at: Any, step: int, place: Any) -> Any:
    """Return the share of each lane: one number, or from coefficients `step` apart where it depends on the place."""
    count = 1 if place is None else COEFFICIENTS
    known = [_splat(builder, _load_one(builder, share, builder.add(at, _index(c * step)))) for c in range(count)]
    if place is None:
        return known[0]
    found = _fused(builder, place, _fused(builder, place, known[2], known[1]), known[0])
    return builder.select(builder.fcmp_ordered(">", found, ZERO), found, ZERO)


def _store_turned(builder: ir.IRBuilder, lines: Sequence[Any], out: Any, to: Sequence[Any]) -> None:
    """Write the columns of `LANES` vectors, exchanging halves, then quarters of these, down to single numbers."""
    rows, half, lanes = list(lines), LANES // 2, range(LANES)
    while half:
        low = [lane if not lane & half else LANES + lane - half for lane in lanes]
        high = [lane + half if not lane & half else LANES + lane for lane in lanes]
        for m in (m for m in lanes if not m & half):
            pair = rows[m], rows[m + half]
            rows[m], rows[m + half] = (builder.shuffle_vector(*pair, _lanes(order)) for order in (low, high))
        half //= 2
    at, step = to
    for n, row in enumerate(rows):
        _store(builder, row, out, _step_on(builder, at, step, n))


def _pointers(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any, positions: Sequence[int]) -> Any:
    """Return where the arrays among the arguments begin."""
    return [context.make_array(signature.args[p])(context, builder, arguments[p]).data for p in positions]


def _index(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(64), value)


def _lanes(order: Sequence[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(order))


def _step_on(builder: ir.IRBuilder, at: Any, step: Any, times: int) -> Any:
    return builder.add(at, builder.mul(step, _index(times)))


def _splat(builder: ir.IRBuilder, value: Any) -> Any:
    """Return a vector with one number in every lane."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, _lanes([0] * LANES))


def _registers(builder: ir.IRBuilder, starts: Sequence[Any]) -> list[Any]:
    """Return sums that start at some vectors; the compiler keeps them in registers."""
    slots = [cgutils.alloca_once(builder, VECTOR) for _ in starts]
    for slot, start in zip(slots, starts, strict=True):
        builder.store(start, slot)
    return slots


def _load(builder: ir.IRBuilder, array: Any, place: Any) -> Any:
    loaded = builder.load(builder.bitcast(builder.gep(array, [place]), VECTOR.as_pointer()))
    loaded.align = 4
    return loaded


def _load_one(builder: ir.IRBuilder, array: Any, place: Any) -> Any:
    """Return a single element of an array."""
    return builder.load(builder.gep(array, [place]))


def _store(builder: ir.IRBuilder, vector: Any, array: Any, place: Any) -> None:
    pointer = builder.bitcast(builder.gep(array, [place]), VECTOR.as_pointer())
    builder.store(vector, pointer).align = 4


def _fused(builder: ir.IRBuilder, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c, rounded once."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f32"), [a, b, c])


def _add_product(builder: ir.IRBuilder, slot: Any, a: Any, b: Any) -> None:
    """Add a product to a sum."""
    builder.store(_fused(builder, a, b, builder.load(slot)), slot)
