"""The files of a sequence's frames, as they are followed: one for each, written as it is found."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lfpiv_cli.console import Frames
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Target
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, Points, no_points, read_points, write_points
from lfpiv_cli.files.provenance import with_warnings
from lfpiv_cli.files.shares import Deadline
from lfpiv_cli.notice import Notice
from lfpiv_cli.reconstruction.images import Image
from lfpiv_cli.reference import Reference
from lfpiv_cli.stages.batches import Failure
from lfpiv_cli.stages.dry_runs import Expected
from lfpiv_cli.stages.reconstruct import residual_path


@dataclass(frozen=True)
class PlannedFrames:
    """The frames of a sequence before any is followed, as `dry_run` asks of them.

    Attributes
    ----------
    targets : where the particles of those go that can be read
    beside : the other files that are written
    left_out : frames that cannot be read
    """

    targets: Sequence[Target]
    beside: Sequence[Path]
    inputs: Sequence[Path]
    left_out: Sequence[Failure]
    overwrite: bool
    label: str = "follow"
    unit: str = "frame"

    @property
    def names(self) -> list[str]:
        """The frames' names."""
        return [target.path.stem for target in self.targets]

    @property
    def order(self) -> range:
        """All of them, in time."""
        return range(len(self.targets))

    @property
    def outputs(self) -> list[Path]:
        """All files that are written."""
        return [*(target.path for target in self.targets), *self.beside]

    def fault(self, _number: int) -> None:
        """Return that nothing is wrong with a frame: those that cannot be read were left out."""

    def expected(self) -> Expected:
        """Return that neither is known: how many particles will be found is not."""
        return Expected()


class FrameFiles:
    """A store of one file for each frame."""

    def __init__(
        self,
        targets: Sequence[Target],
        needed: frozenset[int],
        there: frozenset[int],
        reference: Reference,
        said: Sequence[Notice],
        residuals: bool,
        overwrite: bool,
        work: Frames,
        deadline: Deadline,
    ) -> None:
        """Take where the frames' files go, which are to be made, which there are, and what is said of all of them."""
        self._deadline, self._begun, self._put = deadline, time.monotonic(), 0
        self.targets, self.needed, self.there, self.said = targets, needed, there, said
        self._nothing = no_points(PARTICLES_FORMAT, reference)
        self.residuals, self.overwrite, self.work = residuals, overwrite, work

    def read(self, number: int) -> Points:
        """Return the particles of a frame; none of one that was left out."""
        if number not in self.there:
            return self._nothing
        return read_points(self.targets[number].path, PARTICLES_FORMAT)

    def made(self, number: int) -> Points | None:
        """Return the particles of a frame that was complete; begin another one where there is time for it.

        Raises
        ------
        StoppedEarlyError : there is none
        """
        if number not in self.needed:
            return self.read(number)
        if not self._deadline.leaves_time():
            done = len(self.there) - len(self.needed) + self._put
            raise self._deadline.error(done, len(self.there), "frame")
        self._begun = time.monotonic()
        return None

    def put(self, number: int, points: Points, left: Image, notices: list[Notice]) -> None:
        """Write the particles of a frame, what is left of its image before them: what is complete has both."""
        target = self.targets[number]
        self.work.console.warn(notices)
        if self.residuals:
            image_files.write_tiff(residual_path(target.path), left, overwrite=True)
        told = replace(points, provenance=with_warnings(target.record, [*self.said, *notices]))
        write_points(target.path, PARTICLES_FORMAT, told, overwrite=self.overwrite)
        self._deadline.took(time.monotonic() - self._begun)
        self._put += 1
        self.work.done(target.path.stem)
