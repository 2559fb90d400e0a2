"""What the end of a command says and gives to the shell: a sentence and an exit code for whatever was raised."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import click

from lfpiv_cli.errors import LfpivError, LimitMissedError, OutputError, PartialError
from lfpiv_cli.files.atomic import shown, without_nan
from lfpiv_cli.files.inputs import reason

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


def print_json_error(error: BaseException) -> None:
    """Print an error as the JSON object of a command; one that came with figures stands in theirs already."""
    if not isinstance(error, (LimitMissedError, PartialError)):
        print_json(error_record(error))


def error_record(error: BaseException) -> dict[str, Any]:
    """Return an error as plain data."""
    message, code = outcome_of(error)
    return {"error": printable(message), "exit_code": code}


def printable(message: str) -> str:
    """Return a message whose names of files may be no UTF-8 as text that is."""
    return message.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
