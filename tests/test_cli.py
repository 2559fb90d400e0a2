"""The process around the commands: exit codes, signals, closed pipes, start-up."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data"
CONFIG = ROOT / "configs" / "sample.yaml"


def lfpiv(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lfpiv_cli", *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


def test_help_imports_nothing_heavy():
    script = "import sys, lfpiv_cli.cli; print(sorted({'numpy', 'numba', 'h5py', 'scipy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout.strip() == "[]"


@pytest.mark.thorough
def test_usage_errors_give_2(tmp_path):
    assert lfpiv("no-such-command").returncode == 2
    assert lfpiv("simulate", "white", CONFIG).returncode == 2
    # an output that is an input
    assert lfpiv("build-weights", CONFIG, "-o", CONFIG, "--overwrite").returncode == 2


@pytest.mark.thorough
def test_config_errors_give_3_with_line_and_near_miss(tmp_path):
    broken = tmp_path / "rig.yaml"
    broken.write_text(CONFIG.read_text().replace("layout:", "layuot:"))
    done = lfpiv("build-weights", broken, "-o", tmp_path / "w.h5")
    assert done.returncode == 3
    assert f"{broken}:6:" in done.stderr
    assert "did you mean 'layout'?" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "w.h5").exists()


@pytest.mark.thorough
def test_missing_input_gives_4_and_names_it(tmp_path):
    done = lfpiv("calibrate-snapshot", CONFIG, "--white", tmp_path / "no such.tif", "-o", tmp_path / "c.h5")
    assert done.returncode == 4
    assert "no such.tif" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.thorough
def test_existing_output_gives_6_and_is_untouched(tmp_path):
    target = tmp_path / "w.h5"
    target.write_text("mine")
    assert lfpiv("build-weights", CONFIG, "-o", target).returncode == 6
    assert target.read_text() == "mine"


@pytest.mark.thorough
def test_unwritable_output_gives_7_before_computing(tmp_path):
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    assert lfpiv("build-weights", CONFIG, "-o", tmp_path / "file" / "such" / "w.h5").returncode == 7


@pytest.mark.thorough
def test_json_goes_to_stdout_alone(tmp_path):
    config = tmp_path / "air.yaml"
    config.write_text(CONFIG.read_text().replace("reference: mid_plane", "reference: focal_point"))
    done = lfpiv("build-weights", config, "-o", tmp_path / "w.h5", "--json")
    assert done.returncode == 0
    assert done.stdout.startswith("{")
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


def test_a_closed_pipe_is_quiet():
    done = subprocess.run(
        f"'{sys.executable}' -m lfpiv_cli --help | head -1", shell=True, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0
    assert done.stdout.startswith("Usage")
    assert done.stderr == ""


def hear_interrupts():
    """Have a new process hear SIGINT, which shells have their background jobs ignore, and SIGHUP, as nohup has it."""
    for sent in (signal.SIGINT, signal.SIGHUP):
        signal.signal(sent, signal.SIG_DFL)


IGNORED_FIRST = """
import ctypes, signal, sys, time
from lfpiv_cli.cli.main import end_by_signals

def called_back():
    signal.raise_signal(getattr(signal, sys.argv[1]))

end_by_signals()
try:
    ctypes.CFUNCTYPE(None)(called_back)()
    print("ignored")
    for _ in range(500):
        time.sleep(0.01)
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
def test_a_signal_during_a_call_back_is_not_lost(sent, name, said):
    done = subprocess.run(
        [sys.executable, "-c", IGNORED_FIRST, sent],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        preexec_fn=hear_interrupts,
    )
    assert done.stdout.split() == ["ignored", name]
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
def test_a_signal_is_answered_while_a_compiled_call_goes_on():
    words = [sys.executable, "-c", IN_A_LONG_CALL]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "begun\n"
        time.sleep(1.0)  # from these words to within the call
        process.send_signal(signal.SIGTERM)
        assert process.stderr.readline() == "lfpiv: terminated\n"
        assert process.poll() is None
        process.kill()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGHUP")
def test_what_nohup_has_ignored_stays_so():
    script = "import signal; from lfpiv_cli.cli.main import end_by_signals; end_by_signals(); "
    script += "signal.raise_signal(signal.SIGHUP); print('here')"
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    assert (done.stdout, done.stderr) == ("here\n", "")


@pytest.mark.thorough
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to send")
@pytest.mark.parametrize(
    ("sent", "code", "said"),
    [("SIGTERM", 143, "terminated"), ("SIGINT", 130, "interrupted"), ("SIGHUP", 129, "hung up")],
)
def test_signals_end_the_work_and_leave_nothing(tmp_path, sent, code, said):
    config = tmp_path / "air.yaml"
    config.write_text(CONFIG.read_text().replace("reference: mid_plane", "reference: focal_point"))
    assert lfpiv("build-weights", config, "-o", tmp_path / "w.h5").returncode == 0
    # Compilation, which answers late, is over then.
    assert lfpiv("reconstruct", tmp_path / "w.h5", SAMPLE / "pair_a.tif", "-o", tmp_path / "v.vtkhdf").returncode == 0
    (tmp_path / "v.vtkhdf").unlink()
    images = (tmp_path / "w.h5", SAMPLE / "pair_a.tif", "--iterations", "100000", "-o", tmp_path / "v.vtkhdf")
    command = [sys.executable, "-m", "lfpiv_cli", "reconstruct", *(str(part) for part in images)]
    for seconds in (4.0, 8.0, 16.0):
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=hear_interrupts) as process:
            try:
                time.sleep(seconds)
                process.send_signal(getattr(signal, sent))
                _, words = process.communicate(timeout=5.0)
            finally:
                # A work that goes on would keep the test from failing.
                process.kill()
        # On a busy machine Python may still be reading the program, which then cannot answer.
        if process.returncode != -getattr(signal, sent):
            break
    assert process.returncode == code
    assert f"lfpiv: {said}\n" in words
    assert "Traceback" not in words
    assert sorted(path.name for path in tmp_path.iterdir()) == ["air.yaml", "w.h5"]


A_BROKEN_LIBRARY = """
import signal, sys
from lfpiv_cli.cli import main
from lfpiv_cli.verbs import chain

def broken(*_, **__):
    try:
        signal.raise_signal(signal.SIGTERM)
    except BaseException:
        raise RuntimeError("no compiled object yet")

chain.warm_up = broken
sys.argv = ["lfpiv", "warm-up"]
main()
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to send")
def test_what_a_library_makes_of_a_signal_is_no_bug():
    done = subprocess.run([sys.executable, "-c", A_BROKEN_LIBRARY], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (143, "lfpiv: terminated\n")
