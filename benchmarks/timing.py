"""Timings that a noisy machine cannot fool much: rivals run in turn, medians are compared."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

# Threads of a matrix library spin for a while after their work and would take the next rival's cores.
PAUSE_S = 0.3


def interleaved_medians_s(rivals: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median time of each rival in seconds, all run in turn `repeats` times after one warm-up."""
    for run in rivals.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in rivals}
    for _ in range(repeats):
        for name, run in rivals.items():
            time.sleep(PAUSE_S)
            start = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(taken)) for name, taken in times.items()}
