"""A file of frames, whatever its format: how many, how large, when each was taken, and how one is read.

Where frames lie at known places, each in as many bytes as the next, all of that is here; so is the layout that is
stated of frames without a header.
"""

from __future__ import annotations

import logging
import math
import re
import struct
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.inputs import opened, split_page, split_part
from lfpiv_cli.notice import LfpivWarning, Notice

# What the decoders of images complain of, kept until the command reports it: formats without check sums have no more.

# Of a damaged file there can be one for each page.
MOST_KEPT = 20

# The file that is read.
reading: ContextVar[Path | None] = ContextVar("reading", default=None)
# None outside of a command: complaints are Python warnings there.
_kept: list[Notice] | None = None


class _Keeper(logging.Handler):
    """Keeps what a decoder logs."""

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message, each once, or warn of it."""
        path = reading.get()
        notice = Notice(
            "decoder-complains",
            "an image" if path is None else path.name,
            f"the decoder says: {record.getMessage().splitlines()[0]}",
            "compare the file with the camera's; --verify SHA256SUMS does",
        )
        if _kept is None:
            warnings.warn(LfpivWarning(notice), stacklevel=2)
        elif len(_kept) < MOST_KEPT and notice not in _kept:
            _kept.append(notice)


# In place of printing it.
_logger = logging.getLogger("tifffile")
_logger.addHandler(_Keeper(logging.WARNING))
_logger.propagate = False


@contextmanager
def complaints_kept() -> Iterator[list[Notice]]:
    """Hold a list of what is complained of meanwhile."""
    global _kept
    kept: list[Notice] = []
    _kept = kept
    try:
        yield kept
    finally:
        _kept = None


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


# What all formats ask of a frame's declared size, and of channels that should be one.

# Numbers of samples of which the last is the transparency.
TRANSPARENT_SAMPLES = (2, 4)
# The largest sensor sold has 151 million pixels; a header that declares more is wrong or hostile.
MOST_PIXELS = 160_000_000
# Without a sensor size to compare with, a header may declare this much whatever the file's size ...
HARMLESS_BYTES = 64 * 2**20
# ... and beyond it no more than deflate could have packed into the file.
LARGEST_RATIO = 1100
GREY_HINT = "save the sensor's raw image as greyscale"
CUT = "the file is cut off or damaged"


def ensure_size(what: str, declared: Shape, item_bytes: int, shape: Shape | None, file_bytes: int) -> None:
    """Refuse a declared size that is not the sensor's, or that nothing could have."""
    rows, columns = declared
    if shape is not None and declared != shape:
        raise InputError(
            f"{what} is {columns} x {rows} pixels (columns x rows), expected the sensor's {shape[1]} x {shape[0]}"
        )
    pixels = rows * columns
    if not 0 < pixels <= MOST_PIXELS:
        raise InputError(f"{what} declares {columns} x {rows} pixels, expected at most {MOST_PIXELS} in all")
    if pixels * item_bytes > max(HARMLESS_BYTES, LARGEST_RATIO * file_bytes):
        raise InputError(f"{what} declares {columns} x {rows} pixels, more than {file_bytes} bytes can hold")


def one_channel(array: NDArray[Any], what: str) -> NDArray[Any]:
    """Return the channel that all channels of an image (rows, columns[, samples]) are alike.

    A last one of two or four is how transparent pixels are; it must be the same everywhere.
    """
    if array.ndim == 2:
        return array
    samples = array.shape[2]
    colours = array[..., : samples - (samples in TRANSPARENT_SAMPLES)]
    first = np.broadcast_to(colours[..., :1], colours.shape)
    if not np.array_equal(colours, first, equal_nan=colours.dtype.kind == "f"):
        raise InputError(f"{what} is in colour, its {colours.shape[2]} channels differ: {GREY_HINT}")
    if samples in TRANSPARENT_SAMPLES and np.ptp(array[..., -1]) != 0:
        raise InputError(f"{what} has pixels of different transparency: {GREY_HINT}")
    return array[..., 0]


def as_counts(array: NDArray[Any]) -> Image:
    """Return an image as float32; what exceeds its range becomes infinite and is flagged with the saturated."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32)


# The green of a sensor behind colour filters.

# Colours of the filters over the first two pixels of the first row, and of the second.
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
COLOUR_HINT = (
    "the frames of a colour sensor; save them without a header and state the layout with its pattern, "
    "as in frames.raw:1280x800x16:bayer=RGGB, to read their green"
)


def green_of(mosaic: Image, pattern: str) -> Image:
    """Return what a sensor sees in green: half of its pixels as they are, the others by the mean of those beside.

    A pixel behind a red or blue filter has green ones above, below, left and right; at the rim two or three of them.
    """
    rows, columns = mosaic.shape
    cell = np.array([colour == "G" for colour in pattern]).reshape(2, 2)
    green = np.tile(cell, (rows // 2 + 1, columns // 2 + 1))[:rows, :columns]
    seen = np.pad(np.where(green, mosaic, np.float32(0.0)), 1)
    there = np.pad(green.astype(np.float32), 1)
    total, count = (a[:-2, 1:-1] + a[2:, 1:-1] + a[1:-1, :-2] + a[1:-1, 2:] for a in (seen, there))
    return np.where(green, mosaic, total / np.maximum(count, 1.0)).astype(np.float32)


# How pixels lie in the bytes of a frame that is not compressed.

# `whole`: a pixel in one byte, or in two where it has more than 8 bits. The others leave no bit between pixels: the
# first pixel in the highest bits of the first byte (Photron, Phantom), or in the lowest (GenICam's Mono10p, Mono12p);
# `gige` has the high bits of two pixels in the first and third of three bytes, and the low ones between them (GigE
# Vision's Mono10Packed and Mono12Packed).
Packing = Literal["whole", "high-first", "low-first", "gige"]
# Bits of a pixel that can be packed: with more, a pixel could touch three bytes.
PACKED_BITS = (10, 12)
# The largest pixel that is stored.
MOST_BITS = 16


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of a frame as they are stored.

    Attributes
    ----------
    shape : (rows, columns)
    bits : of a pixel, 1 to 16
    big_endian : whether the higher of two bytes is first
    row_multiple : bytes of which each row takes a multiple, where pixels are `whole`
    bottom_up : whether the last row comes first
    table : count of each stored number, where the numbers are no counts
    bayer : pattern of the colour filters, of which green is taken, see `green_of`; None without filters
    """

    shape: Shape
    bits: int
    packing: Packing = "whole"
    big_endian: bool = False
    row_multiple: int = 1
    bottom_up: bool = False
    table: NDArray[np.uint16] | None = None
    bayer: str | None = None

    @property
    def frame_bytes(self) -> int:
        """Bytes that a frame takes."""
        rows, columns = self.shape
        if self.packing == "whole":
            return rows * self._row_bytes
        if self.packing == "gige":
            return 3 * math.ceil(rows * columns / 2)
        return math.ceil(rows * columns * self.bits / 8)

    def decode(self, data: bytes) -> Image:
        """Return a frame of `frame_bytes` bytes as an image (rows, columns) in counts."""
        (rows, columns), stored = self.shape, np.frombuffer(data, np.uint8)
        if self.packing == "whole":
            kind = np.dtype(np.uint8 if self.bits <= 8 else ">u2" if self.big_endian else "<u2")
            lines = stored.reshape(rows, self._row_bytes)[:, : columns * kind.itemsize]
            image = np.ascontiguousarray(lines).view(kind)
        else:
            if self.packing == "gige":
                first, low, second = stored.reshape(-1, 3).astype(np.uint16).T
                kept, mask = self.bits - 8, (1 << (self.bits - 8)) - 1
                pixels = np.stack([first << kept | low & mask, second << kept | low >> 4 & mask], axis=1).reshape(-1)
            else:
                pixels = unpack(stored, self.bits, high_first=self.packing == "high-first")
            image = pixels[: rows * columns].reshape(self.shape)
        if self.table is not None:
            image = self.table[image]
        counts = (image[::-1] if self.bottom_up else image).astype(np.float32)
        return counts if self.bayer is None else green_of(counts, self.bayer)

    @property
    def _row_bytes(self) -> int:
        written = self.shape[1] * (1 if self.bits <= 8 else 2)
        return math.ceil(written / self.row_multiple) * self.row_multiple


def unpack(packed: NDArray[np.uint8], bits: int, high_first: bool) -> NDArray[np.uint16]:
    """Return the pixels of `bits` bits each, one of `PACKED_BITS`, that lie in bytes without a gap, and what is left.

    A group of pixels that ends with a byte is the unit: all first pixels are taken at once, then all second ones.

    Parameters
    ----------
    packed : bytes of whole groups, or of a last one that is cut after a pixel
    high_first : whether the first pixel is in the highest bits of the first byte, or in the lowest
    """
    group_bytes = math.lcm(bits, 8) // 8
    groups = np.zeros((math.ceil(packed.size / group_bytes), group_bytes), np.uint16)
    groups.reshape(-1)[: packed.size] = packed
    pixels = np.empty((len(groups), group_bytes * 8 // bits), np.uint16)
    for number in range(pixels.shape[1]):
        byte, skipped = divmod(number * bits, 8)
        first, second = groups[:, byte], groups[:, byte + 1]
        if high_first:
            pixels[:, number] = (first << 8 | second) >> (16 - skipped - bits)
        else:
            pixels[:, number] = (second << 8 | first) >> skipped
    pixels &= (1 << bits) - 1
    return pixels.reshape(-1)


def values_at(path: Path, file: BinaryIO, place: int, layout: str) -> tuple[Any, ...]:
    """Return the values at a place of a file, laid out as `struct` says.

    Raises
    ------
    InputError : the file ends before
    """
    return struct.unpack(layout, bytes_at(path, file, place, struct.calcsize(layout)))


def bytes_at(path: Path, file: BinaryIO, place: int, length: int) -> bytes:
    """Return `length` bytes at a place of a file; see `values_at`."""
    size = file.seek(0, 2)
    if not 0 <= place <= place + length <= size:
        raise InputError(f"{path}: holds {size} bytes, and what it declares ends at byte {place + length}: {CUT}")
    file.seek(place)
    found = file.read(length)
    if len(found) < length:
        raise InputError(f"{path}: ended while it was read: {CUT}")
    return found


def recording(
    path: Path,
    places: Sequence[int] | NDArray[np.int64],
    pixels: Pixels,
    time_s: NDArray[np.float64] | None = None,
    begin: Callable[[BinaryIO, int], int] | None = None,
) -> Recording:
    """Return a recording whose frame k lies at byte `places[k]`, after checking that all end inside the file.

    Parameters
    ----------
    begin : tells where the pixels of the frame at a place begin, where that is not the place itself
    """
    size = path.stat().st_size
    if not len(places):
        raise InputError(f"{path}: it holds no frames")
    ensure_size(f"{path}: a frame", pixels.shape, 1, None, size)
    ends = (places[0], places[-1]) if isinstance(places, range) else (int(np.min(places)), int(np.max(places)))
    last = max(ends)
    if begin is not None and 0 <= last < size:
        with open(path, "rb") as file:
            last = begin(file, last)
    if min(ends) < 0 or last + pixels.frame_bytes > size:
        raise InputError(
            f"{path}: declares {len(places)} frames of {pixels.frame_bytes} bytes, of which the last ends at byte "
            f"{last + pixels.frame_bytes} of {size}: {CUT}"
        )

    def read_page(page: int, shape: Shape | None) -> Image:
        with opened(path) as file:
            ensure_size(f"{path}: frame {page}", pixels.shape, 1, shape, file.seek(0, 2))
            place = int(places[page])
            data = bytes_at(path, file, begin(file, place) if begin else place, pixels.frame_bytes)
        return pixels.decode(data)

    return Recording(len(places), pixels.shape, pixels.bits, read_page, time_s)


def at_rate(pages: int, rate_hz: float) -> NDArray[np.float64] | None:
    """Return when frames at an even rate were taken, in s from the first; None where a header tells no rate."""
    if not 0.0 < rate_hz < float("inf"):
        return None
    return np.arange(pages) / rate_hz


# Frames without a header, whose layout is stated: WIDTHxHEIGHTxBITS and what else is to be known.

SIZE = re.compile(r"([1-9]\d{0,5})x([1-9]\d{0,5})x([1-9]\d?)")
# What tells a layout, right or wrong, from the name of a part.
LOOKS_LAID_OUT = re.compile(r"\d+x\d")
# How the names of such files end. Others need their layout in the name, as FILE.dat:LAYOUT.
SUFFIXES = (".raw", ".bin")
PACKINGS = get_args(Packing)
ORDERS = ("little", "big")
# Options of a layout: the kind of value, which are allowed, and what is expected.
OPTIONS: Mapping[str, tuple[Callable[[str], Any], Callable[[Any], bool], str]] = {
    "packing": (str, PACKINGS.__contains__, ", ".join(PACKINGS)),
    "order": (str, ORDERS.__contains__, ", ".join(ORDERS)),
    "header": (int, lambda number: number >= 0, "a number of bytes"),
    "gap": (int, lambda number: number >= 0, "a number of bytes"),
    "rate": (float, lambda rate: 0.0 < rate < math.inf, "frames in a second"),
    "bayer": (str, PATTERNS.__contains__, ", ".join(PATTERNS)),
}
HINT = "a layout is WIDTHxHEIGHTxBITS and options, as in 2352x1768x12:packing=low-first:header=512"


def raw_frames(path: Path, layout: str | None = None) -> Recording:
    """Return the frames of a file, as many as a stated layout finds in it.

    Raises
    ------
    UsageError : no layout is stated, or it is not one
    InputError : the file does not end with a frame
    """
    if layout is None:
        raise UsageError(f"{path}: has no header: state its layout with --raw, or as {path}:LAYOUT; {HINT}")
    pixels, options = parse_layout(layout)
    header, gap = options.get("header", 0), options.get("gap", 0)
    held, step = path.stat().st_size - header, pixels.frame_bytes + gap
    pages, rest = divmod(held, step)
    # What lies between two frames may be missing after the last one.
    if gap and rest == pixels.frame_bytes:
        pages, rest = pages + 1, 0
    if held <= 0 or rest:
        raise InputError(
            f"{path}: its {held} bytes after the header are {held / step:.2f} frames of {step} bytes by the layout "
            f"{layout}, expected a whole number: {CUT}, or of another layout"
        )
    return recording(path, range(header, header + pages * step, step), pixels, at_rate(pages, options.get("rate", 0.0)))


def with_layout(path: Path, layout: str) -> Path:
    """Return the name of a file with a layout, where it is one without a header by its name and has none yet."""
    file, part = split_part(path)
    other, page = split_page(part)
    if file.suffix.lower() not in SUFFIXES or other is not None:
        return path
    return file.with_name(f"{file.name}:{layout}" + ("" if page is None else f":page={page}"))


def parse_layout(text: str) -> tuple[Pixels, dict[str, Any]]:
    """Return how pixels lie in the frames of a layout, and its other options.

    `header` and `gap`: bytes before the first frame, and after each; `rate`: frames in a second.

    Raises
    ------
    UsageError : naming what is wrong with it
    """
    size, *options = text.split(":")
    found = SIZE.fullmatch(size)
    if found is None:
        raise UsageError(f"{size!r} is no layout of frames; {HINT}")
    columns, rows, bits = (int(number) for number in found.groups())
    if bits > MOST_BITS:
        raise UsageError(f"layout {text}: has {bits} bits a pixel, expected 1 to {MOST_BITS}")
    chosen: dict[str, Any] = {}
    for option in options:
        name, _, value = option.partition("=")
        if name not in OPTIONS or name in chosen:
            raise UsageError(f"layout {text}: {name!r} is no option, or there twice; expected {', '.join(OPTIONS)}")
        kind, is_allowed, expected = OPTIONS[name]
        try:
            chosen[name] = kind(value)
        except ValueError:
            chosen[name] = None
        if chosen[name] is None or not is_allowed(chosen[name]):
            raise UsageError(f"layout {text}: {name} is {value!r}, expected {expected}")
    packing = chosen.get("packing", "whole")
    if packing != "whole" and bits not in PACKED_BITS:
        raise UsageError(f"layout {text}: {bits} bits are not packed, expected {' or '.join(map(str, PACKED_BITS))}")
    big = chosen.get("order") == "big"
    return Pixels((rows, columns), bits, packing, big_endian=big, bayer=chosen.get("bayer")), chosen
