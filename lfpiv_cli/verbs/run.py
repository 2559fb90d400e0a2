"""`run`: from raw images to vectors, by the stages of the single commands.

In the output folder: `calibration.h5`, `calibration.png`, `weights.h5`; by volumes `volumes/STEM.vtkhdf` and
`vectors.vtkhdf`; by particles `particles/STEM.vtkhdf`, `tracks.vtkhdf` and `tracks_grid.vtkhdf`; of both together
`combined.vtkhdf`; of several pairs the folders `vectors`, `tracks` and `combined`. `run.json` says what was chosen,
why, and what each step told; `report.html` shows all of it.

What a run would make is known before anything is made. With weights at hand each batch tells of itself; before there
are any, nothing else can be complete: frames and pairs are counted, and their files taken for as large as their arrays.

With `--watch` a camera's folder is measured pair by pair, with a line for each and the picture of the last. What its
frames share is known before: calibration, weights, methods (from the first pair), and the tracers' size, for which
pairs wait until the first images show it. So the files are those of `run` once all pairs are there.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, LfpivError, OutputExistsError, UsageError
from lfpiv_cli.files import atomic, calibration_file
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame, frames_of, images_seen, output_paths, pending
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.pages import Page, Picture, Section, Table, write_pages, write_picture
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import Gone, carried_record, sha256, without_warnings
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.flow.field import VALID, VectorField
from lfpiv_cli.names import FlowMethod
from lfpiv_cli.notice import with_error, written
from lfpiv_cli.pictures.vectors import planes_figure
from lfpiv_cli.verbs import build_weights, calibrate, checks, correlate, particles, run_choice, run_steps
from lfpiv_cli.verbs.batches import ALL, MB, Expected, Failure, carried_out, estimate
from lfpiv_cli.verbs.contents import contents_of, judged
from lfpiv_cli.verbs.follow import follow_particles
from lfpiv_cli.verbs.following import SHORTEST, ensure_sequence
from lfpiv_cli.verbs.frames import readable
from lfpiv_cli.verbs.pairs import coming_pairs, found_pairs, watched
from lfpiv_cli.verbs.particles import LOOKED_AT, Prepared
from lfpiv_cli.verbs.run_choice import Choice
from lfpiv_cli.verbs.run_steps import Chain, RunOptions, Steps
from lfpiv_cli.verbs.simulate import frame_names, simulate_board, simulate_particles, simulate_white
from lfpiv_cli.verbs.weights_cost import FLOAT_BYTES, Cost, cost_of, ensure_volume_fits


def run(
    config: Path, output: Path, options: RunOptions, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Calibrate, build the weights, and measure the flow in images; what is complete and made alike is kept.

    Raises
    ------
    PartialError : frames or pairs failed, and the others were worked on
    """
    settings = load_rig(config)
    if options.watch:
        return watch(config, settings, output, options, overwrite, console)
    frames, pairs = _ensure_possible(settings, options)
    console.warn(pairs.settled(options.keep_going))
    steps = Steps(output, console, run_steps.earlier_run(output, overwrite), options.deadline(), options.shard == ALL)
    chain = Chain(config, settings, options, frames, pairs, steps, overwrite)
    if not options.dry_run:
        ensure_volume_fits(settings, options.method in ("volumes", "both"))
    try:
        return planned(chain) if options.dry_run else run_choice.take_all(chain)
    except OutputExistsError as error:
        # Nothing is made any more: it is told what would be.
        chain.overwrite, chain.options = True, replace(options, dry_run=True)
        raise OutputExistsError(f"{error}{with_overwrite(chain)}") from error


def _ensure_possible(settings: Config, options: RunOptions) -> tuple[list[Frame], Pairs]:
    """Return the frames of the flow and their pairs, after all that can be known to be wrong has been asked for."""
    run_choice.ensure_inputs(settings, options)
    frames = frames_of(options.images, options.keep_going)
    if options.follow:
        ensure_sequence(len(frames), SHORTEST)
        pairs = Pairs(tuple(pairwise(range(len(frames)))), separate=False)
    else:
        pairs = found_pairs(images_seen(frames), options)
        pairs.settled(options.keep_going)
    output_paths(Path(), [frame.stem for frame in frames])
    run_choice.first_readable(frames, settings.image_shape(), options.keep_going)
    if not options.keep_going:
        for path in dict.fromkeys(frame.path for frame in frames):
            if image_files.frames(path).shape != settings.image_shape():
                image_files.read_image(path, 0, settings.image_shape())  # says what is wrong, before any is read
    return frames, pairs


def planned(chain: Chain) -> dict[str, Any]:
    """Return what a run would make, and what that takes; write nothing.

    Raises
    ------
    LfpivError : the run would not begin; as where calibration or weights are there, and were made from something else
    """
    settings, output, options, console = chain.settings, chain.steps.output, chain.options, chain.steps.console
    targets = {
        "calibrate-snapshot": calibrate.target_of(chain.config, output / run_steps.CALIBRATION, chain.photographs),
        "build-weights": build_weights.target_of(chain.config, output / run_steps.WEIGHTS, chain.made_with),
    }
    before: list[str] = []
    for name, target in targets.items():
        # What is made of something that is not there yet is made after it.
        if before or pending([target], (), chain.common["overwrite"], resume=True, dry=True):
            before.append(name)
    counts = {"frames": len(chain.order), "pairs": len(chain.share), "steps_to_make": before}
    if before:
        return counts | _from_nothing(chain)
    weights, to_come = output / run_steps.WEIGHTS, _weights_to_come(chain)
    methods = run_choice.chosen(settings, options, lambda: run_choice.counted(chain, weights)).methods
    reported: dict[str, dict[str, Any]] = {}
    for method in methods:
        if options.follow:
            # The frames of a sequence depend on the whole config.
            whole = replace(chain.following(), resume=to_come is None)
            reported[method] = follow_particles(weights, options.images, output, whole, **chain.common)
            continue
        found = chain.reconstruction(method, weights, to_come)
        in_time = method == "particles" and not chain.pairs.separate
        if options.keep == "all" or in_time:
            reported[method] = carried_out(found, chain.batch_options(shared=False), console)
        if not in_time:
            size = correlate.field_bytes(settings, settings.grid()) if method == "volumes" else None
            batch = chain.in_pairs(method, found, size)
            reported[run_steps.RESULTS[method]] = carried_out(batch, chain.batch_options(shared=True), console)
    return counts | {"method": " and ".join(methods)} | _together(reported)


def with_overwrite(chain: Chain) -> str:
    """Return in words what a run that may overwrite makes again and what it keeps; nothing where that is not known."""
    try:
        reported = planned(chain)
    except LfpivError:
        return ""
    before = {"calibrate-snapshot": run_steps.CALIBRATION, "build-weights": run_steps.WEIGHTS}
    again = [before[step] for step in reported["steps_to_make"]]
    kept = [name for name in before.values() if name not in again]
    if again:
        again.append("what depends on it")
    else:
        for folder, number in reported["to_make"].items():
            # With how many of a folder's files are meant, unless all are.
            skipped = reported["skipped"][folder]
            again += [f"{number} of {number + skipped} {folder}" if skipped else folder] if number else []
            kept += [f"{skipped} of {number + skipped} {folder}" if number else folder] if skipped else []
        in_time = "particles" in reported["to_make"] and not chain.pairs.separate
        if in_time and (reported["to_make"]["particles"] or _weights_to_come(chain) is not None):
            again.append("tracks")
        if again and chain.options.combine:
            again.append("combined")
    if not again:
        return ""
    made, left = (" and ".join(filter(None, (", ".join(names[:-1]), names[-1]))) for names in (again, kept or [""]))
    return f"; with it the run makes {made} again" + (f" and keeps {left}" if kept else "")


def _weights_to_come(chain: Chain) -> Gone | None:
    """Return the weights with the record that they will carry; None where it is the one that they have."""
    weights = chain.steps.output / run_steps.WEIGHTS
    made = build_weights.target_of(chain.config, weights, chain.made_with).record
    return None if without_warnings(carried_record(weights)) == made else Gone(sha256(weights), made)


def _from_nothing(chain: Chain) -> dict[str, Any]:
    """Return what is made where there are no weights yet."""
    settings, options, console = chain.settings, chain.options, chain.steps.console
    grid = settings.grid()
    good = [k for k in chain.order if chain.frames[k].fault is None]
    whole = [number for number in chain.share if set(chain.pairs.pairs[number]) <= set(good)]
    asked = "particles" if options.follow and options.method == "auto" else options.method
    methods: list[FlowMethod] = ["volumes", "particles"] if asked == "both" else ["volumes"]
    if asked == "particles":
        methods = ["particles"]
    calibration = chain.steps.output / run_steps.CALIBRATION
    cost: Cost | None = None
    # What the weights will cost is not always known without a calibration.
    with contextlib.suppress(LfpivError):
        plan = build_weights.plan_of(
            settings, calibration_file.open_calibration(calibration) if calibration.exists() else None
        )
        cost = cost_of(settings, plan.camera, plan.source, plan.grid.padded(plan.padding))
    held = None if cost is None else cost.image_bytes
    sizes = {
        "volumes": (FLOAT_BYTES * math.prod(grid.shape_xyz), correlate.field_bytes(settings, grid)),
        "particles": (None, None),
    }
    reported = {}
    counts = ((len(chain.order), len(good)), (len(chain.share), len(whole)))
    for method in methods:
        names = ((method, "reconstruct"), (run_steps.RESULTS[method], "correlate" if method == "volumes" else "track"))
        for (folder, label), (given, count), size in zip(names, counts, sizes[method], strict=True):
            dropped = options.keep == "results" and chain.pairs.separate | (method == "volumes")
            if dropped and folder == method:
                continue  # the files of a pair at a time
            made_by, numbers = "reconstruct" if dropped else label, {"to_make": count, "skipped": 0}
            numbers["unreadable"] = given - count
            reported[folder] = estimate(made_by, numbers, (), Expected(size, held), chain.steps.output, console)
    told_method = f"{asked}, reckoned as volumes" if asked == "auto" else asked
    built = {"weights_mb": None if cost is None else cost.weights_bytes / MB}
    return {"method": told_method} | built | _together(reported)


def _together(reported: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return what several batches tell: the counts of each, the sums of disk and time, the most of memory."""
    working = [each for each in reported.values() if each["to_make"]]
    figures: dict[str, Any] = {
        key: {name: each[key] for name, each in reported.items()} for key in ("to_make", "skipped", "unreadable")
    }
    for key, by in (("disk_mb", "disk_by"), ("seconds", "seconds_by")):
        # A sum is known where all its parts are.
        known = [each[key] for each in working]
        figures |= {key: None if None in known else sum(known), by: _words(by, working)}
        if key == "disk_mb":
            figures["disk_free_mb"] = next(iter(reported.values()))["disk_free_mb"]
    memory = [each["memory_mb"] for each in working if each["memory_mb"] is not None]
    figures |= {"memory_mb": max(memory, default=None), "memory_by": _words("memory_by", working)}
    listed = [path for each in reported.values() for path in each.get("would_make", ())]
    return figures | ({"would_make": listed} if listed else {})


def _words(key: str, reported: Sequence[Mapping[str, Any]]) -> str | None:
    """Return all the ways in which a figure is known."""
    return "; ".join(dict.fromkeys(each[key] for each in reported if each[key])) or None


# Warming up is a small experiment, in which every step is taken once, so that all kernels are compiled.

# A corner of the paper's sensor and a thin channel, as small as every step still works on.
RIG = """\
camera:
  main_lens:   {magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}
  microlenses: {focal_length_mm: 0.8, pitch_mm: 0.1, layout: square}
  sensor:      {pixel_um: 5.5, columns: 450, rows: 448, microlens_distance_mm: 0.8, column_axis: x}
media:   {air: 1.0, window: 1.49, fluid: 1.33}
channel: {width_mm: 3.0, wall_mm: 2.0}
board:   {dots: [4, 4], spacing_mm: 0.5, dot_diameter_mm: 0.15, thickness_mm: 0.0}
volume:  {shape_xyz: [20, 20, 28], voxel_mm: 0.1, centre_mm: [0, 0, 0], reference: mid_plane}
reconstruction: {solver: em, iterations: 4}
correlation:    {windows: [16, 10], overlap: 0.5, dt_s: 0.002}
simulation:
  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}
  particles: 80
  particle_diameter_mm: 0.05
  frames: 4
  board_z_mm: 2.2
  distortion_per_mm2: 2.0e-5
  seed: 3
"""
WARM_UP_STEPS = 3


def warm_up(*, console: Console = CONSOLE) -> dict[str, Any]:
    """Compile all kernels into numba's folder, by simulating a small experiment and measuring it each way."""
    quiet = Console(quiet=True)
    with tempfile.TemporaryDirectory() as name, console.progress(WARM_UP_STEPS, "warm-up") as advance:
        folder = Path(name)
        config = folder / "rig.yaml"
        atomic.write_text(config, RIG, overwrite=False)
        for simulate in (simulate_white, simulate_board, simulate_particles):
            simulate(config, folder, console=quiet)
        advance(1)
        images = [folder / frame for frame in frame_names(load_rig(config).simulation.frames)]
        recording = RunOptions(
            images=images[:2],
            white=(folder / "white.tif",),
            dark=folder / "dark.tif",
            board=(folder / "board.tif",),
            report=False,
        )
        run(config, folder / "pair", replace(recording, method="both", combine=True), console=quiet)
        advance(1)
        run(config, folder / "sequence", replace(recording, images=images, follow=True), console=quiet)
        advance(1)
    return {"steps": WARM_UP_STEPS}


PICTURE, PAGE = "latest.png", "latest.html"
HEAD = ("first image", "tracers per microlens", "vectors", "u (m/s)", "v (m/s)", "w (m/s)", "verdict", "seconds")
# Pairs that the page lists, how often a browser reads it anew, and what stands for a figure that is not known.
LISTED, RELOAD_S, UNKNOWN = 30, 2, "–"

# Frames that are measured together: those of a pair, or of a file that holds several.
Together = list[tuple[Frame, Frame]]


def watch(
    config: Path, settings: Config, output: Path, options: RunOptions, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Calibrate, then measure each pair of folders that are still being filled when both images are there.

    Once nothing has changed for the idle time, all that has come is taken through `run`, which tells of all.

    Raises
    ------
    UsageError : something is made from all frames
    PartialError : frames or pairs failed, or have no partner
    """
    options.ensure_one_by_one()
    if options.follow or options.pairing == "sequence":
        raise UsageError("--watch measures separate pairs (--pairing ab); run a sequence when all of it is there")
    if options.dask:
        raise UsageError("--dask: a pair is measured as it comes, one at a time; with --watch leave it out")
    options = replace(options, keep_going=True, pairing=options.pairing if options.are_told else "ab")
    run_choice.ensure_inputs(settings, replace(options, images=()))
    come = watched(options.images, "images", options, options.idle_s, console)
    atomic.ensure_writable(output / run_steps.RECORD, overwrite=True)
    watching = Watching(config, settings, output, options, overwrite, console)
    watching.chain([], console, recorded=True).weights()
    left_out: list[Failure] = []
    coming = (frames_of(files, keep_going=True) for files in come)
    try:
        for pairs in coming_pairs(coming, images_seen, options, console, left_out):
            watching.take(pairs)
        watching.take([], last=True)
    finally:
        console.say(f"{watching.count} pairs are done, in {output}; the same command goes on")
    if not watching.every:
        raise InputError(f"{left_out[0].name}: {left_out[0].error}")
    # Through all steps, which are found complete.
    chain = watching.chain(watching.every, replace(console, only_warnings=True), recorded=True)
    chain.steps.failures.extend(left_out)
    return run_choice.take_all(chain)


@dataclass
class Watching:
    """The pairs that have come so far, and what they share.

    Attributes
    ----------
    count, every : how many pairs are measured, and all that have come
    """

    config: Path
    settings: Config
    output: Path
    options: RunOptions
    overwrite: bool
    console: Console
    count: int = 0
    _prepared: Prepared = field(default_factory=Prepared)
    _choice: Choice | None = None
    every: Together = field(default_factory=list)
    _waiting: Together = field(default_factory=list)

    def __post_init__(self) -> None:
        """Say what a pair's steps say in its line alone."""
        self._quiet = replace(self.console, only_warnings=True)
        self._latest = Latest(self.output, self.console, self.options.report)
        self._weights = self.output / run_steps.WEIGHTS

    def chain(self, pairs: Together, console: Console, recorded: bool) -> Chain:
        """Return the steps of some pairs."""
        options, frames = self.options, [frame for pair in pairs for frame in pair]
        earlier = run_steps.earlier_run(self.output, self.overwrite) if recorded else {}
        steps = Steps(self.output, console, earlier, options.deadline(), recorded)
        given = replace(options, images=list(dict.fromkeys(frame.path for frame in frames)))
        two_by_two = Pairs(tuple((k, k + 1) for k in range(0, len(frames), 2)))
        return Chain(self.config, self.settings, given, frames, two_by_two, steps, self.overwrite, self._prepared)

    def take(self, pairs: Together, last: bool = False) -> None:
        """Measure pairs; the first ones when the tracers' size is known, or no others are to come."""
        self.every += pairs
        self._waiting += pairs
        if not self._waiting or not self._is_ready(last) or self._choice is None:
            return
        waiting, self._waiting, choice = self._waiting, [], self._choice
        # Pages of one file belong to pairs that are measured together.
        together = groupby(waiting, key=lambda pair: {frame.path for frame in pair})
        if kept := sum(self._measure(list(those), choice) for _, those in together):
            self.console.say(f"{kept} pairs are complete and kept")

    def _is_ready(self, last: bool) -> bool:
        """Return whether all that pairs share is known, once the first have shown it."""
        chain = self.chain(self._waiting, self._quiet, recorded=False)
        if self._choice is None:
            try:
                self._choice = run_choice.chosen(
                    self.settings, self.options, lambda: run_choice.counted(chain, self._weights)
                )
            except InputError as error:
                for pair in self._waiting:
                    self._latest.failed(pair[0].path.name, str(error))
                self._waiting = []
                return False
            self.console.say(f"by {' and '.join(self._choice.methods)}: {self._choice.reason}")
            head = "velocities are means, ± the usual standard error of one vector"
            self.console.answer(f"{', '.join(HEAD)}; {head}")
        if "particles" not in self._choice.methods or self._prepared.size is not None:
            return True
        bench, read = run_choice.bench_and_reader(chain, self._weights)
        numbers = range(min(len(chain.frames), LOOKED_AT))
        seen = (particles.frame_of(bench, *each) for each in readable(read, numbers, keep_going=True))
        found = particles.size_of(bench, seen)
        if not (found.is_certain or len(chain.frames) >= LOOKED_AT or last):
            self.console.say("too few tracers stand alone to tell their size: waits for the next pair")
            return False
        self._prepared.size = found
        return True

    def _measure(self, pairs: Together, choice: Choice) -> int:
        """Take pairs through all steps, and tell of each; return how many were complete before."""
        begun, name = time.monotonic(), pairs[0][0].path.name
        chain = self.chain(pairs, self._quiet, recorded=False)
        try:
            fields = chain.measured(choice.methods, self._weights)
        except InputError as error:
            fields = {}
            if not chain.steps.failures:
                chain.steps.failures.append(Failure(name, str(error)))
        if chain.steps.failures:
            self._latest.failed(name, chain.steps.failures[0].error)
        vectors = list(fields.values())[-1] if fields else {}
        if not chain.steps.count(run_steps.MADE):
            self.count += len(vectors)
            return len(vectors)
        by_rays = self.settings.weights.method != "dlfc"
        tracers = run_choice.counted(chain, self._weights) if vectors and by_rays else None
        seconds = time.monotonic() - begun
        chain.steps.deadline.took(seconds)
        for number, path in vectors.items():
            files = [self.output / run_steps.CALIBRATION, self._weights, *chain.steps.files]
            self._latest.measured(pairs[number][0].stem, tracers, files, path, seconds / len(pairs))
            self.count += 1
        return 0


@dataclass
class Latest:
    """What is shown of the pairs.

    Attributes
    ----------
    output : the folder of the results
    draws : whether the last pair is drawn, too
    """

    output: Path
    console: Console
    draws: bool
    _rows: deque[tuple[str, ...]] = field(default_factory=lambda: deque(maxlen=LISTED))

    def failed(self, name: str, error: str) -> None:
        """Tell of a pair that could not be measured."""
        self._tell(name, ((UNKNOWN,) * 5 + ("no", UNKNOWN)), f"failed: {error}", {"error": error})

    def measured(
        self, name: str, tracers_per_lens: float | None, made: Sequence[Path], vectors: Path, seconds: float
    ) -> None:
        """Tell of a pair whose files are `made`, and draw its vectors."""
        contents = contents_of(self.output, made)
        fields = {path: open_vectors(path) for path in contents.of("vectors")}
        flow, parts = fields[vectors], judged(contents, fields)
        mean, sigma = checks.velocity_of(flow)
        verdict = checks.worst((line for lines in parts.values() for line in lines), "good")
        cells = (
            UNKNOWN if tracers_per_lens is None else written(tracers_per_lens, 2),
            str(np.count_nonzero(flow.flag == VALID)),
            *map(with_error, mean.tolist(), sigma.tolist()),
            verdict,
            f"{seconds:.1f}",
        )
        tracers, number, u, v, w, *_ = cells
        line = f"{tracers} per microlens  {number} vectors  u {u}  v {v}  w {w} m/s  {verdict}  {seconds:.1f} s"
        figures = {"velocity_m_s": mean.tolist(), "velocity_sigma_m_s": sigma.tolist(), "verdict": verdict}
        self._tell(name, cells, line, figures | {"tracers_per_lens": tracers_per_lens, "seconds": seconds}, flow)

    def _tell(
        self, name: str, cells: tuple[str, ...], line: str, figures: Mapping[str, Any], flow: VectorField | None = None
    ) -> None:
        """Print a pair's line, add it to the log, and renew the page, with its picture where there is one."""
        self.console.answer(f"{name}  {line}")
        self.console.event("pair", name=name, **atomic.without_nan(dict(figures)))
        if not self.draws:
            return
        self._rows.appendleft((name, *cells))
        picture = self.output / PICTURE
        if flow is not None:
            write_picture(picture, planes_figure(flow), overwrite=True)
        shown = (Picture(picture, "The last pair that was measured"),) if picture.exists() else ()
        table = Table("The last one first", HEAD, tuple(self._rows))
        foot = f"Renews itself every {RELOAD_S} s; velocities are means, ± the usual standard error of one vector."
        sections = (Section("The last pair", "latest", pictures=shown), Section("Pairs", "pairs", tables=(table,)))
        page = Page(f"{name}: {line.replace('  ', ', ')}", (), (), sections, foot, reload_s=RELOAD_S)
        write_pages(page, [self.output / PAGE], overwrite=True)
