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
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import LfpivError, OutputExistsError
from lfpiv_cli.files import atomic, calibration_file
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame, frames_of, images_seen, output_paths, pending
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import Gone, carried_record, sha256, without_warnings
from lfpiv_cli.names import FlowMethod
from lfpiv_cli.verbs import build_weights, calibrate, correlate, run_choice, run_steps
from lfpiv_cli.verbs.batches import ALL, MB, Expected, carried_out, estimate
from lfpiv_cli.verbs.follow import follow_particles
from lfpiv_cli.verbs.following import SHORTEST, ensure_sequence
from lfpiv_cli.verbs.pairs import found_pairs
from lfpiv_cli.verbs.run_steps import Chain, RunOptions, Steps
from lfpiv_cli.verbs.simulate import frame_names, simulate_board, simulate_particles, simulate_white
from lfpiv_cli.verbs.watch import watch
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
        chain.overwrite = True
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
