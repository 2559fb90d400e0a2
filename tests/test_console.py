"""What a person, a log and a script are told while a command runs and at its end."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from lfpiv_cli import console as module
from lfpiv_cli.cli.main import cli
from lfpiv_cli.cli.options import common_options
from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, LimitMissedError, OutputError, UsageError
from lfpiv_cli.files.atomic import EventLog
from lfpiv_cli.notice import Notice

# The package names the function `main` as its module is named.
MAIN = importlib.import_module("lfpiv_cli.cli.main")
NOTICE = Notice("odd", "a.tif", "is odd", "look at it", measured=1.0)


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def events(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_without_a_terminal_lines_tell_rate_and_time_left(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Console().frames(3, 2, "reconstruct") as work:
        for name in "abc":
            work.advance(2)
            clock.now += 70.0
            work.done(name)
    # A frame that takes long has a line a minute; work of one piece one now and then.
    with Console().frames(2, 10, "reconstruct") as work:
        for _ in range(10):
            clock.now += 25.0
            work.advance(1)
        work.done("a")
    with Console().progress(100, "refine") as advance:
        for _ in range(100):
            clock.now += 0.25
            advance(1)
    assert capsys.readouterr().err.splitlines() == [
        "reconstruct: a, 1 of 3 frames, 70 s each, 2 min left",
        "reconstruct: b, 2 of 3 frames, 70 s each, 1 min left",
        "reconstruct: c, 3 of 3 frames, 70 s each, 0 s left",
        "reconstruct: 0.3 of 2 frames",
        "reconstruct: 0.6 of 2 frames",
        "reconstruct: 0.9 of 2 frames",
        "reconstruct: a, 1 of 2 frames, 250 s each, 4 min left",
        "refine: 40 of 100 steps, 4 a second, 15 s left",
        "refine: 80 of 100 steps, 4 a second, 5 s left",
    ]
    for silent in (Console(quiet=True), Console(only_warnings=True)):
        with silent.frames(1, 1, "reconstruct") as work, silent.progress(1, "refine") as advance:
            clock.now += 100.0
            advance(1)
            work.done("a")
        assert capsys.readouterr().err == ""


def test_the_bar_counts_frames(monkeypatch, capsys) -> None:
    monkeypatch.setattr(Console, "_is_terminal", True)
    with Console().frames(2, 4, "reconstruct") as work:
        work.advance(2)
        work.done("a")
        # More steps than were foreseen are no second frame.
        work.advance(9)
        assert work.draw is not None
        work.draw(1.5)
    drawn = capsys.readouterr().err
    assert "/2 frames" in drawn
    assert "a, 1 of 2" not in drawn


def test_the_log_has_a_line_for_each_event_whatever_is_silent(clock: Clock, tmp_path: Path) -> None:
    console = Console(quiet=True, warned=[], log=EventLog(tmp_path / "run.log", "reconstruct"))
    console.warn([NOTICE, NOTICE])
    with console.frames(2, 1, "reconstruct") as work:
        clock.now += 3.0
        work.done("a")
    warning, frame = events(tmp_path / "run.log")
    assert warning["event"] == "warning"
    assert warning["code"] == "odd"
    memory = frame.pop("memory_mb")
    assert memory is None or 10.0 < memory < 1e5
    reported = {"command": "reconstruct", "event": "frame", "step": "reconstruct", "name": "a", "done": 1, "of": 2}
    own, times = {"time": 0, "process": 0}, {"seconds_each": 3.0, "seconds_left": 3.0}
    assert frame | own == reported | own | times
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", frame["time"])


def test_the_same_warning_of_many_files_is_printed_three_times(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(warned=[])
    console.warn(Notice("few-tracers", f"{number}.tif", "too few", "seed more") for number in range(5))
    console.warn([Notice("frame-dark", "9.tif", "is dark", "more light")])
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" ")[2] for line in lines] == ["0.tif:", "1.tif:", "2.tif:", "9.tif:"]
    assert lines[2].endswith("[few-tracers]; more of these are not printed")
    assert len(console.warned or ()) == 6


def test_a_log_is_added_to_and_nothing_else_is(tmp_path: Path) -> None:
    EventLog(tmp_path / "run.log", "track").write("start", {})
    EventLog(tmp_path / "run.log", "track").write("end", {"residual": float("nan")})
    assert [event["event"] for event in events(tmp_path / "run.log")] == ["start", "end"]
    for content in (b"II*\0", b'{\n  "steps": {}\n}\n'):  # an image, and what `run` writes
        (tmp_path / "other").write_bytes(content)
        with pytest.raises(UsageError, match="is no log"):
            EventLog(tmp_path / "other", "track")
    with pytest.raises(OutputError, match="Not a directory"):
        EventLog(tmp_path / "other" / "run.log", "track").write("start", {})


@pytest.mark.parametrize(
    ("figures", "lines"),
    [
        (
            {"rms_u": {"volumes": 0.58, "particles": 0.049}, "bias": {"volumes": None, "particles": 1}, "pairs": 12},
            ["volumes particles", "rms_u 0.58 0.049", "bias unknown 1", "pairs 12"],
        ),
        ({"frames": 2, "sizes": [1, 2], "inputs": {"a": "x.tif"}}, ["frames 2", "sizes 1, 2", "inputs a x.tif"]),
        # Of several things they stand in a table that is longer than wide.
        (
            {"voxels": 25, "a.ssim": 0.9, "a.l1": 0.1, "b.ssim": 0.8, "b.l1": None, "c.ssim": 1.0, "c.l1": 0.0},
            ["voxels 25", "ssim l1", "a 0.9 0.1", "b 0.8 unknown", "c 1 0"],
        ),
        (
            {"ideal.ert.x": 1.0, "ideal.ert.y": 2.0, "ideal.ert.z": 3.0, "flow.slope": 4.0},
            ["ideal.ert", "x 1", "y 2", "z 3", "slope", "flow 4"],
        ),
    ],
)
def test_figures_are_tables(figures: dict[str, Any], lines: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Console().summary(figures)
    assert [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()] == lines


def command_that(act: Any) -> click.Command:
    """Return a command with the common options whose body is `act`."""

    def judge(overwrite: bool, console: Console) -> dict[str, Any]:
        return act(console)

    return click.command("judge")(common_options(judge))


def missed(console: Console) -> dict[str, Any]:
    console.warn([NOTICE])
    raise LimitMissedError("too large", {"rms": 0.9})


def failed(console: Console) -> dict[str, Any]:
    raise InputError("a.tif: no such file")


def test_the_log_tells_how_a_command_began_and_ended(tmp_path: Path) -> None:
    log = ["--log", str(tmp_path / "run.log")]
    for act in (lambda console: {"frames": 2}, missed, failed):
        CliRunner().invoke(command_that(act), log)
    found = events(tmp_path / "run.log")
    assert [event["event"] for event in found] == ["start", "end", "start", "warning", "end", "start", "error"]
    assert found[1]["summary"] == {"frames": 2}
    assert (found[1]["exit_code"], found[4]["exit_code"], found[6]["exit_code"]) == (0, 8, 4)
    assert found[4]["error"] == "too large"
    assert found[6]["error"] == "a.tif: no such file"


def talking(console: Console) -> dict[str, Any]:
    console.say("at work")
    console.detail("at this step")
    console.warn([NOTICE])
    return {"frames": 2}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), ["at work", f"lfpiv: warning: {NOTICE}"]),
        (("-v",), ["at work", "at this step", f"lfpiv: warning: {NOTICE}"]),
        (("-q",), []),
    ],
)
def test_the_answer_goes_to_stdout_and_words_to_stderr(options: tuple[str, ...], words: list[str]) -> None:
    done = CliRunner().invoke(command_that(talking), options)
    assert done.stdout.split() == ["frames", "2"]
    assert done.stderr.splitlines() == words


@pytest.mark.parametrize("option", ["-v", "--verbose", "-q", "--quiet", "--json", "--debug"])
def test_options_of_what_is_printed_stand_before_or_after_the_command(tmp_path: Path, option: str) -> None:
    rig = str(tmp_path / "rig.yaml")
    after, before = ([*words, "--overwrite"] for words in (["init", rig, option], [option, "init", rig]))
    said = [CliRunner().invoke(cli, [*words, "--camera", "table2"]) for words in (after, before, before[1:])]
    assert [done.exit_code for done in said] == [0, 0, 0]
    assert (said[0].stdout, said[0].stderr) == (said[1].stdout, said[1].stderr)
    if option in ("-q", "--quiet", "--json"):
        assert (said[0].stdout, said[0].stderr) != (said[2].stdout, said[2].stderr)


def ended(monkeypatch, capsys, act: Any, *options: str) -> tuple[int, list[dict[str, Any]], str]:
    """Return exit code, the objects on stdout, and stderr of a command run as the shell does."""
    monkeypatch.setattr(MAIN, "cli", click.Group(commands=[command_that(act)]))
    monkeypatch.setattr(sys, "argv", ["lfpiv", "judge", *options])
    with pytest.raises(SystemExit) as left:
        MAIN.main()
    said = capsys.readouterr()
    return int(left.value.code or 0), [json.loads(line) for line in said.out.splitlines()], said.err


def interrupted(console: Console) -> dict[str, Any]:
    raise KeyboardInterrupt


def broken(console: Console) -> dict[str, Any]:
    raise ZeroDivisionError("by zero")


@pytest.mark.parametrize(
    ("act", "code", "words"),
    [
        (failed, 4, "a.tif: no such file"),
        (interrupted, 130, "interrupted"),
        (broken, 1, "a bug: ZeroDivisionError: by zero"),
    ],
)
def test_an_error_is_json_on_stdout_with_the_same_code(monkeypatch, capsys, act, code, words) -> None:
    without = ended(monkeypatch, capsys, act)
    left, objects, said = ended(monkeypatch, capsys, act, "--json")
    assert (left, said) == (code, without[2])
    assert (without[0], without[1]) == (code, [])
    assert [list(found) for found in objects] == [["error", "exit_code"]]
    assert objects[0]["error"].startswith(words)
    assert objects[0]["exit_code"] == code


def test_a_missed_limit_and_a_line_that_is_not_understood_are_json_too(monkeypatch, capsys) -> None:
    left, objects, said = ended(monkeypatch, capsys, failed, "--json", "--no-such-option")
    assert left == objects[0]["exit_code"] == 2
    assert "--no-such-option" in objects[0]["error"]
    assert "--no-such-option" in said
    left, objects, _ = ended(monkeypatch, capsys, missed, "--json")
    assert left == 8
    assert [found.pop("warnings")[0]["code"] for found in objects] == ["odd"]
    assert objects == [{"rms": 0.9, "error": "too large", "exit_code": 8}]


def test_help_cuts_no_sentence() -> None:
    listed = CliRunner().invoke(cli, ["--help"]).output
    assert "..." not in listed.split("Commands:")[1]
    # Lines may end within a word that has a hyphen.
    letters = "".join(listed.split())
    for name in cli.list_commands(click.Context(cli)):
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        assert command.short_help
        assert "".join(command.short_help.split()) in letters


def test_shells_complete_commands_and_options() -> None:
    script = "import sys; sys.argv = ['lfpiv']; from lfpiv_cli.cli import main; main()"
    words = {"_LFPIV_COMPLETE": "bash_complete", "COMP_WORDS": "lfpiv recon", "COMP_CWORD": "1"}
    done = subprocess.run([sys.executable, "-c", script], env=os.environ | words, capture_output=True, text=True)
    assert done.stdout.split() == ["plain,reconstruct"]
