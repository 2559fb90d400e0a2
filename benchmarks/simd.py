"""Each intrinsic of the vector dialect against its readable twin, compiled as a plain loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba import njit

from benchmarks.timing import interleaved_medians_s
from lfpiv_cli.simd import block_sums, combine
from lfpiv_cli.simd.vectors import LANES

# Elements of the volumes, and their strides along z and y: a window's share of the second-level cache.
SIZE, PLANE, ROW = 60000, 4000, 60
MIDDLE = SIZE // 2


def bench_simd() -> None:
    """Print how many times faster than its twin each intrinsic is."""
    print(f"{LANES} lanes")
    for name, gain in gains(calls=20000, repeats=7).items():
        print(f"{name}: {gain:.1f} times faster than a plain loop")


def gains(calls: int, repeats: int, names: Sequence[str] = ()) -> dict[str, float]:
    """Return the time of each twin over that of its intrinsic, in a compiled loop; of all, or of those named."""
    found = {}
    rivals_of = _rivals()
    for name in names or rivals_of:
        intrinsic, twin, arguments = rivals_of[name]
        rivals = {"intrinsic": _repeated(intrinsic), "twin": _repeated(twin)}
        runs = {key: _call(run, calls, arguments) for key, run in rivals.items()}
        medians = interleaved_medians_s(runs, repeats)
        found[name] = medians["twin"] / medians["intrinsic"]
    return found


def _call(run: Callable[..., None], calls: int, arguments: tuple[Any, ...]) -> Callable[[], None]:
    return lambda: run(calls, arguments)


def _repeated(kernel: Callable[..., Any]) -> Callable[..., None]:
    """Return a compiled loop over calls of an intrinsic or of a plain function."""

    @njit
    def run(calls: int, arguments: Any) -> None:
        for _ in range(calls):
            kernel(*arguments)

    return run


def _rivals() -> dict[str, tuple[Any, Any, tuple[Any, ...]]]:
    """Return each intrinsic, its twin and what both are called with: sizes that the stages have."""
    rng = np.random.default_rng(0)
    a, b, out = rng.random((3, SIZE), np.float32)
    valid = np.ones(SIZE, np.uint8)
    line = np.arange(40).astype(np.int32)
    weights = rng.random(3 * block_sums.MOST_TAPS * block_sums.NEIGHBOURS, np.float32)
    place = (MIDDLE, PLANE, ROW)
    found = {}
    for name, lines, length, intrinsic in (
        ("combine_long", combine.GROUP, combine.TILE, combine.combine_long),
        ("combine_line", 1, combine.TILE, combine.combine_line),
        ("combine_vector", 1, LANES, combine.combine_vector),
    ):
        twin = _with_shape((lines, length))
        arguments: tuple[Any, ...] = (out, (0, length, 1), a, line, (0, length, 0, line.size), b, (0, lines, 1))
        found[name] = (intrinsic, twin, arguments)
    arguments = (out, (0, combine.TILE), a, line, (0, 80, 0, 3), b, 0)
    found["combine_turned"] = (combine.combine_turned, njit(combine.combine_turned_reference), arguments)
    places = np.linspace(-1.0, 1.0, LANES).astype(np.float32)
    turned = (out, (0, combine.TILE), a, line, (0, 80, 0, 3), b, 0, places, 0)
    twin = njit(combine.combine_turned_varying_reference)
    found["combine_turned_varying"] = (combine.combine_turned_varying, twin, turned)
    summed = (out, 0, a, line, (0, 80, 0, 5), b, 0, places, 0)
    found["combine_varying"] = (
        combine.combine_varying,
        njit(combine.combine_varying_reference),
        summed,
    )
    arguments = (out, (0, combine.TILE), a, (0, combine.TILE))
    found["turn"] = (combine.turn, njit(combine.turn_reference), arguments)
    for shifts in (block_sums.FEW_SHIFTS, block_sums.MANY_SHIFTS):
        arguments = (out, (0, LANES), a, b, place, (4, 8), (-2, shifts))
        found[f"products of {shifts} shifts"] = (block_sums.products, njit(block_sums.products_reference), arguments)
    arguments = (out, (0, LANES), a, b, valid, place, (4, 4))
    found["moments"] = (block_sums.moments, njit(block_sums.moments_reference), arguments)
    arguments = (out, (0, block_sums.NEIGHBOURS), a, b, place, weights, (-1, -1, -1, 4, 4, 4))
    found["interpolate"] = (block_sums.interpolate, njit(block_sums.interpolate_reference), arguments)
    for taps in (4, 5):
        twin, arguments = njit(block_sums.spline_weights_reference), (weights, 0, a, 7, -1, taps)
        found[f"spline_weights of {taps} taps"] = (block_sums.spline_weights, twin, arguments)
    twin = njit(_range_of_neighbours)
    found["range_of_all"] = (block_sums.range_of_all, twin, (a, 7))
    return found


def _range_of_neighbours(places: Any, at: int) -> Any:
    return block_sums.range_reference(places, at, block_sums.NEIGHBOURS)


def _with_shape(shape: tuple[int, int]) -> Any:
    twin = njit(combine.combine_reference)

    @njit
    def combined(out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, shares: Any) -> None:
        twin(shape, out, to, source, line, terms, share, shares)

    return combined
