"""Batches of folders that are still being filled: what is complete is worked through, then what has come since."""

from __future__ import annotations

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
from lfpiv_cli.stages.batches import ALL, Batch, BatchOptions, Failure, Worked, work_through, write_failures
from lfpiv_cli.stages.frames import STILL, Background

OfBatch = TypeVar("OfBatch", bound=Batch)


def watched(
    folders: Sequence[Path],
    kind: InputKind,
    options: BatchOptions,
    console: Console,
    whole: Callable[[Sequence[Path]], int] = len,
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
        if not folder.is_dir():
            raise UsageError(f"{folder}: --watch takes folders")
    read = _read_image if kind == "images" else vtkhdf.read_header
    deadline, count = options.deadline(), 0
    console.say(f"watches {', '.join(map(str, folders))}; ends {options.idle_s:g} s after the last change")

    def listed() -> list[Path]:
        if not deadline.leaves_time():
            raise deadline.error(count, count, "frame")
        return [path for folder in folders for path in files_in(folder, kind)]

    for group in as_they_come(listed, read, options.idle_s, whole):
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
    make: Callable[[Sequence[Path]], OfBatch], groups: Iterable[Sequence[Path]], options: BatchOptions, console: Console
) -> tuple[OfBatch, Worked]:
    """Work through a batch for each group of files; return the last one, and what became of all.

    Raises
    ------
    LfpivError : as `work_through`
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
    assert batch is not None
    write_failures(options, together)
    return batch, together


def paired_from_first(pair: Callable[[Sequence[Path]], Pairs], paths: Sequence[Path]) -> int:
    """Return how many files, from the first one, are pairs that are complete."""
    if len(paths) < 2:
        return 0
    partner: dict[int, int] = {}
    for first, second in pair(paths).pairs:
        partner |= {first: second, second: first}
    complete, farthest = 0, 0
    for number in range(len(paths)):
        if number not in partner:
            break
        farthest = max(farthest, partner[number])
        if farthest == number:
            complete = number + 1
    return complete


def _read_image(path: Path) -> None:
    """Read the last frame of an image file: the others are there when it is.

    Raises
    ------
    InputError : it cannot be read yet
    """
    image_files.read_page(path, image_files.count_pages(path) - 1)
