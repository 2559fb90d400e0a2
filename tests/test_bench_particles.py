"""The benchmark of particles at a tiny size."""

from __future__ import annotations

import re

import pytest

from benchmarks.particles import calibrated, print_figures


@pytest.mark.slow
def test_figures_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    bench = calibrated((500, 600), (26, 20, 20), seed=1)
    # A volume about the focal plane, where light stays within one lens, is the hardest: 0.81 and 0.98 when written.
    for spread, text in ((None, "40 particles, "), (0.5, "40 particles of log-normal brightness 0.5, ")):
        print_figures(bench, 40, 1, spread)
        line = capsys.readouterr().out
        assert line.startswith(text)
        recall = re.search(r"recall ([\d.]+)", line)
        assert recall is not None
        assert float(recall[1]) > 0.7
