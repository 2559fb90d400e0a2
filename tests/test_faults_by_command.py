"""Faults around whole commands: full disks, too little memory, kills, odd names, two at once, one bad frame of many."""

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.errors import OutputError
from lfpiv_cli.files import inputs
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.vtkhdf import open_vectors, write_vectors
from lfpiv_cli.flow.correlation import held_bytes
from lfpiv_cli.flow.windows import CorrelationSettings
from lfpiv_cli.grid import FOCAL_POINT
from lfpiv_cli.verbs.planning import bench_of
from tests.commands import AT_FOCUS, CONFIG, ROOT, SAMPLE, contents, ended, hear_interrupts, sample_rig
from tests.test_batches import QUICK
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


NAMES = ("build-weights", "calibrate-snapshot", "simulate", "correlate", "track")
THOROUGH = pytest.mark.thorough


def work(
    name: str, folder: Path, weights: Path, pairs: list[Path], rng: np.random.Generator
) -> tuple[list[str], str, float]:
    """Return a command that works for a while, but for its output; how the name of that ends, and the seconds taken."""
    words: dict[str, tuple[object, ...]] = {
        "build-weights": (sample_rig(folder, AT_FOCUS),),
        "calibrate-snapshot": (CONFIG, "--white", SAMPLE / "white.tif"),
        "simulate": ("white", CONFIG),
        "correlate": (*pairs[:2], "--windows", 8),
        "track": tuple(frames_of([300] * 3, folder, rng)) if name == "track" else (),
        "reconstruct": (weights, SAMPLE / "pair_a.tif", "--iterations", 400),
    }
    end = {"build-weights": ".h5", "calibrate-snapshot": ".h5", "simulate": ""}.get(name, ".vtkhdf")
    begun = os.times().elapsed
    assert subprocess.run([*command(name, *words[name], "-q"), "-o", folder / f"made{end}"], cwd=ROOT).returncode == 0
    (folder / "out").mkdir()
    return command(name, *words[name], "-q"), end, os.times().elapsed - begun


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
@pytest.mark.parametrize("name", NAMES)
def test_what_was_killed_is_made_again(
    tmp_path: Path, weights: Path, pairs: list[Path], name: str, rng: np.random.Generator
) -> None:
    words, end, takes_s = work(name, tmp_path, weights, pairs, rng)
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


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM to send")
@pytest.mark.parametrize(("sent", "code"), [("SIGTERM", 143), ("SIGINT", 130), ("SIGHUP", 129)])
@pytest.mark.parametrize(
    "name",
    [*(pytest.param(name, marks=pytest.mark.slow) for name in NAMES), pytest.param("reconstruct", marks=THOROUGH)],
)
def test_signals_end_each_command_within_five_seconds(
    tmp_path: Path, weights: Path, pairs: list[Path], name: str, sent: str, code: int, rng: np.random.Generator
) -> None:
    words, end, takes_s = work(name, tmp_path, weights, pairs, rng)
    folder, number, ends = tmp_path / "out", getattr(signal, sent), []
    for share in (0.5, 0.7, 0.9):
        command = [*words, "-o", folder / f"made{end}"]
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, preexec_fn=hear_interrupts) as process:
            with suppress(subprocess.TimeoutExpired):
                process.wait(share * takes_s)
            process.send_signal(number)
            try:
                _, said = process.communicate(timeout=5.0)
            finally:
                process.kill()
        assert b"Traceback" not in said
        ends.append(process.returncode)
        if process.returncode == 0:
            break
        # A process that still reads its libraries cannot answer yet.
        assert process.returncode in (code, -number)
        if os.listdir(folder):
            # All was done when it came: what stands there under its name is whole.
            assert [path.name for path in folder.iterdir()] == [f"made{end}"]
            assert ended("info", folder / f"made{end}") == (0, "")
            break
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
def test_no_home_or_screen_is_needed(vectors: Path, words: tuple[str, ...], changes: list[tuple[str, str]]) -> None:
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


STATUS = "Name:\tpython\nVmSize:\t 1000000 kB\nVmRSS:\t 500000 kB\n"


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A system that says how much memory there is: 10 GB on the machine, no other limit."""
    folder = tmp_path / "system"
    (folder / "self").mkdir(parents=True)
    (folder / "self" / "status").write_text(STATUS)
    (folder / "meminfo").write_text("MemTotal: 20000000 kB\nMemAvailable: 9000000 kB\nSwapFree: 1000000 kB\n")
    for name, place in (("PROCESS", "self"), ("MACHINE", "meminfo"), ("CONTROL_GROUPS", "groups")):
        monkeypatch.setattr(inputs, name, folder / place)
    monkeypatch.setattr(inputs, "address_space", lambda: None)
    return folder


def test_each_limit_counts(system: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs.ensure_room(10e9, "work")
    with pytest.raises(OutputError, match=r"work needs 11\.30 GB.* 10\.24 GB are left of this machine"):
        inputs.ensure_room(11e9, "work")
    monkeypatch.setattr(inputs, "address_space", lambda: 3_024_000_000)
    inputs.ensure_room(1.9e9, "work")
    with pytest.raises(OutputError, match=r"2\.00 GB are left of this process's address space"):
        inputs.ensure_room(2.1e9, "work")
    # Other systems set no limit.
    monkeypatch.setattr(inputs, "address_space", lambda: None)
    for name in ("PROCESS", "MACHINE", "CONTROL_GROUPS"):
        monkeypatch.setattr(inputs, name, system / "none")
    inputs.ensure_room(1e18, "work")


@pytest.mark.parametrize(
    ("line", "file"),
    [("0::/jobs/7", "jobs/7/memory.max"), ("0::/jobs/7", "jobs/memory.max"), ("0::/jobs/7", "memory.max")]
    + [("9:memory:/jobs/7", f"memory/{place}memory.limit_in_bytes") for place in ("jobs/7/", "")],
)
def test_a_jobs_limit_holds_for_all_in_it(system: Path, line: str, file: str) -> None:
    (system / "self" / "cgroup").write_text(f"3:cpu:/other\n{line}\n")
    place = system / "groups" / file
    place.parent.mkdir(parents=True)
    place.write_text("max\n")
    inputs.ensure_room(3e9, "work")
    place.write_text("2512000000\n")
    inputs.ensure_room(1.9e9, "work")
    with pytest.raises(OutputError, match=r"2\.00 GB are left of this job's limit"):
        inputs.ensure_room(2.1e9, "work")


def test_work_that_does_not_fit_is_not_begun(
    system: Path, tmp_path: Path, weights: Path, pairs: list[Path], images: list[Path]
) -> None:
    target, reconstruction = tmp_path / "v.vtkhdf", ("reconstruct", weights, images[0], *QUICK)
    for command, kilobytes, words in (
        (("correlate", *pairs[:2], "--windows", 8), 100, "too little memory: correlate needs 0.30 GB"),
        (reconstruction, 0, f"reading {weights} needs"),
        (reconstruction, 1000, "reconstruct needs"),
    ):
        (system / "meminfo").write_text(f"MemAvailable: {kilobytes} kB\n")
        code, said = ended(*command, "-o", target)
        assert (code, words in said, target.exists()) == (7, True, False), said


IMAGES = (SAMPLE / "pair_a.tif", SAMPLE / "pair_b.tif", "--white", SAMPLE / "white.tif")
TOO_DEEP = ("[30, 22, 40]", "[4000, 4000, 4000]", "4000 x 4000 x 4000 voxels needs 512.30")
TOO_WIDE = ("columns: 600, rows: 448", "columns: 20000, rows: 20000", "needs 13.90 GB")


@pytest.mark.parametrize(
    ("shape", "windows", "overlap", "measured_mb"),
    [
        ((40, 40, 40), (24, 12), 0.5, 4),
        ((80, 80, 120), (24, 12), 0.5, 50),
        ((128, 128, 160), (24, 12), 0.5, 158),
        ((240, 200, 160), (24, 12), 0.5, 497),
        ((80, 80, 120), (16, 8), 0.75, 1382),
    ],
)
def test_a_correlation_takes_what_was_measured(
    shape: tuple[int, int, int], windows: tuple[int, int], overlap: float, measured_mb: float
) -> None:
    settings = CorrelationSettings([(n, n, n) for n in windows], (overlap, overlap, overlap))
    assert 1 / 1.3 < held_bytes(shape, settings) / 1e6 / measured_mb < 1.3


@pytest.mark.parametrize(
    ("command", "more", "change"),
    [
        ("build-weights", (), TOO_DEEP),
        ("run", IMAGES, TOO_DEEP),
        ("run", (*IMAGES, "--method", "volumes"), ("[30, 22, 40]", "[800, 800, 800]", "needs 16.70 GB")),
        ("simulate white", (), TOO_WIDE),
        ("simulate board", (), TOO_WIDE),
    ],
)
def test_work_that_does_not_fit_is_refused_before_any(
    system: Path, tmp_path: Path, command: str, more: tuple[object, ...], change: tuple[str, str, str]
) -> None:
    *changed, said_of = change
    rig, output = sample_rig(tmp_path, AT_FOCUS, tuple(changed)), tmp_path / "output"
    code, said = ended(*command.split(), rig, *more, "-o", output)
    assert (code, said_of in said, "10.24 GB are left of this machine" in said) == (7, True, True), said
    assert not output.exists()


@pytest.mark.thorough
def test_weights_that_the_disk_has_no_room_for_are_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_000))
    rig = sample_rig(tmp_path, AT_FOCUS)
    code, said = ended("build-weights", rig, "-o", tmp_path / "w.h5")
    assert (code, "w.h5: needs 0.00 GB, and 0.00 GB are free on the disk" in said) == (7, True), said


@pytest.mark.thorough
def test_a_volume_far_beyond_what_can_be_refocused_is_judged_in_seconds() -> None:
    settings, begun = load_rig(CONFIG).overridden("volume", reference="focal_point"), time.process_time()
    benches = [bench_of(settings.overridden("volume", shape_xyz=(n, n, n)), None) for n in (40, 4000)]
    assert benches[0].errors_mm.shape == benches[1].errors_mm.shape
    assert time.process_time() - begun < 60.0
