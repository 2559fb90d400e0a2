"""Which frames belong together and who works on which: pairs by name, shares of a batch, folders that fill up."""

import random
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path, PurePath
from time import sleep

import numpy as np
import pytest
from numba import get_num_threads

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import batch, inputs
from lfpiv_cli.files.batch import LOOK_S, PASSED_OVER_S, SETTLED_S, as_they_come
from lfpiv_cli.files.inputs import Deadline, Shard, parse_time_limit
from lfpiv_cli.files.pairing import Pairs, Seen, contradiction, in_order, pair_frames, places_by
from lfpiv_cli.names import Pairing
from lfpiv_cli.threads import blocks, in_threads, share_out

# What a camera calls the frames of pair `k`, first and second.
SEPARATE: dict[str, Callable[[int], tuple[str, str]]] = {
    "number and letter": lambda k: (f"img_{k:04d}_a", f"img_{k:04d}_b"),
    "letters in both cases": lambda k: (f"img_{k:04d}_A", f"IMG_{k:04d}_b"),
    "letter without a separator": lambda k: (f"{k:04d}A", f"{k:04d}B"),
    "letter first": lambda k: (f"a_{k:03d}", f"b_{k:03d}"),
    "letter first, no separator": lambda k: (f"A{k:04d}", f"B{k:04d}"),
    "letter between": lambda k: (f"jet_a_{k:03d}", f"jet_b_{k:03d}"),
    "letter after a word": lambda k: (f"imgA_{k}", f"imgB_{k}"),
    "lasers": lambda k: (f"B{k:05d}_LA", f"B{k:05d}_LB"),
    "buffers from 0": lambda k: (f"B{k:05d}_0", f"B{k:05d}_1"),
    "buffers of four digits": lambda k: (f"B{k:04d}_0", f"B{k:04d}_1"),
    "buffers of four digits, from 1": lambda k: (f"B{k:04d}_1", f"B{k:04d}_2"),
    "frames from 1": lambda k: (f"B{k:05d}_1", f"B{k:05d}_2"),
    "a word behind": lambda k: (f"img_{k:04d}_a_8bit", f"img_{k:04d}_b_8bit"),
    "time stamps": lambda k: (f"{k:03d}_a_20240131_120000.{k:03d}", f"{k:03d}_b_20240131_120000.{k:03d}"),
}
RUNNING: dict[str, Callable[[int], str]] = {
    "running numbers": lambda n: f"run_{n:06d}",
    "without zeros": lambda n: f"frame {n}",
    "numbers alone": lambda n: f"{n:08d}",
    "a word behind": lambda n: f"img_{n:04d}_8bit",
    "a camera's serial number": lambda n: f"C001H001S0001_{n:06d}",
}


def pair_names(names: Sequence[str], how: Pairing, by: str | None = None) -> Pairs:
    """Return which of the frames with these names belong together."""
    return pair_frames([Seen(name, PurePath(name).name, PurePath(name).as_posix()) for name in names], how, by)


def named(names: list[str], found: Pairs) -> set[tuple[str, str]]:
    return {(names[first], names[second]) for first, second in found.pairs}


@pytest.mark.parametrize("form", SEPARATE)
def test_names_of_pairs(form: str) -> None:
    pairs = [SEPARATE[form](k) for k in (1, 2, 3, 12)]
    names = [name for pair in pairs for name in pair]
    random.Random(1).shuffle(names)
    found = pair_names(names, "ab")
    assert [(names[a], names[b]) for a, b in found.pairs] == pairs
    assert not found.left_out
    assert not found.notices


@pytest.mark.parametrize("form", RUNNING)
@pytest.mark.parametrize("begins", [0, 1])
def test_running_numbers_are_pairs_from_where_they_begin(form: str, begins: int) -> None:
    names = [RUNNING[form](n) for n in range(begins, begins + 12)]
    assert pair_names(names, "ab").pairs == tuple((k, k + 1) for k in range(0, 12, 2))


def lost_of(names: list[str], share: float, seed: int) -> Iterator[list[str]]:
    """Yield what is left, in any order, of names of which each is lost with so much chance."""
    chance = random.Random(seed)
    for _ in range(300):
        left = [name for name in names if chance.random() >= share]
        chance.shuffle(left)
        if len(left) >= 2:
            yield left


@pytest.mark.thorough
@pytest.mark.parametrize("form", SEPARATE)
def test_whatever_is_lost_or_moved_no_pair_is_wrong(form: str) -> None:
    pairs = [SEPARATE[form](k) for k in range(1, 6)]
    for left in lost_of([name for pair in pairs for name in pair], 0.3, seed=2):
        whole = {pair for pair in pairs if set(pair) <= set(left)}
        found = pair_names(left, "ab")
        assert named(left, found) <= whole
        # All of the whole pairs are found, but where what is left has another sense: one frame of each alone.
        assert found.left_out or named(left, found) == whole


@pytest.mark.thorough
@pytest.mark.parametrize("form", RUNNING)
def test_whatever_of_running_numbers_is_lost_no_pair_is_wrong(form: str) -> None:
    names = [RUNNING[form](n) for n in range(10)]
    for left in lost_of(names, 0.2, seed=3):
        found, numbers = pair_names(left, "ab"), sorted(map(names.index, left))
        if numbers[0] == 0:
            assert named(left, found) == {(names[k], names[k + 1]) for k in range(0, 9, 2) if {k, k + 1} <= {*numbers}}
            assert len(found.left_out) + 2 * len(found.pairs) == len(left)
        elif found.pairs:
            # Only frames without a gap, that count from 1.
            assert numbers == list(range(1, 1 + 2 * len(found.pairs)))
            assert not found.notices


@pytest.mark.thorough
@pytest.mark.parametrize("form", RUNNING)
def test_whatever_of_a_sequence_is_lost_no_pair_is_wrong(form: str) -> None:
    names = [RUNNING[form](n) for n in range(10)]
    for left in lost_of(names, 0.3, seed=4):
        found, numbers = pair_names(left, "sequence"), sorted(map(names.index, left))
        next_to = {(names[a], names[b]) for a, b in pairwise(numbers) if b == a + 1}
        gaps = sum(b > a + 1 for a, b in pairwise(numbers))
        if next_to:
            assert named(left, found) == next_to
            assert len(found.left_out) == gaps
        else:
            assert [notice.code for notice in found.notices] == ["numbers-apart"]


def test_lost_frames_leave_the_pairs_around_them() -> None:
    left = [name for k in range(1, 11) for name in (f"a{k}", f"b{k}") if name not in ("b2", "a7")]
    found = pair_names(left, "ab")
    assert named(left, found) == {(f"a{k}", f"b{k}") for k in (1, 3, 4, 5, 6, 8, 9, 10)}
    said = [("a2", "the second frame of its pair is missing"), ("b7", "the first frame of its pair is missing")]
    assert [(each.about, each.text) for each in found.left_out] == said
    with pytest.raises(InputError, match=r"a2: the second frame .* 1 more.*--pair-by"):
        found.settled(keep_going=False)
    assert [notice.about for notice in found.settled(keep_going=True)] == ["a2", "b7"]
    found = pair_names([f"run_{n:03d}" for n in (0, 1, 2, 4, 5)], "ab")
    assert found.pairs == ((0, 1), (3, 4))
    assert [each.about for each in found.left_out] == ["run_002"]
    # A repeated frame is left out with its pair.
    found = pair_names(["x/1a", "x/1b", "y/1a", "x/2a", "x/2b"], "ab")
    assert found.pairs == ((3, 4),)
    assert [each.about for each in found.left_out] == ["x/1a", "y/1a", "x/1b"]
    assert "twice: x/1a and y/1a" in found.left_out[0].text


def test_where_pairs_begin_is_open_with_a_gap_and_names_that_tell_nothing_go_by_order() -> None:
    names = ["run_1", "run_2", "run_3", "run_5", "run_6"]
    found = pair_names(names, "ab")
    assert not found.pairs
    with pytest.raises(InputError, match=r"4 is missing.*even or odd"):
        found.settled(keep_going=True)
    assert named(names, pair_names(names, "ab", "run_{number:1}")) == {("run_1", "run_2"), ("run_5", "run_6")}
    assert named(names, pair_names(names, "ab", "run_{number}")) == {("run_2", "run_3")}
    assert pair_names(["still", "moved"], "ab") == Pairs(((0, 1),))
    found = pair_names(["still", "moved", "early", "late"], "ab")
    assert found.pairs == ((0, 1), (2, 3))
    assert [notice.code for notice in found.notices] == ["paired-by-order"]
    with pytest.raises(InputError, match="early"):
        pair_names(["still", "moved", "early"], "ab").settled(keep_going=False)
    mixed = pair_names(["1a", "1b", "background"], "ab")
    assert [each.about for each in mixed.left_out] == ["background"]


@pytest.mark.parametrize("numbers", [range(2, 6), range(7, 9), range(1000, 1010)])
def test_numbers_that_begin_later_leave_open_where_pairs_begin(numbers: range) -> None:
    names = [f"img_{n:04d}" for n in numbers]
    found = pair_names(names, "ab")
    assert not found.pairs
    assert len(found.left_out) == len(names)
    with pytest.raises(InputError, match=rf"{names[0]}: .* {numbers[0]} to {numbers[-1]} none is 0 or 1.*even or odd"):
        found.settled(keep_going=True)
    begins = numbers[0] % 2
    assert pair_names(names, "ab", f"img_{{number:{begins}}}").pairs == tuple(
        (k, k + 1) for k in range(0, len(names), 2)
    )


@pytest.mark.parametrize(
    ("first", "second", "why"),
    [
        ("img_0001a", "img_0001b", None),
        ("img_0001b", "img_0001a", None),  # the other way round, which is another matter
        ("img_0001a", "img_0002b", "different pairs"),
        ("img_0001b", "img_0002a", "different pairs"),
        ("img_0001a", "img_0002a", None),  # a letter that all have
        ("img_0001a", "img_0003a", "numbers are 1 and 3"),
        ("img_a", "img_b", None),
        ("jet_a", "shot_b", "different pairs"),
        ("img_0001", "img_0002", None),
        ("img_0001", "img_0003", "numbers are 1 and 3"),
        ("img_0010", "img_0001", "numbers are 10 and 1"),
        ("B0001_0", "B0001_1", None),
        ("B0001_0", "B0002_1", "different pairs"),
        ("jet_0001", "shot_0003", None),
        ("20240131_120000", "20240131_120005", None),
        ("still", "moved", None),
    ],
)
def test_what_names_contradict_of_two_frames(first: str, second: str, why: str | None) -> None:
    found = contradiction(*seen(first, second))
    assert (found is None) == (why is None)
    assert why is None or why in (found or "")
    pages = [Seen(f"run {page}", "run", "run", page) for page in (0, 1, 3)]
    assert contradiction(*pages[:2]) is None
    assert "numbers are 1 and 3" in (contradiction(*pages[1:]) or "")


def test_series_of_one_command_stay_apart_and_a_letter_that_all_have_is_one_frame() -> None:
    names = ["hot_1", "hot_2", "cold_1", "cold_2"]
    # As ab, hot and cold could be the two frames.
    found = pair_names(names, "ab")
    assert not found.pairs
    assert "2 series" in found.left_out[0].text
    assert named(names, pair_names(names, "sequence")) == {("hot_1", "hot_2"), ("cold_1", "cold_2")}
    names = ["img_1_a", "img_2_a", "img_3_a"]
    assert not pair_names(names, "ab").pairs
    in_time = pair_names(names, "sequence")
    assert len(in_time.pairs) == 2
    assert not in_time.notices
    # LaVision's buffers begin with a letter.
    assert len(pair_names(["B00001", "B00002"], "ab").pairs) == 1
    assert len(pair_names(["B0001_0", "B0001_1"], "ab").pairs) == 1


def test_a_sequence_has_no_pair_across_a_gap_and_numbers_apart_are_steps() -> None:
    names = ["t_9", "t_10", "t_12", "t_13"]
    found = pair_names(names, "sequence")
    assert found.pairs == ((0, 1), (2, 3))
    assert [(each.about, each.text) for each in found.left_out] == [("t_12", "frames are missing between t_10 and it")]
    letters = ["1a", "1b", "2b", "3a"]
    assert named(letters, pair_names(letters, "sequence")) == {("1a", "1b"), ("2b", "3a")}
    found = pair_names(["t_0", "t_2", "t_4", "t_8"], "sequence")
    assert found.pairs == ((0, 1), (1, 2))
    assert found.notices[0].code == "numbers-apart"
    stamps = [f"20240131_1200{second:02d}" for second in (0, 1, 2, 5)]
    assert pair_names(stamps, "sequence").pairs == ((0, 1), (1, 2))


@pytest.mark.parametrize(
    ("template", "names"),
    [
        ("img_{pair}_{frame}", ["img_7_first", "img_7_second"]),
        ("{pair}{frame}", ["0007l", "0007r"]),
        ("t{frame}_{pair}", ["T1_007", "t2_007"]),
        ("{frame}/{pair}", ["here/one/x", "here/two/x"]),
        ("{pair}_*_{frame}", ["7_12:30_0", "7_12:31_1"]),
        ("*_{number:7}_*", ["a_7_1", "b_8_2"]),
    ],
)
def test_templates(template: str, names: list[str]) -> None:
    assert pair_names(names[::-1], "ab", template).pairs == ((1, 0),)
    for too_little in ("img", "{pair}", "{frame}_{frame}", "{pear}_{frame}", "{pair}_{frame", "{}"):
        with pytest.raises(UsageError, match="--pair-by"):
            places_by(too_little, ["img_1_a"])


def test_a_pair_has_two_frames_and_one_frame_is_none() -> None:
    with pytest.raises(UsageError, match="x, y, z"):
        places_by("{pair}_{frame}", ["1_x", "1_y", "1_z"])
    found = pair_names(["1_a", "1_b", "2_a", "other"], "ab", "{pair}_{frame}")
    assert [each.about for each in found.left_out] == ["other", "2_a"]
    for how in ("ab", "sequence"):
        with pytest.raises(UsageError, match=f"--pairing {how}: needs two or more"):
            pair_names(["1a"], how)


def test_those_beside_and_the_order_of_work_and_numbers() -> None:
    found = pair_names(["2", "1", "0"], "sequence")
    assert found.beside(3) == [(1,), (0, 2), (1,)]
    assert found.first_of() == {}
    found = pair_names(["1a", "2a", "2b", "1b"], "ab")
    assert found.beside(4) == [(3,), (2,), (1,), (0,)]
    assert found.first_of() == {3: 0, 2: 1}
    pairs = Pairs(((0, 3), (2, 4)))
    assert pairs.order(6) == [0, 3, 2, 4, 1, 5]
    assert Pairs(((0, 1), (1, 2)), separate=False).order(3) == [0, 1, 2]
    assert in_order(seen("t_1", "t_2", "t_3")) == ([0, 1, 2], [])
    order, notices = in_order(seen("t_1", "t_10", "t_9", "t_8"))
    assert order == [0, 3, 2, 1]
    assert [(each.code, each.about) for each in notices] == [("frames-missing", "t_8"), ("frames-reordered", "t_9")]
    for names in (("late", "early"), ("x_2", "y_1"), ("t_2", "t_1", "t_1"), ("t_2", "early")):
        assert in_order(seen(*names)) == (list(range(len(names))), [])


def seen(*names: str) -> list[Seen]:
    return [Seen(name, name, name) for name in names]


@pytest.mark.parametrize(("total", "count"), [(0, 3), (2, 3), (7, 3), (100, 7), (1000, 1000)])
def test_every_frame_is_in_one_share_and_shares_differ_by_one_frame(total: int, count: int) -> None:
    parts = [Shard(number, count).numbers(total) for number in range(1, count + 1)]
    assert [frame for part in parts for frame in part] == list(range(total))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def slurm(task: int, first: int, count: int, step: int | None = 1) -> dict[str, str]:
    reported = {"ID": task, "MIN": first, "COUNT": count} | ({} if step is None else {"STEP": step})
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in reported.items()}


def test_shares_as_people_write_them_and_slurm_tells_them() -> None:
    assert Shard.parse("2/3") == Shard(2, 3)
    assert Shard.parse("1/1").numbers(5) == range(5)
    for text in ("0/3", "4/3", "1/0", "3", "1/3/5", "a/b", "-1/3", "1.0/3", "", "1/99999999", "²/3"):
        with pytest.raises(UsageError, match="--shard"):
            Shard.parse(text)
    for reported, share in (
        (slurm(0, 0, 4), Shard(1, 4)),
        (slurm(20, 1, 20, None), Shard(20, 20)),
        (slurm(14, 10, 5, 2), Shard(3, 5)),
        # one job of an array that is started again alone does what is left
        (slurm(7, 7, 1), Shard(1, 1)),
    ):
        assert Shard.parse("slurm", reported) == share
    no_range = {**slurm(1, 1, 2), "SLURM_ARRAY_TASK_ID": "x"}
    for reported in ({}, slurm(7, 1, 3), slurm(4, 1, 5, 2), no_range):
        with pytest.raises(UsageError, match="--shard slurm"):
            Shard.parse("slurm", reported)


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
    reported = deadline.error(2, 5, "frame")
    assert "39 s are left" in str(reported)
    assert "2 of 5 frames are done; the same command with --resume goes on" in str(reported)
    assert reported.exit_code == 75
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
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda k: 10 // k, [0, 1, 5], [set(), {0}, {1}])
    done: list[int] = []
    in_threads(lambda k: (sleep(0.02 * (k == 0)), done.append(k)), range(4), [set(), {0}, set(), {1}])
    # With one thread they follow each other.
    assert (done.index(0) < done.index(1) < done.index(3), done[0]) == (True, 2 if get_num_threads() > 1 else 0)
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
    reported: list[str] = []
    groups = as_they_come(recorder.listed, read, 15.0, lambda path, error: reported.append(f"{path.name}, {error}"))
    assert [[path.name for path in group] for group in groups] == [["2"], ["1"]]
    assert reported == [f"1, {recorder.folder / '1'}: is cut"]
