"""The command line: parse, call a verb, print its summary; errors become exit codes.

A module for each group of commands, whose bodies call a verb; `main` lists them. To add a command, write it in a
module with the options of `options` and name it in `main.COMMANDS`. Heavy imports happen inside the commands, so that
`--help` answers at once.
"""

from __future__ import annotations

from lfpiv_cli.cli.main import cli, main

__all__ = ["cli", "main"]
