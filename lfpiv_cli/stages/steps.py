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
from lfpiv_cli.errors import LfpivError, OutputExistsError
from lfpiv_cli.files.atomic import write_json
from lfpiv_cli.files.provenance import carried_record, sha256

RECORD = "run.json"


@dataclass(frozen=True)
class Steps:
    """The steps of a run, those that were taken so far.

    Attributes
    ----------
    output : the run's folder
    earlier : what `run.json` said before
    told : what it says now
    files : what all steps have made or kept
    """

    output: Path
    console: Console
    earlier: Mapping[str, Any]
    told: dict[str, Any] = field(default_factory=lambda: {"steps": {}, "summaries": {}})
    files: list[Path] = field(default_factory=list)

    def take(self, name: str, files: Sequence[Path], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Take a step, which makes files; write down and return what it told.

        Raises
        ------
        LfpivError : as the step does, with its name and what becomes of the steps before
        """
        number = len(self.told["steps"]) + 1
        self.console.say(f"step {number}: {name}")
        before = [_stamp(path) for path in files]
        try:
            summary = make()
        except LfpivError as error:
            done = "; what is done stays, and the same command goes on from there" if number > 1 else ""
            raise type(error)(f"step {number}, {name}: {error}{done}") from error
        made = {path.relative_to(self.output).as_posix(): sha256(path) for path in files}
        is_kept = before == [_stamp(path) for path in files]
        if is_kept:
            self.console.say(f"step {number}: kept, complete and made alike")
            if self.earlier.get("steps", {}).get(name, {}).get("files") == made:
                summary = self.earlier.get("summaries", {}).get(name, summary)
        self.told["steps"][name] = {"state": "kept" if is_kept else "made", "files": made}
        self.told["summaries"][name] = summary
        self.files.extend(files)
        self.write()
        return summary

    def count(self, state: str) -> int:
        """Return how many steps were `made`, or `kept`."""
        return sum(step["state"] == state for step in self.told["steps"].values())

    def write(self) -> None:
        """Write down what is known so far."""
        write_json(self.output / RECORD, self.told | {"warnings": self._warnings()}, overwrite=True)

    def _warnings(self) -> list[dict[str, Any]]:
        """Return what was warned of, in this run and when what it kept was made."""
        recorded = [warning for path in self.files for warning in _recorded(path)]
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


def _recorded(path: Path) -> Iterable[dict[str, Any]]:
    """Return the warnings that a file of ours carries of its own making."""
    return carried_record(path).get("warnings", ()) if path.suffix in (".h5", ".vtkhdf") else ()


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file is written; None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns
