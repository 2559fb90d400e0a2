"""What a person sees while a command runs: progress on a terminal, a short summary, all of it on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import click

from lfpiv_cli.notice import Notice


@dataclass(frozen=True)
class Console:
    """The voice of one command.

    Attributes
    ----------
    verbose : say more
    quiet : say nothing but errors
    only_warnings : say nothing but errors and warnings: the summary goes elsewhere
    warned : where it is given, all warnings are added to it, and none is printed twice
    """

    verbose: bool = False
    quiet: bool = False
    only_warnings: bool = False
    warned: list[Notice] | None = None

    def say(self, text: str) -> None:
        """Print a line that everybody should see."""
        if not self._silent:
            click.echo(text, err=True)

    def warn(self, notices: Iterable[Notice]) -> None:
        """Print what speaks against a result and does not keep the command from going on, a line each."""
        for notice in notices:
            if self.warned is not None:
                if notice in self.warned:
                    continue
                self.warned.append(notice)
            if not self.quiet:
                click.echo(f"lfpiv: warning: {notice}", err=True)

    def detail(self, text: str) -> None:
        """Print a line for those who asked for more."""
        if self.verbose:
            self.say(text)

    def summary(self, figures: dict[str, Any]) -> None:
        """Print the figures of a command, one a line."""
        for name, value in figures.items():
            self.say(f"{name:>28}  {_readable(value)}")

    @contextmanager
    def progress(self, total: int, label: str) -> Iterator[Callable[[int], None]]:
        """Show a progress bar on a terminal and nothing elsewhere; yields the function that advances it."""
        if self._silent or not sys.stderr.isatty():
            yield lambda _steps: None
            return
        from tqdm import tqdm

        with tqdm(total=total, desc=label, file=sys.stderr, leave=False) as bar:
            yield lambda steps: bar.update(steps) and None

    @property
    def _silent(self) -> bool:
        """True where only errors, or these and warnings, are printed."""
        return self.quiet or self.only_warnings


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
