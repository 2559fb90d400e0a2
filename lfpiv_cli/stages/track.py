"""The stage of `track`: particles followed from frame to frame, and their vectors on a grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.batch import Target, output_paths
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, read_points, read_tracks, write_points
from lfpiv_cli.files.provenance import Gone, carried_record, record, with_warnings
from lfpiv_cli.files.whole import fault_of
from lfpiv_cli.flow.field import REJECTED
from lfpiv_cli.interface.tracks import (
    Tracked,
    ensure_frames,
    ensure_particles,
    few_notices,
    settings_of,
    tracked,
    tracking_of,
)
from lfpiv_cli.interface.vectors_checks import (
    Quality,
    calibration_notices,
    field_notices,
    quality_of,
    quality_of_all,
)
from lfpiv_cli.stages.batches import BatchOptions, ByArguments, Failure, Worked, work_through
from lfpiv_cli.stages.dry_runs import Expected, dry_run
from lfpiv_cli.stages.intervals import dt_notices
from lfpiv_cli.stages.pairs import PairOptions, result_pairs, sequence_of


@dataclass(frozen=True, kw_only=True)
class TrackOptions(PairOptions, BatchOptions):
    """What `track_particles` is given besides the particles; where nothing says pairs, they are one sequence.

    Attributes
    ----------
    dt_s : time from one frame to the next, in place of the config's
    search_voxel : displacements are sought up to this along each axis, six microlenses in the scene where None
    shortest : fewest frames of a track in a sequence, three where None
    grid : vectors on the grid of the correlation windows, too
    """

    dt_s: float | None = None
    search_voxel: float | None = None
    shortest: int | None = None
    grid: bool = False


NO_OPTIONS = TrackOptions()


def track_particles(
    particles: Sequence[Path],
    output: Path,
    options: TrackOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
    pairs: Pairs | None = None,
) -> dict[str, Any]:
    """Follow particles from frame to frame, in pairs or over a sequence; `pairs`, where they are known already."""
    batch = Tracks(particles, output, options, overwrite, pairs)
    if options.dry_run:
        return dry_run(batch, options, console)
    worked = work_through(batch, options, console)
    return worked.ensure_whole(batch.summary(worked), batch.unit)


@dataclass(frozen=True)
class Outcome:
    """What is told of tracks: their figures, and how good the vectors of each interval are."""

    figures: dict[str, Any]
    qualities: Sequence[Quality]
    rejected: int


class Tracks(ByArguments):
    """The batch of `track`: the tracks of each pair of files of particles, or those through all of them."""

    label = "track"

    def __init__(
        self,
        particles: Sequence[Path],
        output: Path,
        options: TrackOptions,
        overwrite: bool,
        pairs: Pairs | None = None,
        gone: Mapping[Path, Gone] | None = None,
    ) -> None:
        """Take the arguments of `track`; see which frames belong together, and read no particles.

        Raises
        ------
        LfpivError : frames or outputs do not go together
        """
        self._options, self.overwrite, self.inputs, self._gone = options, overwrite, particles, gone or {}
        in_pairs = pairs is not None or (options.are_told and options.pairing != "sequence")
        self.unit, self.left_out = "pair" if in_pairs else "sequence", []
        if in_pairs:
            found = result_pairs(particles, options) if pairs is None else pairs
            self.notices = found.settled(options.keep_going)
            self.left_out = [Failure(each.name, each.why) for each in found.left_out]
            groups: list[tuple[Path, ...]] = [(particles[first], particles[second]) for first, second in found.pairs]
            paths = output_paths(output, [group[0].stem for group in groups])
        else:
            order, self.notices = sequence_of(particles)
            groups, paths = [tuple(particles[number] for number in order)], [output]
        ensure_frames(len(groups[0]), options.shortest)
        self._groups = groups
        self.names = [path.stem for path in paths]
        grids = [grid_paths(path, len(groups[0]) - 1) if options.grid else [] for path in paths]
        self.targets = [
            Target(path, partial(self._record, number), beside)
            for number, (path, beside) in enumerate(zip(paths, grids, strict=True))
        ]

    @property
    def outputs(self) -> list[Path]:
        """All files that may be written."""
        return [path for target in self.targets for path in target.paths]

    def fault(self, number: int) -> str | None:
        """Return why particles of a result cannot be opened."""
        return fault_of(self._groups[number])

    def expected(self) -> Expected:
        """Return that neither is known: how many tracks will be found is not."""
        return Expected()

    def begin(self, _numbers: Sequence[int], _console: Console) -> float:
        """Do nothing: pairs share nothing but the settings."""
        return 1.0

    def make(self, number: int, work: Frames) -> Outcome:
        """Follow the particles of a pair, or of all frames; write tracks, and vectors where they are asked for."""
        target, paths = self.targets[number], self._groups[number]
        names = [str(path) for path in paths]
        frames = [read_points(path, PARTICLES_FORMAT) for path in paths]
        counts = [len(frame.position_mm) for frame in frames]
        ensure_particles(counts, names)
        settings = settings_of([frame.provenance for frame in frames], names, self._options.dt_s)
        chosen = tracking_of(settings, self._options.search_voxel, self._options.shortest, len(frames), names[0])
        found = tracked(frames, settings, chosen, dict(target.record))
        records = {
            f"{role} {path.name}": frame.provenance
            for (role, path), frame in zip(_roles(paths).items(), frames, strict=True)
        }
        doubts = dt_notices(chosen.dt_s, pairwise(frame.provenance for frame in frames), paths[0].name)
        notices = [*doubts, *calibration_notices(records), *few_notices(counts, [path.name for path in paths], found)]
        work.console.warn(notices)
        provenance = with_warnings(found.points.provenance, notices)
        # What is complete is skipped: in the place of what is made there is nothing, or something broken.
        replacing = self.overwrite or self._options.resume
        write_points(target.path, found.format_name, replace(found.points, provenance=provenance), overwrite=replacing)
        qualities, rejected = _write_grids(target.beside, found, provenance, replacing, work.console)
        return Outcome(found.summary | _sigmas(found), qualities, rejected)

    def summary(self, worked: Worked[Outcome]) -> dict[str, Any]:
        """Return what is told of the batch: all figures of a single result, the sums of several."""
        return summary_of(worked, [target.path for target in self.targets])

    def _record(self, number: int) -> dict[str, Any]:
        """Return the record that tracks will carry."""
        options, paths = self._options, self._groups[number]
        names = [str(path) for path in paths]
        records = [self._gone[path].record if path in self._gone else carried_record(path) for path in paths]
        settings = settings_of(records, names, options.dt_s)
        chosen = tracking_of(settings, options.search_voxel, options.shortest, len(paths), names[0])
        return record("track", settings.resolved() | chosen.told(), _roles(paths), gone=self._gone)


def summary_of(worked: Worked[Outcome], paths: Sequence[Path]) -> dict[str, Any]:
    """Return what is told of so many files of tracks."""
    outcomes = list(worked.outcomes.values())
    if len(paths) == 1:
        told = outcomes[0].figures if outcomes else {"tracks": count_tracks(paths[0]) if paths[0].exists() else 0}
    else:
        tracks = sum(outcome.figures["tracks"] for outcome in outcomes)
        told = {"pairs": len(paths), "skipped": worked.skipped, "tracks": tracks}
    qualities = [quality for outcome in outcomes for quality in outcome.qualities]
    if not qualities:
        return told
    every = quality_of_all(qualities)
    rejected = sum(outcome.rejected for outcome in outcomes)
    return told | {"vectors": every.vectors, "rejected": rejected} | every.summary()


def count_tracks(path: Path) -> int:
    """Return how many tracks a file holds, of two frames or of a sequence."""
    points = read_tracks(path)
    number = points.arrays.get("track")
    return len(points.position_mm) if number is None else len(np.unique(number))


def grid_paths(output: Path, intervals: int) -> list[Path]:
    """Return where the vectors of each interval between frames go, beside the tracks."""
    names = ["_grid"] if intervals == 1 else [f"_grid_{number:04d}" for number in range(intervals)]
    return [output.with_name(f"{output.stem}{name}{output.suffix}") for name in names]


def _roles(particles: Sequence[Path]) -> dict[str, Path]:
    """Return files of particles by their role."""
    if len(particles) == 2:
        return given(particles_a=particles[0], particles_b=particles[1])
    return {f"particles_{number:04d}": path for number, path in enumerate(particles)}


def _sigmas(found: Tracked) -> dict[str, Any]:
    """Return the median of the tracks' standard deviations, and the share of those without one."""
    sigma = found.points.arrays["velocity_sigma"]
    known = np.isfinite(sigma).all(axis=1)
    return {
        "velocity_sigma_m_s_median": np.median(sigma[known], axis=0).tolist() if known.any() else None,
        "tracks_without_uncertainty_share": float(np.mean(~known)) if len(known) else None,
    }


def _write_grids(
    grids: Sequence[Path], found: Tracked, provenance: Mapping[str, Any], overwrite: bool, console: Console
) -> tuple[list[Quality], int]:
    """Write the vectors of each interval; return how good they are, and how many are rejected."""
    qualities, rejected = [], 0
    for target, field in zip(grids, found.vectors() if grids else (), strict=True):
        quality = quality_of(field)
        notices = list(field_notices(quality, target.name))
        console.warn(notices)
        made = with_warnings(provenance, notices)
        vtkhdf.write_vectors(target, field, found.points.reference, provenance=made, overwrite=overwrite)
        qualities.append(quality)
        rejected += int(np.count_nonzero(field.flag >= REJECTED))
    return qualities, rejected
