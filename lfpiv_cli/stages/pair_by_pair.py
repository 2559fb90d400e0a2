"""Pairs whose volumes or particles are dropped as soon as their vectors stand.

A disk holds the files of two frames at a time, however many pairs there are. What is complete is known without them: a
result's record tells of which it was made, with what, and these are asked for what they would be today.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.files.batch import Target, pending, prepare_folder
from lfpiv_cli.files.pairing import Pairs
from lfpiv_cli.files.provenance import Gone, carried_record
from lfpiv_cli.stages.batches import Batch, Failure, Made
from lfpiv_cli.stages.reconstruct import Reconstruction, residual_path


class Join(Protocol[Made]):
    """Makes the batch of one pair: of the files of its frames, of which some may be gone, into one file."""

    def __call__(self, pair: Sequence[Path], output: Path, gone: Mapping[Path, Gone]) -> Batch[Made]:
        """Return it."""


class PairByPair(Generic[Made]):
    """The batch of pairs, each from its two images to its vectors."""

    unit = "pair"

    def __init__(self, found: Reconstruction, join: Join[Made], pairs: Pairs, targets: Sequence[Target]) -> None:
        """Take the batch of the frames, what joins two of them, and where its results go."""
        self._found, self._join, self._pairs = found, join, pairs.pairs
        self.label, self.overwrite = found.label, found.overwrite
        self.targets = [replace(each, make_record=partial(self._record, k)) for k, each in enumerate(targets)]
        self.names = [target.path.stem for target in targets]
        self.inputs = found.inputs
        self.outputs = [*found.outputs, *(path for target in targets for path in target.paths)]
        self.notices, self.left_out = found.notices, [Failure(each.name, each.why) for each in pairs.left_out]
        self._open: dict[int, tuple[int, int]] = {}
        self._lacking: set[int] = set()

    def begin(self, numbers: Sequence[int], console: Console) -> float:
        """Prepare the frames of the pairs that are to be made; drop those of the others."""
        self._open = {number: self._pairs[number] for number in numbers}
        every = dict.fromkeys(k for pair in self._open.values() for k in pair)
        frames = [self._found.targets[k] for k in every]
        if frames:
            prepare_folder([target.path for target in frames])
        left = pending(frames, self.inputs, self.overwrite, resume=True)
        lacking = [k for place, k in enumerate(every) if place in set(left)]
        self._lacking = set(lacking)
        steps = self._found.begin(lacking, console)
        for pair in self._pairs:
            self._drop(pair)
        return steps * len(lacking) / max(len(numbers), 1)

    def make(self, number: int, work: Frames) -> Made:
        """Make the files of two frames, where they are not there, and of these the result."""
        for k in self._pairs[number]:
            if k in self._lacking:
                self._found.make(k, work)
                self._lacking.discard(k)
        joined = self._joined(number, {})
        joined.begin([0], work.console)
        made = joined.make(0, work)
        del self._open[number]
        self._drop(self._pairs[number])
        return made

    def _drop(self, pair: Sequence[int]) -> None:
        """Remove the files of frames that no pair needs any more."""
        needed = {k for pair in self._open.values() for k in pair}
        for k in set(pair) - needed:
            path = self._found.targets[k].path
            for each in (path, residual_path(path)):
                each.unlink(missing_ok=True)
        folder = self._found.targets[0].path.parent
        if not needed and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()

    def _joined(self, number: int, gone: Mapping[Path, Gone]) -> Batch[Made]:
        paths = [self._found.targets[k].path for k in self._pairs[number]]
        return self._join(paths, self.targets[number].path, gone)

    def _record(self, number: int) -> Mapping[str, Any]:
        """Return the record of a result; where the files of its frames are gone, with the hashes that it carries."""
        targets, gone = [self._found.targets[k] for k in self._pairs[number]], {}
        if not all(target.path.exists() for target in targets):
            carried = carried_record(self.targets[number].path)
            hashes = {given["name"]: given["sha256"] for given in carried["inputs"].values()}
            for target in targets:
                digest = hashes.get(target.path.name, "")
                warned = carried["made_from"].get(digest, {}).get("warnings")
                made = target.record if warned is None else {**target.record, "warnings": warned}
                gone[target.path] = Gone(digest, made)
        return self._joined(number, gone).targets[0].record


def joined_by(make: Callable[..., Batch[Made]], *options: Any) -> Join[Made]:
    """Return what makes the batch of one pair, by the class of the batch and what it takes besides."""
    one = Pairs(((0, 1),))

    def join(pair: Sequence[Path], output: Path, gone: Mapping[Path, Gone]) -> Batch[Made]:
        return make(pair, output, *options, one, gone)

    return join
