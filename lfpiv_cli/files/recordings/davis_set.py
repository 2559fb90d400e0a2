"""LaVision DaVis' .set: a text, and beside it a folder of its name with the set's images B00001.im7, B00002.im7, ...

The text tells how DaVis shows the set; which images there are, the folder tells. Its frames are those of one image
after those of the one before.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import opened, reading_from
from lfpiv_cli.files.recordings import im7
from lfpiv_cli.files.recordings.recording import Image, Recording, Shape

SUFFIX = ".set"
IMAGE = re.compile(r"B(\d+)\.im7", re.IGNORECASE)
# A set's images count from 1; from 0 where a program other than DaVis wrote it.
FIRST = (0, 1)
# The text has some hundred characters, and no zero byte among these; archives and streams have them.
TEXT_BYTES = 4096
EXPORT_HINT = "save it from DaVis as a set of .im7 images, or as TIFF"


def frames(path: Path) -> Recording:
    """Return the frames of a set's images, in the order of their numbers.

    Raises
    ------
    InputError : the folder or one of the images is missing, or images differ in size
    """
    with opened(path) as text:
        if b"\0" in text.read(TEXT_BYTES):
            raise InputError(f"{path}: is no text beside a folder of images, as sets are: {EXPORT_HINT}")
    files = _images(path)
    found = [im7.frames(file) for file in files]
    for file, each in zip(files, found, strict=True):
        if each.shape != found[0].shape:
            raise InputError(f"{file}: has (rows, columns) {each.shape}, the first image of its set {found[0].shape}")
    ends = list(accumulate(each.pages for each in found))
    bits = max(each.bits for each in found)
    return Recording(ends[-1], found[0].shape, bits, partial(_read_page, files, ends))


def beside(path: Path) -> tuple[Path, ...]:
    """Return the folder of a set's images.

    Raises
    ------
    InputError : there is none
    """
    folder = path.with_suffix("")
    if not folder.is_dir():
        raise InputError(f"{path}: the folder of its images, {folder.name}, is not beside it")
    return (folder,)


def _images(path: Path) -> list[Path]:
    """Return the images of a set in order, after checking that none is missing.

    Raises
    ------
    InputError
    """
    (folder,) = beside(path)
    numbered = sorted(_numbered(folder))
    if not numbered:
        raise InputError(f"{path}: its folder {folder} {_instead(folder)}")
    numbers = [number for number, _ in numbered]
    if numbers[0] not in FIRST:
        raise InputError(f"{path}: its first image is {numbered[0][1].name}, and those before it are missing")
    for (before, one), (after, other) in pairwise(numbered):
        if after != before + 1:
            what = "has the same number as" if after == before else "is not the next image after"
            raise InputError(f"{path}: {other.name} {what} {one.name}: images of the set are missing or there twice")
    return [file for _, file in numbered]


def _numbered(folder: Path) -> Iterator[tuple[int, Path]]:
    """Yield the images in a folder with their numbers."""
    with reading_from(folder):
        for file in folder.iterdir():
            if found := IMAGE.fullmatch(file.name):
                yield int(found[1]), file


def _instead(folder: Path) -> str:
    """Return what a folder without images holds, and what to do."""
    within = sorted(each for each in folder.iterdir() if each.is_dir() and any(_numbered(each)))
    if within:
        return f"holds several sets: give one of these folders, as {within[0]}"
    kinds = Counter(each.suffix.lower() for each in folder.iterdir() if each.suffix)
    others = f", but {kinds.most_common(1)[0][0]} files" if kinds else ""
    return f"holds no images B00001.im7, B00002.im7, ...{others}: {EXPORT_HINT}"


def _read_page(files: Sequence[Path], ends: Sequence[int], page: int, shape: Shape | None) -> Image:
    """Read a frame; the image's header, too, so that one that was written anew is not read by its old one."""
    number = bisect_right(ends, page)
    within = page - (ends[number - 1] if number else 0)
    found = im7.frames(files[number])
    if within >= found.pages:
        raise InputError(f"{files[number]}: holds {found.pages} frames, fewer than when its set was looked through")
    return found.read_page(within, shape)
