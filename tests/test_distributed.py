"""Batches on Dask's workers: the same files as without, a killed worker loses nothing, what kills workers is named."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.errors import InputError, OutputError, PartialError, StoppedEarlyError, UsageError
from lfpiv_cli.files.atomic import claimed
from lfpiv_cli.files.batch import Target
from lfpiv_cli.files.inputs import Shard
from lfpiv_cli.notice import Notice
from lfpiv_cli.verbs.batches import Batch, BatchOptions, Worked, work_through

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
    """Ends the scheduler, whose process is told in a file, with its last output."""

    def make(self, number: int, work: Frames) -> int:
        if number == len(self.targets) - 1:
            os.kill(int((self.folder / "scheduler").read_text()), signal.SIGKILL)
        return super().make(number, work)


@pytest.mark.slow
def test_workers_elsewhere_and_a_scheduler_that_ends(tmp_path: Path) -> None:
    tests = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": f"{tests.parent}{os.pathsep}{tests}"}
    reported = ["--scheduler-file", str(tmp_path / "told.json")]
    with contextlib.ExitStack() as processes:

        def start(module: str, *options: str) -> int:
            command = [sys.executable, "-m", f"distributed.cli.{module}", *reported, *options]
            process = subprocess.Popen(command, env=environment, cwd="/", stderr=subprocess.DEVNULL)
            processes.callback(process.wait, 20)
            processes.callback(process.terminate)
            return process.pid

        scheduler = start("dask_scheduler", "--port", "0", "--no-dashboard")
        start("dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path))
        while not (tmp_path / "told.json").exists():
            time.sleep(0.1)
        address = json.loads((tmp_path / "told.json").read_text())["address"]
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
