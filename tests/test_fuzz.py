"""Readers fed with what nobody meant: a few cases of `benchmarks.fuzz` each, chosen by Hypothesis."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.fuzz import READERS, Reader, bench_fuzz, case, meant, outcome
from lfpiv_cli.errors import InputError

FEW = {"config": 20, "images": 150, "results": 30, "edited": 20}


@pytest.mark.thorough
@pytest.mark.parametrize("name", READERS)
def test_readers_take_or_refuse_whatever_comes(tmp_path: Path, name: str) -> None:
    reader = READERS[name]

    @settings(
        max_examples=FEW[name], derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(st.randoms(use_true_random=False))
    def taken_or_refused(chosen: random.Random) -> None:
        whole, content = case(reader, chosen)
        kind, words = outcome(reader, content, meant(reader, whole), tmp_path)
        assert kind in ("clean", "refused"), words

    taken_or_refused()


def first_byte(path: Path) -> int:
    """Read a file as nobody should."""
    content = path.read_bytes()
    if not content:
        raise InputError("is empty")
    return 1 // content[0]


def test_failures_are_named_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def damaged(chosen: random.Random, whole: bytes) -> bytes:
        return [b"", b"\0", b"\1", b"\2"][chosen.randrange(4)]

    toy = Reader(".bin", lambda: {"one": b"\1"}, damaged, first_byte, True)
    monkeypatch.setitem(READERS, "toy", toy)
    with pytest.raises(SystemExit):
        bench_fuzz(["toy", "--cases", "40", "--failures", str(tmp_path)])
    told = capsys.readouterr().out
    assert "traceback ZeroDivisionError" in told
    assert all(f"'{kind}'" in told for kind in ("clean", "refused", "traceback", "silent"))
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"\0", b"\2"}
