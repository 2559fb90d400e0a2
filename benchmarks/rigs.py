"""Other people's rigs: whole experiments on cameras drawn at random, by the program's own commands, against the truth.

    python -m benchmarks rigs [--hard] [--seed S] [--rigs N] [--only K] [--lenses COLUMNS ROWS] [--out FILE]
                              [--without-volumes]

Each is simulated with its camera as it is (white, dark, board or none, a pair of tracers' images, dirt on the sensor),
then calibrated, reconstructed and measured with its owner's configuration. With `--hard` there are boards of dots of
0.4 to 3 microlenses up to three depth units off the focal plane, haze, falloff, long moves, and tracers outside the
volume. With `--out` each is a line of JSON at the end of a file, and those that are in it are not run again. What came
of it is one of

- refused: a sentence before the work starts, or no track at all and a warning,
- failed: a sentence later on, or a crash,
- unknown: a result that is wrong as a data sheet is that no image tells of; `check` says so, and by how much,
- warned: a result that is wrong, with a warning,
- silent: a result that is wrong without one,
- worked: of these, how many were warned of something that is wrong with their pictures although all is right.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from click.testing import CliRunner

from benchmarks.rig_drawing import WRONG, DrawnRig, draw, hardened
from benchmarks.rig_judging import (
    SMALLEST_COVERAGE,
    Figures,
    judge_calibration,
    judge_particles,
    judge_tracks,
    judge_vectors,
    offset_mm,
    true_warnings,
    truth_of,
)
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import LfpivError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.images import read_image, write_tiff
from lfpiv_cli.synthetic.render import render_white
from lfpiv_cli.synthetic.scenes import RecordingCamera
from lfpiv_cli.verbs.simulate import readout_of, real_camera

RIGS, SEED = 40, 20261122
# Samples along each side of a white image's pixel.
WHITE_SAMPLES = 4
VERDICTS = ("worked", "refused", "failed", "unknown", "warned", "silent")
# Steps that come before the work: what cannot work is to be refused in one of them.
BEFORE_THE_WORK = ("calibrate-snapshot", "build-weights")
# Bits of the finest sensor.
FINEST_BITS = 16
# Standard deviation of a speck's shadow in pixels, and its depth.
SPECK_PX, SPECK_DEPTH = (0.7, 4.0), (0.1, 0.8)
# A result is wrong where a slope is off by more (and by more than two of its standard errors), where less than this
# share of bright tracers is found, or of what is found are tracers, where fewer errors lie within 1.96 standard errors,
# of so many at least, and where less than this share of the tracers found is followed into the second image.
SMALLEST_TRACKED, SMALLEST_PRECISION = 0.5, 0.5
WRONG_SLOPE, SMALLEST_RECALL, FEWEST = 0.02, 0.5, 20
# A magnification is wrong that is off by more, and by more than so many of its standard errors.
WRONG_MAGNIFICATION, WRONG_SIGMAS = 0.002, 3.0
# So are depths off together by more voxels, a tenth of the depth of one lens, and standard errors of the board's.
WRONG_DEPTH = 0.5
# Tracers are bright where at least this share of them could be told from noise alone.
BRIGHT_SHARE = 0.5

# What no image tells: what `check` says of it, by how much it is off, and which places it makes wrong by more than is
# stated; velocities are off by no larger a share.
BELIEVED = {
    "index": ("media.fluid of [0-9.]+: 1% more makes depths and w 1% larger", WRONG["index"][1], "z"),
    "focal length": (r"focal_length_mm of [0-9.]+: 1% more moves places .* um across", WRONG["focal length"][1], "xyz"),
}

# Advice on what a good rig measures or believes, which says nothing against its pictures; it tells of no wrong result.
ADVICE = {
    "depth-ambiguous",
    "vectors-in-doubt",
    "few-tracers",
    "no-uncertainty",
    "windows-too-large",
    "volume-out-of-view",
    "heavy-work",
    "few-particles",
    "no-board",
}


@dataclass
class Step:
    """A command that was run: its exit code, its error, and what it warned of."""

    command: str
    exit_code: int
    error: str
    warnings: list[str]
    seconds: float


@dataclass
class Outcome:
    """What came of a rig."""

    number: int
    name: str
    wrong_value: str
    hard: tuple[str, ...] = ()
    steps: list[Step] = field(default_factory=list)
    figures: Figures = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    verdict: str = ""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    believed: str = ""

    @property
    def said(self) -> list[str]:
        """All warnings."""
        return [text for step in self.steps for text in step.warnings]

    @property
    def error(self) -> str:
        """The first step that failed, and its sentence."""
        failed = [step for step in self.steps if step.exit_code]
        return f"{failed[0].command} ({failed[0].exit_code}): {failed[0].error}" if failed else ""


def bench_rigs(arguments: Sequence[str] = ()) -> None:
    """Run the experiments and print a row for each and a summary."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks rigs")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--rigs", type=int, default=RIGS)
    parser.add_argument("--hard", action="store_true", help="under hard conditions")
    parser.add_argument("--only", type=int, action="append", help="number of a rig; repeatable")
    parser.add_argument("--lenses", type=int, nargs=2, help="microlenses along each sensor's sides; 30 24 are fast")
    parser.add_argument("--out", type=Path, help="file to which a line of JSON is added for each")
    parser.add_argument("--keep", type=Path, help="folder in which images and results stay")
    parser.add_argument("--without-volumes", action="store_true", help="only particles, which take less time")
    chosen = parser.parse_args(arguments)
    lines = chosen.out.read_text().splitlines() if chosen.out and chosen.out.exists() else []
    outcomes = {(tree.pop("seed"), tree["number"]): outcome_of(tree) for tree in map(json.loads, lines)}
    for number in chosen.only or range(chosen.rigs):
        if (chosen.seed, number) in outcomes:
            continue
        rig = draw(chosen.seed, number, chosen.lenses)
        rig = hardened(rig, chosen.seed) if chosen.hard else rig
        outcome = outcomes[chosen.seed, number] = run_rig(rig, chosen.keep, not chosen.without_volumes)
        print(row(outcome), flush=True)
        if chosen.out:
            with chosen.out.open("a") as file:
                file.write(json.dumps({"seed": chosen.seed} | asdict(outcome)) + "\n")
    print(summary(list(outcomes.values())))


def outcome_of(tree: dict[str, Any]) -> Outcome:
    """Return an outcome from JSON, judged anew."""
    outcome = Outcome(**tree | {"steps": [Step(**step) for step in tree["steps"]]})
    return judged(outcome)


def run_rig(rig: DrawnRig, keep: Path | None = None, volumes: bool = True) -> Outcome:
    """Return what comes of a rig's experiment."""
    outcome = Outcome(rig.number, rig.name(), rig.wrong, rig.hard)
    began, worked = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if keep is None else keep / f"rig_{rig.number:03d}"
        folder.mkdir(parents=True, exist_ok=True)
        experiment(rig, folder, outcome, volumes)
        if rig.wrong in BELIEVED:
            outcome.believed = believed(folder)
    outcome.seconds, outcome.cpu_seconds = time.perf_counter() - began, time.process_time() - worked
    return judged(outcome)


def judged(outcome: Outcome) -> Outcome:
    """Return an outcome with its faults and verdict."""
    outcome.faults, outcome.verdict = faults(outcome.figures), ""
    outcome.verdict = verdict(outcome)
    return outcome


def experiment(rig: DrawnRig, folder: Path, outcome: Outcome, volumes: bool) -> None:
    """Simulate, calibrate, measure by particles and by volumes, and judge, as far as the commands lead."""
    true, reported, images = folder / "true.yaml", folder / "told.yaml", folder / "images"
    true.write_text(yaml.safe_dump(rig.true))
    reported.write_text(yaml.safe_dump(rig.reported))
    photograph_white(true, images)
    tracers = true
    if rig.haze:
        tracers = folder / "finer.yaml"
        tracers.write_text(yaml.safe_dump(recorded_finer(rig.true)))
    for what, settings in (("board", true), ("particles", tracers)) if rig.board else (("particles", tracers),):
        step = run_command("simulate", what, settings, "-o", images)
        if step.exit_code:
            outcome.steps.append(step)
            return
    if rig.haze:
        veil(images, rig)
    soil(images, rig)
    try:
        truth = truth_of(load_rig(true), images, load_rig(reported).grid())
    except LfpivError as error:
        # What its owner believes of a rig cannot be.
        outcome.steps.append(Step(BEFORE_THE_WORK[0], error.exit_code, str(error), [], 0.0))
        return

    def done(*arguments: object) -> bool:
        outcome.steps.append(run_command(*arguments))
        return outcome.steps[-1].exit_code == 0

    dark = ("--dark", images / "dark.tif")
    board = ("--board", images / "board.tif") if rig.board else ()
    calibration, weights = folder / "calibration.h5", folder / "weights.h5"
    if not done("calibrate-snapshot", reported, "--white", images / "white.tif", *dark, *board, "-o", calibration):
        return
    outcome.figures |= judge_calibration(rig, calibration)
    if not done("build-weights", reported, "--calibration", calibration, "-o", weights):
        return
    pair = (images / "pair_a.tif", images / "pair_b.tif")
    by_particles = ("--solver", "particles", "--pairing", "ab", "-o", folder / "particles")
    particles = [folder / "particles" / f"pair_{name}.vtkhdf" for name in "ab"]
    found = done("reconstruct", weights, *pair, *dark, *by_particles)
    if found:
        outcome.figures |= judge_particles(rig, truth, particles[0])
    offset = offset_mm(rig, outcome.figures)
    if found and done("track", *particles, "--grid", "-o", folder / "tracks.vtkhdf"):
        outcome.figures |= judge_tracks(rig, truth, folder / "tracks.vtkhdf", offset)
        outcome.figures |= judge_vectors(truth, folder / "tracks_grid.vtkhdf", "grid", offset)
    if volumes and done("reconstruct", weights, *pair, *dark, "-o", folder / "volumes"):
        both = [folder / "volumes" / f"pair_{name}.vtkhdf" for name in "ab"]
        if done("correlate", *both, "-o", folder / "vectors.vtkhdf"):
            outcome.figures |= judge_vectors(truth, folder / "vectors.vtkhdf", "volumes", offset)


def believed(folder: Path) -> str:
    """Return what `check` says of a rig that no image tells."""
    calibration = folder / "calibration.h5"
    known = ("--calibration", str(calibration)) if calibration.exists() else ()
    ended = CliRunner().invoke(cli, ["check", str(folder / "told.yaml"), *known, "--json"])
    lines = json.loads(ended.stdout)["verdicts"] if ended.exit_code == 0 else []
    return next((line["reason"] for line in lines if line["about"] == "believed"), "")


def run_command(*arguments: object) -> Step:
    """Run a command of the program in this process; return how it ended."""
    words = [str(word) for word in arguments]
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        ended = CliRunner().invoke(cli, words)
    seconds = time.perf_counter() - began
    code, error = ended.exit_code, ""
    if isinstance(ended.exception, LfpivError):
        code, error = ended.exception.exit_code, str(ended.exception)
    elif ended.exception is not None:
        error = f"{type(ended.exception).__name__}: {ended.exception}"
    said = [line for line in ended.stderr.splitlines() if line.startswith("lfpiv:") or "Warning" in line]
    name = " ".join([words[0], *[word for word in words if word == "particles"]])
    return Step(name, code, error, said, seconds)


def codes(steps: Sequence[Step]) -> list[str]:
    """Return the codes of what was warned of, each once; a warning that has none as it is."""
    texts = [text for step in steps for text in step.warnings]
    found = (re.search(r"\[([a-z-]+)\]$", text) for text in texts)
    return list(dict.fromkeys(match.group(1) if match else text for match, text in zip(found, texts, strict=True)))


def photograph_white(config: Path, images: Path) -> None:
    """Write a white and a dark image, as `simulate white` does in ten times as long."""
    settings = load_rig(config)
    camera = RecordingCamera(real_camera(settings), readout_of(settings))
    rng = np.random.default_rng([settings.simulation.seed, 0])
    light = render_white(camera.optics, settings.simulation.peak_counts, WHITE_SAMPLES)
    images.mkdir(exist_ok=True)
    write_tiff(images / "white.tif", camera.record(light, rng), overwrite=True)
    write_tiff(images / "dark.tif", camera.dark_frame(rng), overwrite=True)


def recorded_finer(true: dict[str, Any]) -> dict[str, Any]:
    """Return a rig whose counts are those of the finest sensor, for light that is added before they are rounded."""
    scene = true["simulation"]
    finer = 2.0 ** (FINEST_BITS - scene["bits"])
    counts = {key: finer * scene[key] for key in ("particle_counts", "read_noise_counts", "dark_level_counts")}
    photons = {"photons_per_count": scene["photons_per_count"] / finer}
    return true | {"simulation": scene | counts | photons | {"bits": FINEST_BITS}}


def veil(images: Path, rig: DrawnRig) -> None:
    """Add haze to the tracers' images: light of the white image's shape that fades to a half across the sensor."""
    scene, sensor = rig.true["simulation"], rig.true["camera"]["sensor"]
    rng = np.random.default_rng([scene["seed"], 2])
    shape = (sensor["rows"], sensor["columns"])
    dark, white = (read_image(images / f"{name}.tif", shape=shape).astype(np.float64) for name in ("dark", "white"))
    lit = np.maximum(white - dark, 0.0)
    haze = rig.haze * lit / np.quantile(lit, 0.99) * np.linspace(1.0, 0.5, shape[1])
    per_photon = 1.0 / scene["photons_per_count"]
    finer, full = 2.0 ** (FINEST_BITS - scene["bits"]), 2.0 ** scene["bits"] - 1.0
    for name in ("pair_a", "pair_b"):
        image = read_image(images / f"{name}.tif", shape=shape) / finer + rng.poisson(haze / per_photon) * per_photon
        write_tiff(images / f"{name}.tif", np.minimum(np.rint(image), full).astype(np.uint16), overwrite=True)


def soil(images: Path, rig: DrawnRig) -> None:
    """Cast the shadows of specks on the sensor into all images but the dark one."""
    rng = np.random.default_rng([rig.true["simulation"]["seed"], 1])
    sensor, scene = rig.true["camera"]["sensor"], rig.true["simulation"]
    shape = (sensor["rows"], sensor["columns"])
    row, column = np.indices(shape)
    passing = np.ones(shape)
    for _ in range(rig.dirt):
        middle, width = rng.random(2) * shape, rng.uniform(*SPECK_PX)
        far2 = (row - middle[0]) ** 2 + (column - middle[1]) ** 2
        passing *= 1.0 - rng.uniform(*SPECK_DEPTH) * np.exp(-far2 / (2.0 * width**2))
    dark = scene["dark_level_counts"]
    for path in images.glob("*.tif"):
        if path.name != "dark.tif":
            shadowed = dark + passing * (read_image(path, shape=shape) - dark)
            write_tiff(path, np.rint(np.maximum(shadowed, 0.0)).astype(np.uint16), overwrite=True)


def faults(figures: Figures) -> list[str]:
    """Return what is wrong with the particles and their tracks."""
    wrong = []
    off = abs(figures.get("magnification_off", 0.0))
    if off > max(WRONG_MAGNIFICATION, WRONG_SIGMAS * figures.get("magnification_sigma", 0.0)):
        wrong.append(f"magnification {100.0 * figures['magnification_off']:+.2f} %")
    if figures.get("bright", 0.0) >= BRIGHT_SHARE and figures.get("recall", 1.0) < SMALLEST_RECALL:
        wrong.append(f"recall {figures['recall']:.2f}")
    if figures.get("precision", 1.0) < SMALLEST_PRECISION:
        wrong.append(f"precision {figures['precision']:.2f}")
    for name in "uvw":
        slope = figures.get(f"slope_{name}")
        if slope is not None and abs(slope - 1.0) > WRONG_SLOPE + 2.0 * figures[f"slope_{name}_sigma"]:
            wrong.append(f"slope {name} {slope:.3f}")
    judged = figures.get("recall", 0.0) * figures.get("tracers", 0.0)
    staying = figures.get("staying", judged)
    if figures.get("tracks", staying) < SMALLEST_TRACKED * staying:
        wrong.append(f"{figures['tracks']:.0f} tracks of {staying:.0f} tracers found that stay")
    depth = abs(figures.get("offset_z", 0.0))
    if judged >= FEWEST and depth > max(WRONG_DEPTH, WRONG_SIGMAS * figures.get("depth_sigma", 0.0)):
        wrong.append(f"depths {figures['offset_z']:+.2f} voxel")
    for name in "xyz":
        coverage = figures.get(f"coverage_{name}", 1.0)
        if judged >= FEWEST and coverage < SMALLEST_COVERAGE:
            wrong.append(f"coverage {name} {coverage:.2f}")
    return wrong


def verdict(outcome: Outcome) -> str:
    """Return what came of it, in a word."""
    failed = [step for step in outcome.steps if step.exit_code]
    if failed:
        bug = failed[0].exit_code == 1
        # Of an image that shows none nothing can be followed: the sentence ends with what was warned of it.
        said = codes(outcome.steps)
        explained = "no-particles" in said or failed[0].error.endswith(tuple(f"[{code}]" for code in said))
        empty = failed[0].command == "track" and explained
        return "refused" if (failed[0].command in BEFORE_THE_WORK or empty) and not bug else "failed"
    # Nothing is stated that is wrong where no track was found.
    if "no-tracks" in codes(outcome.steps) and all("tracks of" in fault for fault in outcome.faults):
        return "refused"
    if not outcome.faults:
        return "worked"
    if outcome.wrong_value in BELIEVED:
        said, share, axes = BELIEVED[outcome.wrong_value]
        figures = outcome.figures
        # Where depths are off so are velocities that change along them.
        off = max(abs(figures.get(f"slope_{u}", 1.0) - 1.0) - 2.0 * figures.get(f"slope_{u}_sigma", 0.0) for u in "uvw")
        of_it = ("slope", "depths", *(f"coverage {axis}" for axis in axes))
        by_that = off < share + WRONG_SLOPE and all(fault.startswith(of_it) for fault in outcome.faults)
        if by_that and re.search(said, outcome.believed):
            return "unknown"
    # That the data sheet is believed tells of nothing but a wrong data sheet, and haze that is taken off of no fault.
    reported = set(codes(outcome.steps)) - ADVICE - {"haze"}
    if outcome.wrong_value and "no-board" in codes(outcome.steps):
        reported.add("no-board")
    # Of few particles it is said that nothing tells wrong links.
    if "few-particles" in codes(outcome.steps) and all(fault.startswith("slope") for fault in outcome.faults):
        reported.add("few-particles")
    return "warned" if reported else "silent"


def row(outcome: Outcome) -> str:
    """Return what is printed of a rig."""
    figures = outcome.figures

    def reported(template: str, *names: str) -> str:
        return " ".join(template.format(figures.get(name, float("nan"))) for name in names)

    lines = [
        f"{outcome.number:3d} {outcome.verdict:8s} {outcome.seconds:5.0f} s  {outcome.name}",
        f"      tracers {reported('{:.0f}', 'tracers')}, found {reported('{:.0f}', 'found')}, "
        f"recall {reported('{:.3f}', 'recall')}, precision {reported('{:.3f}', 'precision')}, "
        f"over the bound, lateral {reported('{:.2f}', 'over_x', 'over_y')}, depth {reported('{:.2f}', 'over_z')} "
        f"(astray {reported('{:.2f}', 'astray_x', 'astray_z')}), "
        f"coverage {reported('{:.2f}', 'coverage_x', 'coverage_y', 'coverage_z')}",
        f"      slopes of {reported('{:.0f}', 'tracks')} tracks {reported('{:.3f}', 'slope_u', 'slope_v', 'slope_w')} "
        f"(+- {reported('{:.3f}', 'slope_u_sigma', 'slope_v_sigma', 'slope_w_sigma')}), of their grid "
        f"{reported('{:.3f}', 'grid_slope_u', 'grid_slope_v', 'grid_slope_w')}, of volumes "
        f"{reported('{:.3f}', 'volumes_slope_u', 'volumes_slope_v', 'volumes_slope_w')}, volumes' coverage "
        f"{reported('{:.2f}', 'volumes_coverage_u', 'volumes_coverage_v', 'volumes_coverage_w')} of "
        f"{reported('{:.2f}', 'volumes_sigma_known')}",
    ]
    if outcome.faults:
        lines.append(f"      wrong: {', '.join(outcome.faults)}")
    if outcome.error:
        lines.append(f"      {outcome.error}")
    lines.extend(f"      {text}" for text in outcome.said)
    return "\n".join(lines)


def so_of(hard: Sequence[str]) -> set[str]:
    """Return codes of what is so: lens and refraction by the rig; under hard conditions haze, light from outside."""
    of_hard = {"haze": "haze", "outside": "light-unexplained"}
    return {"paraxial-refraction", "paraxial-lens"} | {of_hard[each] for each in hard if each in of_hard}


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return how many rigs came to what, and which ones were wrong without a word."""
    count = Counter(outcome.verdict for outcome in outcomes)
    verdicts = ", ".join(
        f"{count[name]} {name}" for name in ("worked", "refused", "failed", "unknown", "warned", "silent")
    )
    right = [each for each in outcomes if each.verdict == "worked" and not each.wrong_value]
    said = [
        (each.number, set(codes(each.steps)) - ADVICE - so_of(each.hard) - true_warnings(each.figures))
        for each in right
    ]
    alarms = [(number, of_it) for number, of_it in said if of_it]
    lines = [f"{len(outcomes)} rigs: {verdicts}", f"{len(right)} worked with nothing wrong: {len(alarms)} warned"]
    for name in ("refused", "failed"):
        lines.extend(f"{name}: rig {each.number}: {each.error}" for each in outcomes if each.verdict == name)
    lines.extend(f"warned although right: rig {number}: {', '.join(sorted(of_it))}" for number, of_it in alarms)
    for each in outcomes:
        if each.verdict == "silent":
            doubt = f" (wrong {each.wrong_value})" if each.wrong_value else ""
            lines.append(f"silent: rig {each.number}{doubt}: {', '.join(each.faults)}")
    return "\n".join(lines)
