"""Batches: the files a command was given, also as they come; where each result goes, and which are there already."""

from __future__ import annotations

import os
import re
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum, auto
from pathlib import Path
from typing import Any

from lfpiv_cli.errors import InputError, OutputExistsError, UsageError
from lfpiv_cli.files.atomic import ensure_apart, ensure_writable, folded
from lfpiv_cli.files.hdf5 import read_whole
from lfpiv_cli.files.images import count_pages, format_of, frames
from lfpiv_cli.files.inputs import content_of, reading_from, split_part
from lfpiv_cli.files.pairing import Seen
from lfpiv_cli.files.provenance import (
    differences,
    earlier_record,
    replace_provenance,
    same_result,
    without_warnings,
)
from lfpiv_cli.names import InputKind

VTKHDF_SUFFIX = ".vtkhdf"
# So many things that have changed are named, and all others counted.
MOST_DIFFERENCES = 4


@dataclass(frozen=True)
class Frame:
    """One image of a batch: page `page` of the `pages` of a file, or a file that cannot be read, for its `fault`."""

    path: Path
    page: int
    pages: int
    fault: str | None = None

    @property
    def stem(self) -> str:
        """The file's stem, numbered where the file holds a sequence."""
        stem = split_part(self.path)[0].stem
        return stem if self.pages == 1 else f"{stem}_{self.page:04d}"

    @property
    def time_s(self) -> float | None:
        """When it was taken, in s from a moment of its file's own; None where the file does not tell."""
        times = None if self.fault is not None else frames(self.path).time_s
        return None if times is None else float(times[self.page])

    def seconds_to(self, other: Frame) -> float | None:
        """Return the time to another frame; None where they are not of one recording, or it does not tell."""
        before, after = self.time_s, other.time_s
        return None if before is None or after is None or self.path != other.path else after - before


@dataclass(frozen=True)
class Target:
    """One output of a batch: where it goes, and what makes the provenance record that it will carry.

    Thousands of records are not held in memory: each is made when it is asked for, which reads its inputs.

    Attributes
    ----------
    beside : other files that are made with it and carry the same record
    """

    path: Path
    make_record: Callable[[], Mapping[str, Any]]
    beside: Sequence[Path] = ()

    @property
    def paths(self) -> list[Path]:
        """All its files."""
        return [self.path, *self.beside]

    @property
    def record(self) -> Mapping[str, Any]:
        """The record, made anew.

        Raises
        ------
        InputError : an input cannot be read
        """
        return self.make_record()


class State(IntEnum):
    """What is there in a target's place, by how much it keeps a target of several files from being complete.

    The very result, one that differs in nothing that it depends on, nothing, a broken file, or something else.
    """

    COMPLETE = auto()
    BEARS_ALIKE = auto()
    MISSING = auto()
    BROKEN = auto()
    OTHER = auto()


def frames_of(paths: Iterable[Path], keep_going: bool = False) -> list[Frame]:
    """Return the frames of image files in order, every page of a sequence.

    With `keep_going` a file that cannot be read stands for one frame, with its fault.

    Raises
    ------
    InputError : a file cannot be read
    """
    frames = []
    for path in paths:
        try:
            pages = count_pages(path)
        except InputError as error:
            if not keep_going:
                raise
            frames.append(Frame(path, 0, 1, str(error)))
            continue
        frames += [Frame(path, page, pages) for page in range(pages)]
    return frames


def output_paths(output: Path, stems: Sequence[str]) -> list[Path]:
    """Return where the results go: `output` itself for one result, a folder of `stem.vtkhdf` for several.

    An existing folder takes a single result too.

    Raises
    ------
    UsageError : two inputs would give the same output, or several results meet an output that is a file.
    """
    if len(stems) == 1 and not output.is_dir():
        if output.suffix != VTKHDF_SUFFIX:
            raise UsageError(f"{output}: a single result is one file, whose name ends in {VTKHDF_SUFFIX}")
        return [output]
    if len(stems) > 1 and output.exists() and not output.is_dir():
        raise UsageError(f"{output}: {len(stems)} results need a folder, and this is a file")
    seen: set[str] = set()
    for stem in stems:
        name = folded(stem, output)
        if name in seen:
            raise UsageError(f"{output}: two inputs are called {stem!r} and would give the same output")
        seen.add(name)
    return [output / f"{stem}{VTKHDF_SUFFIX}" for stem in stems]


Stamp = tuple[int, int] | None


def stamp_of(path: Path) -> Stamp:
    """Return what distinguishes a file from another one under its name, None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def state_of(target: Target) -> State:
    """Return what is there in a target's place; what is called complete has been read back, all of it.

    Of several files it is what most of all keeps the target from being complete.

    Raises
    ------
    InputError : an input of the target cannot be read
    """
    paths = [path for path in target.paths if path.exists()]
    if not paths:
        return State.MISSING
    made = target.record
    states = [State.MISSING] if len(paths) <= len(target.beside) else []
    for path in paths:
        try:
            carried = read_whole(path)
        except InputError:
            states.append(State.BROKEN)
            continue
        if carried is not None and without_warnings(carried) == made:
            states.append(State.COMPLETE)
        else:
            alike = carried is not None and same_result(carried, made)
            states.append(State.BEARS_ALIKE if alike else State.OTHER)
    return max(states)


def pending(
    targets: Sequence[Target], inputs: Iterable[Path], overwrite: bool, resume: bool, dry: bool = False
) -> list[int]:
    """Return the numbers of the targets that have to be made.

    With `resume`, a target that is complete and carries the very record that it would get is left as it is, and a
    broken one is made anew; with `overwrite` besides, one whose record differs in nothing that it depends on gets the
    new record, and keeps its data. Where it is `dry`, nothing is written.

    Raises
    ------
    UsageError : two targets have one name, or one is an input
    OutputExistsError : a target is there and neither `overwrite` nor a matching `resume` covers it.
    """
    ensure_apart((path for target in targets for path in target.paths), inputs)
    left = []
    for number, target in enumerate(targets):
        found = state_or_none(target) if resume else None
        if found is State.BEARS_ALIKE and overwrite and not dry:
            made = dict(target.record)
            for path in target.paths:
                old = read_whole(path) or {}
                replace_provenance(path, made | {name: old[name] for name in ("warnings",) if name in old})
        if found is State.COMPLETE or (found is State.BEARS_ALIKE and overwrite):
            continue
        if found in (State.BEARS_ALIKE, State.OTHER) and not overwrite:
            path = next(
                each
                for each in target.paths
                if each.exists() and state_of(replace(target, path=each, beside=())) is found
            )
            reported = differences(read_whole(path) or {}, target.record)
            if len(reported) > MOST_DIFFERENCES:
                reported[MOST_DIFFERENCES:] = [f"{len(reported) - MOST_DIFFERENCES} more"]
            changed = f" ({'; '.join(reported)})" if reported else ""
            what = "keeps it, as it depends on none of that" if found is State.BEARS_ALIKE else "makes it anew"
            raise OutputExistsError(
                f"{path}: exists and was made from other inputs or settings{changed}; --overwrite {what}"
            )
        for path in target.paths:
            ensure_writable(path, overwrite or resume)
        left.append(number)
    return left


def is_kept(paths: Sequence[Path], made: Mapping[str, Any], inputs: Iterable[Path], overwrite: bool) -> bool:
    """Return whether all results of a step, which carry one record, are there already, see `pending`."""
    return not pending([Target(path, lambda: made) for path in paths], inputs, overwrite, resume=True)


def state_or_none(target: Target) -> State | None:
    """Return what is there in a target's place, None where its inputs cannot be read: that is told when it is made."""
    try:
        return state_of(target)
    except InputError:
        return None


# What is known of frames besides their names: the pages of their files, and the images that results are of.

PAGE = re.compile(r"\bpage (\d+)\b")


def images_seen(frames: Sequence[Frame]) -> list[Seen]:
    """Return what is known of frames: their names and, of files of several, their pages."""
    return [
        Seen(
            name=str(frame.path) if frame.pages == 1 else f"{frame.path}, page {frame.page}",
            stem=split_part(frame.path)[0].stem,
            path=(frame.path.parent / frame.stem).as_posix(),
            page=None if frame.pages == 1 else frame.page,
            image=f"{frame.path} {frame.page}",
        )
        for frame in frames
    ]


def results_seen(paths: Sequence[Path]) -> list[Seen]:
    """Return what is known of volumes or particles: names and pages of the images that they are made from.

    Their own names count where these are not known, or are the same for different images.
    """

    def source_of(path: Path) -> tuple[str, str, int] | None:
        """Return its image: the file's name without suffix and SHA-256, and the page; None where that is not known."""
        try:
            made = earlier_record(path) or {}
            image, page = made["inputs"]["image"], PAGE.search(made["command"])
            stem = split_part(Path(image["name"]))[0].stem
            return page and (stem, image["sha256"], int(page[1]))
        except (InputError, KeyError, TypeError):
            return None  # what is broken is told where its turn comes

    sources = [source_of(path) for path in paths]
    own = [Seen(str(path), path.stem, path.with_suffix("").as_posix()) for path in paths]
    pages: dict[str, set[int]] = defaultdict(set)
    for source in sources:
        if source is not None:
            pages[source[1]].add(source[2])
    seen = list(own)
    for k, source in enumerate(sources):
        if source is not None:
            stem, digest, page = source
            # Its page, too, where the image's file holds several.
            several = len(pages[digest]) > 1 or page > 0 or own[k].stem == f"{stem}_{page:04d}"
            seen[k] = replace(own[k], stem=stem, page=page if several else None, image=f"{digest} {page}")
    if len({(each.stem, each.page) for each in seen}) == len({each.image or each.path for each in seen}):
        return seen
    return [replace(each, image=other.image) for each, other in zip(own, seen, strict=True)]


# Folders that a camera, or another command, is still filling: files are taken when they are complete, in order.

# A file is complete when it can be read and has not grown for so long: cameras write a frame at once, or page by page.
SETTLED_S = 2.0
LOOK_S = 0.5
# One that cannot be read holds up those behind it for so long; complete later, it is taken then.
PASSED_OVER_S = 10.0


def as_they_come(
    listed: Callable[[], Sequence[Path]],
    read: Callable[[Path], object],
    idle_s: float,
    passed_over: Callable[[Path, InputError], None] = lambda _path, _error: None,
) -> Iterator[list[Path]]:
    """Yield the files that are complete, in groups, until nothing has changed for `idle_s` seconds.

    The order is that of the list: a file waits for those before it, but for such as stay unreadable. One that is there
    after the idle time and still cannot be read comes in the last group, for whoever takes it to say what it lacks.

    Parameters
    ----------
    listed : returns the files that are there now, in order
    read : raises `InputError` where a file cannot be read yet
    passed_over : is told once of each file that is waited for no longer, and why
    """
    taken: set[Path] = set()
    passed: set[Path] = set()
    # Since when each file that was not taken is as it is.
    waiting: dict[Path, tuple[tuple[int, int], float]] = {}
    changed_at = time.monotonic()
    while True:
        now, before, waiting = time.monotonic(), waiting, {}
        for path in listed():
            if path in taken or (state := _size_and_change(path)) is None:
                continue
            known = before.get(path)
            waiting[path] = known if known is not None and known[0] == state else (state, now)
            if waiting[path] is not known:
                changed_at = now

        # The first of the files that wait, up to one that is not complete.
        now, ready = time.monotonic(), []
        for path, (_, since) in waiting.items():
            if now - since < SETTLED_S:
                break
            try:
                read(path)
            except InputError as error:
                if now - since < PASSED_OVER_S:
                    break
                if path not in passed:
                    passed.add(path)
                    passed_over(path, error)
                continue
            ready.append(path)
        if ready:
            taken.update(ready)
            yield ready
        elif time.monotonic() - changed_at >= max(idle_s, SETTLED_S):
            break
        else:
            time.sleep(LOOK_S)
    if waiting:
        yield list(waiting)


def _size_and_change(path: Path) -> tuple[int, int] | None:
    """Return the size of a file and when it was changed; None where it is gone, or no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_size, status.st_mtime_ns) if path.is_file() else None


# In place of a list's name: the list is read from standard input.
STANDARD_INPUT = "-"
# Files with these names are images, also where nothing of that kind is in them, so that it is told.
IMAGE_SUFFIXES = (".tif", ".tiff", ".png")


def listed(path: Path) -> list[Path]:
    """Return the files that a list names, a line each; lines with nothing in them count for nothing.

    Names are relative to where the command runs, as in a command line.

    Raises
    ------
    InputError : the list cannot be read, or nothing that it names is there
    """
    if str(path) == STANDARD_INPUT:
        with reading_from(path):
            content = sys.stdin.buffer.read()
    else:
        content = content_of(path)
    if b"\0" in content:
        raise InputError(f"{path}: is no list of files: it holds a zero byte")
    found = [Path(os.fsdecode(line)) for line in content.splitlines() if line.strip()]
    # A comment of code, //, is the root.
    if found and not any(str(each) != each.anchor and os.path.exists(split_part(each)[0]) for each in found):
        raise InputError(f"{path}: is no list of files: of its {len(found)} lines none names one")
    return found


def expanded(paths: Iterable[Path], kind: InputKind) -> list[Path]:
    """Return the files that were given, in place of a folder those in it that are of a kind, in natural order.

    Raises
    ------
    InputError : a folder cannot be read, or holds none
    """
    found: list[Path] = []
    for given in paths:
        inside = files_in(given, kind) if os.path.isdir(given) else [given]
        if not inside:
            raise InputError(f"{given}: holds {'no images' if kind == 'images' else f'no {VTKHDF_SUFFIX} files'}")
        found += inside
    return found


def natural(name: str) -> list[str | int]:
    """Return the parts of a name, numbers by their value; texts and numbers take turns."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r"([0-9]+)", name.casefold()))]


def files_in(folder: Path, kind: InputKind) -> list[Path]:
    """Return the files in a folder that are of a kind, in natural order; those whose names begin with a dot are not.

    A kind is told by the name, an image also by its first bytes.

    Raises
    ------
    InputError : the folder cannot be read
    """
    found = []
    with reading_from(folder):
        for path in folder.iterdir():
            suffix = path.suffix.lower()
            if path.name.startswith(".") or path.is_dir():
                continue
            is_of_kind = suffix in IMAGE_SUFFIXES if kind == "images" else suffix == VTKHDF_SUFFIX
            if not is_of_kind and kind == "images":
                with suppress(InputError):
                    is_of_kind = format_of(path).in_folders
            if is_of_kind:
                found.append(path)
    return sorted(found, key=lambda path: (natural(path.name), path.name))
