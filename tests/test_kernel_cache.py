"""Compiled kernels find a place wherever the program runs, read-only containers included."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lfpiv_cli.files import kernel_cache

ROOT = Path(__file__).parents[1]
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


def nowhere(path: Path) -> bool:
    return False


def test_a_place_that_can_be_written_is_numbas_own_affair(process: pytest.MonkeyPatch, tmp_path: Path) -> None:
    process.setenv(kernel_cache.VARIABLE, str(tmp_path / "made" / "later"))
    kernel_cache.ensure_place()
    assert os.environ[kernel_cache.VARIABLE] == str(tmp_path / "made" / "later")
    assert not kernel_cache.lost


def test_without_any_place_the_process_has_one_of_its_own(process: pytest.MonkeyPatch) -> None:
    process.setattr(kernel_cache, "_is_writable", nowhere)
    kernel_cache.ensure_place()
    place = Path(os.environ[kernel_cache.VARIABLE])
    assert place.is_dir()
    assert kernel_cache.lost


def test_a_filled_folder_that_is_read_only_is_copied(process: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "one.nbi").write_bytes(b"compiled")
    process.setenv(kernel_cache.VARIABLE, str(tmp_path))
    process.setattr(kernel_cache, "_is_writable", nowhere)
    kernel_cache.ensure_place()
    place = Path(os.environ[kernel_cache.VARIABLE])
    assert place != tmp_path
    assert (place / "kernels" / "one.nbi").read_bytes() == b"compiled"
    assert not kernel_cache.lost


def test_a_file_in_the_way_is_no_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert not kernel_cache._is_writable(tmp_path / "file" / "cache")
    assert kernel_cache._is_writable(tmp_path / "cache")


def test_kernels_of_changed_files_and_of_those_that_import_them_go(tmp_path: Path) -> None:
    package = tmp_path / "made"
    (package / "optics" / "__pycache__").mkdir(parents=True)
    code = {
        "base": "HALF = 0.5",
        "lens": "from made.optics.base import HALF",
        "camera": "from made.optics import lens",
        "wall": "import numpy",
    }
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
    data, cache, out = ROOT / "sample_data", tmp_path / "cache", tmp_path / "out"
    lfpiv = [sys.executable, "-m", "lfpiv_cli"]
    subprocess.run([*lfpiv, "warm-up", "--cache", str(cache)], cwd=ROOT, check=True)
    before = set(cache.rglob("*.nbc"))
    photographs = [f"--{name}={data / name}.tif" for name in ("white", "dark", "board")]
    images = [str(data / f"pair_{name}.tif") for name in "ab"]
    subprocess.run(
        [*lfpiv, "run", str(ROOT / "configs" / "sample.yaml"), *images, *photographs, "--method", "both"]
        + ["-o", str(out)],
        cwd=ROOT,
        check=True,
        env=os.environ | {kernel_cache.VARIABLE: str(cache)},
    )
    assert before
    assert sorted(path.name for path in set(cache.rglob("*.nbc")) - before) == []
