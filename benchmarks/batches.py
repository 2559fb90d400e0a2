"""Batches: what they cost beside their stages, whether memory stays flat, what workers gain, and kills at any moment.

    python -m benchmarks batches [--pairs N] [--kills K] [--weights W.h5 --images FOLDER] [--only PART]...

Without weights, pairs of the sample's images, a little noise added, and a small part of its volume: frames of a tenth
of a second, at which everything beside the work shows. With them, the first so many pairs of a folder.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tifffile

from lfpiv_cli.cli.main import cli
from lfpiv_cli.console import Console, Frames
from lfpiv_cli.files.batch import expanded
from lfpiv_cli.files.images import read_image
from lfpiv_cli.verbs.batches import Batch, BatchOptions, work_through
from lfpiv_cli.verbs.correlate import CorrelateOptions, Correlation
from lfpiv_cli.verbs.reconstruct import Reconstruction, ReconstructOptions

ROOT = Path(__file__).parents[1]
SMALL = {
    "shape_xyz: [30, 22, 40]": "shape_xyz: [12, 8, 16]",
    "reference: mid_plane": "reference: focal_point",
    "windows: [24, 12]": "windows: [8]",
}
PAIRS, KILLS, SEED = 20, 3, 20261122
# Images with noise of their own; the others differ from these in single pixels.
DIFFERENT, NOISE_COUNTS = 8, 9.0
SILENT = Console(quiet=True)
PARTS = ("throughput", "workers", "kills")


@dataclass(frozen=True)
class Experiment:
    """Weights, and the images of pairs in their order."""

    weights: Path
    images: Sequence[Path]

    def pairs(self) -> int:
        """Return how many there are."""
        return len(self.images) // 2


@dataclass
class Timed:
    """A batch of which each output is timed, and after each the memory and the open files of the process are noted."""

    batch: Any
    seconds: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    files: list[int] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.batch, name)

    def make(self, number: int, work: Frames) -> Any:
        begun, process = time.perf_counter(), psutil.Process()
        made = self.batch.make(number, work)
        self.seconds.append(time.perf_counter() - begun)
        self.memory_mb.append(process.memory_info().rss / 2**20)
        self.files.append(process.num_fds())
        return made


@dataclass(frozen=True)
class Figures:
    """What a batch cost: seconds from its begin to its end, those of its outputs alone, memory and files after each."""

    wall_s: float
    own_s: float
    memory_mb: Sequence[float]
    files: Sequence[int]

    def share(self) -> float:
        """Return which part of the time the outputs themselves took."""
        return self.own_s / self.wall_s

    def growth(self) -> float:
        """Return by how much memory grows from the second quarter of the outputs to the last, as a share."""
        quarters = np.array_split(np.asarray(self.memory_mb), 4)
        return float(np.median(quarters[3]) / np.median(quarters[1]) - 1.0)

    def reported(self) -> str:
        curve = " ".join(f"{each:.0f}" for each in self.memory_mb[:: max(len(self.memory_mb) // 10, 1)])
        return (
            f"{self.wall_s:.1f} s, the outputs themselves {self.own_s:.1f} s: {self.share():.3f} (limit 0.9); memory "
            f"{curve} MB, peak {max(self.memory_mb):.0f}, growth {self.growth():+.1%} (limit 5 %); open files "
            f"{min(self.files)} to {max(self.files)}"
        )


def bench_batches(arguments: Sequence[str] = ()) -> None:
    """Print what batches cost, what workers gain, and what kills change."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks batches")
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--only", choices=PARTS, action="append")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if chosen.weights is None:
            experiment = small_experiment(folder, chosen.pairs)
        else:
            images = expanded([chosen.images], "images")[: 2 * chosen.pairs]
            experiment = Experiment(chosen.weights.absolute(), [image.absolute() for image in images])
        parts = chosen.only or PARTS
        if "throughput" in parts:
            print_throughput(experiment, folder)
        if "workers" in parts:
            print_workers(experiment, folder)
        if "kills" in parts:
            print_kills(experiment, folder, chosen.kills, np.random.default_rng(SEED))


def small_experiment(folder: Path, pairs: int) -> Experiment:
    """Make weights of a part of the sample's volume, and images for so many pairs."""
    text = (ROOT / "configs" / "sample.yaml").read_text(encoding="utf-8")
    for old, new in SMALL.items():
        assert old in text, old
        text = text.replace(old, new)
    (folder / "rig.yaml").write_text(text, encoding="utf-8")
    weights = folder / "weights.h5"
    with contextlib.redirect_stdout(io.StringIO()):
        cli.main(["build-weights", str(folder / "rig.yaml"), "-o", str(weights), "-q"], standalone_mode=False)
    images = folder / "images"
    images.mkdir()
    rng, kinds = np.random.default_rng(SEED), []
    for number in range(DIFFERENT):
        image = read_image(ROOT / "sample_data" / f"pair_{'ab'[number % 2]}.tif")
        kinds.append((image + rng.uniform(0.0, NOISE_COUNTS, image.shape)).astype(np.uint16))
    names = [images / f"{pair:05d}_{letter}.tif" for pair in range(pairs) for letter in "ab"]
    for number, path in enumerate(names):
        picture = kinds[number % DIFFERENT]
        # No two are the same image: those are told.
        picture.flat[number] += 1
        tifffile.imwrite(path, picture)
    return Experiment(weights, names)


def cost_of(batch: Batch[Any], options: BatchOptions, begun: float) -> Figures:
    """Work through a batch that was begun to be made at a time; return what it cost."""
    timed = Timed(batch)
    work_through(timed, options, SILENT)
    return Figures(time.perf_counter() - begun, sum(timed.seconds), timed.memory_mb, timed.files)


def costs(experiment: Experiment, folder: Path) -> dict[str, Figures]:
    """Return what the volumes of all frames cost in this process, and the fields of all pairs, kernels compiled."""
    warm = ReconstructOptions()
    work_through(Reconstruction(experiment.weights, experiment.images[:2], folder / "warm", warm, False), warm, SILENT)
    volumes, options = folder / "volumes", ReconstructOptions()
    begun = time.perf_counter()
    batch = Reconstruction(experiment.weights, experiment.images, volumes, options, False)
    found = {"volumes": cost_of(batch, options, begun)}
    pairing = CorrelateOptions(pairing="ab")
    begun = time.perf_counter()
    fields = Correlation(expanded([volumes], "results"), folder / "vectors", pairing, False)
    return found | {"fields": cost_of(fields, pairing, begun)}


def print_throughput(experiment: Experiment, folder: Path) -> None:
    """Print the cost of a batch of volumes and of one of fields in this process, and that of a command's start."""
    found = costs(experiment, folder)
    for name, figures in found.items():
        print(f"{experiment.pairs()} pairs, {name}: {figures.reported()}", flush=True)
    each_s = found["volumes"].own_s / len(experiment.images)
    one_s = seconds_of(command(experiment, folder / "one", "--no-accelerate", images=experiment.images[:1]))
    print(f"a command for one frame of {each_s:.2f} s: {one_s:.1f} s", flush=True)


def command(experiment: Experiment, output: Path, *options: str, images: Sequence[Path] | None = None) -> list[str]:
    """Return the command line that reconstructs the frames into a folder."""
    listed = [str(image) for image in images or experiment.images]
    program = [sys.executable, "-m", "lfpiv_cli", "reconstruct", str(experiment.weights), *listed]
    return [*program, *options, "--quiet", "-o", str(output / "volume.vtkhdf" if len(listed) == 1 else output)]


def seconds_of(*commands: Sequence[str]) -> float:
    """Run commands at once; return the seconds until all have ended."""
    begun = time.perf_counter()
    processes = [subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL) for words in commands]
    for process in processes:
        assert process.wait() == 0
    return time.perf_counter() - begun


def print_workers(experiment: Experiment, folder: Path) -> None:
    """Print what two workers of Dask gain over one, and two processes over one, each with one thread.

    In seconds with all that starts, and in frames a second from the first frame's end to the last one's.
    """
    for name, ways in {
        "workers of Dask": ([("--dask", "local:1")], [("--dask", "local:2")]),
        "processes": ([()], [("--shard", "1/2"), ("--shard", "2/2")]),
    }.items():
        taken, rates = [], []
        for number, shares in enumerate(ways):
            output = folder / f"{name.split()[0]}_{number}"
            log = output.with_suffix(".log")
            common = ("--threads", "1", "--log", str(log))
            taken.append(seconds_of(*(command(experiment, output, *common, *share) for share in shares)))
            rates.append(frames_per_s(log))
        print(
            f"{name}: one {taken[0]:.1f} s, two {taken[1]:.1f} s, {taken[0] / taken[1]:.2f} times; after the first "
            f"frame {rates[0]:.3f} and {rates[1]:.3f} frames a second, {rates[1] / rates[0]:.2f} times (limit 1.8)",
            flush=True,
        )


def frames_per_s(log: Path) -> float:
    """Return how many frames were done in a second, from the first one's end to the last one's."""
    events = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    ends = sorted(datetime.fromisoformat(event["time"]) for event in events if event["event"] == "frame")
    return (len(ends) - 1) / (ends[-1] - ends[0]).total_seconds()


def print_kills(experiment: Experiment, folder: Path, kills: int, rng: np.random.Generator) -> None:
    """Print whether outputs are the same after kills at random moments."""
    different, resumed = killed(experiment, folder, kills, rng)
    print(f"killed {kills} times, {resumed} batches resumed to their ends: {different} differ", flush=True)


def killed(experiment: Experiment, folder: Path, kills: int, rng: np.random.Generator) -> tuple[int, int]:
    """Kill a batch at random moments, and go on, until it is complete; then another one, for so many kills.

    Returns
    -------
    how many batches were other than one that was not killed, and how many there were
    """
    whole = folder / "whole"
    full_s = seconds_of(command(experiment, whole))
    expected, different, batches, left = digests(whole), 0, 0, kills
    while left > 0:
        output, batches = folder / f"killed_{batches}", batches + 1
        while left > 0 and not is_complete(experiment, output, rng.uniform(0.0, full_s)):
            left -= 1
        assert seconds_of(command(experiment, output, "--resume"))
        different += digests(output) != expected
        shutil.rmtree(output)
    return different, batches


def is_complete(experiment: Experiment, output: Path, after_s: float) -> bool:
    """Run a batch and kill it after a time; return whether it was complete before."""
    process = subprocess.Popen(command(experiment, output, "--resume"), cwd=ROOT, stdout=subprocess.DEVNULL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.wait(after_s) == 0
    process.send_signal(signal.SIGKILL)
    process.wait()
    return False


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each result in a folder."""
    found = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in found}
