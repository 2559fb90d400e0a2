"""The innermost loop of the operators, written for the vector unit.

    out[m] (+)= sum_k share[k, m] source[line[k]],    m = 0..3, lines of 16 float32

Four lines are kept in registers over the whole sum, so each number that is loaded is used four times and nothing is
stored in between. A plain loop does the same (`combine_reference`); the compiler does not find this form in it and
reaches half the speed. The sums run over k in order, with fused multiply-adds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

# Lines of the output that share every load, and their length: 4 x 2 vectors of 8 are the 8 independent sums that keep
# two fused multiply-add units of latency 4 busy, and fit the 16 registers of the narrowest machines in use.
GROUP = 4
TILE = 16
LANES = 8

INDEX = ir.IntType(64)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
SPLAT = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)


def combine_reference(
    out: NDArray[np.float32],
    at: int,
    out_step: int,
    source: NDArray[np.float32],
    source_at: int,
    line: NDArray[np.int32],
    first: int,
    count: int,
    share: NDArray[np.float32],
    share_at: int,
    term_step: int,
    row_step: int,
    accumulate: bool,
) -> None:
    """Combine lines of 16: the readable twin of `combine` and `combine_onto`.

    All arrays are flat; places and steps count elements. Output line m starts at `at + m out_step`; term k is the line
    `line[first + k]` of the lines from `source_at` on, times `share[share_at + k term_step + m row_step]`.
    """
    for m in range(GROUP):
        target = out[at + m * out_step : at + m * out_step + TILE]
        if not accumulate:
            target[:] = 0.0
        for k in range(count):
            begin = source_at + TILE * int(line[first + k])
            target += share[share_at + k * term_step + m * row_step] * source[begin : begin + TILE]


def _signature(out: Any, source: Any, line: Any, share: Any) -> Any:
    i = types.int64
    return types.void(out, i, i, source, i, line, i, i, share, i, i, i)


@intrinsic
def combine(
    typing_context: Any,
    out: Any,
    at: Any,
    out_step: Any,
    source: Any,
    source_at: Any,
    line: Any,
    first: Any,
    count: Any,
    share: Any,
    share_at: Any,
    term_step: Any,
    row_step: Any,
) -> Any:
    """Set four lines of 16 to sums of lines; see `combine_reference`."""
    return _signature(out, source, line, share), _generator(accumulate=False)


@intrinsic
def combine_onto(
    typing_context: Any,
    out: Any,
    at: Any,
    out_step: Any,
    source: Any,
    source_at: Any,
    line: Any,
    first: Any,
    count: Any,
    share: Any,
    share_at: Any,
    term_step: Any,
    row_step: Any,
) -> Any:
    """Add sums of lines to four lines of 16; see `combine_reference`."""
    return _signature(out, source, line, share), _generator(accumulate=True)


def _generator(accumulate: bool) -> Any:
    """Return the code generator of `combine` or `combine_onto`."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        def pointer(position: int) -> Any:
            return context.make_array(signature.args[position])(context, builder, arguments[position]).data

        out, source, line, share = (pointer(position) for position in (0, 3, 5, 8))
        _, at, out_step, _, source_at, _, first, count, _, share_at, term_step, row_step = arguments
        places = [_vector_places(builder, at, out_step, m) for m in range(GROUP)]
        start = [[_load(builder, out, place) if accumulate else _zero() for place in row] for row in places]
        before = builder.block
        test, body, after = (builder.append_basic_block(name) for name in ("terms", "term", "summed"))
        builder.branch(test)

        builder.position_at_end(test)
        k = builder.phi(INDEX)
        sums = [[builder.phi(VECTOR) for _ in row] for row in start]
        builder.cbranch(builder.icmp_signed("<", k, count), body, after)

        builder.position_at_end(body)
        number = builder.sext(builder.load(builder.gep(line, [builder.add(first, k)])), INDEX)
        begin = builder.add(source_at, builder.mul(number, ir.Constant(INDEX, TILE)))
        vectors = [_load(builder, source, builder.add(begin, ir.Constant(INDEX, v))) for v in range(0, TILE, LANES)]
        weight_at = builder.add(share_at, builder.mul(k, term_step))
        for m in range(GROUP):
            weight = _splat(builder, share, builder.add(weight_at, builder.mul(row_step, ir.Constant(INDEX, m))))
            for vector, phi, initial in zip(vectors, sums[m], start[m], strict=True):
                phi.add_incoming(initial, before)
                phi.add_incoming(_multiply_add(builder, vector, weight, phi), body)
        k.add_incoming(ir.Constant(INDEX, 0), before)
        k.add_incoming(builder.add(k, ir.Constant(INDEX, 1)), body)
        builder.branch(test)

        builder.position_at_end(after)
        for row, phis in zip(places, sums, strict=True):
            for place, phi in zip(row, phis, strict=True):
                builder.store(phi, _vector_pointer(builder, out, place)).align = 4
        return context.get_dummy_value()

    return generate


def _vector_places(builder: ir.IRBuilder, at: Any, step: Any, line: int) -> list[Any]:
    """Return where the vectors of one output line start."""
    begin = builder.add(at, builder.mul(step, ir.Constant(INDEX, line)))
    return [builder.add(begin, ir.Constant(INDEX, v)) for v in range(0, TILE, LANES)]


def _vector_pointer(builder: ir.IRBuilder, array: Any, place: Any) -> Any:
    return builder.bitcast(builder.gep(array, [place]), VECTOR.as_pointer())


def _load(builder: ir.IRBuilder, array: Any, place: Any) -> Any:
    loaded = builder.load(_vector_pointer(builder, array, place))
    loaded.align = 4
    return loaded


def _zero() -> Any:
    return ir.Constant(VECTOR, [0.0] * LANES)


def _splat(builder: ir.IRBuilder, array: Any, place: Any) -> Any:
    """Return a vector with one number of an array in every lane."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, builder.load(builder.gep(array, [place])), ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, SPLAT)


def _multiply_add(builder: ir.IRBuilder, a: Any, b: Any, c: Any) -> Any:
    kind = ir.FunctionType(VECTOR, [VECTOR] * 3)
    fused = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f32")
    return builder.call(fused, [a, b, c])
