"""Inputs that are damaged, of another kind, or made to do harm, each through a command that reads them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile

from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume, write_vectors, write_volume
from lfpiv_cli.files.weights_file import FORMAT, UNITS, VERSION
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import FOCAL_POINT
from tests.hostile_files import edited, ended
from tests.test_config import HOSTILE_TEXT, IMPOSSIBLE, RIG
from tests.test_files import ABSURD_IMAGES, TIFF_KINDS
from tests.test_image_faults import COLUMNS, ROWS, weights
from tests.vector_fields import SHAPE, field_of

__all__ = ["weights"]

ROOT = Path(__file__).parent.parent
CONFIG, SAMPLE = ROOT / "configs" / "sample.yaml", ROOT / "sample_data"


# Inputs that are no file of the kind


COMMANDS = {
    "a config": ("build-weights", "{input}"),
    "an image": ("check", CONFIG, "{input}"),
    "a white image": ("calibrate-snapshot", CONFIG, "--white", "{input}"),
    "weights": ("reconstruct", "{input}", SAMPLE / "pair_a.tif"),
    "a page": ("report", "{input}"),
    "frames": ("reconstruct", SAMPLE / "no.h5", "{input}"),
    "volumes": ("correlate", "{input}", "{input}"),
    "particles": ("track", "{input}", "{input}"),
    "vectors": ("combine", "{input}", "{input}"),
    "vectors to judge": ("validate", "flow", CONFIG, "--vectors", "{input}"),
    "what is exported": ("export", "{input}", "--to", "csv"),
}


@pytest.mark.parametrize("what", COMMANDS)
def test_a_name_that_is_too_long_is_refused_by_each_command(tmp_path: Path, what: str) -> None:
    path = tmp_path / f"{'x' * 300}input.tif"
    words = [str(word).format(input=path) for word in COMMANDS[what]]
    output = tmp_path / ("output.vtkhdf" if what in ("weights", "volumes", "particles", "vectors") else "output.html")
    words += [] if words[0] == "check" else ["-o", str(output)]
    code, said = ended(*words)
    assert (code, "input.tif" in said) == (4, True), said
    assert not output.exists()


@pytest.mark.parametrize(
    "command",
    [
        ("check", "{input}"),
        ("build-weights", "{input}", "-o", "{output}"),
        ("calibrate-snapshot", "{input}", "--white", SAMPLE / "white.tif", "-o", "{output}"),
        (
            "run",
            "{input}",
            SAMPLE / "pair_a.tif",
            SAMPLE / "pair_b.tif",
            "--white",
            SAMPLE / "white.tif",
            "-o",
            "{output}",
        ),
        ("simulate", "white", "{input}", "-o", "{output}"),
        ("validate", "board", "{input}", "-o", "{output}"),
        ("correlate", "{volume}", "{copy}", "--config", "{input}", "-o", "{output}.vtkhdf"),
    ],
    ids=lambda command: command[0],
)
def test_an_image_or_a_result_in_place_of_a_config_is_told(tmp_path: Path, command: tuple[object, ...]) -> None:
    volume, copy, png = tmp_path / "v.vtkhdf", tmp_path / "copy.vtkhdf", tmp_path / "rig.png"
    grid = Grid.centred((3, 3, 3), (0.1,) * 3, (0.0,) * 3)
    write_volume(volume, np.ones((3, 3, 3)), grid, FOCAL_POINT, provenance={}, attributes={}, overwrite=False)
    copy.write_bytes(volume.read_bytes())
    png.write_bytes(imagecodecs.png_encode(np.ones((9, 9), np.uint8)))
    kinds = {SAMPLE / "white.tif": "an image (TIFF)", png: "an image (PNG)", volume: "an HDF5 file"}
    for given, kind in kinds.items():
        words = [
            str(word).format(input=given, output=tmp_path / "output", volume=volume, copy=copy) for word in command
        ]
        assert ended(*words) == (3, f"{given}: is {kind}; expected a rig file")
    assert sorted(os.listdir(tmp_path)) == ["copy.vtkhdf", "rig.png", "v.vtkhdf"]


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


@pytest.mark.parametrize("kind", ["a strip that is too long", "a PNG that is too long", "no image"])
def test_gigabytes_that_are_no_image_are_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    path = tmp_path / ("big.png" if "PNG" in kind else "big.tif")
    image = np.full((ROWS, COLUMNS), 100, np.uint16)
    if kind == "a strip that is too long":
        tifffile.imwrite(path, image, photometric="minisblack", compression="zlib", rowsperstrip=ROWS)
        with tifffile.TiffFile(path, mode="r+") as file:
            file.pages[0].tags["StripByteCounts"].overwrite([3_000_000_000])
    else:
        path.write_bytes(imagecodecs.png_encode(image) if "PNG" in kind else b"II*\0\x08\0\0\0")
    os.truncate(path, 3 * 2**30)  # sparse
    # Neither its bytes nor, for a record that nobody will get, their SHA-256.
    monkeypatch.setattr(Path, "read_bytes", lambda path: pytest.fail(f"{path} is read"))
    monkeypatch.setattr("lfpiv_cli.files.provenance._sha256", lambda path, *_: pytest.fail(f"{path} is hashed"))
    code, said = ended("calibrate-snapshot", CONFIG, "--white", path, "-o", tmp_path / "c.h5")
    assert (code, f"{path.name}: " in said) == (4, True), said


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


# Vectors


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("dt_s", [0.1, None])
def test_displacements_that_are_no_numbers_are_refused(tmp_path: Path, value: float, dt_s: float | None) -> None:
    path = tmp_path / "v.vtkhdf"
    field = replace(field_of(np.ones((*SHAPE, 3)), None), dt_s=dt_s)
    write_vectors(path, field, FOCAL_POINT, provenance={}, overwrite=False)
    with edited(path) as file:
        file["displacement_voxel"][1, 2, 3, 0] = value
    for words in (("combine", path, path, "-o", tmp_path / "c.vtkhdf"), ("export", path, "--to", "csv")):
        code, said = ended(*words)
        assert (code, "v.vtkhdf: a vector that counts as valid is not a finite number" in said) == (4, True), said


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
