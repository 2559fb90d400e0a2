"""`validate all`: every report, whatever limit one of them misses."""

from __future__ import annotations

from pathlib import Path

import pytest

from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, LimitMissedError
from lfpiv_cli.verbs import validate
from lfpiv_cli.verbs.validate import validate_flow

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"


def test_a_missed_limit_keeps_no_other_report_from_being_made(monkeypatch, tmp_path):
    made = []

    def stage(name, fails):
        def run(config, output, overwrite, console, **others):
            made.append((name, config, output, overwrite, others))
            if fails:
                raise LimitMissedError(f"{name} is bad", {"error": 0.9})
            return {"error": 0.1}

        return run

    monkeypatch.setattr(validate, "ensure_complete", lambda config: None)
    for name, fails in (("weights", True), ("board", False), ("flow", True)):
        monkeypatch.setattr(validate, f"validate_{name}", stage(name, fails))
    with pytest.raises(LimitMissedError, match="weights is bad; flow is bad") as missed:
        validate.validate_all(tmp_path / "c.yaml", tmp_path, console=Console(quiet=True))
    assert missed.value.figures == {"weights.error": 0.9, "board.error": 0.1, "flow.error": 0.9}
    assert [name for name, *_ in made] == ["weights", "board", "flow"]
    assert made[2][4] == {}
    monkeypatch.setattr(validate, "validate_weights", stage("weights", False))
    monkeypatch.setattr(validate, "validate_flow", stage("flow", False))
    summary = validate.validate_all(tmp_path / "c.yaml", tmp_path, console=Console(quiet=True))
    assert summary == {"weights.error": 0.1, "board.error": 0.1, "flow.error": 0.1}


@pytest.mark.parametrize(
    ("taken_out", "said"),
    [
        (", dt_s: 0.002", "correlation.dt_s: is missing"),
        ("  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}\n  p", "flow"),
        ("board:   {dots: [5, 4]", "board"),
    ],
)
@pytest.mark.parametrize("validate", [validate.validate_all, validate_flow])
def test_what_is_missing_is_said_before_anything_is_made(validate, taken_out, said, tmp_path):
    rig = tmp_path / "rig.yaml"
    text = SAMPLE.read_text()
    assert taken_out in text
    rig.write_text(text.replace(taken_out, "  p" if taken_out.endswith("p") else "#" if "board" in taken_out else ""))
    with pytest.raises(ConfigError, match=said):
        validate(rig, tmp_path / "report", console=Console(quiet=True))
    assert not list((tmp_path / "report").glob("*"))
