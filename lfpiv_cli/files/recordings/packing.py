"""How pixels lie in the bytes of a frame that is not compressed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.recordings.bayer import green_of
from lfpiv_cli.files.recordings.recording import Image, Shape

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
    bayer : pattern of the colour filters, of which green is taken, see `bayer.green_of`; None without filters
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
        rows, columns = self.shape
        if self.packing == "whole":
            kind = np.dtype(np.uint8 if self.bits <= 8 else ">u2" if self.big_endian else "<u2")
            lines = np.frombuffer(data, np.uint8).reshape(rows, self._row_bytes)[:, : columns * kind.itemsize]
            image = np.ascontiguousarray(lines).view(kind)
        elif self.packing == "gige":
            image = _unpack_gige(np.frombuffer(data, np.uint8), self.bits)[: rows * columns].reshape(self.shape)
        else:
            packed = np.frombuffer(data, np.uint8)
            pixels = unpack(packed, self.bits, high_first=self.packing == "high-first")
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


def _unpack_gige(packed: NDArray[np.uint8], bits: int) -> NDArray[np.uint16]:
    """Return the pixels of GigE Vision's Mono10Packed or Mono12Packed: two in three bytes."""
    first, low, second = packed.reshape(-1, 3).astype(np.uint16).T
    kept, mask = bits - 8, (1 << (bits - 8)) - 1
    return np.stack([first << kept | low & mask, second << kept | low >> 4 & mask], axis=1).reshape(-1)
