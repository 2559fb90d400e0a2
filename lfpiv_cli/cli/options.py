"""What commands have in common: options written once, the settings of a run, how it is printed, and how it ends."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable
from functools import partial, wraps
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_origin

import click

from lfpiv_cli import __version__
from lfpiv_cli.errors import LfpivError, LimitMissedError, OutputError, PartialError, UsageError
from lfpiv_cli.files import kernel_cache
from lfpiv_cli.files.atomic import shown, without_nan
from lfpiv_cli.files.inputs import Shard, parse_time_limit, reason
from lfpiv_cli.names import InputKind, Pairing, names_in

if TYPE_CHECKING:
    from lfpiv_cli.console import Console

EXIT_BUG = 1
EXIT_HUNG_UP = 129
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


class Terminated(BaseException):
    """SIGTERM arrived; unwinds like KeyboardInterrupt so that temporary files are removed."""


class HungUp(BaseException):
    """SIGHUP arrived, as the terminal has closed; unwinds like that, too."""


def outcome_of(error: BaseException) -> tuple[str, int]:
    """Return what is said of an error, and the exit code."""
    if isinstance(error, click.ClickException):
        return error.format_message(), error.exit_code
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        return "interrupted", EXIT_INTERRUPTED
    if isinstance(error, Terminated):
        return "terminated", EXIT_TERMINATED
    if isinstance(error, HungUp):
        return "hung up", EXIT_HUNG_UP
    if isinstance(error, LfpivError):
        return str(error), error.exit_code
    if isinstance(error, MemoryError) or "can't start new thread" in str(error):
        words = reason(error) if str(error) else "the system gave no more"
        return f"too little memory: {words}; a smaller volume, or fewer --threads, need less", OutputError.exit_code
    if isinstance(error, OSError) and error.errno and error.filename is not None:
        # What readers meet they say themselves: this is a place where nothing can be made.
        return f"{shown(Path(os.fsdecode(error.filename)))}: cannot be used: {reason(error)}", OutputError.exit_code
    return f"a bug: {type(error).__name__}: {error} (run again with --debug to see where)", EXIT_BUG


def print_json(figures: dict[str, Any]) -> None:
    """Print the one JSON object of a command to stdout; what is no number is null there."""
    click.echo(json.dumps(without_nan(figures), allow_nan=False, sort_keys=True))


def error_record(error: BaseException) -> dict[str, Any]:
    """Return an error as plain data."""
    message, code = outcome_of(error)
    return {"error": printable(message), "exit_code": code}


def printable(message: str) -> str:
    """Return a message whose names of files may be no UTF-8 as text that is."""
    return message.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


# What options are about, in the order in which a command's help shows them, by their names; "" are all others.
GROUPS = {
    "What it needs": "named files_from raw white dark board depth_mm background mask mask_volume calibration config "
    "vectors volume particles at pressure",
    "What it makes": "output picture views report combine grid derived mean residual residuals keep schema to "
    "overwrite",
    "How": "",
    "Pairs and batches": "pairing pair_by pairs watch idle_s resume keep_going failures shard time_limit_s dask "
    "dry_run",
    "What it prints, and on what it runs": "as_json verbose quiet log verify threads debug help",
}
CONFIGS = "the config's"


class Command(click.Command):
    """A command whose help shows options in groups."""

    def format_options(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write each option under what it is about."""
        titles = {name: title for title, names in GROUPS.items() for name in names.split()}
        other = next(title for title, names in GROUPS.items() if not names)
        shown: dict[str, list[tuple[str, str]]] = {title: [] for title in GROUPS}
        for option in self.get_params(context):
            record = option.get_help_record(context) if isinstance(option, click.Option) else None
            if record is not None:
                name = "help" if "--help" in option.opts else str(option.name)
                shown[titles.get(name, other)].append(record)
        for title, records in shown.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


command = partial(click.command, cls=Command, context_settings={"show_default": True})
# Whether a file can be read its reader tells: an input's fault, and none of the command line.
FILE = click.Path(path_type=Path, readable=False)
POSITIVE = click.FloatRange(min=0.0, min_open=True)


def option(name: str, kind: Any, text: str, *called: str, **more: Any) -> Callable[..., Any]:
    """Return an option: a flag (`bool`), one of a kind of names, of a type of values, or what a function makes of text.

    Parameters
    ----------
    text : its help
    called : as in the command, where that is not its name
    """
    if kind is bool:
        more["is_flag"] = True
    elif get_origin(kind) is Literal:
        more["type"] = click.Choice(names_in(kind))
    elif isinstance(kind, (type, click.ParamType)):
        more["type"] = kind
    else:
        more["callback"] = lambda _context, _option, given: None if given is None else kind(given)
    return click.option(name, *called, help=text, **more)


config_argument = click.argument("config", type=FILE)
white_option = option("--white", FILE, "White image, uniform light; twice: stopped down and not.", multiple=True)
board_option = option(
    "--board",
    FILE,
    "Snapshot of the calibration target: dots, a chessboard or a ChArUco board; or several.",
    multiple=True,
)
depth_option = option(
    "--depth-mm",
    float,
    "Depth of each target in the fluid, for dlfc; without a target, of the channel's mid plane.",
    multiple=True,
)
dark_option = option("--dark", FILE, "Dark image, taken with the cap on.")
background_option = option(
    "--background", str, "Image to subtract, or minimum or mean over the images given, or as minimum:15."
)
mask_option = option(
    "--mask",
    str,
    "Image that is black where pixels are left out (reflections, bubbles), or still: where light stands still in "
    "the images given, brighter than what moves.",
)
dt_option = option(
    "--dt-s", POSITIVE, "Time from one frame to the next.", show_default="the config's, or the recording's"
)
resume_option = option("--resume", bool, "Skip outputs that are complete and made from the same inputs.")


def inputs_argument(name: str, kind: InputKind = "images") -> Callable[..., Any]:
    """Give a command the argument of its many inputs, with --files-from: lists and folders are files to it."""

    def with_inputs(command: Callable[..., Any]) -> Callable[..., Any]:
        @click.argument(name, type=FILE, nargs=-1)
        @option("--files-from", FILE, f"List of more {name}, a file or folder a line; - for stdin.")
        @wraps(command)
        def run(files_from: Path | None = None, **arguments: Any) -> Any:
            from lfpiv_cli.files.batch import expanded, listed

            if arguments.get("watch"):
                if files_from is not None:
                    raise click.UsageError("--watch takes folders, and no list of files")
                return command(**arguments)
            more = [] if files_from is None else listed(files_from)
            arguments[name] = tuple(expanded([*arguments[name], *more], kind))
            if not arguments[name]:
                raise click.UsageError(f"no {name} were given")
            return command(**arguments)

        return run

    return with_inputs


def watch_options(unless: str) -> Callable[..., Any]:
    """Return the options of folders that are still being filled; `unless` is when they end if that is not given."""
    help_text = "The folders given are still being filled: take files as they become complete, in order."
    text = "With --watch, end so many seconds after the last change."
    idle = option("--idle-s", POSITIVE, text, show_default=unless)
    watch = option("--watch", bool, help_text)
    return lambda command: watch(idle(command))


def raw_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the layout of images without a header, which their names carry from here on."""

    @option(
        "--raw",
        str,
        "Layout of the .raw and .bin images among those given: WIDTHxHEIGHTxBITS and options, as in "
        "2352x1768x12:packing=low-first.",
        metavar="LAYOUT",
    )
    @wraps(command)
    def run(raw: str | None = None, **arguments: Any) -> Any:
        if raw is None:
            return command(**arguments)
        from lfpiv_cli.files.recording import parse_layout, with_layout

        parse_layout(raw)
        if arguments.get("watch"):
            raise click.UsageError("--watch takes no --raw: a file without a header does not tell when it is whole")

        def named(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(named(each) for each in value)
            return with_layout(value, raw) if isinstance(value, Path) else value

        # These may be words, and are no paths for that.
        for name in ("background", "mask"):
            if isinstance(arguments.get(name), str):
                arguments[name] = str(with_layout(Path(arguments[name]), raw))
        return command(**{name: named(value) for name, value in arguments.items()})

    return run


def work_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of all that goes through many frames."""
    for each in (
        option(
            "--dry-run",
            bool,
            "Tell what would be made, how large and, by the --log of an earlier run, in which time; write nothing.",
        ),
        option(
            "--time-limit",
            parse_time_limit,
            "Stop before so long, as 3600, 50m or 00:50:00, with exit code 75; --resume goes on.",
            "time_limit_s",
            metavar="TIME",
        ),
        option(
            "--shard", Shard.parse, "Make part I of N only, or that of this job in Slurm's array.", metavar="I/N|slurm"
        ),
        option("--failures", FILE, "File to list what failed in, with the reason (JSON)."),
        option("--keep-going", bool, "Go on with the next one when an input fails; exit 5."),
        resume_option,
    ):
        command = each(command)
    return command


def batch_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of all batches, whose outputs workers elsewhere can make, too."""
    help_text = "Work on the workers of this Dask scheduler, or on N workers on this machine."
    return work_options(option("--dask", str, help_text, metavar="ADDRESS|local[:N]")(command))


def pairing_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options that say which frames belong together."""
    how = option(
        "--pairing", Pairing, "Frames belong together in separate pairs, or each with the next, by their names."
    )
    template = option(
        "--pair-by", str, "How names tell pairs, where they do it in no usual way: img_{pair}_{frame}, or img_{number}."
    )
    listed = option("--pairs", FILE, "File that lists pairs, two names a line.")
    return how(template(listed(command)))


def calls(stage: str, options: str | None, *files: str) -> Callable[..., Any]:
    """Have a command call a function of `verbs`: with its files, and with all else that it is given as options."""
    module, _, function = stage.partition(".")

    def with_call(command: Callable[[], None]) -> Callable[..., Any]:
        @wraps(command)
        def run(overwrite: bool, console: Console, **arguments: Any) -> Any:
            verb = import_module(f"lfpiv_cli.verbs.{module}")
            given = [arguments.pop(name, None) for name in files]
            chosen = [] if options is None else [getattr(verb, options)(**arguments)]
            return getattr(verb, function)(*given, *chosen, overwrite=overwrite, console=console)

        return run

    return with_call


def output_option(text: str, required: bool = True) -> Callable[..., Any]:
    """Return the option -o of a command, with what it writes."""
    return click.option("-o", "--output", type=FILE, required=required, help=text)


# Of the paths that a command is given, those that it writes.
OUTPUTS = ("output", "picture", "failures", "cache", "mean")


def _flat(values: Iterable[Any]) -> list[Any]:
    """Return the values that a command is given, each of those that are given several times."""
    return [each for value in values for each in (value if isinstance(value, tuple) else (value,))]


def voice_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command, or the program before its commands, the options that say what it prints, and where."""
    for each in (
        option("--debug", bool, "Show the traceback of an error.", expose_value=False),
        click.option("-q", "--quiet", is_flag=True, help="Say nothing on stderr but errors."),
        click.option("-v", "--verbose", is_flag=True, help="Say more on stderr."),
        option("--json", bool, "Print one JSON object to stdout, warnings to stderr.", "as_json"),
    ):
        command = each(command)
    return command


def common_options(command: Callable[..., dict[str, Any]]) -> Callable[..., None]:
    """Give a command the options that all share, and print the summary it returns.

    It is called with `overwrite`, a `console`, and those of its own arguments that were given: for the others the
    defaults of the stage's options hold.
    """

    @option("--overwrite", bool, "Replace outputs that exist.")
    @option("--threads", click.IntRange(min=1), "Threads to use.", show_default="all cores")
    @option("--log", FILE, "Add a line of JSON to this file for each event: start, frame, warning, end, error.")
    @option("--verify", FILE, "Check all inputs by this list of sha256sum before any work.")
    @voice_options
    @wraps(command)
    def run(
        threads: int | None,
        as_json: bool,
        log: Path | None,
        verify: Path | None,
        verbose: bool,
        quiet: bool,
        **arguments: Any,
    ) -> None:
        from lfpiv_cli.console import Console
        from lfpiv_cli.files.atomic import EventLog, place_of
        from lfpiv_cli.files.recording import complaints_kept
        from lfpiv_cli.notice import Notice

        warned: list[Notice] = []
        log_file = None
        if log is not None:
            if place_of(log) in [place_of(each) for each in _flat(arguments.values()) if isinstance(each, Path)]:
                raise UsageError(f"{log}: is the log, and another file of this command, too")
            name = click.get_current_context().command.name or ""
            # Of a dry run for reading alone.
            log_file = EventLog(log, name, read_only=bool(arguments.get("dry_run")))
        console = Console(verbose=verbose, quiet=quiet, only_warnings=as_json, warned=warned, log=log_file)
        if threads is not None:
            from lfpiv_cli.threads import use_threads

            use_threads(threads)
        console.event("start", version=__version__)
        ended_with: LimitMissedError | PartialError | None = None
        try:
            given = {name: value for name, value in arguments.items() if value is not None}
            if verify is not None:
                from lfpiv_cli.files.provenance import ensure_verified

                # All that it reads; a text may name a file, too.
                read = _flat(value for name, value in given.items() if name not in OUTPUTS)
                texts = {each for each in read if isinstance(each, str) and os.path.exists(each)}
                ensure_verified(verify, [Path(each) for each in read if isinstance(each, Path) or each in texts])
            with complaints_kept() as complaints:
                summary = command(console=console, **given)
        except (LimitMissedError, PartialError) as error:
            ended_with, summary = error, error.figures
        except BaseException as error:
            console.event("error", **error_record(error))
            raise
        console.warn(complaints)
        ended = error_record(ended_with) if ended_with else {"exit_code": 0}
        console.event("end", summary=summary, **ended)
        if kernel_cache.lost and "numba" in sys.modules:
            console.say(f"lfpiv: {kernel_cache.HINT}")
        if as_json:
            warnings = [notice.record() for notice in warned]
            print_json(summary | {"warnings": warnings} | (ended if ended_with else {}))
        else:
            console.summary(summary)
        if ended_with:
            raise ended_with

    return run
