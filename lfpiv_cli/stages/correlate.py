"""The stage of `correlate`: displacements between pairs of volumes, of each or of all together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import Target, output_paths, pending, prepare_folder
from lfpiv_cli.files.config import Config, carried_config, load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record, with_warnings
from lfpiv_cli.flow.correlation import correlate as measure
from lfpiv_cli.flow.correlation import count_passes
from lfpiv_cli.flow.derived import Derived, derived_fields
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, VectorField
from lfpiv_cli.flow.locking import with_locking
from lfpiv_cli.flow.statistics import statistics_of
from lfpiv_cli.interface.vectors import ensure_alike, scale_of, usable_voxels
from lfpiv_cli.interface.vectors_checks import (
    calibration_notices,
    field_notices,
    pair_notices,
    quality_of,
    quality_of_all,
    window_notices,
)
from lfpiv_cli.names import Pairing
from lfpiv_cli.notice import Notice
from lfpiv_cli.reference import Reference

Extra = dict[str, tuple[NDArray[Any], str]]


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
class CorrelateOptions:
    """What `correlate` is given besides the volumes.

    Attributes
    ----------
    config : in place of the one that the volumes carry
    dt_s, windows, overlap : in place of the config's, see its section `correlation`
    pairing : `ab` for separate pairs, `sequence` for each volume with the next; needed for more than two
    mask_volume : volume on the same grid, 0 where the volumes are left out
    ensemble : one field of all pairs together
    derived : vorticity, divergence, strain rate and Q criterion, too
    mean : file of the pairs' mean and fluctuations, to write
    resume : skip what is complete and made from the same inputs
    """

    config: Path | None = None
    dt_s: float | None = None
    windows: Sequence[int | Sequence[int]] | None = None
    overlap: float | Sequence[float] | None = None
    pairing: Pairing | None = None
    mask_volume: Path | None = None
    ensemble: bool = False
    derived: bool = False
    mean: Path | None = None
    resume: bool = False


NO_OPTIONS = CorrelateOptions()


def correlate(
    volumes: Sequence[Path],
    output: Path,
    options: CorrelateOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Measure the displacements between pairs of volumes."""
    mean, derived = options.mean, options.derived
    pairs = _pairs(volumes, options.pairing)
    if mean is not None and (options.ensemble or len(pairs) < 2):
        raise UsageError("--mean needs several pairs, each correlated by itself")
    together = [pairs] if options.ensemble else [[pair] for pair in pairs]
    paths = output_paths(output, [group[0][0].stem for group in together])
    prepare_folder(paths)
    told = load_config(options.config) if options.config else None
    jobs = []
    for group in together:
        first = group[0][0]
        settings = told or carried_config(vtkhdf.read_header(first).provenance, first)
        jobs.append(Job(group, settings.overridden_by("correlation", options)))
    common = given(config=options.config, mask=options.mask_volume)
    command = " ".join(["correlate", *["ensemble"] * options.ensemble, *["derived"] * derived])
    targets = [
        Target(path, record(command, job.settings.resolved(), common | job.inputs()))
        for path, job in zip(paths, jobs, strict=True)
    ]
    if mean is not None:
        ensure_writable(mean, overwrite, [*volumes, *common.values()])
    divergence, qualities, rejected = [], [], 0
    needed = pending(targets, [*volumes, *common.values()], overwrite, options.resume, vtkhdf.read_record)
    with console.frames(len(needed), 1.0, "correlate", "pair" if not options.ensemble else "field") as work:
        for number in needed:
            field, reference, notices = _measure(jobs[number], options.mask_volume, work)
            quality = quality_of(field)
            name = targets[number].path.name
            notices += [*field_notices(quality, name), *pair_notices(field, quality, name)]
            console.warn(notices)
            told_more = derived_fields(field) if derived else None
            vtkhdf.write_vectors(
                targets[number].path,
                field,
                reference,
                provenance=with_warnings(targets[number].record, notices),
                overwrite=overwrite,
                extra=_arrays_of(told_more) if told_more else None,
            )
            qualities.append(quality)
            rejected += int(np.count_nonzero(field.flag >= REJECTED))
            if told_more and told_more.divergence_rms is not None:
                divergence.append(told_more.divergence_rms)
            work.done(targets[number].path.stem)

    found = quality_of_all(qualities)
    summary: dict[str, Any] = {"pairs": len(pairs), "vectors": found.vectors, "rejected": rejected}
    summary |= found.summary()
    if divergence:
        summary["divergence_rms_per_s"] = float(np.mean(divergence))
    if mean is not None:
        _write_mean(mean, paths, jobs[0].settings, derived, overwrite)
    return summary


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
    records = {f"{role} {path.name}": vtkhdf.read_header(path).provenance for role, path in job.inputs().items()}
    notices = [*calibration_notices(records), *window_notices(first, settings, job.pairs[0][0].name)]
    share = 1.0 / count_passes(settings.windows)
    field = measure(volumes(), first.grid, settings, mask=usable, progress=lambda passes: work.advance(share * passes))
    field = with_locking(field, first.reference, scale_of(job.settings))
    return field, first.reference, notices


def _arrays_of(derived: Derived) -> Extra:
    """Return derived fields with the names and units that files give them."""
    return {
        "vorticity": (derived.vorticity, "1/s"),
        "divergence": (derived.divergence, "1/s"),
        "strain_rate": (derived.strain_rate, "1/s"),
        "q_criterion": (derived.q_criterion, "1/s2"),
    }


def _write_mean(path: Path, members: Sequence[Path], settings: Config, derived: bool, overwrite: bool) -> None:
    """Write the mean of a batch's vectors, and their fluctuations as `velocity_rms` and `displacement_rms_voxel`."""
    found = statistics_of(vtkhdf.open_vectors(member) for member in members)
    extra: Extra = {
        "displacement_rms_voxel": (found.rms_voxel, "voxel"),
        "samples": (found.samples, "1"),
    }
    if found.mean.dt_s is not None:
        to_velocity = np.asarray(found.mean.voxel_mm) * MM_TO_M / found.mean.dt_s
        extra["velocity_rms"] = (found.rms_voxel * to_velocity, "m/s")
    if derived:
        extra |= _arrays_of(derived_fields(found.mean))
    inputs = {f"vectors_{number:04d}": member for number, member in enumerate(members)}
    vtkhdf.write_vectors(
        path,
        found.mean,
        vtkhdf.read_header(members[0]).reference,
        provenance=record("correlate mean", settings.resolved(), inputs),
        overwrite=overwrite,
        extra=extra,
    )


def _pairs(volumes: Sequence[Path], pairing: Pairing | None) -> list[tuple[Path, Path]]:
    """Return the pairs to correlate: (1, 2), (3, 4) ... for `ab`, (1, 2), (2, 3) ... for `sequence`."""
    if len(volumes) < 2 or (pairing != "sequence" and len(volumes) % 2):
        raise UsageError(f"correlate needs pairs of volumes, got {len(volumes)}")
    if len(volumes) > 2 and pairing is None:
        raise UsageError(
            f"{len(volumes)} volumes need --pairing: ab for separate pairs or sequence for each with the next"
        )
    step = 1 if pairing == "sequence" else 2
    return [(volumes[k], volumes[k + 1]) for k in range(0, len(volumes) - 1, step)]
