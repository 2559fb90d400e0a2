"""One exception per exit code.

Every failure that a user can cause or meet is one of these; its message is a single sentence that names the place, what
was found and what was expected. Anything else that escapes is a bug (exit code 1).
"""

from typing import Any


class LfpivError(Exception):
    """Base of all expected failures; `exit_code` is what the command returns to the shell."""

    exit_code = 1


class UsageError(LfpivError):
    """The command line asks for something that makes no sense, or for an extra that is not installed."""

    exit_code = 2


class ConfigError(LfpivError):
    """The configuration is malformed, contradictory or physically impossible."""

    exit_code = 3


class InputError(LfpivError):
    """An input is missing, broken, or does not belong with the others."""

    exit_code = 4


class PartialError(LfpivError):
    """Some frames of a batch failed; the others were written, and `figures` are what is told of all of them."""

    exit_code = 5

    def __init__(self, message: str, figures: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.figures = figures or {}


class OutputExistsError(LfpivError):
    """The output is there already and overwriting was not asked for."""

    exit_code = 6


class OutputError(LfpivError):
    """The output cannot be written: no such folder, no permission, no space."""

    exit_code = 7


class LimitMissedError(LfpivError):
    """A validation ran to its end and a figure missed its limit; `figures` are what it would have returned."""

    exit_code = 8

    def __init__(self, message: str, figures: dict[str, Any]) -> None:
        super().__init__(message)
        self.figures = figures


class StoppedEarlyError(LfpivError):
    """A batch stopped before its time limit; what it has not made yet is left for the same command with --resume."""

    exit_code = 75
