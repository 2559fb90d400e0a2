"""Each intrinsic of the vector dialect against its readable twin, compiled as a plain loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba import njit

from benchmarks.timing import interleaved_medians_s
from lfpiv_cli import simd
from lfpiv_cli.simd import LANES

# Elements of the arrays: a share of the second-level cache.
SIZE = 60000


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
    line = np.arange(40).astype(np.int32)
    found = {}
    for name, lines, length, intrinsic in (
        ("combine_long", simd.GROUP, simd.TILE, simd.combine_long),
        ("combine_line", 1, simd.TILE, simd.combine_line),
        ("combine_vector", 1, LANES, simd.combine_vector),
    ):
        twin = _with_shape((lines, length))
        arguments: tuple[Any, ...] = (out, (0, length, 1), a, line, (0, length, 0, line.size), b, (0, lines, 1))
        found[name] = (intrinsic, twin, arguments)
    arguments = (out, (0, simd.TILE), a, line, (0, 80, 0, 3), b, 0)
    found["combine_turned"] = (simd.combine_turned, _plain(simd.combine_turned_reference), arguments)
    places = np.linspace(-1.0, 1.0, LANES).astype(np.float32)
    turned = (out, (0, simd.TILE), a, line, (0, 80, 0, 3), b, 0, places, 0)
    twin = _plain(simd.combine_turned_varying_reference)
    found["combine_turned_varying"] = (simd.combine_turned_varying, twin, turned)
    summed = (out, 0, a, line, (0, 80, 0, 5), b, 0, places, 0)
    found["combine_varying"] = (
        simd.combine_varying,
        _plain(simd.combine_varying_reference),
        summed,
    )
    arguments = (out, (0, simd.TILE), a, (0, simd.TILE))
    found["turn"] = (simd.turn, _plain(simd.turn_reference), arguments)
    return found


def _plain(twin: Callable[..., Any]) -> Any:
    """Return a twin compiled as a loop that may sum in any order."""
    return njit(twin, fastmath=True, error_model="numpy")


def _with_shape(shape: tuple[int, int]) -> Any:
    twin = _plain(simd.combine_reference)

    @njit
    def combined(out: Any, to: Any, source: Any, line: Any, terms: Any, share: Any, shares: Any) -> None:
        twin(shape, out, to, source, line, terms, share, shares)

    return combined
