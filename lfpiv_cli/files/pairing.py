"""Which frames of a batch belong together: by their names, and never across one that is missing.

Cameras and programs name frames in a few ways, all of which are read without regard to case: `img_0001_a` and
`img_0001_b`, `0001A` and `0001B`, `a_001` and `b_001`, `B00001_LA` and `B00001_LB`, `B00001_0` and `B00001_1`, or by
running numbers, `run_000000`, `run_000001`, ...
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path, PurePath

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.inputs import content_of
from lfpiv_cli.names import Pairing
from lfpiv_cli.notice import Notice

REMEDY = "say how names tell it with --pair-by, or leave such frames out with --keep-going"
NO_PLACE = "its name has neither a number nor a letter that says where it belongs"
# Numbers in a sequence may be times, which are not quite even: beyond so many steps a frame is missing.
MOST_STEPS = 1.5
# Letters that say which frame of a pair it is, alone or after the L of a laser.
MARKS = {"a": 0, "b": 1, "la": 0, "lb": 1}
# A pair's frames count from 0 or from 1.
FIRST_AND_SECOND = ({0, 1}, {1, 2})
# The buffer's letter of LaVision's exports stands before so many digits, or before any where the last number is the
# frame's, and is no frame's itself.
BUFFER, BUFFER_DIGITS = "b", 5
# Words, at capitals within them too; numbers; what is between.
TOKEN = re.compile(r"\d+|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^A-Za-z\d]+", re.ASCII)
# A date with a time of day, down to fractions of a second behind a point.
TIME_STAMP = re.compile(
    r"(?<!\d)((?:19|20)\d\d)([-_.]?)([01]\d)\2([0-3]\d)[T_ .-]?"
    r"([0-2]\d)([-_.:]?)([0-5]\d)\6([0-5]\d)(?:[.,](\d{1,6}))?(?!\d)",
    re.ASCII,
)
STAMP = "\N{STOPWATCH}"
FIELD = re.compile(r"(\{(?:pair|frame|number)(?::\d+)?\}|\*)")
FIELDS = {"pair": "[^/]+", "frame": "[a-z]+|[0-9]+", "number": "[0-9]+"}


@dataclass(frozen=True)
class Place:
    """Where a frame belongs.

    Attributes
    ----------
    series : what the frames that can belong together have in common
    number : of the pair where `frame` is known, a running number of frames elsewhere
    frame : 0 for the first of a pair, 1 for the second, None where the name does not say
    begins : where running numbers begin, None where it is not known
    """

    series: str
    number: int
    frame: int | None = None
    begins: int | None = None


@dataclass(frozen=True)
class Pairs:
    """The frames that belong together.

    Attributes
    ----------
    pairs : numbers of the frames of each pair, the earlier first
    left_out : of frames that should have a partner and have none, and of gaps in sequences, each with its reason
    notices : what was taken for granted
    separate : False where frames are in two pairs, one with the frame before and one with the next
    """

    pairs: tuple[tuple[int, int], ...]
    left_out: tuple[Notice, ...] = ()
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
            raise InputError(f"{first.about}: {first.text}{more}; {REMEDY}")
        return [*self.notices, *self.left_out]


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
    """Pairs as they are found among frames of these names."""

    names: Sequence[str]
    pairs: list[tuple[int, int]] = field(default_factory=list)
    left_out: list[Notice] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)

    def leave_out(self, numbers: Iterable[int], why: str) -> None:
        self.left_out += [Notice("frame-unpaired", self.names[number], why, REMEDY) for number in numbers]

    def reported(self, how: Pairing) -> Pairs:
        return Pairs(tuple(self.pairs), tuple(self.left_out), tuple(self.notices), how == "ab")


def pair_frames(frames: Sequence[Seen], how: Pairing, by: str | None = None, coming: bool = False) -> Pairs:
    """Return which frames belong together; pages of one file belong together by their numbers.

    Parameters
    ----------
    how : `ab` for separate pairs, `sequence` for each frame with the next
    by : how names tell it, as `img_{pair}_{frame}`, see `places_by`; None: as cameras usually name frames
    coming : more frames are to come, so that the first two running numbers say where pairs begin

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
        return found.reported(how)
    placed = {number: place for number, place in zip(once, places, strict=True) if place is not None}
    missed = NO_PLACE if by is None else f"its name is not of the form {by}"
    found.leave_out((number for number in once if number not in placed), missed)
    if how == "ab":
        _pair(placed, found, coming)
    else:
        _follow(placed, found)
    return found.reported(how)


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
    remedy = "tracks end or go on across the gap; leave out what is before it"
    notices = [replace(each, code="frames-missing", remedy=remedy) for each in found.left_out]
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
    """Return where each frame belongs: by a template, or what its name says beside the others.

    None where that has neither a number nor a frame's letter.
    """
    if by is not None:
        return places_by(by, [frame.path for frame in frames])
    found: list[Place | None] = [None] * len(frames)
    alike: dict[tuple[str, ...], list[int]] = defaultdict(list)
    read = [_tokens(frame.stem) for frame in frames]
    for number, (tokens, _) in enumerate(read):
        # What tokens in the same place of names of one form have in common.
        kinds = (f"{token[:-1]}?" if token in MARKS else "#" if _is_number(token) else token for token in tokens)
        alike[tuple(kinds)].append(number)
    for members in alike.values():
        group = [read[number][0] for number in members]
        # Which token is the letter of a frame: where both are seen, the last such.
        letters = [k for k, token in enumerate(group[0]) if token in MARKS]
        seen = [k for k in letters if len({MARKS[tokens[k]] for tokens in group}) == 2]
        if not seen and how != "sequence":
            # Unless it is of the number of a buffer, with which names begin as `B00001` and `B0001_0` do.
            first, second, *_ = [*group[0], "", ""]
            buffers = first == BUFFER and _is_number(second) and (len(second) == BUFFER_DIGITS or _ends_in_frame(group))
            seen = [k for k in letters if k or not buffers]
        mark = seen[-1] if seen else None
        marks = [] if mark is None else [MARKS[tokens[mark]] for tokens in group]
        if mark is None and how == "ab" and _ends_in_frame(group):
            mark = len(group[0]) - 1
            least = min(int(tokens[mark]) for tokens in group)
            marks = [int(tokens[mark]) - least for tokens in group]
        rest = [[*tokens[:mark], "?", *tokens[mark + 1 :]] if mark is not None else tokens for tokens in group]
        for k, (member, tokens) in enumerate(zip(members, rest, strict=True)):
            series, running = _numbered(tokens, rest)
            if mark is not None:
                found[member] = Place(series, running or 0, marks[k])
            elif (position := read[member][1] if running is None else running) is not None:
                found[member] = Place(series, position)
    return [
        place if frame.page is None else Place(f"pages of {frame.stem}", frame.page, begins=0)
        for frame, place in zip(frames, found, strict=True)
    ]


def _pair(places: Mapping[int, Place], found: _Found, coming: bool) -> None:
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
            # Frames count from 0 or from 1. With 0 there, it is known; without it, 0 may be what is missing, and where
            # any number is missing all others might stand in the wrong halves of pairs. Where neither is there, the
            # first may be a second.
            numbers = [places[k].number for k in (members[:2] if coming else members)]
            if numbers[0] == 0 or (len(numbers) % 2 == 0 and numbers == list(range(1, 1 + len(numbers)))):
                begins = numbers[0]
            else:
                missing = next((before + 1 for before, after in pairwise(numbers) if after > before + 1), None)
                lost = "none is 0 or 1" if numbers[0] > 1 else "not all make pairs"
                begins = (
                    f"of the running numbers {numbers[0]} to {numbers[-1]} "
                    f"{lost if missing is None else f'{missing} is missing'}, so it is open whether even or odd ones "
                    "begin pairs (--pair-by with {number} for even, {number:1} for odd)"
                )
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
            half_missing = "second" if slot[0] else "first"
            found.leave_out((*slot[0], *slot[1]), f"the {half_missing} frame of its pair is missing")


def _by_series(places: Mapping[int, Place]) -> dict[str, list[int]]:
    """Return the frames of each series in the order of their numbers."""
    found: dict[str, list[int]] = defaultdict(list)
    for number in sorted(places, key=lambda k: (places[k].series, _position(places[k]))):
        found[places[number].series].append(number)
    return found


def _position(place: Place) -> int:
    """Return where a frame is in its series."""
    return place.number if place.frame is None else 2 * place.number + place.frame


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


# What names say: of which series each is, its number, and whether it is the first or second of a pair.


def places_by(template: str, names: Sequence[str]) -> list[Place | None]:
    """Return what each name says by a template such as `img_{pair}_{frame}`; None where a name is of another form.

    Parameters
    ----------
    template : of names without suffix, or of their last folders too where it has slashes. `{pair}` is the pair's name
        or number, `{frame}` the letter or number of the frame in it; in their place `{number}` is a running number,
        which begins pairs where it is even, or as `{number:1}` where it is odd. `*` is whatever does not matter.
    names : paths without suffix

    Raises
    ------
    UsageError : the template has other fields, or there are more than two frames to a pair
    """
    parts = FIELD.split(template.casefold())
    fields = [part.strip("{}").partition(":") for part in parts[1::2] if part != "*"]
    named = sorted(name for name, _, _ in fields)
    if any(set(part) & set("{}") for part in parts[::2]) or named not in (["frame", "pair"], ["number"]):
        raise UsageError(
            f"--pair-by {template}: takes {{pair}} and {{frame}}, each once, or {{number}} or {{number:1}}; "
            f"as img_{{pair}}_{{frame}}"
        )
    begins = next((int(start) for name, _, start in fields if name == "number" and start), 0)
    pattern = ""
    for part in parts:
        name = part.strip("{}").partition(":")[0]
        field = f"(?P<{name}>{FIELDS[name]})" if name != part else re.escape(part)
        pattern += "[^/]*" if part == "*" else field
    form = re.compile(rf"(?:^|/){pattern}$")
    matches = [form.search(name.casefold()) for name in names]
    seen = {match["frame"] for match in matches if match and "frame" in form.groupindex}
    frames = sorted(seen, key=lambda text: (False, int(text), "") if _is_number(text) else (True, 0, text))
    if len(frames) > 2:
        raise UsageError(f"--pair-by {template}: a pair has two frames, and the names have {', '.join(frames[:5])}")
    marks = MARKS if set(frames) <= set(MARKS) else {name: k for k, name in enumerate(frames)}

    def place(match: re.Match[str]) -> Place:
        if "number" in form.groupindex:
            return Place(template, int(match["number"]), begins=begins)
        series, number = _numbered(TOKEN.findall(match["pair"]), [])
        return Place(series, number or 0, marks[match["frame"]])

    return [match and place(match) for match in matches]


def _tokens(stem: str) -> tuple[list[str], int | None]:
    """Return the words, numbers and separators of a name, and its time stamp in microseconds, which is none of them."""
    ticks, rest = None, stem
    if (stamp := TIME_STAMP.search(stem)) is not None:
        year, _, month, day, hour, _, minute, second, fraction = stamp.groups("")
        with suppress(ValueError):
            moment = datetime(int(year), int(month), int(day), int(hour), int(minute), int(second))
            micro = timedelta(microseconds=1)
            ticks = (moment - datetime(1970, 1, 1)) // micro + int(fraction.ljust(6, "0"))
            rest = stem[: stamp.start()] + STAMP + stem[stamp.end() :]
    return [token.casefold() for token in TOKEN.findall(rest)], ticks


def _ends_in_frame(group: Sequence[list[str]]) -> bool:
    """Return whether names end in a number of their own that is the first's or the second's of a pair."""
    *before, last = group[0]
    if not _is_number(last) or not any(_is_number(token) for token in before):
        return False
    return {int(tokens[-1]) for tokens in group} in FIRST_AND_SECOND


def _numbered(tokens: Sequence[str], group: Sequence[Sequence[str]]) -> tuple[str, int | None]:
    """Return a name without its running number, which is its last one, and that number.

    One that all have and that belongs to a word, as in `img_0001_8bit`, is no running number.
    """
    numbers = [k for k, token in enumerate(tokens) if _is_number(token)]
    while len(numbers) > 1 and len(group) > 1:
        place = numbers[-1]
        if not "".join(tokens[place + 1 : place + 2]).isalpha() or len({names[place] for names in group}) > 1:
            break
        numbers.pop()
    if not numbers:
        return "".join(tokens), None
    last = numbers[-1]
    fixed = (str(int(token)) if _is_number(token) else token for token in tokens)
    return "".join("#" if k == last else token for k, token in enumerate(fixed)), int(tokens[last])


def _is_number(token: str) -> bool:
    return token.isascii() and token.isdigit()


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
    left_out: list[Notice] = []
    text = content_of(path).decode("utf-8", errors="surrogateescape")
    for place, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].strip()
        names = [name.strip() for name in words.split(next((each for each in ",;\t" if each in words), None))]
        if not words:
            continue
        if len(names) != 2 or not all(names):
            what = f"{line.strip()!r} is not two names, with a comma, a tab or blanks between"
            raise InputError(f"{path}:{place}: {what}")
        here = [called.get(name, called.get(PurePath(name).as_posix(), set())) for name in names]
        for name, numbers in zip(names, here, strict=True):
            if len(numbers) > 1:
                what = f"{name!r} is the name of {len(numbers)} frames; give its folder, too"
                raise InputError(f"{path}:{place}: {what}")
            if not numbers:
                why = f"is in {path}, line {place}, and not among the frames given"
                left_out.append(Notice("frame-unpaired", name, why, REMEDY))
        if all(here):
            (first,), (second,) = here
            if first == second:
                raise InputError(f"{path}:{place}: names {names[0]} twice, where a pair has two frames")
            pairs.append((first, second))
    unlisted = len(frames) - len({number for pair in pairs for number in pair})
    text = f"{unlisted} of the frames given are in none of its pairs"
    notices = [Notice("frames-unlisted", str(path), text, "add them, or leave them out", float(unlisted), "0")]
    return Pairs(tuple(pairs), tuple(left_out), tuple(notices if unlisted else ()))
