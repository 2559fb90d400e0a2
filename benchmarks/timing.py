"""Timings that a noisy machine cannot fool much: rivals run in turn, medians are compared."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

# Threads of a matrix library spin for a while after their work and would take the next rival's cores.
PAUSE_S = 0.3
# After a pause caches are cold and cores asleep; a short run is repeated for as long as this and the mean taken.
LEAST_S = 1.0


def interleaved_medians_s(rivals: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median time of each rival in seconds, all run in turn `repeats` times after one warm-up."""
    for run in rivals.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in rivals}
    for _ in range(repeats):
        for name, run in rivals.items():
            time.sleep(PAUSE_S)
            times[name].append(_mean_s(run))
    return {name: float(np.median(taken)) for name, taken in times.items()}


def _mean_s(run: Callable[[], object]) -> float:
    """Return the mean time of a run over `LEAST_S`, or of one that takes longer."""
    start = time.perf_counter()
    calls, taken = 0, 0.0
    while calls == 0 or taken < LEAST_S:
        run()
        calls += 1
        taken = time.perf_counter() - start
    return taken / calls
