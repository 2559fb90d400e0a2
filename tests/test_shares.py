"""Shares of a batch: every frame in exactly one, by number or by Slurm's array; times as people write them."""

from __future__ import annotations

import pytest

from lfpiv_cli.errors import UsageError
from lfpiv_cli.files import shares
from lfpiv_cli.files.shares import Deadline, Runs, Shard, parse_time_limit


@pytest.mark.parametrize(("total", "count"), [(0, 3), (2, 3), (7, 3), (100, 7), (1000, 1000)])
def test_every_frame_is_in_one_share_and_shares_differ_by_one_frame(total: int, count: int) -> None:
    parts = [Shard(number, count).numbers(total) for number in range(1, count + 1)]
    assert [frame for part in parts for frame in part] == list(range(total))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_a_share_is_written_as_a_part_of_parts() -> None:
    assert Shard.parse("2/3") == Shard(2, 3)
    assert Shard.parse("1/1").numbers(5) == range(5)


@pytest.mark.parametrize("text", ["0/3", "4/3", "1/0", "3", "1/3/5", "a/b", "-1/3", "1.0/3", "", "1/99999999", "²/3"])
def test_what_is_no_share_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--shard"):
        Shard.parse(text)


def slurm(task: int, first: int, count: int, step: int | None = 1) -> dict[str, str]:
    told = {"ID": task, "MIN": first, "COUNT": count} | ({} if step is None else {"STEP": step})
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in told.items()}


@pytest.mark.parametrize(
    ("told", "share"),
    [
        (slurm(0, 0, 4), Shard(1, 4)),
        (slurm(20, 1, 20, None), Shard(20, 20)),
        (slurm(14, 10, 5, 2), Shard(3, 5)),
        # one job of an array that is started again alone does what is left
        (slurm(7, 7, 1), Shard(1, 1)),
    ],
)
def test_slurm_tells_the_share(told: dict[str, str], share: Shard) -> None:
    assert Shard.parse("slurm", told) == share


@pytest.mark.parametrize(
    "told", [{}, slurm(7, 1, 3), slurm(4, 1, 5, 2), {**slurm(1, 1, 2), "SLURM_ARRAY_TASK_ID": "x"}]
)
def test_arrays_of_slurm_that_are_no_range_are_refused(told: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="--shard slurm"):
        Shard.parse("slurm", told)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("3600", 3600.0), ("50m", 3000.0), ("1.5h", 5400.0), ("90s", 90.0), ("2d", 172800.0), ("00:50:00", 3000.0)],
)
def test_times_as_people_and_slurm_write_them(text: str, seconds: float) -> None:
    assert parse_time_limit(text) == seconds
    assert parse_time_limit("1-12:00:00") == 129600.0


@pytest.mark.parametrize("text", ["", "0", "0m", "-5", "5 m", "1e3", "12:30", "1:60:00", "00:00:00", "inf", "9" * 30])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--time-limit"):
        parse_time_limit(text)


def test_a_frame_that_would_not_be_done_is_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(shares.time, "monotonic", lambda: clock[0])
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


def test_without_a_limit_nothing_stops() -> None:
    assert Deadline(None, longest_s=1e9, begun=-1e9).leaves_time()


def test_workers_go_on_where_they_are_and_begin_where_most_is_left() -> None:
    left = Runs([10, 11, 12, 13, 14, 15, 16, 17])
    assert [left.next_for(worker) for worker in "ab"] == [10, 14]
    assert [left.next_for(worker) for worker in "aab"] == [11, 12, 15]
    # a third worker takes the second half of the longest run, a worker without one the rest of another's
    assert [left.next_for(worker) for worker in "caa"] == [17, 13, 16]
    assert not left


def test_a_single_worker_goes_through_in_order() -> None:
    left = Runs(range(5))
    assert [left.next_for("a") for _ in range(len(left))] == list(range(5))


def test_a_frame_that_is_put_back_goes_to_another_worker() -> None:
    left = Runs([5, 6])
    assert left.next_for("a") == 5
    left.put_back(5)
    assert sorted([left.next_for("b"), left.next_for("c")]) == [5, 6]
