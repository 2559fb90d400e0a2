"""The loop of all batches: which outputs are made, in which order, and what becomes of those that fail.

A batch knows its outputs and how each is made. The loop owns what is the same for all: what is complete is skipped,
what another worker makes is left to it, one bad input stops the batch or is listed, and how far it is is told.

A dry run says what a batch would make. Sizes are those of its outputs that are there already, times and memory those
that the log of an earlier run has; where there are none, they are at most what the arrays take, or unknown.
"""

from __future__ import annotations

import json
import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Generic, Self, TypeVar

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.errors import InputError, PartialError, UsageError
from lfpiv_cli.files.atomic import SECONDS_BETWEEN_LOOKS, Turn, claimed, ensure_apart, ensure_writable, write_text
from lfpiv_cli.files.batch import Stamp, State, Target, pending, stamp_of, state_of
from lfpiv_cli.files.inputs import PROGRAM_BYTES, Deadline, Shard
from lfpiv_cli.notice import Notice

Made = TypeVar("Made", covariant=True)
MB = 1e6
# What a file has besides its arrays: its record and those of its inputs, attributes, and space that HDF5 leaves free.
RECORD_BYTES = 100e3

ALL = Shard(1, 1)


# The numbers of outputs with what became of each, as it is known.
Attempts = Generator[tuple[int, Made | Turn | InputError], None, None]


@dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """What all that goes through many frames is given.

    Attributes
    ----------
    resume : skip what is complete and made from the same inputs with the same settings
    keep_going : go on with the next one when an input cannot be read
    failures : file to list those that failed in, as JSON
    dry_run : tell what would be made and what that takes, and write nothing
    shard : make this share of the outputs only
    time_limit_s : stop before so many seconds have gone by, with what is left for another time
    begun_s : when the time began, by the clock that never goes back
    """

    resume: bool = False
    keep_going: bool = False
    failures: Path | None = None
    dry_run: bool = False
    shard: Shard = ALL
    time_limit_s: float | None = None
    begun_s: float = field(default_factory=time.monotonic, compare=False, repr=False)

    def deadline(self) -> Deadline:
        """Return when the work has to be done."""
        return Deadline(self.time_limit_s, begun=self.begun_s)


@dataclass(frozen=True, kw_only=True)
class BatchOptions(WorkOptions):
    """What every batch is given.

    Attributes
    ----------
    dask : address of the scheduler whose workers make the outputs, or `local` for workers on this machine
    watch : the inputs are folders that are still being filled
    idle_s : such folders end when nothing in them has changed for so long
    """

    dask: str | None = None
    watch: bool = False
    idle_s: float = 60.0


@dataclass(frozen=True)
class Failure:
    """An output that could not be made: its name, and the sentence that says why."""

    name: str
    error: str


@dataclass(frozen=True)
class Expected:
    """What an output takes, None where that is not known before.

    Attributes
    ----------
    file_bytes : its arrays without compression: its files take at most that
    memory_bytes : arrays that are held while it is made
    """

    file_bytes: float | None = None
    memory_bytes: float | None = None


class Batch(ABC, Generic[Made]):
    """Outputs that are made one after the other, each from inputs of its own.

    Another process makes it again from its arguments: these are sent, and not what it holds.

    Attributes
    ----------
    label, unit : what the work and its outputs are called where it is told how far it is
    targets : where each output goes
    beside : other files that are written
    inputs : all files that are read, none of which may be written
    overwrite : whether outputs that were made from other inputs or settings may be replaced
    notices : what is to be said before anything is made
    left_out : what is known to have no output before anything is made, as a frame without its partner
    """

    label: str
    unit: str
    targets: Sequence[Target]
    inputs: Sequence[Path]
    overwrite: bool
    beside: Sequence[Path] = ()
    notices: Sequence[Notice] = ()
    left_out: Sequence[Failure] = ()
    _made_by: Callable[[], Self]

    def __new__(cls, *arguments: Any, **named: Any) -> Self:
        """Keep the arguments."""
        batch = super().__new__(cls)
        batch._made_by = partial(cls, *arguments, **named)
        return batch

    def __reduce__(self) -> tuple[Callable[[], Self], tuple[()]]:
        """Return what makes it again."""
        return self._made_by, ()

    @property
    def outputs(self) -> list[Path]:
        """All files that are written."""
        return [*(path for target in self.targets for path in target.paths), *self.beside]

    @property
    def names(self) -> Sequence[str]:
        """What each output is called."""
        return [target.path.stem for target in self.targets]

    @property
    def order(self) -> Sequence[int]:
        """The numbers of the outputs that are to be made, in the order of the work; shares are cut from it."""
        return range(len(self.targets))

    def fault(self, number: int) -> str | None:
        """Return why an output cannot be made, as far as is known before its inputs are read."""
        return None

    def expected(self) -> Expected:
        """Return what an output takes."""
        return Expected()

    def begin(self, numbers: Sequence[int], console: Console) -> float:
        """Prepare what the outputs of these numbers share, to be made in their order; return the steps of each."""
        return 1.0

    @abstractmethod
    def make(self, number: int, work: Frames) -> Made:
        """Make and write an output.

        Raises
        ------
        InputError : one of its inputs cannot be read, or does not belong with the others
        """

    def attempt(self, number: int, before: Stamp, work: Frames) -> Made | Turn:
        """Make an output, unless another worker does or did; `before` is what was in its place when the batch began.

        Raises
        ------
        InputError : as `make`
        """
        target = self.targets[number]
        with claimed(target.path) as granted:
            if not granted:
                return Turn.CLAIMED
            if stamp_of(target.path) != before and state_of(target) is State.COMPLETE:
                return Turn.SKIPPED
            return self.make(number, work)

    def end(self, worked: Worked[Made], console: Console) -> None:
        """Make what is made of all outputs together, once these are there."""

    def summary(self, worked: Worked[Made]) -> dict[str, Any]:
        """Return what is reported of what became of it."""
        return {}


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

    def total(self) -> int:
        """Return how many outputs it was about."""
        return len(self.outcomes) + self.skipped + len(self.failures)

    def add(self, other: Worked[Made]) -> None:
        """Add what became of another batch, after that of this one."""
        self.outcomes |= dict(enumerate(other.outcomes.values(), len(self.outcomes)))
        self.skipped += other.skipped
        self.failures += other.failures

    def list_failures(self, path: Path | None) -> None:
        """Write those that failed, with the reasons, as JSON, where it is asked for."""
        if path is not None:
            listed = json.dumps([asdict(failure) for failure in self.failures], indent=2, ensure_ascii=False)
            write_text(path, listed + "\n", overwrite=True)

    def ensure_whole(self, summary: dict[str, Any], unit: str) -> dict[str, Any]:
        """Return the summary of a batch of which nothing failed (PartialError: something did)."""
        if not self.failures:
            return summary
        reported = f"{len(self.failures)} of {self.total()} {unit}s failed, the first because {self.failures[0].error}"
        raise PartialError(reported, summary | {"failures": [asdict(failure) for failure in self.failures]})


def carried_out(batch: Batch[Made], options: BatchOptions, console: Console) -> dict[str, Any]:
    """Make what there is to make of a batch, or say what that would be; return what is reported of it.

    Raises
    ------
    LfpivError : as `work_through`
    PartialError : outputs could not be made, and the others were
    """
    share, before = _left_of(batch, options, console)
    if not options.dry_run:
        worked = _made(batch, share, before, options, console)
        batch.end(worked, console)
        return worked.ensure_whole(batch.summary(worked), batch.unit)
    faults = {number: fault for number in before if (fault := batch.fault(number)) is not None}
    making, skipped = [number for number in before if number not in faults], sorted(set(share) - set(before))
    for number in making:
        if console.verbose:
            console.answer(f"would make {batch.targets[number].path}")
    for number, fault in faults.items():
        console.answer(f"would leave out {batch.names[number]}: {fault}")
    known = [sum(path.stat().st_size for path in batch.targets[number].paths) for number in skipped]
    counts = {"to_make": len(making), "skipped": len(skipped), "unreadable": len(faults) + len(batch.left_out)}
    expected = batch.expected() if making else Expected()
    reported: dict[str, Any] = {f"{batch.unit}s": len(share)}
    reported |= estimate(batch.label, counts, known, expected, batch.targets[0].path, console)
    if console.only_warnings:
        reported["would_make"] = [str(batch.targets[number].path) for number in making]
    return reported


def work_through(batch: Batch[Made], options: BatchOptions, console: Console) -> Worked[Made]:
    """Make what there is to make of a batch.

    Raises
    ------
    OutputExistsError : an output is there, and is not to be skipped or replaced
    InputError : an input cannot be read, and the batch is not to go on without it
    StoppedEarlyError : the time is over
    """
    return _made(batch, *_left_of(batch, options, console), options, console)


def _made(
    batch: Batch[Made], share: Sequence[int], before: Mapping[int, Stamp], options: BatchOptions, console: Console
) -> Worked[Made]:
    """Make those outputs of a share that are left, and note what became of each."""
    left, worked = list(before), Worked[Made](skipped=len(share) - len(before))
    console.warn(batch.notices)
    deadline, steps = options.deadline(), 1.0
    made_by: Callable[..., Attempts[Made]] = _made_here
    if options.dask is None:
        steps = batch.begin(left, console)
    else:
        try:
            from lfpiv_cli.verbs.distributed import made_by_workers
        except ImportError as error:
            raise UsageError(f'--dask needs distributed: pip install "lfpiv[cluster]" ({error})') from error
        made_by = partial(made_by_workers, options.dask)
    # Closed at once where one fails: workers are let go.
    with (
        console.frames(len(left), steps, batch.label, batch.unit) as work,
        closing(made_by(batch, before, deadline, work)) as attempts,
    ):
        for number, made in attempts:
            name = batch.names[number]
            if isinstance(made, InputError):
                if not options.keep_going:
                    names = [batch.names[k] for k in worked.outcomes]
                    if not names:
                        raise InputError(str(made)) from made
                    reported = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
                    written = f"{len(names)} of {len(batch.targets)} {batch.unit}s were written before"
                    raise InputError(f"{made}; {written}: {reported}") from made
                worked.failures.append(Failure(name, str(made)))
                console.warn([Notice("frame-failed", name, str(made), "leave it out, or mend it")])
            elif isinstance(made, Turn):
                worked.skipped += 1
            else:
                worked.outcomes[number] = made
            work.done(name)
    worked.outcomes = dict(sorted(worked.outcomes.items()))
    done = worked.total()
    if options.shard.number == 1:
        # Of several shards the first one tells them.
        worked.failures[:0] = batch.left_out
    worked.list_failures(options.failures)
    if done < len(share):
        raise deadline.error(done, len(share), batch.unit)
    return worked


def _left_of(batch: Batch[Any], options: BatchOptions, console: Console) -> tuple[Sequence[int], dict[int, Stamp]]:
    """Return the numbers of this worker's outputs, none an input; and of those left, with what is in their places."""
    ensure_apart([*batch.outputs, *filter(None, (options.failures, console.log_file))], batch.inputs)
    if options.failures is not None and not options.dry_run:
        ensure_writable(options.failures, batch.overwrite or options.resume)
    share = options.shard.of(batch.order)
    targets = [batch.targets[number] for number in share]
    left = pending(targets, (), batch.overwrite, options.resume, dry=options.dry_run)
    return share, {share[k]: stamp_of(targets[k].path) for k in left}


def _made_here(batch: Batch[Made], before: Mapping[int, Stamp], deadline: Deadline, work: Frames) -> Attempts[Made]:
    """Make outputs one after the other; what another worker has claimed is asked for again, after all others."""
    left = list(before)
    while left:
        of_others = []
        for number in left:
            if not deadline.leaves_time():
                return
            begun = time.monotonic()
            made: Made | Turn | InputError
            try:
                made = batch.attempt(number, before[number], work)
            except InputError as error:
                made = error
            if made is Turn.CLAIMED:
                of_others.append(number)
            else:
                deadline.took(time.monotonic() - begun)
                yield number, made
        if len(of_others) == len(left):
            time.sleep(SECONDS_BETWEEN_LOOKS)
        left = of_others


def estimate(
    label: str, counts: dict[str, int], known: Sequence[int], expected: Expected, place: Path, console: Console
) -> dict[str, Any]:
    """Return the `counts` of outputs, and what those that are to be made take: disk, time and memory.

    The size of an output is the median of those that are known, time and memory are by the log of an earlier run.
    """
    count, each, known_by = counts["to_make"], median(known) if known else None, "those that are there"
    if each is None and expected.file_bytes is not None:
        each, known_by = expected.file_bytes + RECORD_BYTES, "at most, uncompressed"
    folder = next(path for path in (place.absolute(), *place.absolute().parents) if path.is_dir())
    last = None if console.log is None else console.log.last("frame", step=label)
    logged, held = last or {}, expected.memory_bytes
    seconds, memory = logged.get("seconds_each"), logged.get("memory_mb")
    by_log = f"the last run in {console.log_file}"
    return counts | {
        "disk_mb": None if each is None else count * each / MB,
        "disk_by": None if each is None else known_by,
        "disk_free_mb": shutil.disk_usage(folder).free / MB,
        "seconds": None if seconds is None else count * seconds,
        "seconds_by": None if seconds is None else by_log,
        "memory_mb": memory if memory is not None or held is None else (PROGRAM_BYTES + held) / MB,
        "memory_by": by_log if memory is not None else None if held is None else "the program and its arrays",
    }
