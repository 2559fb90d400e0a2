"""What a batch would make, before anything is made: which outputs, how large, in which time, with how much memory.

Sizes are those of the batch's outputs that are there already, times and memory those that the log of an earlier run
has; where there are none, they are at most what the arrays take, or unknown.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Protocol

from lfpiv_cli.console import Console
from lfpiv_cli.files.batch import Target, pending
from lfpiv_cli.files.memory import PROGRAM_BYTES
from lfpiv_cli.files.places import ensure_apart
from lfpiv_cli.stages.batches import Failure, WorkOptions

MB = 1e6
AT_MOST = "at most, uncompressed"
# What a file has besides its arrays: its record and those of its inputs, attributes, and space that HDF5 leaves free.
RECORD_BYTES = 100e3


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


class PlannedBatch(Protocol):
    """A batch that can say beforehand what it takes; the rest is as of `Batch`."""

    @property
    def label(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def targets(self) -> Sequence[Target]: ...
    @property
    def outputs(self) -> Sequence[Path]: ...
    @property
    def names(self) -> Sequence[str]: ...
    @property
    def order(self) -> Sequence[int]: ...
    @property
    def inputs(self) -> Sequence[Path]: ...
    @property
    def left_out(self) -> Sequence[Failure]: ...
    @property
    def overwrite(self) -> bool: ...

    def fault(self, number: int) -> str | None:
        """Return why an output cannot be made, as far as is known before its inputs are read."""

    def expected(self) -> Expected:
        """Return what an output takes."""


def dry_run(batch: PlannedBatch, options: WorkOptions, console: Console) -> dict[str, Any]:
    """Return what a batch would make, and what that takes; write nothing.

    Raises
    ------
    LfpivError : the batch would not begin
    """
    ensure_apart([*batch.outputs, *filter(None, (options.failures, console.log_file))], batch.inputs)
    share = options.shard.of(batch.order)
    targets = [batch.targets[number] for number in share]
    needed = [share[k] for k in pending(targets, (), batch.overwrite, options.resume, dry=True)]
    faults = {number: fault for number in needed if (fault := batch.fault(number)) is not None}
    making, skipped = [number for number in needed if number not in faults], sorted(set(share) - set(needed))
    for number in making:
        if console.verbose:
            console.answer(f"would make {batch.targets[number].path}")
    for number, fault in faults.items():
        console.answer(f"would leave out {batch.names[number]}: {fault}")
    told: dict[str, Any] = {
        f"{batch.unit}s": len(share),
        "to_make": len(making),
        "skipped": len(skipped),
        "unreadable": len(faults) + len(batch.left_out),
    }
    expected = batch.expected() if making else Expected()
    told |= _disk(batch, len(making), skipped, expected)
    told |= time_and_memory(batch.label, len(making), expected, console)
    if console.only_warnings:
        told["would_make"] = [str(batch.targets[number].path) for number in making]
    return told


def _disk(
    batch: PlannedBatch, count: int, complete: Sequence[int], expected: Expected
) -> dict[str, float | str | None]:
    """Return how much disk so many outputs take, by what that is known, and how much is free."""
    folder = next(path for path in batch.targets[0].path.absolute().parents if path.exists())
    known = [sum(path.stat().st_size for path in batch.targets[number].paths) for number in complete]
    each, known_by = median(known) if known else None, "those that are there"
    if each is None and expected.file_bytes is not None:
        each, known_by = expected.file_bytes + RECORD_BYTES, AT_MOST
    return {
        "disk_mb": None if each is None else count * each / MB,
        "disk_by": None if each is None else known_by,
        "disk_free_mb": shutil.disk_usage(folder).free / MB,
    }


def time_and_memory(label: str, count: int, expected: Expected, console: Console) -> dict[str, float | str | None]:
    """Return how long so many outputs take and how much memory: by the log, memory without one by the arrays held."""
    last = None if console.log is None else console.log.last("frame", step=label)
    logged, held = last or {}, expected.memory_bytes
    seconds, memory = logged.get("seconds_each"), logged.get("memory_mb")
    by_log = f"the last run in {console.log_file}"
    return {
        "seconds": None if seconds is None else count * seconds,
        "seconds_by": None if seconds is None else by_log,
        "memory_mb": memory if memory is not None or held is None else (PROGRAM_BYTES + held) / MB,
        "memory_by": by_log if memory is not None else None if held is None else "the program and its arrays",
    }
