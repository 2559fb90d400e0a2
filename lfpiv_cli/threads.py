"""How many threads the compiled loops and OpenCV may use."""

from __future__ import annotations

import cv2
import numba


def use_threads(threads: int) -> None:
    """Use at most `threads` threads from here on."""
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    cv2.setNumThreads(threads)
