"""The calibration's benchmark at a size for tests: a few small random benches, none wrong without a word."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.calibration import report, run_series


@pytest.mark.slow
def test_random_benches_are_calibrated_within_their_errors(capsys: pytest.CaptureFixture[str]) -> None:
    results = run_series(3, seed=20261121, largest_side=600)
    report(results)
    assert "wrong without a word" in capsys.readouterr().out
    assert not [each for each in results if "silent" in each or "failure" in each]
    for name, limit in (("rotation_deg", 2e-3), ("board_z_mm", 0.03), ("origin_column_px", 0.05)):
        assert np.max(np.abs([float(each[name]) for each in results])) < limit
