"""Places where nothing can be made, words that nobody takes, lists of particles made to do harm: said, with codes."""

import io
import json
import os
import random
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.particle_file import read_particles
from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.grid import FOCAL_POINT
from tests.commands import CONFIG, SAMPLE, ended
from tests.vector_fields import SHAPE, field_of


@pytest.fixture(scope="module")
def vectors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vectors") / "v.vtkhdf"
    field = field_of(np.random.default_rng(1).normal(size=(*SHAPE, 3)), None)
    write_vectors(path, field, FOCAL_POINT, provenance={}, overwrite=False)
    return path


def words_of(command: str, **places: Path) -> list[str]:
    """Return the words of a command, with paths in place of their names in braces."""
    photographs = {name: SAMPLE / f"{name}.tif" for name in ("white", "dark", "pair_a", "pair_b")}
    return [word.format(sample=CONFIG, **photographs, **places) for word in command.split()]


@pytest.mark.thorough
@pytest.mark.parametrize("place", ["x" * 300, "file/x", "/".join(["x" * 100] * 50)], ids=["name", "below", "path"])
@pytest.mark.parametrize(
    "command",
    [
        "simulate white {sample} -o {place}",
        "info {vectors} --picture {place}.png",
        "plot {vectors} -o {place}.png",
        "report {folder} -o {place}.html",
        "export {vectors} --to csv -o {place}.csv",
        "check {sample} --picture {place}.png",
        "check {sample} --log {place}.json",
        "init --camera table2 -o {place}.yaml",
        "build-weights {sample} -o {place}.h5",
        "calibrate-snapshot {sample} --white {white} -o {place}.h5",
        "combine {vectors} {vectors} -o {place}.vtkhdf",
        "track {vectors} {vectors} -o {place}.vtkhdf",
        "validate flow {sample} --vectors {vectors} -o {place}",
        "run {sample} {pair_a} {pair_b} --white {white} -o {place}",
    ],
)
def test_a_place_where_nothing_can_be_made_gives_7(tmp_path: Path, vectors: Path, command: str, place: str) -> None:
    (tmp_path / "file").touch()
    code, said = ended(*words_of(command, place=tmp_path / place, vectors=vectors, folder=vectors.parent))
    assert code == 7
    assert len(said) < 400
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "command",
    [
        "simulate white {sample} -o {place}",
        "plot {vectors} -o {place}/p.pdf --only planes",
        "export {vectors} --to csv -o {place}/v.csv",
        "combine {vectors} {vectors} -o {place}/c.vtkhdf",
        "correlate {vectors} --mean {place}/m.vtkhdf",
        "init --camera table2 -o {place}/r.yaml",
        "init --camera table2 -o {folder}/r.yaml --overwrite --log {place}/log.json",
    ],
)
def test_missing_folders_of_an_output_are_made(tmp_path: Path, vectors: Path, command: str) -> None:
    place = tmp_path / "new" / "deep"
    assert ended(*words_of(command, place=place, vectors=vectors, folder=vectors.parent)) == (0, "")
    assert list(place.iterdir())


@pytest.mark.thorough
@pytest.mark.parametrize(
    "command",
    [
        "validate flow {sample} --vectors {broken} -o {place}",
        "validate volume {sample} --volume {vectors} --particles {broken} --frame a -o {place}",
        "validate weights {broken} -o {place}",
        "validate board {broken} -o {place}",
        "validate all {broken} -o {place}",
        "simulate particles {broken} -o {place}",
        "run {sample} {broken} {broken} --white {white} -o {place}",
        "run {sample} {pair_a} {pair_b} --white {broken} -o {place}",
        "reconstruct {broken} {pair_a} {pair_b} -o {place}",
        "follow {broken} {pair_a} {pair_b} {white} {dark} -o {place}",
        "correlate {vectors} {copy} -o {place}/v.vtkhdf",
        "track {vectors} {copy} -o {place}/t.vtkhdf",
        "report {empty} -o {place}/r.html",
    ],
)
def test_a_command_that_fails_leaves_no_folder(tmp_path: Path, vectors: Path, command: str) -> None:
    files = {name: tmp_path / name for name in ("broken", "copy", "empty")}
    files["broken"].write_bytes(b"{")
    files["copy"].write_bytes(vectors.read_bytes())
    files["empty"].mkdir()
    code, _ = ended(*words_of(command, place=tmp_path / "new" / "deep", vectors=vectors, **files))
    assert code in (3, 4)
    assert sorted(os.listdir(tmp_path)) == ["broken", "copy", "empty"]


@pytest.mark.skipif(sys.platform != "linux", reason="no limit of the address space")
def test_an_address_space_that_the_libraries_do_not_fit_into_is_told(tmp_path: Path) -> None:
    line = f"ulimit -v 500000; exec '{sys.executable}' -m lfpiv_cli build-weights '{CONFIG}' -o '{tmp_path}/w.h5'"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60)
    assert done.returncode == 7
    assert "too little memory: the address space of this process is limited to 0.51 GB" in done.stderr


def test_too_little_memory_is_no_bug_nor_are_locked_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = tmp_path / "secret.tif"
    image.write_bytes((SAMPLE / "white.tif").read_bytes())
    allowed = os.access
    # Root may read everything, and tests often run as root.
    monkeypatch.setattr(os, "access", lambda path, mode: "secret" not in str(path) and allowed(path, mode))
    for option in ((), ("--white",), ("--dark",)):
        code, said = ended("check", CONFIG, *option, image)
        assert code == 4
        assert "secret.tif: cannot be read: permission denied" in said
    for error in (MemoryError(), MemoryError("Unable to allocate 3 GiB"), RuntimeError("can't start new thread")):
        monkeypatch.setattr("lfpiv_cli.verbs.check.check", Mock(side_effect=error))
        code, said = ended("check", CONFIG)
        assert code == 7
        assert said.startswith("too little memory: ")


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes in folders")
def test_a_log_that_nobody_reads_is_refused_at_once(tmp_path: Path) -> None:
    pipe, words = tmp_path / "log", ("check", tmp_path / "no.yaml", "--log", tmp_path / "log")
    os.mkfifo(pipe)
    assert ended(*words) == (7, f"{pipe}: cannot be written: is a pipe that nobody reads")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    assert ended(*words)[0] == 4
    assert b"no.yaml: no such file" in os.read(reader, 10_000)
    os.close(reader)


def true_arrays(count: int = 20) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    moved = {"frame_position_mm": rng.random((2, count, 3)), "frame_brightness": np.ones((2, count))}
    return {"position_mm": rng.random((count, 3)), "velocity_mm_s": rng.random((count, 3))} | moved


def packed(content: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **content)
    return file.getvalue()


def header(shape: str) -> bytes:
    """Return NumPy's header of float64 numbers of a shape."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def with_member(name: str, content: bytes) -> bytes:
    """Return a list of particles with other bytes in place of an array."""
    file = io.BytesIO()
    old = zipfile.ZipFile(io.BytesIO(packed(true_arrays())))
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        for each in old.namelist():
            new.writestr(each, content if each == f"{name}.npy" else old.read(each))
    return file.getvalue()


def encrypted() -> bytes:
    """Return a list whose members say that they are encrypted."""
    content = bytearray(packed(true_arrays()))
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = content.find(mark)
        while place >= 0:
            content[place + at] |= 1
            place = content.find(mark, place + 4)
    return bytes(content)


def misnamed() -> bytes:
    """Return a list in which a bit of an optional array's name is flipped, in the archive's list of names."""
    content = bytearray(packed(true_arrays() | {"diameter_mm": np.ones(20)}))
    content[content.rfind(b"diameter_mm")] ^= 1
    return bytes(content)


HARM: dict[str, Callable[[], bytes]] = {
    "no dimensions": lambda: packed({name: np.array(1.0) for name in true_arrays()}),
    "frames of no dimensions": lambda: packed(true_arrays() | {"frame_position_mm": np.array(1.0)}),
    "too large a number": lambda: packed(true_arrays() | {"velocity_mm_s": np.full((20, 3), 1e300)}),
    "no number": lambda: packed(true_arrays() | {"position_mm": np.full((20, 3), np.nan)}),
    "complex": lambda: packed(true_arrays() | {"position_mm": np.full((20, 3), 1j)}),
    "text": lambda: packed(true_arrays() | {"position_mm": np.full((20, 3), "a")}),
    "objects": lambda: packed(true_arrays() | {"position_mm": np.full((20, 3), None)}),
    "one array": lambda: header("(20, 3)") + bytes(480),
    "encrypted": encrypted,
    "misnamed": misnamed,
    "bomb": lambda: with_member("position_mm", header("(2500000, 3)") + bytes(60_000_000)),
    "bomb beside": lambda: with_member("frame_brightness", header("(375000, 20)") + bytes(60_000_000)),
    "declares a terabyte": lambda: with_member("position_mm", header("(50000000000, 3)") + bytes(480)),
    "negative": lambda: with_member("position_mm", header("(-20, -3)") + bytes(480)),
    "no header": lambda: with_member("position_mm", b""),
    "code for a header": lambda: with_member("position_mm", header("(" * 2000)),
    "empty": lambda: packed({name: array[:0] for name, array in true_arrays().items()}),
}


@pytest.mark.thorough
@pytest.mark.parametrize("harm", HARM)
def test_what_is_no_list_of_particles_is_refused(tmp_path: Path, vectors: Path, harm: str) -> None:
    particles = tmp_path / "true.npz"
    particles.write_bytes(HARM[harm]())
    given = ("--vectors", vectors, "--particles", particles)
    code, said = ended("validate", "flow", CONFIG, *given, "-o", tmp_path / "report")
    assert code == 4
    assert f"{particles}: " in said
    json.dumps(said)


def test_no_damage_is_anything_but_refused(tmp_path: Path) -> None:
    path, whole = tmp_path / "true.npz", packed(true_arrays())
    path.write_bytes(whole)
    expected = read_particles(path)
    chosen, refused = random.Random(5), 0
    for _ in range(300):
        content = bytearray(whole)
        for _ in range(chosen.randint(1, 4)):
            content[chosen.randrange(len(content))] ^= 1 << chosen.randrange(8)
        path.write_bytes(content[: chosen.randrange(len(content))] if chosen.random() < 0.2 else content)
        try:
            found = read_particles(path)
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(found.positions_mm, expected.positions_mm)
            np.testing.assert_array_equal(found.velocities_m_s, expected.velocities_m_s)
    assert refused > 200


needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
LFPIV = f"'{sys.executable}' -m lfpiv_cli"


def shell(line: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True, text=True, timeout=60)


@needs_full
@pytest.mark.thorough
@pytest.mark.parametrize("closed", ["2>/dev/full", "<&- >&- 2>&-"])
def test_a_rig_file_is_written_though_nothing_can_be_said(tmp_path: Path, closed: str) -> None:
    done = shell(f"{LFPIV} init --camera table2 -o '{tmp_path}/rig.yaml' {closed} >&-")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "rig.yaml").stat().st_size > 100


@needs_full
@pytest.mark.thorough
@pytest.mark.parametrize(("closed", "code"), [("| true", 0), (">&-", 0), (">/dev/full", 7)])
def test_a_lost_answer_fails_but_for_a_reader_that_has_gone(tmp_path: Path, closed: str, code: int) -> None:
    done = shell(f"{LFPIV} check '{CONFIG}' --json {closed}")
    assert done.returncode == code
    assert ("stdout: cannot be written: No space left on device" in done.stderr) == (code == 7)
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


@pytest.mark.thorough
@needs_full
def test_an_answer_goes_through_a_pipe_and_errors_keep_their_codes(tmp_path: Path) -> None:
    done = shell(f"{LFPIV} check '{CONFIG}' 2>/dev/null | head -1")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(" ")
    assert done.stdout.count("\n") == 1
    assert shell(f"{LFPIV} info '{tmp_path}/none.h5' 2>/dev/full").returncode == 4
    assert shell(f"{LFPIV} no-such-command 2>/dev/full").returncode == 2
