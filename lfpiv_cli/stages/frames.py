"""Frames of a batch: read ahead, dark and background taken off, and what their records say of other frames."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.reconstruction.images import Image, light, mean_background, minimum_background, still_light

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
    level: Background, frames: Sequence[Frame], shape: tuple[int, int], dark: Image | None
) -> Callable[[int], tuple[Image, Image]]:
    """Return the function that reads frame `number`: raw, and with dark or background taken off."""
    fixed = image_files.read_image(level.path, shape) if level.path else None
    window = len(level.around(0, len(frames)))

    @lru_cache(maxsize=window if level.frames else 1)
    def page(number: int) -> Image:
        return image_files.read_page(frames[number].path, frames[number].page, shape)

    @lru_cache(maxsize=1)
    def over(numbers: range) -> NDArray[np.float32]:
        return BACKGROUNDS[level.kind or ""](page(k) for k in numbers)

    def read(number: int) -> tuple[Image, Image]:
        numbers = level.around(number, len(frames))
        raw = page(number)
        return raw, light(raw, dark, over(numbers) if level.kind else fixed)

    return read


def mask_of(given: str | Path | None, frames: Sequence[Frame], shape: tuple[int, int], pitch_px: float) -> Image | None:
    """Return the mask, 0 where pixels are left out: of a file, or of what does not move in the frames (`still`)."""
    if given is None:
        return None
    if given != STILL:
        return image_files.read_image(Path(given), shape)
    images = (image_files.read_page(frame.path, frame.page, shape) for frame in frames)
    still = still_light(images, pitch_px)
    return np.where(still, np.float32(0.0), np.float32(1.0))


def ahead(
    read: Callable[[int], tuple[Image, Image]], numbers: Sequence[int]
) -> Iterator[tuple[int, Future[tuple[Image, Image]]]]:
    """Yield each number with its frame, read while the one before is worked on."""
    with ThreadPoolExecutor(max_workers=1) as pool:
        coming = [pool.submit(read, number) for number in numbers[:1]]
        for place, number in enumerate(numbers):
            current = coming.pop()
            coming = [pool.submit(read, following) for following in numbers[place + 1 : place + 2]]
            yield number, current


def sequence_digests(level: Background, frames: Sequence[Frame], mask: str | Path | None = None) -> list[str]:
    """Return for each frame which other frames its background and mask are made from, as words for its record."""
    words = [""] * len(frames)
    if level.kind is None and mask != STILL:
        return words
    pages = [f"{sha256(frame.path)} {frame.page}\n" for frame in frames]

    def over(numbers: range) -> str:
        digest = hashlib.sha256("".join(pages[k] for k in numbers).encode()).hexdigest()
        return f"over {len(numbers)} frames, SHA-256 {digest}"

    if level.kind is not None:
        words = [f", background: {level.kind} {over(level.around(k, len(frames)))}" for k in range(len(frames))]
    if mask == STILL:
        words = [f"{word}, mask: {STILL} {over(range(len(frames)))}" for word in words]
    return words


def with_those_beside(made_of: Sequence[str], frames: Sequence[Frame], beside: Sequence[tuple[int, ...]]) -> list[str]:
    """Return the words of each frame's record with those of the frames that help it."""
    alone = [
        f", beside page {frame.page}{words} of SHA-256 {sha256(frame.path)}"
        for frame, words in zip(frames, made_of, strict=True)
    ]
    return ["".join([words, *(alone[k] for k in numbers)]) for words, numbers in zip(made_of, beside, strict=True)]
