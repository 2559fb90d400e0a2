"""The command `lfpiv`: its subcommands, and how errors become exit codes.

Signals end the work whenever they arrive. stdout and stderr never stop a command: what cannot be said is lost, what is
to be written is not.
"""

from __future__ import annotations

import atexit
import errno
import io
import os
import signal
import sys
from contextlib import suppress
from threading import Lock, Thread, get_ident
from time import sleep
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from lfpiv_cli import __version__
from lfpiv_cli.cli import measuring, results, rig
from lfpiv_cli.cli.options import HungUp, Terminated, error_record, outcome_of, print_json, printable, voice_options
from lfpiv_cli.errors import LimitMissedError, OutputError, PartialError, UsageError
from lfpiv_cli.files.inputs import ensure_address_space

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


# By then an exception has come to where it is caught.
AGAIN_AFTER_S = 0.1
# Windows has no SIGHUP.
RAISED: dict[int, type[BaseException]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
    **({signal.SIGHUP: HungUp} if hasattr(signal, "SIGHUP") else {}),
}
# The signals that Python has heard of while commands run, and whether none has been answered yet.
_heard: list[int] = []
_unanswered = Lock()


def end_by_signals() -> None:
    """Have SIGTERM and SIGHUP unwind the program as SIGINT does, have none be lost, and each be answered at once.

    What is ignored from the start stays so: nohup has SIGHUP ignored, shells SIGINT in the background.
    """

    def unwind(number: int, _frame: FrameType | None) -> None:
        _heard.append(number)
        raise RAISED[number]

    for number in RAISED:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, unwind)
    sys.unraisablehook = _say_unless_a_signal
    unwound, heard = get_ident(), None
    if sys.platform != "win32":
        # Answered from a thread of its own: Python itself hears of a signal when a compiled call has returned.
        heard, reported = os.pipe()
        os.set_blocking(reported, False)
        signal.set_wakeup_fd(reported, warn_on_full_buffer=False)
        # What is sent to a forked process is none of this one's.
        os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))

    def listen() -> None:
        if heard is not None:
            while (number := os.read(heard, 1)[0]) not in RAISED:
                pass
            _answer(number)
        # Exceptions are lost in what a library calls back, as LLVM does for each kernel, and while source is compiled.
        while True:
            before = len(_heard)
            sleep(AGAIN_AFTER_S)
            if 0 < before == len(_heard) and not _unwinds(unwound):
                signal.raise_signal(_heard[0])

    Thread(target=listen, daemon=True).start()


def _answer(number: int) -> None:
    """Say on stderr by which signal the work ends, once."""
    if not _unanswered.acquire(blocking=False):
        return
    after_bars = "\n" if os.isatty(2) else ""
    with suppress(OSError):  # a terminal that has closed
        os.write(2, f"{after_bars}lfpiv: {outcome_of(RAISED[number]())[0]}\n".encode())


def _unwinds(thread: int) -> bool:
    """Return whether a thread handles an exception that a signal has raised, or one that came of it."""
    raised: Any = sys._current_exceptions().get(thread)
    error = raised[1] if isinstance(raised, tuple) else raised  # in Python 3.11, and from 3.12 on
    while error is not None and not isinstance(error, tuple(RAISED.values())):
        error = error.__context__
    return error is not None


def _say_unless_a_signal(unraisable: UnraisableHookArgs) -> None:
    """Say what Python ignores, unless a signal has raised it: that one is raised again."""
    if unraisable.exc_type not in RAISED.values():
        sys.__unraisablehook__(unraisable)


THREADS, SCREEN = "NUMBA_NUM_THREADS", "MPLBACKEND"


class Stream(io.RawIOBase):
    """A descriptor to write to, whose first failure is kept and not raised."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.failure: OSError | None = None

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return os.isatty(self._descriptor)

    def write(self, data: bytes | bytearray | memoryview) -> int:  # type: ignore[override]
        """Write all of the bytes, or none that could be written."""
        left = memoryview(data).cast("B")
        try:
            while left and self.failure is None:
                left = left[os.write(self._descriptor, left) :]
        except OSError as error:
            self.failure = error
        return len(data)


def open_streams() -> Stream:
    """Put such streams in the place of stdout and stderr, and something in that of descriptors that are closed.

    A file that was opened under the number of a closed stdout would get what is printed.

    Returns
    -------
    Stream
        That of stdout.
    """
    descriptor = os.open(os.devnull, os.O_RDWR)
    while descriptor <= 2:
        descriptor = os.dup(descriptor)
    os.close(descriptor)
    streams = {}
    for name, number in (("stdout", 1), ("stderr", 2)):
        before = getattr(sys, name)
        streams[name] = Stream(number)
        if before is not getattr(sys, f"__{name}__"):  # whoever has put another one there wants what is said
            continue
        encoding, errors = (before.encoding, before.errors) if before else ("utf-8", "backslashreplace")
        text = io.TextIOWrapper(
            io.BufferedWriter(streams[name]),  # type: ignore[type-var]
            encoding=encoding,
            errors=errors,
            line_buffering=number == 2,
        )
        setattr(sys, name, text)
    return streams["stdout"]


COMMANDS = (
    rig.init,
    rig.check,
    measuring.run,
    rig.calibrate_snapshot,
    rig.refine_calibration,
    rig.build_weights,
    measuring.reconstruct,
    measuring.correlate,
    measuring.combine,
    measuring.statistics,
    measuring.track,
    measuring.field,
    measuring.follow,
    results.info,
    results.plot,
    results.warm_up,
    results.report,
    results.export,
    results.validate,
    results.simulate,
)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="lfpiv")
@voice_options
@click.pass_context
def cli(context: click.Context, **before: Any) -> None:
    """From raw light-field camera images to three-dimensional velocity fields (PIV and PTV).

    \b
    lfpiv run rig.yaml a.tif b.tif --white white.tif --dark dark.tif --board board.tif -o results
    or step by step
    lfpiv calibrate-snapshot rig.yaml --white white.tif --board board.tif -o calibration.h5
    lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5
    lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif -o volumes
    lfpiv correlate volumes/a.vtkhdf volumes/b.vtkhdf -o vectors.vtkhdf
    lfpiv validate flow rig.yaml --vectors vectors.vtkhdf -o report

    Options that stand before a command hold for it as those after it do.
    """
    # Pictures are drawn into files, on no screen.
    os.environ.pop(SCREEN, None)
    reported = os.environ.get(THREADS)
    if reported is not None and not (reported.strip().isdecimal() and int(reported) > 0):
        raise UsageError(f"{THREADS} is {reported!r}, expected a number of threads from 1 on, or that it is not set")
    context.default_map = {str(context.invoked_subcommand): {name: value for name, value in before.items() if value}}


for _command in COMMANDS:
    # The first sentence of its help; click would cut what is longer than a line.
    _words = " ".join((_command.help or "").split("\n\n")[0].split())
    _command.short_help = _command.short_help or _words.split(". ")[0].removesuffix(".")
    cli.add_command(_command)


def main() -> NoReturn:
    """Run the command line and leave with the exit code of the outcome."""
    # Asked of the words themselves: a command line that is not understood has no options yet.
    debug, as_json = ("--debug" in sys.argv[1:], "--json" in sys.argv[1:])
    # First: a pipe for signals would take the number of a stdout that is closed.
    stdout = open_streams()
    end_by_signals()
    try:
        ensure_address_space()
        cli.main(standalone_mode=False)
        sys.stdout.flush()
        lost = stdout.failure
        # A reader that has gone wanted no more of the answer; without it otherwise no command is done.
        if lost is not None and lost.errno != errno.EPIPE:
            raise OutputError(f"stdout: cannot be written: {os.strerror(lost.errno or 0)}; all files are written")
        code = 0
    except SystemExit:
        raise
    except BaseException as raised:
        # By the first signal, whatever a library has made of it.
        error = RAISED[_heard[0]]() if _heard else raised
        if _heard:
            _answer(_heard[0])
        message, code = outcome_of(error)
        if as_json and not isinstance(error, (LimitMissedError, PartialError)):
            # One that came with figures stands in theirs already.
            print_json(error_record(error))
        if isinstance(error, click.ClickException):
            error.show()
        elif isinstance(error, Exception) and not isinstance(error, click.Abort):
            if debug:
                raise
            click.echo(printable(f"lfpiv: {message}"), err=True)
        if _heard:
            # Python would wait for all threads, and one that compiles takes long.
            atexit._run_exitfuncs()
            sys.stdout.flush()
            os._exit(code)
    _heard.clear()
    sys.exit(code)
