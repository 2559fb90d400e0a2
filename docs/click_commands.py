"""The commands as attributes, which is how sphinx-click asks for what it shows."""

from __future__ import annotations

from typing import Any

import click

from lfpiv_cli.cli.main import cli


def names() -> list[str]:
    """Return the commands' names in the order in which the program lists them."""
    return cli.list_commands(click.Context(cli))


def __getattr__(name: str) -> Any:
    """Return a command by its name with underscores."""
    command = cli.get_command(click.Context(cli), name.replace("_", "-"))
    if command is None:
        raise AttributeError(name)
    return command
