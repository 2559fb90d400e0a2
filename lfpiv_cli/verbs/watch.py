"""`--watch`: each pair of a folder as a camera fills it, with a line for each and the picture of the last one.

A pair is taken through the steps of `run` by itself. What its frames share with all others is known before:
calibration and weights, by which methods the flow is measured (from the first pair), and the tracers' size, for which
pairs are waited for until the first images show it. So the files are those of `run` once all pairs are there.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import atomic
from lfpiv_cli.files.batch import Frame, frames_of, images_seen
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.pages import Page, Picture, Section, Table, write_pages, write_picture
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.flow.field import VALID, VectorField
from lfpiv_cli.notice import with_error, written
from lfpiv_cli.pictures.vectors import planes_figure
from lfpiv_cli.verbs import checks, particles, run_choice, run_steps
from lfpiv_cli.verbs.batches import Failure
from lfpiv_cli.verbs.contents import contents_of, judged
from lfpiv_cli.verbs.frames import readable
from lfpiv_cli.verbs.pairs import coming_pairs, watched
from lfpiv_cli.verbs.particles import LOOKED_AT, Prepared
from lfpiv_cli.verbs.run_choice import Choice
from lfpiv_cli.verbs.run_steps import Chain, RunOptions, Steps

PICTURE, PAGE = "latest.png", "latest.html"
HEAD = ("first image", "tracers per microlens", "vectors", "u (m/s)", "v (m/s)", "w (m/s)", "verdict", "seconds")
# Pairs that the page lists, and how often a browser reads it anew.
LISTED, RELOAD_S = 30, 2
UNKNOWN = "–"

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
    chain.failures = list(left_out)
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
        waiting, self._waiting = self._waiting, []
        kept = 0
        # Pages of one file belong to pairs that are measured together.
        for _, those in groupby(waiting, key=lambda pair: {frame.path for frame in pair}):
            kept += self._measure(list(those), self._choice)
        if kept:
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
            fields = run_choice.measured(chain, choice, self._weights)
        except InputError as error:
            fields = {}
            chain.failures = chain.failures or [Failure(name, str(error))]
        if chain.failures:
            self._latest.failed(name, chain.failures[0].error)
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
