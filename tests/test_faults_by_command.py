"""Faults around whole commands: cut images, a full disk, kills, odd names, two at once, one bad frame of many."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli.files.vtkhdf import open_vectors, write_vectors
from lfpiv_cli.reference import FOCAL_POINT
from tests.commands import AT_FOCUS, CONFIG, ROOT, SAMPLE, sample_rig
from tests.hostile_files import ended
from tests.test_batches import QUICK
from tests.test_cli import hear_interrupts
from tests.test_particle_stage import frames_of
from tests.vector_fields import SHAPE, field_of


@pytest.fixture
def vectors(tmp_path: Path) -> Path:
    path = tmp_path / "v.vtkhdf"
    field = field_of(np.random.default_rng(1).normal(size=(*SHAPE, 3)), None)
    write_vectors(path, field, FOCAL_POINT, provenance={}, overwrite=False)
    return path


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "lfpiv_cli", *map(str, arguments)]


def combine_under_limits(vectors: Path) -> None:
    """Combine vectors under 40 limits on the size of files, in a process of its own, for the sake of this one."""
    import resource

    target = vectors.with_name("combined.vtkhdf")
    words = ("combine", vectors, vectors, "-o", target)
    assert ended(*words)[0] == 0
    old = target.read_bytes()
    for limit in np.linspace(0, len(old) - 1, 40).astype(int):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), resource.RLIM_INFINITY))
        code, said = ended(*words, "--overwrite")
        assert (code, said) == (7, f"{target}: cannot be written: {os.strerror(errno.EFBIG)}")
        assert target.read_bytes() == old
    assert sorted(os.listdir(vectors.parent)) == ["combined.vtkhdf", "v.vtkhdf"]


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
def test_a_full_disk_gives_7_and_the_old_file(vectors: Path) -> None:
    code = "import sys, pathlib; from tests.test_faults_by_command import combine_under_limits\n"
    code += "combine_under_limits(pathlib.Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(vectors)], cwd=ROOT, stderr=subprocess.PIPE, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "name", ["two words", "line\nbreak", "-leading", "ends.", "é" * 100, os.fsdecode(b"\xff\xfe"), "%s{x}"]
)
def test_odd_names_go_through_a_command(vectors: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    odd = vectors.rename(vectors.with_name(f"{name}.vtkhdf"))
    monkeypatch.chdir(odd.parent)
    assert ended("combine", "-o", f"./{name}_2.vtkhdf", "--", odd.name, odd.name) == (0, "")
    assert open_vectors(odd.with_name(f"{name}_2.vtkhdf")).flag.shape == SHAPE
    code, said = ended("combine", "-o", f"./{name}_2.vtkhdf", "--", odd.name, odd.name)
    assert (code, name in said) == (6, True)


@pytest.mark.thorough
def test_two_commands_of_one_target_leave_one_whole_file(vectors: Path) -> None:
    target = vectors.with_name("combined.vtkhdf")
    words = command("combine", vectors, vectors, "-o", target, "--overwrite")
    both = [subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=120)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert sorted(os.listdir(vectors.parent)) == ["combined.vtkhdf", "v.vtkhdf"]
    assert open_vectors(target).flag.shape == SHAPE


@pytest.mark.slow
def test_one_bad_frame_of_a_hundred_leaves_the_others_as_they_are(
    tmp_path: Path, weights: Path, raw: np.ndarray
) -> None:
    frames = [tmp_path / f"f{number:02d}.tif" for number in range(100)]
    for number, path in enumerate(frames):
        tifffile.imwrite(path, raw + np.uint16(number), compression="zlib")
    words = ("reconstruct", weights, *frames, *QUICK, "-q", "-o")
    assert ended(*words, tmp_path / "clean") == (0, "")
    frames[57].write_bytes(frames[57].read_bytes()[:-5000])
    code, said = ended(*words, tmp_path / "stopped")
    assert (code, "f57.tif" in said) == (4, True)
    code, said = ended(*words, tmp_path / "rest", "--keep-going")
    assert (code, "f57.tif" in said) == (5, True)
    rest = sorted((tmp_path / "rest").iterdir())
    assert len(rest) == 99
    assert all(path.read_bytes() == (tmp_path / "clean" / path.name).read_bytes() for path in rest)


NAMES = ("build-weights", "calibrate-snapshot", "simulate", "correlate", "track")


def work(name: str, folder: Path, pairs: list[Path], rng: np.random.Generator) -> tuple[list[str], str, float]:
    """Return a command that works for a while, but for its output; how the name of that ends, and the seconds taken."""
    words: dict[str, tuple[object, ...]] = {
        "build-weights": (sample_rig(folder, AT_FOCUS),),
        "calibrate-snapshot": (CONFIG, "--white", SAMPLE / "white.tif"),
        "simulate": ("white", CONFIG),
        "correlate": (*pairs[:2], "--windows", 8),
        "track": tuple(frames_of([300] * 3, folder, rng)) if name == "track" else (),
    }
    end = {"build-weights": ".h5", "calibrate-snapshot": ".h5", "simulate": ""}.get(name, ".vtkhdf")
    begun = os.times().elapsed
    assert subprocess.run([*command(name, *words[name], "-q"), "-o", folder / f"made{end}"], cwd=ROOT).returncode == 0
    (folder / "out").mkdir()
    return command(name, *words[name], "-q"), end, os.times().elapsed - begun


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
@pytest.mark.parametrize("name", NAMES)
def test_what_was_killed_at_any_moment_can_be_made_again(
    tmp_path: Path, pairs: list[Path], name: str, rng: np.random.Generator
) -> None:
    words, end, takes_s = work(name, tmp_path, pairs, rng)
    folder = tmp_path / "out"
    made, whole = folder / f"made{end}", tmp_path / f"made{end}"
    again = [*words, "--overwrite", "-o", str(made)]
    for _ in range(6):
        with subprocess.Popen(again, cwd=ROOT) as process:
            with suppress(subprocess.TimeoutExpired):
                process.wait(rng.uniform(0.2, 1.0) * takes_s)
            process.kill()
        if end and made.exists():
            assert made.read_bytes() == whole.read_bytes()
    assert subprocess.run(again, cwd=ROOT).returncode == 0
    assert contents(made) == contents(whole)
    # What was killed half way is cleared away: nothing lies beside what was asked for.
    assert [path.name for path in folder.iterdir()] == [made.name]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM to send")
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("name", NAMES)
def test_signals_end_each_command_within_five_seconds(
    tmp_path: Path, pairs: list[Path], name: str, sent: int, code: int, rng: np.random.Generator
) -> None:
    words, end, takes_s = work(name, tmp_path, pairs, rng)
    folder, ends = tmp_path / "out", []
    for share in (0.5, 0.7, 0.9):
        command = [*words, "-o", folder / f"made{end}"]
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, preexec_fn=hear_interrupts) as process:
            with suppress(subprocess.TimeoutExpired):
                process.wait(share * takes_s)
            process.send_signal(sent)
            try:
                _, said = process.communicate(timeout=5.0)
            finally:
                process.kill()
        assert b"Traceback" not in said
        ends.append(process.returncode)
        if process.returncode == 0:
            break
        # A process that still reads its libraries cannot answer yet.
        assert process.returncode in (code, -sent)
        assert not os.listdir(folder)
    assert code in ends


def quiet_environment(**changes: str | None) -> dict[str, str]:
    """Return the environment with changes; what is None is not in it."""
    environment = {**os.environ, **changes}
    return {name: value for name, value in environment.items() if value is not None}


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="no terminals to open")
@pytest.mark.parametrize("terminal", [False, True])
def test_no_colour_is_sent_where_none_is_wanted(vectors: Path, terminal: bool) -> None:
    outer, inner = os.openpty()
    words = command("combine", vectors, vectors, "-o", vectors.with_name("combined.vtkhdf"))
    environment = quiet_environment(NO_COLOR="1", FORCE_COLOR=None)
    heard, said = inner if terminal else subprocess.PIPE, b""
    with subprocess.Popen(words, cwd=ROOT, env=environment, stdout=heard, stderr=heard) as process:
        os.close(inner)
        with suppress(OSError):  # until nobody holds the terminal's other end
            while terminal and (content := os.read(outer, 4096)):
                said += content
        said += b"" if terminal else b"".join(process.communicate(timeout=60))
    os.close(outer)
    assert process.returncode == 0
    assert b"vectors" in said
    assert not re.search(rb"\x1b\[[0-9;]*m", said)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("words", "changes"),
    [
        (("combine", "{}", "{}", "-o", "{}_2"), dict.fromkeys(("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"))),
        (("plot", "{}", "-o", "{}.png"), {"MPLBACKEND": "bogus", "DISPLAY": None}),
    ],
    ids=["home", "screen"],
)
def test_neither_home_nor_screen_is_needed(
    vectors: Path, words: tuple[str, ...], changes: list[tuple[str, str]]
) -> None:
    environment = quiet_environment(MPLCONFIGDIR=None, **changes)
    given = command(*(word.format(vectors) for word in words), "-q")
    done = subprocess.run(given, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("threads", ["0", "x", "-1", ""])
def test_a_number_of_threads_that_is_none_gives_2(vectors: Path, monkeypatch: pytest.MonkeyPatch, threads: str) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    code, said = ended("info", vectors)
    assert (code, said.startswith(f"NUMBA_NUM_THREADS is {threads!r}, expected")) == (2, True), said


@pytest.mark.parametrize(
    ("module", "extra", "words"),
    [
        ("matplotlib", "plot", ("plot", "{vectors}", "-o", "{folder}/v.png")),
        ("jinja2", "report", ("report", "{folder}", "-o", "{folder}/v.html")),
    ],
)
def test_an_extra_that_is_missing_gives_2_and_its_line(
    vectors: Path, monkeypatch: pytest.MonkeyPatch, module: str, extra: str, words: tuple[str, ...]
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, module, None)
    code, said = ended(*(word.format(vectors=vectors, folder=vectors.parent) for word in words))
    assert (code, f'pip install "lfpiv[{extra}]"' in said) == (2, True), said
    assert os.listdir(vectors.parent) == ["v.vtkhdf"]


def contents(path: Path) -> dict[str, bytes]:
    """Return the bytes of a file, or of all files in a folder."""
    files = [each for each in path.rglob("*") if each.is_file()] if path.is_dir() else [path]
    return {str(file.relative_to(path.parent)): file.read_bytes() for file in files}
