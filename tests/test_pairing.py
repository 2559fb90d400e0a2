"""Pairs by name: the names that cameras give, and that no name lost, moved or repeated ever makes a wrong pair."""

import random
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import PurePath

import pytest

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.pairing import Pairs, Seen, contradiction, in_order, pair_frames, places_by
from lfpiv_cli.names import Pairing

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


@pytest.mark.thorough
@pytest.mark.parametrize("form", SEPARATE)
def test_whatever_is_lost_or_moved_no_pair_is_wrong(form: str) -> None:
    pairs = [SEPARATE[form](k) for k in range(1, 6)]
    chance = random.Random(2)
    for _ in range(200):
        left = [name for pair in pairs for name in pair if chance.random() < 0.7]
        chance.shuffle(left)
        if len(left) < 2:
            continue
        whole = {pair for pair in pairs if set(pair) <= set(left)}
        found = pair_names(left, "ab")
        assert named(left, found) <= whole
        # All of the whole pairs are found, but where what is left has another sense: one frame of each alone.
        assert found.left_out or named(left, found) == whole


@pytest.mark.thorough
@pytest.mark.parametrize("form", RUNNING)
def test_whatever_of_running_numbers_is_lost_no_pair_is_wrong(form: str) -> None:
    names = [RUNNING[form](n) for n in range(10)]
    chance = random.Random(3)
    for _ in range(300):
        left = [name for name in names if chance.random() < 0.8]
        chance.shuffle(left)
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
    chance = random.Random(4)
    for _ in range(300):
        left = [name for name in names if chance.random() < 0.7]
        chance.shuffle(left)
        if len(left) < 2:
            continue
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
    assert [(each.about, each.text) for each in found.left_out] == [
        ("a2", "the second frame of its pair is missing"),
        ("b7", "the first frame of its pair is missing"),
    ]
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
    assert [(notice.code, notice.about) for notice in notices] == [
        ("frames-missing", "t_8"),
        ("frames-reordered", "t_9"),
    ]
    for names in (("late", "early"), ("x_2", "y_1"), ("t_2", "t_1", "t_1"), ("t_2", "early")):
        assert in_order(seen(*names)) == (list(range(len(names))), [])


def seen(*names: str) -> list[Seen]:
    return [Seen(name, name, name) for name in names]
