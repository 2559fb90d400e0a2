"""Frames in the formats of any program, refused rather than guessed where anything is odd.

Greyscale TIFF has one frame a page, PNG one a file. HDF5 has a dataset (frames, rows, columns), named as FILE.h5:/PATH,
or the only one of three axes; a dataset `time_s` with a number for each frame beside it has their times.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import BinaryIO

import h5py
import imagecodecs
import numpy as np
import tifffile

from lfpiv_cli.errors import InputError, LfpivError
from lfpiv_cli.files import recording as recordings
from lfpiv_cli.files.hdf5 import items_in, member, open_h5
from lfpiv_cli.files.inputs import reason
from lfpiv_cli.files.recording import CUT, GREY_HINT, Image, Recording, Shape, as_counts, ensure_size

# Greyscale PNG: one frame a file.

PNG_START = b"\x89PNG\r\n\x1a\n"
# Samples of a pixel by a PNG's colour type, once decoded: grey, colour, palette, and with transparency.
PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
# Where the header's width, height and bit depth stand, in the part that comes first.
HEADER_AT, HEADER = 16, ">IIB"
# Four samples of two bytes, and as much again: what a file has beyond that, and what is said besides, is no image.
MOST_BYTES_A_PIXEL = 16


def png_frames(path: Path) -> Recording:
    """Return what a PNG file's header says; its check sums are left to the reading."""
    with open(path, "rb") as file:
        file.seek(HEADER_AT)
        header = file.read(struct.calcsize(HEADER))
    if len(header) < struct.calcsize(HEADER):
        raise InputError(f"{path}: its header ends after {HEADER_AT + len(header)} bytes: {CUT}")
    columns, rows, bits = struct.unpack(HEADER, header)
    return Recording(1, (rows, columns), bits, partial(_read_png, path))


def _read_png(path: Path, page: int, shape: Shape | None) -> Image:
    """Read a PNG file after checking its header and the check sums of all its parts."""
    with _naming(path):
        declared, size = png_frames(path).shape, path.stat().st_size
        ensure_size("the image", declared, 1, shape, size)
        if size > recordings.HARMLESS_BYTES + MOST_BYTES_A_PIXEL * math.prod(declared):
            raise InputError(f"has {size} bytes, more than a PNG of {declared[1]} x {declared[0]} pixels takes: {CUT}")
        content = path.read_bytes()
        # Kind and body of each part: all are there, and undamaged.
        parts, place, kind = list[tuple[bytes, bytes]](), len(PNG_START), b""
        while kind != b"IEND":
            kind, end = content[place + 4 : place + 8], place + 12 + int.from_bytes(content[place : place + 4], "big")
            if end > len(content):
                raise InputError(f"the part at byte {place} ends at byte {end} of {len(content)}: {CUT}")
            if zlib.crc32(content[place + 4 : end - 4]) != int.from_bytes(content[end - 4 : end], "big"):
                raise InputError(f"the part at byte {place} has a wrong check sum: {CUT}")
            parts.append((kind, content[place + 8 : end - 4]))
            place = end
        header = dict(parts).get(b"IHDR", b"")
        if len(header) != 13:
            raise InputError(f"its header has {len(header)} bytes, expected 13")
        columns, rows, bits, colour = struct.unpack_from(">IIBB", header)
        if colour not in PNG_SAMPLES:
            raise InputError(f"is a PNG of colour type {colour}: {GREY_HINT}")
        ensure_size("the image", (rows, columns), PNG_SAMPLES[colour] * (1 if bits <= 8 else 2), shape, len(content))

        # Packed data that are more than the pixels a decoder may unpack all the same. A byte for each line; interlaced
        # images have seven passes, the lines of each filled up.
        largest = rows * (columns * bits * PNG_SAMPLES[colour] // 8 + 2) + 7 * (2 * rows + columns)
        unpacker = zlib.decompressobj()
        for packed in (body for name, body in parts if name == b"IDAT"):
            largest -= len(unpacker.decompress(packed, largest + 1))
            if largest < 0 or unpacker.unconsumed_tail:
                raise InputError(f"its data are more than the {columns} x {rows} pixels that it declares")
        array = imagecodecs.png_decode(content)
        if array.shape[:2] != (rows, columns):
            raise InputError(f"decodes to {array.shape}, it declares {rows, columns}")
        return as_counts(recordings.one_channel(array, "the image"))


# A walk over a TIFF file's directories that takes nothing on trust.
#
# The decoding library stops at a broken directory and returns the pages before it; a count of pages that an
# experiment relies on must not shrink in silence. So the chain is followed here first, and every directory and tag
# value must lie inside the file. Header and entries as in the TIFF 6.0 and BigTIFF specifications.

# Bytes of one value of each tag type, TIFF 6.0 and BigTIFF.
TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
CLASSIC, BIG = 42, 43
# A camera's directory holds some 20 tags; the decoder gives up at 4096.
MOST_TAGS = 4096
# Ten hours at 25 frames a second; a chain of more is looked through for minutes.
MOST_PAGES = 1_000_000
# Width, height and where the data of strips or tiles lie: without them a directory is of no image.
SIZE_TAGS, DATA_TAGS = {256, 257}, {273, 324}


def directories(file: BinaryIO, size: int) -> list[int]:
    """Return where the directory of each page of a TIFF file begins, after checking that each lies inside the file.

    Parameters
    ----------
    file : open at any position
    size : its length in bytes

    Raises
    ------
    InputError : the chain leads outside the file or into a circle; the caller adds the file's name
    """
    file.seek(0)
    head = file.read(16)
    order = "<" if head[:2] == b"II" else ">"
    try:
        (magic,) = struct.unpack_from(order + "H", head, 2)
        big = magic == BIG
        (offset,) = struct.unpack_from(order + ("Q" if big else "I"), head, 8 if big else 4)
    except struct.error:
        raise InputError(f"its header has {len(head)} bytes: {CUT}") from None
    if magic not in (CLASSIC, BIG):
        raise InputError(f"its TIFF version is {magic}, expected {CLASSIC} or {BIG}")
    seen: dict[int, None] = {}
    while offset:
        if offset in seen:
            raise InputError(f"its directories form a circle after page {len(seen) - 1}")
        seen[offset] = None
        if len(seen) > MOST_PAGES:
            raise InputError(f"it holds more than {MOST_PAGES} pages")
        offset = _next_directory(file, size, offset, len(seen) - 1, order, big)
    if not seen:
        raise InputError("it holds no pages")
    return list(seen)


def _next_directory(file: BinaryIO, size: int, offset: int, page: int, order: str, big: bool) -> int:
    """Return where the directory after the one at `offset` lies, 0 after the last one."""
    count_format, pointer_format = ("Q", "Q") if big else ("H", "I")
    entry_bytes, inline_bytes = (20, 8) if big else (12, 4)
    file.seek(offset)
    head = file.read(struct.calcsize(count_format))
    if len(head) < struct.calcsize(count_format):
        raise InputError(f"the directory of page {page} lies at byte {offset} of {size}: {CUT}")
    (count,) = struct.unpack(order + count_format, head)
    if not 0 < count <= MOST_TAGS:
        raise InputError(f"the directory of page {page} has {count} entries, expected 1 to {MOST_TAGS}")
    length = count * entry_bytes + inline_bytes
    body = file.read(length)
    if len(body) < length:
        raise InputError(f"the directory of page {page} ends after {size} bytes: {CUT}")
    tags = set()
    for k in range(count):
        tag, kind, values = struct.unpack_from(order + "HH" + pointer_format, body, k * entry_bytes)
        tags.add(tag)
        bytes_used = values * TYPE_BYTES.get(kind, 1)
        if bytes_used > inline_bytes:
            (place,) = struct.unpack_from(order + pointer_format, body, (k + 1) * entry_bytes - inline_bytes)
            if place + bytes_used > size:
                raise InputError(f"tag {tag} of page {page} ends at byte {place + bytes_used} of {size}: {CUT}")
    if not tags >= SIZE_TAGS or not tags & DATA_TAGS:
        raise InputError(f"the directory of page {page} is of no image, it has the tags {sorted(tags)[:20]}: {CUT}")
    (following,) = struct.unpack_from(order + pointer_format, body, count * entry_bytes)
    return following


TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# Photometric interpretations: of a greyscale TIFF whose zeros are black, and of colours.
BLACK_IS_ZERO, RGB, PALETTE = 1, 2, 3
# TIFF's palettes hold 16-bit colours for indices of 8 bits.
PALETTE_SHIFT = 8
# Of the compressions, none.
NOT_PACKED = 1
# Compressions of faxes: CCITT's three, and the first of them with lines of whole words.
BLACK_AND_WHITE = (2, 3, 4, 32771)
# How a TIFF says that its channels lie apart.
SEPARATE = 2


def tiff_frames(path: Path) -> Recording:
    """Return the pages of a TIFF file whose directories are sound."""
    with _naming(path), open(path, "rb") as file:
        places = directories(file, path.stat().st_size)
        file.seek(0)
        with tifffile.TiffFile(file) as tiff:
            first, said = tiff.pages[0], 1
            # The writers' private ways of storing many frames behind one directory.
            if found := re.search(r"^images=(\d+)", first.description, re.MULTILINE):
                said = int(found.group(1))
            elif found := re.match(r'{"shape": \[([\d, ]+)\]', first.description):
                said = math.prod(int(n) for n in found.group(1).split(",")) // max(math.prod(first.shape), 1)
            if said > len(places):
                raise InputError(
                    f"holds {len(places)} pages and says {said} frames: save it as an ordinary multi-page TIFF"
                )
            bits = first.bitspersample if isinstance(first.bitspersample, int) else first.bitspersample[0]
            return Recording(
                len(places), (first.imagelength, first.imagewidth), bits, partial(_read_tiff, path, places)
            )


def _read_tiff(path: Path, places: Sequence[int], number: int, shape: Shape | None) -> Image:
    """Read the page whose directory lies at `places[number]`, after checking what it declares.

    The chain of directories is not walked again.
    """
    with _naming(path), open(path, "rb") as file, tifffile.TiffFile(file) as tiff:
        tiff.filehandle.seek(places[number])
        page = tifffile.TiffPage(tiff, number)
        has_palette = page.colormap is not None and page.samplesperpixel == 1 and page.dtype == np.uint8
        if page.photometric not in (BLACK_IS_ZERO, RGB, PALETTE) or (page.photometric == PALETTE) != has_palette:
            kind = getattr(page.photometric, "name", page.photometric)
            raise InputError(f"page {number} is {kind} with {page.samplesperpixel} samples per pixel: {GREY_HINT}")
        if page.dtype is None or page.dtype.kind not in "uif":
            raise InputError(f"page {number} has {page.bitspersample} bits per pixel of an unknown kind")
        if page.compression in BLACK_AND_WHITE:
            name = page.compression.name
            raise InputError(f"page {number} is packed as {name}, for black and white alone: {GREY_HINT}")
        size, declared = tiff.filehandle.size, (page.imagelength, page.imagewidth)
        ensure_size(f"page {number}", declared, page.dtype.itemsize * page.samplesperpixel, shape, size)
        # The decoder asks none of these: of a strip that is too short and not packed it takes the bytes after it as
        # pixels, and of one that is far too long it reads all.
        segments = math.prod(page.chunked)
        if not len(page.dataoffsets) == len(page.databytecounts) == segments:
            raise InputError(f"page {number} has {len(page.dataoffsets)} of its {segments} strips or tiles: {CUT}")
        for segment, (place, length) in enumerate(zip(page.dataoffsets, page.databytecounts, strict=True)):
            if length == 0 or place + length > size:
                raise InputError(f"the data of page {number} ends at byte {place + length} of {size}: {CUT}")
            rows, columns, *samples = page.chunks
            if not page.is_tiled:  # whose last ones are filled up, where the last strip is shorter
                rows = min(rows, page.imagelength - segment % -(-page.imagelength // rows) * rows)
            # Where it is not packed; each of its rows takes whole bytes.
            pixels = rows * -(-columns * math.prod(samples) * page.bitspersample // 8)
            least, most = pixels if page.compression == NOT_PACKED else 1, recordings.HARMLESS_BYTES + 2 * pixels
            if not least <= length <= most:
                raise InputError(
                    f"strip or tile {segment} of page {number} has {length} bytes, its pixels take {pixels}: {CUT}"
                )
        array = page.asarray(maxworkers=1)
        if page.samplesperpixel > 1 and page.planarconfig == SEPARATE:
            array = np.moveaxis(array, 0, -1)
        if array.shape[:2] != declared:
            raise InputError(f"page {number} decodes to {array.shape}, it declares {declared}")
        if page.colormap is not None:
            array = np.moveaxis(page.colormap[:, array] >> PALETTE_SHIFT, 0, -1)
        return as_counts(recordings.one_channel(array, f"page {number}"))


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file in what is raised.

    A damaged file can raise anything inside the decoders, so anything becomes an `InputError`.
    """
    token = recordings.reading.set(path)
    try:
        yield
    except LfpivError as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:
        raise InputError(f"{path}: cannot be decoded: {reason(error)}") from error
    finally:
        recordings.reading.reset(token)


# Datasets of HDF5.

HDF5_START = b"\x89HDF\r\n\x1a\n"
TIMES = "time_s"
# A chunk is unpacked whole for each frame in it; cameras' programs write a frame or a few in each.
MOST_CHUNK_BYTES = 2**28
# Names of datasets that an error lists.
MOST_LISTED = 5


def hdf5_frames(path: Path, name: str | None = None) -> Recording:
    """Return the frames of a dataset, of one with two dimensions the only frame; by default of the only one of three.

    Raises
    ------
    InputError : there is no such dataset, there are several, or it is a file of ours
    """
    with open_h5(path) as file:
        if name is not None:
            return _frames_in(path, _dataset(path, file, name))
        if "format" in file.attrs and "provenance" in file.attrs:
            raise InputError(f"{path}: is a result of this program, expected images")
        arrays = [item for item in items_in(file) if isinstance(item, h5py.Dataset) and item.dtype.kind in "uif"]
        names = [array.name for array in arrays if array.ndim == 3]
        if len(names) != 1:
            listed = ", ".join(f"{path.name}:{name}" for name in names[:MOST_LISTED])
            raise InputError(
                f"{path}: holds {len(names)} datasets of frames, expected one, or to be told which"
                + (f": {listed}" if names else "")
            )
        return _frames_in(path, file[names[0]])


def _dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Return a dataset by its path of hard links."""
    found: h5py.Group | h5py.Dataset = file
    for part in name.strip("/").split("/"):
        if not isinstance(found, h5py.Group) or part not in found:
            raise InputError(f"{path}: holds no dataset {name}")
        found = member(found, part)
    if not isinstance(found, h5py.Dataset):
        raise InputError(f"{path}: {name} is a group, expected a dataset of frames")
    return found


def _frames_in(path: Path, dataset: h5py.Dataset) -> Recording:
    """Return the frames of a dataset whose bytes are all in this very file, with the times beside it."""
    name = dataset.name
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{path}: {name} lies in another file")
    if dataset.shape is None or dataset.ndim not in (2, 3) or dataset.dtype.kind not in "uif" or not dataset.size:
        raise InputError(
            f"{path}: {name} is {dataset.dtype} {dataset.shape}, expected numbers of (frames, rows, columns)"
        )
    shape, item_bytes = (int(dataset.shape[-2]), int(dataset.shape[-1])), dataset.dtype.itemsize
    ensure_size(f"{path}: a frame of {name}", shape, item_bytes, None, path.stat().st_size)

    # Parts that were never written would be read as zeros.
    if dataset.chunks is None:
        stored = dataset.id.get_storage_size()
        if stored < dataset.size * item_bytes:
            raise InputError(f"{path}: {name} has {stored} of its {dataset.size * item_bytes} bytes: {CUT}")
    else:
        if math.prod(dataset.chunks) * item_bytes > MOST_CHUNK_BYTES:
            raise InputError(f"{path}: {name} has chunks of {dataset.chunks}, more than {MOST_CHUNK_BYTES} bytes each")
        expected = math.prod(-(-n // c) for n, c in zip(dataset.shape, dataset.chunks, strict=True))
        found = dataset.id.get_num_chunks()
        if found != expected:
            raise InputError(f"{path}: {name} has {found} of its {expected} chunks: {CUT}")

    pages, time_s = int(dataset.shape[0]) if dataset.ndim == 3 else 1, None
    times = member(dataset.parent, TIMES) if TIMES in dataset.parent else None
    if isinstance(times, h5py.Dataset) and times.shape == (pages,) and times.dtype.kind in "uif":
        reported = np.asarray(times[()], np.float64)
        time_s = reported if np.isfinite(reported).all() else None
    return Recording(pages, shape, 8 * item_bytes, partial(_read_dataset, path, name), time_s)


def _read_dataset(path: Path, name: str, page: int, shape: Shape | None) -> Image:
    with open_h5(path) as file:
        dataset = _dataset(path, file, name)
        ensure_size(f"{path}: frame {page}", dataset.shape[-2:], dataset.dtype.itemsize, shape, path.stat().st_size)
        return as_counts(dataset[page] if dataset.ndim == 3 else dataset[()])
