"""The command `lfpiv`: its subcommands, and how errors become exit codes."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import NoReturn

import click

from lfpiv_cli import __version__
from lfpiv_cli.cli import (
    calibration,
    inspection,
    planning,
    reconstruction,
    simulation,
    tracks,
    validation,
    vectors,
    weights,
)
from lfpiv_cli.errors import LfpivError

EXIT_BUG = 1
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143

COMMANDS = (
    planning.init,
    calibration.calibrate_snapshot,
    calibration.refine_calibration,
    weights.build_weights,
    reconstruction.reconstruct,
    vectors.correlate,
    vectors.combine,
    tracks.track,
    tracks.follow,
    inspection.info,
    validation.validate,
    simulation.simulate,
)


class Terminated(BaseException):
    """SIGTERM arrived; unwinds like KeyboardInterrupt so that temporary files are removed."""


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="lfpiv")
def cli() -> None:
    """From raw light-field camera images to three-dimensional velocity fields (PIV and PTV).

    \b
    lfpiv calibrate-snapshot rig.yaml --white white.tif --board board.tif -o calibration.h5
    lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5
    lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif -o volumes
    lfpiv correlate volumes/a.vtkhdf volumes/b.vtkhdf -o vectors.vtkhdf
    lfpiv validate flow rig.yaml --vectors vectors.vtkhdf -o report
    """


for _command in COMMANDS:
    cli.add_command(_command)


def main() -> NoReturn:
    """Run the command line and leave with the exit code of the outcome."""
    debug = "--debug" in sys.argv[1:]
    signal.signal(signal.SIGTERM, _terminate)
    try:
        cli.main(standalone_mode=False)
        code = 0
        sys.stdout.flush()
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (KeyboardInterrupt, click.Abort):
        code = EXIT_INTERRUPTED
    except Terminated:
        code = EXIT_TERMINATED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except LfpivError as error:
        if debug:
            raise
        _complain(str(error))
        code = error.exit_code
    except Exception as error:
        if debug:
            raise
        _complain(f"a bug: {type(error).__name__}: {error} (run again with --debug to see where)")
        code = EXIT_BUG
    sys.exit(code)


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise Terminated


def _complain(message: str) -> None:
    click.echo(f"lfpiv: {message}".encode("utf-8", "surrogateescape").decode("utf-8", "replace"), err=True)
