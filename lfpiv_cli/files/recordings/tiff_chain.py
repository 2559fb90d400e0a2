"""A walk over a TIFF file's directories that takes nothing on trust.

The decoding library stops at a broken directory and returns the pages before it; a count of pages that an experiment
relies on must not shrink in silence. So the chain is followed here first, and every directory and tag value must lie
inside the file. Header and entries as in the TIFF 6.0 and BigTIFF specifications.
"""

from __future__ import annotations

import struct
from typing import BinaryIO

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.recordings.pixels import CUT

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
    InputError
        If the chain leads outside the file or into a circle; the caller adds the file's name.
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
