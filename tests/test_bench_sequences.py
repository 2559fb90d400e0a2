"""The benchmark of sequences at a tiny size."""

from __future__ import annotations

import re

import pytest

from benchmarks.particles import calibrated
from benchmarks.sequences import print_sequence


@pytest.mark.slow
def test_figures_of_a_sequence_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    bench = calibrated((880, 880), (24, 20, 30), seed=1)
    print_sequence(bench, "duct", 30, 5, seed=1)
    lines = capsys.readouterr().out.splitlines()
    # All of it, and the two ranges of depths that it has.
    assert len(lines) == 3
    assert lines[0].startswith("duct, 30, ")
    recall = re.search(r"recall ([\d.]+)", lines[0])
    assert recall is not None
    # A volume about the focal plane, the hardest, of tracers that are few.
    assert float(recall[1]) > 0.7
