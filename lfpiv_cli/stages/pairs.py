"""Which frames of a command belong together, as its options have it, and the batches of what is made of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.frame_sources import images_seen, results_seen
from lfpiv_cli.files.pair_lists import pairs_listed
from lfpiv_cli.files.pairing import Pairs, Seen, contradiction, in_order, pair_frames
from lfpiv_cli.files.provenance import Gone
from lfpiv_cli.names import Pairing
from lfpiv_cli.notice import Notice
from lfpiv_cli.stages.batches import BatchOptions, ByArguments, Failure


@dataclass(frozen=True, kw_only=True)
class PairOptions:
    """How a command is told which frames belong together.

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


@dataclass(frozen=True, kw_only=True)
class PairBatchOptions(PairOptions, BatchOptions):
    """What a batch of pairs is given."""


Chosen = TypeVar("Chosen", bound=PairBatchOptions)


class PairBatch(ByArguments, ABC, Generic[Chosen]):
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
        self.inputs: Sequence[Path] = files
        self.notices: Sequence[Notice] = ()
        self.left_out: Sequence[Failure] = ()
        self._arrange(files, output, pairs)

    @abstractmethod
    def _arrange(self, files: Sequence[Path], output: Path, pairs: Pairs | None) -> None:
        """Say which files each result is made of, and where it goes."""

    def _paired(self, files: Sequence[Path], pairs: Pairs | None) -> list[tuple[Path, Path]]:
        """Return the files of each pair; note what is to be said of them, and those without a partner."""
        found = result_pairs(files, self._options) if pairs is None else pairs
        self.notices, self.left_out = found.settled(self._options.keep_going), failures_of(found)
        return [(files[first], files[second]) for first, second in found.pairs]


def failures_of(pairs: Pairs) -> list[Failure]:
    """Return the frames that have no partner, as what has failed."""
    return [Failure(each.name, each.why) for each in pairs.left_out]


def image_pairs(frames: Sequence[Frame], options: PairOptions) -> Pairs:
    """Return which frames of images belong together, see `_found`."""
    return _found(images_seen(frames), options)


def result_pairs(paths: Sequence[Path], options: PairOptions) -> Pairs:
    """Return which volumes or files of particles belong together, see `_found`."""
    return _found(results_seen(paths), options)


def sequence_of(paths: Sequence[Path]) -> tuple[list[int], list[Notice]]:
    """Return files of particles in the order of time, by their names, and what is to be said of it.

    Two are taken as they are given.
    """
    frames = results_seen(paths)
    return ([0, 1], _doubts(frames)) if len(frames) == 2 else in_order(frames)


def _found(frames: Sequence[Seen], options: PairOptions) -> Pairs:
    """Return which frames belong together: by a list, by names; without options two as they are given.

    Raises
    ------
    UsageError : no option says it and there are not two frames, or options contradict each other
    """
    if options.pairs is not None:
        if options.pairing == "sequence" or options.pair_by is not None:
            raise UsageError("--pairs lists separate pairs: give it without --pairing sequence and --pair-by")
        return pairs_listed(options.pairs, frames)
    if options.are_told:
        return pair_frames(frames, options.pairing or "ab", options.pair_by)
    if len(frames) < 2:
        raise UsageError(f"pairs need two or more frames, got {len(frames)} frames")
    if len(frames) > 2:
        raise UsageError(
            f"{len(frames)} frames need --pairing: ab for separate pairs or sequence for each with the next"
        )
    return Pairs(((0, 1),), notices=tuple(_doubts(frames)))


def _doubts(frames: Sequence[Seen]) -> list[Notice]:
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
