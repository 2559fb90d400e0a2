"""Building blocks of code for the vector unit: as many neighbours at once as one of its registers holds.

They generate LLVM's instructions inside numba's intrinsics. A `place` counts elements from the start of a flat array.
Each lane is a sum of its own with fused multiply-adds in a fixed order, so the number of lanes changes no result.

Every intrinsic has a readable twin, which stands in its place where compilation is switched off (`NUMBA_DISABLE_JIT`),
and beside it how much faster it is than that twin compiled as a plain loop (`python -m benchmarks simd`).
"""

from __future__ import annotations

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
