"""Photron's .mraw: frames one after the other, and a header in a file beside it, .cihx (XML) or .cih (text)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, reason
from lfpiv_cli.files.recordings.bayer import COLOUR_HINT
from lfpiv_cli.files.recordings.blocks import at_rate, recording
from lfpiv_cli.files.recordings.packing import PACKED_BITS, Pixels
from lfpiv_cli.files.recordings.pixels import CUT
from lfpiv_cli.files.recordings.recording import Recording

SUFFIX = ".mraw"
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
STORED_BITS = (8, 16, *PACKED_BITS)
MONOCHROME = "mono"
# A header has some thousand characters; one that is larger is none.
MOST_HEADER_BYTES = 2**20


def frames(path: Path) -> Recording:
    """Return the frames that the header beside a file describes, timed by its rate.

    Raises
    ------
    InputError
    """
    header = _header_beside(path)
    found = _read_header(header)
    colour = found.get("colour", MONOCHROME).lower()
    if colour != MONOCHROME:
        raise InputError(f"{header}: describes {colour} images: {COLOUR_HINT}")
    pages, columns, rows, bits = (_number(header, found, name) for name in ("pages", "columns", "rows", "bits"))
    if bits not in STORED_BITS:
        raise InputError(f"{header}: {NAMES['bits'][0]} is {bits}, expected one of {sorted(STORED_BITS)}")
    pixels = Pixels((rows, columns), bits, "high-first" if bits in PACKED_BITS else "whole")
    places = range(0, pages * pixels.frame_bytes, pixels.frame_bytes)
    return recording(path, places, pixels, at_rate(pages, _rate_hz(found)))


def beside(path: Path) -> tuple[Path, ...]:
    """Return the header of a file, which the counts depend on as on the file itself."""
    return (_header_beside(path),)


def _header_beside(path: Path) -> Path:
    """Return the header of a file: its name with another ending, in small or large letters."""
    for suffix in (".cihx", ".cih", ".CIHX", ".CIH"):
        header = path.with_suffix(suffix)
        if header.exists():
            return header
    raise InputError(f"{path}: its header {path.with_suffix('.cihx').name} or .cih is not beside it")


def _read_header(header: Path) -> dict[str, str]:
    """Return the words of a header by our names; what it does not say is missing."""
    if ensure_regular_file(header) > MOST_HEADER_BYTES:
        raise InputError(f"{header}: has more than {MOST_HEADER_BYTES} bytes, and is no header of frames")
    content = content_of(header)
    if header.suffix.lower() == ".cih":
        lines = (line.split(" : ", 1) for line in content.decode("latin-1").splitlines())
        words = {line[0].strip(): line[1].strip() for line in lines if len(line) == 2}
        return {name: words[word] for name, (word, _) in NAMES.items() if word in words}
    # The XML lies between bytes of the camera's own, without what could declare entities.
    inside = re.search(rb"<cih>.*</cih>", content, re.DOTALL)
    if inside is None:
        raise InputError(f"{header}: holds no <cih> … </cih>: {CUT}")
    try:
        tree = ElementTree.fromstring(inside.group().decode("utf-8", errors="replace"))
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{header}: is not XML: {reason(error)}") from error
    told = {name: tree.findtext(place) for name, (_, place) in NAMES.items()}
    return {name: text.strip() for name, text in told.items() if text is not None}


def _number(header: Path, found: Mapping[str, str], name: str) -> int:
    text = found.get(name)
    if text is None or re.fullmatch(r"[1-9]\d{0,8}", text) is None:
        raise InputError(f"{header}: {NAMES[name][0]} is {text}, expected a positive number")
    return int(text)


def _rate_hz(found: Mapping[str, str]) -> float:
    """Return how many frames a second are in the file: the camera's, or one in so many where it left some out."""
    try:
        return float(found.get("rate", "0")) / float(found.get("step", "1"))
    except (ValueError, ZeroDivisionError):
        return 0.0
