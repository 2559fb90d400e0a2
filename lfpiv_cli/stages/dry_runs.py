"""What a batch would make, before anything is made: which outputs, how large, in which time, with how much memory.

Sizes are those of the batch's outputs that are there already, times and memory those that the log of an earlier run
has; where there are none, they are at most what the arrays take, or unknown.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Protocol

from lfpiv_cli.console import Console
from lfpiv_cli.files.batch import pending
from lfpiv_cli.files.places import ensure_apart
from lfpiv_cli.stages.batches import Batch, BatchOptions, Made

MB = 1e6
# What a file has besides its arrays: its record and those of its inputs, attributes, and space that HDF5 leaves free.
RECORD_BYTES = 100e3
# What the program takes with its libraries and compiled code.
PROGRAM_BYTES = 300e6


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


class PlannedBatch(Batch[Made], Protocol[Made]):
    """A batch that can say beforehand what it takes."""

    def fault(self, number: int) -> str | None:
        """Return why an output cannot be made, as far as is known before its inputs are read."""

    def expected(self) -> Expected:
        """Return what an output takes."""


def dry_run(batch: PlannedBatch[Made], options: BatchOptions, console: Console) -> dict[str, Any]:
    """Return what a batch would make, and what that takes; write nothing.

    Raises
    ------
    LfpivError : the batch would not begin
    """
    ensure_apart([*batch.outputs, *filter(None, (options.failures, console.log_file))], batch.inputs)
    share = options.shard.numbers(len(batch.targets))
    targets = batch.targets[share.start : share.stop]
    needed = [share[k] for k in pending(targets, (), batch.overwrite, options.resume, dry=True)]
    faults = {number: fault for number in needed if (fault := batch.fault(number)) is not None}
    making, skipped = [number for number in needed if number not in faults], sorted(set(share) - set(needed))
    for number in making:
        console.detail(f"would make {batch.targets[number].path}")
    for number, fault in faults.items():
        console.say(f"would leave out {batch.names[number]}: {fault}")
    told: dict[str, Any] = {
        f"{batch.unit}s": len(share),
        "to_make": len(making),
        "skipped": len(skipped),
        "unreadable": len(faults) + len(batch.left_out),
    }
    expected = batch.expected() if making else Expected()
    told |= _disk(batch, len(making), skipped, expected) | _time(batch, len(making), expected, console)
    if console.only_warnings:
        told["would_make"] = [str(batch.targets[number].path) for number in making]
    return told


def _disk(
    batch: PlannedBatch[Made], count: int, complete: Sequence[int], expected: Expected
) -> dict[str, float | str | None]:
    """Return how much disk so many outputs take, by what that is known, and how much is free."""
    folder = next(path for path in batch.targets[0].path.absolute().parents if path.exists())
    known = [sum(path.stat().st_size for path in batch.targets[number].paths) for number in complete]
    each, known_by = median(known) if known else None, "those that are there"
    if each is None and expected.file_bytes is not None:
        each, known_by = expected.file_bytes + RECORD_BYTES, "at most, uncompressed"
    return {
        "disk_mb": None if each is None else count * each / MB,
        "disk_by": None if each is None else known_by,
        "disk_free_mb": shutil.disk_usage(folder).free / MB,
    }


def _time(batch: PlannedBatch[Made], count: int, expected: Expected, console: Console) -> dict[str, float | str | None]:
    """Return how long so many outputs take and how much memory: by the log, memory without one by the arrays held."""
    last = None if console.log is None else console.log.last("frame", step=batch.label)
    logged, held = last or {}, expected.memory_bytes
    seconds, memory = logged.get("seconds_each"), logged.get("memory_mb")
    by_log = f"the last run in {console.log_file}"
    return {
        "seconds": None if seconds is None else count * seconds,
        "seconds_by": None if seconds is None else by_log,
        "memory_mb": memory if memory is not None or held is None else (PROGRAM_BYTES + held) / MB,
        "memory_by": by_log if memory is not None else None if held is None else "the program and its arrays",
    }
