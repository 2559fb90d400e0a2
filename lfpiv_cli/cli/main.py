"""The command `lfpiv`: its subcommands, and how errors become exit codes."""

from __future__ import annotations

import sys
from typing import Any, NoReturn

import click

from lfpiv_cli import __version__
from lfpiv_cli.cli import (
    calibration,
    chain,
    exports,
    fields,
    inspection,
    planning,
    reconstruction,
    report,
    simulation,
    tracks,
    validation,
    vectors,
    weights,
)
from lfpiv_cli.cli.environment import settle_environment
from lfpiv_cli.cli.interrupts import end_by_signals, ended_by
from lfpiv_cli.cli.options import voice_options
from lfpiv_cli.cli.outcome import outcome_of, print_json_error, printable
from lfpiv_cli.cli.streams import ensure_said, open_streams
from lfpiv_cli.files.inputs import ensure_address_space

COMMANDS = (
    planning.init,
    planning.check,
    chain.run,
    calibration.calibrate_snapshot,
    calibration.refine_calibration,
    weights.build_weights,
    reconstruction.reconstruct,
    vectors.correlate,
    vectors.combine,
    tracks.track,
    fields.field,
    tracks.follow,
    inspection.info,
    inspection.plot,
    inspection.warm_up,
    report.report,
    exports.export,
    validation.validate,
    simulation.simulate,
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
    settle_environment()
    context.default_map = {str(context.invoked_subcommand): {name: value for name, value in before.items() if value}}


def first_sentence(text: str) -> str:
    """Return the first sentence of a help, on one line and without its full stop."""
    return " ".join(text.split("\n\n")[0].split()).split(". ")[0].removesuffix(".")


for _command in COMMANDS:
    # click would cut what is longer than a line.
    _command.short_help = _command.short_help or first_sentence(_command.help or "")
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
        ensure_said(stdout)
        code = 0
    except SystemExit:
        raise
    except BaseException as raised:
        error = ended_by(raised)
        message, code = outcome_of(error)
        if as_json:
            print_json_error(error)
        if isinstance(error, click.ClickException):
            error.show()
        elif isinstance(error, Exception) and not isinstance(error, click.Abort):
            if debug:
                raise
            click.echo(printable(f"lfpiv: {message}"), err=True)
    sys.exit(code)
