"""The benchmark of rigs drawn at random: what is drawn fits together, and one tiny rig from images to figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rig_drawing import DrawnRig, draw
from benchmarks.rigs import Outcome, Step, faults, row, run_rig, summary, verdict
from lfpiv_cli.files.config import load_config

SEED = 20261122


def test_rigs_are_drawn_alike_and_from_the_whole_range() -> None:
    rigs = [draw(SEED, number) for number in range(40)]
    assert draw(SEED, 7) == rigs[7]
    size = np.array([abs(rig.true["camera"]["main_lens"]["magnification"]) for rig in rigs])
    assert size.min() < 0.2
    assert size.max() > 4.0
    assert {rig.true["camera"]["microlenses"]["layout"] for rig in rigs} == {"square", "hexagonal"}
    assert {rig.true["media"]["fluid"] for rig in rigs} == {1.0, 1.33, 1.47}
    assert 0.1 < np.mean([rig.wrong != "" for rig in rigs]) < 0.35


@pytest.mark.parametrize("number", range(12))
def test_configs_of_drawn_rigs_are_accepted(number: int, tmp_path: Path) -> None:
    rig = draw(SEED, number)
    for name, tree in (("true", rig.true), ("told", rig.told)):
        path = tmp_path / f"{name}.yaml"
        path.write_text(json.dumps(tree))
        load_config(path)
    assert (rig.told == {key: value for key, value in rig.true.items() if key != "simulation"}) == (rig.wrong == "")


def outcome_of(figures: dict[str, float], *steps: Step) -> Outcome:
    outcome = Outcome(1, "a rig", "", list(steps), figures)
    outcome.faults = faults(figures)
    outcome.verdict = verdict(outcome)
    return outcome


def test_verdicts() -> None:
    fine = {"bright": 1.0, "recall": 0.9, "tracers": 50.0, "slope_u": 1.01, "slope_u_sigma": 0.001, "coverage_x": 0.93}
    done = Step("reconstruct particles", 0, "", [], 1.0)
    assert outcome_of(fine, done).verdict == "worked"
    for change in ({"recall": 0.4}, {"slope_u": 1.03}, {"coverage_x": 0.7}, {"tracks": 9.0}):
        assert outcome_of(fine | change, done).verdict == "silent"
        assert outcome_of(fine | change, Step("track", 0, "", ["lfpiv: few"], 1.0)).verdict == "warned"
    # Not sure enough to call it wrong; faint tracers need not be found; of few, coverage says nothing.
    for change in ({"slope_u": 1.03, "slope_u_sigma": 0.01}, {"recall": 0.4, "bright": 0.1}):
        assert outcome_of(fine | change, done).verdict == "worked"
    assert outcome_of(fine | {"coverage_x": 0.5, "tracers": 10.0}, done).verdict == "worked"
    assert outcome_of({}, Step("build-weights", 3, "no room", [], 1.0)).verdict == "refused"
    assert outcome_of({}, Step("build-weights", 1, "ValueError", [], 1.0)).verdict == "failed"
    assert outcome_of(fine, done, Step("correlate", 4, "no", [], 1.0)).verdict == "failed"


def test_summary_names_what_is_wrong_without_a_word() -> None:
    silent = outcome_of({"bright": 1.0, "recall": 0.1, "tracers": 9.0}, Step("track", 0, "", [], 1.0))
    text = summary([silent, outcome_of({}, Step("build-weights", 3, "there is no room", [], 1.0))])
    assert "2 rigs: 0 worked, 1 refused, 0 failed, 0 warned, 1 silent" in text
    assert "silent: rig 1: recall 0.10" in text
    assert "there is no room" in text


@pytest.mark.slow
def test_a_tiny_rig_is_run_and_judged(tmp_path: Path) -> None:
    rig = next(rig for rig in map(tiny, range(40)) if 3 <= rig.true["simulation"]["particles"] <= 60)
    outcome = run_rig(rig, tmp_path)
    assert outcome.verdict in ("worked", "refused", "failed", "warned", "silent")
    assert outcome.steps[0].command == "calibrate-snapshot"
    assert not [step for step in outcome.steps if step.exit_code == 1], row(outcome)


def tiny(number: int) -> DrawnRig:
    return draw(SEED, number, (24, 20))
