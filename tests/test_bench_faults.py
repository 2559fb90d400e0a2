"""The benchmark of planted faults, on a tiny rig: a fault is told, and a good experiment is not spoken against."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import faults
from benchmarks.faults import ADVICE, FAULTS, STAGES, Bench, Experiment, benches, codes, prepare, told_by
from benchmarks.rigs import Step


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(faults, "LENSES", (18, 14))
        tiny = next(benches(faults.SEED, 1, faults.clear, tmp_path_factory.mktemp("bench")))
    # which is too small for its board
    return replace(tiny, good=faults.without("board")(tiny.good))


def test_faults_are_spoilt_experiments() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(set(names)) == len(names) > 20
    pictures = {name: np.full((20, 24), 100.0) + k for k, name in enumerate(("dark", "pair_a", "pair_b"))}
    good = Experiment({"media": {"fluid": 1.33}}, pictures, 255.0)
    by_name = {fault.name: fault.spoil for fault in FAULTS}
    assert by_name["index 5 % off"](good).told["media"]["fluid"] == pytest.approx(1.33 * 1.05)
    assert good.told["media"]["fluid"] == 1.33
    assert "dark" not in by_name["no dark"](good).pictures
    assert by_name["frame overexposed"](good).pictures["pair_a"].max() == 255.0
    assert by_name["pair exchanged"](good).pictures["pair_a"].max() == 102.0


def test_what_was_said() -> None:
    line = "lfpiv: warning: white image: is dim; light it [white-dim]"
    done = Step("calibrate-snapshot", 0, "", [line, line, "RuntimeWarning: overflow"], 0.0)
    assert codes([done]) == ["white-dim", "RuntimeWarning: overflow"]
    advice = Step("build-weights", 0, "", [f"lfpiv: warning: a: b; c [{min(ADVICE)}]"], 0.0)
    assert told_by([advice]) == ""
    assert told_by([done, Step("track", 4, "no particles", [], 0.0)]) == "refused: no particles"
    assert told_by([Step("track", 1, "KeyError: 'a'", [], 0.0)]) == "CRASH: KeyError: 'a'"


@pytest.mark.thorough
def test_a_fault_is_told_and_a_good_picture_is_not(bench: Bench) -> None:
    by_name = {fault.name: fault for fault in FAULTS}
    assert told_by([bench.calibrate(bench.good)]) == ""
    overexposed = by_name["white overexposed"].spoil(bench.good)
    assert "of the white image is saturated" in STAGES["calibrate"](bench, overexposed)
    prepare(bench, "frame")
    assert told_by([bench.look(bench.good)]) == ""
    assert STAGES["frame"](bench, by_name["no dark"].spoil(bench.good)) == "dark-level"
    assert "frame-given-before" in STAGES["frame"](bench, by_name["white as frame"].spoil(bench.good))
