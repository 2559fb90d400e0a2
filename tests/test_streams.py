"""Commands whose words nobody takes: their results are written all the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"
LFPIV = f"'{sys.executable}' -m lfpiv_cli"

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")


def shell(line: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True, text=True, timeout=60)


@pytest.mark.thorough
@pytest.mark.parametrize("closed", ["2>/dev/full", "<&- >&- 2>&-"])
def test_a_rig_file_is_written_though_nothing_can_be_said(tmp_path: Path, closed: str) -> None:
    done = shell(f"{LFPIV} init --camera table2 -o '{tmp_path}/rig.yaml' {closed} >&-")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "rig.yaml").stat().st_size > 100


@pytest.mark.thorough
@pytest.mark.parametrize(("closed", "code"), [("| true", 0), (">&-", 0), (">/dev/full", 7)])
def test_an_answer_that_is_lost_is_a_failure_but_for_a_reader_that_has_gone(
    tmp_path: Path, closed: str, code: int
) -> None:
    done = shell(f"{LFPIV} check '{SAMPLE}' --json {closed}")
    assert done.returncode == code
    assert ("stdout: cannot be written: No space left on device" in done.stderr) == (code == 7)
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


@pytest.mark.thorough
def test_an_answer_goes_through_a_pipe() -> None:
    done = shell(f"{LFPIV} check '{SAMPLE}' 2>/dev/null | head -1")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(" ")
    assert done.stdout.count("\n") == 1


@pytest.mark.thorough
def test_errors_keep_their_codes(tmp_path: Path) -> None:
    assert shell(f"{LFPIV} info '{tmp_path}/none.h5' 2>/dev/full").returncode == 4
    assert shell(f"{LFPIV} no-such-command 2>/dev/full").returncode == 2
