"""The benchmark of batches at a tiny size."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.batches import Figures, digests, killed, print_throughput, print_workers, small_experiment


def test_growth_is_that_of_the_last_quarter_over_the_second() -> None:
    # The first quarter is when things are loaded.
    memory = [50.0, 90.0, 100.0, 100.0, 104.0, 105.0, 110.0, 110.0]
    figures = Figures(wall_s=10.0, own_s=9.5, memory_mb=memory, files=[5, 6])
    assert figures.growth() == pytest.approx(0.1)
    assert figures.share() == 0.95
    assert "growth +10.0%" in figures.told()


@pytest.mark.slow
def test_the_cost_of_a_batch_and_what_workers_gain_are_printed(tmp_path: Path, capsys) -> None:
    experiment = small_experiment(tmp_path, pairs=2)
    assert len(set(digests(tmp_path / "images").values())) == 4
    print_throughput(experiment, tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:2]] == ["2 pairs, volumes", "2 pairs, fields"]
    for line in lines[:2]:
        share = re.search(r": ([\d.]+) \(limit 0.9\)", line)
        assert share is not None
        assert 0.3 < float(share[1]) <= 1.0
    print_workers(experiment, tmp_path)
    assert len(re.findall(r"[\d.]+ times", capsys.readouterr().out)) == 4


@pytest.mark.slow
def test_a_batch_that_is_killed_and_resumed_gives_the_same_files(tmp_path: Path) -> None:
    assert killed(small_experiment(tmp_path, pairs=2), tmp_path, 2, np.random.default_rng(1))[0] == 0
