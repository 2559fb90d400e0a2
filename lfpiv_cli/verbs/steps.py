"""The steps of `run`: each is told and taken, and what it made is written down in `run.json`.

A step whose files are complete and made alike leaves them as they are; its summary is then the one of the run that made
them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, LfpivError, OutputExistsError, StoppedEarlyError
from lfpiv_cli.files.atomic import write_json
from lfpiv_cli.files.provenance import bear_alike, carried_record, sha256
from lfpiv_cli.files.shares import Deadline
from lfpiv_cli.verbs.batches import Stamp, stamp_of

RECORD = "run.json"
# What becomes of a step: its files are made; complete and left as they are; or complete and their record is another, as
# settings have changed that they do not depend on.
MADE, KEPT, RECORDED = "made", "kept", "recorded anew"
OURS = (".h5", ".vtkhdf")


@dataclass(frozen=True)
class Steps:
    """The steps of a run, those that were taken so far.

    Attributes
    ----------
    output : the run's folder
    earlier : what `run.json` said before
    deadline : when all steps have to be done
    recorded : whether they are written down; of several shards none can tell of all
    told : what it says now
    files : what all steps have made or kept
    """

    output: Path
    console: Console
    earlier: Mapping[str, Any]
    deadline: Deadline = field(default_factory=Deadline)
    recorded: bool = True
    told: dict[str, Any] = field(default_factory=lambda: {"steps": {}, "summaries": {}})
    files: list[Path] = field(default_factory=list)

    def take(self, name: str, files: Sequence[Path], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Take a step, which makes files; write down and return what it told.

        Raises
        ------
        LfpivError : as the step does, with its name and what becomes of the steps before
        StoppedEarlyError : the time is over
        """
        number = len(self.told["steps"]) + 1
        if not self.deadline.leaves_time():
            raise StoppedEarlyError(
                f"stopped before step {number}, {name}: the time limit of {self.deadline.limit_s:g} s is over; the "
                "same command goes on from there"
            )
        self.console.say(f"step {number}: {name}")
        before, times = [_recorded(path) for path in files], [stamp_of(path) for path in files]
        hashes = self._hashes(files)
        try:
            summary = make()
        except LfpivError as error:
            goes_on = number > 1 and not isinstance(error, OutputExistsError)
            done = "; what is done stays, and the same command goes on from there" if goes_on else ""
            raise type(error)(f"step {number}, {name}: {error}{done}") from error
        state = _state(files, before, times)
        if state != MADE:
            why = "complete and made alike" if state == KEPT else "as it depends on nothing that has changed"
            self.console.say(f"step {number}: {state}, {why}")
            if self.earlier.get("steps", {}).get(name, {}).get("files") == hashes:
                summary = self.earlier.get("summaries", {}).get(name, summary)
        self.told["steps"][name] = {"state": state, "files": self._hashes(files)}
        self.told["summaries"][name] = summary
        self.files.extend(files)
        self.write()
        return summary

    def _hashes(self, files: Iterable[Path]) -> dict[str, str]:
        """Return the hash of each file that is there by its name in the folder; of those that failed there is none."""
        return {path.relative_to(self.output).as_posix(): sha256(path) for path in files if path.exists()}

    def count(self, state: str) -> int:
        """Return how many steps were made, kept, or recorded anew."""
        return sum(step["state"] == state for step in self.told["steps"].values())

    def write(self, *, whole: bool = False) -> None:
        """Write down what is known so far: of steps to come what the run before told, unless this is the `whole` run.

        What a step told would be lost where another one fails before it is found to be complete.
        """
        if not self.recorded:
            return
        told = dict(self.told)
        for part in () if whole else ("steps", "summaries"):
            told[part] = self.earlier.get(part, {}) | self.told[part]
        write_json(self.output / RECORD, told | {"warnings": self._warnings()}, overwrite=True)

    def _warnings(self) -> list[dict[str, Any]]:
        """Return what was warned of, in this run and when what it kept was made."""
        recorded = [warning for path in self.files for warning in (_recorded(path) or {}).get("warnings", ())]
        every: list[dict[str, Any]] = []
        for warning in (*recorded, *(notice.record() for notice in self.console.warned or ())):
            if warning not in every:
                every.append(warning)
        return every


def earlier_run(output: Path, overwrite: bool) -> dict[str, Any]:
    """Return what `run.json` says of the run before; nothing where there was none.

    Raises
    ------
    OutputExistsError : it is not ours, and `overwrite` is false
    """
    path = output / RECORD
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        told = None
    if isinstance(told, dict) and isinstance(told.get("steps"), dict):
        return told
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path}: exists, and is not of a run (use --overwrite to replace it)")
    return {}


def _state(files: Sequence[Path], before: Sequence[Mapping[str, Any] | None], times: Sequence[Stamp]) -> str:
    """Return what became of files, given the records and times that they had before a step."""
    if list(times) == [stamp_of(path) for path in files]:
        return KEPT
    records = [(old, _recorded(path)) for path, old in zip(files, before, strict=True) if path.suffix in OURS]
    alike = bool(records) and all(old and new and old != new and bear_alike(old, new) for old, new in records)
    return RECORDED if alike else MADE


def _recorded(path: Path) -> dict[str, Any] | None:
    """Return the record that a file of ours carries; None where there is none, or a broken one."""
    if path.suffix not in OURS or not path.exists():
        return None
    try:
        return carried_record(path)
    except InputError:
        return None
