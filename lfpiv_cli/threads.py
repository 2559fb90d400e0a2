"""How many threads the compiled loops and OpenCV may use, and loops over pieces of work on so many threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2
import numba

Item = TypeVar("Item")
Result = TypeVar("Result")


def use_threads(threads: int) -> None:
    """Use at most `threads` threads from here on."""
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    cv2.setNumThreads(threads)


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return what work makes of each item, items worked on at once; for compiled work that needs no interpreter.

    Takes less than half the time of a parallel loop of numba's to compile, and tuples of arrays can be written to.
    """
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        return list(pool.map(work, items))


def blocks(count: int, size: int) -> list[slice]:
    """Return the slices of up to `size` items that `count` items fall into; one empty slice for none."""
    return [slice(begin, min(begin + size, count)) for begin in range(0, max(count, 1), size)]
