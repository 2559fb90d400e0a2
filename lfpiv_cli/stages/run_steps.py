"""The steps of `run` by the stages of the single commands, each for all frames or pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from lfpiv_cli.errors import InputError, PartialError
from lfpiv_cli.files.batch import VTKHDF_SUFFIX, Frame, Target, prepare_folder
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.names import FlowMethod
from lfpiv_cli.stages import correlate as correlating
from lfpiv_cli.stages import track as tracking
from lfpiv_cli.stages.batches import BatchOptions, Failure, Worked, work_through
from lfpiv_cli.stages.build_weights import BuildWeightsOptions, build_weights
from lfpiv_cli.stages.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.stages.combine import combine_vectors
from lfpiv_cli.stages.correlate import CorrelateOptions, Correlation, correlate
from lfpiv_cli.stages.follow import PLAYBACK, TRACKS, FollowOptions, follow_particles
from lfpiv_cli.stages.pair_by_pair import PairByPair, joined_by
from lfpiv_cli.stages.prepared import Prepared
from lfpiv_cli.stages.reconstruct import Reconstruction, ReconstructOptions, reconstruct
from lfpiv_cli.stages.run_options import RunOptions
from lfpiv_cli.stages.steps import Steps
from lfpiv_cli.stages.track import TrackOptions, Tracks, grid_paths, track_particles

Outcome = TypeVar("Outcome")
# The files of vectors by the numbers of their pairs.
Vectors = dict[int, Path]


class Chain:
    """The steps, as the options of a run have them.

    Attributes
    ----------
    failures : frames and pairs that could not be worked on
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
        self.failures = [Failure(each.name, each.why) for each in pairs.left_out]
        self._prepared, self._overwrite = prepared, overwrite
        self._pairs = replace(pairs, left_out=())

    @property
    def common(self) -> dict[str, Any]:
        """What every stage is given."""
        return {"overwrite": self._overwrite, "console": self.steps.console}

    @property
    def _resuming(self) -> dict[str, Any]:
        """The options of every batch."""
        return {"resume": True, "keep_going": self.options.keep_going}

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

    def vectors_by(self, method: FlowMethod, weights: Path) -> Vectors:
        """Measure the flow by volumes or by particles; return the files of vectors, none where tracks are all."""
        if method == "volumes":
            return self._by_volumes(weights)
        return self._followed(weights) if self.options.follow else self._by_particles(weights)

    def combined(self, first: Vectors, second: Vectors) -> Vectors:
        """Weight the vectors of two methods by their uncertainties; return the files."""
        every = self._of_pairs("combined")
        paths = {number: every[number] for number in first if number in second}

        def combine_all() -> dict[str, Any]:
            told = {
                path.stem: combine_vectors(first[number], second[number], path, resume=True, **self.common)
                for number, path in paths.items()
            }
            return next(iter(told.values())) if len(told) == 1 else told

        self.steps.take("combine", list(paths.values()), combine_all)
        return paths

    def _by_volumes(self, weights: Path) -> Vectors:
        paths = self._of_pairs("vectors")
        options = CorrelateOptions(dt_s=self.options.dt_s, **self._resuming)
        if self.options.keep == "results":
            found = self._reconstruction(weights, "volumes", self._of_images(ReconstructOptions()))
            join = joined_by(Correlation, options, self._overwrite)
            batch = PairByPair(found, join, self._pairs, [Target(path, dict) for path in paths])
            self._take_pair_by_pair("correlate", batch, lambda worked: correlating.summary_of(worked, len(paths)))
            return self._standing(paths, range(len(paths)))
        volumes, failed = self._reconstructed("reconstruct", weights, "volumes", ReconstructOptions())
        whole = self._without(failed)
        output = paths[0] if len(paths) == 1 else paths[0].parent
        ours = [paths[number] for number in whole]
        self._take(
            "correlate", ours, lambda: correlate(volumes, output, options, **self.common, pairs=self._only(whole))
        )
        return self._standing(paths, whole)

    def _by_particles(self, weights: Path) -> Vectors:
        options = TrackOptions(dt_s=self.options.dt_s, grid=True, **self._resuming)
        chosen = ReconstructOptions(solver="particles")
        if not self._pairs.separate:
            return self._tracked_in_time(weights, chosen, options)
        tracks = self._of_pairs("tracks")
        grids = [grid_paths(path, 1)[0] for path in tracks]
        if self.options.keep == "results":
            asked = self._of_images(replace(chosen, residual=False))
            found = self._reconstruction(weights, "particles", asked, self._pairs)
            join = joined_by(Tracks, options, self._overwrite)
            targets = [Target(path, dict, [grid]) for path, grid in zip(tracks, grids, strict=True)]
            batch = PairByPair(found, join, self._pairs, targets)
            self._take_pair_by_pair("track", batch, lambda worked: tracking.summary_of(worked, tracks))
            return {number: grids[number] for number in self._standing(tracks, range(len(tracks)))}
        particles, failed = self._reconstructed("reconstruct particles", weights, "particles", chosen, self._pairs)
        whole = self._without(failed)
        output = tracks[0] if len(tracks) == 1 else tracks[0].parent
        ours = [each for number in whole for each in (tracks[number], grids[number])]
        self._take(
            "track", ours, lambda: track_particles(particles, output, options, **self.common, pairs=self._only(whole))
        )
        return {number: grids[number] for number in self._standing(tracks, whole)}

    def _tracked_in_time(self, weights: Path, chosen: ReconstructOptions, options: TrackOptions) -> Vectors:
        """Track particles through all frames; return the vectors of each interval."""
        found, failed = self._reconstructed("reconstruct particles", weights, "particles", chosen, self._pairs)
        tracks = self.steps.output / TRACKS
        grids = grid_paths(tracks, len(found) - 1)
        if failed or len(self._pairs.pairs) < len(grids):
            error = "a frame of the sequence is missing, and tracks would take those beside it for neighbours in time"
            self.failures.append(Failure(TRACKS, error))
            return {}
        self._take("track", [tracks, *grids], lambda: track_particles(found, tracks, options, **self.common))
        return dict(enumerate(grids))

    def _followed(self, weights: Path) -> Vectors:
        given, output = self.options, self.steps.output
        chosen = FollowOptions(
            dark=given.dark, background=given.background, mask=given.mask, dt_s=given.dt_s, **self._resuming
        )
        files = [*self._of_frames("particles"), output / TRACKS, output / PLAYBACK]
        self._take("follow", files, lambda: follow_particles(weights, given.images, output, chosen, **self.common))
        return {}

    def _take_pair_by_pair(
        self, name: str, batch: PairByPair[Outcome], summary: Callable[[Worked[Outcome]], dict[str, Any]]
    ) -> None:
        """Make the results of pairs one after the other, and drop what they are made of."""

        def make() -> dict[str, Any]:
            worked = work_through(batch, BatchOptions(**self._resuming), self.steps.console)
            return worked.ensure_whole(summary(worked), batch.unit)

        self._take(name, [path for target in batch.targets for path in target.paths], make)

    def _reconstructed(
        self, name: str, weights: Path, folder: str, chosen: ReconstructOptions, pairs: Pairs | None = None
    ) -> tuple[list[Path], set[str]]:
        """Reconstruct all frames into a folder; return the files, and the names of frames that failed."""
        paths, options, before = self._of_frames(folder), self._of_images(chosen), len(self.failures)
        given, output = (weights, self.options.images), paths[0].parent
        self._take(
            name,
            paths,
            lambda: reconstruct(*given, output, options, **self.common, pairs=pairs, prepared=self._prepared),
        )
        return paths, {failure.name for failure in self.failures[before:]}

    def _reconstruction(
        self, weights: Path, folder: str, options: ReconstructOptions, pairs: Pairs | None = None
    ) -> Reconstruction:
        """Return the batch of all frames."""
        output = self.steps.output / folder
        return Reconstruction(weights, self.options.images, output, options, self._overwrite, pairs, self._prepared)

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
        whole = [number for number, pair in enumerate(self._pairs.pairs) if not broken & set(pair)]
        if not whole:
            raise InputError(f"of every pair a frame has failed, the first because {self.failures[0].error}")
        return whole

    def _only(self, numbers: Sequence[int]) -> Pairs:
        """Return these pairs alone."""
        return replace(self._pairs, pairs=tuple(self._pairs.pairs[number] for number in numbers))

    def _standing(self, paths: Sequence[Path], numbers: Iterable[int]) -> Vectors:
        """Return those of the results that have not failed, by the numbers of their pairs."""
        failed = {failure.name for failure in self.failures}
        return {number: paths[number] for number in numbers if paths[number].stem not in failed}

    def _of_frames(self, folder: str) -> list[Path]:
        """Return the file of each frame in a folder."""
        return [self.steps.output / folder / f"{frame.stem}{VTKHDF_SUFFIX}" for frame in self.frames]

    def _of_pairs(self, name: str) -> list[Path]:
        """Return the file of each pair, in a folder where there are several, which is made."""
        if len(self.frames) == 2:
            return [self.steps.output / f"{name}{VTKHDF_SUFFIX}"]
        of_frames = self._of_frames(name)
        paths = [of_frames[first] for first, _ in self._pairs.pairs]
        prepare_folder(paths)
        return paths
