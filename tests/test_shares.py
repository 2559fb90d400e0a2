"""Shares of a batch, times as people write them, folders that are being filled, work on threads."""

from collections.abc import Iterator
from pathlib import Path
from time import sleep

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import batch, inputs
from lfpiv_cli.files.batch import LOOK_S, PASSED_OVER_S, SETTLED_S, as_they_come
from lfpiv_cli.files.inputs import Deadline, Shard, parse_time_limit
from lfpiv_cli.threads import blocks, in_threads, share_out


@pytest.mark.parametrize(("total", "count"), [(0, 3), (2, 3), (7, 3), (100, 7), (1000, 1000)])
def test_every_frame_is_in_one_share_and_shares_differ_by_one_frame(total: int, count: int) -> None:
    parts = [Shard(number, count).numbers(total) for number in range(1, count + 1)]
    assert [frame for part in parts for frame in part] == list(range(total))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def slurm(task: int, first: int, count: int, step: int | None = 1) -> dict[str, str]:
    told = {"ID": task, "MIN": first, "COUNT": count} | ({} if step is None else {"STEP": step})
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in told.items()}


def test_shares_as_people_write_them_and_slurm_tells_them() -> None:
    assert Shard.parse("2/3") == Shard(2, 3)
    assert Shard.parse("1/1").numbers(5) == range(5)
    for text in ("0/3", "4/3", "1/0", "3", "1/3/5", "a/b", "-1/3", "1.0/3", "", "1/99999999", "²/3"):
        with pytest.raises(UsageError, match="--shard"):
            Shard.parse(text)
    for told, share in (
        (slurm(0, 0, 4), Shard(1, 4)),
        (slurm(20, 1, 20, None), Shard(20, 20)),
        (slurm(14, 10, 5, 2), Shard(3, 5)),
        # one job of an array that is started again alone does what is left
        (slurm(7, 7, 1), Shard(1, 1)),
    ):
        assert Shard.parse("slurm", told) == share
    no_range = {**slurm(1, 1, 2), "SLURM_ARRAY_TASK_ID": "x"}
    for told in ({}, slurm(7, 1, 3), slurm(4, 1, 5, 2), no_range):
        with pytest.raises(UsageError, match="--shard slurm"):
            Shard.parse("slurm", told)


TIMES = {"3600": 3600.0, "50m": 3000.0, "1.5h": 5400.0, "90s": 90.0, "2d": 172800.0, "00:50:00": 3000.0}
NO_TIMES = ("", "0", "0m", "-5", "5 m", "1e3", "12:30", "1:60:00", "00:00:00", "inf", "9" * 30)


def test_times_as_people_and_slurm_write_them() -> None:
    for text, seconds in (TIMES | {"1-12:00:00": 129600.0}).items():
        assert parse_time_limit(text) == seconds
    for text in NO_TIMES:
        with pytest.raises(UsageError, match="--time-limit"):
            parse_time_limit(text)


def test_a_frame_that_would_not_be_done_is_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(inputs.time, "monotonic", lambda: clock[0])
    deadline = Deadline(100.0, begun=0.0)
    assert deadline.leaves_time()
    deadline.took(40.0)
    deadline.took(10.0)
    clock[0] = 59.0
    assert deadline.leaves_time()
    assert not deadline.leaves_time(2)
    clock[0] = 61.0
    assert not deadline.leaves_time()
    told = deadline.error(2, 5, "frame")
    assert "39 s are left" in str(told)
    assert "2 of 5 frames are done; the same command with --resume goes on" in str(told)
    assert told.exit_code == 75
    assert Deadline(None, longest_s=1e9, begun=-1e9).leaves_time()


WHOLE = b"a whole image"


class Recorder:
    """A clock, and what is written to a folder as it goes on."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.now_s = folder, 0.0
        self.plan: list[tuple[float, str, bytes]] = []

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.write()

    def write(self) -> None:
        for written in [each for each in self.plan if each[0] <= self.now_s]:
            self.plan.remove(written)
            with open(self.folder / written[1], "ab") as file:
                file.write(written[2])

    def listed(self) -> list[Path]:
        return sorted(self.folder.iterdir())

    def groups(self, idle_s: float) -> Iterator[list[str]]:
        self.write()
        for group in as_they_come(self.listed, read, idle_s):
            yield [path.name for path in group]


def read(path: Path) -> None:
    if path.read_bytes() != WHOLE:
        raise InputError(f"{path}: is cut")


@pytest.fixture
def recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recorder:
    recorder = Recorder(tmp_path)
    monkeypatch.setattr(batch, "time", recorder)
    return recorder


def test_what_is_there_is_taken_at_once_and_the_rest_as_it_comes(recorder: Recorder) -> None:
    assert not list(recorder.groups(3.0))
    assert 3.0 <= recorder.now_s <= 3.0 + LOOK_S
    begun_s = recorder.now_s
    recorder.plan = [(begun_s, "1", WHOLE), (begun_s, "2", WHOLE), (begun_s + 6.0, "3", WHOLE)]
    assert list(recorder.groups(10.0)) == [["1", "2"], ["3"]]
    # the third file's time and the idle time, seen at the next look
    assert 16.0 <= recorder.now_s - begun_s <= 16.0 + 2 * LOOK_S


def test_a_file_that_is_being_written_is_waited_for_and_so_are_those_behind_it(recorder: Recorder) -> None:
    recorder.plan = [(0.0, "1", WHOLE[:5]), (0.0, "2", WHOLE), (4.0, "1", WHOLE[5:8]), (8.0, "1", WHOLE[8:])]
    assert list(recorder.groups(5.0)) == [["1", "2"]]
    assert recorder.now_s >= 8.0 + SETTLED_S


def test_a_file_is_not_taken_while_it_grows_though_it_can_be_read(recorder: Recorder) -> None:
    recorder.plan = [(0.5 * step, "run", b"page") for step in range(12)]
    groups = as_they_come(recorder.listed, lambda path: path.stat().st_size, 5.0)
    assert [path.stat().st_size for (path,) in groups] == [4 * 12]


def test_what_never_becomes_complete_comes_last(recorder: Recorder) -> None:
    recorder.plan = [(0.0, "1", WHOLE), (0.0, "2", b""), (0.0, "3", WHOLE)]
    assert list(recorder.groups(5.0)) == [["1"], ["2", "3"]]


def test_a_file_that_goes_away_is_forgotten(recorder: Recorder) -> None:
    def leave_out(seconds: float) -> None:
        recorder.now_s += seconds
        if recorder.now_s >= 3.0:
            (recorder.folder / "1").unlink(missing_ok=True)

    recorder.plan = [(0.0, "1", b"half"), (0.0, "2", WHOLE)]
    groups = as_they_come(recorder.listed, read, 5.0)
    recorder.write()
    recorder.sleep = leave_out  # type: ignore[method-assign]
    assert [[path.name for path in group] for group in groups] == [["2"]]


def test_results_are_in_order_and_errors_come_through() -> None:
    assert in_threads(lambda k: 10 // k, [1, 2, 5]) == [10, 5, 2]
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda k: 10 // k, [1, 0, 5])
    sums = in_threads(lambda row: sum(in_threads(lambda k: row * k, range(5))), range(5))
    assert sums == [10 * row for row in range(5)]


def test_every_piece_of_work_is_shared_out_once() -> None:
    for count, expected in ((0, [(0, 0)]), (1, [(0, 1)]), (4, [(0, 2), (2, 4)]), (5, [(0, 2), (2, 4), (4, 5)])):
        assert [(block.start, block.stop) for block in blocks(count, 2)] == expected

    def work(part: tuple[int, int], much: float, onto: Floats) -> None:
        onto[part[0] : part[1]] += much

    for count in (0, 1, 2, 100):
        done = np.zeros(count)
        share_out(work, count, 2.0, done)
        assert done.tolist() == [2.0] * count


def test_nothing_more_is_begun_after_an_error() -> None:
    begun = []

    def work(piece: int) -> None:
        begun.append(piece)
        sleep(1e-3)
        if piece == 0:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        in_threads(work, range(50))
    assert len(begun) < 25


def test_a_file_that_stays_broken_is_passed_over_and_taken_when_it_is_whole(recorder: Recorder) -> None:
    recorder.plan = [(0.0, "1", WHOLE[:5]), (0.0, "2", WHOLE), (PASSED_OVER_S + 8.0, "1", WHOLE[5:])]
    recorder.write()
    told: list[str] = []
    groups = as_they_come(recorder.listed, read, 15.0, lambda path, error: told.append(f"{path.name}, {error}"))
    assert [[path.name for path in group] for group in groups] == [["2"], ["1"]]
    assert told == [f"1, {recorder.folder / '1'}: is cut"]
