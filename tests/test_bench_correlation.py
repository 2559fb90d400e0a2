"""The correlation's benchmarks at a tiny size."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.correlation import accuracy_series, against_openpiv, openpiv_pass, time_and_memory
from benchmarks.volumes import Seeding, volume_pair


@pytest.mark.thorough
def test_every_case_of_the_accuracy_has_figures() -> None:
    series = accuracy_series((40, 40, 40), [(16, 16, 16)], per_window=(8.0,), flows=("channel", "taylor_green"))
    assert len(series) == 8
    for figures in series.values():
        assert np.all(np.isfinite(figures["rms"]))
        assert np.all(figures["coverage"] <= 1.0)
    # 95 % by its definition. (Vortices of 40 voxels are more than windows of 16 can tell.)
    assert np.mean([series[f"A 8 {noise} channel"]["coverage"] for noise in ("clean", "noisy")]) > 0.9
    # Along y nothing moves in the vortices, and nothing but noise is in the way.
    assert series["A 8 clean taylor_green"]["rms"][1] < 0.1
    assert series["A 8 clean taylor_green"]["rms"][1] < series["A 8 noisy taylor_green"]["rms"][1]


def test_memory_is_measured_where_the_system_tells() -> None:
    seconds, memory = time_and_memory((40, 40, 40), [(16, 16, 16)])
    assert seconds > 0.0
    assert memory is None or memory >= 0.0


def test_openpiv_s_signs_are_turned_round(rng: np.random.Generator) -> None:
    pytest.importorskip("openpiv", reason="OpenPIV is not installed: it is only a benchmark's peer")
    shift = np.array([1.3, -0.7, 0.4])
    a, b = volume_pair(lambda points: np.tile(shift, (len(points), 1)), (32, 32, 32), Seeding(20.0, (1.0,) * 3), rng)
    # It is biased by 0.15 voxel towards zero.
    np.testing.assert_allclose(np.median(openpiv_pass(a, b, 16), axis=(0, 1, 2)), shift[::-1], atol=0.3)
    assert set(against_openpiv(a, b, [(16, 16, 16)], repeats=1)) == {"ours_s", "one_pass", "four_passes"}
