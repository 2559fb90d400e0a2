"""A file of frames, whatever its format: how many, how large, when each was taken, and how one is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Shape = tuple[int, int]


class PageReader(Protocol):
    """Reads one frame of a file that is named in it."""

    def __call__(self, page: int, shape: Shape | None) -> Image:
        """Return frame `page` (rows, columns) in counts; `shape` is the sensor's (rows, columns), where it is known.

        Raises
        ------
        InputError : the frame is damaged, in colour, or of another size; the message names the file
        """


@dataclass(frozen=True, eq=False)
class Recording:
    """What the header of a file says. It holds no open file, so that any number of them may be kept.

    Attributes
    ----------
    pages : number of frames
    shape : (rows, columns) of the first one
    bits : of a pixel, as they are stored
    read_page : reads the frame of a number that is at least 0 and less than `pages`
    time_s : when each frame was taken, shape (pages,), from the first frame or another start; None where it is not told
    """

    pages: int
    shape: Shape
    bits: int
    read_page: PageReader
    time_s: NDArray[np.float64] | None = None
