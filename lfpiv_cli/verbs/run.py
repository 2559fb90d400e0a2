"""`run`: from raw images to vectors, by the stages of the single commands.

In the output folder: `calibration.h5`, `calibration.png`, `weights.h5`; by volumes `volumes/STEM.vtkhdf` and
`vectors.vtkhdf`; by particles `particles/STEM.vtkhdf`, `tracks.vtkhdf` and `tracks_grid.vtkhdf`; of both together
`combined.vtkhdf`; of several pairs the folders `vectors`, `tracks` and `combined`. `run.json` says what was chosen,
why, and what each step told; `report.html` shows all of it.

What a run would make is known before anything is made. With weights at hand each batch tells of itself; before there
are any, nothing else can be complete: frames and pairs are counted, and their files taken for as large as their arrays.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError, InputError, LfpivError, OutputExistsError, PartialError, UsageError
from lfpiv_cli.files import atomic, calibration_file, inputs, pages
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame, frames_of, images_seen, output_paths, pending
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import Gone, carried_record, sha256, without_warnings
from lfpiv_cli.names import FlowMethod
from lfpiv_cli.notice import written
from lfpiv_cli.verbs import build_weights, calibrate, checks, correlate, particles, run_steps
from lfpiv_cli.verbs.batches import ALL, MB, Expected, Failure, Worked, dry_run, estimate
from lfpiv_cli.verbs.follow import SEQUENCE_IS_WHOLE, TRACKS, follow_particles
from lfpiv_cli.verbs.following import SHORTEST, ensure_sequence
from lfpiv_cli.verbs.frames import Bench, Read, other_frames, read_frame
from lfpiv_cli.verbs.pairs import found_pairs
from lfpiv_cli.verbs.report import ReportOptions, report
from lfpiv_cli.verbs.run_steps import Chain, RunOptions, Steps, Vectors
from lfpiv_cli.verbs.simulate import frame_names, simulate_board, simulate_particles, simulate_white
from lfpiv_cli.verbs.weights_cost import FLOAT_BYTES, Cost, cost_of, ensure_volume_fits

REPORT = "report.html"

# Vectors by particles err less than those by volumes up to 1.9 tracers for each microlens, and more from 2.4 on, in the
# laminar channel of the paper.
MOST_FOR_PARTICLES = 2.0


@dataclass(frozen=True)
class Choice:
    """By which methods a flow is measured, and why; the tracers for each microlens where they were counted."""

    methods: tuple[FlowMethod, ...]
    reason: str
    tracers_per_lens: float | None = None

    def reported(self) -> dict[str, Any]:
        """Return what is told of it."""
        method = self.methods[0] if len(self.methods) == 1 else "both"
        return {"method": method, "reason": self.reason, "tracers_per_lens": self.tracers_per_lens}


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
        from lfpiv_cli.verbs.watch import watch

        return watch(config, settings, output, options, overwrite, console)
    frames, pairs = _ensure_possible(settings, options)
    console.warn(pairs.settled(options.keep_going))
    steps = Steps(output, console, run_steps.earlier_run(output, overwrite), options.deadline(), options.shard == ALL)
    chain = Chain(config, settings, options, frames, pairs, steps, overwrite)
    if not options.dry_run:
        ensure_volume_fits(settings, options.method in ("volumes", "both"))
    try:
        return planned(chain) if options.dry_run else take_all(chain)
    except OutputExistsError as error:
        chain.overwrite = True
        raise OutputExistsError(f"{error}{with_overwrite(chain)}") from error


def take_all(chain: Chain) -> dict[str, Any]:
    """Take all steps; return what is told of them (PartialError: something failed)."""
    steps, options, output = chain.steps, chain.options, chain.steps.output
    atomic.ensure_writable(output / run_steps.RECORD, overwrite=True)
    weights = chain.weights()
    if not chain.share:
        return steps.summary()
    choice = chosen(chain.settings, options, lambda: counted(chain, weights))
    steps.console.say(f"by {' and '.join(choice.methods)}: {choice.reason}")
    steps.reported.update(choice.reported())
    fields = measured(chain, choice, weights)
    figures = checks.figures_of({method: list(paths.values()) for method, paths in fields.items()})
    steps.reported["figures"] = figures
    reported = choice.reported() | figures
    if options.report and options.shard == ALL:
        raw = (
            *dict.fromkeys(frame.path for frame in chain.frames if frame.fault is None),
            *options.white,
            *options.board,
        )
        page = output / REPORT
        is_kept = page.exists() and not steps.count(run_steps.MADE)

        def make() -> dict[str, Any]:
            # Of all that the folder holds, where a step has made anything.
            if is_kept:
                return {}
            replacing = chain.overwrite or bool(steps.earlier)
            return report(output, page, ReportOptions(raw=raw), overwrite=replacing, console=steps.console)

        of_page = steps.take("report", [page], make)
        reported |= {"sentence": of_page.get("sentence"), "verdict": of_page.get("verdict"), "report": str(page)}
    steps.write(whole=True)
    reported |= steps.summary()
    # By both methods a frame fails twice.
    worked = Worked[None](failures=list(dict.fromkeys(chain.failures)))
    worked.list_failures(options.failures)
    reported["summary"] = in_words(chain, reported, [*fields.values()][-1], worked.failures)
    if worked.failures:
        first, records = worked.failures[0], [asdict(failure) for failure in worked.failures]
        number = "one frame or pair" if len(records) == 1 else f"{len(records)} frames or pairs"
        text = f"{number} failed, the first {first.name}: {first.error}"
        raise PartialError(text, reported | {"failures": records})
    return reported


def in_words(chain: Chain, reported: Mapping[str, Any], vectors: Vectors, failures: Sequence[Failure]) -> list[str]:
    """Return what a person wants to know of a run: what was found, what was made, and what to open next."""
    steps, output = chain.steps, chain.steps.output
    found: dict[str, list[str]] = {run_steps.MADE: [], run_steps.KEPT: []}
    for step in steps.reported["steps"].values():
        names = found[run_steps.MADE if step["state"] == run_steps.MADE else run_steps.KEPT]
        names += [name for name in dict.fromkeys(file.split("/")[0] for file in step["files"]) if name not in names]
    files = [f"{state}: {', '.join(names)}" for state, names in found.items() if names]
    flow = next(iter(vectors.values()), output / TRACKS if chain.options.follow else None)
    shown = [f"{reported['report']} in a browser"] if "report" in reported else []
    shown += [f"{flow} in ParaView"] if flow is not None else []
    return [
        *filter(None, [reported.get("sentence")]),
        f"by {reported['method'].replace('both', 'volumes and particles')}: {reported['reason']}",
        *(f"failed: {failure.name}: {failure.error}" for failure in failures),
        *files,
        f"open next: {', '.join(shown)}" if shown else f"all is in {output}",
        f"all figures: --json, -v, or {output / run_steps.RECORD}",
    ]


def measured(chain: Chain, choice: Choice, weights: Path) -> dict[str, Vectors]:
    """Return the files of vectors by each method; those that err least are the last."""
    fields: dict[str, Vectors] = {method: chain.vectors_by(method, weights) for method in choice.methods}
    if chain.options.combine:
        fields["combined"] = chain.combined(fields["volumes"], fields["particles"])
    return fields


def ensure_inputs(settings: Config, options: RunOptions) -> None:
    """Raise where settings, photographs or outputs are wrong, as far as it is known before the images are read."""
    if options.dt_s is None and settings.correlation.dt_s is None:
        # Whether recordings say when each frame was taken, those that can be read.
        reported = []
        for path in options.images:
            try:
                reported.append(image_files.frames(path).time_s is not None)
            except InputError:
                if not options.keep_going:
                    raise
        if not reported or not all(reported):
            raise ConfigError(
                f"{settings.source}: correlation.dt_s: is missing, and velocities need it; give it there, or --dt-s"
            )
    settings.camera_model()
    settings.grid()
    if options.board:
        settings.rig()
    if settings.weights.method != "dlfc" and settings.channel is None:
        settings.object_space()
    by_volumes, by_particles = (options.method in (method, "both") for method in ("volumes", "particles"))
    if options.combine and options.method != "both":
        raise UsageError("--combine needs --method both")
    if options.follow and options.method == "volumes":
        raise UsageError("--follow finds particles, but --method is volumes")
    if options.follow and options.shard != ALL:
        raise UsageError(SEQUENCE_IS_WHOLE)
    if options.follow and options.dask:
        raise UsageError("--dask: a sequence is followed from frame to frame, which workers cannot share")
    if options.follow and options.combine:
        raise UsageError("--follow gives tracks, and --combine needs vectors")
    if by_volumes and settings.reconstruction.solver == "particles":
        raise ConfigError(f"{settings.source}: reconstruction.solver: is particles; volumes need another one")
    if settings.weights.method == "dlfc" and (options.follow or by_particles):
        raise ConfigError(f"{settings.source}: weights.method: is dlfc, but particles are fitted with traced rays")
    pages.ensure_drawing()
    if options.report:
        pages.ensure_pages()
    calibrate.ensure_pictures(len(options.white), len(options.board), len(options.depth_mm))
    for path in (*options.white, *options.board):
        inputs.ensure_regular_file(inputs.split_part(path)[0])
    for path in filter(None, (options.dark, options.level.path, options.mask_file)):
        image_files.read_reference(path, settings.image_shape())
    if options.failures is not None:
        atomic.ensure_writable(options.failures, overwrite=True)


def _ensure_possible(settings: Config, options: RunOptions) -> tuple[list[Frame], Pairs]:
    """Return the frames of the flow and their pairs, after all that can be known to be wrong has been asked for."""
    ensure_inputs(settings, options)
    frames = frames_of(options.images, options.keep_going)
    if options.follow:
        ensure_sequence(len(frames), SHORTEST)
        pairs = Pairs(tuple(pairwise(range(len(frames)))), separate=False)
    else:
        pairs = found_pairs(images_seen(frames), options)
        pairs.settled(options.keep_going)
    output_paths(Path(), [frame.stem for frame in frames])
    _first_readable(frames, settings.image_shape(), options.keep_going)
    if not options.keep_going:
        for path in dict.fromkeys(frame.path for frame in frames):
            if image_files.frames(path).shape != settings.image_shape():
                image_files.read_image(path, 0, settings.image_shape())  # says what is wrong, before any is read
    return frames, pairs


def _first_readable(frames: Sequence[Frame], shape: tuple[int, int], keep_going: bool) -> int:
    """Return the number of the first frame; of those that can be read, where the others are to go on.

    Raises
    ------
    InputError : it cannot be read, or none can
    """
    for number, frame in enumerate(frames):
        try:
            read_frame(frame, shape)
        except InputError:
            if not keep_going or number == len(frames) - 1:
                raise
        else:
            return number
    raise InputError("no images were given")


def chosen(settings: Config, options: RunOptions, count_tracers: Callable[[], float | None]) -> Choice:
    """Return by which methods the flow is measured: those asked for, or what errs less with so many tracers."""
    if settings.weights.method == "dlfc":
        return Choice(("volumes",), "weights.method is dlfc, whose fitted rays particles cannot be fitted with")
    count = count_tracers()
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
    reason = (
        f"{written(count, 2)} tracers for each microlens, and {better} err less {side} about {MOST_FOR_PARTICLES:g}"
    )
    if asked is None or asked == better:
        return Choice((better,), reason, count)
    return Choice((asked,), f"as asked for; but there are {reason}", count)


def counted(chain: Chain, weights: Path) -> float | None:
    """Return how many tracers for each microlens the first image holds, as the run before has counted if it could."""
    settings, options, frames, steps = chain.settings, chain.options, chain.frames, chain.steps
    shape, level = settings.image_shape(), options.level
    order = chain.pairs.order(len(frames))
    first = order[_first_readable([frames[k] for k in order], shape, options.keep_going)]
    files = (weights, frames[first].path, *filter(None, (options.dark, level.path)))
    mask = "" if options.mask_file is None else sha256(options.mask_file)
    words = other_frames(level, frames)(first)
    counted_from = " ".join([*map(sha256, files), str(frames[first].page), mask, words])
    steps.reported["counted_from"] = hashlib.sha256(counted_from.encode()).hexdigest()
    if steps.earlier.get("counted_from") == steps.reported["counted_from"] and "tracers_per_lens" in steps.earlier:
        return cast("float | None", steps.earlier["tracers_per_lens"])
    bench, read = bench_and_reader(chain, weights)
    return particles.tracers_per_lens(bench, particles.frame_of(bench, *read(first)))


def bench_and_reader(chain: Chain, weights: Path) -> tuple[Bench, Read]:
    """Return what frames share where particles are sought in them, and what reads a frame."""
    content = chain.prepared.searchable(weights, chain.settings)
    # What stands still would take a look at every image, and a pair hardly shows it better than one counts without.
    options = replace(chain.options, mask=chain.options.mask_file)
    return chain.prepared.reading(content, chain.settings, chain.frames, options, options.keep_going)


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
    methods = chosen(settings, options, lambda: counted(chain, weights)).methods
    reported: dict[str, dict[str, Any]] = {}
    for method in methods:
        if options.follow:
            # The frames of a sequence depend on the whole config.
            whole = replace(chain.following(dry_run=True), resume=to_come is None)
            reported[method] = follow_particles(weights, options.images, output, whole, **chain.common)
            continue
        found = chain.reconstruction(method, weights, to_come)
        in_time = method == "particles" and not chain.pairs.separate
        if options.keep == "all" or in_time:
            reported[method] = dry_run(found, chain.batch_options(shared=False), console)
        if not in_time:
            size = correlate.field_bytes(settings, settings.grid()) if method == "volumes" else None
            batch = chain.in_pairs(method, found, size)
            reported[run_steps.RESULTS[method]] = dry_run(batch, chain.batch_options(shared=True), console)
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
