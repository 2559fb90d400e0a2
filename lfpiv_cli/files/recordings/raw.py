"""Frames without a header, whose layout is stated: WIDTHxHEIGHTxBITS and what else is to be known."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.inputs import split_page, split_part
from lfpiv_cli.files.recordings.bayer import PATTERNS
from lfpiv_cli.files.recordings.blocks import at_rate, recording
from lfpiv_cli.files.recordings.packing import MOST_BITS, PACKED_BITS, Packing, Pixels
from lfpiv_cli.files.recordings.pixels import CUT
from lfpiv_cli.files.recordings.recording import Recording

SIZE = re.compile(r"([1-9]\d{0,5})x([1-9]\d{0,5})x([1-9]\d?)")
# What tells a layout, right or wrong, from the name of a part.
LOOKS_LAID_OUT = re.compile(r"\d+x\d")
# How the names of such files end. Others need their layout in the name, as FILE.dat:LAYOUT.
SUFFIXES = (".raw", ".bin")
PACKINGS = get_args(Packing)
HINT = "a layout is WIDTHxHEIGHTxBITS and options, as in 2352x1768x12:packing=low-first:header=512"


@dataclass(frozen=True)
class Layout:
    """How frames lie in a file.

    Attributes
    ----------
    header, gap : bytes before the first frame, and after each
    rate_hz : frames in a second, 0 where not stated
    """

    pixels: Pixels
    header: int
    gap: int
    rate_hz: float


def frames(path: Path) -> Recording:
    """Refuse frames whose layout is not stated."""
    raise UsageError(f"{path}: has no header: state its layout with --raw, or as {path}:LAYOUT; {HINT}")


def frames_laid_out(path: Path, layout: str) -> Recording:
    """Return the frames of a file, as many as a stated layout finds in it.

    Raises
    ------
    UsageError : the layout is not one
    InputError : the file does not end with a frame
    """
    laid = parse_layout(layout)
    held = path.stat().st_size - laid.header
    pages, rest = divmod(held, laid.pixels.frame_bytes + laid.gap)
    # What lies between two frames may be missing after the last one.
    if laid.gap and rest == laid.pixels.frame_bytes:
        pages, rest = pages + 1, 0
    if held <= 0 or rest:
        raise InputError(
            f"{path}: its {held} bytes after the header are {held / (laid.pixels.frame_bytes + laid.gap):.2f} frames "
            f"of {laid.pixels.frame_bytes + laid.gap} bytes by the layout {layout}, expected a whole number: {CUT}, "
            "or of another layout"
        )
    step = laid.pixels.frame_bytes + laid.gap
    places = range(laid.header, laid.header + pages * step, step)
    return recording(path, places, laid.pixels, at_rate(pages, laid.rate_hz))


def with_layout(path: Path, layout: str) -> Path:
    """Return the name of a file with a layout, where it is one without a header by its name and has none yet."""
    file, part = split_part(path)
    other, page = split_page(part)
    if file.suffix.lower() not in SUFFIXES or other is not None:
        return path
    return file.with_name(f"{file.name}:{layout}" + ("" if page is None else f":page={page}"))


def parse_layout(text: str) -> Layout:
    """Return the layout that a text states.

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
    chosen = _options(text, options)
    packing = chosen.get("packing", "whole")
    if packing != "whole" and bits not in PACKED_BITS:
        raise UsageError(f"layout {text}: {bits} bits are not packed, expected {' or '.join(map(str, PACKED_BITS))}")
    pixels = Pixels((rows, columns), bits, packing, big_endian=chosen.get("order") == "big", bayer=chosen.get("bayer"))
    return Layout(pixels, chosen.get("header", 0), chosen.get("gap", 0), chosen.get("rate", 0.0))


def _bytes(text: str) -> int:
    number = int(text)
    if number < 0:
        raise ValueError
    return number


def _rate(text: str) -> float:
    rate = float(text)
    if not (math.isfinite(rate) and rate > 0.0):
        raise ValueError
    return rate


def _one_of(names: tuple[str, ...]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text not in names:
            raise ValueError
        return text

    return parse


# Options of a layout: how each is read, and what is expected of it.
OPTIONS: Mapping[str, tuple[Callable[[str], Any], str]] = {
    "packing": (_one_of(PACKINGS), ", ".join(PACKINGS)),
    "order": (_one_of(("little", "big")), "little, big"),
    "header": (_bytes, "a number of bytes"),
    "gap": (_bytes, "a number of bytes"),
    "rate": (_rate, "frames in a second"),
    "bayer": (_one_of(PATTERNS), ", ".join(PATTERNS)),
}


def _options(text: str, options: list[str]) -> dict[str, Any]:
    """Return the options of a layout by their names."""
    chosen: dict[str, Any] = {}
    for option in options:
        name, _, value = option.partition("=")
        if name not in OPTIONS or name in chosen:
            raise UsageError(f"layout {text}: {name!r} is no option, or there twice; expected {', '.join(OPTIONS)}")
        parse, expected = OPTIONS[name]
        try:
            chosen[name] = parse(value)
        except ValueError:
            raise UsageError(f"layout {text}: {name} is {value!r}, expected {expected}") from None
    return chosen
