"""Dry runs: what would be made, what it takes, and that nothing is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lfpiv_cli.errors import InputError, OutputExistsError, UsageError
from lfpiv_cli.files.atomic import EventLog
from tests.commands import run, told
from tests.test_batches import QUICK, spoil, stamps


def test_a_dry_run_tells_and_writes_nothing(weights, images, tmp_path, capsys) -> None:
    command = ("reconstruct", weights, *images, *QUICK, "-o", tmp_path / "out", "--failures", tmp_path / "failed.json")
    before = stamps(tmp_path)
    summary = told(capsys, *command, "--log", tmp_path / "log", "--dry-run")
    assert stamps(tmp_path) == before
    assert (summary["frames"], summary["to_make"], summary["skipped"], summary["unreadable"]) == (3, 3, 0, 0)
    assert summary["would_make"] == [str(tmp_path / "out" / f"f{number}.vtkhdf") for number in range(3)]
    assert (summary["seconds"], summary["seconds_by"]) == (None, None)
    assert summary["disk_by"] == "at most, uncompressed"
    run(*command)
    written = sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) / 1e6
    assert written < summary["disk_mb"] < 10.0 * written


@pytest.mark.thorough
def test_a_dry_run_believes_what_is_there_and_the_log(weights, images, tmp_path, capsys) -> None:
    command = ("reconstruct", weights, *images, *QUICK, "-o", tmp_path / "out", "--log", tmp_path / "log", "--resume")
    run(*command)
    victim = tmp_path / "out" / "f1.vtkhdf"
    size = victim.stat().st_size
    victim.unlink()
    before = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    frames = [each for each in before if each["event"] == "frame"]
    summary = told(capsys, *command, "--dry-run")
    assert [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()] == before
    assert (summary["to_make"], summary["skipped"]) == (1, 2)
    assert summary["would_make"] == [str(victim)]
    assert summary["disk_mb"] == pytest.approx(size / 1e6, rel=0.2)
    assert summary["seconds"] == frames[-1]["seconds_each"]
    assert summary["memory_mb"] == frames[-1]["memory_mb"] > 50.0
    run(*command[:-1], "--dry-run", "--overwrite", "-v")
    said = capsys.readouterr().out
    assert said.count("would make") == 3
    assert "would_make" not in said


def test_a_dry_run_ends_as_the_batch_would(weights, images, tmp_path, capsys) -> None:
    output = ("-o", tmp_path / "out", "--dry-run")
    run("reconstruct", weights, *images[1:], *QUICK, *output[:2])
    with pytest.raises(OutputExistsError):
        run("reconstruct", weights, *images, *QUICK, *output)
    with pytest.raises(UsageError, match="same output"):
        run("reconstruct", weights, images[0], images[0], *QUICK, *output)
    spoil(images[0], "empty")
    with pytest.raises(InputError, match="f0.tif: is empty"):
        run("reconstruct", weights, *images, *QUICK, *output)
    summary = told(
        capsys, "reconstruct", weights, *images, *QUICK, *output[:2], "--keep-going", "--resume", "--dry-run"
    )
    assert (summary["to_make"], summary["skipped"], summary["unreadable"]) == (0, 2, 1)


def test_a_dry_run_of_pairs(pairs, tmp_path, capsys) -> None:
    command = ("correlate", *pairs, "--pairing", "ab", "--windows", 8, "--derived", "-o", tmp_path / "out")
    summary = told(capsys, *command, "--dry-run")
    assert (summary["pairs"], summary["to_make"]) == (2, 2)
    assert 300.0 < summary["memory_mb"] < 310.0
    run(*command)
    written = sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) / 1e6
    assert written < summary["disk_mb"] < 10.0 * written
    bad = tmp_path / "b1.vtkhdf"
    bad.write_bytes(pairs[3].read_bytes()[:-200])
    summary = told(
        capsys,
        "correlate",
        *pairs[:3],
        bad,
        "--pairing",
        "ab",
        "--keep-going",
        "-o",
        tmp_path / "two",
        "--windows",
        8,
        "--dry-run",
    )
    assert (summary["to_make"], summary["unreadable"]) == (1, 1)


def test_the_last_event_of_a_command_is_found(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "log", "reconstruct")
    assert log.last("frame") is None
    for number in (1, 2):
        log.write("frame", {"step": "reconstruct", "done": number})
    EventLog(tmp_path / "log", "correlate").write("frame", {"step": "reconstruct", "done": 3})
    log.write("frame", {"step": "other", "done": 4})
    with open(tmp_path / "log", "a") as file:
        file.write('{"cut')
    found = log.last("frame", step="reconstruct")
    assert found is not None
    assert found["done"] == 2
