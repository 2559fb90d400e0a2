"""`validate all`: every report, whatever limit one of them misses."""

from __future__ import annotations

import pytest

from lfpiv_cli.console import Console
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.stages import validate_all


def test_a_missed_limit_keeps_no_other_report_from_being_made(monkeypatch, tmp_path):
    made = []

    def stage(name, fails):
        def run(config, output, overwrite, console, **others):
            made.append((name, config, output, overwrite, others))
            if fails:
                raise LimitMissedError(f"{name} is bad", {"error": 0.9})
            return {"error": 0.1}

        return run

    for name, fails in (("weights", True), ("board", False), ("flow", True)):
        monkeypatch.setattr(validate_all, f"validate_{name}", stage(name, fails))
    with pytest.raises(LimitMissedError, match="weights is bad; flow is bad") as missed:
        validate_all.validate_all(tmp_path / "c.yaml", tmp_path, console=Console(quiet=True))
    assert missed.value.figures == {"weights.error": 0.9, "board.error": 0.1, "flow.error": 0.9}
    assert [name for name, *_ in made] == ["weights", "board", "flow"]
    assert made[2][4] == {}
    monkeypatch.setattr(validate_all, "validate_weights", stage("weights", False))
    monkeypatch.setattr(validate_all, "validate_flow", stage("flow", False))
    summary = validate_all.validate_all(tmp_path / "c.yaml", tmp_path, console=Console(quiet=True))
    assert summary == {"weights.error": 0.1, "board.error": 0.1, "flow.error": 0.1}
