"""What a person sees while a command runs: progress on a terminal, a short summary, all of it on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import click


@dataclass(frozen=True)
class Console:
    """The voice of one command.

    Attributes
    ----------
    verbose : say more
    quiet : say nothing but errors
    """

    verbose: bool = False
    quiet: bool = False

    def say(self, text: str) -> None:
        """Print a line that everybody should see."""
        if not self.quiet:
            click.echo(text, err=True)

    def warn(self, text: str) -> None:
        """Print what went otherwise than one would expect, and does not keep the command from going on."""
        self.say(f"lfpiv: {text}")

    def detail(self, text: str) -> None:
        """Print a line for those who asked for more."""
        if self.verbose and not self.quiet:
            click.echo(text, err=True)

    def summary(self, figures: dict[str, Any]) -> None:
        """Print the figures of a command, one a line."""
        for name, value in figures.items():
            self.say(f"{name:>28}  {_readable(value)}")

    @contextmanager
    def progress(self, total: int, label: str) -> Iterator[Callable[[int], None]]:
        """Show a progress bar on a terminal and nothing elsewhere; yields the function that advances it."""
        if self.quiet or not sys.stderr.isatty():
            yield lambda _steps: None
            return
        from tqdm import tqdm

        with tqdm(total=total, desc=label, file=sys.stderr, leave=False) as bar:
            yield lambda steps: bar.update(steps) and None


# For those who call a stage from Python and say nothing of it.
CONSOLE = Console()


def _readable(value: Any) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_readable(each)}" for name, each in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_readable(each) for each in value)
    return str(value)
