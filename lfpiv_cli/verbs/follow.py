"""`follow`: the particles of a time-resolved sequence, found and tracked together.

In the output folder: `particles/STEM.vtkhdf` for each frame, as `reconstruct` writes them, `tracks.vtkhdf`, as `track`
writes them, and `playback.vtkhdf`, the same for playing them in time; with both ways `forwards/STEM.vtkhdf`, too, what
was found on the way forwards.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import atomic, export_vtk, pairing
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import VTKHDF_SUFFIX, Frame, Target, frames_of, images_seen, output_paths, pending
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, UNITS, Points, read_points, write_points
from lfpiv_cli.files.provenance import even_step_s, record, sha256, with_warnings
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.grid import Reference
from lfpiv_cli.notice import Notice
from lfpiv_cli.particles.neighbour_frames import STEPS as PREDICTED_STEPS
from lfpiv_cli.tracks.candidates import Trajectories
from lfpiv_cli.verbs import frames as of_frames
from lfpiv_cli.verbs import particles
from lfpiv_cli.verbs.batches import ALL, Batch, BatchOptions, Failure, WorkOptions, carried_out, work_through
from lfpiv_cli.verbs.checks import few_notices
from lfpiv_cli.verbs.following import SHORTEST, BothWays, Forwards, Recorded, ensure_sequence
from lfpiv_cli.verbs.frames import ImageOptions
from lfpiv_cli.verbs.particles import Prepared
from lfpiv_cli.verbs.reconstruct import file_notices
from lfpiv_cli.verbs.tracers import size_notices
from lfpiv_cli.verbs.track import SeenFrames, stored_tracks
from lfpiv_cli.verbs.tracks import Tracking, tracking_of

SEQUENCE_IS_WHOLE = "--shard: a sequence is followed from frame to frame and cannot be divided; leave out --shard"
PARTICLES, FORWARDS = "particles", "forwards"
TRACKS, PLAYBACK = f"tracks{VTKHDF_SUFFIX}", f"playback{VTKHDF_SUFFIX}"


@dataclass(frozen=True, kw_only=True)
class FollowOptions(ImageOptions, WorkOptions):
    """What `follow_particles` is given besides weights and images; with `keep_going` tracks end before bad frames.

    Attributes
    ----------
    dt_s : time from one frame to the next, in place of the config's
    search_voxel : displacements from the first frame to the second are sought up to this along each axis
    shortest : fewest frames of a track
    both_ways : go through the frames a second time, each with its tracks before and after it
    residuals : write what the particles leave of each image, too
    """

    dt_s: float | None = None
    search_voxel: float | None = None
    shortest: int = SHORTEST
    both_ways: bool = False
    residuals: bool = False


class Way(Batch[None]):
    """One way through a sequence: the particles of each frame that can be read, in a file of its own.

    Attributes
    ----------
    finder, said : what finds the particles of a frame, and what is said of all frames; known before any is made
    reference : the origin of the particles' coordinates
    failed : frames whose particles could not be found
    """

    label, unit = "follow", "frame"
    order: Sequence[int] = ()
    finder: Forwards | BothWays
    said: Sequence[Notice] = ()
    reference: Reference

    def __init__(
        self, targets: Sequence[Target], order: Sequence[int], inputs: Sequence[Path], overwrite: bool, resume: bool
    ) -> None:
        """Take where the files of all frames go, and which of these there are."""
        self.targets, self.order, self.inputs, self.overwrite = targets, order, inputs, overwrite
        self._replace, self.residuals = overwrite or resume, False
        self.failed: set[int] = set()

    def ensure_residuals(self, numbers: Sequence[int]) -> None:
        """Refuse residual images that could not be written."""
        for number in numbers if self.residuals else ():
            atomic.ensure_writable(of_frames.residual_path(self.targets[number].path), self._replace, self.inputs)

    def begin(self, numbers: Sequence[int], console: Console) -> float:
        """Return the steps of a frame: only the first two are searched from nothing."""
        self.ensure_residuals(numbers)
        searched = sum(number < 2 for number in numbers) if isinstance(self.finder, Forwards) else 0
        steps = searched * particles.STEPS + (len(numbers) - searched) * PREDICTED_STEPS
        return steps / max(len(numbers), 1)

    def make(self, number: int, work: Frames) -> None:
        """Write the particles of a frame, what is left of its image before them: what is complete has both."""
        target = self.targets[number]
        try:
            points, left, notices = self.finder.find(number, work.advance)
        except InputError:
            self.failed.add(number)
            raise
        work.console.warn(notices)
        if self.residuals:
            image_files.write_tiff(of_frames.residual_path(target.path), left, overwrite=True)
        reported = replace(points, provenance=with_warnings(target.record, [*self.said, *notices]))
        write_points(target.path, PARTICLES_FORMAT, reported, overwrite=self._replace)

    def read(self, number: int) -> Points:
        """Return the particles of a frame; none of one that was left out."""
        path = self.targets[number].path
        if number not in self.order or number in self.failed:
            shapes = {name: (0, 6) if name.startswith("covariance") else 0 for name in UNITS[PARTICLES_FORMAT]}
            none = {name: np.zeros(shape) for name, shape in shapes.items()}
            return Points(np.zeros((0, 3)), none, self.reference, {}, {})
        if not path.exists():
            with atomic.awaited(path):  # another worker makes it now
                pass
        return read_points(path, PARTICLES_FORMAT)


def follow_particles(
    weights: Path,
    images: Sequence[Path],
    output: Path,
    options: FollowOptions = FollowOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Find and follow the particles of a sequence.

    Raises
    ------
    PartialError : frames were left out
    UsageError : a share is asked for
    StoppedEarlyError : the time is over
    """
    if options.shard != ALL:
        raise UsageError(SEQUENCE_IS_WHOLE)
    frames, replacing = frames_of(images, options.keep_going), overwrite or options.resume
    ensure_sequence(len(frames), options.shortest)
    if options.failures is not None:
        atomic.ensure_writable(options.failures, replacing, images)
    order, notices = pairing.in_order(images_seen(frames))
    frames = [frames[number] for number in order]
    console.warn(notices)
    prepared = Prepared()
    content = prepared.weights(weights)
    settings = carried_config(content.provenance, weights).overridden("reconstruction", solver="particles")
    settings = settings.overridden("correlation", dt_s=options.dt_s)
    steps = [before.seconds_to(after) for before, after in pairwise(frames)]
    if settings.correlation.dt_s is None:
        names = [f"{each.path} page {each.page}" for each in frames]
        settings = settings.overridden("correlation", dt_s=even_step_s(steps, names))
    console.warn(of_frames.dt_notices(settings.correlation.dt_s, steps, str(frames[0].path)))
    tracking = tracking_of(settings, options.search_voxel, options.shortest, len(frames), str(weights))
    left_out: list[Failure] = []
    if options.keep_going:
        frames, left_out = _readable(frames, content.image_shape)
        console.warn(Notice("frame-failed", each.name, each.error, "leave it out, or mend it") for each in left_out)
        ensure_sequence(len(frames), options.shortest)
    ways = _ways(output, frames, settings, tracking, (weights, images), options, overwrite)
    last, there, results = ways[-1], ways[-1].order, [output / TRACKS, output / PLAYBACK]
    last.left_out, last.beside = left_out, [*results, *(path for way in ways[:-1] for path in way.outputs)]
    chosen = BatchOptions(**{each.name: getattr(options, each.name) for each in fields(WorkOptions)})
    if options.dry_run:
        return carried_out(last, chosen, console)
    for path in results:
        atomic.ensure_writable(path, replacing, last.inputs)
    if last is not ways[0]:
        # What is made the second time can be written, which is to be known before the first.
        there_again = pending([last.targets[k] for k in there], last.inputs, overwrite, options.resume, dry=True)
        last.ensure_residuals([there[k] for k in there_again])
    sequence, said = _recorded(
        prepared.searchable(weights, settings), settings, tracking, frames, ways[0], options, console
    )
    forwards = Forwards(sequence, ways[0].read)
    found: Trajectories | None = None
    for way in ways:
        way.said, way.reference = said, content.reference
        way.finder = forwards if way is ways[0] else BothWays(sequence, forwards.found(), ways[0].read)
        worked = work_through(way, replace(chosen, failures=options.failures if way is last else None), console)
    if not options.both_ways:
        found = forwards.found()
    counts = {"frames": len(frames), "found": len(worked.outcomes), "skipped": worked.skipped}
    summary = _write_tracks(output, sequence, last, found, replacing, console)
    return worked.ensure_whole(counts | summary | sequence.size.summary(), "frame")


def _recorded(
    content: WeightsFile,
    settings: Config,
    tracking: Tracking,
    frames: Sequence[Frame],
    way: Way,
    options: FollowOptions,
    console: Console,
) -> tuple[Recorded, list[Notice]]:
    """Return the sequence as it is followed, its tracers' size known; and what is said of that."""
    bench, read = Prepared().reading(content, settings, frames, options, options.keep_going)
    bench, size = particles.sized(bench, (particles.frame_of(bench, *read(k)) for k in way.order))
    said = size_notices(settings, size)
    console.warn(said)

    def frame_at(number: int) -> particles.Frame:
        (raw, lit), stem = read(number), frames[number].stem
        of_frames.check_frame(bench, raw, str(frames[number].path))
        console.warn([*file_notices(way.targets[number].record, stem), *of_frames.frame_notices(bench, raw, lit, stem)])
        return particles.frame_of(bench, raw, lit)

    return Recorded(bench, size, tracking, frame_at, [frame.stem for frame in frames], {}), said


def _readable(frames: Sequence[Frame], shape: tuple[int, int]) -> tuple[list[Frame], list[Failure]]:
    """Return a sequence with the faults of its frames, and those that are left out of it.

    It begins with two that can be read, as these are found together.
    """
    seen: list[Frame] = []
    for frame in frames:
        try:
            raw, fault = of_frames.read_frame(frame, shape), None
        except InputError as error:
            fault = str(error)
        else:
            if raw.min() == raw.max():
                fault = f"{frame.path}: has one value everywhere; it shows no particles"
        seen.append(replace(frame, fault=fault))
    begins = (k for k in range(len(seen) - 1) if seen[k].fault is None and seen[k + 1].fault is None)
    begin = next(begins, len(seen))
    before = "is before the first two frames in a row that can be read"
    left_out = [frame for k, frame in enumerate(seen) if k < begin or frame.fault is not None]
    return seen[begin:], [Failure(frame.stem, frame.fault or f"{frame.path}: {before}") for frame in left_out]


def _write_tracks(
    output: Path, sequence: Recorded, way: Way, found: Trajectories | None, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Write the tracks through a sequence; return what is told of them."""
    settings, tracking = sequence.bench.settings, sequence.tracking
    there = [number for number in way.order if number not in way.failed]
    first = way.read(there[0])
    carried = carried_config(first.provenance, way.targets[there[0]].path)
    inputs = {f"particles_{number:04d}": way.targets[number].path for number in there}
    provenance = record("follow", carried.resolved() | tracking.reported(), inputs)
    frames = SeenFrames(len(sequence.names), way.read)
    with stored_tracks(frames, first.reference, settings, tracking, provenance, output, found) as result:
        counts = [frames.particles(number) for number in there]
        notices = few_notices(counts, [sequence.names[number] for number in there], result.summary, result.points)
        console.warn(notices)
        reported = result.points.with_record(with_warnings(provenance, notices))
        write_points(output / TRACKS, result.format_name, reported, overwrite=overwrite)
        export_vtk.write_playback(output / PLAYBACK, reported, len(frames), tracking.dt_s, overwrite=overwrite)
    return {"particles_fewest": min(counts)} | {k: v for k, v in result.summary.items() if k != "frames"}


def _ways(
    output: Path,
    frames: Sequence[Frame],
    settings: Config,
    tracking: Tracking,
    given: tuple[Path, Sequence[Path]],
    options: FollowOptions,
    overwrite: bool,
) -> list[Way]:
    """Return the ways through a sequence, of weights and images as `given`, with the records of their files.

    These say which frames each is made with: on the way forwards those before it (the first with the second), the
    second time all.
    """
    common, words = options.files(given[0]), of_frames.other_frames(options.level, frames, options.mask)
    every = ["left out\n" if frame.fault else f"{sha256(frame.path)} {frame.page}\n" for frame in frames]
    resolved, there = settings.resolved(), [number for number, frame in enumerate(frames) if frame.fault is None]

    def made(number: int, name: str, count: int) -> dict[str, Any]:
        frame, digest = frames[number], hashlib.sha256("".join(every[:count]).encode()).hexdigest()
        command = f"follow {name} page {frame.page} of {count} frames, SHA-256 {digest}" + (
            "" if tracking.search_mm is None else f", within {tracking.search_mm:g} mm"
        )
        return record(command + words(number), resolved, {**common, "image": frame.path}, {"image": frame.time_s})

    ways = []
    names = {FORWARDS: "forwards", PARTICLES: "both ways"} if options.both_ways else {PARTICLES: "forwards"}
    for folder, name in names.items():
        targets = [
            Target(path, partial(made, k, name, max(k + 1, 2) if name == "forwards" else len(frames)))
            for k, path in enumerate(output_paths(output / folder, [frame.stem for frame in frames]))
        ]
        ways.append(Way(targets, there, [*common.values(), *given[1]], overwrite, options.resume))
    ways[-1].residuals = options.residuals
    return ways
