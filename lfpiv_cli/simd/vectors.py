"""Building blocks of code for the vector unit: 16 neighbours along x at once.

They generate LLVM's instructions inside numba's intrinsics. A `place` counts elements from the start of a flat array;
sums live in slots that the compiler keeps in registers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils

LANES = 16

INDEX = ir.IntType(64)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
FLAGS = ir.VectorType(ir.IntType(8), LANES)
ZERO = ir.Constant(VECTOR, [0.0] * LANES)


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


def index(value: int) -> ir.Constant:
    return ir.Constant(INDEX, value)


def constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [value] * LANES)


def splat(builder: ir.IRBuilder, value: Any) -> Any:
    """Return a vector with one number in every lane."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def call(builder: ir.IRBuilder, name: str, *vectors: Any) -> Any:
    """Return what one of LLVM's functions of whole vectors gives."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * len(vectors))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), vectors)


def registers(builder: ir.IRBuilder, count: int) -> list[Any]:
    """Return sums that start at zero; the compiler keeps them in registers."""
    slots = [cgutils.alloca_once(builder, VECTOR) for _ in range(count)]
    for slot in slots:
        builder.store(ZERO, slot)
    return slots


def load(builder: ir.IRBuilder, array: Any, place: Any, kind: ir.VectorType = VECTOR) -> Any:
    loaded = builder.load(builder.bitcast(builder.gep(array, [place]), kind.as_pointer()))
    loaded.align = 1 if kind is FLAGS else 4
    return loaded


def store(builder: ir.IRBuilder, sums: Sequence[Any], array: Any, places: Sequence[Any]) -> None:
    for slot, place in zip(sums, places, strict=True):
        store_vector(builder, builder.load(slot), array, place)


def store_vector(builder: ir.IRBuilder, vector: Any, array: Any, place: Any) -> None:
    pointer = builder.bitcast(builder.gep(array, [place]), VECTOR.as_pointer())
    builder.store(vector, pointer).align = 4


def add_product(builder: ir.IRBuilder, slot: Any, a: Any, b: Any) -> None:
    """Add a product to a sum, rounding once."""
    builder.store(call(builder, "fma", a, b, builder.load(slot)), slot)
