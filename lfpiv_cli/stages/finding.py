"""The particles of the frames of a batch: each frame by itself, or with the help of those beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.interface import particles
from lfpiv_cli.interface.reconstruction import Bench, Progress, check_frame
from lfpiv_cli.notice import Notice
from lfpiv_cli.particles.search import Particles
from lfpiv_cli.stages.frames import Read


class Finder:
    """Finds the particles of frames, alone or with the first passes of those beside them.

    That of the second frame of a pair begins with what the first frame's found, never the other way round: so it does
    not matter which frames are there already.
    """

    def __init__(
        self,
        bench: Bench,
        read: Read,
        frames: Sequence[Frame],
        beside: Sequence[tuple[int, ...]] | None,
        first_of: Mapping[int, int],
        keep_going: bool,
    ) -> None:
        """Take how frames are read, which are beside each, and of each second of a pair the first.

        With `keep_going`, one of those beside may be unreadable.
        """
        self._bench, self._read, self._frames = bench, read, frames
        self._beside, self._first_of, self._keep_going = beside, first_of, keep_going
        # A frame needs itself and one at either side, the next one two of these again.
        self._first_pass_of: Callable[[int], NDArray[np.float64]] = lru_cache(maxsize=3)(self._first_pass)
        self._advance: Progress | None = None

    def find(self, number: int, frame: particles.Frame, advance: Progress) -> tuple[Particles, list[Notice]]:
        """Return the particles of a frame, and which of those beside it did not help.

        Raises
        ------
        InputError : one beside it cannot be read, and that is to stop the batch
        """
        self._advance = advance
        if self._beside is None:
            return particles.find(self._bench, frame, advance), []
        notices, helping = [], []
        for k in self._beside[number]:
            fault = self._fault(k) if self._keep_going else None
            if fault is None:
                helping.append(k)
            else:
                text = f"is found without the help of {self._frames[k].stem}: {fault}"
                notices.append(Notice("frame-alone", self._frames[number].stem, text, "mend that one"))
        if not helping:
            return particles.find(self._bench, frame, advance), notices
        seen = {k: self._first_pass_of(k) for k in sorted((number, *helping))}
        return particles.find_beside(self._bench, frame, seen[number], [seen[k] for k in helping]), notices

    def _first_pass(self, number: int) -> NDArray[np.float64]:
        frame, first = self._frame(number), self._first_of.get(number)
        if first is None:
            return particles.find_first(self._bench, frame, self._advance)
        before = self._frame(first)
        return particles.find_second(self._bench, frame, before, self._first_pass_of(first), self._advance)

    def _frame(self, number: int) -> particles.Frame:
        raw, lit = self._read(number)
        check_frame(self._bench, raw, str(self._frames[number].path))
        return particles.frame_of(self._bench, raw, lit)

    def _fault(self, number: int) -> str | None:
        """Return why a frame cannot help another one, None where it can."""
        try:
            self._frame(number)
        except InputError as error:
            return str(error)
        return None
