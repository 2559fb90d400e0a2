"""The stage of `reconstruct`: each image prepared, solved, and its volume or particles written."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, PartialError, UsageError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import Frame, Target, frames_beside, frames_of, output_paths, pending, prepare_folder
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, write_points
from lfpiv_cli.files.provenance import also_used_as, record, with_warnings
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.interface import particles
from lfpiv_cli.interface.reconstruction import Bench, Progress, bench_of, check_frame, frame_notices, volume_of
from lfpiv_cli.interface.weights_cost import on_demand_told
from lfpiv_cli.names import Pairing, Start
from lfpiv_cli.notice import Notice
from lfpiv_cli.particles.search import Particles
from lfpiv_cli.reconstruction.images import Image
from lfpiv_cli.reconstruction.registry import SolverName
from lfpiv_cli.stages.frames import STILL, Background, ahead, mask_of, reader, sequence_digests, with_those_beside

# Reads frame `number`: raw, and with dark or background taken off.
Read = Callable[[int], tuple[Image, Image]]


@dataclass(frozen=True)
class Outcome:
    """What is told of a frame: its relative residual, the number of pixels that took no part, and of particles."""

    residual: float
    excluded_pixels: int
    particles: int | None = None


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """What `reconstruct` is given besides weights and images.

    Attributes
    ----------
    solver, iterations, relaxation, accelerate, start : in place of the config's, see its section `reconstruction`
    dark : image taken with the cap on; its hot and dead pixels are left out
    background : image to subtract, or `minimum` or `mean` over the images, or as `minimum:15`
    mask : image that is black where pixels are left out, or `still`: where bright light does not move in the images
    pairing : `ab` or `sequence`: find particles with the help of the frames beside
    residual : of particles, also write what they leave of each image
    resume : skip what is complete and made from the same inputs
    keep_going : go on with the next frame when one fails
    """

    solver: SolverName | None = None
    iterations: int | None = None
    relaxation: float | None = None
    accelerate: bool | None = None
    start: Start | None = None
    dark: Path | None = None
    background: str | None = None
    mask: str | Path | None = None
    pairing: Pairing | None = None
    residual: bool = True
    resume: bool = False
    keep_going: bool = False


NO_OPTIONS = ReconstructOptions()


def reconstruct(
    weights: Path,
    images: Sequence[Path],
    output: Path,
    options: ReconstructOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Reconstruct the volume behind each image, or find its particles."""
    level = Background.parse(options.background)
    mask_file = None if options.mask is None or options.mask == STILL else Path(options.mask)
    common = given(weights=weights, dark=options.dark, background=level.path, mask=mask_file)
    frames = frames_of(images)
    beside = None if options.pairing is None else frames_beside(len(frames), options.pairing)
    paths = output_paths(output, [frame.stem for frame in frames])
    prepare_folder(paths)
    content = open_weights(weights)
    settings = carried_config(content.provenance, weights).overridden_by("reconstruction", options)
    as_particles = settings.reconstruction.solver == "particles"
    if beside is not None and not as_particles:
        raise UsageError(
            f"--pairing: {settings.reconstruction.solver} takes each frame alone; --solver particles does not"
        )
    made_of = sequence_digests(level, frames, options.mask)
    if beside is not None:
        made_of = with_those_beside(made_of, frames, beside)
    targets = _targets(paths, frames, made_of, settings, common)
    needed = pending(targets, [*common.values(), *images], overwrite, options.resume, vtkhdf.read_record)
    if as_particles:
        content = particles.searchable(content, settings)
        if options.residual:
            _ensure_residuals(paths, needed, overwrite or options.resume, images, console)
    elif content.weights.on_demand and needed:
        console.say(on_demand_told(math.prod(content.weights.padded.shape)))
    shape = content.image_shape
    dark = image_files.read_image(options.dark, shape) if options.dark else None
    pitch_px = float(content.camera.micro_image_lattice_px().pitch.max())
    # What stands still takes a look at every frame: only where there is one to reconstruct.
    mask = mask_of(options.mask, frames, shape, pitch_px) if needed or mask_file else None
    bench = bench_of(content, settings, dark, mask, with_sums=bool(needed))
    read = reader(level, frames, shape, dark)
    steps = particles.STEPS if as_particles else settings.reconstruction.iterations
    outcomes: list[Outcome] = []
    failures: list[str] = []
    looked_at = needed if beside is None else {k for number in needed for k in (number, *beside[number])}
    size = None
    if as_particles and needed:
        bench, size = particles.sized(bench, _frames(bench, read, len(frames)))
        said = particles.size_notices(settings, size)
        console.warn(said)
        targets = [replace(target, record=with_warnings(target.record, said)) for target in targets]
    with console.frames(len(needed), steps * len(looked_at) / max(len(needed), 1), "reconstruct") as work:
        find = _finder(bench, read, beside, options.pairing, work.advance)
        for number, future in ahead(read, needed):
            try:
                pictures, target = future.result(), targets[number]
                check_frame(bench, pictures[0], str(frames[number].path))
                stem = frames[number].stem
                notices = file_notices(target.record, stem) + frame_notices(bench, *pictures, stem)
                console.warn(notices)
                target = replace(target, record=with_warnings(target.record, notices))
                if size is not None:
                    frame = particles.frame_of(bench, *pictures)
                    made = (frame, find(number, frame), size)
                    outcomes.append(_write_particles(bench, target, made, options.residual, overwrite, console))
                else:
                    outcomes.append(_make_volume(bench, target, pictures, overwrite, work.advance))
            except InputError as error:
                if not options.keep_going:
                    raise
                failures.append(str(error))
                console.warn([Notice("frame-failed", frames[number].stem, str(error), "leave it out, or mend it")])
            work.done(frames[number].stem)
    if failures:
        raise PartialError(f"{len(failures)} of {len(frames)} frames failed, the first because {failures[0]}")
    found = [outcome.particles for outcome in outcomes if outcome.particles is not None]
    counts = {"particles": sum(found), "particles_fewest": min(found)} if found else {}
    return (
        {
            "frames": len(frames),
            "reconstructed": len(outcomes),
            "skipped": len(frames) - len(needed),
            "solver": settings.reconstruction.solver,
            "iterations": None if as_particles else settings.reconstruction.iterations,
            "residual": max((outcome.residual for outcome in outcomes), default=None),
            "excluded_pixels": max((outcome.excluded_pixels for outcome in outcomes), default=None),
        }
        | counts
        | (size.summary() if size else {})
    )


def _frames(bench: Bench, read: Read, number: int) -> Iterator[particles.Frame]:
    """Yield the frames that can be read."""
    for k in range(number):
        try:
            pictures = read(k)
        except InputError:
            continue  # it is told where its turn comes
        yield particles.frame_of(bench, *pictures)


def _targets(
    paths: Sequence[Path],
    frames: Sequence[Frame],
    made_of: Sequence[str],
    settings: Config,
    common: Mapping[str, Path],
) -> list[Target]:
    """Return where each frame's result goes and the record that it will carry, with words of other frames."""
    return [
        Target(
            path, record(f"reconstruct page {frame.page}{words}", settings.resolved(), {**common, "image": frame.path})
        )
        for path, frame, words in zip(paths, frames, made_of, strict=True)
    ]


def file_notices(made: Mapping[str, Any], name: str) -> list[Notice]:
    """Return what is said of a frame whose file was given as something else, too."""
    other = also_used_as(made, "image")
    if other is None:
        return []
    text = f"the file is also the {other}: it shows no tracers"
    return [Notice("frame-given-before", name, text, "leave it out of the images, or correct the other")]


def residual_path(particles: Path) -> Path:
    """Return where the residual image of a file of particles goes."""
    return particles.with_name(f"{particles.stem}_residual.tif")


def _ensure_residuals(
    paths: Sequence[Path], needed: Sequence[int], overwrite: bool, images: Sequence[Path], console: Console
) -> None:
    """Refuse residual images that could not be written; say of which frames that are complete there is none."""
    for number in needed:
        ensure_writable(residual_path(paths[number]), overwrite, images)
    without = sum(not residual_path(path).exists() for number, path in enumerate(paths) if number not in needed)
    if without:
        console.say(f"{without} frames that are complete have no residual image; --overwrite makes both anew")


def _make_volume(
    bench: Bench, target: Target, frame: tuple[Image, Image], overwrite: bool, advance: Progress
) -> Outcome:
    """Reconstruct and write the volume of a frame."""
    volume = volume_of(bench, *frame, target.record, advance)
    told = volume.attributes
    vtkhdf.write_volume(
        target.path,
        volume.array,
        volume.grid,
        volume.reference,
        provenance=target.record,
        attributes=told,
        overwrite=overwrite,
    )
    return Outcome(float(told["residual"][-1]), told["excluded_pixels"])


def _write_particles(
    bench: Bench,
    target: Target,
    made: tuple[particles.Frame, Particles, particles.TracerSize],
    residual: bool,
    overwrite: bool,
    console: Console,
) -> Outcome:
    """Write the particles found behind a frame and, where it is asked for, what they leave of it."""
    frame, found, size = made
    points = particles.points_of(bench, frame, found, size, target.record)
    notices = particles.light_notices(points, target.path.name)
    console.warn(notices)
    if residual:
        left = particles.what_is_left(frame, found)
        # Made again whenever the particles are: an interrupted batch may have left one without them.
        image_files.write_tiff(residual_path(target.path), left.astype(np.float32), overwrite=True)
    told = replace(points, provenance=with_warnings(target.record, notices))
    write_points(target.path, PARTICLES_FORMAT, told, overwrite=overwrite)
    return Outcome(points.attributes["residual"], points.attributes["excluded_pixels"], len(points.position_mm))


def _finder(
    bench: Bench,
    read: Read,
    beside: Sequence[tuple[int, ...]] | None,
    pairing: Pairing | None,
    advance: Progress,
) -> Callable[[int, particles.Frame], Particles]:
    """Return the function that finds the particles of a frame, alone or with the first passes of those beside it.

    That of the second frame of a pair begins with what the first frame's found, never the other way round: so it does
    not matter which frames are there already.
    """

    # A frame needs itself and one at either side, the next one two of these again.
    @lru_cache(maxsize=3)
    def first_pass_of(number: int) -> NDArray[np.float64]:
        frame = particles.frame_of(bench, *read(number))
        if pairing != "ab" or number % 2 == 0:
            return particles.find_first(bench, frame, advance)
        before = particles.frame_of(bench, *read(number - 1))
        return particles.find_second(bench, frame, before, first_pass_of(number - 1), advance)

    def find(number: int, frame: particles.Frame) -> Particles:
        if beside is None:
            return particles.find(bench, frame, advance)
        seen = {k: first_pass_of(k) for k in sorted((number, *beside[number]))}
        return particles.find_beside(bench, frame, seen[number], [seen[k] for k in beside[number]])

    return find
