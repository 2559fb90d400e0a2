"""Planted faults: what people do wrong at a camera's computer, one at a time, and what the program says to it.

    python -m benchmarks faults [--seed S] [--rigs N] [--good N]

On rigs drawn at random (see `rig_drawing`) whole experiments are simulated and one thing after the other is spoilt: a
value of the data sheet, a picture, the order of the files. A fault is told by a warning, which prints as its code, or
by a refusal; else it is silent. What no image can tell is printed apart. Good experiments, on further rigs, are to pass
without a word that something is wrong with their pictures.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.rig_drawing import DrawnRig, Tree, draw
from benchmarks.rigs import ADVICE, Step, codes, photograph_white, run_command, so_of, soil
from lfpiv_cli.files.images import read_image, write_tiff

SEED, RIGS, GOOD = 20261122, 2, 10
# Microlenses along the sensor's sides: fewer than `rigs` has, as pictures are only looked at.
LENSES = (34, 26)
# Tracers for each microlens that are enough for lens images to be seen by their light, and that leave some dark.
DENSITY = (0.05, 1.0)

# Words that end like this are files in the experiment's folder.
FILES = (".yaml", ".h5", ".vtkhdf", "found")

CRASH = "CRASH"

Picture = NDArray[np.float64]
Stage = Literal["calibrate", "frame", "pair"]


@dataclass(frozen=True, eq=False)
class Experiment:
    """What somebody brings home: a rig file and pictures.

    Attributes
    ----------
    reported : the rig file
    pictures : white, dark, board, pair_a, pair_b, and other, the second image of another recording; what is missing is
        not given to the program
    full_counts : where the sensor saturates
    """

    reported: Tree
    pictures: dict[str, Picture]
    full_counts: float

    def less_dark(self, name: str) -> Picture:
        """Return the light of a picture."""
        return self.pictures[name] - self.pictures["dark"]

    def with_pictures(self, **pictures: Picture) -> Experiment:
        """Return the experiment with others in place of some pictures, as its sensor would have them."""
        counts = {name: np.clip(np.rint(each), 0.0, self.full_counts) for name, each in pictures.items()}
        return replace(self, pictures=self.pictures | counts)

    def changed(self, name: str, change: Callable[[Picture], Picture]) -> Experiment:
        """Return the experiment with a change of one picture's light, its dark level as it was."""
        dark = float(np.median(self.pictures["dark"]))
        return self.with_pictures(**{name: change(self.pictures[name] - dark) + dark})

    def with_value(self, keys: str, value: Callable[[Any], Any]) -> Experiment:
        """Return the experiment with another value of the rig file."""
        reported = copy.deepcopy(self.reported)
        *sections, key = keys.split(".")
        section = reported
        for each in sections:
            section = section[each]
        section[key] = value(section[key])
        return replace(self, reported=reported)


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong, where it is to be told, and whether pictures can tell it."""

    name: str
    stage: Stage
    spoil: Callable[[Experiment], Experiment]
    knowable: bool = True


def moved(*shift: float) -> Callable[[Picture], Picture]:
    """Return the move of a picture by (rows, columns)."""
    return lambda picture: ndimage.shift(picture, shift, order=3 if max(shift) < 1.0 else 1, mode="nearest")


def turned(degrees: float) -> Callable[[Picture], Picture]:
    """Return the turn of a picture about its middle."""
    return lambda picture: ndimage.rotate(picture, degrees, reshape=False, order=1, mode="nearest")


def scaled(by: float) -> Callable[[Picture], Picture]:
    """Return the magnification of a picture about its middle."""

    def change(picture: Picture) -> Picture:
        middle = (np.array(picture.shape) - 1.0) / 2.0
        return ndimage.affine_transform(picture, np.eye(2) / by, middle - middle / by, order=1, mode="nearest")

    return change


def exchanged(first: str, second: str) -> Callable[[Experiment], Experiment]:
    """Return the exchange of two pictures."""
    return lambda e: e.with_pictures(**{first: e.pictures[second], second: e.pictures[first]})


def given_as(given: str, name: str) -> Callable[[Experiment], Experiment]:
    """Return the mistake of giving one picture as another."""
    return lambda e: e.with_pictures(**{name: e.pictures[given]})


def on(name: str, change: Callable[[Picture], Picture]) -> Callable[[Experiment], Experiment]:
    """Return a change of one picture's light."""
    return lambda e: e.changed(name, change)


def reported(keys: str, value: Callable[[Any], Any]) -> Callable[[Experiment], Experiment]:
    """Return a wrong value of the rig file."""
    return lambda e: e.with_value(keys, value)


def times(factor: float) -> Callable[[Any], Any]:
    """Return the multiplication of a value."""
    return lambda value: value * factor


def without(name: str) -> Callable[[Experiment], Experiment]:
    """Return the omission of a picture."""
    return lambda e: replace(e, pictures={key: each for key, each in e.pictures.items() if key != name})


def gamma(e: Experiment) -> Experiment:
    """Return frames whose counts are a power of the light, as video cameras have them."""
    full = e.full_counts
    return e.with_pictures(**{name: full * (e.pictures[name] / full) ** 0.45 for name in ("pair_a", "pair_b")})


def flipped(*axes: int) -> Callable[[Picture], Picture]:
    """Return a picture mirrored along axes."""
    return lambda picture: np.flip(picture, axes)


FAULTS = (
    Fault("white overexposed", "calibrate", on("white", times(8.0))),
    Fault("white with a scene", "calibrate", given_as("pair_a", "white")),
    Fault("white and board exchanged", "calibrate", exchanged("white", "board")),
    Fault("white and dark exchanged", "calibrate", exchanged("white", "dark")),
    Fault("white of another size", "calibrate", lambda e: e.with_pictures(white=e.pictures["white"][:, :-8])),
    Fault("white moved by 3 px before the board", "calibrate", on("white", moved(0.0, 3.0))),
    Fault("white turned by 0.5 deg before the board", "calibrate", on("white", turned(0.5))),
    Fault(
        "dark with a twentieth of the light",
        "calibrate",
        lambda e: e.with_pictures(dark=e.pictures["dark"] + 0.05 * e.less_dark("white")),
    ),
    Fault("tracers as board", "calibrate", given_as("pair_a", "board")),
    Fault("board mirrored", "calibrate", on("board", flipped(1))),
    Fault("board moved by 0.3 px", "calibrate", on("board", moved(0.0, 0.3))),
    Fault("board moved by 3 px", "calibrate", on("board", moved(3.0, 0.0))),
    Fault("board of other dots", "calibrate", reported("board.dots", lambda dots: [dots[0] + 2, dots[1] + 1])),
    Fault("board spacing 1.2 times", "calibrate", reported("board.spacing_mm", times(1.2))),
    Fault("magnification 0.9 times", "calibrate", reported("camera.main_lens.magnification", times(0.9))),
    Fault("pitch 1.1 times", "calibrate", reported("camera.microlenses.pitch_mm", times(1.1))),
    Fault("pixel 0.9 times", "calibrate", reported("camera.sensor.pixel_um", times(0.9))),
    Fault("aperture 0.6 times", "calibrate", reported("camera.main_lens.aperture_mm", times(0.6))),
    Fault("microlens focal length 0.7 times", "calibrate", reported("camera.microlenses.focal_length_mm", times(0.7))),
    Fault(
        "layout",
        "calibrate",
        reported("camera.microlenses.layout", lambda layout: "square" if layout == "hexagonal" else "hexagonal"),
    ),
    Fault("frame black", "frame", given_as("dark", "pair_a")),
    Fault("frame overexposed", "frame", on("pair_a", times(1e3))),
    Fault("frame of another size", "frame", lambda e: e.with_pictures(pair_a=e.pictures["pair_a"][:-8])),
    Fault("frame binned", "frame", lambda e: e.with_pictures(pair_a=e.pictures["pair_a"][::2, ::2])),
    Fault("white as frame", "frame", given_as("white", "pair_a")),
    Fault(
        "another white as frame",
        "frame",
        lambda e: e.with_pictures(pair_a=e.pictures["dark"] + 0.7 * e.less_dark("white")),
    ),
    Fault("board as frame", "frame", given_as("board", "pair_a")),
    Fault("frame mirrored", "frame", on("pair_a", flipped(1))),
    Fault("frame upside down", "frame", on("pair_a", flipped(0, 1))),
    Fault("frame turned by 0.5 deg", "frame", on("pair_a", turned(0.5))),
    Fault("frame moved by 0.3 px", "frame", on("pair_a", moved(0.0, 0.3))),
    Fault("frame moved by 3 px", "frame", on("pair_a", moved(3.0, 0.0))),
    Fault("frame of another camera, 1.07 times", "frame", on("pair_a", scaled(1.07))),
    Fault("lens focused anew, 1.005 times", "frame", on("pair_a", scaled(1.005))),
    Fault("no dark", "frame", without("dark")),
    Fault(
        "dark of another exposure",
        "frame",
        lambda e: e.with_pictures(dark=e.pictures["dark"] + max(8.0 * e.pictures["dark"].std(), 3.0)),
    ),
    Fault("dark in other bits", "frame", lambda e: e.with_pictures(dark=np.floor(e.pictures["dark"] / 4.0))),
    Fault("images of two recordings", "pair", given_as("other", "pair_b")),
    Fault("the same image twice", "pair", given_as("pair_a", "pair_b")),
    Fault("pair exchanged", "pair", exchanged("pair_a", "pair_b"), knowable=False),
    Fault("index 5 % off", "calibrate", reported("media.fluid", times(1.05)), knowable=False),
    Fault("column axis", "calibrate", reported("camera.sensor.column_axis", lambda _: "y"), knowable=False),
    Fault("gamma", "frame", gamma, knowable=False),
)


def bench_faults(arguments: Sequence[str] = ()) -> None:
    """Plant the faults on rigs, run good experiments, and print what is said to each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks faults")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--rigs", type=int, default=RIGS, help="rigs that faults are planted on")
    parser.add_argument("--good", type=int, default=GOOD, help="good experiments")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        for bench in benches(chosen.seed, chosen.rigs, clear, Path(folder)):
            print_faults(bench)
        alarms = 0
        for bench in benches(chosen.seed + 1, chosen.good, lambda rig: not rig.wrong, Path(folder)):
            said = false_alarms(bench)
            alarms += len(said)
            print(f"good  {bench.rig.name()}: {', '.join(said) or 'nothing'}", flush=True)
    print(f"{chosen.good} good experiments: {alarms} false alarms")


def benches(seed: int, count: int, wanted: Callable[[DrawnRig], bool], folder: Path) -> Iterator[Bench]:
    """Yield the experiments of the first so many rigs of a seed that are wanted and can be simulated."""
    rigs = filter(wanted, (draw(seed, number, LENSES) for number in itertools.count()))
    simulated = (bench for rig in rigs if (bench := Bench.of(rig, folder / f"{seed}_{rig.number}")) is not None)
    yield from itertools.islice(simulated, count)


def clear(rig: DrawnRig) -> bool:
    """Tell whether a rig is one to plant faults on: a board, nothing wrong, and tracers enough."""
    return rig.board and not rig.wrong and DENSITY[0] <= rig.density <= DENSITY[1]


@dataclass(frozen=True, eq=False)
class Bench:
    """A rig, its good experiment, and the folder for files."""

    rig: DrawnRig
    good: Experiment
    folder: Path

    @classmethod
    def of(cls, rig: DrawnRig, folder: Path) -> Bench | None:
        """Simulate the experiment of a rig; None where there is no room for its volume."""
        folder.mkdir()
        true, images = folder / "true.yaml", folder / "images"
        true.write_text(yaml.safe_dump(rig.true))
        photograph_white(true, images)
        for what in ("board", "particles") if rig.board else ("particles",):
            step = run_command("simulate", what, true, "-o", images)
            if step.exit_code:
                return None
        # Another recording's second image.
        scene, other = rig.true["simulation"], folder / "other.yaml"
        other.write_text(yaml.safe_dump(rig.true | {"simulation": scene | {"seed": scene["seed"] + 1}}))
        run_command("simulate", "particles", other, "-o", folder / "other")
        (folder / "other" / "pair_b.tif").rename(images / "other.tif")
        soil(images, rig)
        sensor = rig.true["camera"]["sensor"]
        shape = (sensor["rows"], sensor["columns"])
        names = ("white", "dark", *(["board"] if rig.board else []), "pair_a", "pair_b", "other")
        pictures = {name: read_image(images / f"{name}.tif", shape=shape).astype(np.float64) for name in names}
        return cls(rig, Experiment(rig.reported, pictures, 2.0 ** rig.true["simulation"]["bits"] - 1.0), folder)

    def run(self, experiment: Experiment, command: str, *arguments: str, config: Tree | None = None) -> Step:
        """Run a command whose arguments that begin with @ are pictures, left out with their option where missing."""
        for name, picture in experiment.pictures.items():
            write_tiff(self.folder / f"{name}.tif", picture.astype(np.uint16), overwrite=True)
        (self.folder / "told.yaml").write_text(yaml.safe_dump(config or experiment.reported))
        words: list[str | Path] = []
        for word in arguments:
            if word.startswith("@") and word[1:] not in experiment.pictures:
                words.pop()
            else:
                words.append(self.folder / f"{word[1:]}.tif" if word.startswith("@") else word)
        paths = [self.folder / word if isinstance(word, str) and word.endswith(FILES) else word for word in words]
        return run_command(command, *paths, "--overwrite")

    def calibrate(self, experiment: Experiment) -> Step:
        """Calibrate."""
        pictures = ("--white", "@white", "--dark", "@dark", "--board", "@board")
        return self.run(experiment, "calibrate-snapshot", "told.yaml", *pictures, "-o", "calibration.h5")

    def build(self, experiment: Experiment, config: Tree | None = None) -> Step:
        """Make weights."""
        calibrated = ("--calibration", "calibration.h5", "-o", "weights.h5")
        return self.run(experiment, "build-weights", "told.yaml", *calibrated, config=config)

    def look(self, experiment: Experiment, frame: str = "@pair_a") -> Step:
        """Reconstruct a frame in the least time: only what is said of its picture matters."""
        quick = ("--solver", "sart", "--iterations", "1", "-o", "volume.vtkhdf")
        return self.run(experiment, "reconstruct", "weights.h5", frame, "--dark", "@dark", *quick)

    def measure(self, experiment: Experiment) -> list[Step]:
        """Find and follow the tracers of the pair."""
        frames = ("@pair_a", "@pair_b", "--dark", "@dark")
        found = self.run(
            experiment, "reconstruct", "weights.h5", *frames, "--solver", "particles", "--pairing", "ab", "-o", "found"
        )
        particles = (str(self.folder / "found" / f"pair_{name}.vtkhdf") for name in "ab")
        return [found, self.run(experiment, "track", *particles, "-o", "tracks.vtkhdf")]

    def few_voxels(self) -> Tree:
        """Return the rig file with a volume of few voxels, for what is only looked at."""
        volume = self.good.reported["volume"]
        lens, depth = self.rig.lens_mm, volume["size_mm"][2] / 4.0
        few = {"shape_xyz": [8, 8, 4], "voxel_mm": [lens, lens, depth]}
        kept = {key: value for key, value in volume.items() if key != "size_mm"}
        return self.good.reported | {"volume": kept | few}


def print_faults(bench: Bench) -> None:
    """Plant all faults on a rig and print a row for each, and how many were not told."""
    print(bench.rig.name(), flush=True)
    silent, count = 0, 0
    for stage in STAGES:
        prepare(bench, stage)
        for fault in (fault for fault in FAULTS if fault.stage == stage):
            said = STAGES[stage](bench, fault.spoil(bench.good))
            silent += fault.knowable and (not said or said.startswith(CRASH))
            count += fault.knowable
            print(
                f"  {fault.name:42s} {said or ('SILENT' if fault.knowable else 'not told, as no picture can')}",
                flush=True,
            )
    print(f"{count} planted faults that pictures can tell: {silent} silent", flush=True)


def prepare(bench: Bench, stage: Stage) -> None:
    """Make what the faults of a stage are looked at with, of the good experiment."""
    if stage != "calibrate":
        bench.calibrate(bench.good)
        bench.build(bench.good, bench.few_voxels() if stage == "frame" else None)


STAGES: dict[Stage, Callable[[Bench, Experiment], str]] = {
    "calibrate": lambda bench, spoilt: told_by([bench.calibrate(spoilt)]),
    "frame": lambda bench, spoilt: told_by([bench.look(spoilt)]),
    "pair": lambda bench, spoilt: told_by(bench.measure(spoilt)),
}


def told_by(steps: Sequence[Step]) -> str:
    """Return the sentence of the first step that refused, or the codes of warnings but advice; empty for neither."""
    for step in steps:
        if step.exit_code:
            return f"refused: {step.error}" if step.exit_code != 1 else f"{CRASH}: {step.error}"
    return ", ".join(code for code in codes(steps) if code not in ADVICE)


def false_alarms(bench: Bench) -> list[str]:
    """Return what is said against a good experiment: its pictures and its pair."""
    steps = [bench.calibrate(bench.good), bench.build(bench.good)]
    if not any(step.exit_code for step in steps):
        steps += bench.measure(bench.good)
    refused = [f"{step.command}: {step.error}" for step in steps if step.exit_code]
    return refused + [code for code in codes(steps) if code not in ADVICE | so_of(())]
