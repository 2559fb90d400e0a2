"""Signals that end the work, whenever they arrive."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from threading import Lock, Thread, Timer
from types import FrameType
from typing import TYPE_CHECKING

from lfpiv_cli.cli.outcome import HungUp, Terminated, outcome_of

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

# By then the call that ignored it has returned.
AGAIN_AFTER_S = 0.1
# Windows has no SIGHUP.
RAISED: dict[int, type[BaseException]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
    **({signal.SIGHUP: HungUp} if hasattr(signal, "SIGHUP") else {}),
}
# The signals that Python has heard of, and whether none has been answered yet.
_heard: list[int] = []
_unanswered = Lock()


def end_by_signals() -> None:
    """Have SIGTERM and SIGHUP unwind the program as SIGINT does, have none be lost, and each be answered at once.

    What is ignored from the start stays so: nohup has SIGHUP ignored, shells SIGINT in the background.
    """
    for number in RAISED:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _unwind)
    sys.unraisablehook = _send_again
    if sys.platform != "win32":
        _answer_at_once()


def ended_by(error: BaseException) -> BaseException:
    """Return what a command ends by: the first signal, whatever a library has made of it, else the error."""
    if not _heard:
        return error
    _answer(_heard[0])
    return RAISED[_heard[0]]()


def _unwind(number: int, _frame: FrameType | None) -> None:
    _heard.append(number)
    raise RAISED[number]


def _answer_at_once() -> None:
    """Answer signals from a thread of its own: Python itself hears of them when a compiled call has returned."""
    heard, told = os.pipe()
    os.set_blocking(told, False)
    signal.set_wakeup_fd(told, warn_on_full_buffer=False)
    # What is sent to a forked process is none of this one's.
    os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    Thread(target=_listen, args=(heard,), daemon=True).start()


def _listen(heard: int) -> None:
    while (number := os.read(heard, 1)[0]) not in RAISED:
        pass
    _answer(number)


def _answer(number: int) -> None:
    """Say on stderr by which signal the work ends, once."""
    if not _unanswered.acquire(blocking=False):
        return
    after_bars = "\n" if os.isatty(2) else ""
    with suppress(OSError):  # a terminal that has closed
        os.write(2, f"{after_bars}lfpiv: {outcome_of(RAISED[number]())[0]}\n".encode())


def _send_again(unraisable: UnraisableHookArgs) -> None:
    """Send a signal again that arrived where Python ignores exceptions: when a library calls it back.

    LLVM does for each kernel that is compiled or loaded.
    """
    for number, raised in RAISED.items():
        if unraisable.exc_type is raised:
            again = Timer(AGAIN_AFTER_S, signal.raise_signal, (number,))
            again.daemon = True
            again.start()
            return
    sys.__unraisablehook__(unraisable)
