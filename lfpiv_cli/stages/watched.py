"""Batches of folders that are still being filled: what is complete is worked through, then what has come since."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.listing import files_in
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.watching import as_they_come
from lfpiv_cli.names import InputKind
from lfpiv_cli.notice import Notice
from lfpiv_cli.stages.batches import ALL, Batch, BatchOptions, Failure, Worked, work_through, write_failures
from lfpiv_cli.stages.frames import STILL, Background
from lfpiv_cli.stages.pairs import failures_of

OfBatch = TypeVar("OfBatch", bound=Batch)


def watched(
    folders: Sequence[Path],
    kind: InputKind,
    options: BatchOptions,
    console: Console,
) -> Iterator[list[Path]]:
    """Yield the files of folders in groups, as they become complete: see `as_they_come`.

    Raises
    ------
    UsageError : one is no folder, or a share is asked for
    InputError : none has come
    StoppedEarlyError : the time is over
    """
    if options.shard != ALL:
        raise UsageError("--watch: which frames make a share is known when the last one is there; leave out --shard")
    if options.dry_run:
        raise UsageError("--watch waits for what is not there, and --dry-run tells what is: leave out one of them")
    for folder in folders:
        if not os.path.isdir(folder):
            raise UsageError(f"{folder}: --watch takes folders")
    read = _read_image if kind == "images" else vtkhdf.read_header
    deadline, count = options.deadline(), 0
    console.say(f"watches {', '.join(map(str, folders))}; ends {options.idle_s:g} s after the last change")

    def listed() -> list[Path]:
        if not deadline.leaves_time():
            raise deadline.error(count, count, "frame")
        return [path for folder in folders for path in files_in(folder, kind)]

    for group in as_they_come(listed, read, options.idle_s):
        count += len(group)
        yield group
    if count == 0:
        raise InputError(f"{folders[0]}: no {kind} have come in {options.idle_s:g} s")


def ensure_frames_alone(settings: Config, background: str | None, mask: str | Path | None) -> None:
    """Refuse what is made from other frames than a frame's own, where these are still coming.

    Raises
    ------
    UsageError
    """
    if Background.parse(background).kind is not None:
        refused = f"--background {background} is"
    elif mask == STILL:
        refused = f"--mask {STILL} is"
    elif settings.reconstruction.solver == "particles":
        refused = "the tracers' size, which --solver particles needs, is"
    else:
        return
    raise UsageError(f"--watch: {refused} made from all frames, some of which have not come yet; wait for them")


def work_as_they_come(
    make: Callable[[Sequence[Path]], OfBatch],
    groups: Iterable[Sequence[Path]],
    options: BatchOptions,
    console: Console,
    left_out: Callable[[], Sequence[Failure]] = tuple,
) -> tuple[OfBatch, Worked]:
    """Work through a batch for each group of files; return the last one, and what became of all.

    Parameters
    ----------
    left_out : returns, at the end, the files that were in no group

    Raises
    ------
    LfpivError : as `work_through`
    InputError : there was no group
    """
    alone = replace(options, failures=None)
    together: Worked = Worked()
    batch: OfBatch | None = None
    for group in groups:
        try:
            batch = make(group)
        except InputError as error:
            if not options.keep_going or batch is None:
                raise
            together.failures.append(Failure(group[0].stem, str(error)))
        else:
            together.add(work_through(batch, alone, console))
    together.failures[:0] = left_out()
    if batch is None:
        raise InputError(f"{together.failures[0].name}: {together.failures[0].error}")
    write_failures(options, together)
    return batch, together


class ComingPairs:
    """The pairs of files that come one after the other.

    Attributes
    ----------
    left_out : the files of which no partner has come so far
    """

    def __init__(self, pair: Callable[[Sequence[Path]], Pairs], console: Console) -> None:
        """Take which of some files are pairs, and where it is told of those that are passed over."""
        self._pair, self._console = pair, console
        self._seen: list[Path] = []
        self._made: set[tuple[int, int]] = set()
        self._told: set[Notice] = set()
        self.left_out: Sequence[Failure] = ()

    def groups(self, coming: Iterable[Sequence[Path]]) -> Iterator[list[Path]]:
        """Yield the files of pairs that are complete, two by two, as they come."""
        for files in coming:
            self._seen += files
            if len(self._seen) < 2:
                self.left_out = [Failure(str(self._seen[0]), "no other frame has come")]
                continue
            found = self._pair(self._seen)
            fresh = [pair for pair in found.pairs if pair not in self._made]
            self._made.update(fresh)
            self.left_out = failures_of(found)
            self._tell(found)
            if fresh:
                yield [self._seen[number] for pair in fresh for number in pair]

    def _tell(self, found: Pairs) -> None:
        """Say once what is taken for granted, and which files have no partner though later pairs are complete."""
        last = max((second for _, second in self._made), default=0)
        before = {str(path) for path in self._seen[:last]}
        passed = Pairs((), tuple(each for each in found.left_out if each.name in before), found.notices)
        fresh = [notice for notice in passed.said() if notice not in self._told]
        self._told.update(fresh)
        self._console.warn(fresh)


def _read_image(path: Path) -> None:
    """Read the last frame of an image file: the others are there when it is.

    Raises
    ------
    InputError : it cannot be read yet
    """
    image_files.read_page(path, image_files.count_pages(path) - 1)
