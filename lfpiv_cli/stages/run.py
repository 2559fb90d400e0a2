"""The stage of `run`: from raw images to vectors, by the stages of the single commands.

In the output folder: `calibration.h5`, `calibration.png`, `weights.h5`; by volumes `volumes/STEM.vtkhdf` and
`vectors.vtkhdf`; by particles `particles/STEM.vtkhdf`, `tracks.vtkhdf` and `tracks_grid.vtkhdf`; of both together
`combined.vtkhdf`; of several pairs the folders `vectors`, `tracks` and `combined`. `run.json` says what was chosen,
why, and what each step told; `report.html` shows all of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError, UsageError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.atomic import without_nan
from lfpiv_cli.files.batch import VTKHDF_SUFFIX, Frame, frames_of, output_paths, prepare_folder
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.inputs import ensure_regular_file, split_part
from lfpiv_cli.files.pages import ensure_pages
from lfpiv_cli.files.pictures import ensure_drawing
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.flow.field import REJECTED, VALID, VectorField
from lfpiv_cli.interface import particles
from lfpiv_cli.interface.calibration import ensure_pictures
from lfpiv_cli.interface.following import SHORTEST, ensure_sequence
from lfpiv_cli.interface.reconstruction import bench_of
from lfpiv_cli.interface.vectors_checks import quality_of, quality_of_all
from lfpiv_cli.names import FlowMethod, Pairing, RunMethod
from lfpiv_cli.stages.build_weights import BuildWeightsOptions, build_weights
from lfpiv_cli.stages.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.stages.combine import combine_vectors
from lfpiv_cli.stages.correlate import CorrelateOptions, correlate
from lfpiv_cli.stages.follow import PLAYBACK, TRACKS, FollowOptions, follow_particles
from lfpiv_cli.stages.frames import STILL, Background, mask_of, reader
from lfpiv_cli.stages.pairs import PairOptions, image_pairs
from lfpiv_cli.stages.reconstruct import ReconstructOptions, reconstruct
from lfpiv_cli.stages.report import ReportOptions, report
from lfpiv_cli.stages.steps import KEPT, MADE, RECORD, Steps, earlier_run
from lfpiv_cli.stages.track import TrackOptions, grid_paths, track_particles

REPORT = "report.html"

# Vectors by particles err less than those by volumes up to 1.9 tracers for each microlens, and more from 2.4 on, in the
# laminar channel of the paper.
MOST_FOR_PARTICLES = 2.0
# A range of displacements leaves out so many percent at either end, where a few are false.
LEFT_OUT_PERCENT = 5.0


@dataclass(frozen=True, kw_only=True)
class RunOptions(PairOptions):
    """What `run` is given besides the config.

    Attributes
    ----------
    images : of the flow
    white, dark, board, depth_mm : as of `calibrate_snapshot`; the dark image also of the flow
    background, mask : as of `reconstruct`
    method : by volumes, particles or both; `auto`: by how many tracers there are
    dt_s : time from one image to the next, in place of the config's
    combine : of both methods, also one field that weights their vectors by their uncertainties
    follow : find and track the particles of a time-resolved sequence together, as `follow_particles` does
    report : make the page of all that the folder holds, too
    """

    images: Sequence[Path]
    white: Sequence[Path] = ()
    dark: Path | None = None
    board: Sequence[Path] = ()
    depth_mm: Sequence[float] = ()
    background: str | None = None
    mask: str | Path | None = None
    method: RunMethod = "auto"
    dt_s: float | None = None
    combine: bool = False
    follow: bool = False
    report: bool = True


@dataclass(frozen=True)
class Choice:
    """By which methods a flow is measured, and why; the tracers for each microlens where they were counted."""

    methods: tuple[FlowMethod, ...]
    reason: str
    tracers_per_lens: float | None = None

    def told(self) -> dict[str, Any]:
        """Return what is told of it."""
        method = self.methods[0] if len(self.methods) == 1 else "both"
        return {"method": method, "reason": self.reason, "tracers_per_lens": self.tracers_per_lens}


def run(
    config: Path, output: Path, options: RunOptions, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Calibrate, build the weights, and measure the flow in images; what is complete and made alike is kept."""
    settings = load_config(config)
    frames = _ensure_possible(settings, options)
    prepare_folder([output / RECORD])
    steps = Steps(output, console, earlier_run(output, overwrite))
    chain = _Chain(config, options, frames, steps, overwrite)
    weights = chain.weights()
    choice = _chosen(settings, options, weights, frames)
    console.say(f"by {' and '.join(choice.methods)}: {choice.reason}")
    steps.told.update(choice.told())
    fields: dict[str, list[Path]] = {method: chain.vectors_by(method, weights) for method in choice.methods}
    if options.combine:
        fields["combined"] = chain.combined(fields["volumes"], fields["particles"])
    figures = _figures(fields)
    steps.told["figures"] = figures
    told = choice.told() | figures
    if options.report:
        told |= {"verdict": chain.report().get("verdict"), "report": str(output / REPORT)}
    steps.write(whole=True)
    return told | {"steps_made": steps.count(MADE), "steps_kept": steps.count(KEPT), "folder": str(output)}


def _ensure_possible(settings: Config, options: RunOptions) -> list[Frame]:
    """Return the frames of the flow, after all that can be known to be wrong has been asked for."""
    _ensure_settings(settings, options)
    _ensure_methods(settings, options)
    ensure_drawing()
    if options.report:
        ensure_pages()
    ensure_pictures(len(options.white), len(options.board), len(options.depth_mm))
    background = Background.parse(options.background).path
    for path in (*options.white, *options.board, *filter(None, (options.dark, background))):
        ensure_regular_file(split_part(path)[0])
    frames = frames_of(options.images)
    if options.follow:
        ensure_sequence(len(frames), SHORTEST)
    else:
        image_pairs(frames, options).settled(keep_going=False)
    output_paths(Path(), [frame.stem for frame in frames])
    image_files.read_page(frames[0].path, frames[0].page, settings.image_shape())
    return frames


def _pairing(options: RunOptions) -> Pairing:
    return "sequence" if options.follow else options.pairing or "ab"


def _ensure_settings(settings: Config, options: RunOptions) -> None:
    """Raise where the config lacks what a later step needs."""
    if options.dt_s is None and settings.correlation.dt_s is None:
        raise ConfigError(
            f"{settings.source}: correlation.dt_s: is missing, and velocities need it; give it there, or --dt-s"
        )
    settings.camera_model()
    settings.grid()
    if options.board:
        settings.rig()
    if settings.weights.method != "dlfc" and settings.channel is None:
        settings.object_space()


def _ensure_methods(settings: Config, options: RunOptions) -> None:
    """Raise where the methods that are asked for contradict the config or other options."""
    by_volumes, by_particles = (options.method in (method, "both") for method in ("volumes", "particles"))
    if options.combine and options.method != "both":
        raise UsageError("--combine needs --method both")
    if options.follow and options.method == "volumes":
        raise UsageError("--follow finds particles, but --method is volumes")
    if options.follow and options.combine:
        raise UsageError("--follow gives tracks, and --combine needs vectors")
    if by_volumes and settings.reconstruction.solver == "particles":
        raise ConfigError(f"{settings.source}: reconstruction.solver: is particles; volumes need another one")
    if settings.weights.method == "dlfc" and (options.follow or by_particles):
        raise ConfigError(f"{settings.source}: weights.method: is dlfc, but particles are fitted with traced rays")


def _chosen(settings: Config, options: RunOptions, weights: Path, frames: Sequence[Frame]) -> Choice:
    """Return by which methods the flow is measured: those asked for, or what errs less with so many tracers."""
    if settings.weights.method == "dlfc":
        return Choice(("volumes",), "weights.method is dlfc, whose fitted rays particles cannot be fitted with")
    count = _tracers_per_lens(settings, options, weights, frames)
    asked: FlowMethod | None = "particles" if options.follow else None
    if options.method == "both":
        return Choice(("volumes", "particles"), "as --method asks for", count)
    if options.method != "auto":
        asked = options.method
    elif settings.reconstruction.solver == "particles":
        return Choice(("particles",), "reconstruction.solver is particles", count)
    if count is None:
        return Choice((asked or "particles",), "too little is seen of the volume to count tracers by their light")
    better: FlowMethod = "particles" if count <= MOST_FOR_PARTICLES else "volumes"
    side = "up to" if better == "particles" else "beyond"
    reason = f"{count:.2g} tracers for each microlens, and {better} err less {side} about {MOST_FOR_PARTICLES:g}"
    if asked is None or asked == better:
        return Choice((better,), reason, count)
    return Choice((asked,), f"as asked for; but there are {reason}", count)


def _tracers_per_lens(settings: Config, options: RunOptions, weights: Path, frames: Sequence[Frame]) -> float | None:
    """Return how many tracers for each microlens the first image holds."""
    content = particles.searchable(open_weights(weights), settings)
    shape, level = content.image_shape, Background.parse(options.background)
    dark = image_files.read_reference(options.dark, shape) if options.dark else None
    # What stands still would take a look at every image, and a pair hardly shows it better than one counts without.
    mask = None if options.mask == STILL else mask_of(options.mask, frames, shape, 0.0)
    bench = bench_of(content, settings, dark, mask)
    return particles.tracers_per_lens(bench, particles.frame_of(bench, *reader(level, frames, shape, dark)(0)))


@dataclass(frozen=True)
class _Chain:
    """The stages, as the options of a run have them."""

    config: Path
    options: RunOptions
    frames: Sequence[Frame]
    steps: Steps
    overwrite: bool

    @property
    def common(self) -> dict[str, Any]:
        """What every stage is given."""
        return {"overwrite": self.overwrite, "console": self.steps.console}

    def weights(self) -> Path:
        """Calibrate and build the weights; return their file."""
        options, output = self.options, self.steps.output
        calibration, weights, picture = (output / name for name in ("calibration.h5", "weights.h5", "calibration.png"))
        photographs = CalibrateOptions(
            white=options.white,
            dark=options.dark,
            board=options.board,
            depth_mm=options.depth_mm,
            picture=picture,
            resume=True,
        )
        made_with = BuildWeightsOptions(calibration=calibration, resume=True)
        self.steps.take(
            "calibrate-snapshot",
            [calibration, picture],
            lambda: calibrate_snapshot(self.config, calibration, photographs, **self.common),
        )
        self.steps.take(
            "build-weights", [weights], lambda: build_weights(self.config, weights, made_with, **self.common)
        )
        return weights

    def vectors_by(self, method: FlowMethod, weights: Path) -> list[Path]:
        """Measure the flow by volumes or by particles; return the files of vectors, none where tracks are all."""
        if method == "volumes":
            return self._by_volumes(weights)
        return self._followed(weights) if self.options.follow else self._by_particles(weights)

    def combined(self, first: Sequence[Path], second: Sequence[Path]) -> list[Path]:
        """Weight the vectors of two methods by their uncertainties; return the files."""
        paths = self._of_pairs("combined")

        def combine_all() -> dict[str, Any]:
            told = [
                combine_vectors(a, b, path, resume=True, **self.common)
                for a, b, path in zip(first, second, paths, strict=True)
            ]
            return _of_all(paths, told)

        self.steps.take("combine", paths, combine_all)
        return paths

    def report(self) -> dict[str, Any]:
        """Make the page of all that the folder holds, where a step has made anything; return what it tells."""
        page = self.steps.output / REPORT
        is_kept = page.exists() and not self.steps.count(MADE)
        raw = (*self.options.images, *self.options.white, *self.options.board)
        overwrite = self.overwrite or bool(self.steps.earlier)

        def make() -> dict[str, Any]:
            if is_kept:
                return {}
            console = self.steps.console
            return report(self.steps.output, page, ReportOptions(raw=raw), overwrite=overwrite, console=console)

        return self.steps.take("report", [page], make)

    def _by_volumes(self, weights: Path) -> list[Path]:
        options = self.options
        volumes = self._reconstructed("reconstruct", weights, "volumes", ReconstructOptions())
        paths = self._of_pairs("vectors")
        chosen = CorrelateOptions(dt_s=options.dt_s, pairing=_pairing(options), resume=True)
        output = paths[0] if len(paths) == 1 else paths[0].parent
        self.steps.take("correlate", paths, lambda: correlate(volumes, output, chosen, **self.common))
        return paths

    def _by_particles(self, weights: Path) -> list[Path]:
        chosen = ReconstructOptions(solver="particles", pairing=_pairing(self.options))
        found = self._reconstructed("reconstruct particles", weights, "particles", chosen)
        groups = [found]
        if _pairing(self.options) == "ab":
            groups = [found[k : k + 2] for k in range(0, len(found), 2)]
        tracks = self._of_pairs("tracks") if len(groups) > 1 else [self.steps.output / TRACKS]
        grids = [grid for path, group in zip(tracks, groups, strict=True) for grid in grid_paths(path, len(group) - 1)]
        options = TrackOptions(dt_s=self.options.dt_s, grid=True, resume=True)

        def track_all() -> dict[str, Any]:
            told = [
                track_particles(group, path, options, **self.common) for group, path in zip(groups, tracks, strict=True)
            ]
            return _of_all(tracks, told)

        self.steps.take("track", [*tracks, *grids], track_all)
        return grids

    def _followed(self, weights: Path) -> list[Path]:
        given, output = self.options, self.steps.output
        chosen = FollowOptions(
            dark=given.dark, background=given.background, mask=given.mask, dt_s=given.dt_s, resume=True
        )
        files = [*self._of_frames("particles"), output / TRACKS, output / PLAYBACK]
        self.steps.take("follow", files, lambda: follow_particles(weights, given.images, output, chosen, **self.common))
        return []

    def _reconstructed(self, name: str, weights: Path, folder: str, chosen: ReconstructOptions) -> list[Path]:
        """Reconstruct all frames into a folder; return the files."""
        given, paths = self.options, self._of_frames(folder)
        options = replace(chosen, dark=given.dark, background=given.background, mask=given.mask, resume=True)
        self.steps.take(
            name, paths, lambda: reconstruct(weights, given.images, paths[0].parent, options, **self.common)
        )
        return paths

    def _of_frames(self, folder: str) -> list[Path]:
        """Return the file of each frame in a folder."""
        return [self.steps.output / folder / f"{frame.stem}{VTKHDF_SUFFIX}" for frame in self.frames]

    def _of_pairs(self, name: str) -> list[Path]:
        """Return the file of each pair, in a folder where there are several, which is made."""
        if len(self.frames) == 2:
            return [self.steps.output / f"{name}{VTKHDF_SUFFIX}"]
        paths = self._of_frames(name)
        paths = paths[::2] if _pairing(self.options) == "ab" else paths[:-1]
        prepare_folder(paths)
        return paths


def _of_all(paths: Sequence[Path], told: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what is told of one result, or of several by their names."""
    return told[0] if len(told) == 1 else {path.stem: each for path, each in zip(paths, told, strict=True)}


def _figures(fields: Mapping[str, Sequence[Path]]) -> dict[str, dict[str, float | int | None]]:
    """Return how many vectors each method gives, how good they are and what they range over: figures by method."""
    measured = {method: paths for method, paths in fields.items() if paths}
    by_method = {method: _figures_of([open_vectors(path) for path in paths]) for method, paths in measured.items()}
    names = next(iter(by_method.values()), {})
    return {name: {method: figures[name] for method, figures in by_method.items()} for name in names}


def _figures_of(fields: Sequence[VectorField]) -> dict[str, float | int | None]:
    """Return the figures of a method's fields."""
    quality = quality_of_all([quality_of(field) for field in fields])
    moved = np.concatenate([field.displacement_voxel[field.flag < REJECTED] for field in fields])
    ends = LEFT_OUT_PERCENT, 100.0 - LEFT_OUT_PERCENT
    low, high = np.percentile(moved, ends, axis=0) if len(moved) else np.full((2, 3), np.nan)
    sigma = np.median(quality.sigma, axis=0) if len(quality.sigma) else np.full(3, np.nan)
    told: dict[str, float | int | None] = {
        "vectors": quality.vectors,
        "valid": sum(int(np.count_nonzero(field.flag == VALID)) for field in fields),
    }
    for k, name in enumerate("uvw"):
        told |= {
            f"{name}_from_voxel": without_nan(low[k]),
            f"{name}_to_voxel": without_nan(high[k]),
            f"{name}_sigma_voxel": without_nan(sigma[k]),
        }
    return told
