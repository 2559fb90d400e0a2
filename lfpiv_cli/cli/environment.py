"""What the environment tells the libraries: asked before they read it, as they would end with a traceback."""

from __future__ import annotations

import os

from lfpiv_cli.errors import UsageError

THREADS, SCREEN = "NUMBA_NUM_THREADS", "MPLBACKEND"


def settle_environment() -> None:
    """Refuse a number of threads that is none; forget the screen to draw on, as pictures are drawn into files.

    Raises
    ------
    UsageError
    """
    os.environ.pop(SCREEN, None)
    told = os.environ.get(THREADS)
    if told is not None and not (told.strip().isdecimal() and int(told) > 0):
        raise UsageError(f"{THREADS} is {told!r}, expected a number of threads from 1 on, or that it is not set")
