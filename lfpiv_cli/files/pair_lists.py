"""Lists of pairs as people write them: a line for each pair, with the names of its two frames."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePath

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import content_of
from lfpiv_cli.files.pairing import LeftOut, Pairs, Seen
from lfpiv_cli.notice import Notice


def pairs_listed(path: Path, frames: Sequence[Seen]) -> Pairs:
    """Return the pairs that a list names, of the frames that are there.

    A line is two paths, file names or names without suffix, between them a comma, a tab or blanks; what is behind `#`
    is a comment.

    Raises
    ------
    InputError : the list cannot be read, a line does not name two frames, or a name is that of several
    """
    called = _called(frames)
    pairs: list[tuple[int, int]] = []
    left_out: list[LeftOut] = []
    for line, names in _lines(path):
        numbers = [_number(f"{path}:{line}", name, called) for name in names]
        missing = [name for name, number in zip(names, numbers, strict=True) if number is None]
        left_out += [LeftOut(name, f"is in {path}, line {line}, and not among the frames given") for name in missing]
        if not missing:
            first, second = (number for number in numbers if number is not None)
            if first == second:
                raise InputError(f"{path}:{line}: names {names[0]} twice, where a pair has two frames")
            pairs.append((first, second))
    unlisted = len(frames) - len({number for pair in pairs for number in pair})
    text = f"{unlisted} of the frames given are in none of its pairs"
    notices = [Notice("frames-unlisted", str(path), text, "add them, or leave them out", float(unlisted), "0")]
    return Pairs(tuple(pairs), tuple(left_out), tuple(notices if unlisted else ()))


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of each line and the two names on it."""
    text = content_of(path).decode("utf-8", errors="surrogateescape")
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].strip()
        separator = next((each for each in ",;\t" if each in words), None)
        names = [name.strip() for name in words.split(separator)]
        if not words:
            continue
        if len(names) != 2 or not all(names):
            raise InputError(
                f"{path}:{number}: {line.strip()!r} is not two names, with a comma, a tab or blanks between"
            )
        yield number, names


def _called(frames: Sequence[Seen]) -> Mapping[str, set[int]]:
    """Return the numbers of the frames by all that they may be called."""
    called: dict[str, set[int]] = defaultdict(set)
    for number, frame in enumerate(frames):
        for name in (frame.name, PurePath(frame.name).name, frame.path, PurePath(frame.path).name):
            called[name].add(number)
    return called


def _number(place: str, name: str, called: Mapping[str, set[int]]) -> int | None:
    """Return the number of the frame that is called so, None where none is."""
    numbers = called.get(name, called.get(PurePath(name).as_posix(), set()))
    if len(numbers) > 1:
        raise InputError(f"{place}: {name!r} is the name of {len(numbers)} frames; give its folder, too")
    return next(iter(numbers), None)
