"""The steps of `run` by the stages of the single commands, each for all frames or pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from lfpiv_cli.errors import InputError, PartialError
from lfpiv_cli.files.batch import VTKHDF_SUFFIX, Frame, Target
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import Gone
from lfpiv_cli.files.shares import awaited
from lfpiv_cli.names import FlowMethod, Kept, RunMethod
from lfpiv_cli.verbs import correlate as correlating
from lfpiv_cli.verbs import track as tracking
from lfpiv_cli.verbs.batches import ALL, BatchOptions, Failure, Worked, WorkOptions, work_through
from lfpiv_cli.verbs.build_weights import BuildWeightsOptions, build_weights_file
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.verbs.combine import combine_vectors
from lfpiv_cli.verbs.correlate import CorrelateOptions, Correlation, correlate_files
from lfpiv_cli.verbs.follow import PLAYBACK, TRACKS, FollowOptions, follow_particles
from lfpiv_cli.verbs.pairs import PairByPair, PairOptions, failures_of
from lfpiv_cli.verbs.particles import Prepared
from lfpiv_cli.verbs.reconstruct import Reconstruction, ReconstructOptions, reconstruct_files
from lfpiv_cli.verbs.steps import Steps
from lfpiv_cli.verbs.track import TrackOptions, Tracks, grid_paths, track_particles


@dataclass(frozen=True, kw_only=True)
class RunOptions(PairOptions, WorkOptions):
    """What `run` is given besides the config; it resumes by itself.

    Attributes
    ----------
    images : of the flow
    white, dark, board, depth_mm : as of `calibrate_snapshot`; the dark image also of the flow
    background, mask : as of `reconstruct`
    method : by volumes, particles or both; `auto`: by how many tracers there are
    dt_s : time from one image to the next, in place of the config's
    combine : of both methods, also one field that weights their vectors by their uncertainties
    follow : find and track the particles of a time-resolved sequence together, as `follow_particles` does
    keep : `results`: volumes, and particles of separate pairs, are dropped as soon as their vectors stand
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
    keep: Kept = "all"
    report: bool = True


Outcome = TypeVar("Outcome")
CALIBRATION, WEIGHTS, PICTURE = "calibration.h5", "weights.h5", "calibration.png"
VOLUMES, PARTICLES = ReconstructOptions(), ReconstructOptions(solver="particles")
# The files of vectors by the numbers of their pairs.
Vectors = dict[int, Path]


class Chain:
    """The steps, as the options of a run have them.

    Attributes
    ----------
    failures : frames and pairs that could not be worked on
    pairs : of all frames
    share : the numbers of the pairs that are to be measured
    order : those of the frames that this takes, and in the last share those without a partner
    """

    def __init__(
        self,
        config: Path,
        options: RunOptions,
        frames: Sequence[Frame],
        pairs: Pairs,
        steps: Steps,
        prepared: Prepared,
        overwrite: bool,
    ) -> None:
        """Take the frames and which of them belong together, and what steps share."""
        self.config, self.options, self.frames, self.steps = config, options, frames, steps
        shard = options.shard
        self.share = shard.of(range(len(pairs.pairs)))
        ours = [pairs.pairs[number] for number in self.share]
        alone = pairs.order(len(frames))[len({k for pair in pairs.pairs for k in pair}) :]
        self.order = list(dict.fromkeys([*(k for pair in ours for k in pair), *(alone if shard.is_last else [])]))
        # Of several shards the first one tells them.
        self.failures = failures_of(pairs) if shard.number == 1 else []
        self._prepared, self._overwrite = prepared, overwrite
        self.pairs = replace(pairs, left_out=())

    @property
    def common(self) -> dict[str, Any]:
        """What every stage is given."""
        return {"overwrite": self._overwrite, "console": self.steps.console}

    @property
    def _resuming(self) -> dict[str, Any]:
        """The options of every batch."""
        given = self.options
        limit = {"time_limit_s": given.time_limit_s, "begun_s": given.begun_s}
        return {"resume": True, "keep_going": given.keep_going} | limit

    @property
    def photographs(self) -> CalibrateOptions:
        """What the calibration is given."""
        options = self.options
        return CalibrateOptions(
            white=options.white,
            dark=options.dark,
            board=options.board,
            depth_mm=options.depth_mm,
            picture=self.steps.output / PICTURE,
            resume=True,
        )

    @property
    def made_with(self) -> BuildWeightsOptions:
        """What the weights are given."""
        return BuildWeightsOptions(calibration=self.steps.output / CALIBRATION, resume=True)

    def weights(self) -> Path:
        """Calibrate and build the weights, or take those of another worker, shard or run; return their file."""
        calibration, weights, picture = (self.steps.output / name for name in (CALIBRATION, WEIGHTS, PICTURE))
        photographs, made_with = self.photographs, self.made_with
        self.steps.take(
            "calibrate-snapshot",
            [calibration, picture],
            _alone(calibration, lambda: calibrate_snapshot(self.config, calibration, photographs, **self.common)),
        )
        self.steps.take(
            "build-weights",
            [weights],
            _alone(weights, lambda: build_weights_file(self.config, weights, made_with, **self.common)),
        )
        return weights

    def vectors_by(self, method: FlowMethod, weights: Path) -> Vectors:
        """Measure the flow by volumes or by particles; return the files of vectors, none where tracks are all."""
        if method == "volumes":
            return self._by_volumes(weights)
        return self._followed(weights) if self.options.follow else self._by_particles(weights)

    def combined(self, first: Vectors, second: Vectors) -> Vectors:
        """Weight the vectors of two methods by their uncertainties; return the files."""
        every = self.of_pairs("combined")
        paths = {number: every[number] for number in first if number in second}

        def combine_all() -> dict[str, Any]:
            told = {
                path.stem: combine_vectors(first[number], second[number], path, resume=True, **self.common)
                for number, path in paths.items()
            }
            return next(iter(told.values())) if len(told) == 1 else told

        self.steps.take("combine", list(paths.values()), combine_all)
        return paths

    def reconstruction(self, method: FlowMethod, weights: Path, to_come: Gone | None = None) -> Reconstruction:
        """Return the batch of the frames of this share, of weights as they are `to_come` if they change."""
        by_particles = method == "particles"
        chosen = replace(PARTICLES, residual=self.options.keep == "all") if by_particles else VOLUMES
        given = (weights, self.options.images, self.steps.output / method, self._of_images(chosen), self._overwrite)
        return Reconstruction(*given, self.pairs if by_particles else None, self._prepared, self.order, to_come)

    def correlated(self, found: Reconstruction, file_bytes: float | None = None) -> PairByPair[correlating.Outcome]:
        """Return the batch of pairs, each from its images to its vectors, of so many bytes."""
        targets = [Target(path, dict) for path in self.of_pairs("vectors")]
        return PairByPair(found, Correlation, (self._correlating, self._overwrite), self.pairs, targets, file_bytes)

    def tracked(self, found: Reconstruction) -> PairByPair[tracking.Outcome]:
        """Return the batch of separate pairs, each from its images to its tracks."""
        targets = [Target(path, dict, grid_paths(path, 1)) for path in self.of_pairs("tracks")]
        return PairByPair(found, Tracks, (self._tracking, self._overwrite), self.pairs, targets)

    @property
    def _correlating(self) -> CorrelateOptions:
        return CorrelateOptions(dt_s=self.options.dt_s, **self._resuming)

    @property
    def _tracking(self) -> TrackOptions:
        return TrackOptions(dt_s=self.options.dt_s, grid=True, **self._resuming)

    def _by_volumes(self, weights: Path) -> Vectors:
        paths, options = self.of_pairs("vectors"), self._correlating
        if self.options.keep == "results":
            batch = self.correlated(self.reconstruction("volumes", weights))
            self._take_pair_by_pair("correlate", batch, lambda worked: correlating.summary_of(worked, worked.total()))
            return self._standing(paths, self.share)
        volumes, failed = self._reconstructed("reconstruct", weights, "volumes", VOLUMES)
        whole = self._without(failed)
        output = paths[whole[0]] if len(whole) == 1 else paths[0].parent
        given, pairs = self._only(volumes, whole)
        self._take(
            "correlate",
            [paths[number] for number in whole],
            lambda: correlate_files(given, output, options, **self.common, pairs=pairs),
        )
        return self._standing(paths, whole)

    def _by_particles(self, weights: Path) -> Vectors:
        if not self.pairs.separate:
            return self._tracked_in_time(weights)
        tracks, options = self.of_pairs("tracks"), self._tracking
        grids = [grid_paths(path, 1)[0] for path in tracks]
        if self.options.keep == "results":
            results = [tracks[number] for number in self.share]
            batch = self.tracked(self.reconstruction("particles", weights))
            self._take_pair_by_pair("track", batch, lambda worked: tracking.summary_of(worked, results))
            return {number: grids[number] for number in self._standing(tracks, self.share)}
        particles, failed = self._reconstructed("reconstruct particles", weights, "particles", PARTICLES, self.pairs)
        whole = self._without(failed)
        output = tracks[whole[0]] if len(whole) == 1 else tracks[0].parent
        ours = [each for number in whole for each in (tracks[number], grids[number])]
        given, pairs = self._only(particles, whole)
        self._take("track", ours, lambda: track_particles(given, output, options, **self.common, pairs=pairs))
        return {number: grids[number] for number in self._standing(tracks, whole)}

    def _tracked_in_time(self, weights: Path) -> Vectors:
        """Track particles through all frames; return the vectors of each interval."""
        found, failed = self._reconstructed("reconstruct particles", weights, "particles", PARTICLES, self.pairs)
        if self.options.shard != ALL:
            self.steps.console.say("tracks go through all frames: the same command without --shard makes them")
            return {}
        tracks = self.steps.output / TRACKS
        grids = grid_paths(tracks, len(found) - 1)
        if failed or len(self.pairs.pairs) < len(grids):
            error = "a frame of the sequence is missing, and tracks would take those beside it for neighbours in time"
            self.failures.append(Failure(TRACKS, error))
            return {}
        self._take("track", [tracks, *grids], lambda: track_particles(found, tracks, self._tracking, **self.common))
        return dict(enumerate(grids))

    def _followed(self, weights: Path) -> Vectors:
        given, output, chosen = self.options, self.steps.output, self.following()
        files = [*self._of_frames("particles"), output / TRACKS, output / PLAYBACK]
        self._take("follow", files, lambda: follow_particles(weights, given.images, output, chosen, **self.common))
        return {}

    def following(self, dry_run: bool = False) -> FollowOptions:
        """Return the options of a sequence that is followed."""
        given = self.options
        of_images: dict[str, Any] = {"dark": given.dark, "background": given.background, "mask": given.mask}
        return FollowOptions(**of_images, dt_s=given.dt_s, dry_run=dry_run, **self._resuming)

    def batch_options(self, shared: bool) -> BatchOptions:
        """Return the options of a batch, `shared` where it is one of all pairs."""
        return BatchOptions(**self._resuming, shard=self.options.shard if shared else ALL)

    def _take_pair_by_pair(
        self, name: str, batch: PairByPair[Outcome], summary: Callable[[Worked[Outcome]], dict[str, Any]]
    ) -> None:
        """Make the results of pairs one after the other, and drop what they are made of."""

        def make() -> dict[str, Any]:
            worked = work_through(batch, self.batch_options(shared=True), self.steps.console)
            return worked.ensure_whole(summary(worked), batch.unit)

        self._take(name, [path for number in self.share for path in batch.targets[number].paths], make)

    def _reconstructed(
        self, name: str, weights: Path, folder: str, chosen: ReconstructOptions, pairs: Pairs | None = None
    ) -> tuple[list[Path], set[str]]:
        """Reconstruct all frames into a folder; return the files, and the names of frames that failed."""
        paths, options, before = self._of_frames(folder), self._of_images(chosen), len(self.failures)
        images, output = self.options.images, paths[0].parent
        known: dict[str, Any] = {"pairs": pairs, "prepared": self._prepared, "order": self.order}
        self._take(
            name,
            [paths[k] for k in self.order],
            lambda: reconstruct_files(weights, images, output, options, **self.common, **known),
        )
        return paths, {failure.name for failure in self.failures[before:]}

    def _of_images(self, chosen: ReconstructOptions) -> ReconstructOptions:
        """Return options with what is given of the images."""
        given = self.options
        return replace(chosen, dark=given.dark, background=given.background, mask=given.mask, **self._resuming)

    def _take(self, name: str, files: Sequence[Path], make: Callable[[], dict[str, Any]]) -> None:
        """Take a step of which a part may fail, where the others are to go on."""

        def tolerant() -> dict[str, Any]:
            try:
                return make()
            except PartialError as error:
                self.failures += [Failure(**each) for each in error.figures["failures"]]
                return error.figures

        self.steps.take(name, files, tolerant)

    def _without(self, failed: set[str]) -> list[int]:
        """Return the numbers of the pairs of which no frame has failed.

        Raises
        ------
        InputError : there is none
        """
        broken = {number for number, frame in enumerate(self.frames) if frame.stem in failed}
        whole = [number for number in self.share if not broken & set(self.pairs.pairs[number])]
        if not whole:
            raise InputError(f"of every pair a frame has failed, the first because {self.failures[0].error}")
        return whole

    def _only(self, of_frames: Sequence[Path], numbers: Sequence[int]) -> tuple[list[Path], Pairs]:
        """Return the files of the frames of these pairs alone, and how these belong together."""
        pairs = [self.pairs.pairs[number] for number in numbers]
        place = {k: place for place, k in enumerate(sorted({k for pair in pairs for k in pair}))}
        ours = tuple((place[first], place[second]) for first, second in pairs)
        return [of_frames[k] for k in place], replace(self.pairs, pairs=ours)

    def _standing(self, paths: Sequence[Path], numbers: Iterable[int]) -> Vectors:
        """Return those of the results that have not failed, by the numbers of their pairs."""
        failed = {failure.name for failure in self.failures}
        return {number: paths[number] for number in numbers if paths[number].stem not in failed}

    def _of_frames(self, folder: str) -> list[Path]:
        """Return the file of each frame in a folder."""
        return [self.steps.output / folder / f"{frame.stem}{VTKHDF_SUFFIX}" for frame in self.frames]

    def of_pairs(self, name: str) -> list[Path]:
        """Return the file of each pair, in a folder where there are several."""
        if len(self.frames) == 2:
            return [self.steps.output / f"{name}{VTKHDF_SUFFIX}"]
        of_frames = self._of_frames(name)
        return [of_frames[first] for first, _ in self.pairs.pairs]


def _alone(output: Path, make: Callable[[], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    """Return what makes an output after any other worker that makes it now: what that one has made is kept."""

    def make_alone() -> dict[str, Any]:
        with awaited(output):
            return make()

    return make_alone
