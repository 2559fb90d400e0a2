"""`track`: particles followed from frame to frame, and their vectors on a grid."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.files import hdf5, inputs, particle_file, vtkhdf
from lfpiv_cli.files.batch import Target, output_paths, results_seen
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.pairing import Pairs, in_order
from lfpiv_cli.files.provenance import carried_record, record, seconds_between, with_warnings
from lfpiv_cli.flow.field import REJECTED
from lfpiv_cli.grid import Reference
from lfpiv_cli.names import GridMethod
from lfpiv_cli.tracks.candidates import Seen, Trajectories
from lfpiv_cli.tracks.sequences import HALVES_FRAMES
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs import tracks as of_tracks
from lfpiv_cli.verbs.batches import Worked, carried_out
from lfpiv_cli.verbs.fields import fields_of
from lfpiv_cli.verbs.frames import dt_notices
from lfpiv_cli.verbs.pairs import PairBatch, PairOptions, doubts
from lfpiv_cli.verbs.tracks import Tracking, TracksOf

# States look at so many frames, one after the other; forecasts at fewer.
KEPT_FRAMES = 2 * max(HALVES_FRAMES) + 1


class SeenFrames(Sequence[Seen]):
    """The particles of a sequence's frames, read when they are asked for; the last few stay in memory."""

    def __init__(self, count: int, read: Callable[[int], particle_file.Points]) -> None:
        """Take how many frames there are, and what reads one."""
        self._read, self._seen = read, lru_cache(KEPT_FRAMES)(self._seen_in)
        self._counts: dict[int, int] = dict.fromkeys(range(count), -1)

    def __len__(self) -> int:
        """Return how many frames there are."""
        return len(self._counts)

    def __getitem__(self, number: int) -> Seen:  # type: ignore[override]
        """Return the particles of a frame."""
        if number not in self._counts:
            raise IndexError(number)
        return self._seen(number)

    def _seen_in(self, number: int) -> Seen:
        found = of_tracks.seen_in(self._read(number))
        self._counts[number] = len(found)
        return found

    def particles(self, number: int) -> int:
        """Return how many particles a frame has."""
        return self._counts[number] if self._counts[number] >= 0 else len(self[number])


@contextmanager
def stored_tracks(
    frames: SeenFrames,
    reference: Reference,
    settings: Config,
    chosen: Tracking,
    provenance: Mapping[str, Any],
    folder: Path,
    found: Trajectories | None = None,
) -> Iterator[TracksOf[particle_file.StoredTracks]]:
    """Yield the tracks of a sequence, whose places lie in a folder for as long; as `tracked` in memory.

    Raises
    ------
    OutputError : there is no room in the folder
    """
    sequence = of_tracks.tracks_through(frames, chosen, found)
    with particle_file.StoredTracks(folder, reference, chosen.attributes(reference), dict(provenance)) as points:
        for number in range(len(frames)):
            points.put(sequence.at(number))
        yield TracksOf(points, particle_file.TRAJECTORIES_FORMAT, sequence.paths, sequence.summary(), settings)


@dataclass(frozen=True, kw_only=True)
class TrackOptions(PairOptions):
    """What `track_particles` is given besides the particles; where nothing says pairs, they are one sequence.

    Attributes
    ----------
    dt_s : time from one frame to the next, in place of the config's
    search_voxel : largest displacement; found from the particles where None
    shortest : fewest frames of a track in a sequence, three where None
    grid : vectors on the grid of the correlation windows, too
    by : local polynomials (kriging in rough flows), or one spline field as of `field`, for the grid
    """

    dt_s: float | None = None
    search_voxel: float | None = None
    shortest: int | None = None
    grid: bool = False
    by: GridMethod = "polynomials"


def track_particles(
    particles: Sequence[Path],
    output: Path,
    options: TrackOptions = TrackOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Follow particles from frame to frame, in pairs or over a sequence."""
    return carried_out(Tracks(particles, output, options, overwrite), options, console)


@dataclass(frozen=True)
class Outcome:
    """What is told of tracks: their figures, and how good the vectors of each interval are."""

    figures: dict[str, Any]
    qualities: Sequence[checks.Quality]
    rejected: int


class Tracks(PairBatch[Outcome, TrackOptions]):
    """The batch of `track`: the tracks of each pair of files of particles, or those through all of them."""

    label = "track"

    def _arrange(self, files: Sequence[Path], output: Path, pairs: Pairs | None) -> None:
        options = self._options
        in_pairs = pairs is not None or (options.are_told and options.pairing != "sequence")
        self.unit = "pair" if in_pairs else "sequence"
        groups: Sequence[tuple[Path, ...]]
        if in_pairs:
            groups = self._paired(files, pairs)
            paths = output_paths(output, [group[0].stem for group in groups])
        else:
            # In the order of time, by names; two are taken as they are given.
            frames = results_seen(files)
            order, self.notices = ([0, 1], doubts(frames)) if len(frames) == 2 else in_order(frames)
            groups, paths = [tuple(files[number] for number in order)], [output]
        of_tracks.ensure_frames(len(groups[0]), options.shortest)
        self._groups = groups
        grids = [grid_paths(path, len(groups[0]) - 1) if options.grid else [] for path in paths]
        self.targets = [
            Target(path, partial(self._record, number), beside)
            for number, (path, beside) in enumerate(zip(paths, grids, strict=True))
        ]

    def fault(self, number: int) -> str | None:
        """Return why particles of a result cannot be opened."""
        return hdf5.fault_of(self._groups[number])

    def make(self, number: int, work: Frames) -> Outcome:
        """Follow the particles of a pair, or of all frames; write tracks, and vectors where they are asked for."""
        target, paths = self.targets[number], self._groups[number]
        names = [str(path) for path in paths]
        # A pair is read once; of a sequence all that is kept of a frame is its record.
        read = lru_cache(maxsize=2)(partial(particle_file.read_points, format_name=particle_file.PARTICLES_FORMAT))
        counts, records = zip(*((frame.count, frame.provenance) for frame in map(read, paths)), strict=True)
        of_tracks.ensure_particles(counts, names, records)
        settings = of_tracks.settings_of(records, names, self._options.dt_s)
        chosen = of_tracks.tracking_of(
            settings, self._options.search_voxel, self._options.shortest, len(paths), names[0]
        )
        with _tracks(paths, read, settings, chosen, dict(target.record), target.path.parent) as found:
            roles = zip(_roles(paths).items(), records, strict=True)
            reported = {f"{role} {path.name}": made for (role, path), made in roles}
            doubts = dt_notices(chosen.dt_s, (seconds_between(*pair) for pair in pairwise(records)), paths[0].name)
            few = checks.few_notices(counts, [path.name for path in paths], found.summary, found.points)
            notices = [*doubts, *checks.calibration_notices(reported), *few]
            work.console.warn(notices)
            provenance = with_warnings(found.points.provenance, notices)
            # What is complete is skipped: in the place of what is made there is nothing, or something broken.
            replacing = self.overwrite or self._options.resume
            points = found.points.with_record(provenance)
            particle_file.write_points(target.path, found.format_name, points, overwrite=replacing)
            if self._options.by == "polynomials":
                fields = found.fields()
            else:
                fields = (each.vectors() for each in fields_of(found, names[0]))
            qualities, rejected = [], 0
            for path, field in zip(target.beside, fields if target.beside else (), strict=True):
                quality = checks.quality_of(field)
                notices = list(checks.field_notices(quality, path.name))
                work.console.warn(notices)
                made = with_warnings(points.provenance, notices)
                vtkhdf.write_vectors(path, field, points.reference, provenance=made, overwrite=replacing)
                qualities.append(quality)
                rejected += int(np.count_nonzero(field.flag >= REJECTED))
            count, sigmas = found.points.count, found.points.rows("velocity_sigma")
            sigma = np.concatenate([each[np.isfinite(each).all(axis=1)] for each in sigmas])
            told_sigmas = {
                "velocity_sigma_m_s_median": np.median(sigma, axis=0).tolist() if len(sigma) else None,
                "tracks_without_uncertainty_share": (count - len(sigma)) / count if count else None,
            }
            return Outcome(found.summary | told_sigmas, qualities, rejected)

    def summary(self, worked: Worked[Outcome]) -> dict[str, Any]:
        """Return what is told of the batch: all figures of a single result, the sums of several."""
        return summary_of(worked, [target.path for target in self.targets])

    def _record(self, number: int) -> dict[str, Any]:
        """Return the record that tracks will carry."""
        options, paths = self._options, self._groups[number]
        names = [str(path) for path in paths]
        records = [self._gone[path].record if path in self._gone else carried_record(path) for path in paths]
        settings = of_tracks.settings_of(records, names, options.dt_s)
        chosen = of_tracks.tracking_of(settings, options.search_voxel, options.shortest, len(paths), names[0])
        reported = chosen.reported() | ({"grid_by": options.by} if options.grid and options.by != "polynomials" else {})
        return record("track", settings.resolved() | reported, _roles(paths), gone=self._gone)


def summary_of(worked: Worked[Outcome], paths: Sequence[Path]) -> dict[str, Any]:
    """Return what is told of so many files of tracks."""
    outcomes = list(worked.outcomes.values())
    if len(paths) == 1:
        reported = outcomes[0].figures if outcomes else {"tracks": 0}
        if not outcomes and paths[0].exists():
            # Of two frames, or of a sequence, which has a place for each frame of a track.
            points = particle_file.open_tracks(paths[0])
            number = points.arrays.get("track")
            reported = {"tracks": len(points.position_mm) if number is None else len(np.unique(number))}
    else:
        tracks = sum(outcome.figures["tracks"] for outcome in outcomes)
        reported = {"pairs": len(paths), "skipped": worked.skipped, "tracks": tracks}
    qualities = [quality for outcome in outcomes for quality in outcome.qualities]
    if not qualities:
        return reported
    every = checks.quality_of_all(qualities)
    rejected = sum(outcome.rejected for outcome in outcomes)
    return reported | {"vectors": every.vectors, "rejected": rejected} | every.summary()


def grid_paths(output: Path, intervals: int) -> list[Path]:
    """Return where the vectors of each interval between frames go, beside the tracks."""
    names = ["_grid"] if intervals == 1 else [f"_grid_{number:04d}" for number in range(intervals)]
    return [output.with_name(f"{output.stem}{name}{output.suffix}") for name in names]


def _roles(particles: Sequence[Path]) -> dict[str, Path]:
    """Return files of particles by their role."""
    if len(particles) == 2:
        return inputs.given(particles_a=particles[0], particles_b=particles[1])
    return {f"particles_{number:04d}": path for number, path in enumerate(particles)}


@contextmanager
def _tracks(
    paths: Sequence[Path],
    read: Callable[[Path], particle_file.Points],
    settings: Config,
    chosen: Tracking,
    made: dict[str, Any],
    folder: Path,
) -> Iterator[TracksOf[Any]]:
    """Yield the tracks of a pair of files in memory, those of a sequence on a disk; `made` is their provenance."""
    if chosen.shortest is None:
        yield of_tracks.tracked([read(path) for path in paths], settings, chosen, made)
        return
    frames, reference = SeenFrames(len(paths), lambda number: read(paths[number])), read(paths[0]).reference
    with stored_tracks(frames, reference, settings, chosen, made, folder) as found:
        yield found
