"""LaVision DaVis' .set: a text, and beside it a folder of its name with the set's images B00001.im7, B00002.im7, ...

The text tells how DaVis shows the set; which images there are, the folder tells. Its frames are those of one image
after those of the one before.
"""

from __future__ import annotations

import re
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from itertools import accumulate, pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import opened, reading_from, reason
from lfpiv_cli.files.recordings.blocks import bytes_at, values_at
from lfpiv_cli.files.recordings.recording import CUT, Image, Recording, Shape, as_counts, ensure_size

# LaVision DaVis' .im7: the frames of one recording, one below the other, as they are or packed by zlib.
#
# Header as the manufacturer published it (ReadIM7). Counts are those that are stored, without the scale that DaVis
# shows.

# Version, packing, format, sparse; columns, rows, planes, frames.
HEADER, HEADER_BYTES = "<4h4i", 256
# Kinds of counts by the format of images; positive ones are of vectors.
KINDS = {-3: "<f4", -4: "<u2", -5: "<f8"}
NOT_PACKED, ZLIB = 0, 2
# The number of packed bytes, before these.
LENGTH, LENGTH_BYTES = "<I", 4
PACKED_HINT = "save it from DaVis without compression, or as TIFF"


def im7_frames(path: Path) -> Recording:
    """Return the frames that a header declares, after checking that their bytes are there."""
    with opened(path) as file:
        size = file.seek(0, 2)
        _, packing, kind, _, columns, rows, planes, pages = values_at(path, file, 0, HEADER)
        if kind not in KINDS or planes != 1:
            raise InputError(f"{path}: is of format {kind} with {planes} planes, expected images: {PACKED_HINT}")
        if packing not in (NOT_PACKED, ZLIB):
            raise InputError(f"{path}: is packed in a way of its own ({packing}): {PACKED_HINT}")
        if min(columns, rows, pages) < 1:
            raise InputError(f"{path}: declares {pages} frames of {columns} x {rows} pixels (columns x rows)")
        counts, declared = np.dtype(KINDS[kind]), (rows, columns)
        ensure_size(f"{path}: all frames together", (rows * pages, columns), counts.itemsize, None, size)
        frame_bytes = rows * columns * counts.itemsize
        stored = frame_bytes * pages
        if packing == ZLIB:
            stored = LENGTH_BYTES + values_at(path, file, HEADER_BYTES, LENGTH)[0]
        if HEADER_BYTES + stored > size:
            raise InputError(
                f"{path}: declares {pages} frames that end at byte {HEADER_BYTES + stored} of {size}: {CUT}"
            )

    def read_page(page: int, shape: Shape | None) -> Image:
        with opened(path) as file:
            ensure_size(f"{path}: frame {page}", declared, 1, shape, file.seek(0, 2))
            if packing == ZLIB:
                data = _unpacked(path, file, pages, frame_bytes)[page * frame_bytes : (page + 1) * frame_bytes]
            else:
                data = bytes_at(path, file, HEADER_BYTES + page * frame_bytes, frame_bytes)
        return as_counts(np.frombuffer(data, counts).reshape(declared))

    return Recording(pages, declared, 8 * counts.itemsize, read_page)


def _unpacked(path: Path, file: BinaryIO, pages: int, frame_bytes: int) -> bytes:
    """Return the bytes of all frames, whose check sum tells damage."""
    (length,) = values_at(path, file, HEADER_BYTES, LENGTH)
    unpacking = zlib.decompressobj()
    try:
        # One byte more than there should be, and the check sum after it is looked at.
        data = unpacking.decompress(bytes_at(path, file, HEADER_BYTES + LENGTH_BYTES, length), pages * frame_bytes + 1)
    except zlib.error as error:
        raise InputError(f"{path}: cannot be unpacked: {reason(error)}: {CUT}") from error
    if len(data) != pages * frame_bytes or not unpacking.eof:
        raise InputError(f"{path}: does not unpack to {pages} frames of {frame_bytes} bytes: {CUT}")
    return data


SUFFIX = ".set"
IMAGE = re.compile(r"B(\d+)\.im7", re.IGNORECASE)
# A set's images count from 1; from 0 where a program other than DaVis wrote it.
FIRST = (0, 1)
# The text has some hundred characters, and no zero byte among these; archives and streams have them.
TEXT_BYTES = 4096
EXPORT_HINT = "save it from DaVis as a set of .im7 images, or as TIFF"


def set_frames(path: Path) -> Recording:
    """Return the frames of a set's images, in the order of their numbers.

    Raises
    ------
    InputError : the folder or one of the images is missing, or images differ in size
    """
    with opened(path) as text:
        if b"\0" in text.read(TEXT_BYTES):
            raise InputError(f"{path}: is no text beside a folder of images, as sets are: {EXPORT_HINT}")
    files = _images(path)
    found = [im7_frames(file) for file in files]
    for file, each in zip(files, found, strict=True):
        if each.shape != found[0].shape:
            raise InputError(f"{file}: has (rows, columns) {each.shape}, the first image of its set {found[0].shape}")
    ends = list(accumulate(each.pages for each in found))

    def read_page(page: int, shape: Shape | None) -> Image:
        number = bisect_right(ends, page)
        within = page - (ends[number - 1] if number else 0)
        # The header is read, too, so that an image that was written anew is not read by its old one.
        image = im7_frames(files[number])
        if within >= image.pages:
            raise InputError(f"{files[number]}: holds {image.pages} frames, fewer than when its set was looked through")
        return image.read_page(within, shape)

    return Recording(ends[-1], found[0].shape, max(each.bits for each in found), read_page)


def beside(path: Path) -> tuple[Path, ...]:
    """Return the folder of a set's images."""
    folder = path.with_suffix("")
    if not folder.is_dir():
        raise InputError(f"{path}: the folder of its images, {folder.name}, is not beside it")
    return (folder,)


def _images(path: Path) -> list[Path]:
    """Return the images of a set in order, after checking that none is missing."""
    (folder,) = beside(path)
    numbered = sorted(_numbered(folder))
    if not numbered:
        within = sorted(each for each in folder.iterdir() if each.is_dir() and any(_numbered(each)))
        kinds = Counter(each.suffix.lower() for each in folder.iterdir() if each.suffix)
        others = f", but {kinds.most_common(1)[0][0]} files" if kinds else ""
        instead = f"holds no images B00001.im7, B00002.im7, ...{others}: {EXPORT_HINT}"
        if within:
            instead = f"holds several sets: give one of these folders, as {within[0]}"
        raise InputError(f"{path}: its folder {folder} {instead}")
    if numbered[0][0] not in FIRST:
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
