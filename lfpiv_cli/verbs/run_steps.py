"""The steps of `run` by the stages of the single commands, each for all frames or pairs.

Each is told and taken, and what it made is written down in `run.json`. A step whose files are complete and made alike
leaves them as they are; its summary is then the one of the run that made them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, LfpivError, OutputExistsError, PartialError, StoppedEarlyError
from lfpiv_cli.files import atomic
from lfpiv_cli.files.atomic import awaited
from lfpiv_cli.files.batch import VTKHDF_SUFFIX, Frame, Target, stamp_of
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.inputs import Deadline
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import Gone, carried_record, same_result, sha256
from lfpiv_cli.names import FlowMethod, Kept, RunMethod
from lfpiv_cli.verbs import correlate as correlating
from lfpiv_cli.verbs import track as tracking
from lfpiv_cli.verbs.batches import ALL, BatchOptions, Failure, carried_out, work_through
from lfpiv_cli.verbs.build_weights import BuildWeightsOptions, build_weights_file
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.verbs.combine import combine_vectors
from lfpiv_cli.verbs.correlate import CorrelateOptions, Correlation
from lfpiv_cli.verbs.follow import PLAYBACK, TRACKS, FollowOptions, follow_particles
from lfpiv_cli.verbs.frames import ImageOptions
from lfpiv_cli.verbs.pairs import PairByPair, PairOptions, failures_of
from lfpiv_cli.verbs.particles import Prepared
from lfpiv_cli.verbs.reconstruct import Reconstruction, ReconstructOptions
from lfpiv_cli.verbs.track import TrackOptions, Tracks, grid_paths

RECORD = "run.json"
# What becomes of a step: its files are made; complete and left as they are; or complete and their record is another, as
# settings have changed that they do not depend on.
MADE, KEPT, RECORDED = "made", "kept", "recorded anew"
OURS = (".h5", ".vtkhdf")


@dataclass(frozen=True)
class Steps:
    """The steps of a run, those that were taken so far.

    Attributes
    ----------
    output : the run's folder
    earlier : what `run.json` said before
    deadline : when all steps have to be done
    recorded : whether they are written down; of several shards none can tell of all
    reported : what it says now
    files : what all steps have made or kept
    failures : frames and pairs that could not be worked on
    """

    output: Path
    console: Console
    earlier: Mapping[str, Any]
    deadline: Deadline = field(default_factory=Deadline)
    recorded: bool = True
    reported: dict[str, Any] = field(default_factory=lambda: {"steps": {}, "summaries": {}})
    files: list[Path] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)

    def take(self, name: str, files: Sequence[Path], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Take a step, which makes files; write down and return what it reported, and what of it failed.

        Raises
        ------
        LfpivError : as the step does, with its name and what becomes of the steps before
        StoppedEarlyError : the time is over
        """
        number = len(self.reported["steps"]) + 1
        if not self.deadline.leaves_time():
            raise StoppedEarlyError(
                f"stopped before step {number}, {name}: the time limit of {self.deadline.limit_s:g} s is over; the "
                "same command goes on from there"
            )
        self.console.say(f"step {number}: {name}")
        before, times = [_recorded(path) for path in files], [stamp_of(path) for path in files]
        hashes = self._hashes(files)
        try:
            summary = make()
        except PartialError as error:
            self.failures.extend(Failure(**each) for each in error.figures["failures"])
            summary = error.figures
        except LfpivError as error:
            goes_on = number > 1 and not isinstance(error, OutputExistsError)
            done = "; what is done stays, and the same command goes on from there" if goes_on else ""
            raise type(error)(f"step {number}, {name}: {error}{done}") from error
        state = KEPT
        if times != [stamp_of(path) for path in files]:
            # By the records that the files had before.
            ours = [(old, _recorded(path)) for path, old in zip(files, before, strict=True) if path.suffix in OURS]
            alike = bool(ours) and all(old and new and old != new and same_result(old, new) for old, new in ours)
            state = RECORDED if alike else MADE
        if state != MADE:
            why = "complete and made alike" if state == KEPT else "as it depends on nothing that has changed"
            self.console.say(f"step {number}: {state}, {why}")
            if self.earlier.get("steps", {}).get(name, {}).get("files") == hashes:
                summary = self.earlier.get("summaries", {}).get(name, summary)
        self.reported["steps"][name] = {"state": state, "files": self._hashes(files)}
        self.reported["summaries"][name] = summary
        self.files.extend(files)
        self.write()
        return summary

    def _hashes(self, files: Iterable[Path]) -> dict[str, str]:
        """Return the hash of each file that is there by its name in the folder; of those that failed there is none."""
        return {path.relative_to(self.output).as_posix(): sha256(path) for path in files if path.exists()}

    def count(self, state: str) -> int:
        """Return how many steps were made, kept, or recorded anew."""
        return sum(step["state"] == state for step in self.reported["steps"].values())

    def summary(self) -> dict[str, Any]:
        """Return what is told of the steps."""
        return {"steps_made": self.count(MADE), "steps_kept": self.count(KEPT), "folder": str(self.output)}

    def write(self, *, whole: bool = False) -> None:
        """Write down what is known so far: of steps to come what the run before told, unless this is the `whole` run.

        What a step told would be lost where another one fails before it is found to be complete.
        """
        if not self.recorded:
            return
        reported = dict(self.reported)
        for part in () if whole else ("steps", "summaries"):
            reported[part] = self.earlier.get(part, {}) | self.reported[part]
        # What was warned of, in this run and when what it kept was made.
        recorded = [warning for path in self.files for warning in (_recorded(path) or {}).get("warnings", ())]
        reported["warnings"] = []
        for warning in (*recorded, *(notice.record() for notice in self.console.warned or ())):
            if warning not in reported["warnings"]:
                reported["warnings"].append(warning)
        atomic.write_json(self.output / RECORD, reported, overwrite=True)


def earlier_run(output: Path, overwrite: bool) -> dict[str, Any]:
    """Return what `run.json` says of the run before; nothing where there was none.

    Raises
    ------
    OutputExistsError : it is not ours, and `overwrite` is false
    """
    path = output / RECORD
    try:
        reported = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        reported = None
    if isinstance(reported, dict) and isinstance(reported.get("steps"), dict):
        return reported
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path}: exists, and is not of a run (use --overwrite to replace it)")
    return {}


def _recorded(path: Path) -> dict[str, Any] | None:
    """Return the record that a file of ours carries; None where there is none, or a broken one."""
    if path.suffix not in OURS or not path.exists():
        return None
    try:
        return carried_record(path)
    except InputError:
        return None


@dataclass(frozen=True, kw_only=True)
class RunOptions(PairOptions, ImageOptions):
    """What `run` is given besides the config; it resumes by itself.

    Attributes
    ----------
    images : of the flow
    white, board, depth_mm : as of `calibrate_snapshot`, which is given the dark image, too
    method : by volumes, particles or both; `auto`: by how many tracers there are
    dt_s : time from one image to the next, in place of the config's
    combine : of both methods, also one field that weights their vectors by their uncertainties
    follow : find and track the particles of a time-resolved sequence together, as `follow_particles` does
    keep : `results`: volumes, and particles of separate pairs, are dropped as soon as their vectors stand
    report : make the page of all that the folder holds, too
    """

    images: Sequence[Path]
    white: Sequence[Path] = ()
    board: Sequence[Path] = ()
    depth_mm: Sequence[float] = ()
    method: RunMethod = "auto"
    dt_s: float | None = None
    combine: bool = False
    follow: bool = False
    keep: Kept = "all"
    report: bool = True
    idle_s: float = math.inf


CALIBRATION, WEIGHTS, PICTURE = "calibration.h5", "weights.h5", "calibration.png"
VOLUMES, PARTICLES = ReconstructOptions(), ReconstructOptions(solver="particles")
# What is made of the pairs of each method, by the name of the file, or of the folder of several.
RESULTS: dict[FlowMethod, str] = {"volumes": "vectors", "particles": "tracks"}
# And by which batch, with which options.
BATCHES: dict[FlowMethod, tuple[type[Correlation | Tracks], Any]] = {
    "volumes": (Correlation, CorrelateOptions()),
    "particles": (Tracks, TrackOptions(grid=True)),
}
# The files of vectors by the numbers of their pairs.
Vectors = dict[int, Path]


@dataclass
class Chain:
    """The steps, as the options of a run have them.

    Attributes
    ----------
    config, settings : the rig file, and what it says
    pairs : of all frames
    prepared : what steps share that takes long to open
    share : the numbers of the pairs that are to be measured
    order : those of the frames that this takes, and in the last share those without a partner
    """

    config: Path
    settings: Config
    options: RunOptions
    frames: Sequence[Frame]
    pairs: Pairs
    steps: Steps
    overwrite: bool
    prepared: Prepared = field(default_factory=Prepared)

    def __post_init__(self) -> None:
        """See what belongs to this share."""
        shard, pairs = self.options.shard, self.pairs
        self.share = shard.of(range(len(pairs.pairs)))
        ours = [pairs.pairs[number] for number in self.share]
        alone = pairs.order(len(self.frames))[len({k for pair in pairs.pairs for k in pair}) :]
        self.order = list(dict.fromkeys([*(k for pair in ours for k in pair), *(alone if shard.is_last else [])]))
        if shard.number == 1:
            # Of several shards the first one tells them.
            self.steps.failures.extend(failures_of(pairs))
        self.pairs = replace(pairs, left_out=())

    @property
    def common(self) -> dict[str, Any]:
        """What every stage is given."""
        return {"overwrite": self.overwrite, "console": self.steps.console}

    @property
    def _resuming(self) -> dict[str, Any]:
        """The options of every batch."""
        given = self.options
        limit = {"time_limit_s": given.time_limit_s, "begun_s": given.begun_s}
        return {"resume": True, "keep_going": given.keep_going, "dry_run": given.dry_run} | limit

    @property
    def photographs(self) -> CalibrateOptions:
        """What the calibration is given."""
        given, picture = self.options, self.steps.output / PICTURE
        return CalibrateOptions(
            white=given.white, dark=given.dark, board=given.board, depth_mm=given.depth_mm, picture=picture, resume=True
        )

    @property
    def made_with(self) -> BuildWeightsOptions:
        """What the weights are given."""
        return BuildWeightsOptions(calibration=self.steps.output / CALIBRATION, resume=True)

    def weights(self) -> Path:
        """Calibrate and build the weights, or take those of another worker, shard or run; return their file."""
        calibration, weights, picture = (self.steps.output / name for name in (CALIBRATION, WEIGHTS, PICTURE))

        def calibrated() -> dict[str, Any]:
            with awaited(calibration):
                return calibrate_snapshot(self.config, calibration, self.photographs, **self.common)

        def built() -> dict[str, Any]:
            with awaited(weights):
                return build_weights_file(self.config, weights, self.made_with, **self.common)

        # What another worker makes now is waited for, and what it has made is kept.
        self.steps.take("calibrate-snapshot", [calibration, picture], calibrated)
        self.steps.take("build-weights", [weights], built)
        return weights

    def measured(self, methods: Sequence[FlowMethod], weights: Path) -> dict[str, Vectors]:
        """Measure the flow; return the files of vectors by each method, those that err least as the last."""
        fields: dict[str, Vectors] = {method: self.vectors_by(method, weights) for method in methods}
        if not self.options.combine:
            return fields
        # Those of both, weighted by their uncertainties.
        every, first, second = self.of_pairs("combined"), fields["volumes"], fields["particles"]
        paths = {number: every[number] for number in first if number in second}

        def combine_all() -> dict[str, Any]:
            reported = {
                path.stem: combine_vectors(first[number], second[number], path, resume=True, **self.common)
                for number, path in paths.items()
            }
            return next(iter(reported.values())) if len(reported) == 1 else reported

        self.steps.take("combine", list(paths.values()), combine_all)
        return fields | {"combined": paths}

    def reconstruction(self, method: FlowMethod, weights: Path, to_come: Gone | None = None) -> Reconstruction:
        """Return the batch of the frames of this share, of weights as they are `to_come` if they change."""
        by_particles, kept = method == "particles", self.options.keep == "all" or not self.pairs.separate
        chosen = replace(PARTICLES, residual=kept) if by_particles else VOLUMES
        # What is prepared here no other process has.
        prepared = None if self.options.dask else self.prepared
        options = replace(chosen, **self._of_images, **self._resuming)
        given = (weights, self.options.images, self.steps.output / method, options, self.overwrite)
        return Reconstruction(*given, self.pairs if by_particles else None, prepared, self.order, to_come)

    def vectors_by(self, method: FlowMethod, weights: Path) -> Vectors:
        """Measure the flow by volumes or by particles; return the files of vectors, none where tracks are all."""
        given, output = self.options, self.steps.output
        tracks = output / TRACKS
        if method == "volumes" or self.pairs.separate:
            return self._by_pairs(method, weights)
        if given.follow:
            files, chosen = [*self._of_frames("particles"), tracks, output / PLAYBACK], self.following()
            follow = partial(follow_particles, weights, given.images, output, chosen, **self.common)
            self.steps.take("follow", files, follow)
            return {}
        found, failed = self._reconstructed("particles", weights)
        if given.shard != ALL:
            self.steps.console.say("tracks go through all frames: the same command without --shard makes them")
            return {}
        # The vectors of each interval.
        grids = grid_paths(tracks, len(found) - 1)
        if failed or len(self.pairs.pairs) < len(grids):
            error = "a frame of the sequence is missing, and tracks would take those beside it for neighbours in time"
            self.steps.failures.append(Failure(TRACKS, error))
            return {}
        self.steps.take("track", [tracks, *grids], lambda: self._worked(self._measured("particles")(found, tracks)))
        return dict(enumerate(grids))

    def in_pairs(self, method: FlowMethod, found: Reconstruction, file_bytes: float | None = None) -> PairByPair[Any]:
        """Return the batch of pairs, each from its images to its vectors or tracks, of so many bytes if known."""
        results = self.of_pairs(RESULTS[method])
        targets = [Target(path, dict, grid_paths(path, 1) if method == "particles" else ()) for path in results]
        return PairByPair(found, self._measured(method), self.pairs, targets, file_bytes)

    def _measured(self, method: FlowMethod) -> Callable[..., Correlation | Tracks]:
        """Return what makes the batch of pairs of volumes, or of particles, here or in another process."""
        kind, options = BATCHES[method]
        return partial(
            kind, options=replace(options, dt_s=self.options.dt_s, **self._resuming), overwrite=self.overwrite
        )

    def _worked(self, batch: Correlation | Tracks | Reconstruction) -> dict[str, Any]:
        """Work through a batch of which nothing fails; return what is told of it."""
        return carried_out(batch, self.batch_options(shared=False), self.steps.console)

    def _by_pairs(self, method: FlowMethod, weights: Path) -> Vectors:
        """Measure the flow in each pair, `keep` has it one after the other or all frames first."""
        paths, name = self.of_pairs(RESULTS[method]), "correlate" if method == "volumes" else "track"
        vectors = paths if method == "volumes" else [grid_paths(path, 1)[0] for path in paths]
        numbers = list(self.share)
        if self.options.keep == "results":
            batch = self.in_pairs(method, self.reconstruction(method, weights))

            def make() -> dict[str, Any]:
                worked = work_through(batch, self.batch_options(shared=True), self.steps.console)
                if method == "volumes":
                    summary = correlating.summary_of(worked, worked.total())
                else:
                    summary = tracking.summary_of(worked, [paths[number] for number in self.share])
                return worked.ensure_whole(summary, batch.unit)

        else:
            files, failed = self._reconstructed(method, weights)
            broken = {number for number, frame in enumerate(self.frames) if frame.stem in failed}
            numbers = [number for number in self.share if not broken & set(self.pairs.pairs[number])]
            if not numbers:
                why = self.steps.failures[0].error
                raise InputError(f"of every pair a frame has failed, the first because {why}")
            output = paths[numbers[0]] if len(numbers) == 1 else paths[0].parent
            pairs = [self.pairs.pairs[number] for number in numbers]
            place = {k: place for place, k in enumerate(sorted({k for pair in pairs for k in pair}))}
            ours = replace(self.pairs, pairs=tuple((place[first], place[second]) for first, second in pairs))

            def make() -> dict[str, Any]:
                return self._worked(self._measured(method)([files[k] for k in place], output, pairs=ours))

        made = [path for number in numbers for path in dict.fromkeys((paths[number], vectors[number]))]
        self.steps.take(name, made, make)
        lost = {failure.name for failure in self.steps.failures}
        return {number: vectors[number] for number in numbers if paths[number].stem not in lost}

    def following(self) -> FollowOptions:
        """Return the options of a sequence that is followed."""
        given = self.options
        return FollowOptions(**self._of_images, dt_s=given.dt_s, **self._resuming)

    def batch_options(self, shared: bool) -> BatchOptions:
        """Return the options of a batch, `shared` where it is one of all pairs."""
        return BatchOptions(**self._resuming, shard=self.options.shard if shared else ALL, dask=self.options.dask)

    def _reconstructed(self, method: FlowMethod, weights: Path) -> tuple[list[Path], set[str]]:
        """Reconstruct all frames into a folder; return the files, and the names of frames that failed."""
        paths, before = self._of_frames(method), len(self.steps.failures)
        name = "reconstruct particles" if method == "particles" else "reconstruct"
        made = [paths[k] for k in self.order]
        self.steps.take(name, made, lambda: self._worked(self.reconstruction(method, weights)))
        return paths, {failure.name for failure in self.steps.failures[before:]}

    @property
    def _of_images(self) -> dict[str, Any]:
        """What is taken off images, and left out of them."""
        return {"dark": self.options.dark, "background": self.options.background, "mask": self.options.mask}

    def _of_frames(self, folder: str) -> list[Path]:
        """Return the file of each frame in a folder."""
        return [self.steps.output / folder / f"{frame.stem}{VTKHDF_SUFFIX}" for frame in self.frames]

    def of_pairs(self, name: str) -> list[Path]:
        """Return the file of each pair, in a folder where there are several."""
        if len(self.frames) == 2 and not self.options.watch:
            return [self.steps.output / f"{name}{VTKHDF_SUFFIX}"]
        of_frames = self._of_frames(name)
        return [of_frames[first] for first, _ in self.pairs.pairs]
