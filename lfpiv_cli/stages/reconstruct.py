"""The stage of `reconstruct`: each image prepared, solved, and its volume or particles written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.sections import ReconstructionSection
from lfpiv_cli.files.weights_file import WeightsFile, read_weights
from lfpiv_cli.names import Pairing, Start
from lfpiv_cli.particles.search import Particles
from lfpiv_cli.reconstruction.equations import Normalisers, Operator, normalisers
from lfpiv_cli.reconstruction.images import (
    Image,
    Mask,
    as_if_lit,
    defects,
    filled,
    noise_residual,
    saturated,
    touched,
)
from lfpiv_cli.reconstruction.registry import SolverName
from lfpiv_cli.reconstruction.solvers import Reconstruction, Stopping
from lfpiv_cli.reconstruction.solvers import reconstruct as solve
from lfpiv_cli.stages import particles
from lfpiv_cli.stages.frames import Background, ahead, reader, sequence_digests, with_those_beside

# Finds the particles of frame `number`.
Find = Callable[[int, particles.Frame], Particles]


@dataclass(frozen=True, eq=False)
class Bench:
    """What all frames of a batch share.

    Attributes
    ----------
    dark : dark image (rows, columns) or None
    lasting : raw pixels that are never usable: defects of the dark image, and where the mask is black
    excluded : pixels in the weights' frame that never take part: off the sensor, or touched by `lasting`
    sums : of the weights without `excluded`; None where weights are made for each image
    """

    content: WeightsFile
    settings: Config
    dark: Image | None
    lasting: Mask
    excluded: Mask
    sums: Normalisers | None


@dataclass(frozen=True)
class Outcome:
    """What is told of a frame: its relative residual, and how many of its pixels took no part."""

    residual: float
    excluded_pixels: int


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """What `reconstruct` is given besides weights and images.

    Attributes
    ----------
    solver, iterations, relaxation, accelerate, start : in place of the config's, see its section `reconstruction`
    dark : image taken with the cap on; its hot and dead pixels are left out
    background : image to subtract, or `minimum` or `mean` over the images, or as `minimum:15`
    mask : image that is black where pixels are left out
    pairing : `ab` or `sequence`: find particles with the help of the frames beside
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
    mask: Path | None = None
    pairing: Pairing | None = None
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
    common = given(weights=weights, dark=options.dark, background=level.path, mask=options.mask)
    frames = frames_of(images)
    beside = None if options.pairing is None else frames_beside(len(frames), options.pairing)
    paths = output_paths(output, [frame.stem for frame in frames])
    prepare_folder(paths)
    content = read_weights(weights)
    settings = carried_config(content.provenance, weights).overridden_by("reconstruction", options)
    as_particles = settings.reconstruction.solver == "particles"
    if beside is not None and not as_particles:
        raise UsageError(
            f"--pairing: {settings.reconstruction.solver} takes each frame alone; --solver particles does not"
        )
    targets = _targets(paths, frames, level, settings, common, beside)
    needed = pending(targets, [*common.values(), *images], overwrite, options.resume, _record_of)
    if as_particles:
        content = particles.searchable(content, settings)
        for number in needed:
            ensure_writable(particles.residual_path(paths[number]), overwrite or options.resume, images)
    bench = _bench(content, settings, options.dark, options.mask, bool(needed))
    read = reader(level, frames, content.weights.image_shape, bench.dark)
    steps = particles.STEPS if as_particles else settings.reconstruction.iterations
    outcomes: list[Outcome] = []
    failures: list[str] = []
    looked_at = needed if beside is None else {k for number in needed for k in (number, *beside[number])}
    with console.progress(len(looked_at) * steps, "reconstruct") as advance:
        find = _finder(bench, read, beside, advance)
        for number, future in ahead(read, needed):
            try:
                raw, lit = future.result()
                outcomes.append(_make(bench, targets[number], number, raw, lit, find, overwrite, advance))
            except InputError as error:
                if not options.keep_going:
                    raise
                failures.append(str(error))
                console.say(f"lfpiv: {error}")
    if failures:
        raise PartialError(f"{len(failures)} of {len(frames)} frames failed, the first because {failures[0]}")
    return {
        "frames": len(frames),
        "reconstructed": len(outcomes),
        "skipped": len(frames) - len(needed),
        "solver": settings.reconstruction.solver,
        "iterations": None if as_particles else settings.reconstruction.iterations,
        "residual": max((outcome.residual for outcome in outcomes), default=None),
        "excluded_pixels": max((outcome.excluded_pixels for outcome in outcomes), default=None),
    }


def _targets(
    paths: Sequence[Path],
    frames: Sequence[Frame],
    level: Background,
    settings: Config,
    common: Mapping[str, Path],
    beside: Sequence[tuple[int, ...]] | None,
) -> list[Target]:
    """Return where each frame's result goes and the record that it will carry."""
    made_of = sequence_digests(level, frames)
    if beside is not None:
        made_of = with_those_beside(made_of, frames, beside)
    return [
        Target(
            path, record(f"reconstruct page {frame.page}{words}", settings.resolved(), {**common, "image": frame.path})
        )
        for path, frame, words in zip(paths, frames, made_of, strict=True)
    ]


def _record_of(path: Path) -> dict[str, Any]:
    return vtkhdf.read_header(path).provenance


def _bench(content: WeightsFile, settings: Config, dark: Path | None, mask: Path | None, needed: bool) -> Bench:
    """Return what all frames share."""
    weights = content.weights
    shape = weights.image_shape
    dark_image = image_files.read_image(dark, shape) if dark else None
    lasting = np.zeros(shape, np.bool_) if dark_image is None else defects(dark_image)
    if mask is not None:
        lasting |= image_files.read_image(mask, shape) == 0.0
    excluded = touched(lasting, weights.prepare) if lasting.any() else np.zeros(shape, np.bool_)
    if weights.calibration is not None:
        excluded |= ~weights.calibration.rectification.inside
    sums = normalisers(weights.padded, excluded) if needed and not weights.on_demand else None
    return Bench(content, settings, dark_image, lasting, excluded, sums)


def _make(
    bench: Bench,
    target: Target,
    number: int,
    raw: Image,
    lit: Image,
    find: Find,
    overwrite: bool,
    advance: Callable[[int], None],
) -> Outcome:
    """Make and write the particles or the volume of a frame."""
    if bench.settings.reconstruction.solver == "particles":
        frame = _particle_frame(bench, raw, lit)
        residual = particles.write_frame(
            bench.content, bench.settings, frame, find(number, frame), target.path, target.record, overwrite
        )
        return Outcome(residual, int(np.count_nonzero(frame.unusable)))
    lit, _, excluded = _usable(bench, raw, lit)
    result = _solved(bench, bench.content.weights.prepare(lit), excluded, advance)
    outcome = Outcome(float(result.residual[-1]), int(np.count_nonzero(excluded)))
    _write(target, bench.content, result, outcome.excluded_pixels, overwrite)
    return outcome


def _usable(bench: Bench, raw: Image, lit: Image) -> tuple[Image, Mask, Mask]:
    """Return a frame with its unusable pixels filled, these, and what takes no part in the weights' frame."""
    unusable = bench.lasting | saturated(raw, bench.settings.reconstruction.saturation_counts)
    return filled(lit, unusable), unusable, _excluded(bench, unusable)


def _particle_frame(bench: Bench, raw: Image, lit: Image) -> particles.Frame:
    """Return a frame as particles are sought in it."""
    lit, unusable, excluded = _usable(bench, raw, lit)
    return particles.Frame(lit, unusable, _sums_without(bench, bench.content.weights.padded, excluded))


def _finder(
    bench: Bench,
    read: Callable[[int], tuple[Image, Image]],
    beside: Sequence[tuple[int, ...]] | None,
    advance: Callable[[int], None],
) -> Find:
    """Return the function that finds the particles of a frame, alone or with the first passes of those beside it."""
    content, settings = bench.content, bench.settings

    # A frame needs itself and one at either side, the next one two of these again.
    @lru_cache(maxsize=3)
    def first_pass_of(number: int) -> NDArray[np.float64]:
        return particles.find_first(content, settings, _particle_frame(bench, *read(number)), advance)

    def find(number: int, frame: particles.Frame) -> Particles:
        if beside is None:
            return particles.find(content, settings, frame, advance)
        seen = {k: first_pass_of(k) for k in sorted((number, *beside[number]))}
        return particles.find_beside(content, settings, frame, seen[number], [seen[k] for k in beside[number]])

    return find


def _excluded(bench: Bench, unusable: Mask) -> Mask:
    """Return which pixels in the weights' frame take no part in a frame whose raw pixels are partly unusable."""
    too_bright = unusable & ~bench.lasting
    return bench.excluded | touched(too_bright, bench.content.weights.prepare) if too_bright.any() else bench.excluded


def _sums_without(bench: Bench, operator: Operator, excluded: Mask) -> Normalisers:
    """Return an operator's sums without what a frame excludes: from those that all frames share, if they do."""
    if bench.sums is None:
        return normalisers(operator, excluded)
    return bench.sums if excluded is bench.excluded else bench.sums.without(operator, excluded)


def _solved(bench: Bench, image: Image, excluded: Mask, advance: Callable[[int], None]) -> Reconstruction:
    """Return the reconstruction of an image in the weights' frame."""
    operator = bench.content.weights.padded
    if bench.sums is None:
        operator = operator.for_image(as_if_lit(image, excluded))
    sums = _sums_without(bench, operator, excluded)
    chosen = bench.settings.reconstruction
    return solve(
        operator,
        image,
        chosen.solver,
        chosen.iterations,
        chosen.relaxation,
        chosen.accelerate,
        sums,
        advance,
        chosen.start,
        Stopping(chosen.stop_change, _noise_limit(chosen, image)),
    )


def _noise_limit(chosen: ReconstructionSection, image: Image) -> float | None:
    """Return the relative residual at which what remains is noise, None where noise does not end the iterations."""
    return None if chosen.stop_noise is None else chosen.stop_noise * noise_residual(image, chosen.photons_per_count)


def _write(target: Target, content: WeightsFile, result: Reconstruction, excluded: int, overwrite: bool) -> None:
    vtkhdf.write_volume(
        target.path,
        content.weights.to_world(result.volume),
        content.reference.grid_from_focal_point(content.weights.grid),
        content.reference,
        provenance=target.record,
        attributes={
            "residual": result.residual,
            "excluded_pixels": excluded,
            "support_voxels": result.support_voxels,
        },
        overwrite=overwrite,
    )
