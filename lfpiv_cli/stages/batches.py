"""The loop of all batches: which outputs are made, in which order, and what becomes of those that fail.

A batch knows its outputs and how each is made. The loop owns what is the same for all: what is complete is skipped,
what another worker makes is left to it, one bad input stops the batch or is listed, and how far it is is told.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.errors import InputError, PartialError
from lfpiv_cli.files.atomic import ensure_writable, write_text
from lfpiv_cli.files.batch import State, Target, pending, prepare_folder, state_of
from lfpiv_cli.files.claims import claimed
from lfpiv_cli.notice import Notice

# How often a worker that has done all of its own looks at what others have claimed.
SECONDS_BETWEEN_LOOKS = 0.5

Made = TypeVar("Made", covariant=True)
# What tells a file from another one under its name; None where there is none.
Stamp = tuple[int, int] | None


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """What every batch is given.

    Attributes
    ----------
    resume : skip what is complete and made from the same inputs with the same settings
    keep_going : go on with the next one when an input cannot be read
    failures : file to list those that failed in, as JSON
    """

    resume: bool = False
    keep_going: bool = False
    failures: Path | None = None


class Batch(Protocol[Made]):
    """Outputs that are made one after the other, each from inputs of its own.

    Attributes
    ----------
    label, unit : what the work and its outputs are called where it is told how far it is
    """

    label: str
    unit: str

    @property
    def targets(self) -> Sequence[Target]:
        """Where each output goes."""

    @property
    def names(self) -> Sequence[str]:
        """What each output is called."""

    @property
    def inputs(self) -> Sequence[Path]:
        """All files that are read, none of which may be written."""

    @property
    def overwrite(self) -> bool:
        """Whether outputs that were made from other inputs or settings may be replaced."""

    def begin(self, numbers: Sequence[int], console: Console) -> float:
        """Prepare what the outputs of these numbers share, to be made in their order; return the steps of each."""

    def make(self, number: int, work: Frames) -> Made:
        """Make and write an output.

        Raises
        ------
        InputError : one of its inputs cannot be read, or does not belong with the others
        """


@dataclass(frozen=True)
class Failure:
    """An output that could not be made: its name, and the sentence that says why."""

    name: str
    error: str


@dataclass
class Worked(Generic[Made]):
    """What became of a batch.

    Attributes
    ----------
    outcomes : what was told of each output that was made, by its number
    skipped : how many were complete before, or made by another worker
    failures : those that could not be made
    """

    outcomes: dict[int, Made] = field(default_factory=dict)
    skipped: int = 0
    failures: list[Failure] = field(default_factory=list)

    def ensure_whole(self, summary: dict[str, Any], unit: str) -> dict[str, Any]:
        """Return the summary of a batch of which nothing failed.

        Raises
        ------
        PartialError : something did
        """
        if not self.failures:
            return summary
        total = len(self.outcomes) + self.skipped + len(self.failures)
        told = f"{len(self.failures)} of {total} {unit}s failed, the first because {self.failures[0].error}"
        raise PartialError(told, summary | {"failures": [asdict(failure) for failure in self.failures]})


def work_through(batch: Batch[Made], options: BatchOptions, console: Console) -> Worked[Made]:
    """Make what there is to make of a batch.

    Raises
    ------
    OutputExistsError : an output is there, and is not to be skipped or replaced
    InputError : an input cannot be read, and the batch is not to go on without it
    """
    prepare_folder([target.path for target in batch.targets])
    if options.failures is not None:
        ensure_writable(options.failures, batch.overwrite or options.resume, batch.inputs)
    left = pending(batch.targets, batch.inputs, batch.overwrite, options.resume)
    worked: Worked[Made] = Worked(skipped=len(batch.targets) - len(left))
    before = {number: _stamp(batch.targets[number].path) for number in left}
    steps = batch.begin(left, console)
    with console.frames(len(left), steps, batch.label, batch.unit) as work:
        while left:
            of_others = [k for k in left if not _is_settled(batch, k, before[k], options.keep_going, work, worked)]
            if len(of_others) == len(left):
                time.sleep(SECONDS_BETWEEN_LOOKS)
            left = of_others
    if options.failures is not None:
        listed = json.dumps([asdict(failure) for failure in worked.failures], indent=2, ensure_ascii=False)
        write_text(options.failures, listed + "\n", overwrite=True)
    return worked


def _is_settled(
    batch: Batch[Made], number: int, before: Stamp, keep_going: bool, work: Frames, worked: Worked[Made]
) -> bool:
    """Make an output, unless another worker does or did; return False while one does.

    `before` is what was in its place when the batch began.
    """
    target, name = batch.targets[number], batch.names[number]
    with claimed(target.path) as granted:
        if not granted:
            return False
        if _stamp(target.path) != before and state_of(target) is State.COMPLETE:
            worked.skipped += 1
        else:
            try:
                worked.outcomes[number] = batch.make(number, work)
            except InputError as error:
                if not keep_going:
                    raise InputError(f"{error}{_done_before(batch, worked)}") from error
                worked.failures.append(Failure(name, str(error)))
                work.console.warn([Notice("frame-failed", name, str(error), "leave it out, or mend it")])
    work.done(name)
    return True


def _stamp(path: Path) -> Stamp:
    """Return what tells a file from another one under its name, None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def _done_before(batch: Batch[Made], worked: Worked[Made]) -> str:
    """Return what has been made of a batch that ends early, in words."""
    if not worked.outcomes:
        return ""
    names = [batch.names[number] for number in worked.outcomes]
    told = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
    return f"; {len(names)} of {len(batch.targets)} {batch.unit}s were written before: {told}"
