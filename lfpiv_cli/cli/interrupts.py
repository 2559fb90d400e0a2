"""Signals that end the work, whenever they arrive."""

from __future__ import annotations

import signal
import sys
from threading import Timer
from types import FrameType
from typing import TYPE_CHECKING

from lfpiv_cli.cli.outcome import Terminated

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

# By then the call that ignored it has returned.
AGAIN_AFTER_S = 0.1
SIGNALS: dict[type[BaseException], signal.Signals] = {KeyboardInterrupt: signal.SIGINT, Terminated: signal.SIGTERM}


def end_by_signals() -> None:
    """Have SIGTERM unwind the program as SIGINT does, and have neither be lost."""
    signal.signal(signal.SIGTERM, _terminate)
    sys.unraisablehook = _send_again


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise Terminated


def _send_again(unraisable: UnraisableHookArgs) -> None:
    """Send a signal again that arrived where Python ignores exceptions: when a library calls it back.

    LLVM does for each kernel that is compiled or loaded.
    """
    sent = SIGNALS.get(unraisable.exc_type)
    if sent is None:
        sys.__unraisablehook__(unraisable)
        return
    again = Timer(AGAIN_AFTER_S, signal.raise_signal, (sent,))
    again.daemon = True
    again.start()
