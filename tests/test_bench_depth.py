"""The depth benchmark at a small size."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.depth import CAMERA, LATERAL_MM, Case, response


@pytest.mark.slow
def test_a_displacement_in_depth_comes_back():
    case = Case(tracers=450, depth_mm=0.3, noisy=False)
    mean, spread = response(case, replace(CAMERA, columns=760, rows=760), box_mm=(3.2, 3.2, 4.8))
    assert mean[:2] == pytest.approx(LATERAL_MM, abs=0.01)
    assert mean[2] == pytest.approx(0.3, abs=0.03)  # few windows, each 0.025 mm from their mean
    assert (spread < (0.02, 0.02, 0.06)).all()
