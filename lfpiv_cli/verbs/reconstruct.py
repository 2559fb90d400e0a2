"""`reconstruct`: each image prepared, solved, and its volume or particles kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import atomic, config, hdf5, vtkhdf
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Target, frames_of, images_seen, output_paths
from lfpiv_cli.files.inputs import ensure_room
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, write_points
from lfpiv_cli.files.provenance import Gone, also_used_as, record, sha256, with_warnings
from lfpiv_cli.files.vtkhdf import Volume
from lfpiv_cli.files.weights_file import WeightsFile, read_weights_record
from lfpiv_cli.names import Start
from lfpiv_cli.notice import Notice, warn_of, written
from lfpiv_cli.reconstruction.images import Image, as_if_lit, filled, light
from lfpiv_cli.reconstruction.registry import SolverName
from lfpiv_cli.reconstruction.solvers import reconstruct as solve
from lfpiv_cli.verbs import frames as of_frames
from lfpiv_cli.verbs import particles
from lfpiv_cli.verbs.batches import Batch, Expected, Worked, carried_out
from lfpiv_cli.verbs.frames import IMAGE, Bench, ImageOptions, Progress, ReadAhead
from lfpiv_cli.verbs.pairs import PairOptions, found_pairs, watched, work_as_they_come
from lfpiv_cli.verbs.particles import Finder, Prepared
from lfpiv_cli.verbs.tracers import TracerSize, light_notices, size_notices
from lfpiv_cli.verbs.weights_cost import COLUMN_S, FLOAT_BYTES, columns_bytes, held_bytes


def reconstruct(
    weights: WeightsFile,
    image: NDArray[Any],
    *,
    dark: NDArray[Any] | None = None,
    background: NDArray[Any] | None = None,
    mask: NDArray[Any] | None = None,
    **settings: Any,
) -> Volume:
    """Reconstruct the volume of tracer particles behind an image.

    Parameters
    ----------
    weights : WeightsFile
        From `build_weights` or `open_weights`.
    image : (rows, columns) counts
        Raw image.
    dark : (rows, columns) counts, optional
        Raw image taken with the cap on: is subtracted, and its hot and dead pixels are left out.
    background : (rows, columns) counts, optional
        Raw image without tracers, subtracted in place of the dark one.
    mask : (rows, columns), optional
        0 where pixels are left out (reflections, bubbles).
    **settings
        Keys of the rig's section `reconstruction`, in their place: solver, iterations, relaxation and so on.

    Returns
    -------
    Volume
        `array` (nz, ny, nx) float32, light in counts; `grid`, spacing and origin in mm, z from the volume's reference;
        `attributes` with the relative `residual` after each iteration.

    Raises
    ------
    ConfigError
        The settings are not possible.
    UsageError
        The solver is `particles`, which makes no volume: see `find_particles`.
    InputError
        An image has another shape than what the weights were made for, or does not fit into memory.
    """
    chosen = config.carried_config(weights.provenance, "the weights").overridden("reconstruction", **settings)
    if chosen.reconstruction.solver == "particles":
        raise UsageError("reconstruct: the solver particles makes no volume; find_particles finds them")
    bench = of_frames.bench_of(
        weights, chosen, of_frames.given_picture(weights, dark), of_frames.given_picture(weights, mask)
    )
    raw = of_frames.picture_for(weights, image)
    lit = light(raw, bench.dark, of_frames.given_picture(weights, background))
    of_frames.check_frame(bench, raw, IMAGE)
    warn_of(of_frames.frame_notices(bench, raw, lit, IMAGE))
    volume = volume_of(bench, raw, lit, record("reconstruct", chosen.resolved(), {}))
    warn_of(of_frames.haze_notices(volume.attributes, IMAGE))
    return volume


def volume_of(
    bench: Bench, raw: Image, lit: Image, provenance: Mapping[str, Any], progress: Progress | None = None
) -> Volume:
    """Return the volume behind a raw frame, given also with dark or background taken off (`lit`)."""
    unusable = bench.unusable(raw)
    excluded = bench.excluded_with(unusable)
    content = bench.content
    (haze, _), operator = bench.haze_in(lit, unusable), content.weights.padded
    light_of_tracers = lit if haze is None else lit - haze.image
    image = content.weights.prepare(filled(light_of_tracers, unusable))
    if bench.sums is None:
        operator = operator.for_image(as_if_lit(image, excluded))
    sums = bench.sums_without(operator, excluded)
    result = solve(operator, image, bench.settings.solver_settings(), sums=sums, progress=progress)
    reported = (
        content.reference.attributes()
        | {
            "residual": result.residual,
            "excluded_pixels": int(np.count_nonzero(excluded)),
            "support_voxels": result.support_voxels,
        }
        | ({} if haze is None else {"haze_counts": haze.level_counts})
    )
    grid = content.reference.grid_from_focal_point(content.weights.grid)
    array = content.weights.to_world(result.volume)
    return Volume(array, grid, content.reference, attributes=reported, provenance=dict(provenance))


@dataclass(frozen=True)
class Outcome:
    """What is told of a frame: its relative residual, the number of pixels that took no part, and of particles.

    Of these also the size of the tracers, which all frames share: whoever makes a frame knows it.
    """

    residual: float
    excluded_pixels: int
    particles: int | None = None
    tracers: TracerSize | None = None


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(PairOptions, ImageOptions):
    """What `reconstruct` is given besides weights and images.

    Attributes
    ----------
    solver, iterations, relaxation, accelerate, start : in place of the config's, see its section `reconstruction`
    residual : of particles, also write what they leave of each image
    """

    solver: SolverName | None = None
    iterations: int | None = None
    relaxation: float | None = None
    accelerate: bool | None = None
    start: Start | None = None
    residual: bool = True


def reconstruct_files(
    weights: Path,
    images: Sequence[Path],
    output: Path,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Reconstruct the volume behind each image, or find its particles."""
    if options.watch:
        settings = config.carried_config(read_weights_record(weights), weights).overridden_by("reconstruction", options)
        if settings.reconstruction.solver == "particles":
            why = "the tracers' size, which --solver particles needs, is measured first"
            raise UsageError(f"--watch: {why}; run --watch does so")
        options.ensure_one_by_one()
        groups = watched(images, "images", options, options.idle_s, console)
        with atomic.folder_of(output / weights.name):
            return work_as_they_come(
                lambda group: Reconstruction(weights, group, output, options, overwrite), groups, options, console
            )
    return carried_out(Reconstruction(weights, images, output, options, overwrite), options, console)


@dataclass(eq=False, repr=False)
class Reconstruction(Batch[Outcome]):
    """The batch of `reconstruct`: a volume, or particles, for each frame.

    Attributes
    ----------
    pairs, prepared : where these are known already
    only : the numbers of the frames that are to be made, in their order; None: all
    weights_to_come : where the weights are to carry another record before anything is made

    Raises
    ------
    LfpivError : frames or outputs do not go together, or a file cannot be opened
    """

    weights: Path
    images: Sequence[Path]
    output: Path
    options: ReconstructOptions
    overwrite: bool
    pairs: Pairs | None = None
    prepared: Prepared | None = None
    only: Sequence[int] | None = None
    weights_to_come: Gone | None = None
    names: Sequence[str] = field(init=False, default=())
    order: Sequence[int] = field(init=False, default=())
    label, unit = "reconstruct", "frame"

    def __post_init__(self) -> None:
        """See which frames there are, and read no image."""
        options, weights, pairs, to_come = self.options, self.weights, self.pairs, self.weights_to_come
        self._prepared = self.prepared or Prepared()
        # What is complete is skipped: in the place of what is made there is nothing, or something broken.
        self._replace = self.overwrite or options.resume
        self._common = options.files(weights)
        self.inputs = [*self._common.values(), *self.images]
        self._frames = frames = frames_of(self.images, options.keep_going)
        if pairs is None and options.are_told:
            pairs = found_pairs(images_seen(frames), options)
        self.notices = [] if pairs is None else pairs.settled(options.keep_going)
        self._beside = None if pairs is None else pairs.beside(len(frames))
        self._first_of = {} if pairs is None else pairs.first_of()
        self._every = list(range(len(frames))) if pairs is None else pairs.order(len(frames))
        self.order = self._every if self.only is None else self.only
        self.names = [frame.stem for frame in frames]
        self._paths = output_paths(self.output, self.names)
        self._gone = {} if to_come is None else {weights: to_come}
        carried = read_weights_record(weights) if to_come is None else to_come.record
        self._settings = config.carried_config(carried, weights).overridden_by("reconstruction", options)
        solver = self._settings.reconstruction.solver
        self._as_particles = solver == "particles"
        if self._beside is not None and not self._as_particles:
            raise UsageError(f"--pairing: {solver} takes each frame alone; --solver particles does not")
        # Which other frames the background and mask of one are made from.
        self._words = of_frames.other_frames(options.level, frames, options.mask)
        self._resolved = self._settings.resolved()
        self.targets = [Target(path, partial(self._record, number)) for number, path in enumerate(self._paths)]
        with_residuals = self._as_particles and options.residual
        self.beside = [of_frames.residual_path(path) for path in self._paths] if with_residuals else []

    def fault(self, number: int) -> str | None:
        """Return why a frame's file cannot be read."""
        return self._frames[number].fault

    def expected(self) -> Expected:
        """Return the bytes of a volume's voxels and what the solver holds; of particles neither is known."""
        if self._as_particles:
            return Expected()
        path = self._common["weights"]
        weights = self._prepared.weights(path).weights
        voxels, pixels = math.prod(weights.padded.shape), math.prod(weights.image_shape)
        rows = columns_bytes(voxels) if weights.on_demand else hdf5.unpacked_bytes(path)
        return Expected(FLOAT_BYTES * math.prod(weights.shape), held_bytes(voxels, pixels) + rows)

    def begin(self, numbers: Sequence[int], console: Console) -> float:
        """Open the weights, and prepare what all frames share."""
        options, settings, frames = self.options, self._settings, self._frames
        if self._as_particles and options.residual:
            for number in numbers:
                atomic.ensure_writable(of_frames.residual_path(self._paths[number]), self._replace)
            coming = set(numbers)
            complete = [path for number, path in enumerate(self._paths) if number not in coming and path.exists()]
            if without := sum(not of_frames.residual_path(path).exists() for path in complete):
                console.say(f"{without} frames that are complete have no residual image; --overwrite makes both anew")
        if not numbers:
            return 0.0
        prepared, weights = self._prepared, self._common["weights"]
        if self._as_particles:
            content = prepared.searchable(weights, settings)
        else:
            content = prepared.weights(weights)
            voxels = math.prod(content.weights.padded.shape)
            if content.weights.on_demand:
                console.say(
                    f"columns are made on demand: up to {written(voxels * COLUMN_S / 60.0, 2)} minutes of a core for "
                    f"each image, where all {written(voxels)} voxels can be lit"
                )
            # The weights are in memory by now.
            ensure_room(held_bytes(voxels, math.prod(content.image_shape)), self.label)
        bench, read = prepared.reading(content, settings, frames, options, options.keep_going)
        self._size: TracerSize | None = None
        self._said: Sequence[Notice] = ()
        if self._as_particles:
            # What cannot be read is told where its turn comes.
            pictures = of_frames.readable(read, self._every, keep_going=True)
            seen = (particles.frame_of(bench, *each) for each in pictures)
            bench, self._size = particles.sized(bench, seen, prepared.size)
            self._said = size_notices(settings, self._size)
            console.warn(self._said)
        self._bench, self._ahead = bench, ReadAhead(read, numbers)
        self._finder = Finder(bench, read, frames, self._beside, self._first_of, options.keep_going)
        if not self._as_particles:
            return settings.reconstruction.iterations
        looks = numbers if self._beside is None else {k for number in numbers for k in (number, *self._beside[number])}
        return particles.STEPS * len(looks) / len(numbers)

    def make(self, number: int, work: Frames) -> Outcome:
        """Reconstruct a frame, or find its particles, and write them."""
        bench, size, name, target = self._bench, self._size, self.names[number], self.targets[number]
        pictures = self._ahead(number)
        of_frames.check_frame(bench, pictures[0], str(self._frames[number].path))
        made = target.record
        notices = file_notices(made, name) + of_frames.frame_notices(bench, *pictures, name)
        work.console.warn(notices)
        if size is None:
            made = with_warnings(made, notices)
            volume = volume_of(bench, *pictures, made, work.advance)
            array, grid, reference, reported = volume.array, volume.grid, volume.reference, volume.attributes
            of_haze = of_frames.haze_notices(reported, name)
            work.console.warn(of_haze)
            made = with_warnings(made, of_haze)
            vtkhdf.write_volume(
                target.path, array, grid, reference, provenance=made, attributes=reported, overwrite=self._replace
            )
            return Outcome(float(reported["residual"][-1]), reported["excluded_pixels"])
        frame = particles.frame_of(bench, *pictures)
        found, alone = self._finder.find(number, frame, work.advance)
        work.console.warn(alone)
        made = with_warnings(made, [*self._said, *notices, *alone])
        points = particles.points_of(bench, frame, found, size, made)
        of_light = light_notices(points, target.path.name)
        work.console.warn(of_light)
        if self.options.residual:
            left = particles.what_is_left(frame, found)
            # Made again whenever the particles are: an interrupted batch may have left one without them.
            image_files.write_tiff(of_frames.residual_path(target.path), left.astype(np.float32), overwrite=True)
        points = replace(points, provenance=with_warnings(made, of_light))
        write_points(target.path, PARTICLES_FORMAT, points, overwrite=self._replace)
        reported = points.attributes
        return Outcome(reported["residual"], reported["excluded_pixels"], len(points.position_mm), size)

    def summary(self, worked: Worked[Outcome]) -> dict[str, Any]:
        """Return what is told of the batch."""
        outcomes = list(worked.outcomes.values())
        found = [outcome.particles for outcome in outcomes if outcome.particles is not None]
        reported = {
            "frames": worked.total(),
            "reconstructed": len(outcomes),
            "skipped": worked.skipped,
            "solver": self._settings.reconstruction.solver,
            "iterations": None if self._as_particles else self._settings.reconstruction.iterations,
            "residual": max((outcome.residual for outcome in outcomes), default=None),
            "excluded_pixels": max((outcome.excluded_pixels for outcome in outcomes), default=None),
        }
        counts = {"particles": sum(found), "particles_fewest": min(found)} if found else {}
        size = next((outcome.tracers for outcome in outcomes), None)
        return reported | counts | (size.summary() if size else {})

    def _record(self, number: int) -> dict[str, Any]:
        """Return the record that a frame's result will carry."""
        frame = self._frames[number]
        if frame.fault is not None:
            raise InputError(frame.fault)
        command = f"reconstruct page {frame.page}{self._words(number)}"
        for k in () if self._beside is None else self._beside[number]:
            if (beside := self._frames[k]).fault is None:
                command += f", beside page {beside.page}{self._words(k)} of SHA-256 {sha256(beside.path)}"
        inputs = {**self._common, "image": frame.path}
        return record(command, self._resolved, inputs, {"image": frame.time_s}, self._gone)


def file_notices(made: Mapping[str, Any], name: str) -> list[Notice]:
    """Return what is said of a frame whose file was given as something else, too."""
    other = also_used_as(made, "image")
    if other is None:
        return []
    text = f"the file is also the {other}: it shows no tracers"
    return [Notice("frame-given-before", name, text, "leave it out of the images, or correct the other")]
