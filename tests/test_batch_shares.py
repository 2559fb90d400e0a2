"""Batches divided among jobs and Dask's workers: the same files, byte for byte, and what kills workers is named."""

import contextlib
import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.errors import InputError, OutputError, PartialError, StoppedEarlyError, UsageError
from lfpiv_cli.files import batch
from lfpiv_cli.files.atomic import claimed
from lfpiv_cli.files.batch import Target
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.inputs import Shard
from lfpiv_cli.notice import Notice
from lfpiv_cli.verbs.batches import Batch, BatchOptions, Worked, work_through
from tests.commands import CONFIG, SAMPLE, contents, run
from tests.test_particle_stage import write_frame


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Five frames, each of other light."""
    folder, rng = tmp_path_factory.mktemp("frames"), np.random.default_rng(3)
    image = read_image(SAMPLE / "pair_a.tif")
    paths = [folder / f"{number}.tif" for number in range(5)]
    for path in paths:
        tifffile.imwrite(path, (image + rng.uniform(0.0, 9.0, image.shape)).astype(np.uint16))
    return paths


@pytest.fixture(scope="module")
def volumes(weights: Path, frames: list[Path], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The volumes of the frames, by one command."""
    folder = tmp_path_factory.mktemp("volumes") / "volumes"
    reconstruct(weights, frames, folder)
    return sorted(folder.iterdir())


def reconstruct(weights: Path, frames: list[Path], output: Path, *options: object) -> None:
    common = ("--iterations", 2, "--background", "minimum:3", "--quiet")
    run("reconstruct", weights, *frames, *common, *options, "-o", output)


def correlate(volumes: list[Path], output: Path, *options: object) -> None:
    run("correlate", *volumes, "--pairing", "sequence", "--windows", "4", "--quiet", *options, "-o", output)


@pytest.fixture(scope="module")
def particles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Particles of three pairs of frames."""
    folder, rng = tmp_path_factory.mktemp("particles"), np.random.default_rng(20260101)
    for pair in (1, 2, 3):
        start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (60, 3))
        for name, moved in (("a", 0.0), ("b", 0.1)):
            write_frame(folder / f"{pair}{name}.vtkhdf", start + (moved, 0.0, 0.0))
    return folder


@pytest.mark.thorough
@pytest.mark.parametrize("how", ["shards", "workers"])
@pytest.mark.parametrize("command", ["reconstruct", "correlate", "track"])
def test_shards_and_workers_give_one_command_s_files(
    weights: Path,
    frames: list[Path],
    volumes: list[Path],
    particles: Path,
    in_process: str,
    tmp_path: Path,
    command: str,
    how: str,
) -> None:
    def work(output: str, *share: object) -> None:
        options = (*share, "--log", tmp_path / f"log of {output}")
        if command == "reconstruct":
            reconstruct(weights, frames, tmp_path / output, *options)
        elif command == "correlate":
            correlate(volumes, tmp_path / output, *options)
        else:
            run("track", particles, "--pairing", "ab", "--quiet", *options, "-o", tmp_path / output)

    work("one")
    for share in [("--shard", f"{number}/3") for number in (3, 1, 2)] if how == "shards" else [("--dask", in_process)]:
        work("many", *share)
    assert contents(tmp_path / "many") == contents(tmp_path / "one")
    assert len(contents(tmp_path / "one")) == {"reconstruct": 5, "correlate": 4, "track": 3}[command]
    done = [json.loads(line).get("done") for line in (tmp_path / "log of many").read_text().splitlines()]
    assert how == "shards" or list(filter(None, done)) == list(range(1, 1 + max(filter(None, done))))


@pytest.mark.thorough
def test_the_share_of_an_array_job_is_made(
    weights: Path, frames: list[Path], volumes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"ID": 12, "MIN": 10, "COUNT": 3, "STEP": 2}.items():
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", str(value))
    reconstruct(weights, frames, tmp_path / "v", "--shard", "slurm")
    assert sorted(contents(tmp_path / "v")) == ["1.vtkhdf", "2.vtkhdf"]


def test_more_shards_than_frames_and_no_time_at_all(weights: Path, frames: list[Path], tmp_path: Path) -> None:
    for number in range(1, 5):
        reconstruct(weights, frames[:2], tmp_path / "v", "--shard", f"{number}/4")
    assert len(contents(tmp_path / "v")) == 2
    # A time limit that is over at once.
    with pytest.raises(StoppedEarlyError, match="0 of 5 frames are done"):
        reconstruct(weights, frames, tmp_path / "w", "--time-limit", "0.000001s")


@pytest.mark.thorough
def test_fields_of_shards_and_their_mean_by_a_last_command(volumes: list[Path], tmp_path: Path) -> None:
    correlate(volumes, tmp_path / "one", "--mean", tmp_path / "mean_one.vtkhdf")
    with pytest.raises(UsageError, match="--mean needs the fields of all shards.*without --shard and with --resume"):
        correlate(volumes, tmp_path / "v", "--mean", tmp_path / "mean.vtkhdf", "--shard", "1/2")
    for number in (1, 2):
        correlate(volumes, tmp_path / "v", "--shard", f"{number}/2")
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "v").iterdir()}
    correlate(volumes, tmp_path / "v", "--mean", tmp_path / "mean.vtkhdf", "--resume")
    assert contents(tmp_path / "v") == contents(tmp_path / "one")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "v").iterdir()} == made
    assert (tmp_path / "mean.vtkhdf").read_bytes() == (tmp_path / "mean_one.vtkhdf").read_bytes()


class Filling:
    """A clock with which files come into a folder, each at its time, the first half of it a second before."""

    def __init__(self, folder: Path, plan: dict[float, Path]) -> None:
        self.folder, self.plan, self.now_s = folder, plan, 0.0
        folder.mkdir()

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        for time_s, path in self.plan.items():
            whole, there = path.read_bytes(), self.folder / path.name
            if self.now_s >= time_s:
                if not there.exists() or there.stat().st_size < len(whole):
                    there.write_bytes(whole)
            elif self.now_s >= time_s - 1.0:
                there.write_bytes(whole[: len(whole) // 2])


def alone(weights: Path, frames: list[Path], output: Path, *options: object) -> None:
    run("reconstruct", weights, *frames, "--iterations", 2, "--quiet", *options, "-o", output)


@pytest.mark.thorough
def test_frames_that_come(
    weights: Path,
    frames: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    camera = Filling(tmp_path / "run", {1.0: frames[0], 2.0: frames[1], 14.0: frames[2]})
    monkeypatch.setattr(batch, "time", camera)
    alone(weights, [camera.folder], tmp_path / "v", "--watch", "--idle-s", 20, "--json")
    reported = json.loads(capsys.readouterr().out)
    assert (reported["frames"], reported["reconstructed"]) == (3, 3)
    alone(weights, frames[:3], tmp_path / "one")
    assert contents(tmp_path / "v") == contents(tmp_path / "one")
    # once more, with one that never becomes whole
    (camera.folder / "9.tif").write_bytes(frames[0].read_bytes()[:9000])
    listed = tmp_path / "failures.json"
    options = ("--watch", "--idle-s", 5, "--resume", "--keep-going", "--failures", listed)
    with pytest.raises(PartialError, match="1 of 4 frames failed, the first because .*9.tif"):
        alone(weights, [camera.folder], tmp_path / "v", *options)
    assert [failure["name"] for failure in json.loads(listed.read_text())] == ["9"]


@pytest.mark.thorough
@pytest.mark.parametrize("pairing", ["ab", "sequence"])
def test_pairs_that_come(pairing: str, volumes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = [tmp_path / f"{1 + number // 2}{'ab'[number % 2]}.vtkhdf" for number in range(4)]
    for path, volume in zip(named, volumes, strict=False):
        path.write_bytes(volume.read_bytes())
    common = ("--pairing", pairing, "--windows", "4", "--quiet")
    folder = Filling(tmp_path / "volumes", dict(zip((1.0, 5.9, 6.0, 14.0), named, strict=True)))
    monkeypatch.setattr(batch, "time", folder)
    run("correlate", folder.folder, *common, "--watch", "--idle-s", 20, "-o", tmp_path / "v")
    run("correlate", *named, *common, "-o", tmp_path / "one")
    assert len(contents(tmp_path / "one")) == (2 if pairing == "ab" else 3)
    assert contents(tmp_path / "v") == contents(tmp_path / "one")


@pytest.mark.thorough
def test_a_lost_frame_of_a_folder_that_is_being_filled_is_told_at_once(
    volumes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    named = [tmp_path / f"{name}.vtkhdf" for name in ("1a", "1b", "2a", "3a", "3b")]
    for path, volume in zip(named, volumes, strict=True):
        path.write_bytes(volume.read_bytes())
    folder = Filling(tmp_path / "volumes", dict(zip((1.0, 1.5, 2.0, 9.0, 10.0), named, strict=True)))
    monkeypatch.setattr(batch, "time", folder)
    with pytest.raises(PartialError, match="1 of 3 pairs failed, the first because the second frame of its pair"):
        run("correlate", folder.folder, "--pair-by", "{pair}{frame}", "--windows", 4, "--watch", "-o", tmp_path / "v")
    assert sorted(contents(tmp_path / "v")) == ["1a.vtkhdf", "3a.vtkhdf"]
    assert capsys.readouterr().err.count("2a.vtkhdf: the second frame of its pair is missing") == 1


def test_what_stays_away(volumes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path) -> None:
    folder = Filling(tmp_path / "volumes", {1.0: volumes[0]})
    monkeypatch.setattr(batch, "time", folder)
    with pytest.raises(InputError, match="no other frame has come"):
        run("correlate", folder.folder, "--pairing", "ab", "--watch", "--idle-s", 5, "-o", tmp_path / "v")
    camera = Filling(tmp_path / "run", {})
    monkeypatch.setattr(batch, "time", camera)
    with pytest.raises(InputError, match="no images have come in 5 s"):
        alone(weights, [camera.folder], tmp_path / "v", "--watch", "--idle-s", 5)


ALONE, PAIRED = "reconstruct {weights} {folder}", "correlate {folder} --pairing ab"
RUN = f"run '{CONFIG}' {{folder}} --white '{SAMPLE}/white.tif' --board '{SAMPLE}/board.tif' --method volumes"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (f"{ALONE} --background minimum:3", "--background minimum:3 is made from all frames"),
        (f"{ALONE} --mask still", "--mask still is made from all frames"),
        (f"{ALONE} --solver particles", "the tracers' size, which --solver particles needs"),
        (f"{ALONE} --shard 1/2", "leave out --shard"),
        (f"{ALONE} --dry-run", "leave out one of them"),
        (f"{PAIRED} --mean mean.vtkhdf", "--watch: --mean is made from all pairs"),
        (f"{PAIRED} --ensemble", "--watch: --ensemble is made from all pairs"),
        ("reconstruct {weights} {file}", "--watch takes folders"),
        (f"{RUN} --follow", "separate pairs"),
        (f"{RUN} --pairing sequence", "separate pairs"),
        (f"{RUN} --background minimum:3", "--background minimum:3 is made from all frames"),
        (f"{RUN} --mask still", "--mask still is made from all frames"),
        (f"{RUN} --shard 1/2", "leave out --shard"),
        (f"{RUN} --dry-run", "leave out one of them"),
    ],
)
def test_what_frames_that_come_exclude(
    weights: Path, frames: list[Path], tmp_path: Path, words: str, said: str
) -> None:
    command = words.format(weights=weights, folder=tmp_path, file=frames[0])
    with pytest.raises(UsageError, match=said):
        run(*shlex.split(command), "--watch", "-o", tmp_path / "v")
    assert not (tmp_path / "v").exists()


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--pairing", "ab"), ("--background", "minimum:5")])
def test_particles_of_shards(weights: Path, frames: list[Path], options: tuple[str, ...], tmp_path: Path) -> None:
    for share in ("1/1", "2/3", "1/3", "3/3"):
        folder, common = tmp_path / ("one" if share == "1/1" else "shards"), ("--solver", "particles", "--quiet")
        run("reconstruct", weights, *frames[:4], *common, *options, "--shard", share, "-o", folder)
    assert contents(tmp_path / "shards") == contents(tmp_path / "one")


distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


class Toy(Batch[int]):
    """Outputs that say in which process they were made; some are faulty, or kill their process."""

    label, unit, overwrite = "toy", "frame", True

    def __init__(
        self, folder: Path, count: int, faulty: Sequence[int] = (), deadly: Sequence[int] = (), fault: type = InputError
    ) -> None:
        self.folder, self.faulty, self.deadly, self.fault = folder, faulty, deadly, fault
        self.targets = [Target(folder / f"{number}.vtkhdf", dict) for number in range(count)]
        self.inputs: list[Path] = []

    def begin(self, numbers: Sequence[int], console: Console) -> float:
        with open(self.folder / "begun", "a") as file:
            file.write(f"{os.getpid()}\n")
        return 1.0

    def make(self, number: int, work: Frames) -> int:
        if number in self.faulty:
            raise self.fault(f"{number}: is cut")
        if number in self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        work.console.warn([Notice("frame-dark", str(number), "is dark", "light")])
        self.targets[number].path.write_text(str(number))
        return os.getpid()


def work(batch: Toy, dask: str, **options: Any) -> tuple[Worked[int], list[Notice]]:
    warned: list[Notice] = []
    console = Console(quiet=True, warned=warned)
    return work_through(batch, BatchOptions(dask=dask, **options), console), warned


def written(folder: Path) -> list[str]:
    return sorted(path.read_text() for path in folder.glob("*.vtkhdf"))


def test_every_output_is_made_and_what_is_said_comes_back(in_process: str, tmp_path: Path) -> None:
    worked, warned = work(Toy(tmp_path, 5), in_process)
    assert written(tmp_path) == list("01234")
    assert list(worked.outcomes) == [0, 1, 2, 3, 4]
    assert sorted(notice.about for notice in warned) == list("01234")
    # once for each worker, not for each output
    assert len((tmp_path / "begun").read_text().split()) == 2
    assert not list(tmp_path.glob(".*"))


def test_a_faulty_output_is_listed_or_stops_the_batch(in_process: str, tmp_path: Path) -> None:
    worked, _ = work(Toy(tmp_path, 4, faulty=[1]), in_process, keep_going=True)
    assert [failure.name for failure in worked.failures] == ["1"]
    assert written(tmp_path) == list("023")
    with pytest.raises(InputError, match="1: is cut"):
        work(Toy(tmp_path, 4, faulty=[1]), in_process)


def test_what_another_command_makes_is_left_to_it_and_made_if_it_does_not(in_process: str, tmp_path: Path) -> None:
    batch, ended = Toy(tmp_path, 3), threading.Event()

    def other_command() -> None:
        with claimed(batch.targets[1].path):
            ended.wait(0.3)

    other = threading.Thread(target=other_command)
    other.start()
    worked, _ = work(batch, in_process)
    other.join()
    assert sorted(worked.outcomes) == [0, 1, 2]


def test_shares_time_limits_and_errors_of_other_kinds(in_process: str, tmp_path: Path) -> None:
    worked, _ = work(Toy(tmp_path, 5), in_process, shard=Shard(2, 2))
    assert list(worked.outcomes) == [2, 3, 4]
    with pytest.raises(StoppedEarlyError, match="0 of 5 frames are done"):
        work(Toy(tmp_path, 5), in_process, time_limit_s=1e-9)
    with pytest.raises(OutputError, match="is cut"):
        work(Toy(tmp_path, 4, faulty=range(4), fault=OutputError), in_process, keep_going=True)


def test_an_address_where_nobody_is_and_no_library_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lfpiv_cli.verbs import distributed as stage

    monkeypatch.setattr(stage, "CONNECT_S", 0.2)
    for address in ("tcp://127.0.0.1:1", "nonsense"):
        with pytest.raises(UsageError, match=f"--dask {address}"):
            work(Toy(tmp_path, 2), address)
    monkeypatch.setitem(sys.modules, "lfpiv_cli.verbs.distributed", None)
    with pytest.raises(UsageError, match=r'pip install "lfpiv\[cluster\]"'):
        work(Toy(tmp_path, 2), "local")


class Fatal(Toy):
    """The first process to make output 0 ends there, once; output 2 takes until that has happened."""

    def make(self, number: int, work: Frames) -> int:
        ended = self.folder / "ended"
        if number == 0 and not ended.exists():
            ended.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().make(number, work)


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
    worked, warned = work(Fatal(tmp_path, 4), "local:2")
    assert written(tmp_path) == list("0123")
    assert not worked.failures
    assert [notice.about for notice in warned if notice.code == "worker-ended"] == ["0"]
    # The claim of the killed worker was taken over.
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
def test_an_output_that_kills_workers_is_named_and_the_others_are_made(tmp_path: Path) -> None:
    worked, warned = work(Toy(tmp_path, 5, deadly=[1]), "local:2", keep_going=True)
    assert written(tmp_path) == list("0234")
    assert [(failure.name, failure.error) for failure in worked.failures] == [
        ("1", "1: 3 workers ended while they worked on it")
    ]
    with pytest.raises(PartialError, match="1 of 5 frames failed, the first because 1: 3 workers ended"):
        worked.ensure_whole({}, "frame")
    # Without `keep_going` the others are made first.
    (tmp_path / "more").mkdir()
    with pytest.raises(InputError, match=r"0: 3 workers ended .*; 2 of 3 frames were written before"):
        work(Toy(tmp_path / "more", 3, deadly=[0]), "local:2")
    assert written(tmp_path / "more") == list("12")


class Ending(Toy):
    """Ends the scheduler, whose process is named in a file, with its last output."""

    def make(self, number: int, work: Frames) -> int:
        if number == len(self.targets) - 1:
            os.kill(int((self.folder / "scheduler").read_text()), signal.SIGKILL)
        return super().make(number, work)


@pytest.mark.slow
def test_workers_elsewhere_and_a_scheduler_that_ends(tmp_path: Path) -> None:
    tests = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": f"{tests.parent}{os.pathsep}{tests}"}
    reported = ["--scheduler-file", str(tmp_path / "scheduler.json")]
    with contextlib.ExitStack() as processes:

        def start(module: str, *options: str) -> int:
            command = [sys.executable, "-m", f"distributed.cli.{module}", *reported, *options]
            process = subprocess.Popen(command, env=environment, cwd="/", stderr=subprocess.DEVNULL)
            processes.callback(process.wait, 20)
            processes.callback(process.terminate)
            return process.pid

        scheduler = start("dask_scheduler", "--port", "0", "--no-dashboard")
        start("dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path))
        while not (tmp_path / "scheduler.json").exists():
            time.sleep(0.1)
        address = json.loads((tmp_path / "scheduler.json").read_text())["address"]
        worked, _ = work(Toy(tmp_path, 3), address)
        assert list(worked.outcomes) == [0, 1, 2]
        assert os.getpid() not in worked.outcomes.values()
        (tmp_path / "scheduler").write_text(str(scheduler))
        with pytest.raises(StoppedEarlyError, match="the scheduler has ended; the same command with --resume goes on"):
            work(Ending(tmp_path, 2), address)


def test_workers_go_on_where_they_are_and_begin_where_most_is_left() -> None:
    from lfpiv_cli.verbs.distributed import Runs

    left = Runs([10, 11, 12, 13, 14, 15, 16, 17])
    assert [left.next_for(worker) for worker in "ab"] == [10, 14]
    assert [left.next_for(worker) for worker in "aab"] == [11, 12, 15]
    # a third worker takes the second half of the longest run, a worker without one the rest of another's
    assert [left.next_for(worker) for worker in "caa"] == [17, 13, 16]
    assert not left
    left = Runs(range(5))
    assert [left.next_for("a") for _ in range(len(left))] == list(range(5))
    left = Runs([5, 6])
    assert left.next_for("a") == 5
    left.put_back(5)
    assert sorted([left.next_for("b"), left.next_for("c")]) == [5, 6]
