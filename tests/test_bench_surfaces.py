"""The benchmark of rays through a pipe, at a tiny size."""

from __future__ import annotations

import pytest

from benchmarks import timing
from benchmarks.surfaces import rates


def test_every_way_has_a_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "PAUSE_S", 0.0)
    monkeypatch.setattr(timing, "LEAST_S", 0.0)
    found = rates(rays=20, repeats=1)
    assert len(found) == 2
    assert min(found.values()) > 0.0
