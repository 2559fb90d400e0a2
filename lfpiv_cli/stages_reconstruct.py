"""The stage of `reconstruct`: each image prepared, solved, and its volume or particles written."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli import stages_particles
from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, PartialError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import Frame, Target, frames_of, output_paths, pending, prepare_folder
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record, sha256
from lfpiv_cli.files.sections import ReconstructionSection
from lfpiv_cli.files.weights_file import WeightsFile, read_weights
from lfpiv_cli.reconstruction.equations import Normalisers, normalisers
from lfpiv_cli.reconstruction.images import (
    Image,
    Mask,
    as_if_lit,
    defects,
    filled,
    light,
    mean_background,
    minimum_background,
    noise_residual,
    saturated,
    touched,
)
from lfpiv_cli.reconstruction.solvers import Reconstruction, Stopping
from lfpiv_cli.reconstruction.solvers import reconstruct as solve

BACKGROUNDS = {"minimum": minimum_background, "mean": mean_background}


@dataclass(frozen=True)
class Background:
    """What is subtracted as background: an image, or the minimum or mean over the frames, or over some around each.

    Attributes
    ----------
    path : of the image, None where it is made from the frames
    kind : name in `BACKGROUNDS`
    frames : how many around each frame; None: all of them
    """

    path: Path | None = None
    kind: str | None = None
    frames: int | None = None

    @classmethod
    def parse(cls, text: str | None) -> Background:
        """Return the background given as a file's name, `minimum`, `mean`, or `minimum:15` for fifteen frames."""
        if text is None:
            return cls()
        over_frames = re.fullmatch(rf"({'|'.join(BACKGROUNDS)})(?::(\d+))?", text)
        if over_frames is None:
            return cls(path=Path(text))
        kind, count = over_frames.groups()
        return cls(kind=kind, frames=None if count is None else int(count))

    def around(self, number: int, total: int) -> range:
        """Return the numbers of the frames, of `total`, that the background of one is made from."""
        if self.kind is None:
            return range(0)
        count = total if self.frames is None else min(self.frames, total)
        first = min(max(number - count // 2, 0), total - count)
        return range(first, first + count)


@dataclass(frozen=True, eq=False)
class Bench:
    """What all frames of a batch share.

    Attributes
    ----------
    dark : dark image (rows, columns) or None
    lasting : raw pixels that are never believed: defects of the dark image, and where the mask is black
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


def reconstruct(
    weights: Path,
    images: Sequence[Path],
    solver: str | None,
    iterations: int | None,
    relaxation: float | None,
    accelerate: bool | None,
    start: str | None,
    dark: Path | None,
    background: str | None,
    mask: Path | None,
    resume: bool,
    keep_going: bool,
    output: Path,
    overwrite: bool,
    console: Console,
) -> dict[str, Any]:
    """Reconstruct the volume behind each image."""
    level = Background.parse(background)
    common = given(weights=weights, dark=dark, background=level.path, mask=mask)
    frames = frames_of(images)
    paths = output_paths(output, [frame.stem for frame in frames])
    prepare_folder(paths)
    content = read_weights(weights)
    settings = carried_config(content.provenance, weights).overridden(
        "reconstruction",
        solver=solver,
        iterations=iterations,
        relaxation=relaxation,
        accelerate=accelerate,
        start=start,
    )
    targets = _targets(paths, frames, level, settings, common)
    needed = pending(targets, [*common.values(), *images], overwrite, resume, _record_of)
    as_particles = settings.reconstruction.solver == "particles"
    if as_particles:
        content = stages_particles.searchable(content, settings)
        for number in needed:
            ensure_writable(stages_particles.residual_path(paths[number]), overwrite or resume, images)
    bench = _bench(content, settings, dark, mask, bool(needed))
    read = _reader(level, frames, bench)
    steps = stages_particles.STEPS if as_particles else settings.reconstruction.iterations
    outcomes: list[Outcome] = []
    failures: list[str] = []
    with console.progress(len(needed) * steps, "reconstruct") as advance:
        for number, future in _ahead(read, needed):
            try:
                raw, lit = future.result()
                outcomes.append(_make(bench, targets[number], raw, lit, overwrite, advance))
            except InputError as error:
                if not keep_going:
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
    paths: Sequence[Path], frames: Sequence[Frame], level: Background, settings: Config, common: Mapping[str, Path]
) -> list[Target]:
    """Return where each frame's result goes and the record that it will carry."""
    made_of = _sequence_digests(level, frames)
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
    bench: Bench, target: Target, raw: Image, lit: Image, overwrite: bool, advance: Callable[[int], None]
) -> Outcome:
    """Make and write the particles or the volume of a frame."""
    unusable = bench.lasting | saturated(raw, bench.settings.reconstruction.saturation_counts)
    lit = filled(lit, unusable)
    excluded = _excluded(bench, unusable)
    if bench.sums is not None and bench.settings.reconstruction.solver == "particles":
        frame = stages_particles.Frame(lit, unusable, _sums_without(bench, bench.sums, excluded))
        residual = stages_particles.write_frame(
            bench.content, bench.settings, frame, target.path, target.record, overwrite, advance
        )
        return Outcome(residual, int(np.count_nonzero(unusable)))
    result = _solved(bench, bench.content.weights.prepare(lit), excluded, advance)
    outcome = Outcome(float(result.residual[-1]), int(np.count_nonzero(excluded)))
    _write(target, bench.content, result, outcome.excluded_pixels, overwrite)
    return outcome


def _excluded(bench: Bench, unusable: Mask) -> Mask:
    """Return which pixels in the weights' frame take no part in a frame whose raw pixels are partly unusable."""
    too_bright = unusable & ~bench.lasting
    return bench.excluded | touched(too_bright, bench.content.weights.prepare) if too_bright.any() else bench.excluded


def _sums_without(bench: Bench, sums: Normalisers, excluded: Mask) -> Normalisers:
    """Return the sums that all frames share, with what only this one excludes left out."""
    return sums if excluded is bench.excluded else sums.without(bench.content.weights.padded, excluded)


def _solved(bench: Bench, image: Image, excluded: Mask, advance: Callable[[int], None]) -> Reconstruction:
    """Return the reconstruction of an image in the weights' frame."""
    operator, sums = bench.content.weights.padded, bench.sums
    if sums is None:
        operator = operator.for_image(as_if_lit(image, excluded))
        sums = normalisers(operator, excluded)
    else:
        sums = _sums_without(bench, sums, excluded)
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
    grid = content.weights.grid
    x, y, z = grid.origin_mm
    vtkhdf.write_volume(
        target.path,
        content.weights.to_world(result.volume),
        # in the coordinates of files, whose z counts from the reference
        replace(grid, origin_mm=(x, y, z - content.reference_z_mm)),
        provenance=target.record,
        attributes={
            "reference": content.reference,
            "reference_z_mm": content.reference_z_mm,
            "residual": result.residual,
            "excluded_pixels": excluded,
            "support_voxels": result.support_voxels,
        },
        overwrite=overwrite,
    )


def _reader(level: Background, frames: Sequence[Frame], bench: Bench) -> Callable[[int], tuple[Image, Image]]:
    """Return the function that reads frame `number`: raw, and with dark or background taken off."""
    shape = bench.content.weights.image_shape
    fixed = image_files.read_image(level.path, shape) if level.path else None
    window = len(level.around(0, len(frames)))

    @lru_cache(maxsize=window if level.frames else 1)
    def page(number: int) -> Image:
        return image_files.read_page(frames[number].path, frames[number].page, shape)

    @lru_cache(maxsize=1)
    def over(numbers: range) -> NDArray[np.float32]:
        return BACKGROUNDS[level.kind or ""](page(k) for k in numbers)

    def read(number: int) -> tuple[Image, Image]:
        numbers = level.around(number, len(frames))
        raw = page(number)
        return raw, light(raw, bench.dark, over(numbers) if level.kind else fixed)

    return read


def _ahead(
    read: Callable[[int], tuple[Image, Image]], numbers: Sequence[int]
) -> Iterator[tuple[int, Future[tuple[Image, Image]]]]:
    """Yield each number with its frame, read while the one before is worked on."""
    with ThreadPoolExecutor(max_workers=1) as pool:
        coming = [pool.submit(read, number) for number in numbers[:1]]
        for place, number in enumerate(numbers):
            current = coming.pop()
            coming = [pool.submit(read, following) for following in numbers[place + 1 : place + 2]]
            yield number, current


def _sequence_digests(level: Background, frames: Sequence[Frame]) -> list[str]:
    """Return for each frame which other frames its background is made from, as words for its record."""
    if level.kind is None:
        return [""] * len(frames)
    pages = [f"{sha256(frame.path)} {frame.page}\n" for frame in frames]
    words = []
    for number in range(len(frames)):
        numbers = level.around(number, len(frames))
        digest = hashlib.sha256("".join(pages[k] for k in numbers).encode()).hexdigest()
        words.append(f", background: {level.kind} over {len(numbers)} frames, SHA-256 {digest}")
    return words
