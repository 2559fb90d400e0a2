"""The benchmark of particles at a tiny size."""

from __future__ import annotations

import re

import numpy as np
import pytest

from benchmarks.particles import calibrated, errors_over_bound, print_errors_over_bound, print_figures


@pytest.mark.slow
def test_figures_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    # The least that shows enough of the board's dots.
    bench = calibrated((880, 880), (26, 20, 20), seed=1)
    # A volume about the focal plane, where light stays within one lens, is the hardest: 0.81 and 0.98 when written.
    for spread, text in ((None, "40 particles, "), (0.5, "40 particles of log-normal brightness 0.5, ")):
        print_figures(bench, 40, 1, spread)
        line = capsys.readouterr().out
        assert line.startswith(text)
        recall = re.search(r"recall ([\d.]+)", line)
        assert recall is not None
        assert float(recall[1]) > 0.7


@pytest.mark.slow
def test_errors_over_the_bound_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_errors_over_bound((300, 320), (12, 12, 20), 8, seed=1)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(", ")[0] for line in lines] == ["1 tracers apart"] * 2 + ["8 tracers strewn"] * 2


def test_errors_over_the_bound_leave_out_what_is_another_tracer() -> None:
    over = np.array([[1.0, 2.0, 0.0], [-1.0, -2.0, 30.0], [1.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    figures = errors_over_bound(over)
    assert figures["rms_x"] == 1.0
    assert figures["rms_y"] == 2.0
    assert figures["rms_z"] == 0.0
    assert figures["astray_z"] == 0.25
