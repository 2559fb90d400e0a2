"""By which methods `run` measures a flow, and all its steps taken together.

What settings, photographs and outputs lack is known before the first step; how many tracers there are, by which the
program chooses, when there are weights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

from lfpiv_cli.errors import ConfigError, InputError, PartialError, UsageError
from lfpiv_cli.files import atomic, inputs, pages
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.names import FlowMethod
from lfpiv_cli.notice import written
from lfpiv_cli.verbs import calibrate, checks, particles, run_steps
from lfpiv_cli.verbs.batches import ALL, Failure, Worked
from lfpiv_cli.verbs.follow import SEQUENCE_IS_WHOLE, TRACKS
from lfpiv_cli.verbs.frames import Bench, Read, other_frames, read_frame
from lfpiv_cli.verbs.report import ReportOptions, report
from lfpiv_cli.verbs.run_steps import Chain, RunOptions, Vectors

REPORT = "report.html"

# Up to so many tracers for each microlens vectors by particles err less than those by volumes in the laminar channel of
# the paper; more were not tried.
MOST_FOR_PARTICLES = 3.0


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
    fields = chain.measured(choice.methods, weights)
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
    worked = Worked[None](failures=list(dict.fromkeys(steps.failures)))
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


def first_readable(frames: Sequence[Frame], shape: tuple[int, int], keep_going: bool) -> int:
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
    first = order[first_readable([frames[k] for k in order], shape, options.keep_going)]
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
