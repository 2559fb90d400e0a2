"""Recordings of cameras' own programs: Phantom's .cine, Norpix' .seq, Photron's .mraw, LaVision's .im7 and .set.

Cine: headers, a table of times, a table of places, and frames with bottom rows first.

Structures and offsets as in Vision Research's description of the format. Counts are given as stored, neither flipped
for display nor stretched between black and white levels.
"""

from __future__ import annotations

import re
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import accumulate, pairwise
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import recording as recordings
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, opened, reading_from, reason
from lfpiv_cli.files.recording import CUT, Image, Pixels, Recording, Shape, ensure_size, values_at

# Photron's .mraw: frames one after the other, and a header in a file beside it, .cihx (XML) or .cih (text).

MRAW_SUFFIX = ".mraw"
# Where the figures stand: the words of a .cih, and the elements of a .cihx.
NAMES = {
    "pages": ("Total Frame", "frameInfo/totalFrame"),
    "columns": ("Image Width", "imageDataInfo/resolution/width"),
    "rows": ("Image Height", "imageDataInfo/resolution/height"),
    "bits": ("Color Bit", "imageDataInfo/colorInfo/bit"),
    "colour": ("Color Type", "imageDataInfo/colorInfo/type"),
    "rate": ("Record Rate(fps)", "recordInfo/recordRate"),
    "step": ("Save Step", "frameInfo/skipFrame"),
}
STORED_BITS = (8, 16, *recordings.PACKED_BITS)
MONO = "mono"
# A header has some thousand characters; one that is larger is none.
MOST_HEADER_BYTES = 2**20


def mraw_frames(path: Path) -> Recording:
    """Return the frames that the header beside a file describes, timed by its rate."""
    (header,) = header_beside(path)
    if ensure_regular_file(header) > MOST_HEADER_BYTES:
        raise InputError(f"{header}: has more than {MOST_HEADER_BYTES} bytes, and is no header of frames")
    content = content_of(header)
    if header.suffix.lower() == ".cih":
        lines = (line.split(" : ", 1) for line in content.decode("latin-1").splitlines())
        words = {line[0].strip(): line[1].strip() for line in lines if len(line) == 2}
        reported = {name: words.get(word) for name, (word, _) in NAMES.items()}
    else:
        # The XML lies between bytes of the camera's own, without what could declare entities.
        inside = re.search(rb"<cih>.*</cih>", content, re.DOTALL)
        if inside is None:
            raise InputError(f"{header}: holds no <cih> … </cih>: {CUT}")
        try:
            tree = ElementTree.fromstring(inside.group().decode("utf-8", errors="replace"))
        except (ElementTree.ParseError, ValueError) as error:
            raise InputError(f"{header}: is not XML: {reason(error)}") from error
        reported = {name: tree.findtext(place) for name, (_, place) in NAMES.items()}
    found = {name: text.strip() for name, text in reported.items() if text is not None}

    colour = found.get("colour", MONO).lower()
    if colour != MONO:
        raise InputError(f"{header}: describes {colour} images: {recordings.COLOUR_HINT}")
    for name in ("pages", "columns", "rows", "bits"):
        text = found.get(name)
        if text is None or re.fullmatch(r"[1-9]\d{0,8}", text) is None:
            raise InputError(f"{header}: {NAMES[name][0]} is {text}, expected a positive number")
    pages, columns, rows, bits = (int(found[name]) for name in ("pages", "columns", "rows", "bits"))
    if bits not in STORED_BITS:
        raise InputError(f"{header}: {NAMES['bits'][0]} is {bits}, expected one of {sorted(STORED_BITS)}")
    pixels = Pixels((rows, columns), bits, "high-first" if bits in recordings.PACKED_BITS else "whole")
    rate_hz = 0.0
    with suppress(ValueError, ZeroDivisionError):
        # The camera's, or one in so many where it left some out.
        rate_hz = float(found.get("rate", "0")) / float(found.get("step", "1"))
    places = range(0, pages * pixels.frame_bytes, pixels.frame_bytes)
    return recordings.recording(path, places, pixels, recordings.at_rate(pages, rate_hz))


def header_beside(path: Path) -> tuple[Path, ...]:
    """Return the header of a file, which the counts depend on as on the file itself: its name with another ending."""
    for suffix in (".cihx", ".cih", ".CIHX", ".CIH"):
        header = path.with_suffix(suffix)
        if header.exists():
            return (header,)
    raise InputError(f"{path}: its header {path.with_suffix('.cihx').name} or .cih is not beside it")


# Norpix' .seq: a header of 1024 or 8192 bytes, then frames, each followed by its time.
#
# Offsets as in the format's description, which StreamPix' manual has.

SEQ_START = b"\xed\xfe\0\0"
# Version, at byte 28; from 5 on the header has 8192 bytes whatever it says, and times have microseconds.
VERSION_AT, LONG_HEADER_VERSION = 28, 5
SHORT_HEADER, LONG_HEADER = 1024, 8192
# Width, height, bits of a pixel in the file and of these those that are used, bytes of a frame, format, number of
# frames, origin, bytes from one frame to the next.
FRAME_AT, FRAME = 548, "<9I"
COMPRESSION_AT = 620
MONOCHROME, RAW_BAYER = 100, 101
# Seconds, milliseconds, microseconds.
TIME = np.dtype([("s", "<u4"), ("ms", "<u2"), ("us", "<u2")])


def seq_frames(path: Path) -> Recording:
    """Return the frames of a sequence that is not compressed, and their times."""
    with opened(path) as file:
        (version,) = values_at(path, file, VERSION_AT, "<i")
        columns, rows, stored, used, frame_bytes, kind, pages, _, step = values_at(path, file, FRAME_AT, FRAME)
        (compression,) = values_at(path, file, COMPRESSION_AT, "<I")
        if compression:
            raise InputError(f"{path}: its frames are compressed (kind {compression}): save it without compression")
        if kind != MONOCHROME:
            what = "raw Bayer" if kind == RAW_BAYER else f"of kind {kind}"
            raise InputError(
                f"{path}: its frames are {what}, expected monochrome ({MONOCHROME}): {recordings.COLOUR_HINT}"
            )
        if stored not in (8, 16) or not 0 < used <= stored:
            raise InputError(f"{path}: has {used} bits in {stored} a pixel, expected them in 8 or 16")
        ensure_size(f"{path}: a frame", (rows, columns), stored // 8, None, path.stat().st_size)
        pixels = Pixels((rows, columns), stored)
        if frame_bytes != pixels.frame_bytes or step < frame_bytes + TIME.itemsize:
            raise InputError(
                f"{path}: declares frames of {frame_bytes} bytes every {step} bytes, expected {pixels.frame_bytes} for "
                f"{columns} x {rows} pixels, and {TIME.itemsize} for a time"
            )
        first = LONG_HEADER if version >= LONG_HEADER_VERSION else SHORT_HEADER
        places = range(first, first + pages * step, step)
        found, size = recordings.recording(path, places, pixels), file.seek(0, 2)
        stamps = np.empty(len(places), TIME)
        for page, place in enumerate(places):
            if place + frame_bytes + TIME.itemsize > size:
                raise InputError(f"{path}: ends before the time of frame {page}: {CUT}")
            file.seek(place + frame_bytes)
            stamps[page] = np.frombuffer(file.read(TIME.itemsize), TIME)[0]
    if version < LONG_HEADER_VERSION:
        stamps["us"] = 0
    ticks = stamps["s"].astype(np.int64) * 1_000_000 + stamps["ms"].astype(np.int64) * 1000 + stamps["us"]
    return Recording(pages, found.shape, used, found.read_page, (ticks - ticks[0]) / 1e6)


CINE_START = b"CI"
# CINEFILEHEADER: type, its length, compression, version, numbers of images at the camera, of these in the file, and
# where the next structures lie.
FILE_HEADER = "<2s3HiIiI3I"
NOT_INTERPOLATED = 2
# BITMAPINFOHEADER up to the bytes of a frame.
BITMAP = "<I2i2H2I"
WHOLE, PACKED_10, PACKED_12 = 0, 256, 1024
# SETUP: mark and length, frames a second, colour filters, bits of a pixel that are used, by their places in it.
SETUP_MARK_AT, SETUP_MARK = 140, b"ST"
RATE_AT, FILTERS_AT, USED_BITS_AT = 768, 808, 896
# Blocks after it: length, kind, reserved; one of them holds a time for each frame.
BLOCK, TIMES = "<I2H", 1002
# Cameras write some ten of them.
MOST_BLOCKS = 100
BLOCK_BYTES = 8
# Times count 2^-32 s; the lowest two bits are flags.
FLAG_BITS = 2
TICKS_PER_S = 2.0 ** (32 - FLAG_BITS)
# Each frame begins with notes, whose last four bytes are the frame's own length.
SHORTEST_NOTES = 8
ROW_MULTIPLE = 4
LINEAR_BITS = 12


def cine_frames(path: Path) -> Recording:
    """Return the frames of a recording of a monochrome camera, and their times."""
    with opened(path) as file:
        header = values_at(path, file, 0, FILE_HEADER)
        _, _, compression, version, _, _, _, pages, bitmap_at, setup_at, places_at = header
        if compression not in (0, NOT_INTERPOLATED) or version not in (0, 1):
            raise InputError(
                f"{path}: is a cine of compression {compression} and version {version}: save it as a raw cine"
            )
        (filters,) = values_at(path, file, setup_at + FILTERS_AT, "<I")
        if compression == NOT_INTERPOLATED and filters:
            raise InputError(f"{path}: holds {recordings.COLOUR_HINT}")
        kind = np.dtype("<i8" if version else "<u4")
        if not pages:
            raise InputError(f"{path}: it holds no frames")
        places = np.frombuffer(recordings.bytes_at(path, file, places_at, pages * kind.itemsize), kind).astype(np.int64)
        pixels, used = _pixels(path, file, bitmap_at, setup_at)
        ensure_size(f"{path}: a frame", pixels.shape, 1, None, path.stat().st_size)
        times = _times(path, file, setup_at, places_at, pages)

    def begin(file: BinaryIO, place: int) -> int:
        (notes_bytes,) = values_at(path, file, place, "<I")
        if notes_bytes < SHORTEST_NOTES:
            raise InputError(f"{path}: the notes of the frame at byte {place} have {notes_bytes} bytes: {CUT}")
        (declared,) = values_at(path, file, place + notes_bytes - 4, "<I")
        if declared != pixels.frame_bytes:
            raise InputError(
                f"{path}: the frame at byte {place} declares {declared} bytes, expected {pixels.frame_bytes}: {CUT}"
            )
        return place + notes_bytes

    found = recordings.recording(path, places, pixels, begin=begin)
    return Recording(pages, found.shape, used, found.read_page, times)


def _pixels(path: Path, file: BinaryIO, bitmap_at: int, setup_at: int) -> tuple[Pixels, int]:
    """Return how pixels are stored, and how many of their bits are used.

    Raises
    ------
    UsageError : they are packed to 10 bits, and the library that has the manufacturer's table is missing
    """
    _, columns, height, _, stored, packing, frame_bytes = values_at(path, file, bitmap_at, BITMAP)
    (mark,) = values_at(path, file, setup_at + SETUP_MARK_AT, "<2s")
    if mark != SETUP_MARK:
        raise InputError(f"{path}: has no SETUP at byte {setup_at}: {CUT}")
    (used,) = values_at(path, file, setup_at + USED_BITS_AT, "<I")
    shape = (abs(height), columns)
    if columns <= 0 or height == 0:
        raise InputError(f"{path}: declares frames of {columns} x {height} pixels (columns x rows)")
    if packing == PACKED_10:
        try:
            from cine_reader.unpack import unpack_10bit_numpy
        except ImportError:
            raise UsageError(f'{path}: is packed to 10 bits: pip install "lfpiv[cameras]"') from None
        # The count, linear in the light, of each of 1024 codes, four in five bytes, by the library's unpacking.
        codes = "".join(f"{code:010b}" for code in range(1024))
        table = unpack_10bit_numpy(int(codes, 2).to_bytes(len(codes) // 8, "big"))
        pixels, used = Pixels(shape, 10, "high-first", table=table), LINEAR_BITS
    elif packing == PACKED_12:
        pixels = Pixels(shape, 12, "high-first")
    elif packing == WHOLE and stored in (8, 16):
        padded = Pixels(shape, stored, row_multiple=ROW_MULTIPLE, bottom_up=height > 0)
        tight = Pixels(shape, stored, bottom_up=height > 0)
        pixels = padded if frame_bytes == padded.frame_bytes else tight
    else:
        raise InputError(f"{path}: has {stored} bits a pixel, packed by kind {packing}: {recordings.COLOUR_HINT}")
    if frame_bytes != pixels.frame_bytes:
        raise InputError(f"{path}: declares {frame_bytes} bytes a frame, expected {pixels.frame_bytes}")
    return pixels, used if 0 < used <= pixels.bits or packing == PACKED_10 else pixels.bits


def _times(path: Path, file: BinaryIO, setup_at: int, places_at: int, pages: int) -> NDArray[np.float64] | None:
    """Return the times of the frames, in s from the first one's; without a table of times, by the frame rate."""
    (length,) = values_at(path, file, setup_at + SETUP_MARK_AT + 2, "<H")
    place = setup_at + length
    for _ in range(MOST_BLOCKS):
        if not setup_at < place < places_at:
            break
        block_bytes, kind, _ = values_at(path, file, place, BLOCK)
        if kind == TIMES:
            ticks = np.frombuffer(recordings.bytes_at(path, file, place + BLOCK_BYTES, 8 * pages), "<u8")
            exact = ticks >> np.uint64(FLAG_BITS)
            return (exact.astype(np.int64) - int(exact[0])) / TICKS_PER_S
        if block_bytes < BLOCK_BYTES:
            break
        place += block_bytes
    (rate_hz,) = values_at(path, file, setup_at + RATE_AT, "<I")
    return recordings.at_rate(pages, rate_hz)


# LaVision DaVis' .im7: the frames of one recording, one below the other, as they are or packed by zlib.
#
# Header as the manufacturer published it (ReadIM7). Counts are those that are stored, without the scale that DaVis
# shows.

# Version, packing, format, sparse; columns, rows, planes, frames.
IM7_HEADER, IM7_HEADER_BYTES = "<4h4i", 256
# Kinds of counts by the format of images; positive ones are of vectors.
KINDS = {-3: "<f4", -4: "<u2", -5: "<f8"}
NOT_PACKED, ZLIB = 0, 2
# The number of packed bytes, before these.
PACKED_LENGTH, PACKED_LENGTH_BYTES = "<I", 4
PACKED_HINT = "save it from DaVis without compression, or as TIFF"


def im7_frames(path: Path) -> Recording:
    """Return the frames that a header declares, after checking that their bytes are there."""
    with opened(path) as file:
        size = file.seek(0, 2)
        _, packing, kind, _, columns, rows, planes, pages = values_at(path, file, 0, IM7_HEADER)
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
            stored = PACKED_LENGTH_BYTES + values_at(path, file, IM7_HEADER_BYTES, PACKED_LENGTH)[0]
        if IM7_HEADER_BYTES + stored > size:
            raise InputError(
                f"{path}: declares {pages} frames that end at byte {IM7_HEADER_BYTES + stored} of {size}: {CUT}"
            )

    def read_page(page: int, shape: Shape | None) -> Image:
        with opened(path) as file:
            ensure_size(f"{path}: frame {page}", declared, 1, shape, file.seek(0, 2))
            if packing == NOT_PACKED:
                data = recordings.bytes_at(path, file, IM7_HEADER_BYTES + page * frame_bytes, frame_bytes)
            else:
                # All frames, whose check sum tells damage: one byte more than there should be shows that it is there.
                (length,) = values_at(path, file, IM7_HEADER_BYTES, PACKED_LENGTH)
                packed = recordings.bytes_at(path, file, IM7_HEADER_BYTES + PACKED_LENGTH_BYTES, length)
                unpacking = zlib.decompressobj()
                try:
                    whole = unpacking.decompress(packed, pages * frame_bytes + 1)
                except zlib.error as error:
                    raise InputError(f"{path}: cannot be unpacked: {reason(error)}: {CUT}") from error
                if len(whole) != pages * frame_bytes or not unpacking.eof:
                    raise InputError(f"{path}: does not unpack to {pages} frames of {frame_bytes} bytes: {CUT}")
                data = whole[page * frame_bytes : (page + 1) * frame_bytes]
        return recordings.as_counts(np.frombuffer(data, counts).reshape(declared))

    return Recording(pages, declared, 8 * counts.itemsize, read_page)


# The .set: a text, and beside it a folder of its name with the set's images B00001.im7, B00002.im7, ... The text tells
# how DaVis shows the set; which images there are, the folder tells. Its frames are those of one image after those of
# the one before.

SET_SUFFIX = ".set"
SET_IMAGE = re.compile(r"B(\d+)\.im7", re.IGNORECASE)
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
    (folder,) = folder_beside(path)
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

    files = [file for _, file in numbered]
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


def folder_beside(path: Path) -> tuple[Path, ...]:
    """Return the folder of a set's images."""
    folder = path.with_suffix("")
    if not folder.is_dir():
        raise InputError(f"{path}: the folder of its images, {folder.name}, is not beside it")
    return (folder,)


def _numbered(folder: Path) -> Iterator[tuple[int, Path]]:
    """Yield the images in a folder with their numbers."""
    with reading_from(folder):
        for file in folder.iterdir():
            if found := SET_IMAGE.fullmatch(file.name):
                yield int(found[1]), file
