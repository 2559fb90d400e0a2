"""Pairs whose volumes or particles are dropped as soon as their vectors stand.

A disk holds the files of two frames at a time, however many pairs there are. What is complete is known without them: a
result's record tells of which it was made, with what, and these are asked for what they would be today. Several workers
share the files of a frame: each is claimed while it is made, and dropped by whoever completes the last of its pairs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.files.batch import State, Target, pending, state_or_none
from lfpiv_cli.files.claims import awaited
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import Gone, carried_record, sha256, without_warnings
from lfpiv_cli.stages.batches import Batch, Made, Stamp, stamp_of
from lfpiv_cli.stages.dry_runs import Expected
from lfpiv_cli.stages.pairs import failures_of
from lfpiv_cli.stages.reconstruct import Reconstruction, residual_path


class Join(Protocol[Made]):
    """Makes the batch of one pair: of the files of its frames, of which some may be gone, into one file."""

    def __call__(self, pair: Sequence[Path], output: Path, gone: Mapping[Path, Gone]) -> Batch[Made]:
        """Return it."""


class PairByPair(Generic[Made]):
    """The batch of pairs, each from its two images to its vectors."""

    unit = "pair"

    def __init__(
        self,
        found: Reconstruction,
        join: Join[Made],
        pairs: Pairs,
        targets: Sequence[Target],
        file_bytes: float | None = None,
    ) -> None:
        """Take the batch of the frames, what joins two of them, where its results go, and how large one is if known."""
        self._found, self._join, self._pairs = found, join, pairs.pairs
        self._file_bytes = file_bytes
        self.label, self.overwrite = found.label, found.overwrite
        self.targets = [replace(each, make_record=partial(self._record, k)) for k, each in enumerate(targets)]
        self.names, self.order = [target.path.stem for target in targets], range(len(targets))
        self.inputs = found.inputs
        self.outputs = [*found.outputs, *(path for target in targets for path in target.paths)]
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
        left = self._left_of(every) if every else []
        self._whole = {k: stamp_of(self._found.targets[k].path) for k in set(every) - set(left)}
        steps = self._found.begin(left, console)
        self._drop(range(len(self._found.targets)))
        # Where all frames are there, what joins them is a step.
        return max(steps * len(left) / max(len(numbers), 1), 1.0)

    def _left_of(self, every: Sequence[int]) -> list[int]:
        """Return the frames that have to be made."""
        frames = [self._found.targets[k] for k in every]
        return [every[k] for k in pending(frames, self.inputs, self.overwrite, resume=True)]

    def make(self, number: int, work: Frames) -> Made:
        """Make the files of two frames, where they are not there, and of these the result."""
        for k in self._pairs[number]:
            self._ensure_made(k, work)
        joined = self._joined(number, {})
        joined.begin([0], work.console)
        made = joined.make(0, work)
        self._complete.add(number)
        self._drop(self._pairs[number])
        return made

    def _ensure_made(self, k: int, work: Frames) -> None:
        """Make the file of a frame, unless it is there and complete, or another worker makes it."""
        target = self._found.targets[k]
        stamp = stamp_of(target.path)
        if stamp is not None and self._whole.get(k) == stamp:
            return
        with awaited(target.path):
            if state_or_none(target) is not State.COMPLETE:
                self._found.make(k, work)
        self._whole[k] = stamp_of(target.path)

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

    def _joined(self, number: int, gone: Mapping[Path, Gone]) -> Batch[Made]:
        paths = [self._found.targets[k].path for k in self._pairs[number]]
        return self._join(paths, self.targets[number].path, gone)

    def _record(self, number: int) -> Mapping[str, Any]:
        """Return the record of a result, of its frames' files as they will be."""
        targets = [self._found.targets[k] for k in self._pairs[number]]
        to_come = {target.path: self._to_come(target, self.targets[number].path) for target in targets}
        gone = {path: file for path, file in to_come.items() if file is not None}
        return self._joined(number, gone).targets[0].record

    def _to_come(self, frame: Target, result: Path) -> Gone | None:
        """Return a frame's file where it is gone, with the hash that the result carries, or is to carry another record.

        None where it is there and stays as it is.
        """
        carried: Mapping[str, Any]
        if frame.path.exists():
            carried, digest = carried_record(frame.path), sha256(frame.path)
            if without_warnings(carried) == frame.record:
                return None
        else:
            made = carried_record(result)
            digest = {each["name"]: each["sha256"] for each in made["inputs"].values()}.get(frame.path.name, "")
            carried = made["made_from"].get(digest, {})
        return Gone(digest, {**frame.record, **{name: carried[name] for name in ("warnings",) if name in carried}})


def joined_by(make: Callable[..., Batch[Made]], *options: Any) -> Join[Made]:
    """Return what makes the batch of one pair, by the class of the batch and what it takes besides."""
    one = Pairs(((0, 1),))

    def join(pair: Sequence[Path], output: Path, gone: Mapping[Path, Gone]) -> Batch[Made]:
        return make(pair, output, *options, one, gone)

    return join
