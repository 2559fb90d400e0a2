"""What a person sees of a command: its answer on stdout; how far it is and what it warns of on stderr.

On a terminal how far it is shows as a bar; elsewhere a line is printed for each frame, and for work of one piece every
ten seconds. The log, where one is asked for, gets the same as events.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import click

from lfpiv_cli.files.atomic import EventLog, largest_memory_mb
from lfpiv_cli.notice import Notice, written

# Without a terminal, lines of work that is one piece are this far apart, and those within a frame that takes long.
SECONDS_BETWEEN_LINES, SECONDS_WITHIN_FRAME = 10.0, 60.0
# Of warnings with one code so many are printed: the same of each of a thousand pairs hides all else.
MOST_ALIKE = 3
# Where the summary's figures begin.
NAME_WIDTH = 28
# Frames count in fractions while they are worked on.
FRAMES_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total} {unit}s [{elapsed}<{remaining}, {rate_fmt}]"


@dataclass(frozen=True)
class Console:
    """The voice of one command.

    Attributes
    ----------
    verbose : say more
    quiet : say nothing but errors on stderr; the answer on stdout stays
    only_warnings : say nothing but errors and warnings: the answer goes elsewhere
    warned : where it is given, all warnings are added to it, and none is printed twice
    log : where it is given, what happens is added to it, whatever else is silent
    """

    verbose: bool = False
    quiet: bool = False
    only_warnings: bool = False
    warned: list[Notice] | None = None
    log: EventLog | None = None
    # Those of `warned`, to look them up in: thousands of frames may each have some.
    _told: set[Notice] = field(default_factory=set, init=False, repr=False, compare=False)
    _printed: Counter[str] = field(default_factory=Counter, init=False, repr=False, compare=False)

    def event(self, name: str, /, **fields: Any) -> None:
        """Add what happens to the log."""
        if self.log is not None:
            self.log.write(name, fields)

    @property
    def log_file(self) -> Path | None:
        """Where the log goes, if there is one."""
        return None if self.log is None else self.log.path

    def say(self, text: str) -> None:
        """Print a line that everybody should see, on stderr."""
        if not self._silent:
            click.echo(text, err=True)

    def answer(self, text: str) -> None:
        """Print a line of what the command was asked for, on stdout."""
        if not self.only_warnings:
            click.echo(text)

    def warn(self, notices: Iterable[Notice]) -> None:
        """Print what speaks against a result and does not keep the command from going on, a line each."""
        for notice in notices:
            if self.warned is not None:
                if notice in self._told:
                    continue
                self._told.add(notice)
                self.warned.append(notice)
            self.event("warning", **notice.record())
            self._printed[notice.code] += 1
            if not self.quiet and self._printed[notice.code] <= MOST_ALIKE:
                last = "; more of these are not printed" if self._printed[notice.code] == MOST_ALIKE else ""
                click.echo(f"lfpiv: warning: {notice}{last}", err=True)

    def detail(self, text: str) -> None:
        """Print a line for those who asked for more."""
        if self.verbose:
            self.say(text)

    def summary(self, figures: Mapping[str, Any]) -> None:
        """Print the figures of a command on stdout, one a line; or its `summary` in words, where it has one.

        What there is for several things, as a figure with a value for each or under names like `recorded.ert.error`,
        stands in a table. Of a list of records each has a line, which begins with its first entry.
        """
        figures = dict(figures)
        in_words = figures.pop("summary", [])
        for line in in_words:
            self.answer(line)
        if in_words and not self.verbose:
            return
        unfolded: dict[str, Any] = {}
        for name, value in figures.items():
            if isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
                records = [[readable(each) for each in record.values()] for record in value]
                unfolded |= {first: "  ".join(rest) for first, *rest in records}
            else:
                unfolded[name] = value
        blocks = _blocks(unfolded)
        first = max([NAME_WIDTH, *(len(name) for block in blocks for name in block)])
        for block in blocks:
            heads = list(dict.fromkeys(head for value in block.values() if _is_row(value) for head in value))
            table = {"": heads} if heads else {}
            for name, value in block.items():
                table[name] = [readable(value.get(head)) for head in heads] if _is_row(value) else [readable(value)]
            rows = [name for name, cells in table.items() if not name or _is_row(block[name])]
            widths = [max(map(len, column)) for column in zip(*(table[name] for name in rows), strict=True)]
            for name, cells in table.items():
                columns = map(str.rjust, cells, widths) if name in rows else cells
                self.answer(f"{name:>{first}}  {'  '.join(columns)}")

    @contextmanager
    def progress(self, total: int, label: str) -> Iterator[Callable[[int], None]]:
        """Show how far a work of so many steps is; yields the function that advances it."""
        if self._silent:
            yield lambda _steps: None
        elif self._is_terminal:
            from tqdm import tqdm

            with tqdm(total=total, desc=label, file=sys.stderr, leave=False) as bar:
                yield lambda steps: bar.update(steps) and None
        else:
            begun = reported = time.monotonic()
            done = 0

            def advance(steps: int) -> None:
                nonlocal reported, done
                done, now = done + steps, time.monotonic()
                if now - reported >= SECONDS_BETWEEN_LINES and done:
                    reported, rate = now, done / (now - begun)
                    left = _duration(max(total - done, 0) / rate)
                    self.say(f"{label}: {done} of {total} steps, {written(rate)} a second, {left} left")

            yield advance

    @contextmanager
    def frames(self, total: int, steps: float, label: str, unit: str = "frame") -> Iterator[Frames]:
        """Show how many frames are done, each of about so many steps."""
        if self._silent or not self._is_terminal:
            yield Frames(self, total, steps, label, unit)
            return
        from tqdm import tqdm

        with tqdm(total=total, desc=label, unit=unit, bar_format=FRAMES_BAR, file=sys.stderr, leave=False) as bar:
            yield Frames(self, total, steps, label, unit, lambda number: bar.update(number - bar.n) and None)

    @property
    def _silent(self) -> bool:
        """True where only errors, or these and warnings, are printed."""
        return self.quiet or self.only_warnings

    @property
    def _is_terminal(self) -> bool:
        """True where bars can be drawn."""
        return sys.stderr.isatty()


@dataclass
class Frames:
    """So many frames of a batch, of how many steps each, as they are worked on; `draw` shows them in place of lines."""

    console: Console
    total: int
    steps: float
    label: str
    unit: str
    draw: Callable[[float], None] | None = None
    _done: int = 0
    _part: float = 0.0

    def __post_init__(self) -> None:
        """Begin."""
        self._begun = self._told = time.monotonic()

    def advance(self, steps: float) -> None:
        """Take so many steps in the frame that is worked on."""
        self._part = min(self._part + steps / self.steps, 1.0)
        if self.draw is not None:
            self.draw(self._done + self._part)
        elif time.monotonic() - self._told >= SECONDS_WITHIN_FRAME:
            self._told = time.monotonic()
            self.console.say(f"{self.label}: {self._done + self._part:.1f} of {self.total} {self.unit}s")

    def done(self, name: str) -> None:
        """Count a frame that is complete, or given up."""
        self._done, self._part, self._told = self._done + 1, 0.0, time.monotonic()
        each = (time.monotonic() - self._begun) / self._done
        left = each * (self.total - self._done)
        self.console.event(
            "frame",
            step=self.label,
            name=name,
            done=self._done,
            of=self.total,
            seconds_each=round(each, 3),
            seconds_left=round(left, 3),
            memory_mb=largest_memory_mb(),
        )
        if self.draw is not None:
            self.draw(self._done)
        else:
            count = f"{self._done} of {self.total} {self.unit}s"
            self.console.say(f"{self.label}: {name}, {count}, {written(each)} s each, {_duration(left)} left")


# For those who call a stage from Python and say nothing of it.
CONSOLE = Console()


def _duration(seconds: float) -> str:
    """Return a time as a person says it."""
    if seconds < 60.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def _blocks(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return figures in blocks, each with heads of its own: names with a point are what the figure is of, and which.

    Where there are more figures than things they are of, each thing has a column.
    """
    blocks: list[dict[str, Any]] = []
    for of, items in groupby(figures.items(), lambda item: item[0].rpartition(".")[0] if _is_number(item[1]) else ""):
        if not of:
            blocks.append(dict(items))
            continue
        row = {name.rpartition(".")[2]: value for name, value in items}
        if blocks and all(_is_row(each) and list(each) == list(row) for each in blocks[-1].values()):
            blocks[-1][of] = row
        else:
            blocks.append({of: row})
    for k, block in enumerate(blocks):
        heads = list(next(iter(block.values()), {})) if all(map(_is_row, block.values())) else []
        if len(heads) > len(block):
            blocks[k] = {head: {name: row.get(head) for name, row in block.items()} for head in heads}
    return blocks


def _is_row(value: Any) -> bool:
    """Return whether a figure is a row of numbers, one for each method."""
    return isinstance(value, dict) and bool(value) and all(_is_number(each) for each in value.values())


def _is_number(value: Any) -> bool:
    """Return whether a figure is a number, or not known."""
    return value is None or isinstance(value, (int, float))


def readable(value: Any, digits: int = 6, unknown: str = "unknown") -> str:
    """Return a figure, or several, as a person reads them; `unknown` stands for one that is not known."""
    if value is None:
        return unknown
    if isinstance(value, float):
        return written(value, digits)
    if isinstance(value, dict):
        return ", ".join(f"{name} {readable(each, digits, unknown)}" for name, each in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(readable(each, digits, unknown) for each in value)
    return str(value)
