"""Which frames help which: with one that cannot be read, those beside it are searched by themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.verbs import particles

BAD = 2


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches that return words for how they were made, of frames that are their own numbers."""
    stub = {
        "frame_of": lambda bench, raw, lit: int(raw),
        "find": lambda bench, frame, advance: f"{frame} alone",
        "find_first": lambda bench, frame, advance: f"{frame}",
        "find_second": lambda bench, frame, before, first, advance: f"{frame} after {first}",
        "find_beside": lambda bench, frame, own, others: f"{own} beside {' and '.join(others)}",
        "check_frame": lambda bench, raw, name: None,
    }
    for name, search in stub.items():
        monkeypatch.setattr(particles, name, search)


def finder(pairing: str, keep_going: bool) -> particles.Finder:
    def read(number: int) -> tuple[Any, Any]:
        if number == BAD:
            raise InputError(f"f{number}.tif: is empty")
        return np.float32(number), np.float32(number)

    beside, first_of = [(1,), (0,), (3,), (2,)], {1: 0, 3: 2}
    if pairing == "sequence":
        beside, first_of = [(1,), (0, 2), (1, 3), (2,)], {}
    frames = [Frame(Path(f"f{number}.tif"), 0, 1) for number in range(4)]
    return particles.Finder(None, read, frames, beside, first_of, keep_going)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("pairing", "expected"),
    [
        ("ab", {0: "0 beside 1 after 0", 1: "1 after 0 beside 0", 3: "3 alone"}),
        ("sequence", {0: "0 beside 1", 1: "1 beside 0", 3: "3 alone"}),
    ],
)
def test_those_beside_a_bad_frame_have_a_look_of_their_own(searched, pairing, expected) -> None:
    find = finder(pairing, keep_going=True).find
    for number, words in expected.items():
        found, notices = find(number, number, lambda steps: None)  # type: ignore[arg-type]
        assert found == words
        lacking = number == 3 or (pairing == "sequence" and number == 1)
        assert [(notice.code, notice.about) for notice in notices] == [("frame-alone", f"f{number}")] * lacking
        assert all("without the help of f2: f2.tif: is empty" in notice.text for notice in notices)


def test_without_keep_going_the_bad_frame_is_told(searched) -> None:
    with pytest.raises(InputError, match=r"f2\.tif: is empty"):
        finder("ab", keep_going=False).find(3, 3, lambda steps: None)  # type: ignore[arg-type]
