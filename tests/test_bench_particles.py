"""The benchmark of particles at a tiny size."""

from __future__ import annotations

import re

import pytest

from benchmarks.particles import print_figures


@pytest.mark.slow
def test_figures_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_figures(40, (500, 600), (26, 20, 20), seed=1)
    line = capsys.readouterr().out
    assert line.startswith("40 particles")
    recall = re.search(r"recall ([\d.]+)", line)
    # A volume about the focal plane, where light stays within one lens, is the hardest: 0.76 when written.
    assert recall is not None
    assert float(recall[1]) > 0.6
