"""Sums of lines whose shares change from lane to lane: with a polynomial of the second degree in a lane's place.

    out[n] (+)= sum_k w[k, n] source[line[k]][n],     w[k, n] = max(0, c[k, 0] + t[n] (c[k, 1] + t[n] c[k, 2]))

As `combine` otherwise, with its readable twins.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numpy.typing import NDArray

from lfpiv_cli.simd.combine import Floats, step_on, transposed
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
