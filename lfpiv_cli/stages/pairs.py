"""Which frames of a command belong together, as its options have it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.frame_sources import images_seen, results_seen
from lfpiv_cli.files.pair_lists import pairs_listed
from lfpiv_cli.files.pairing import Pairs, Seen, in_order, pair_frames
from lfpiv_cli.names import Pairing
from lfpiv_cli.notice import Notice


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
    return ([0, 1], _backwards(frames)) if len(frames) == 2 else in_order(frames)


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
    return Pairs(((0, 1),), notices=tuple(_backwards(frames)))


def _backwards(frames: Sequence[Seen]) -> list[Notice]:
    """Say of two frames that are taken as they are given where their names say that the second is the first."""
    order, _ = in_order(frames)
    if order == [0, 1]:
        return []
    text = f"is the second of the pair, and {frames[0].name} the first; by their names they are the other way round"
    return [Notice("pair-backwards", frames[1].name, text, "give the earlier frame first")]
