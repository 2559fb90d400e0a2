"""Places where nothing can be made, inputs that may not be read, too little memory: said, with the right code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.reference import FOCAL_POINT
from tests.hostile_files import ended
from tests.vector_fields import SHAPE, field_of

ROOT = Path(__file__).parent.parent
CONFIG, SAMPLE = ROOT / "configs" / "sample.yaml", ROOT / "sample_data"
PAIR = SAMPLE / "pair_a.tif", SAMPLE / "pair_b.tif"


@pytest.fixture(scope="module")
def vectors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vectors") / "v.vtkhdf"
    field = field_of(np.random.default_rng(1).normal(size=(*SHAPE, 3)), None)
    write_vectors(path, field, FOCAL_POINT, provenance={}, overwrite=False)
    return path


@pytest.mark.thorough
@pytest.mark.parametrize("place", ["a name that is too long", "below a file", "a path that is too long"])
@pytest.mark.parametrize(
    "command",
    [
        ("simulate", "white", CONFIG, "-o", "{place}"),
        ("info", "{vectors}", "--picture", "{place}.png"),
        ("plot", "{vectors}", "-o", "{place}.png"),
        ("report", "{folder}", "-o", "{place}.html"),
        ("export", "{vectors}", "--to", "csv", "-o", "{place}.csv"),
        ("check", CONFIG, "--picture", "{place}.png"),
        ("check", CONFIG, "--log", "{place}.json"),
        ("init", "--camera", "table2", "-o", "{place}.yaml"),
        ("build-weights", CONFIG, "-o", "{place}.h5"),
        ("calibrate-snapshot", CONFIG, "--white", SAMPLE / "white.tif", "-o", "{place}.h5"),
        ("combine", "{vectors}", "{vectors}", "-o", "{place}.vtkhdf"),
        ("track", "{vectors}", "{vectors}", "-o", "{place}.vtkhdf"),
        ("validate", "flow", CONFIG, "--vectors", "{vectors}", "-o", "{place}"),
        ("run", CONFIG, SAMPLE / "pair_a.tif", SAMPLE / "pair_b.tif", "--white", SAMPLE / "white.tif", "-o", "{place}"),
    ],
    ids=lambda command: " ".join(map(str, command[:1])) + str(command[-2]),
)
def test_a_place_where_nothing_can_be_made_gives_7(
    tmp_path: Path, vectors: Path, command: tuple[object, ...], place: str
) -> None:
    (tmp_path / "file").touch()
    at = {
        "a name that is too long": tmp_path / ("x" * 300),
        "below a file": tmp_path / "file" / "x",
        "a path that is too long": tmp_path / "/".join(["x" * 100] * 50),
    }[place]
    words = [str(word).format(place=at, vectors=vectors, folder=vectors.parent) for word in command]
    code, said = ended(*words)
    assert code == 7
    assert len(said) < 400
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "command",
    [
        ("simulate", "white", CONFIG, "-o", "{place}"),
        ("plot", "{vectors}", "-o", "{place}/p.pdf", "--only", "planes"),
        ("export", "{vectors}", "--to", "csv", "-o", "{place}/v.csv"),
        ("combine", "{vectors}", "{vectors}", "-o", "{place}/c.vtkhdf"),
        ("correlate", "{vectors}", "--mean", "{place}/m.vtkhdf"),
        ("init", "--camera", "table2", "-o", "{place}/r.yaml"),
        ("init", "--camera", "table2", "-o", "{folder}/r.yaml", "--overwrite", "--log", "{place}/log.json"),
    ],
    ids=lambda command: " ".join(map(str, command[:2])),
)
def test_missing_folders_of_an_output_are_made(tmp_path: Path, vectors: Path, command: tuple[object, ...]) -> None:
    place = tmp_path / "new" / "deep"
    words = [str(word).format(place=place, vectors=vectors, folder=vectors.parent) for word in command]
    assert ended(*words) == (0, "")
    assert list(place.iterdir())


@pytest.mark.thorough
@pytest.mark.parametrize(
    "command",
    [
        ("validate", "flow", CONFIG, "--vectors", "{broken}", "-o", "{place}"),
        (
            "validate",
            "volume",
            CONFIG,
            "--volume",
            "{vectors}",
            "--particles",
            "{broken}",
            "--frame",
            "a",
            "-o",
            "{place}",
        ),
        ("validate", "weights", "{broken}", "-o", "{place}"),
        ("validate", "board", "{broken}", "-o", "{place}"),
        ("validate", "all", "{broken}", "-o", "{place}"),
        ("simulate", "particles", "{broken}", "-o", "{place}"),
        ("run", CONFIG, "{broken}", "{broken}", "--white", SAMPLE / "white.tif", "-o", "{place}"),
        ("run", CONFIG, *PAIR, "--white", "{broken}", "-o", "{place}"),
        ("reconstruct", "{broken}", *PAIR, "-o", "{place}"),
        ("follow", "{broken}", *PAIR, SAMPLE / "white.tif", SAMPLE / "dark.tif", "-o", "{place}"),
        ("correlate", "{vectors}", "{copy}", "-o", "{place}/v.vtkhdf"),
        ("track", "{vectors}", "{copy}", "-o", "{place}/t.vtkhdf"),
        ("report", "{empty}", "-o", "{place}/r.html"),
    ],
    ids=lambda command: " ".join(map(str, command[:2])),
)
def test_a_command_that_fails_leaves_no_folder(tmp_path: Path, vectors: Path, command: tuple[object, ...]) -> None:
    broken, copy, empty = tmp_path / "broken", tmp_path / "copy.vtkhdf", tmp_path / "empty"
    broken.write_bytes(b"{")
    copy.write_bytes(vectors.read_bytes())
    empty.mkdir()
    files = {"broken": broken, "copy": copy, "empty": empty, "vectors": vectors}
    words = [str(word).format(place=tmp_path / "new" / "deep", **files) for word in command]
    code, _ = ended(*words)
    assert code in (3, 4)
    assert sorted(os.listdir(tmp_path)) == ["broken", "copy.vtkhdf", "empty"]


@pytest.mark.parametrize("option", [(), ("--white",), ("--dark",)])
def test_an_input_that_may_not_be_read_gives_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: tuple[str, ...]
) -> None:
    image = tmp_path / "secret.tif"
    image.write_bytes((SAMPLE / "white.tif").read_bytes())
    allowed = os.access
    # Root may read everything, and tests often run as root.
    monkeypatch.setattr(os, "access", lambda path, mode: "secret" not in str(path) and allowed(path, mode))
    code, said = ended("check", CONFIG, *option, image)
    assert code == 4
    assert "secret.tif: cannot be read: permission denied" in said


@pytest.mark.skipif(sys.platform != "linux", reason="no limit of the address space")
def test_an_address_space_that_the_libraries_do_not_fit_into_is_told(tmp_path: Path) -> None:
    line = f"ulimit -v 500000; exec '{sys.executable}' -m lfpiv_cli build-weights '{CONFIG}' -o '{tmp_path}/w.h5'"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60)
    assert done.returncode == 7
    assert "too little memory: the address space of this process is limited to 0.51 GB" in done.stderr


@pytest.mark.parametrize(
    "error", [MemoryError(), MemoryError("Unable to allocate 3 GiB"), RuntimeError("can't start new thread")]
)
def test_too_little_memory_is_no_bug(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("lfpiv_cli.verbs.check.check", fail)
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
