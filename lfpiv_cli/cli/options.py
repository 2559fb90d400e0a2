"""What commands have in common: options written once, the settings of a run, and how a summary is printed."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.names import Pairing, names_in

FILE = click.Path(path_type=Path)
POSITIVE = click.FloatRange(min=0.0, min_open=True)

config_argument = click.argument("config", type=FILE)
dark_option = click.option("--dark", type=FILE, help="Dark image, taken with the cap on.")
background_option = click.option(
    "--background", help="Image to subtract, or minimum or mean over the images given, or as minimum:15."
)
mask_option = click.option(
    "--mask",
    help="Image that is black where pixels are left out (reflections, bubbles), or still: where light stands still in "
    "the images given, brighter than what moves.",
)
dt_option = click.option("--dt-s", type=POSITIVE, help="Time from one frame to the next; default from the config.")
pairing_option = click.option(
    "--pairing",
    type=click.Choice(names_in(Pairing)),
    help="Frames belong together in separate pairs, or each with the next.",
)
resume_option = click.option(
    "--resume", is_flag=True, help="Skip outputs that are complete and made from the same inputs."
)


def output_option(text: str, required: bool = True) -> Callable[..., Any]:
    """Return the option -o of a command, with what it writes."""
    return click.option("-o", "--output", type=FILE, required=required, help=text)


def common_options(command: Callable[..., dict[str, Any]]) -> Callable[..., None]:
    """Give a command the options that all share, and print the summary it returns.

    It is called with `overwrite`, a `console`, and those of its own arguments that were given: for the others the
    defaults of the stage's options hold.
    """

    @click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
    @click.option("--threads", type=click.IntRange(min=1), help="Threads to use; all cores when not given.")
    @click.option(
        "--json", "as_json", is_flag=True, help="Print one JSON object to stdout, and only warnings to stderr."
    )
    @click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")
    @click.option("-q", "--quiet", is_flag=True, help="Say nothing on stderr but errors.")
    @click.option("--debug", is_flag=True, expose_value=False, help="Show the traceback of an error.")
    @wraps(command)
    def run(threads: int | None, as_json: bool, verbose: bool, quiet: bool, **arguments: Any) -> None:
        from lfpiv_cli.console import Console
        from lfpiv_cli.notice import Notice

        warned: list[Notice] = []
        console = Console(verbose=verbose, quiet=quiet, only_warnings=as_json, warned=warned)
        if threads is not None:
            from lfpiv_cli.threads import use_threads

            use_threads(threads)
        missed: LimitMissedError | None = None
        try:
            given = {name: value for name, value in arguments.items() if value is not None}
            summary = command(console=console, **given)
        except LimitMissedError as error:
            missed, summary = error, error.figures
        if as_json:
            told = summary | {"warnings": [notice.record() for notice in warned]}
            click.echo(json.dumps(told, allow_nan=False, sort_keys=True))
        else:
            console.summary(summary)
        if missed:
            raise missed

    return run
