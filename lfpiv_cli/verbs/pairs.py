"""Which frames of a command belong together, as its options have it, and the batches of what is made of them."""

from __future__ import annotations

import contextlib
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import atomic, vtkhdf
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import (
    Stamp,
    State,
    Target,
    as_they_come,
    files_in,
    pending,
    results_seen,
    stamp_of,
    state_or_none,
)
from lfpiv_cli.files.pairing import Pairs, Seen, contradiction, in_order, pair_frames, pairs_listed
from lfpiv_cli.files.provenance import Gone, carried_record, sha256, without_warnings
from lfpiv_cli.names import InputKind, Pairing
from lfpiv_cli.notice import Notice
from lfpiv_cli.verbs import batches
from lfpiv_cli.verbs.batches import ALL, Batch, BatchOptions, Expected, Failure, Made, Worked, WorkOptions
from lfpiv_cli.verbs.frames import residual_path


@dataclass(frozen=True, kw_only=True)
class PairOptions(BatchOptions):
    """What a batch is given whose frames belong together: how it is told which do.

    Attributes
    ----------
    pairing : `ab` for separate pairs, `sequence` for each frame with the next; needed for more than two
    pair_by : how names tell it, as `img_{pair}_{frame}`; the usual ways are known
    pairs : file that lists pairs
    """

    pairing: Pairing | None = None
    pair_by: str | None = None
    pairs: Path | None = None

    @property
    def are_told(self) -> bool:
        """True where any of them is given."""
        return any(each is not None for each in (self.pairing, self.pair_by, self.pairs))


Chosen = TypeVar("Chosen", bound=PairOptions)


class PairBatch(Batch[Made], ABC, Generic[Made, Chosen]):
    """Results of volumes or files of particles that belong together: of two each, or of all."""

    def __init__(
        self,
        files: Sequence[Path],
        output: Path,
        options: Chosen,
        overwrite: bool,
        pairs: Pairs | None = None,
        gone: Mapping[Path, Gone] | None = None,
    ) -> None:
        """Take the arguments of a command; see which files belong together, and read no content.

        Parameters
        ----------
        pairs : where they are known already
        gone : of the files, those that are no longer there

        Raises
        ------
        LfpivError : files or outputs do not go together, or a config is wrong
        """
        self._options, self.overwrite, self._gone = options, overwrite, gone or {}
        self.inputs = files
        self._arrange(files, output, pairs)

    @abstractmethod
    def _arrange(self, files: Sequence[Path], output: Path, pairs: Pairs | None) -> None:
        """Say which files each result is made of, and where it goes."""

    def _paired(self, files: Sequence[Path], pairs: Pairs | None) -> list[tuple[Path, Path]]:
        """Return the files of each pair; note what is to be said of them, and those without a partner."""
        found = found_pairs(results_seen(files), self._options) if pairs is None else pairs
        self.notices, self.left_out = found.settled(self._options.keep_going), failures_of(found)
        return [(files[first], files[second]) for first, second in found.pairs]


def failures_of(pairs: Pairs) -> list[Failure]:
    """Return the frames that have no partner, as what has failed."""
    return [Failure(each.about, each.text) for each in pairs.left_out]


def found_pairs(frames: Sequence[Seen], options: PairOptions, coming: bool = False) -> Pairs:
    """Return which frames belong together: by a list, by names; without options two as they are given.

    With `coming`, more frames are to come.

    Raises
    ------
    UsageError : no option says it and there are not two frames, or options contradict each other
    """
    if options.pairs is not None:
        if options.pairing == "sequence" or options.pair_by is not None:
            raise UsageError("--pairs lists separate pairs: give it without --pairing sequence and --pair-by")
        return pairs_listed(options.pairs, frames)
    if options.are_told:
        return pair_frames(frames, options.pairing or "ab", options.pair_by, coming)
    if len(frames) < 2:
        raise UsageError(f"pairs need two or more frames, got {len(frames)} frames")
    if len(frames) > 2:
        raise UsageError(
            f"{len(frames)} frames need --pairing: ab for separate pairs or sequence for each with the next"
        )
    return Pairs(((0, 1),), notices=tuple(doubts(frames)))


def doubts(frames: Sequence[Seen]) -> list[Notice]:
    """Say of two frames that are taken as they are given where their names contradict it."""
    first, second = frames
    if (why := contradiction(first, second)) is not None:
        text = f"is taken as the second frame of {first.name}'s pair, but {why}"
        return [
            Notice("pair-contradicted", second.name, text, "give frames that belong together, or list them in --pairs")
        ]
    if in_order(frames)[0] == [0, 1]:
        return []
    text = f"is the second of the pair, and {first.name} the first; by their names they are the other way round"
    return [Notice("pair-backwards", second.name, text, "give the earlier frame first")]


# Batches of folders that are still being filled: what is complete is worked through, then what has come since.


Item = TypeVar("Item")
# So many that have come without a single pair among them are told.
MOST_ALONE = 4
PASSED_OVER = "it is passed over; its pair is measured when it is complete"


def watched(
    folders: Sequence[Path], kind: InputKind, options: WorkOptions, idle_s: float, console: Console
) -> Iterator[list[Path]]:
    """Return the files of folders in groups, as they become complete: see `as_they_come`.

    Raises
    ------
    UsageError : one is no folder, or a share is asked for
    InputError : none has come by the end
    StoppedEarlyError : the time is over, as is seen between groups
    """
    if options.shard != ALL:
        raise UsageError("--watch: which frames make a share is known when the last one is there; leave out --shard")
    if options.dry_run:
        raise UsageError("--watch waits for what is not there, and --dry-run tells what is: leave out one of them")
    for folder in folders or ("",):
        if not os.path.isdir(folder):
            raise UsageError(f"{folder or 'no folder was given'}: --watch takes folders")

    def read(path: Path) -> None:
        if kind == "images":
            # The others are there when the last one is.
            image_files.read_image(path, image_files.count_pages(path) - 1)
        else:
            vtkhdf.read_header(path)

    def passed_over(path: Path, error: InputError) -> None:
        console.warn([Notice("frame-failed", path.stem, f"cannot be read so far: {error}", PASSED_OVER)])

    deadline = options.deadline()

    def groups() -> Iterator[list[Path]]:
        count = 0
        ends = "until it is interrupted" if math.isinf(idle_s) else f"ends {idle_s:g} s after the last change"
        console.say(f"watches {', '.join(map(str, folders))}; {ends}")

        def listed() -> list[Path]:
            if not deadline.leaves_time():
                raise deadline.error(count, count, "frame")
            return [path for folder in folders for path in files_in(folder, kind)]

        for group in as_they_come(listed, read, idle_s, passed_over):
            count += len(group)
            yield group
        if count == 0:
            raise InputError(f"{folders[0]}: no {kind} have come in {idle_s:g} s")

    return groups()


def work_as_they_come(
    make: Callable[[Sequence[Path]], Batch[Any]],
    groups: Iterable[Sequence[Path]],
    options: BatchOptions,
    console: Console,
    left_out: Sequence[Failure] = (),
) -> dict[str, Any]:
    """Work through a batch for each group of files; return what the last one reports of all.

    Parameters
    ----------
    left_out : the files that were in no group, as known at the end

    Raises
    ------
    LfpivError : as `carried_out`
    InputError : there was no group
    """
    alone = replace(options, failures=None)
    together: Worked = Worked()
    batch: Batch[Any] | None = None
    for group in groups:
        try:
            batch = make(group)
        except InputError as error:
            if not options.keep_going or batch is None:
                raise
            together.failures.append(Failure(group[0].stem, str(error)))
        else:
            together.add(batches.work_through(batch, alone, console))
    together.failures[:0] = left_out
    if batch is None:
        raise InputError(f"{together.failures[0].name}: {together.failures[0].error}")
    together.list_failures(options.failures)
    return together.ensure_whole(batch.summary(together), batch.unit)


def coming_pairs(
    groups: Iterable[Sequence[Item]],
    seen_of: Callable[[Sequence[Item]], Sequence[Seen]],
    options: PairOptions,
    console: Console,
    left_out: list[Failure],
) -> Iterator[list[tuple[Item, Item]]]:
    """Yield pairs that are complete, of frames or files as they come.

    Parameters
    ----------
    seen_of : tells what is known of some of them
    left_out : is kept at those of which no partner has come so far
    """
    items: list[Item] = []
    made: set[tuple[int, int]] = set()
    reported: set[Notice] = set()
    for more in groups:
        items += more
        seen = seen_of(items)
        if len(items) < 2:
            left_out[:] = [Failure(each.name, "no other frame has come") for each in seen]
            continue
        found = found_pairs(seen, options, coming=True)
        fresh = [each for each in found.pairs if each not in made]
        made.update(fresh)
        left_out[:] = failures_of(found)
        # Once: what is taken for granted, and what has no partner though later pairs are complete, or none is at all.
        last = max((second for _, second in made), default=0 if len(items) < MOST_ALONE else len(items))
        before = {each.name for each in seen[:last]}
        passed = [replace(each, remedy=PASSED_OVER) for each in found.left_out if each.about in before]
        unsaid = [notice for notice in (*found.notices, *passed) if notice not in reported]
        unsaid = unsaid if made else [] if reported else unsaid[:1]
        reported.update(unsaid)
        console.warn(unsaid)
        if fresh:
            yield [(items[first], items[second]) for first, second in fresh]


# Pairs whose volumes or particles are dropped as soon as their vectors stand.
#
# A disk holds the files of two frames at a time, however many pairs there are. What is complete is known without
# them: a result's record tells of which it was made, with what, and these are asked for what they would be today.
# Several workers share the files of a frame: each is claimed while it is made, and dropped by whoever completes the
# last of its pairs.


class PairByPair(Batch[Made]):
    """The batch of pairs, each from its two images to its vectors."""

    unit = "pair"

    def __init__(
        self,
        found: Batch[Any],
        of_pair: Callable[..., Batch[Made]],
        pairs: Pairs,
        targets: Sequence[Target],
        file_bytes: float | None = None,
    ) -> None:
        """Take the batch of the frames, what makes that of two of them, where results go, and how large one is."""
        self._found, self._of_pair, self._pairs = found, of_pair, pairs.pairs
        self._file_bytes = file_bytes
        self.label, self.overwrite = found.label, found.overwrite
        self.targets = [replace(each, make_record=partial(self._record, k)) for k, each in enumerate(targets)]
        self.inputs = found.inputs
        self.beside = found.outputs
        self.notices, self.left_out = found.notices, failures_of(pairs)
        self._pairs_of: list[list[int]] = [[] for _ in found.targets]
        for number, pair in enumerate(self._pairs):
            for k in pair:
                self._pairs_of[k].append(number)
        # Pairs that are known to be complete, and frames whose files are, as these were when they were read.
        self._complete: set[int] = set()
        self._whole: dict[int, Stamp] = {}

    def begin(self, numbers: Sequence[int], console: Console) -> float:
        """Prepare the frames of the pairs that are to be made; drop those that no pair needs."""
        every = list(dict.fromkeys(k for number in numbers for k in self._pairs[number]))
        frames = [self._found.targets[k] for k in every]
        left = [every[k] for k in pending(frames, self.inputs, self.overwrite, resume=True)] if every else []
        self._whole = {k: stamp_of(self._found.targets[k].path) for k in set(every) - set(left)}
        steps = self._found.begin(left, console)
        self._drop(range(len(self._found.targets)))
        # Where all frames are there, what joins them is a step.
        return max(steps * len(left) / max(len(numbers), 1), 1.0)

    def make(self, number: int, work: Frames) -> Made:
        """Make the files of two frames, where they are not there, and of these the result."""
        for k in self._pairs[number]:
            target = self._found.targets[k]
            stamp = stamp_of(target.path)
            if stamp is None or self._whole.get(k) != stamp:
                with atomic.awaited(target.path):
                    if state_or_none(target) is not State.COMPLETE:
                        self._found.make(k, work)
                self._whole[k] = stamp_of(target.path)
        joined = self._join(number, {})
        joined.begin([0], work.console)
        made = joined.make(0, work)
        self._complete.add(number)
        self._drop(self._pairs[number])
        return made

    def _is_complete(self, number: int) -> bool:
        """Return whether the result of a pair is there, by whichever worker."""
        if number not in self._complete and state_or_none(self.targets[number]) is State.COMPLETE:
            self._complete.add(number)
        return number in self._complete

    def _drop(self, frames: Iterable[int]) -> None:
        """Remove the files of those of some frames whose pairs are all complete, and their folder after the last."""
        for k in frames:
            path = self._found.targets[k].path
            if path.exists() and self._pairs_of[k] and all(map(self._is_complete, self._pairs_of[k])):
                for each in (path, residual_path(path)):
                    each.unlink(missing_ok=True)
        folder = self._found.targets[0].path.parent
        if folder.is_dir() and not any(folder.iterdir()) and all(map(self._is_complete, range(len(self._pairs)))):
            with contextlib.suppress(OSError):  # another worker was quicker
                folder.rmdir()

    def fault(self, number: int) -> str | None:
        """Return why a frame of a pair cannot be read."""
        return next(filter(None, map(self._found.fault, self._pairs[number])), None)

    def expected(self) -> Expected:
        """Return how large a result is, and what is held while the files of a frame are made."""
        return Expected(self._file_bytes, self._found.expected().memory_bytes)

    def _record(self, number: int) -> Mapping[str, Any]:
        """Return the record of a result, of its frames' files as they will be.

        Of a file that is gone the hash is the one that the result carries; one that is there and stays as it is tells
        of itself.
        """
        gone: dict[Path, Gone] = {}
        for frame in (self._found.targets[k] for k in self._pairs[number]):
            carried: Mapping[str, Any]
            if frame.path.exists():
                carried, digest = carried_record(frame.path), sha256(frame.path)
                if without_warnings(carried) == frame.record:
                    continue
            else:
                made = carried_record(self.targets[number].path)
                digest = {each["name"]: each["sha256"] for each in made["inputs"].values()}.get(frame.path.name, "")
                carried = made["made_from"].get(digest, {})
            warned = {name: carried[name] for name in ("warnings",) if name in carried}
            gone[frame.path] = Gone(digest, {**frame.record, **warned})
        return self._join(number, gone).targets[0].record

    def _join(self, number: int, gone: Mapping[Path, Gone]) -> Batch[Made]:
        """Return the batch of one pair: of the files of its frames, of which some may be gone, into one file."""
        paths = [self._found.targets[k].path for k in self._pairs[number]]
        return self._of_pair(paths, self.targets[number].path, pairs=Pairs(((0, 1),)), gone=gone)
