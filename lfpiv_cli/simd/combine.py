"""The innermost loop of the operators, written for the vector unit.

    out[m] (+)= sum_k share[k, m] source[line[k]]

Some lines of the output are kept in registers over the whole sum, so each number that is loaded is used for all of them
and nothing is stored in between. A plain loop does the same (`combine_reference`); the compiler does not find this form
in it. The sums run over k in order, with fused multiply-adds.
"""

from __future__ import annotations

from collections.abc import Callable
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
    splat,
    store,
)

# Lines of the output that share every load, and vectors a line: 8 independent sums keep two fused multiply-add units
# of latency 4 busy and fit the 16 registers of machines with 8 lanes. Two long lines where few terms are shared by
# more of them (a third of the products of four would be with zero), eight short ones where lines are short.
GROUP, VECTORS = 2, 4
ROWS = 8
TILE = VECTORS * LANES

Floats = NDArray[np.float32]


def combine_reference(
    shape: tuple[int, int],
    out: Floats,
    to: tuple[int, int, int],
    source: Floats,
    line: NDArray[np.int32],
    terms: tuple[int, int, int],
    share: Floats,
    shares: tuple[int, int, int],
) -> None:
    """Set lines to sums of lines, or add these to them: the readable twin of `combine_long` and `combine_short`.

    Parameters
    ----------
    shape : how many lines are written, and the length of all lines
    out, to : flat; where the first line starts, the step to the next, and 0 where what they hold is overwritten
    source, line, terms : flat; (at, first, count), term k is line number `line[first + k]` of the lines from `at` on
    share, shares : flat; (at, term step, line step), term k in line m is taken `share[at + k term step + m line step]`
        times
    """
    lines, length = shape
    at, first, count = terms
    share_at, term_step, line_step = shares
    for m in range(lines):
        begin = to[0] + m * to[1]
        target = out[begin : begin + length]
        if to[2] == 0:
            target[:] = 0.0
        for k in range(count):
            here = at + length * line[first + k]
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
        three = integers(3)
        return types.void(out, three, source, line, three, share, three), _generator(lines, vectors)

    return combine


def _generator(lines: int, vectors: int) -> Callable[..., Any]:
    """Return the code generator for some lines of some vectors."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        out, source, line, share = pointers(context, builder, signature, arguments, (0, 2, 3, 5))
        at, step, kept = cgutils.unpack_tuple(builder, arguments[1], 3)
        source_at, first, count = cgutils.unpack_tuple(builder, arguments[4], 3)
        share_at, term_step, line_step = cgutils.unpack_tuple(builder, arguments[6], 3)
        places = []
        for m in range(lines):
            begin = builder.add(at, builder.mul(step, index(m)))
            places += [builder.add(begin, index(v * LANES)) for v in range(vectors)]
        onto = builder.icmp_signed("!=", kept, index(0))
        sums = registers(builder, [builder.select(onto, load(builder, out, place), ZERO) for place in places])
        with cgutils.for_range(builder, count) as k:
            number = builder.sext(load_one(builder, line, builder.add(first, k.index)), count.type)
            begin = builder.add(source_at, builder.mul(number, index(vectors * LANES)))
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


# Times faster than the twin as a plain loop, with 16 lanes and with 8: 5 and 22.
combine_long = _combine(GROUP, VECTORS)
# 28 and 20 times.
combine_short = _combine(ROWS, 1)
