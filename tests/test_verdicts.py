"""The verdict of a result: what warnings and vectors make of it."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.flow.field import MASKED, REJECTED
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs.checks import FOR_INFORMATION, Line, of_two_ways, of_vectors, of_warnings, worst, worst_first
from tests.vector_fields import SHAPE, SIGMA_VOXEL, VOXEL_MM, field_of, noise_mm, rotation_mm

TROUBLESHOOTING = Path(__file__).parents[1] / "docs" / "troubleshooting.md"


def made(command: str, *codes: str) -> dict[str, Any]:
    warnings = [
        {"code": code, "about": "a.tif", "text": f"found {code}", "remedy": "mend it", "measured": None}
        for code in codes
    ]
    return {"command": command, "warnings": warnings}


def words(lines: list[Line]) -> dict[str, str]:
    return {part: worst(worst_first(lines, part), "good") for part in ("calibration", "images", "vectors")}


def test_warnings_count_for_the_part_that_their_command_makes() -> None:
    records = {
        "calibration.h5": made("calibrate-snapshot", "f-numbers"),
        "particles/a.vtkhdf": made("reconstruct page 0", "light-unexplained"),
        "tracks.vtkhdf": made("track"),
    }
    assert words(of_warnings(records)) == {"calibration": "look", "images": "no", "vectors": "good"}
    found = of_warnings({"a.vtkhdf": made("reconstruct", "particle-diameter-limit")})
    assert [(each.about, each.verdict) for each in found] == [("images", "good")]
    records = {f"{number}.vtkhdf": made("reconstruct", "frame-saturated") for number in range(5)}
    [reason] = of_warnings(records)
    assert "(and 4 more)" in reason.reason
    assert "mend it" in reason.reason
    lines = [Line("images", "good", "fine"), Line("images", "no", "dark"), Line("images", "look", "dim")]
    assert [each.reason for each in worst_first(lines, "images")] == ["dark", "dim", "fine"]
    assert (worst(lines), worst([])) == ("no", "unknown")
    documented = set(re.findall(r"^\| `([a-z-]+)` \|", TROUBLESHOOTING.read_text(encoding="utf-8"), re.MULTILINE))
    assert documented >= checks.WORTHLESS | FOR_INFORMATION


def test_vectors_as_good_as_they_state_and_not() -> None:
    # Of errors as stated, half of them, and a sixth.
    for understated, word in ((1.0, "good"), (2.0, "good"), (6.0, "look")):
        field = field_of(rotation_mm() * 20.0 + noise_mm(0), SIGMA_VOXEL / understated)
        assert words(of_vectors(field, "v"))["vectors"] == word
    [_, reason] = of_vectors(field_of(noise_mm(0), SIGMA_VOXEL), "v")
    assert reason.verdict == "look"
    assert "standard deviations of zero" in reason.reason
    flow = np.zeros((*SHAPE, 3))
    flow[..., 0] = 1.0
    reasons = of_vectors(field_of(flow, np.array([0.05, 0.02, 1.2])), "v")
    [reason] = [each for each in reasons if each.verdict == "look"]
    assert "w is known to 0.36 mm, 36% of the usual displacement" in reason.reason
    assert words(of_vectors(field_of(flow, SIGMA_VOXEL), "v"))["vectors"] == "good"
    field = field_of(rotation_mm(), SIGMA_VOXEL)
    field.flag[:] = REJECTED
    assert words(of_vectors(field, "v"))["vectors"] == "no"
    field.flag[:] = MASKED
    assert words(of_vectors(field, "v"))["vectors"] == "no"
    one = field_of(rotation_mm() + noise_mm(1), SIGMA_VOXEL)
    same = field_of(rotation_mm() + noise_mm(2), SIGMA_VOXEL)
    off = field_of(rotation_mm() + noise_mm(3) + 8.0 * SIGMA_VOXEL * VOXEL_MM, SIGMA_VOXEL)
    assert of_two_ways(one, same, ("a", "b"))[0].verdict == "good"
    assert of_two_ways(one, off, ("a", "b"))[0].verdict == "look"
    assert not of_two_ways(one, field_of(np.zeros((*SHAPE, 3)), None), ("a", "b"))
