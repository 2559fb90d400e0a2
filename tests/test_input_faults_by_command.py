"""Inputs that are damaged, of another kind, or made to do harm, each through a command that reads them."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile

from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume, write_volume
from lfpiv_cli.files.weights_file import FORMAT, UNITS, VERSION
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import FOCAL_POINT
from tests.hostile_files import edited, ended
from tests.test_config import HOSTILE_TEXT, IMPOSSIBLE, RIG
from tests.test_files import ABSURD_IMAGES, TIFF_KINDS
from tests.test_image_faults import COLUMNS, ROWS, weights

__all__ = ["weights"]

ROOT = Path(__file__).parent.parent
CONFIG, SAMPLE = ROOT / "configs" / "sample.yaml", ROOT / "sample_data"


# Images


def test_another_shape_is_refused_with_both(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "turned.tif", np.ones((COLUMNS, ROWS), np.uint16))
    code, said = ended("check", CONFIG, tmp_path / "turned.tif")
    assert code == 4
    for words in ("turned.tif", f"{ROWS} x {COLUMNS}", f"{COLUMNS} x {ROWS}"):
        assert words in said


@pytest.mark.thorough
def test_pages_of_another_shape_are_refused_with_both(tmp_path: Path, weights: Path) -> None:
    path = tmp_path / "pages.tif"
    tifffile.imwrite(path, tifffile.imread(SAMPLE / "pair_a.tif"))
    tifffile.imwrite(path, np.ones((30, 50), np.uint16), append=True)
    code, said = ended("reconstruct", weights, path, "--iterations", 1, "-o", tmp_path / "out")
    assert code == 4
    for words in ("pages.tif", "50 x 30", f"{COLUMNS} x {ROWS}"):
        assert words in said


def test_colour_is_refused(tmp_path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 255, (ROWS, COLUMNS, 3)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "colour.tif", image, photometric="rgb")
    (tmp_path / "colour.png").write_bytes(imagecodecs.png_encode(image))
    for name in ("colour.tif", "colour.png"):
        code, said = ended("check", CONFIG, tmp_path / name)
        assert (code, f"{name}: " in said, "greyscale" in said) == (4, True, True), said


@pytest.mark.parametrize("layout", [{}, {"rowsperstrip": 64}, {"tile": (64, 64)}], ids=str)
def test_bytes_after_what_is_too_short_are_no_pixels(tmp_path: Path, layout: dict) -> None:
    path = tmp_path / "short.tif"
    tifffile.imwrite(path, np.full((ROWS, COLUMNS), 100, np.uint16), photometric="minisblack", **layout)
    with tifffile.TiffFile(path, mode="r+") as file:
        lengths = file.pages[0].tags["TileByteCounts" if "tile" in layout else "StripByteCounts"]
        lengths.overwrite([lengths.value[0] // 2, *lengths.value[1:]])
    code, said = ended("check", CONFIG, path)
    assert (code, "short.tif: strip or tile 0 of page 0 has" in said) == (4, True), said


@pytest.mark.thorough
@pytest.mark.parametrize("percent", [1, 20, 40, 60, 80, 99])
def test_no_page_of_a_cut_recording_is_lost_in_silence(tmp_path: Path, weights: Path, percent: int) -> None:
    path = tmp_path / "cut.tif"
    pages = np.random.default_rng(1).integers(0, 4096, (3, ROWS, COLUMNS)).astype(np.uint16)
    tifffile.imwrite(path, pages, photometric="minisblack")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * percent // 100])
    code, said = ended("reconstruct", weights, path, "--iterations", 1, "-o", tmp_path / "out")
    assert (code, "cut.tif" in said) == (4, True), said


@pytest.mark.parametrize(
    "content", [content for content, _ in ABSURD_IMAGES], ids=[words for _, words in ABSURD_IMAGES]
)
def test_absurd_images_are_refused_by_a_command(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "t.img").write_bytes(content)
    begun = time.thread_time()
    code, said = ended("calibrate-snapshot", CONFIG, "--white", tmp_path / "t.img", "-o", tmp_path / "c.h5")
    assert (code, "t.img" in said) == (4, True), said
    assert time.thread_time() - begun < 1.0
    assert not (tmp_path / "c.h5").exists()


def read_all_absurd(folder: Path) -> None:
    """Have a command read each absurd image, in a process of its own, and print the most memory in MB that it had."""
    for content, _ in ABSURD_IMAGES:
        (folder / "t.img").write_bytes(content)
        assert ended("check", CONFIG, folder / "t.img")[0] == 4
    # getrusage would count what the process that began this one had
    status = Path("/proc/self/status").read_text(encoding="ascii")
    print(int(status.partition("VmHWM:")[2].split()[0]) / 1024)


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="Linux tells the most memory that a process had")
def test_absurd_images_take_no_memory(tmp_path: Path) -> None:
    code = "import sys, pathlib; from tests.test_input_faults_by_command import read_all_absurd\n"
    code += "read_all_absurd(pathlib.Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) < 500.0


@pytest.mark.thorough
def test_every_kind_of_tiff_gives_the_same_volume(tmp_path: Path, weights: Path) -> None:
    image = tifffile.imread(SAMPLE / "pair_a.tif")
    volumes = []
    for number, options in enumerate(TIFF_KINDS):
        frame, volume = tmp_path / f"f{number}.tif", tmp_path / f"f{number}.vtkhdf"
        tifffile.imwrite(frame, image, photometric="minisblack", **options)
        assert ended("reconstruct", weights, frame, "--iterations", 1, "-o", volume) == (0, "")
        volumes.append(open_volume(volume).array)
    assert volumes[0].any()
    for volume in volumes[1:]:
        np.testing.assert_array_equal(volume, volumes[0])


# Volumes without particles


def correlated(folder: Path, value: float, other: float) -> tuple[int, str]:
    """Correlate two volumes that are a value all over, but for one voxel of one of them, which is another value."""
    grid = Grid.centred((16, 16, 16), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    told = {"residual": np.ones(1), "excluded_pixels": 0, "support_voxels": 1}
    pair = [folder / f"{name}.vtkhdf" for name in "ab"]
    for path in pair:
        array = np.full(grid.shape_zyx, value)
        write_volume(path, array, grid, FOCAL_POINT, provenance={}, attributes=told, overwrite=False)
    with edited(pair[1]) as file:
        file["intensity"][3, 4, 5] = other
    words = ("--config", CONFIG, "--dt-s", 0.001, "--windows", 8, "-o", folder / "v.vtkhdf")
    return ended("correlate", *pair, *words)


@pytest.mark.thorough
@pytest.mark.parametrize("value", [0.0, 1.0, 65535.0, 1e30])
def test_no_vector_of_constant_volumes_is_an_unflagged_nan(tmp_path: Path, value: float) -> None:
    assert correlated(tmp_path, value, value) == (0, "")
    field = open_vectors(tmp_path / "v.vtkhdf")
    assert np.isfinite(field.displacement_voxel[field.flag == 0]).all()
    assert value or field.flag.all()


@pytest.mark.thorough
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_volumes_that_hold_no_numbers_are_refused(tmp_path: Path, value: float) -> None:
    code, said = correlated(tmp_path, 1.0, value)
    assert (code, "b.vtkhdf" in said) == (4, True), said
    assert not (tmp_path / "v.vtkhdf").exists()


# Configs


@pytest.mark.parametrize("content", [content for content, _ in HOSTILE_TEXT], ids=[words for _, words in HOSTILE_TEXT])
def test_hostile_text_gives_3(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "rig.yaml").write_bytes(content)
    begun = time.thread_time()
    code, said = ended("check", tmp_path / "rig.yaml")
    assert (code, "rig.yaml" in said) == (3, True), said
    assert time.thread_time() - begun < 1.0


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("magnification: -1.0", "magnification: .nan"),
        ("magnification: -1.0", "magnification: 1e400"),
        ("magnification: -1.0", "magnification: 1.0"),
        ("magnification: -1.0", "magnification: -1.0, magnification: -2.0"),
        ("pitch_mm", "pich_mm"),
        ("fluid: 1.33", "fluid: 0.9"),
        *((old, new) for old, new, _ in IMPOSSIBLE),
    ],
)
def test_possible_text_of_impossible_rigs_gives_3(tmp_path: Path, old: str, new: str) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.replace(old, new))
    code, said = ended("build-weights", rig, "-o", tmp_path / "w.h5")
    assert (code, "rig.yaml" in said) == (3, True), said
    assert not (tmp_path / "w.h5").exists()


# Weights


def damage(path: Path, kind: str) -> None:
    """Damage weights: at their end, within, in what they say of themselves, or in what they point at."""
    content = bytearray(path.read_bytes())
    if kind == "cut":
        del content[len(content) // 2 :]
    elif kind == "flipped":
        content[len(content) // 2] ^= 1
    elif kind == "zero tail":
        content[len(content) // 2 :] = bytes(len(content) - len(content) // 2)
    path.write_bytes(content)
    if kind == "version":
        with edited(path) as file:
            file.attrs["format_version"] = 999
    elif kind == "index":
        tree, provenance = read_tree(path, FORMAT, (VERSION,))
        tree["rows"]["cell"][7] = 10**6
        write_tree(
            path, tree, format_name=FORMAT, format_version=VERSION, provenance=provenance, overwrite=True, units=UNITS
        )


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["cut", "flipped", "zero tail", "version", "index"])
def test_damaged_weights_reconstruct_nothing(tmp_path: Path, weights: Path, kind: str) -> None:
    broken = tmp_path / "broken.h5"
    broken.write_bytes(weights.read_bytes())
    damage(broken, kind)
    code, said = ended("reconstruct", broken, SAMPLE / "pair_a.tif", "-o", tmp_path / "v.vtkhdf")
    assert (code, "broken.h5" in said) == (4, True), said
    assert not (tmp_path / "v.vtkhdf").exists()
