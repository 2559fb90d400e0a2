"""What names of frames say: of which series each is, its number, and whether it is the first or second of a pair.

Cameras and programs name frames in a few ways, all of which are read without regard to case: `img_0001_a` and
`img_0001_b`, `0001A` and `0001B`, `a_001` and `b_001`, `B00001_LA` and `B00001_LB`, `B00001_0` and `B00001_1`, or by
running numbers, `run_000000`, `run_000001`, ...
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime

from lfpiv_cli.errors import UsageError
from lfpiv_cli.names import Pairing

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


def places_of(stems: Sequence[str], how: Pairing) -> list[Place | None]:
    """Return what each name says, read beside the others; None where it has neither a number nor a frame's letter."""
    found: list[Place | None] = [None] * len(stems)
    alike: dict[tuple[str, ...], list[int]] = defaultdict(list)
    read = [_tokens(stem) for stem in stems]
    for number, (tokens, _) in enumerate(read):
        # What tokens in the same place of names of one form have in common.
        kinds = (f"{token[:-1]}?" if token in MARKS else "#" if _is_number(token) else token for token in tokens)
        alike[tuple(kinds)].append(number)
    for members in alike.values():
        group = [read[number][0] for number in members]
        places = _read_together(group, how, [read[number][1] for number in members])
        for number, place in zip(members, places, strict=True):
            found[number] = place
    return found


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
    frames = sorted({match["frame"] for match in matches if match and "frame" in form.groupindex}, key=_natural)
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
            seconds = int((moment - datetime(1970, 1, 1)).total_seconds())
            ticks = seconds * 1_000_000 + int(fraction.ljust(6, "0"))
            rest = stem[: stamp.start()] + STAMP + stem[stamp.end() :]
    return [token.casefold() for token in TOKEN.findall(rest)], ticks


def _read_together(group: Sequence[list[str]], how: Pairing, stamps: Sequence[int | None]) -> list[Place | None]:
    """Return what names of one form say."""
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
    numbered = [_numbered(tokens, rest) for tokens in rest]
    places: list[Place | None] = []
    for k, (series, number) in enumerate(numbered):
        position = stamps[k] if number is None and mark is None else number
        if mark is not None:
            places.append(Place(series, number or 0, marks[k]))
        else:
            places.append(None if position is None else Place(series, position))
    return places


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


def _natural(text: str) -> tuple[bool, int, str]:
    """Return the key by which frames of a pair are sorted: numbers by their value."""
    return (False, int(text), "") if _is_number(text) else (True, 0, text)
