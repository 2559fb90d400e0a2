"""Frames of a batch: read ahead, dark and background taken off, and what their records say of other frames."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.reconstruction.images import Image, light, mean_background, minimum_background, still_light

# Reads frame `number`: raw, and with dark or background taken off.
Read = Callable[[int], tuple[Image, Image]]

# In place of a mask's file: what does not move in the frames is left out.
STILL = "still"
BACKGROUNDS = {"minimum": minimum_background, "mean": mean_background}


@dataclass(frozen=True)
class Background:
    """What is subtracted as background: an image, or the minimum or mean over the frames, or over some around each.

    Attributes
    ----------
    path : of the image, None where it is made from the frames
    kind : name in `BACKGROUNDS`
    frames : how many around each frame; None: all of them
    """

    path: Path | None = None
    kind: str | None = None
    frames: int | None = None

    @classmethod
    def parse(cls, text: str | None) -> Background:
        """Return the background given as a file's name, `minimum`, `mean`, or `minimum:15` for fifteen frames."""
        if text is None:
            return cls()
        over_frames = re.fullmatch(rf"({'|'.join(BACKGROUNDS)})(?::(\d+))?", text)
        if over_frames is None:
            return cls(path=Path(text))
        kind, count = over_frames.groups()
        return cls(kind=kind, frames=None if count is None else int(count))

    def around(self, number: int, total: int) -> range:
        """Return the numbers of the frames, of `total`, that the background of one is made from."""
        if self.kind is None:
            return range(0)
        count = total if self.frames is None else min(self.frames, total)
        first = min(max(number - count // 2, 0), total - count)
        return range(first, first + count)


def reader(
    level: Background, frames: Sequence[Frame], shape: tuple[int, int], dark: Image | None, keep_going: bool = False
) -> Read:
    """Return the function that reads frame `number`: raw, and with dark or background taken off.

    With `keep_going` frames that cannot be read are left out of the backgrounds of others.
    """
    fixed = image_files.read_reference(level.path, shape) if level.path else None
    window = len(level.around(0, len(frames)))

    @lru_cache(maxsize=window if level.frames else 1)
    def page(number: int) -> Image:
        return read_frame(frames[number], shape)

    @lru_cache(maxsize=1)
    def over(numbers: range) -> NDArray[np.float32]:
        return BACKGROUNDS[level.kind or ""](_readable(page, numbers, keep_going))

    def read(number: int) -> tuple[Image, Image]:
        numbers = level.around(number, len(frames))
        raw = page(number)
        return raw, light(raw, dark, over(numbers) if level.kind else fixed)

    return read


def read_frame(frame: Frame, shape: tuple[int, int]) -> Image:
    """Read a frame.

    Raises
    ------
    InputError : it cannot be read, or has another shape
    """
    if frame.fault is not None:
        raise InputError(frame.fault)
    return image_files.read_page(frame.path, frame.page, shape)


def _readable(read: Callable[[int], Image], numbers: Iterable[int], keep_going: bool) -> Iterator[Image]:
    """Yield images, those that cannot be read left out where the others are to go on."""
    for number in numbers:
        try:
            image = read(number)
        except InputError:
            if not keep_going:
                raise
            continue
        yield image


def mask_of(
    given: str | Path | None,
    frames: Sequence[Frame],
    shape: tuple[int, int],
    pitch_px: float,
    keep_going: bool = False,
) -> Image | None:
    """Return the mask, 0 where pixels are left out: of a file, or of what does not move in the frames (`still`)."""
    if given is None:
        return None
    if given != STILL:
        return image_files.read_reference(Path(given), shape)
    images = _readable(lambda number: read_frame(frames[number], shape), range(len(frames)), keep_going)
    still = still_light(images, pitch_px)
    return np.where(still, np.float32(0.0), np.float32(1.0))


class Ahead:
    """Frames, each read while the one before is worked on."""

    def __init__(self, read: Read, numbers: Sequence[int]) -> None:
        """Take the function that reads a frame, and the numbers of those that are coming in their order."""
        self._read, self._pool = read, ThreadPoolExecutor(max_workers=1)
        self._following = dict(pairwise(numbers))
        self._coming: tuple[int, Future[tuple[Image, Image]]] | None = None

    def __call__(self, number: int) -> tuple[Image, Image]:
        """Return a frame, and begin to read the one that follows."""
        coming, self._coming = self._coming, None
        current = coming[1] if coming and coming[0] == number else self._pool.submit(self._read, number)
        following = self._following.get(number)
        if following is not None:
            self._coming = following, self._pool.submit(self._read, following)
        return current.result()


def other_frames(level: Background, frames: Sequence[Frame], mask: str | Path | None = None) -> Callable[[int], str]:
    """Return the function that says which other frames the background and mask of one are made from.

    Frames whose files cannot be read at all are not among them.
    """

    # The frames around one are nearly those around the next.
    @lru_cache(maxsize=max(2 * (level.frames or 0), 1))
    def page(number: int) -> str:
        return f"{sha256(frames[number].path)} {frames[number].page}\n"

    # Where the background is made from all frames, it is the same for all, as the mask is.
    @lru_cache(maxsize=2)
    def over(numbers: range) -> str:
        pages = [page(k) for k in numbers if frames[k].fault is None]
        digest = hashlib.sha256("".join(pages).encode()).hexdigest()
        return f"over {len(pages)} frames, SHA-256 {digest}"

    def words(number: int) -> str:
        around = level.around(number, len(frames))
        background = "" if level.kind is None else f", background: {level.kind} {over(around)}"
        return background + (f", mask: {STILL} {over(range(len(frames)))}" if mask == STILL else "")

    return words


def sequence_digests(level: Background, frames: Sequence[Frame], mask: str | Path | None = None) -> list[str]:
    """Return for each frame which other frames its background and mask are made from, as words for its record."""
    words = other_frames(level, frames, mask)
    return [words(number) for number in range(len(frames))]


def beside_frames(
    words: Callable[[int], str], frames: Sequence[Frame], beside: Sequence[tuple[int, ...]]
) -> Callable[[int], str]:
    """Return the function that says which frames help one, besides those of its own background and mask (`words`)."""

    def alone(number: int) -> str:
        frame = frames[number]
        return f", beside page {frame.page}{words(number)} of SHA-256 {sha256(frame.path)}"

    return lambda number: "".join([words(number), *(alone(k) for k in beside[number] if frames[k].fault is None)])
