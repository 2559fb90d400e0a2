"""`follow`: the particles of a time-resolved sequence, found and tracked together.

In the output folder: `particles/STEM.vtkhdf` for each frame, as `reconstruct` writes them, `tracks.vtkhdf`, as `track`
writes them, and `playback.vtkhdf`, the same for playing them in time; with both ways `forwards/STEM.vtkhdf`, too, what
was found on the way forwards.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import (
    VTKHDF_SUFFIX,
    Frame,
    Target,
    frames_of,
    images_seen,
    output_paths,
    pending,
)
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.exports.vtk import write_playback
from lfpiv_cli.files.pairing import in_order
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, Points, no_points, read_points, write_points
from lfpiv_cli.files.provenance import even_step_s, record, sha256, with_warnings
from lfpiv_cli.files.shares import Deadline
from lfpiv_cli.notice import Notice
from lfpiv_cli.particles.neighbour_frames import STEPS as PREDICTED_STEPS
from lfpiv_cli.reconstruction.images import Image
from lfpiv_cli.reference import Reference
from lfpiv_cli.tracks.candidates import Trajectories
from lfpiv_cli.verbs import particles
from lfpiv_cli.verbs.batches import ALL, Batch, Failure, Worked, WorkOptions, dry_run
from lfpiv_cli.verbs.checks import few_notices
from lfpiv_cli.verbs.following import SHORTEST, Recorded, ensure_sequence, forwards, go_both_ways
from lfpiv_cli.verbs.frames import (
    ImageOptions,
    bench_of,
    check_frame,
    frame_notices,
    frames_dt_notices,
    mask_of,
    other_frames,
    read_frame,
    reader,
    residual_path,
)
from lfpiv_cli.verbs.particles import open_weights_that_fit, searchable_weights
from lfpiv_cli.verbs.reconstruct import file_notices
from lfpiv_cli.verbs.tracers import size_notices
from lfpiv_cli.verbs.track import SeenFrames, stored_tracks
from lfpiv_cli.verbs.tracks import Tracking, tracking_of


@dataclass(eq=False)
class PlannedFrames(Batch[None]):
    """The frames of a sequence that can be read before any is followed, as `dry_run` asks of them."""

    targets: Sequence[Target]
    inputs: Sequence[Path]
    overwrite: bool
    beside: Sequence[Path]
    left_out: Sequence[Failure]
    label = "follow"
    unit = "frame"


@dataclass(eq=False)
class FrameFiles:
    """A store of one file for each frame, written as it is found.

    Attributes
    ----------
    targets : where the frames' files go
    needed, there : the numbers of those that are to be made, and of all that there are
    said : what is said of all of them
    """

    targets: Sequence[Target]
    needed: Collection[int]
    there: Collection[int]
    reference: Reference
    said: Sequence[Notice]
    residuals: bool
    overwrite: bool
    work: Frames
    deadline: Deadline
    put_so_far: int = 0
    begun_s: float = 0.0

    def read(self, number: int) -> Points:
        """Return the particles of a frame; none of one that was left out."""
        if number not in self.there:
            return no_points(PARTICLES_FORMAT, self.reference)
        return read_points(self.targets[number].path, PARTICLES_FORMAT)

    def made(self, number: int) -> Points | None:
        """Return the particles of a frame that was complete; begin another one where there is time for it.

        Raises
        ------
        StoppedEarlyError : there is none
        """
        if number not in self.needed:
            return self.read(number)
        if not self.deadline.leaves_time():
            done = len(self.there) - len(self.needed) + self.put_so_far
            raise self.deadline.error(done, len(self.there), "frame")
        self.begun_s = time.monotonic()
        return None

    def put(self, number: int, points: Points, left: Image, notices: list[Notice]) -> None:
        """Write the particles of a frame, what is left of its image before them: what is complete has both."""
        target = self.targets[number]
        self.work.console.warn(notices)
        if self.residuals:
            image_files.write_tiff(residual_path(target.path), left, overwrite=True)
        told = replace(points, provenance=with_warnings(target.record, [*self.said, *notices]))
        write_points(target.path, PARTICLES_FORMAT, told, overwrite=self.overwrite)
        self.deadline.took(time.monotonic() - self.begun_s)
        self.put_so_far += 1
        self.work.done(target.path.stem)


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


NO_OPTIONS = FollowOptions()


def follow_particles(
    weights: Path,
    images: Sequence[Path],
    output: Path,
    options: FollowOptions = NO_OPTIONS,
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
    frames = frames_of(images, options.keep_going)
    ensure_sequence(len(frames), options.shortest)
    if options.failures is not None:
        ensure_writable(options.failures, overwrite or options.resume, images)
    order, notices = in_order(images_seen(frames))
    frames = [frames[number] for number in order]
    console.warn(notices)
    level, common = options.level, options.files(weights)
    content = open_weights_that_fit(weights)
    settings = carried_config(content.provenance, weights).overridden("reconstruction", solver="particles")
    settings = settings.overridden("correlation", dt_s=options.dt_s)
    if settings.correlation.dt_s is None:
        steps = [before.seconds_to(after) for before, after in pairwise(frames)]
        names = [f"{each.path} page {each.page}" for each in frames]
        settings = settings.overridden("correlation", dt_s=even_step_s(steps, names))
    console.warn(frames_dt_notices(settings.correlation.dt_s, frames))
    tracking = tracking_of(settings, options.search_voxel, options.shortest, len(frames), str(weights))
    shape = content.image_shape
    left_out: list[Failure] = []
    if options.keep_going:
        frames, left_out = _readable(frames, shape)
        console.warn(Notice("frame-failed", each.name, each.error, "leave it out, or mend it") for each in left_out)
        ensure_sequence(len(frames), options.shortest)
    words = other_frames(level, frames, options.mask)
    passes = _passes(output, frames, words, settings, tracking, common, options.both_ways)
    inputs = [*common.values(), *images]
    if options.dry_run:
        beside = [output / TRACKS, output / PLAYBACK, *(target.path for targets in passes[:-1] for target in targets)]
        here = [target for target, frame in zip(passes[-1], frames, strict=True) if frame.fault is None]
        return dry_run(PlannedFrames(here, inputs, overwrite, beside, left_out), options, console)
    content = searchable_weights(weights, content, settings)
    there = [number for number, frame in enumerate(frames) if frame.fault is None]
    # It is known that what is to be made can be written.
    replacing, needed = overwrite or options.resume, []
    for targets in passes:
        needed.append([there[k] for k in pending([targets[k] for k in there], inputs, overwrite, options.resume)])
        for number in needed[-1] if options.residuals and targets is passes[-1] else []:
            ensure_writable(residual_path(targets[number].path), replacing, inputs)
    for name in (TRACKS, PLAYBACK):
        ensure_writable(output / name, replacing, inputs)
    dark = options.dark_image(shape)
    pitch_px = float(content.camera.micro_image_lattice_px().pitch.max())
    bench = bench_of(content, settings, dark, mask_of(options.mask, frames, shape, pitch_px, options.keep_going))
    read = reader(level, frames, shape, dark, options.keep_going)
    bench, size = particles.sized(bench, (particles.frame_of(bench, *read(k)) for k in there))
    said = size_notices(settings, size)
    console.warn(said)

    def frame_at(number: int) -> particles.Frame:
        (raw, lit), stem = read(number), frames[number].stem
        check_frame(bench, raw, str(frames[number].path))
        console.warn([*file_notices(passes[0][number].record, stem), *frame_notices(bench, raw, lit, stem)])
        return particles.frame_of(bench, raw, lit)

    sequence = Recorded(bench, size, tracking, frame_at, [frame.stem for frame in frames], {})
    found: Trajectories | None
    count, deadline = sum(map(len, needed)), options.deadline()
    searched = sum(number < 2 for number in needed[0])
    work_steps = searched * particles.STEPS + (count - searched) * PREDICTED_STEPS
    with console.frames(count, work_steps / max(count, 1), "follow") as work:
        stores = [
            FrameFiles(
                targets,
                set(numbers),
                set(there),
                content.reference,
                said,
                options.residuals and targets is passes[-1],
                overwrite,
                work,
                deadline,
            )
            for targets, numbers in zip(passes, needed, strict=True)
        ]
        found = forwards(sequence, stores[0], work.advance)
        if options.both_ways:
            go_both_ways(sequence, found, stores[0].read, stores[1], work.advance)
            found = None
    counts = {"frames": len(frames), "found": len(needed[-1]), "skipped": len(there) - len(needed[-1])}
    summary = _write_tracks(output, sequence, stores[-1], found, replacing, console)
    worked = Worked(dict.fromkeys(there), failures=left_out)
    worked.list_failures(options.failures)
    return worked.ensure_whole(counts | summary | size.summary(), "frame")


def _readable(frames: Sequence[Frame], shape: tuple[int, int]) -> tuple[list[Frame], list[Failure]]:
    """Return a sequence with the faults of its frames, and those that are left out of it.

    It begins with two that can be read, as these are found together.
    """
    seen: list[Frame] = []
    for frame in frames:
        try:
            raw, fault = read_frame(frame, shape), None
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
    output: Path, sequence: Recorded, store: FrameFiles, found: Trajectories | None, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Write the tracks through a sequence; return what is told of them."""
    settings, tracking, there = sequence.bench.settings, sequence.tracking, sorted(store.there)
    first = store.read(0)
    carried = carried_config(first.provenance, store.targets[0].path)
    inputs = {f"particles_{number:04d}": store.targets[number].path for number in there}
    provenance = record("follow", carried.resolved() | tracking.told(), inputs)
    frames = SeenFrames(len(sequence.names), store.read)
    with stored_tracks(frames, first.reference, settings, tracking, provenance, output, found) as result:
        counts = [frames.particles(number) for number in there]
        notices = few_notices(counts, [sequence.names[number] for number in there], result.summary, result.points)
        console.warn(notices)
        told = result.points.with_record(with_warnings(provenance, notices))
        write_points(output / TRACKS, result.format_name, told, overwrite=overwrite)
        write_playback(output / PLAYBACK, told, len(frames), tracking.dt_s, overwrite=overwrite)
    return {"particles_fewest": min(counts)} | {k: v for k, v in result.summary.items() if k != "frames"}


def _passes(
    output: Path,
    frames: Sequence[Frame],
    words: Callable[[int], str],
    settings: Config,
    tracking: Tracking,
    common: Mapping[str, Path],
    both_ways: bool,
) -> list[list[Target]]:
    """Return for each pass where the files of its frames go, and the records that they carry.

    These say which frames each is made with: on the way forwards those before it (the first with the second), the
    second time all; `words` says what their background and mask are made of.
    """
    every = ["left out\n" if frame.fault else f"{sha256(frame.path)} {frame.page}\n" for frame in frames]
    resolved = settings.resolved()

    def target(path: Path, number: int, way: str, count: int) -> Target:
        frame, digest = frames[number], hashlib.sha256("".join(every[:count]).encode()).hexdigest()
        command = (
            f"follow {way} page {frame.page} of {count} frames, SHA-256 {digest}, within {tracking.search_mm:g} mm"
        )
        inputs, taken_s = {**common, "image": frame.path}, {"image": frame.time_s}
        return Target(path, partial(record, command + words(number), resolved, inputs, taken_s))

    stems, numbers = [frame.stem for frame in frames], range(len(frames))
    folder = output / (FORWARDS if both_ways else PARTICLES)
    paths = output_paths(folder, stems)
    passes = [[target(paths[k], k, "forwards", max(k + 1, 2)) for k in numbers]]
    if both_ways:
        paths = output_paths(output / PARTICLES, stems)
        passes.append([target(paths[k], k, "both ways", len(frames)) for k in numbers])
    return passes
