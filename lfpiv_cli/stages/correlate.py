"""The stage of `correlate`: displacements between pairs of volumes, of each or of all together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.errors import InputError, LfpivError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import Target, output_paths, prepare_folder
from lfpiv_cli.files.config import Config, carried_config, load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.memory import ensure_room
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import earlier_record, ensure_even, record, seconds_between, with_warnings
from lfpiv_cli.files.whole import ensure_opens, fault_of
from lfpiv_cli.flow.correlation import correlate as measure
from lfpiv_cli.flow.correlation import count_passes
from lfpiv_cli.flow.derived import derived_fields
from lfpiv_cli.flow.field import REJECTED, VectorField
from lfpiv_cli.flow.footprint import held_bytes
from lfpiv_cli.flow.locking import with_locking
from lfpiv_cli.grid import Grid
from lfpiv_cli.interface.vectors import ensure_alike, scale_of, usable_voxels
from lfpiv_cli.interface.vectors_checks import (
    Quality,
    calibration_notices,
    field_notices,
    pair_notices,
    quality_of,
    quality_of_all,
    window_notices,
)
from lfpiv_cli.notice import Notice
from lfpiv_cli.reference import Reference
from lfpiv_cli.stages.batches import ALL, BatchOptions, Worked, work_through
from lfpiv_cli.stages.dry_runs import Expected, dry_run
from lfpiv_cli.stages.intervals import dt_notices
from lfpiv_cli.stages.means import Mean, arrays_of
from lfpiv_cli.stages.pairs import PairBatch, PairBatchOptions, result_pairs
from lfpiv_cli.stages.watched import ComingPairs, watched, work_as_they_come

# Numbers of eight bytes that a file has of each vector at most, and derived ones besides.
NUMBERS_A_VECTOR, NUMBERS_DERIVED, NUMBER_BYTES = 16, 6, 8


@dataclass(frozen=True)
class Job:
    """One result: the pairs of volumes that it is made of, and the settings."""

    pairs: Sequence[tuple[Path, Path]]
    settings: Config

    def inputs(self) -> dict[str, Path]:
        """Return the volumes by their role."""
        if len(self.pairs) == 1:
            return given(volume_a=self.pairs[0][0], volume_b=self.pairs[0][1])
        return {
            f"volume_{name}_{number:04d}": path
            for number, pair in enumerate(self.pairs)
            for name, path in zip("ab", pair, strict=True)
        }


@dataclass(frozen=True, kw_only=True)
class CorrelateOptions(PairBatchOptions):
    """What `correlate` is given besides the volumes.

    Attributes
    ----------
    config : in place of the one that the volumes carry
    dt_s, windows, overlap : in place of the config's, see its section `correlation`
    mask_volume : volume on the same grid, 0 where the volumes are left out
    ensemble : one field of all pairs together
    derived : vorticity, divergence, strain rate and Q criterion, too
    mean : file of the pairs' mean and fluctuations, to write
    """

    config: Path | None = None
    dt_s: float | None = None
    windows: Sequence[int | Sequence[int]] | None = None
    overlap: float | Sequence[float] | None = None
    mask_volume: Path | None = None
    ensemble: bool = False
    derived: bool = False
    mean: Path | None = None


NO_OPTIONS = CorrelateOptions()


def correlate(
    volumes: Sequence[Path],
    output: Path,
    options: CorrelateOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
    pairs: Pairs | None = None,
) -> dict[str, Any]:
    """Measure the displacements between pairs of volumes; `pairs`, where they are known already."""
    if options.watch:
        batch, worked = _as_they_come(volumes, output, options, overwrite, console)
        return worked.ensure_whole(batch.summary(worked), batch.unit)
    batch = Correlation(volumes, output, options, overwrite, pairs)
    if options.dry_run:
        return dry_run(batch, options, console)
    worked = work_through(batch, options, console)
    fields = batch.fields(worked)
    if options.mean is not None and fields:
        mean = Mean(options.mean, fields, batch.settings.resolved(), options.derived, overwrite)
        # What another worker made of the same fields in the meantime is as good.
        work_through(mean, BatchOptions(resume=True), console)
    return worked.ensure_whole(batch.summary(worked), batch.unit)


def _as_they_come(
    folders: Sequence[Path], output: Path, options: CorrelateOptions, overwrite: bool, console: Console
) -> tuple[Correlation, Worked[Outcome]]:
    """Correlate the volumes of folders that are still being filled, each pair when both are there.

    Raises
    ------
    UsageError : something is made from all pairs
    """
    if options.ensemble or options.mean is not None:
        refused = "--ensemble" if options.ensemble else "--mean"
        raise UsageError(f"--watch: {refused} is made from all pairs, some of which have not come yet; wait for them")
    if not options.are_told:
        raise UsageError("--watch needs --pairing: ab or sequence")
    prepare_folder([output / folders[0].name])
    coming = ComingPairs(lambda files: result_pairs(files, options), console)

    def of_pairs(files: Sequence[Path]) -> Correlation:
        two_by_two = tuple((number, number + 1) for number in range(0, len(files), 2))
        return Correlation(files, output, options, overwrite, Pairs(two_by_two))

    groups = coming.groups(watched(folders, "results", options, console))
    return work_as_they_come(of_pairs, groups, options, console, lambda: coming.left_out)


@dataclass(frozen=True)
class Outcome:
    """What is told of a field: how good it is, how many vectors are rejected, and the divergence where it is asked."""

    quality: Quality
    rejected: int
    divergence_rms: float | None = None


class Correlation(PairBatch[CorrelateOptions]):
    """The batch of `correlate`: a field of vectors for each pair of volumes, or one of all pairs together."""

    label = "correlate"

    def _arrange(self, files: Sequence[Path], output: Path, pairs: Pairs | None) -> None:
        options = self._options
        self.unit = "field" if options.ensemble else "pair"
        self._pairs = self._paired(files, pairs)
        if options.mean is not None and (options.ensemble or len(self._pairs) < 2):
            raise UsageError("--mean needs several pairs, each correlated by itself")
        if options.mean is not None and options.shard != ALL:
            raise UsageError(
                "--mean needs the fields of all shards: once they are there, the same command without --shard and with "
                "--resume makes it"
            )
        self._groups = [self._pairs] if options.ensemble else [[pair] for pair in self._pairs]
        self._common = given(config=options.config, mask=options.mask_volume)
        self._config = load_config(options.config) if options.config else None
        self.inputs = [*files, *self._common.values()]
        paths = output_paths(output, [group[0][0].stem for group in self._groups])
        self.names = [path.stem for path in paths]
        self.targets = [Target(path, partial(self._record, number)) for number, path in enumerate(paths)]
        self.order = range(len(paths))
        self._first = files[0] if self._gone else _ensure_readable(files, options.keep_going)

    @property
    def outputs(self) -> list[Path]:
        """The fields, and their mean."""
        return [*(target.path for target in self.targets), *([self._options.mean] if self._options.mean else [])]

    def fault(self, number: int) -> str | None:
        """Return why a volume of a field cannot be opened."""
        return fault_of(path for pair in self._groups[number] for path in pair)

    def expected(self) -> Expected:
        """Return the bytes of a field's arrays, and what a correlation holds."""
        grid, settings = vtkhdf.read_grid(self._first), self.settings
        held = held_bytes(grid.shape_xyz, settings.correlation_settings(grid.spacing_mm))
        return Expected(field_bytes(settings, grid, self._options.derived), len(self._groups[0]) * held)

    def begin(self, numbers: Sequence[int], _console: Console) -> float:
        """Refuse a mean that could not be written, and fields too large for the memory."""
        if self._options.mean is not None:
            ensure_writable(self._options.mean, self.overwrite or self._options.resume)
        if numbers and not self._gone:
            ensure_room(self._held(), self.label)
        return 1.0

    def _held(self) -> float:
        """Return what a field takes in memory; 0 where its volume cannot be read, which is told in its turn."""
        try:
            return self.expected().memory_bytes or 0.0
        except LfpivError:
            return 0.0

    def make(self, number: int, work: Frames) -> Outcome:
        """Correlate a pair, or all of them, and write the vectors."""
        target = self.targets[number]
        job = self._job(number)
        field, reference, notices = _measure(job, self._options.mask_volume, work)
        quality, name = quality_of(field), target.path.name
        records = ([self._record_of(path) for path in pair] for pair in job.pairs)
        notices += dt_notices(job.settings.correlation.dt_s, records, name)
        notices += [*field_notices(quality, name), *pair_notices(field, quality, name)]
        work.console.warn(notices)
        derived = derived_fields(field) if self._options.derived else None
        vtkhdf.write_vectors(
            target.path,
            field,
            reference,
            provenance=with_warnings(target.record, notices),
            # What is complete is skipped: in the place of what is made there is nothing, or something broken.
            overwrite=self.overwrite or self._options.resume,
            extra=arrays_of(derived) if derived else None,
        )
        rejected = int(np.count_nonzero(field.flag >= REJECTED))
        return Outcome(quality, rejected, derived.divergence_rms if derived else None)

    def summary(self, worked: Worked[Outcome]) -> dict[str, Any]:
        """Return what is told of the batch."""
        return summary_of(worked, len(self._pairs) if self._options.ensemble else worked.total())

    def fields(self, worked: Worked[Outcome]) -> list[Path]:
        """Return the files of the fields that are there."""
        failed = {failure.name for failure in worked.failures}
        return [target.path for target, name in zip(self.targets, self.names, strict=True) if name not in failed]

    @property
    def settings(self) -> Config:
        """Those of the first volume that can be opened."""
        return self._settings_of(self._first)

    def _job(self, number: int) -> Job:
        """Return the pairs that a field is made of, and the settings."""
        group = self._groups[number]
        settings = self._settings_of(group[0][0])
        if settings.correlation.dt_s is None:
            settings = settings.overridden("correlation", dt_s=self._step_s(group))
        return Job(group, settings)

    def _step_s(self, group: Sequence[tuple[Path, Path]]) -> float | None:
        """Return the time within the pairs of a field, where the recordings of their frames tell it.

        Raises
        ------
        InputError : it is not the same in all of them
        """
        steps = [seconds_between(self._record_of(first), self._record_of(second)) for first, second in group]
        told = [step for step in steps if step is not None]
        return ensure_even(told, [str(group[0][0]), str(group[-1][1])]) if told and len(told) == len(steps) else None

    def _record_of(self, volume: Path) -> Mapping[str, Any]:
        """Return the record of a volume, which may be gone."""
        return self._gone[volume].record if volume in self._gone else earlier_record(volume) or {}

    def _settings_of(self, volume: Path) -> Config:
        """Return the settings for a volume: its own, or those of a config in their place."""
        settings = self._config or carried_config(self._record_of(volume), volume)
        return settings.overridden_by("correlation", self._options)

    def _record(self, number: int) -> dict[str, Any]:
        """Return the record that a field will carry."""
        options, job = self._options, self._job(number)
        command = " ".join(["correlate", *["ensemble"] * options.ensemble, *["derived"] * options.derived])
        return record(command, job.settings.resolved(), self._common | job.inputs(), gone=self._gone)


def field_bytes(settings: Config, grid: Grid, derived: bool = False) -> float:
    """Return the bytes of the arrays of a field of vectors, between volumes on a grid."""
    windows = math.prod(settings.correlation_settings(grid.spacing_mm).layout(grid.shape_xyz).count)
    return NUMBER_BYTES * (NUMBERS_A_VECTOR + derived * NUMBERS_DERIVED) * windows


def summary_of(worked: Worked[Outcome], pairs: int) -> dict[str, Any]:
    """Return what is told of the fields of so many pairs."""
    outcomes = list(worked.outcomes.values())
    found = quality_of_all([outcome.quality for outcome in outcomes])
    told: dict[str, Any] = {
        "pairs": pairs,
        "skipped": worked.skipped,
        "vectors": found.vectors,
        "rejected": sum(outcome.rejected for outcome in outcomes),
    }
    divergence = [outcome.divergence_rms for outcome in outcomes if outcome.divergence_rms is not None]
    return told | found.summary() | ({"divergence_rms_per_s": float(np.mean(divergence))} if divergence else {})


def _measure(job: Job, mask: Path | None, work: Frames) -> tuple[VectorField, Reference, list[Notice]]:
    """Return the vectors of a job, the origin of its volumes' coordinates, and what speaks against its windows."""
    first = vtkhdf.open_volume(job.pairs[0][0])
    drawn = None if mask is None else vtkhdf.open_volume(mask)
    if drawn is not None and drawn.grid != first.grid:
        raise InputError(f"{mask}: its grid {drawn.grid} differs from that of {job.pairs[0][0]}, {first.grid}")

    def volumes() -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        for pair in job.pairs:
            a, b = (first if path == job.pairs[0][0] else vtkhdf.open_volume(path) for path in pair)
            for path, volume in zip(pair, (a, b), strict=True):
                ensure_alike(first, volume, (str(job.pairs[0][0]), str(path)))
            yield a.array, b.array

    usable = usable_voxels(job.settings, first.grid, None if drawn is None else drawn.array)
    settings = job.settings.correlation_settings(first.grid.spacing_mm)
    records = {f"{role} {path.name}": earlier_record(path) or {} for role, path in job.inputs().items()}
    notices = [*calibration_notices(records), *window_notices(first, settings, job.pairs[0][0].name)]
    share = 1.0 / count_passes(settings.windows)
    field = measure(volumes(), first.grid, settings, mask=usable, progress=lambda passes: work.advance(share * passes))
    field = with_locking(field, first.reference, scale_of(job.settings))
    return field, first.reference, notices


def _ensure_readable(volumes: Sequence[Path], keep_going: bool) -> Path:
    """Return the first volume that can be opened, after it is known whether the others can, where one is to stop.

    Raises
    ------
    InputError : one cannot, or with `keep_going` none
    """
    readable, first_fault = [], None
    for path in volumes:
        try:
            ensure_opens(path)
        except InputError as error:
            if not keep_going:
                raise
            first_fault = first_fault or error
        else:
            readable.append(path)
    if not readable and first_fault is not None:
        raise first_fault
    return readable[0]
