"""The process around the commands: exit codes, signals, closed pipes, start-up, a place for compiled kernels."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest

from lfpiv_cli.cli.main import cli
from lfpiv_cli.cli.options import GROUPS
from lfpiv_cli.files import kernel_cache
from tests.commands import CONFIG, ROOT, SAMPLE, hear_interrupts


def lfpiv(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lfpiv_cli", *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


@pytest.mark.parametrize("module", ["lfpiv_cli", "lfpiv_cli.cli"])
def test_nothing_heavy_is_imported_for_help_or_by_a_script(module) -> None:
    script = f"import sys, {module}; print(sorted({{'numpy', 'numba', 'h5py', 'scipy'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout.strip() == "[]"


def groups_of(name: str) -> dict[str, list[str]]:
    """Return the options of a command's help, those of several names by the last, under their headings."""
    context = click.Context(cli, info_name="lfpiv")
    command = cli.get_command(context, name)
    assert command is not None
    found: dict[str, list[str]] = {}
    for line in command.get_help(click.Context(command, parent=context, info_name=name)).splitlines():
        if line.endswith(":") and not line.startswith(" "):
            found[line[:-1]] = []
        elif (option := re.match(r"  (?:-\w, )?--([\w-]+)", line)) and found:
            list(found.values())[-1].append(option[1])
    return found


# Options of a command beside those of all batches and of all commands: more are not read.
MOST_OWN = 25


@pytest.mark.parametrize("name", cli.list_commands(click.Context(cli)))
def test_help_has_each_option_once_under_what_it_is_about(name: str) -> None:
    found = groups_of(name)
    command = cli.commands[name]
    options = [each for each in command.get_params(click.Context(command)) if isinstance(each, click.Option)]
    listed = [each for names in found.values() for each in names]
    assert sorted(listed) == sorted(option.opts[-1].removeprefix("--") for option in options)
    assert [title for title in GROUPS if title in found] == list(found)
    assert {"json", "quiet", "threads", "help"} <= set(found["What it prints, and on what it runs"])
    *own, _, _ = (found.get(title, []) for title in GROUPS)
    assert sum(map(len, own)) <= MOST_OWN


def test_batches_have_one_heading_and_defaults_are_shown() -> None:
    batch = {"pairing", "pair-by", "pairs", "resume", "keep-going", "failures", "shard", "time-limit", "dry-run"}
    for name in ("run", "reconstruct", "correlate", "track"):
        assert batch <= set(groups_of(name)["Pairs and batches"])
    assert {"white", "dark", "board"} <= set(groups_of("run")["What it needs"])
    assert set(groups_of("reconstruct")["How"]) == {"solver", "iterations", "relaxation", "accelerate", "start"}
    words = " ".join(cli.commands["run"].get_help(click.Context(cli.commands["run"], info_name="run")).split())
    assert "By what the flow is measured. [default: (auto)]" in words
    # What a group names is an option of some command.
    known = {str(each.name) for command in cli.commands.values() for each in command.params} | {"help"}
    assert {name for names in GROUPS.values() for name in names.split()} <= known


@pytest.mark.thorough
def test_exit_codes_and_what_is_said(tmp_path) -> None:
    broken, target, file = tmp_path / "rig.yaml", tmp_path / "w.h5", tmp_path / "file"
    broken.write_text(CONFIG.read_text().replace("layout:", "layuot:"))
    file.write_text("mine", encoding="utf-8")
    for code, said, words in (
        (2, "", ("no-such-command",)),
        (2, "", ("simulate", "white", CONFIG)),
        (2, "", ("build-weights", CONFIG, "-o", CONFIG, "--overwrite")),
        (3, f"{broken}:6:", ("build-weights", broken, "-o", target)),
        (3, "did you mean 'layout'?", ("build-weights", broken, "-o", target)),
        (4, "no such.tif", ("calibrate-snapshot", CONFIG, "--white", tmp_path / "no such.tif", "-o", target)),
        (6, "file", ("build-weights", CONFIG, "-o", file)),
        # Before anything is computed.
        (7, "file", ("build-weights", CONFIG, "-o", file / "such" / "w.h5")),
    ):
        done = lfpiv(*words)
        assert (done.returncode, said in done.stderr, "Traceback" in done.stderr) == (code, True, False), words
        assert code == 2 or done.stderr.count("\n") == 1
    assert file.read_text() == "mine"
    assert not target.exists()


LOST_FIRST = """
import ctypes, signal, sys, time
from lfpiv_cli.cli.main import end_by_signals

def called_back():
    signal.raise_signal(getattr(signal, sys.argv[1]))

def dropped():
    try:
        called_back()
    except BaseException:
        pass

end_by_signals()
try:
    ctypes.CFUNCTYPE(None)(called_back)() if sys.argv[2] == "called back" else dropped()
    print("lost")
    try:
        for _ in range(500):
            time.sleep(0.01)
    finally:
        time.sleep(0.5)  # as files are removed: no signal is raised again meanwhile
        print("cleared")
except BaseException as error:
    print(type(error).__name__)
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to send")
@pytest.mark.parametrize(
    ("sent", "name", "said"),
    [
        ("SIGTERM", "Terminated", "terminated"),
        ("SIGINT", "KeyboardInterrupt", "interrupted"),
        ("SIGHUP", "HungUp", "hung up"),
    ],
)
@pytest.mark.parametrize("where", ["called back", "dropped"])
def test_a_signal_whose_exception_is_lost_is_raised_again(sent, name, said, where) -> None:
    words, heard = [sys.executable, "-c", LOST_FIRST, sent, where], {"capture_output": True, "text": True}
    done = subprocess.run(words, check=True, timeout=60, preexec_fn=hear_interrupts, **heard)
    assert done.stdout.split() == ["lost", "cleared", name]
    assert done.stderr == f"lfpiv: {said}\n"


IN_A_LONG_CALL = """
import hashlib
from lfpiv_cli.cli.main import end_by_signals

end_by_signals()
print("begun", flush=True)
hashlib.pbkdf2_hmac("sha256", b"", b"", 100_000_000)  # half a minute without Python's lock, as compiled loops are
"""


@pytest.mark.thorough
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to send")
def test_a_signal_is_answered_while_a_compiled_call_goes_on() -> None:
    words = [sys.executable, "-c", IN_A_LONG_CALL]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "begun\n"
        time.sleep(1.0)  # from these words to within the call
        process.send_signal(signal.SIGTERM)
        assert process.stderr.readline() == "lfpiv: terminated\n"
        assert process.poll() is None
        process.kill()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGHUP")
def test_what_nohup_has_ignored_stays_so() -> None:
    script = "import signal; from lfpiv_cli.cli.main import end_by_signals; end_by_signals(); "
    script += "signal.raise_signal(signal.SIGHUP); print('here')"
    ignored = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, **ignored)
    assert (done.stdout, done.stderr) == ("here\n", "")


A_BROKEN_LIBRARY = """
import signal, sys
from lfpiv_cli.cli import main
from lfpiv_cli.verbs import run

def broken(*_, **__):
    try:
        signal.raise_signal(signal.SIGTERM)
    except BaseException:
        raise RuntimeError("no compiled object yet")

run.warm_up = broken
sys.argv = ["lfpiv", "warm-up"]
main()
"""
# For minutes, as none of Python's threads can be stopped.
WHILE_ANOTHER_THREAD_WORKS = """
import hashlib, signal, sys, threading, time
from lfpiv_cli.cli import main
from lfpiv_cli.threads import in_threads, use_threads
from lfpiv_cli.verbs import run

def work(piece):
    if threading.current_thread() is threading.main_thread():
        time.sleep(0.5)
        signal.raise_signal(signal.SIGTERM)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 1_000_000_000)

def in_two_threads(*_, **__):
    use_threads(2)
    in_threads(work, range(2))

run.warm_up = in_two_threads
sys.argv = ["lfpiv", "warm-up"]
main()
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to send")
@pytest.mark.parametrize("script", [A_BROKEN_LIBRARY, WHILE_ANOTHER_THREAD_WORKS], ids=["library", "thread"])
def test_a_signal_ends_a_command_whatever_a_library_makes_of_it_and_a_thread_does(script: str) -> None:
    heard = {"capture_output": True, "text": True, "env": os.environ | {"NUMBA_NUM_THREADS": "2"}}
    done = subprocess.run([sys.executable, "-c", script], timeout=40, **heard)
    assert (done.returncode, done.stderr) == (143, "lfpiv: terminated\n")


# A machine that can be written in its folder for temporary files alone, and a kernel that takes a moment to compile.
READ_ONLY = """
import os, tempfile
access, opened, free = os.access, tempfile.TemporaryFile, tempfile.gettempdir()
def refused(*given, dir=None, **more):
    if not str(dir).startswith(free):
        raise PermissionError(13, "read-only", dir)
    return opened(*given, dir=dir, **more)
tempfile.TemporaryFile = refused
os.access = lambda path, mode: str(path).startswith(free) and access(path, mode)
"""
USE = """
import numpy as np
import lfpiv_cli
from lfpiv_cli.optics.media import snell_invariant
print(snell_invariant(0.1, np.ones(2), np.array([1.0, 1.33])))
print(os.environ["NUMBA_CACHE_DIR"])
"""


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A process that has no place for compiled code, and whose variable is put back."""
    monkeypatch.setenv(kernel_cache.VARIABLE, "")
    monkeypatch.setattr(kernel_cache, "lost", False)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    return monkeypatch


def test_a_place_that_can_be_written_is_numbas_own_affair(process: pytest.MonkeyPatch, tmp_path: Path) -> None:
    process.setenv(kernel_cache.VARIABLE, str(tmp_path / "made" / "later"))
    kernel_cache.ensure_place()
    assert os.environ[kernel_cache.VARIABLE] == str(tmp_path / "made" / "later")
    assert not kernel_cache.lost
    # A file in the way is no place.
    (tmp_path / "file").write_text("")
    assert not kernel_cache._is_writable(tmp_path / "file" / "cache")
    assert kernel_cache._is_writable(tmp_path / "cache")


def test_a_filled_folder_that_is_read_only_is_copied(process: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "one.nbi").write_bytes(b"compiled")
    process.setenv(kernel_cache.VARIABLE, str(tmp_path))
    process.setattr(kernel_cache, "_is_writable", lambda path: False)
    kernel_cache.ensure_place()
    place = Path(os.environ[kernel_cache.VARIABLE])
    assert place != tmp_path
    assert (place / "kernels" / "one.nbi").read_bytes() == b"compiled"
    assert not kernel_cache.lost


def test_kernels_of_changed_files_and_of_those_that_import_them_go(tmp_path: Path) -> None:
    package = tmp_path / "made"
    (package / "optics" / "__pycache__").mkdir(parents=True)
    code = {"base": "HALF = 0.5", "lens": "from made.optics.base import HALF"}
    code |= {"camera": "from made.optics import lens", "wall": "import numpy"}
    for name, text in code.items():
        (package / "optics" / f"{name}.py").write_text(text)
    kernel_cache.forget_outdated(package)
    kernels = {name: package / "optics" / "__pycache__" / f"{name}.trace-1.py311.nbi" for name in [*code, "removed"]}
    for kernel in kernels.values():
        kernel.write_text("compiled")
    kernel_cache.forget_outdated(package)
    assert all(kernel.exists() for kernel in kernels.values())
    os.utime(package / "optics" / "base.py", ns=(1, 1))
    kernel_cache.forget_outdated(package)
    assert [name for name, kernel in kernels.items() if kernel.exists()] == ["wall"]


@pytest.mark.thorough
def test_kernels_compile_where_neither_package_nor_home_can_be_written(tmp_path: Path) -> None:
    surroundings = {name: value for name, value in os.environ.items() if name != kernel_cache.VARIABLE}
    # A folder of its own: the package may itself lie in the one for temporary files.
    surroundings["TMPDIR"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", READ_ONLY + USE], cwd=ROOT, env=surroundings, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    place = done.stdout.splitlines()[1]
    assert "lfpiv-kernels-" in place
    assert not Path(place).exists()


@pytest.mark.slow
def test_what_was_warmed_up_is_not_compiled_again(tmp_path: Path) -> None:
    """The sample's steps find all their kernels in a folder that `warm-up` has filled."""
    cache, out = tmp_path / "cache", tmp_path / "out"
    lfpiv = [sys.executable, "-m", "lfpiv_cli"]
    subprocess.run([*lfpiv, "warm-up", "--cache", str(cache)], cwd=ROOT, check=True)
    before = set(cache.rglob("*.nbc"))
    photographs = [f"--{name}={SAMPLE / name}.tif" for name in ("white", "dark", "board")]
    images = [str(SAMPLE / f"pair_{name}.tif") for name in "ab"]
    command = [*lfpiv, "run", str(CONFIG), *images, *photographs, "--method", "both", "-o", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, env=os.environ | {kernel_cache.VARIABLE: str(cache)})
    assert before
    assert sorted(path.name for path in set(cache.rglob("*.nbc")) - before) == []
