"""Greyscale PNG: one frame a file."""

from __future__ import annotations

import math
import struct
import zlib
from functools import partial
from pathlib import Path

import imagecodecs

from lfpiv_cli.errors import InputError, LfpivError
from lfpiv_cli.files.inputs import reason
from lfpiv_cli.files.recordings.pixels import CUT, GREY_HINT, HARMLESS_BYTES, as_counts, ensure_size, one_channel
from lfpiv_cli.files.recordings.recording import Image, Recording, Shape

START = b"\x89PNG\r\n\x1a\n"
# Samples of a pixel by a PNG's colour type, once decoded: grey, colour, palette, and with transparency.
PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
# Where the header's width, height and bit depth stand, in the part that comes first.
HEADER_AT, HEADER = 16, ">IIB"
# Four samples of two bytes, and as much again: what a file has beyond that, and what is said besides, is no image.
MOST_BYTES_A_PIXEL = 16


def frames(path: Path) -> Recording:
    """Return what a PNG file's header says; its check sums are left to the reading.

    Raises
    ------
    InputError
    """
    with open(path, "rb") as file:
        file.seek(HEADER_AT)
        header = file.read(struct.calcsize(HEADER))
    if len(header) < struct.calcsize(HEADER):
        raise InputError(f"{path}: its header ends after {HEADER_AT + len(header)} bytes: {CUT}")
    columns, rows, bits = struct.unpack(HEADER, header)
    return Recording(1, (rows, columns), bits, partial(_read_page, path))


def _read_page(path: Path, page: int, shape: Shape | None) -> Image:
    """Read a PNG file after checking its header and the check sums of all its parts."""
    try:
        declared, size = frames(path).shape, path.stat().st_size
        ensure_size("the image", declared, 1, shape, size)
        if size > HARMLESS_BYTES + MOST_BYTES_A_PIXEL * math.prod(declared):
            raise InputError(f"has {size} bytes, more than a PNG of {declared[1]} x {declared[0]} pixels takes: {CUT}")
        content = path.read_bytes()
        columns, rows, bits, colour = _png_header(content)
        if colour not in PNG_SAMPLES:
            raise InputError(f"is a PNG of colour type {colour}: {GREY_HINT}")
        ensure_size("the image", (rows, columns), PNG_SAMPLES[colour] * (1 if bits <= 8 else 2), shape, len(content))
        _ensure_pixels(content, rows, columns, bits * PNG_SAMPLES[colour])
        array = imagecodecs.png_decode(content)
        if array.shape[:2] != (rows, columns):
            raise InputError(f"decodes to {array.shape}, it declares {rows, columns}")
        return as_counts(one_channel(array, "the image"))
    except LfpivError as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:  # a damaged file can raise anything inside the decoder
        raise InputError(f"{path}: cannot be decoded: {reason(error)}") from error


def _ensure_pixels(content: bytes, rows: int, columns: int, bits: int) -> None:
    """Refuse packed data that are more than the declared pixels, which a decoder may unpack all the same.

    Parameters
    ----------
    bits : of a pixel, at most
    """
    # A byte for each line; interlaced images have seven passes, the lines of each filled up.
    largest = rows * (columns * bits // 8 + 2) + 7 * (2 * rows + columns)
    unpacker, place = zlib.decompressobj(), len(START)
    while place < len(content):
        length = int.from_bytes(content[place : place + 4], "big")
        if content[place + 4 : place + 8] == b"IDAT":
            largest -= len(unpacker.decompress(content[place + 8 : place + 8 + length], largest + 1))
            if largest < 0 or unpacker.unconsumed_tail:
                raise InputError(f"its data are more than the {columns} x {rows} pixels that it declares")
        place += 12 + length


def _png_header(content: bytes) -> tuple[int, int, int, int]:
    """Return width, height, bit depth and colour type of a PNG whose parts are all there and undamaged."""
    place = len(START)
    header = b""
    while True:
        length = int.from_bytes(content[place : place + 4], "big")
        kind = content[place + 4 : place + 8]
        end = place + 12 + length
        if end > len(content):
            raise InputError(f"the part at byte {place} ends at byte {end} of {len(content)}: {CUT}")
        if zlib.crc32(content[place + 4 : end - 4]) != int.from_bytes(content[end - 4 : end], "big"):
            raise InputError(f"the part at byte {place} has a wrong check sum: {CUT}")
        if kind == b"IHDR":
            header = content[place + 8 : end - 4]
        if kind == b"IEND":
            break
        place = end
    if len(header) != 13:
        raise InputError(f"its header has {len(header)} bytes, expected 13")
    return int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big"), header[8], header[9]
