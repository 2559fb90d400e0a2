"""Building blocks of code for the vector unit: as many neighbours at once as one of its registers holds.

They generate LLVM's instructions inside numba's intrinsics. A `place` counts elements from the start of a flat array.
Each lane is a sum of its own with fused multiply-adds in a fixed order, so the number of lanes changes no result.

Every intrinsic has a readable twin, which stands in its place where compilation is switched off (`NUMBA_DISABLE_JIT`),
and beside it how much faster it is than that twin compiled as a plain loop (`python -m benchmarks simd`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import config
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.core.types import int64
from numba.core.types.containers import UniTuple
from numba.extending import intrinsic


def lanes_of(features: str) -> int:
    """Return how many float32 numbers a register holds, from LLVM's list of a processor's features.

    Elsewhere 8: LLVM halves these where registers are shorter still.
    """
    return 16 if "+avx512f" in features.split(",") else 8


# Of the processor that numba compiles for, which names its cached code as well.
LANES = lanes_of(cpu_target.target_context.codegen().magic_tuple()[2])

INDEX = ir.IntType(64)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
FLAGS = ir.VectorType(ir.IntType(8), LANES)
ZERO = ir.Constant(VECTOR, [0.0] * LANES)


def in_place_of(twin: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make an intrinsic of the decorated typing function, or give its readable twin where nothing is compiled."""
    return lambda typing: twin if config.DISABLE_JIT else intrinsic(typing)


def for_each(builder: ir.IRBuilder, value: Any, cases: Sequence[int], generate: Callable[[int], None]) -> None:
    """Generate code for each value that a number may have, the loops that it counts written out; none for others."""
    end = builder.append_basic_block("end")
    choice = builder.switch(value, end)
    for case in cases:
        block = builder.append_basic_block(f"case_{case}")
        choice.add_case(index(case), block)
        builder.position_at_end(block)
        generate(case)
        builder.branch(end)
    builder.position_at_end(end)


def pointers(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any, positions: Sequence[int]) -> Any:
    """Return where the arrays among the arguments begin."""
    return [context.make_array(signature.args[p])(context, builder, arguments[p]).data for p in positions]


def integers(count: int) -> UniTuple:
    """Return the type of some places, steps and counts that belong together."""
    return UniTuple(int64, count)


def index(value: int) -> ir.Constant:
    return ir.Constant(INDEX, value)


def constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [value] * LANES)


def splat(builder: ir.IRBuilder, value: Any) -> Any:
    """Return a vector with one number in every lane."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def shuffle(builder: ir.IRBuilder, a: Any, b: Any, lanes: Sequence[int]) -> Any:
    """Return a vector of lanes of two others, those of the second counted from `LANES` on."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(lanes)))


def call(builder: ir.IRBuilder, name: str, *vectors: Any) -> Any:
    """Return what one of LLVM's functions of whole vectors gives."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * len(vectors))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), vectors)


def registers(builder: ir.IRBuilder, starts: Sequence[Any]) -> list[Any]:
    """Return sums that start at some vectors; the compiler keeps them in registers."""
    slots = [cgutils.alloca_once(builder, VECTOR) for _ in starts]
    for slot, start in zip(slots, starts, strict=True):
        builder.store(start, slot)
    return slots


def load(builder: ir.IRBuilder, array: Any, place: Any, kind: ir.VectorType = VECTOR) -> Any:
    loaded = builder.load(builder.bitcast(builder.gep(array, [place]), kind.as_pointer()))
    loaded.align = 1 if kind is FLAGS else 4
    return loaded


def load_one(builder: ir.IRBuilder, array: Any, place: Any) -> Any:
    """Return a single element of an array."""
    return builder.load(builder.gep(array, [place]))


def store(builder: ir.IRBuilder, vector: Any, array: Any, place: Any) -> None:
    pointer = builder.bitcast(builder.gep(array, [place]), VECTOR.as_pointer())
    builder.store(vector, pointer).align = 4


def add_product(builder: ir.IRBuilder, slot: Any, a: Any, b: Any) -> None:
    """Add a product to a sum, rounding once."""
    builder.store(call(builder, "fma", a, b, builder.load(slot)), slot)


# Formulas for the vector unit, written as for plain numbers; `Lanes` in place of these generate code for many at
# once.
#
# A formula is a function of numbers by Python's operators and the functions below. A readable twin calls it with one
# number after the other, its intrinsic once with as many float64 numbers as a register holds. Products and sums may
# be fused.


# A register holds half as many float64 numbers as float32.
DOUBLES = LANES // 2
DOUBLE_VECTOR = ir.VectorType(ir.DoubleType(), DOUBLES)
PIXELS = ir.VectorType(ir.IntType(32), DOUBLES)
INTEGERS = ir.VectorType(ir.IntType(64), DOUBLES)
FUSED = ("contract",)


class Lanes:
    """As many float64 numbers as a register holds, at work on which code is generated."""

    def __init__(self, builder: ir.IRBuilder, value: Any) -> None:
        self.builder = builder
        self.value = value

    def _with(self, operation: str, a: Any, b: Any) -> Lanes:
        a, b = (lanes(self.builder, number).value for number in (a, b))
        return Lanes(self.builder, getattr(self.builder, operation)(a, b, flags=FUSED))

    def __add__(self, other: Lanes | float) -> Lanes:
        return self._with("fadd", self, other)

    def __radd__(self, other: float) -> Lanes:
        return self._with("fadd", other, self)

    def __sub__(self, other: Lanes | float) -> Lanes:
        return self._with("fsub", self, other)

    def __rsub__(self, other: float) -> Lanes:
        return self._with("fsub", other, self)

    def __mul__(self, other: Lanes | float) -> Lanes:
        return self._with("fmul", self, other)

    def __rmul__(self, other: float) -> Lanes:
        return self._with("fmul", other, self)

    def __truediv__(self, other: Lanes | float) -> Lanes:
        return self._with("fdiv", self, other)

    def __rtruediv__(self, other: float) -> Lanes:
        return self._with("fdiv", other, self)

    def called(self, name: str, *others: Lanes | float) -> Lanes:
        """Return what one of LLVM's functions of whole vectors gives."""
        kind = ir.FunctionType(DOUBLE_VECTOR, [DOUBLE_VECTOR] * (1 + len(others)))
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.v{DOUBLES}f64")
        values = [lanes(self.builder, number).value for number in (self, *others)]
        return Lanes(self.builder, self.builder.call(function, values))


def at_least(number: Any, least: float) -> Any:
    """Return a number, or `least` where it is smaller or no number."""
    return number.called("maxnum", least) if isinstance(number, Lanes) else max(least, number)


def at_most(number: Any, most: float) -> Any:
    """Return a number, or `most` where it is larger."""
    return number.called("minnum", most) if isinstance(number, Lanes) else min(most, number)


def root(number: Any) -> Any:
    """Return a number's square root."""
    return number.called("sqrt") if isinstance(number, Lanes) else math.sqrt(number)


def where_above(number: Any, limit: Any, kept: Any, other: Any) -> Any:
    """Return one number where another is above a limit, and a third elsewhere."""
    if not isinstance(number, Lanes):
        return kept if number > limit else other
    builder = number.builder
    limit, kept, other = (lanes(builder, one).value for one in (limit, kept, other))
    return Lanes(builder, builder.select(builder.fcmp_ordered(">", number.value, limit), kept, other))


def lanes(builder: ir.IRBuilder, number: Any) -> Lanes:
    """Return a number, known when the code is generated or when it runs, in every lane."""
    if isinstance(number, Lanes):
        return number
    if isinstance(number, float | int):
        return Lanes(builder, ir.Constant(DOUBLE_VECTOR, [float(number)] * DOUBLES))
    undefined = ir.Constant(DOUBLE_VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), DOUBLES), [0] * DOUBLES)
    return Lanes(builder, builder.shuffle_vector(one, undefined, order))


def counted_from(builder: ir.IRBuilder, first: Any) -> Lanes:
    """Return first, first + 1 and so on."""
    return lanes(builder, builder.sitofp(first, ir.DoubleType())) + Lanes(
        builder, ir.Constant(DOUBLE_VECTOR, [float(lane) for lane in range(DOUBLES)])
    )


def load_lanes(builder: ir.IRBuilder, array: Any, place: Any) -> Lanes:
    """Return neighbouring elements of an array."""
    loaded = builder.load(builder.bitcast(builder.gep(array, [place]), DOUBLE_VECTOR.as_pointer()))
    loaded.align = 8
    return Lanes(builder, loaded)


def store_lanes(builder: ir.IRBuilder, numbers: Lanes, array: Any, place: Any) -> None:
    """Write neighbouring elements of an array."""
    pointer = builder.bitcast(builder.gep(array, [place]), DOUBLE_VECTOR.as_pointer())
    builder.store(numbers.value, pointer).align = 8


def store_count(builder: ir.IRBuilder, first: Any, array: Any, place: Any) -> None:
    """Write first, first + 1 and so on to neighbouring elements of an array of int32."""
    narrow = ir.IntType(32)
    undefined = ir.Constant(PIXELS, ir.Undefined)
    one = builder.insert_element(undefined, builder.trunc(first, narrow), ir.Constant(narrow, 0))
    order = ir.Constant(ir.VectorType(narrow, DOUBLES), [0] * DOUBLES)
    numbers = builder.add(builder.shuffle_vector(one, undefined, order), ir.Constant(PIXELS, list(range(DOUBLES))))
    pointer = builder.bitcast(builder.gep(array, [place]), PIXELS.as_pointer())
    builder.store(numbers, pointer).align = 4


def groups_of_lanes(builder: ir.IRBuilder, count: Any) -> Any:
    """Return the loop over as many registers as hold `count` numbers."""
    return cgutils.for_range(builder, builder.sdiv(builder.add(count, index(DOUBLES - 1)), index(DOUBLES)))


def whole_part(numbers: Lanes) -> tuple[Lanes, Any]:
    """Return numbers from 0 on without their fractions, and as integers."""
    builder = numbers.builder
    whole = builder.fptosi(numbers.value, INTEGERS)
    return Lanes(builder, builder.sitofp(whole, DOUBLE_VECTOR)), whole


def integers_in_lanes(builder: ir.IRBuilder, number: Any) -> Any:
    """Return an integer in every lane."""
    undefined = ir.Constant(INTEGERS, ir.Undefined)
    one = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), DOUBLES), [0] * DOUBLES)
    return builder.shuffle_vector(one, undefined, order)


def gather(builder: ir.IRBuilder, array: Any, places: Any, count: int) -> list[Lanes]:
    """Return the first, the second and so on of `count` neighbouring elements of an array from some places on.

    Read are whole registers, beyond the last element too.
    """
    found: list[Lanes] = []
    for begin in range(0, count, DOUBLES):
        lines = []
        for lane in range(DOUBLES):
            place = builder.extract_element(places, ir.Constant(ir.IntType(32), lane))
            lines.append(load_lanes(builder, array, builder.add(place, index(begin))).value)
        found += [Lanes(builder, value) for value in _transposed(builder, lines)]
    return found[:count]


def _transposed(builder: ir.IRBuilder, lines: Sequence[Any]) -> Sequence[Any]:
    """Return the columns of a square of numbers, a register for each of its lines."""
    step = 1
    while step < DOUBLES:
        swapped = list(lines)
        for one in range(DOUBLES):
            if one & step:
                continue
            # Columns that have the step in their number change places with the lines that have.
            pair, other = (lines[one], lines[one + step]), one + step
            kept = [DOUBLES + k - step if k & step else k for k in range(DOUBLES)]
            rest = [DOUBLES + k if k & step else k + step for k in range(DOUBLES)]
            for line, order in ((one, kept), (other, rest)):
                kind = ir.VectorType(ir.IntType(32), DOUBLES)
                swapped[line] = builder.shuffle_vector(*pair, ir.Constant(kind, order))
        lines, step = swapped, 2 * step
    return lines


def any_above(numbers: Lanes, limit: Lanes) -> Any:
    """Return whether a number in any lane is above a limit."""
    builder = numbers.builder
    above = builder.fcmp_ordered(">", numbers.value, limit.value)
    bits = builder.bitcast(above, ir.IntType(DOUBLES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(DOUBLES), 0))
