"""What a run would make, before anything is made: which files, how much disk and memory, in which time.

With weights at hand each batch tells of itself. Before there are any, nothing else can be complete: frames and pairs
are counted, and their files taken for as large as their arrays are.
"""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lfpiv_cli.errors import LfpivError
from lfpiv_cli.files.batch import pending
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.provenance import Gone, carried_record, sha256, without_warnings
from lfpiv_cli.names import FlowMethod
from lfpiv_cli.verbs import build_weights, calibrate
from lfpiv_cli.verbs.batches import AT_MOST, MB, RECORD_BYTES, Expected, dry_run, time_and_memory
from lfpiv_cli.verbs.build_weights import plan_of
from lfpiv_cli.verbs.correlate import field_bytes
from lfpiv_cli.verbs.follow import follow_particles
from lfpiv_cli.verbs.run_steps import CALIBRATION, RESULTS, WEIGHTS, Chain
from lfpiv_cli.verbs.weights_cost import FLOAT_BYTES, Cost, cost_of


def planned(settings: Config, chain: Chain, choose: Callable[[Path], Sequence[FlowMethod]]) -> dict[str, Any]:
    """Return what a run would make, and what that takes; write nothing.

    Parameters
    ----------
    choose : tells by which methods the flow will be measured, by the weights

    Raises
    ------
    LfpivError : the run would not begin; as where calibration or weights are there, and were made from something else
    """
    output, options, console = chain.steps.output, chain.options, chain.steps.console
    targets = {
        "calibrate-snapshot": calibrate.target_of(chain.config, output / CALIBRATION, chain.photographs),
        "build-weights": build_weights.target_of(chain.config, output / WEIGHTS, chain.made_with),
    }
    before: list[str] = []
    for name, target in targets.items():
        # What is made of something that is not there yet is made after it.
        if before or pending([target], (), chain.common["overwrite"], resume=True, dry=True):
            before.append(name)
    counts = {"frames": len(chain.order), "pairs": len(chain.share), "steps_to_make": before}
    if before:
        return counts | _from_nothing(settings, chain)
    weights, to_come = output / WEIGHTS, _weights_to_come(chain)
    methods = choose(weights)
    told: dict[str, dict[str, Any]] = {}
    for method in methods:
        if options.follow:
            # The frames of a sequence depend on the whole config.
            chosen = replace(chain.following(dry_run=True), resume=to_come is None)
            told[method] = follow_particles(weights, options.images, output, chosen, **chain.common)
            continue
        found = chain.reconstruction(method, weights, to_come)
        in_time = method == "particles" and not chain.pairs.separate
        if options.keep == "all" or in_time:
            told[method] = dry_run(found, chain.batch_options(shared=False), console)
        if not in_time:
            size = field_bytes(settings, settings.grid()) if method == "volumes" else None
            batch = chain.in_pairs(method, found, size)
            told[RESULTS[method]] = dry_run(batch, chain.batch_options(shared=True), console)
    return counts | {"method": " and ".join(methods)} | _together(told, output)


def with_overwrite(settings: Config, chain: Chain, choose: Callable[[Path], Sequence[FlowMethod]]) -> str:
    """Return in words what a run that may overwrite makes again and what it keeps; nothing where that is not known."""
    try:
        told = planned(settings, chain, choose)
    except LfpivError:
        return ""
    before = {"calibrate-snapshot": CALIBRATION, "build-weights": WEIGHTS}
    again = [before[step] for step in told["steps_to_make"]]
    kept = [name for name in before.values() if name not in again]
    if again:
        again.append("what depends on it")
    else:
        for folder, number in told["to_make"].items():
            # With how many of a folder's files are meant, unless all are.
            skipped = told["skipped"][folder]
            again += [f"{number} of {number + skipped} {folder}" if skipped else folder] if number else []
            kept += [f"{skipped} of {number + skipped} {folder}" if number else folder] if skipped else []
        in_time = "particles" in told["to_make"] and not chain.pairs.separate
        if in_time and (told["to_make"]["particles"] or _weights_to_come(chain) is not None):
            again.append("tracks")
        if again and chain.options.combine:
            again.append("combined")
    if not again:
        return ""
    made, left = (" and ".join(filter(None, (", ".join(names[:-1]), names[-1]))) for names in (again, kept or [""]))
    return f"; with it the run makes {made} again" + (f" and keeps {left}" if kept else "")


def _weights_to_come(chain: Chain) -> Gone | None:
    """Return the weights with the record that they will carry; None where it is the one that they have."""
    weights = chain.steps.output / WEIGHTS
    made = build_weights.target_of(chain.config, weights, chain.made_with).record
    return None if without_warnings(carried_record(weights)) == made else Gone(sha256(weights), made)


def _from_nothing(settings: Config, chain: Chain) -> dict[str, Any]:
    """Return what is made where there are no weights yet."""
    options, grid, console = chain.options, settings.grid(), chain.steps.console
    good = [k for k in chain.order if chain.frames[k].fault is None]
    whole = [number for number in chain.share if set(chain.pairs.pairs[number]) <= set(good)]
    asked = "particles" if options.follow and options.method == "auto" else options.method
    methods: list[FlowMethod] = ["volumes", "particles"] if asked == "both" else ["volumes"]
    if asked == "particles":
        methods = ["particles"]
    calibration = chain.steps.output / CALIBRATION
    cost: Cost | None = None
    # What the weights will cost is not always known without a calibration.
    with contextlib.suppress(LfpivError):
        plan = plan_of(settings, read_calibration(calibration) if calibration.exists() else None)
        cost = cost_of(settings, plan.camera, plan.source, plan.grid.padded(plan.padding))
    held = None if cost is None else cost.image_bytes
    sizes = {
        "volumes": (FLOAT_BYTES * math.prod(grid.shape_xyz), field_bytes(settings, grid)),
        "particles": (None, None),
    }
    told = {}
    counts = ((len(chain.order), len(good)), (len(chain.share), len(whole)))
    for method in methods:
        names = ((method, "reconstruct"), (RESULTS[method], "correlate" if method == "volumes" else "track"))
        for (folder, label), (given, count), size in zip(names, counts, sizes[method], strict=True):
            dropped = options.keep == "results" and chain.pairs.separate | (method == "volumes")
            if dropped and folder == method:
                continue  # the files of a pair at a time
            disk = None if size is None else count * (size + RECORD_BYTES) / MB
            told[folder] = {
                "to_make": count,
                "skipped": 0,
                "unreadable": given - count,
                "disk_mb": disk,
                "disk_by": None if disk is None else AT_MOST,
            } | time_and_memory("reconstruct" if dropped else label, count, Expected(size, held), console)
    told_method = f"{asked}, reckoned as volumes" if asked == "auto" else asked
    built = {"weights_mb": None if cost is None else cost.weights_bytes / MB}
    return {"method": told_method} | built | _together(told, chain.steps.output)


def _together(told: Mapping[str, Mapping[str, Any]], output: Path) -> dict[str, Any]:
    """Return what several batches tell: the counts of each, the sums of disk and time, the most of memory."""
    working = [each for each in told.values() if each["to_make"]]
    there = next(path for path in (output.absolute(), *output.absolute().parents) if path.exists())
    figures: dict[str, Any] = {
        key: {name: each[key] for name, each in told.items()} for key in ("to_make", "skipped", "unreadable")
    }
    for key, name in (("disk_mb", "disk"), ("seconds", "seconds")):
        # A sum is known where all its parts are.
        known = [each[key] for each in working]
        figures |= {key: None if None in known else sum(known), f"{name}_by": _words(f"{name}_by", working)}
        if name == "disk":
            figures["disk_free_mb"] = shutil.disk_usage(there).free / MB
    memory = [each["memory_mb"] for each in working if each["memory_mb"] is not None]
    figures |= {"memory_mb": max(memory, default=None), "memory_by": _words("memory_by", working)}
    listed = [path for each in told.values() for path in each.get("would_make", ())]
    return figures | ({"would_make": listed} if listed else {})


def _words(key: str, told: Sequence[Mapping[str, Any]]) -> str | None:
    """Return all the ways in which a figure is known."""
    return "; ".join(dict.fromkeys(each[key] for each in told if each[key])) or None
