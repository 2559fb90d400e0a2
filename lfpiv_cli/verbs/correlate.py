"""`correlate`: displacements between pairs of volumes, of each or of all together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import fields as fields_of
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Flags, Singles
from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.errors import InputError, LfpivError, UsageError
from lfpiv_cli.files import atomic, hdf5, provenance, vtkhdf
from lfpiv_cli.files.batch import Target, output_paths, results_seen
from lfpiv_cli.files.config import Config, carried_config, load_rig
from lfpiv_cli.files.inputs import ensure_room, given
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.sections_work import CorrelationKeys
from lfpiv_cli.files.vtkhdf import Volume
from lfpiv_cli.flow import correlation
from lfpiv_cli.flow.correlation import correlate as measure
from lfpiv_cli.flow.correlation import count_passes, held_bytes
from lfpiv_cli.flow.field import REJECTED, VectorField, derived_fields
from lfpiv_cli.flow.peaks import with_locking
from lfpiv_cli.flow.windows import inside
from lfpiv_cli.grid import FOCAL_POINT, Grid
from lfpiv_cli.notice import warn_of
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs.batches import ALL, BatchOptions, Expected, Failure, Worked, carried_out, work_through
from lfpiv_cli.verbs.fields import arrays_of
from lfpiv_cli.verbs.frames import dt_notices
from lfpiv_cli.verbs.pairs import PairBatch, PairOptions, coming_pairs, watched, work_as_they_come
from lfpiv_cli.verbs.statistics import Mean, are_measured


def correlate(
    a: Volume | NDArray[Any],
    b: Volume | NDArray[Any],
    *,
    mask: NDArray[Any] | None = None,
    voxel_mm: tuple[float, float, float] | None = None,
    **settings: Any,
) -> VectorField:
    """Measure the displacements between two volumes by three-dimensional cross-correlation.

    Parameters
    ----------
    a, b : Volume or (nz, ny, nx) array
        First and second volume, from `reconstruct` or `open_volume`; or light on a regular grid of your own.
    mask : (nz, ny, nx), optional
        0 where the volumes are left out.
    voxel_mm : (x, y, z) mm, optional
        Size of a voxel where `a` and `b` are plain arrays; their middle is then the origin.
    **settings
        Keys of the rig's section `correlation`, in their place: windows=((32, 32, 32), (16, 16, 16)),
        overlap=(0.5, 0.5, 0.5), dt_s=0.001, exponent and so on.

    Returns
    -------
    VectorField
        `velocity` (nz, ny, nx, 3) m/s as (u, v, w), NaN where there is no vector or no `dt_s`; `displacement_voxel`,
        `uncertainty_voxel` and `flag` likewise; `grid` has the centres of the interrogation windows, mm.

    Raises
    ------
    InputError
        The volumes or the mask do not belong together.
    ConfigError
        The settings are not possible.
    UsageError
        Plain arrays are given without `voxel_mm`.
    """
    volumes = []
    for each in (a, b):
        if isinstance(each, Volume):
            volumes.append(each)
            continue
        # A plain array lies about the origin.
        if voxel_mm is None:
            raise UsageError("correlate: plain arrays need voxel_mm, the size of a voxel along x, y, z")
        array = np.asarray(each, dtype=np.float32)
        if array.ndim != 3:
            raise InputError(f"a volume of shape {array.shape}, expected (nz, ny, nx)")
        grid = Grid.centred((array.shape[2], array.shape[1], array.shape[0]), voxel_mm, (0.0, 0.0, 0.0))
        volumes.append(Volume(array, grid, FOCAL_POINT, {}, {}))
    first, second = volumes
    ensure_alike(first, second, ("the first volume", "the second volume"))
    config = first.provenance.get("config")
    carried = carried_config(first.provenance, "the volume") if config else Config.from_resolved({})
    chosen = carried.overridden("correlation", **settings)
    windows = chosen.correlation_settings(first.grid.spacing_mm)
    usable = usable_voxels(chosen, first.grid, mask)
    field = correlation.correlate([(first.array, second.array)], first.grid, windows, mask=usable)
    if config:
        # Of light that no camera recorded nothing is known.
        field = with_locking(field, first.reference, chosen.camera_model().scale(chosen.media_model()))
    quality, name = checks.quality_of(field), "the field"
    against_field = [*checks.field_notices(quality, name), *checks.pair_notices(field, quality, name)]
    warn_of([*checks.window_notices(first, windows, "the first volume"), *against_field])
    made = provenance.record("correlate", chosen.resolved() if config else None, {})
    return replace(field, reference=first.reference, provenance=made)


def usable_voxels(settings: Config, grid: Grid, mask: NDArray[Any] | None) -> Flags | None:
    """Return where volumes may be used (nz, ny, nx): between walls and where a mask is above 0; None: everywhere."""
    walls = settings.masking_walls()
    usable = None if walls is None else inside(grid, walls)
    if mask is not None:
        drawn = np.asarray(mask) > 0.0
        usable = drawn if usable is None else usable & drawn
    return usable


def ensure_alike(first: Volume, second: Volume, names: tuple[str, str]) -> None:
    """Refuse two volumes that were not made alike (InputError)."""
    if first.grid != second.grid:
        raise InputError(f"{names[1]}: its grid {second.grid} differs from that of {names[0]}, {first.grid}")
    if first.reference.name != second.reference.name:
        raise InputError(f"{names[1]}: its coordinates have another origin than those of {names[0]}")
    provenance.ensure_agreement([first.provenance, second.provenance], names, provenance.OF_FRAMES)


# Numbers of eight bytes that a file has of each vector at most, and derived ones besides.
NUMBERS_A_VECTOR, NUMBERS_DERIVED, NUMBER_BYTES = 16, 6, 8


@dataclass(frozen=True, kw_only=True)
class CorrelateOptions(CorrelationKeys, PairOptions):
    """What `correlate` is given besides the volumes, and keys in place of those of the config's section `correlation`.

    Attributes
    ----------
    config : in place of the one that the volumes carry
    mask_volume : volume on the same grid, 0 where the volumes are left out
    ensemble : one field of all pairs together
    derived : vorticity, divergence, strain rate and Q criterion, too
    mean : file of the pairs' mean and fluctuations, to write; of vectors or tracks, in place of volumes, it is all
    """

    config: Path | None = None
    mask_volume: Path | None = None
    ensemble: bool = False
    derived: bool = False
    mean: Path | None = None


# What the mean of vectors that are there may be asked with; which belong together is then known.
FOR_MEANS = {"mean", "derived", "resume", "pairing", "pair_by", "pairs"}


def correlate_files(
    volumes: Sequence[Path],
    output: Path | None,
    options: CorrelateOptions = CorrelateOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Measure the displacements between pairs of volumes.

    Of vectors and tracks that are there, in place of volumes, only the `mean` is made.

    Raises
    ------
    UsageError : options are of no use for what is given, or something is made from all pairs that are still to come
    """
    if options.mean is not None and not options.watch and are_measured(volumes):
        for each in fields_of(options):
            if each.compare and each.name not in FOR_MEANS and getattr(options, each.name) != each.default:
                name = each.name.removesuffix("_volume").replace("_", "-")
                raise UsageError(
                    f"--{name}: is for volumes; the mean of {volumes[0]} and those beside it has no use for it"
                )
        if output is not None:
            console.say(f"{output}: is not written: the vectors are there, and --mean alone is made of them")
        mean = Mean(options.mean, volumes, None, options.derived, overwrite)
        return carried_out(mean, options, console)
    if output is None:
        raise UsageError("-o: is missing, the file or folder of the vectors; only the --mean of vectors needs none")
    if not options.watch:
        return carried_out(Correlation(volumes, output, options, overwrite), options, console)
    # Each pair when both are there.
    if options.ensemble or options.mean is not None:
        refused = "--ensemble" if options.ensemble else "--mean"
        raise UsageError(f"--watch: {refused} is made from all pairs, some of which have not come yet; wait for them")
    if not options.are_told:
        raise UsageError("--watch needs --pairing: ab or sequence")
    left_out: list[Failure] = []

    def of_pairs(files: Sequence[Path]) -> Correlation:
        two_by_two = tuple((number, number + 1) for number in range(0, len(files), 2))
        return Correlation(files, output, options, overwrite, Pairs(two_by_two))

    come = watched(volumes, "results", options, options.idle_s, console)
    with atomic.folder_of(output / volumes[0].name):
        pairs = coming_pairs(come, results_seen, options, console, left_out)
        groups = ([path for pair in group for path in pair] for group in pairs)
        return work_as_they_come(of_pairs, groups, options, console, left_out)


@dataclass(frozen=True)
class Outcome:
    """What is told of a field: how good it is, how many vectors are rejected, and the divergence where it is asked."""

    quality: checks.Quality
    rejected: int
    divergence_rms: float | None = None


class Correlation(PairBatch[Outcome, CorrelateOptions]):
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
        self._config = load_rig(options.config) if options.config else None
        self.inputs = [*files, *self._common.values()]
        paths = output_paths(output, [group[0][0].stem for group in self._groups])
        self.targets = [Target(path, partial(self._record, number)) for number, path in enumerate(paths)]
        self.beside = [options.mean] if options.mean else []
        # The first volume that can be opened, after it is known whether the others can, where one is to stop.
        readable: list[Path] = []
        fault: InputError | None = None
        for path in () if self._gone else files:
            try:
                hdf5.ensure_opens(path)
            except InputError as error:
                if not options.keep_going:
                    raise
                fault = fault or error
            else:
                readable.append(path)
        if fault is not None and not readable:
            raise fault
        self._first = (readable or files)[0]

    def fault(self, number: int) -> str | None:
        """Return why a volume of a field cannot be opened."""
        return hdf5.fault_of(path for pair in self._groups[number] for path in pair)

    def expected(self) -> Expected:
        """Return the bytes of a field's arrays, and what a correlation holds."""
        with hdf5.open_h5(self._first) as file:
            grid, settings = vtkhdf.grid_in(file), self.settings
        held = held_bytes(grid.shape_xyz, settings.correlation_settings(grid.spacing_mm))
        return Expected(field_bytes(settings, grid, self._options.derived), len(self._groups[0]) * held)

    def begin(self, numbers: Sequence[int], _console: Console) -> float:
        """Refuse a mean that could not be written, and fields too large for the memory."""
        if self._options.mean is not None:
            atomic.ensure_writable(self._options.mean, self.overwrite or self._options.resume)
        if numbers and not self._gone:
            try:
                held = self.expected().memory_bytes or 0.0
            except LfpivError:
                held = 0.0  # its volume cannot be read, which is told in its turn
            ensure_room(held, self.label)
        return 1.0

    def make(self, number: int, work: Frames) -> Outcome:
        """Correlate a pair, or all of them, and write the vectors."""
        target = self.targets[number]
        config, pairs, mask = self._settings_for(number), self._groups[number], self._options.mask_volume
        one = pairs[0][0]
        first, drawn = vtkhdf.open_volume(one), None if mask is None else vtkhdf.open_volume(mask)
        if drawn is not None and drawn.grid != first.grid:
            raise InputError(f"{mask}: its grid {drawn.grid} differs from that of {one}, {first.grid}")

        def volumes() -> Iterator[tuple[Singles, Singles]]:
            for pair in pairs:
                a, b = (first if path == one else vtkhdf.open_volume(path) for path in pair)
                for path, volume in zip(pair, (a, b), strict=True):
                    ensure_alike(first, volume, (str(one), str(path)))
                yield a.array, b.array

        usable = usable_voxels(config, first.grid, None if drawn is None else drawn.array)
        settings = config.correlation_settings(first.grid.spacing_mm)
        of_volumes = {
            f"{role} {path.name}": provenance.earlier_record(path) or {} for role, path in self._volumes(number).items()
        }
        notices = [*checks.calibration_notices(of_volumes), *checks.window_notices(first, settings, one.name)]
        share = 1.0 / count_passes(settings.windows)
        field = measure(
            volumes(), first.grid, settings, mask=usable, progress=lambda passes: work.advance(share * passes)
        )
        camera, media = config.camera_model(), config.media_model()
        field = with_locking(field, first.reference, camera.scale(media))
        quality, name = checks.quality_of(field), target.path.name
        notices += dt_notices(config.correlation.dt_s, self._steps_s(number), name)
        notices += [*checks.field_notices(quality, name), *checks.pair_notices(field, quality, name)]
        work.console.warn(notices)
        derived = derived_fields(field) if self._options.derived else None
        made = provenance.with_warnings(target.record, notices)
        extra = arrays_of(derived) if derived else None
        # What is complete is skipped: in the place of what is made there is nothing, or something broken.
        replacing = self.overwrite or self._options.resume
        vtkhdf.write_vectors(target.path, field, first.reference, provenance=made, overwrite=replacing, extra=extra)
        rejected = int(np.count_nonzero(field.flag >= REJECTED))
        return Outcome(quality, rejected, derived.divergence_rms if derived else None)

    def summary(self, worked: Worked[Outcome]) -> dict[str, Any]:
        """Return what is told of the batch."""
        return summary_of(worked, len(self._pairs) if self._options.ensemble else worked.total())

    def end(self, worked: Worked[Outcome], console: Console) -> None:
        """Write the mean of the fields that are there, where it is asked for."""
        failed = {failure.name for failure in worked.failures}
        fields = [target.path for target, name in zip(self.targets, self.names, strict=True) if name not in failed]
        if self._options.mean is not None and fields:
            mean = Mean(self._options.mean, fields, self.settings.resolved(), self._options.derived, self.overwrite)
            # What another worker made of the same fields in the meantime is as good.
            work_through(mean, BatchOptions(resume=True), console)

    @property
    def settings(self) -> Config:
        """Those of the first volume that can be opened."""
        return self._settings_of(self._first)

    def _volumes(self, number: int) -> dict[str, Path]:
        """Return the volumes that a field is made of by their role."""
        pairs = self._groups[number]
        if len(pairs) == 1:
            return given(volume_a=pairs[0][0], volume_b=pairs[0][1])
        return {
            f"volume_{name}_{place:04d}": path
            for place, pair in enumerate(pairs)
            for name, path in zip("ab", pair, strict=True)
        }

    def _settings_for(self, number: int) -> Config:
        """Return the settings that a field is made with."""
        group = self._groups[number]
        settings = self._settings_of(group[0][0])
        if settings.correlation.dt_s is None:
            # Where the recordings of the frames of all pairs tell it: the same in all of them.
            step_s = provenance.even_step_s(self._steps_s(number), [str(group[0][0]), str(group[-1][1])])
            settings = settings.overridden("correlation", dt_s=step_s)
        return settings

    def _steps_s(self, number: int) -> list[float | None]:
        """Return the recorded times between the frames of a field's pairs."""
        return [provenance.seconds_between(*map(self._record_of, pair)) for pair in self._groups[number]]

    def _record_of(self, volume: Path) -> Mapping[str, Any]:
        """Return the record of a volume, which may be gone."""
        return self._gone[volume].record if volume in self._gone else provenance.earlier_record(volume) or {}

    def _settings_of(self, volume: Path) -> Config:
        """Return the settings for a volume: its own, or those of a config in their place."""
        settings = self._config or carried_config(self._record_of(volume), volume)
        return settings.overridden_by("correlation", self._options)

    def _record(self, number: int) -> dict[str, Any]:
        """Return the record that a field will carry."""
        options = self._options
        command = " ".join(["correlate", *["ensemble"] * options.ensemble, *["derived"] * options.derived])
        inputs = self._common | self._volumes(number)
        return provenance.record(command, self._settings_for(number).resolved(), inputs, gone=self._gone)


def field_bytes(settings: Config, grid: Grid, derived: bool = False) -> float:
    """Return the bytes of the arrays of a field of vectors, between volumes on a grid."""
    windows = math.prod(settings.correlation_settings(grid.spacing_mm).layout(grid.shape_xyz).count)
    return NUMBER_BYTES * (NUMBERS_A_VECTOR + derived * NUMBERS_DERIVED) * windows


def summary_of(worked: Worked[Outcome], pairs: int) -> dict[str, Any]:
    """Return what is told of the fields of so many pairs."""
    outcomes = list(worked.outcomes.values())
    found = checks.quality_of_all([outcome.quality for outcome in outcomes])
    reported: dict[str, Any] = {
        "pairs": pairs,
        "skipped": worked.skipped,
        "vectors": found.vectors,
        "rejected": sum(outcome.rejected for outcome in outcomes),
    }
    divergence = [outcome.divergence_rms for outcome in outcomes if outcome.divergence_rms is not None]
    return reported | found.summary() | ({"divergence_rms_per_s": float(np.mean(divergence))} if divergence else {})
