"""Which frames of a batch belong together: by their names, and never across one that is missing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePath

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.frame_names import STAMP, Place, places_by, places_of
from lfpiv_cli.files.inputs import content_of
from lfpiv_cli.names import Pairing
from lfpiv_cli.notice import Notice

REMEDY = "say how names tell it with --pair-by, or leave such frames out with --keep-going"
NO_PLACE = "its name has neither a number nor a letter that says where it belongs"
# Numbers in a sequence may be times, which are not quite even: beyond so many steps a frame is missing.
MOST_STEPS = 1.5


@dataclass(frozen=True)
class LeftOut:
    """A frame that belongs with no other, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class Pairs:
    """The frames that belong together.

    Attributes
    ----------
    pairs : numbers of the frames of each pair, the earlier first
    left_out : frames that should have a partner and have none, and gaps in sequences
    notices : what was taken for granted
    separate : False where frames are in two pairs, one with the frame before and one with the next
    """

    pairs: tuple[tuple[int, int], ...]
    left_out: tuple[LeftOut, ...] = ()
    notices: tuple[Notice, ...] = ()
    separate: bool = True

    def beside(self, count: int) -> list[tuple[int, ...]]:
        """Return for each of `count` frames the numbers of those that it is paired with."""
        found: list[list[int]] = [[] for _ in range(count)]
        for first, second in self.pairs:
            found[first].append(second)
            found[second].append(first)
        return [tuple(sorted(numbers)) for numbers in found]

    def order(self, count: int) -> list[int]:
        """Return the numbers of `count` frames, the second of a pair behind its first, those without a partner last."""
        return list(dict.fromkeys([*(number for pair in self.pairs for number in pair), *range(count)]))

    def first_of(self) -> dict[int, int]:
        """Return of each second frame of separate pairs the first."""
        return {second: first for first, second in self.pairs} if self.separate else {}

    def settled(self, keep_going: bool) -> list[Notice]:
        """Return what is to be said of the pairs, where they can be taken.

        Raises
        ------
        InputError : a frame has no partner, or one is missing in a sequence, and `keep_going` is false; or no two
            belong together
        """
        if not self.left_out and not self.pairs:
            raise InputError("no two of the frames given are a pair")
        if self.left_out and not (keep_going and self.pairs):
            first, *others = self.left_out
            more = f", and {len(others)} more" if others else ""
            raise InputError(f"{first.name}: {first.why}{more}; {REMEDY}")
        return self.said()

    def said(self) -> list[Notice]:
        """Return what was taken for granted, and which frames are left out."""
        skipped = [Notice("frame-unpaired", each.name, each.why, REMEDY) for each in self.left_out]
        return [*self.notices, *skipped]


@dataclass(frozen=True)
class Seen:
    """What is known of a frame.

    Attributes
    ----------
    name : what it is called in messages
    stem : of the file that the camera wrote, where that is known, else of its own
    path : of its own file, without suffix
    page : in a file of several, counted from 0; None where a file is one frame
    image : what is the same only for the same image; None where it is not known
    """

    name: str
    stem: str
    path: str
    page: int | None = None
    image: str | None = None


@dataclass
class _Found:
    """Pairs as they are found."""

    names: Sequence[str]
    pairs: list[tuple[int, int]] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)

    def leave_out(self, numbers: Iterable[int], why: str) -> None:
        self.left_out += [LeftOut(self.names[number], why) for number in numbers]

    def told(self, how: Pairing) -> Pairs:
        return Pairs(tuple(self.pairs), tuple(self.left_out), tuple(self.notices), how == "ab")


def pair_frames(frames: Sequence[Seen], how: Pairing, by: str | None = None) -> Pairs:
    """Return which frames belong together; pages of one file belong together by their numbers.

    Parameters
    ----------
    how : `ab` for separate pairs, `sequence` for each frame with the next
    by : how names tell it, as `img_{pair}_{frame}`, see `places_by`; None: as cameras usually name frames

    Raises
    ------
    UsageError : there is only one frame, or `by` is no such template
    """
    count = len(frames)
    if count < 2:
        raise UsageError(f"--pairing {how}: needs two or more frames, got {count}")
    found = _Found([frame.name for frame in frames])
    first: dict[str, int] = {}
    once = []  # of each image the first frame only
    for number, frame in enumerate(frames):
        earlier = number if frame.image is None else first.setdefault(frame.image, number)
        if earlier == number:
            once.append(number)
        else:
            found.leave_out([number], f"shows the same image as {frames[earlier].name}")
    places = _places([frames[number] for number in once], how, by)

    # Where names tell nothing, frames are paired as they were given.
    if all(place is None for place in places) and by is None and len(once) == count:
        found.pairs = [(k, k + 1) for k in range(0, count - 1, 2 if how == "ab" else 1)]
        if count > 2:
            text = f"the names of {count} frames have no numbers, and only the order in which they are given pairs them"
            remedy = "number them, so that a missing one is seen"
            found.notices.append(Notice("paired-by-order", frames[0].name, text, remedy))
            found.leave_out([count - 1] if how == "ab" and count % 2 else [], "no frame comes after it")
        return found.told(how)
    placed = {number: place for number, place in zip(once, places, strict=True) if place is not None}
    missed = NO_PLACE if by is None else f"its name is not of the form {by}"
    found.leave_out((number for number in once if number not in placed), missed)
    (_pair if how == "ab" else _follow)(placed, found)
    return found.told(how)


def in_order(frames: Sequence[Seen]) -> tuple[list[int], list[Notice]]:
    """Return the frames of one sequence in the order of time, and what is to be said of it.

    That is the order of their numbers, where all have one and no two the same; else the order in which they are given.
    """
    given = list(range(len(frames)))
    places = _places(frames, "sequence", None)
    known = {number: place for number, place in enumerate(places) if place is not None}
    at = {(place.series, _position(place)) for place in known.values()}
    if len({place.series for place in known.values()}) > 1 or not len(at) == len(known) == len(frames):
        return given, []
    order = sorted(given, key=lambda number: _position(known[number]))
    found = _Found([frame.name for frame in frames])
    _follow(known, found)
    notices = [
        Notice("frames-missing", each.name, each.why, "tracks end or go on across the gap; leave out what is before it")
        for each in found.left_out
    ]
    if order != given:
        wrong = next(after for before, after in pairwise(given) if _position(known[after]) < _position(known[before]))
        text = f"is given behind {frames[wrong - 1].name}, and its number is before; numbers say what is first"
        notices.append(Notice("frames-reordered", frames[wrong].name, text, "give frames in the order of time"))
    return order, [*found.notices, *notices]


def contradiction(first: Seen, second: Seen) -> str | None:
    """Return how names contradict that two frames are a pair as they are given, or the other way round.

    Names of different series, without numbers or with times in their place contradict nothing.
    """
    a, b = _places([first, second], "ab", None)
    if a and b and {a.frame, b.frame} == {0, 1}:
        return None if (a.series, a.number) == (b.series, b.number) else "by their names they are of different pairs"
    a, b = _places([first, second], "sequence", None)
    if not a or not b or a.series != b.series or STAMP in a.series or abs(_position(a) - _position(b)) <= 1:
        return None
    return f"their numbers are {a.number} and {b.number}, and frames between them are not given"


def _places(frames: Sequence[Seen], how: Pairing, by: str | None) -> list[Place | None]:
    """Return where each frame belongs."""
    if by is not None:
        return places_by(by, [frame.path for frame in frames])
    places = places_of([frame.stem for frame in frames], how)
    return [
        place if frame.page is None else Place(f"pages of {frame.stem}", frame.page, begins=0)
        for frame, place in zip(frames, places, strict=True)
    ]


def _pair(places: Mapping[int, Place], found: _Found) -> None:
    """Find separate pairs."""
    numbered = _by_series({number: place for number, place in places.items() if place.frame is None})
    slots: dict[tuple[str, int], dict[int, list[int]]] = defaultdict(lambda: {0: [], 1: []})
    for number, place in places.items():
        if place.frame is not None:
            slots[place.series, place.number][place.frame].append(number)
    open_ones = [series for series, members in numbered.items() if places[members[0]].begins is None]
    for series, members in numbered.items():
        begins: int | str | None = places[members[0]].begins
        if begins is None and len(open_ones) > 1:
            begins = (
                f"running numbers are of {len(open_ones)} series ({', '.join(open_ones[:3])}), so it is open what is "
                "first and second of a pair"
            )
        elif begins is None:
            begins = _beginning([places[k].number for k in members])
        if isinstance(begins, str):
            found.leave_out(members, begins)
            continue
        for k in members:
            pair, half = divmod(places[k].number - begins, 2)
            slots[series, pair][half].append(k)
    for _, slot in sorted(slots.items()):
        if len(slot[0]) == len(slot[1]) == 1:
            found.pairs.append((slot[0][0], slot[1][0]))
        elif len(slot[0]) > 1 or len(slot[1]) > 1:
            names = " and ".join(found.names[k] for k in (slot[0] if len(slot[0]) > 1 else slot[1]))
            found.leave_out((*slot[0], *slot[1]), f"of its pair one frame is there twice: {names}")
        else:
            found.leave_out(
                (*slot[0], *slot[1]), f"the {'second' if slot[0] else 'first'} frame of its pair is missing"
            )


def _by_series(places: Mapping[int, Place]) -> dict[str, list[int]]:
    """Return the frames of each series in the order of their numbers."""
    found: dict[str, list[int]] = defaultdict(list)
    for number in sorted(places, key=lambda k: (places[k].series, _position(places[k]))):
        found[places[number].series].append(number)
    return found


def _position(place: Place) -> int:
    """Return where a frame is in its series."""
    return place.number if place.frame is None else 2 * place.number + place.frame


def _beginning(numbers: Sequence[int]) -> int | str:
    """Return where running numbers begin that are those of whole pairs, or why a lost frame leaves it open.

    Frames count from 0 or from 1. With 0 there, it is known; without it, 0 may be what is missing, and where any number
    is missing all others might stand in the wrong halves of pairs. Where neither is there, the first may be a second.
    """
    if numbers[0] == 0:
        return 0
    if len(numbers) % 2 == 0 and list(numbers) == list(range(1, 1 + len(numbers))):
        return 1
    missing = next((before + 1 for before, after in pairwise(numbers) if after > before + 1), None)
    lost = "not all make pairs" if missing is None else f"{missing} is missing"
    if missing is None and numbers[0] > 1:
        lost = "none is 0 or 1"
    return (
        f"of the running numbers {numbers[0]} to {numbers[-1]} {lost}, so it is open whether even or odd ones begin "
        f"pairs (--pair-by with {{number}} for even, {{number:1}} for odd)"
    )


def _follow(places: Mapping[int, Place], found: _Found) -> None:
    """Find pairs of each frame with the next, none across a gap."""
    for members in _by_series(places).values():
        at: dict[int, list[int]] = defaultdict(list)
        for number in members:
            at[_position(places[number])].append(number)
        for twice in (numbers for numbers in at.values() if len(numbers) > 1):
            names = " and ".join(found.names[k] for k in twice)
            found.leave_out(twice, f"the same frame is there twice: {names}")
        once = [(position, numbers[0]) for position, numbers in at.items() if len(numbers) == 1]
        if len(once) == 1:
            found.leave_out([once[0][1]], "no frame comes before or after it")
        step = min((after[0] - before[0] for before, after in pairwise(once)), default=1)
        for (position, number), (following, after) in pairwise(once):
            if following - position <= MOST_STEPS * step:
                found.pairs.append((number, after))
            else:
                found.leave_out([after], f"frames are missing between {found.names[number]} and it")
        if step > 1:
            text = f"numbers go up by {step}; each frame is taken with the next that is there"
            remedy = "where frames are missing between them, set dt_s to the time between those that are there"
            found.notices.append(Notice("numbers-apart", found.names[once[0][1]], text, remedy, float(step), "1"))


# Lists of pairs as people write them: a line for each pair, with the names of its two frames.


def pairs_listed(path: Path, frames: Sequence[Seen]) -> Pairs:
    """Return the pairs that a list names, of the frames that are there.

    A line is two paths, file names or names without suffix, between them a comma, a tab or blanks; what is behind `#`
    is a comment.

    Raises
    ------
    InputError : the list cannot be read, a line does not name two frames, or a name is that of several
    """
    called: dict[str, set[int]] = defaultdict(set)
    for number, frame in enumerate(frames):
        for name in (frame.name, PurePath(frame.name).name, frame.path, PurePath(frame.path).name):
            called[name].add(number)
    pairs: list[tuple[int, int]] = []
    left_out: list[LeftOut] = []
    text = content_of(path).decode("utf-8", errors="surrogateescape")
    for place, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].strip()
        names = [name.strip() for name in words.split(next((each for each in ",;\t" if each in words), None))]
        if not words:
            continue
        if len(names) != 2 or not all(names):
            raise InputError(
                f"{path}:{place}: {line.strip()!r} is not two names, with a comma, a tab or blanks between"
            )
        here = [called.get(name, called.get(PurePath(name).as_posix(), set())) for name in names]
        for name, numbers in zip(names, here, strict=True):
            if len(numbers) > 1:
                several = f"{name!r} is the name of {len(numbers)} frames; give its folder, too"
                raise InputError(f"{path}:{place}: {several}")
            if not numbers:
                left_out.append(LeftOut(name, f"is in {path}, line {place}, and not among the frames given"))
        if all(here):
            (first,), (second,) = here
            if first == second:
                raise InputError(f"{path}:{place}: names {names[0]} twice, where a pair has two frames")
            pairs.append((first, second))
    unlisted = len(frames) - len({number for pair in pairs for number in pair})
    text = f"{unlisted} of the frames given are in none of its pairs"
    notices = [Notice("frames-unlisted", str(path), text, "add them, or leave them out", float(unlisted), "0")]
    return Pairs(tuple(pairs), tuple(left_out), tuple(notices if unlisted else ()))
