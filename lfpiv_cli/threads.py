"""How many threads the compiled loops and OpenCV may use, and loops over pieces of work on so many threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from multiprocessing.util import register_after_fork
from threading import Condition, get_native_id, local
from typing import TypeVar

import cv2
import numba

from lfpiv_cli.errors import UsageError
from lfpiv_cli.kernels import for_types_of

# More than one, for pieces of work that do not take equally long; the threads wait for the last part.
PARTS_A_THREAD = 4

# True in a process that was forked when OpenMP's threads ran, which were lost with that: another loop would end it.
_lost_threads = False

Item = TypeVar("Item")
Result = TypeVar("Result")


# `pool`: of each thread that shares out work, its number (another in a forked process, which has lost the threads), the
# number of further threads and their pool. It is kept, since new threads take longer than a short loop does.
_here = local()

# What `use_threads` was called with last.
_told: list[int] = []


def _note_fork(_registered: object) -> None:
    """Note, in a forked worker, whether it has lost the threads of compiled loops."""
    global _lost_threads
    try:
        _lost_threads = _lost_threads or numba.threading_layer() == "omp"
    except ValueError:  # none has begun
        return


register_after_fork(_note_fork, _note_fork)


def ensure_own_threads() -> None:
    """Refuse parallel loops in a process that was forked after the first one: OpenMP would end it, a pool would hang.

    Raises
    ------
    UsageError
    """
    if _lost_threads:
        raise UsageError(
            "this process was forked after compiled loops had begun to use threads, which it has lost; make workers "
            'with multiprocessing.get_context("spawn"), or set NUMBA_THREADING_LAYER=workqueue before the start'
        )


def use_threads(threads: int) -> None:
    """Use at most `threads` threads from here on."""
    _told[:] = [threads]
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    cv2.setNumThreads(threads)


def told_threads() -> int | None:
    """Return how many threads were asked for, None if nothing was."""
    return _told[0] if _told else None


def in_threads(
    work: Callable[[Item], Result], items: Iterable[Item], after: Sequence[set[int]] | None = None
) -> list[Result]:
    """Return what work makes of each item, items worked on at once; for compiled work that needs no interpreter.

    Takes less than half the time of a parallel loop of numba's to compile, and tuples of arrays can be written to.

    Parameters
    ----------
    after : of each item the numbers of earlier ones that must be done before it; None: of none
    """
    pieces = list(items)
    threads = min(numba.get_num_threads(), len(pieces))
    if threads < 2:
        return [work(piece) for piece in pieces]
    done: dict[int, Result] = {}
    left = dict(enumerate(pieces))
    one_ends = Condition()

    def ready() -> int | None:
        # What is in work needs nothing that is left: where none is ready, one that is done will make one so.
        return next((place for place in left if after is None or after[place] <= done.keys()), None)

    def take() -> None:
        try:
            while True:
                with one_ends:
                    one_ends.wait_for(lambda: not left or ready() is not None)
                    place = ready()
                    if place is None:
                        return
                    piece = left.pop(place)
                result = work(piece)
                with one_ends:
                    done[place] = result
                    one_ends.notify_all()
        except BaseException:
            with one_ends:
                left.clear()
                one_ends.notify_all()
            raise

    # The calling thread's own pool.
    owner, size, pool = getattr(_here, "pool", (0, 0, None))
    if pool is None or (owner, size) != (get_native_id(), threads - 1):
        pool = ThreadPoolExecutor(threads - 1)
        _here.pool = (get_native_id(), threads - 1, pool)
    others = [pool.submit(take) for _ in range(threads - 1)]
    try:
        take()
        # One that has not begun by now has nothing left to do.
        for other in [other for other in others if not other.cancel()]:
            other.result()
    except BaseException as error:
        begun = [other for other in others if not other.cancel()]
        # A signal waits for none: they hold what they work on, and one that compiles takes long.
        if isinstance(error, Exception):
            wait(begun)
        raise
    return [done[place] for place in range(len(pieces))]


def share_out(kernel: Callable[..., None], count: int, *arguments: object) -> None:
    """Have `kernel(part, *arguments)` do `count` pieces of work, a part (first, end) of them at a time on each thread.

    The kernel is compiled with `nogil`; what it does for one piece may not depend on another.
    """
    threads = numba.get_num_threads()
    size = -(-count // (PARTS_A_THREAD * threads)) if threads > 1 else count
    call = for_types_of(kernel, (0, 0), *arguments)
    in_threads(lambda part: call((part.start, part.stop), *arguments), blocks(count, max(size, 1)))


def blocks(count: int, size: int) -> list[slice]:
    """Return the slices of up to `size` items that `count` items fall into; one empty slice for none."""
    return [slice(begin, min(begin + size, count)) for begin in range(0, max(count, 1), size)]
