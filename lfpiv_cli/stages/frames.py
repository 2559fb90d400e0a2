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
from lfpiv_cli.reconstruction.images import Image, light, mean_background, minimum_background

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


def sequence_digests(level: Background, frames: Sequence[Frame]) -> list[str]:
    """Return for each frame which other frames its background is made from, as words for its record."""
    if level.kind is None:
        return [""] * len(frames)
    pages = [f"{sha256(frame.path)} {frame.page}\n" for frame in frames]
    words = []
    for number in range(len(frames)):
        numbers = level.around(number, len(frames))
        digest = hashlib.sha256("".join(pages[k] for k in numbers).encode()).hexdigest()
        words.append(f", background: {level.kind} over {len(numbers)} frames, SHA-256 {digest}")
    return words


def with_those_beside(made_of: Sequence[str], frames: Sequence[Frame], beside: Sequence[tuple[int, ...]]) -> list[str]:
    """Return the words of each frame's record with those of the frames that help it."""
    alone = [
        f", beside page {frame.page}{words} of SHA-256 {sha256(frame.path)}"
        for frame, words in zip(frames, made_of, strict=True)
    ]
    return ["".join([words, *(alone[k] for k in numbers)]) for words, numbers in zip(made_of, beside, strict=True)]
