"""Files in and out: what is refused, what survives faults, and what other programs see."""

from __future__ import annotations

import contextlib
import json
import os
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import imagecodecs
import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import InputError, OutputError, OutputExistsError, UsageError
from lfpiv_cli.files import atomic
from lfpiv_cli.files.atomic import ensure_writable, folder_of, write_atomically, write_json
from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.files.images import count_pages, read_image, read_page, write_tiff
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume, read_header, write_vectors, write_volume
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import Reference
from tests.hostile_files import edited, make_no_file

ROOT = Path(__file__).parent.parent
GRID = Grid.centred((4, 3, 2), (0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
REFERENCE = Reference("mid_plane", -0.3)
TREE = {
    "array": np.arange(24.0).reshape(2, 3, 4),
    "group": {
        "index": np.arange(5, dtype=np.int32),
        "none_left": np.zeros((0, 3)),
        "name": "micro é",
        "nothing": None,
        "empty": "",
        "count": 3,
        "length_mm": 1.5,
        "yes": True,
    },
}


def save_tree(path: Path, overwrite: bool = False) -> Path:
    write_tree(
        path,
        TREE,
        format_name="lfpiv-test",
        format_version=2,
        provenance={"command": "test"},
        overwrite=overwrite,
        units={"array": "mm", "index": "1", "none_left": "1"},
    )
    return path


def load_tree(path: Path) -> dict:
    return read_tree(path, "lfpiv-test", (2,))[0]


def pages_of(path: Path, shape: tuple[int, int] | None = None) -> list[np.ndarray]:
    """Every page of an image file, as a batch reads them."""
    return [read_page(path, page, shape) for page in range(count_pages(path))]


def refused(read: Callable[[], object], *words: str) -> bool:
    """Return whether a read is refused with an `InputError` that holds the words; other exceptions pass through."""
    try:
        read()
    except InputError as error:
        message = str(error)
    else:
        return False
    assert all(word in message for word in words), message
    return True


def test_an_array_without_a_unit_is_not_written(tmp_path: Path) -> None:
    made = {"format_name": "lfpiv-test", "format_version": 1, "provenance": {}, "overwrite": False}
    with pytest.raises(ValueError, match="array has no unit"):
        write_tree(tmp_path / "t.h5", {"group": {"array": np.zeros(3)}}, **made)
    assert not os.listdir(tmp_path)


# Atomic writing


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    target.write_bytes(b"old")

    def fail(temporary: Path) -> None:
        temporary.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(target, fail, overwrite=True)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_what_does_not_read_back_is_not_published(tmp_path: Path) -> None:
    def check(temporary: Path) -> None:
        raise InputError("wrong")

    with pytest.raises(OutputError, match="does not read back"):
        write_atomically(tmp_path / "out", lambda path: None, overwrite=False, check=check)
    assert os.listdir(tmp_path) == []


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_atomically(tmp_path / "out", lambda path: None, overwrite=False)
    finally:
        os.umask(before)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o640


def test_early_refusals(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.touch()
    link = tmp_path / "link"
    link.symlink_to(old)
    with pytest.raises(OutputExistsError, match="old"):
        ensure_writable(old, overwrite=False)
    ensure_writable(old, overwrite=True)
    with pytest.raises(UsageError, match="also an input"):
        ensure_writable(old, overwrite=True, inputs=[tmp_path / "other", link])
    with pytest.raises(OutputError, match="folder"):
        ensure_writable(tmp_path, overwrite=True)


def test_missing_folders_are_made_with_the_first_file_in_them_and_not_before(tmp_path: Path) -> None:
    target = tmp_path / "new" / "deep" / "out"
    ensure_writable(target, overwrite=False)
    assert os.listdir(tmp_path) == []
    with pytest.raises(OutputError, match="does not read back"):
        write_atomically(target, lambda _: None, overwrite=False, check=lambda _: fail_as_wrong())
    assert os.listdir(tmp_path) == []
    with folder_of(target), folder_of(target.with_name("other")):
        assert target.parent.is_dir()
        (target.parent / "kept").touch()
    assert os.listdir(target.parent) == ["kept"]
    (tmp_path / "before").mkdir()
    with folder_of(tmp_path / "before" / "after" / "out"):
        pass
    assert os.listdir(tmp_path / "before") == []


def fail_as_wrong() -> None:
    raise InputError("wrong")


@pytest.mark.parametrize("place", ["file/new/out", f"new/{'x' * 300}/out", "shut/new/out"])
def test_folders_that_cannot_be_made_are_refused_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "shut").mkdir()
    allowed = os.access
    # Root may write everywhere, and tests often run as root.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "shut" and allowed(path, mode))
    with pytest.raises(OutputError, match="is not a folder|is read-only|name too long"):
        ensure_writable(tmp_path / place, overwrite=False)
    assert sorted(os.listdir(tmp_path)) == ["file", "shut"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_folder_is_refused_early(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="read-only"):
        ensure_writable(tmp_path / "out", overwrite=False)


@pytest.mark.parametrize("name", ["two words", "line\nbreak", "-leading", "ends.", os.fsdecode(b"\xff\xfe"), "é" * 100])
def test_odd_names_work(tmp_path: Path, name: str) -> None:
    assert "array" in load_tree(save_tree(tmp_path / f"{name}.h5"))
    write_tiff(tmp_path / f"{name}.tif", np.ones((3, 4), np.uint8), overwrite=False)
    assert read_image(tmp_path / f"{name}.tif").shape == (3, 4)
    json.dumps(record("test", None, {"image": tmp_path / f"{name}.tif"})).encode("ascii")


def test_json_never_holds_nan(tmp_path: Path) -> None:
    value = {"a": float("nan"), "b": [np.float32("inf"), np.array([1.0, np.nan])], "c": {"d": np.int64(3), "e": True}}
    write_json(tmp_path / "out.json", value, overwrite=False)
    found = json.loads((tmp_path / "out.json").read_text(), parse_constant=lambda word: pytest.fail(word))
    assert found == {"a": None, "b": [None, [1.0, None]], "c": {"d": 3, "e": True}}


def write_under_limits(path: Path) -> None:
    """Write under 40 limits on the size of files, in a process of its own: a crash would take this one with it."""
    import resource

    array = np.random.default_rng(0).random((3, 60, 60))

    def write() -> None:
        write_tree(path, {"a_mm": array}, format_name="t", format_version=1, provenance={}, overwrite=True)

    write()
    old = path.read_bytes()
    for limit in np.linspace(0, len(old) - 1, 40).astype(int):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), resource.RLIM_INFINITY))
        with pytest.raises(OutputError, match="File too large"):
            write()
        assert path.read_bytes() == old
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
def test_a_full_disk_is_an_error_and_never_a_crash(tmp_path: Path) -> None:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\nimport pathlib, test_files\n"
    code += f"test_files.write_under_limits(pathlib.Path({str(tmp_path / 'full.h5')!r}))"
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0, done.stderr


# HDF5


def test_tree_round_trip(tmp_path: Path) -> None:
    tree, provenance = read_tree(save_tree(tmp_path / "t.h5"), "lfpiv-test", (1, 2))
    assert provenance == {"command": "test"}
    assert tree["array"].dtype == np.float64
    np.testing.assert_array_equal(tree["array"], TREE["array"])
    for name, value in TREE["group"].items():
        np.testing.assert_array_equal(tree["group"][name], value)
        assert type(tree["group"][name]) is type(value)
    with h5py.File(tmp_path / "t.h5") as file:
        assert file["array"].attrs["units"] == b"mm"
        assert file["array"].fletcher32


@pytest.mark.thorough
def test_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    first = save_tree(tmp_path / "a.h5").read_bytes()
    time.sleep(1.1)  # HDF5 keeps times in seconds
    assert save_tree(tmp_path / "b.h5").read_bytes() == first


@pytest.mark.thorough
@pytest.mark.parametrize("damage", ["cut", "flipped", "zero tail"])
def test_damage_is_never_read_as_data(tmp_path: Path, damage: str) -> None:
    whole = save_tree(tmp_path / "t.h5").read_bytes()
    expected = str(load_tree(tmp_path / "t.h5"))
    path = tmp_path / "damaged.h5"
    errors = 0
    for place in range(0, len(whole), 5):
        content = bytearray(whole)
        if damage == "cut":
            del content[place:]
        elif damage == "flipped":
            content[place] ^= 0x10
        else:
            content[place:] = bytes(len(whole) - place)
        path.write_bytes(content)
        if refused(lambda: load_tree(path), "damaged.h5"):
            errors += 1
        else:
            assert str(load_tree(path)) == expected
    assert errors > (len(whole) / 5 - 1 if damage == "cut" else 100)


def test_other_formats_and_versions_are_refused(tmp_path: Path) -> None:
    path = save_tree(tmp_path / "t.h5")
    assert refused(lambda: read_tree(path, "lfpiv-weights", (2,)), "holds lfpiv-test, expected lfpiv-weights")
    assert refused(lambda: read_tree(path, "lfpiv-test", (3, 4)), "version 2", "reads 3, 4")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["a"] = 1.0
    assert refused(lambda: load_tree(tmp_path / "foreign.h5"), "no format of ours")


def hostile(path: Path, kind: str) -> Path:
    """Write a file of our format that leads elsewhere or declares what it does not hold."""
    save_tree(path)
    secret = path.with_name("secret.h5")
    with h5py.File(secret, "w") as file:
        file["array"] = np.full(24, 7.0)
    with h5py.File(path, "r+") as file:
        del file["array"]
        if kind == "external link":
            file["array"] = h5py.ExternalLink(secret.name, "/array")
        elif kind == "soft link":
            file["array"] = h5py.SoftLink("/group/index")
        elif kind == "external storage":
            file.create_dataset("array", (24,), "f8", external=[(str(secret), 0, h5py.h5f.UNLIMITED)])
        elif kind == "virtual dataset":
            layout = h5py.VirtualLayout((24,), "f8")
            layout[:] = h5py.VirtualSource(str(secret), "array", (24,))
            file.create_virtual_dataset("array", layout)
        elif kind == "huge shape":
            file.create_dataset("array", (10**6, 10**6, 10**3), "f8", chunks=(100, 100, 100))
        elif kind == "large and never written":
            file.create_dataset("array", (10**8,), "u1")
        elif kind == "never written":
            file.create_dataset("array", (100,), "f8")
        elif kind == "chunks not written":
            file.create_dataset("array", (100, 100), "f8", chunks=(10, 10))
        elif kind == "strings":
            file.create_dataset("array", (3,), h5py.string_dtype())
        elif kind == "circle":
            file["array"] = file["group"]
            file["group/again"] = file["group"]
    return path


@pytest.mark.parametrize(
    "kind",
    [
        "external link",
        "soft link",
        "external storage",
        "virtual dataset",
        "huge shape",
        "large and never written",
        "never written",
        "chunks not written",
        "strings",
        "circle",
    ],
)
def test_hostile_hdf5_is_refused(tmp_path: Path, kind: str) -> None:
    path = hostile(tmp_path / "t.h5", kind)
    start = time.perf_counter()
    assert refused(lambda: load_tree(path), "t.h5: not a readable")
    assert time.perf_counter() - start < 1.0


# What is no file


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes in folders")
@pytest.mark.parametrize("kind", ["missing", "folder", "pipe", "empty", "text"])
@pytest.mark.parametrize("read", [read_image, count_pages, load_tree, open_volume, open_vectors])
def test_what_is_no_file_is_refused_without_waiting(tmp_path: Path, kind: str, read: Callable) -> None:
    path = tmp_path / "input"
    make_no_file(path, kind)
    assert refused(lambda: read(path), "input: ")


# Volumes and vectors


def vectors(grid: Grid = GRID, uncertainty: bool = True) -> VectorField:
    rng = np.random.default_rng(5)
    shape = grid.shape_zyx
    displacement = rng.normal(size=(*shape, 3))
    flag = rng.integers(0, 5, shape).astype(np.uint8)
    displacement[flag == 3] = np.nan
    return VectorField(
        grid=grid,
        displacement_voxel=displacement,
        displacement_raw_voxel=rng.normal(size=(*shape, 3)),
        correlation=rng.random(shape),
        peak_ratio=rng.random(shape),
        valid_fraction=rng.random(shape),
        flag=flag,
        uncertainty_voxel=rng.random((*shape, 3)) if uncertainty else None,
        voxel_mm=(0.1, 0.1, 0.2),
        dt_s=0.0018,
        window_voxel=(16, 16, 8),
    )


def save_volume(path: Path, array: np.ndarray, grid: Grid = GRID) -> Path:
    attributes = {"residual": np.array([1.0, 0.5]), "unknown": None}
    write_volume(
        path, array, grid, REFERENCE, provenance=record("test", None, {}), attributes=attributes, overwrite=False
    )
    return path


@pytest.mark.parametrize("shape", [(4, 3, 2), (4, 3, 1), (1, 3, 2), (1, 1, 1)])
def test_volume_round_trip(tmp_path: Path, rng: np.random.Generator, shape: tuple[int, int, int]) -> None:
    grid = Grid.centred(shape, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
    array = rng.random(grid.shape_zyx).astype(np.float32)
    volume = open_volume(save_volume(tmp_path / "v.vtkhdf", array, grid))
    np.testing.assert_array_equal(volume.array, array)
    assert volume.grid == grid
    assert volume.attributes == {"reference": "mid_plane", "reference_z_mm": -0.3, "residual": [1.0, 0.5]}
    assert volume.reference == REFERENCE
    assert volume.provenance["command"] == "test"


@pytest.mark.parametrize("uncertainty", [True, False])
def test_vectors_round_trip(tmp_path: Path, uncertainty: bool) -> None:
    field = vectors(uncertainty=uncertainty)
    path = tmp_path / "v.vtkhdf"
    write_vectors(path, field, REFERENCE, provenance={}, overwrite=False)
    found = open_vectors(path)
    for name in ("displacement_voxel", "displacement_raw_voxel", "correlation", "peak_ratio", "valid_fraction", "flag"):
        np.testing.assert_array_equal(getattr(found, name), getattr(field, name))
    np.testing.assert_array_equal(found.velocity, field.velocity)
    assert (found.uncertainty_voxel is not None) == uncertainty
    assert (found.grid, found.voxel_mm, found.dt_s, found.window_voxel) == (GRID, (0.1, 0.1, 0.2), 0.0018, (16, 16, 8))
    assert read_header(path).reference == REFERENCE
    with h5py.File(path) as file:
        velocity = file["VTKHDF/PointData/velocity"][()]
    np.testing.assert_array_equal(np.isfinite(velocity).all(-1), field.flag <= 2)


@pytest.mark.thorough
@pytest.mark.parametrize("nz", [1, 2])
def test_paraviews_reader_opens_the_very_files(tmp_path: Path, rng: np.random.Generator, nz: int) -> None:
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    grid = Grid.centred((4, 3, nz), (0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
    array = rng.random(grid.shape_zyx)
    field = vectors(grid)
    write_vectors(tmp_path / "w.vtkhdf", field, REFERENCE, provenance={}, overwrite=False)
    found = {}
    for name in (save_volume(tmp_path / "v.vtkhdf", array, grid), tmp_path / "w.vtkhdf"):
        reader = vtk.vtkHDFReader()
        reader.SetFileName(str(name))
        reader.Update()
        image = reader.GetOutput()
        assert image.GetDimensions() == grid.shape_xyz
        assert image.GetOrigin() == pytest.approx(grid.origin_mm)
        assert image.GetSpacing() == pytest.approx(grid.spacing_mm)
        data = image.GetPointData()
        names = [data.GetArrayName(k) for k in range(data.GetNumberOfArrays())]
        found |= {name: vtk_to_numpy(data.GetArray(name)) for name in names}
    np.testing.assert_array_equal(found["intensity"], array.astype(np.float32).ravel())
    np.testing.assert_array_equal(found["velocity"], field.velocity.reshape(-1, 3))
    np.testing.assert_array_equal(found["flag"], field.flag.ravel())
    assert found.keys() >= {"displacement_voxel", "displacement_raw_voxel", "peak_ratio", "uncertainty_voxel"}


@pytest.mark.thorough
def test_xarray_opens_the_very_files(tmp_path: Path, rng: np.random.Generator) -> None:
    xarray = pytest.importorskip("xarray")
    array = rng.random(GRID.shape_zyx).astype(np.float32)
    with xarray.open_dataset(save_volume(tmp_path / "v.vtkhdf", array), engine="h5netcdf") as data:
        assert data.intensity.dims == ("z", "y", "x")
        np.testing.assert_allclose(data.x, GRID.axis_mm(0))
        np.testing.assert_array_equal(data.intensity, array)
        assert data.x.attrs["units"] == "mm"


def test_volume_and_vectors_are_not_taken_for_each_other(tmp_path: Path) -> None:
    path = save_volume(tmp_path / "v.vtkhdf", np.zeros(GRID.shape_zyx))
    assert refused(lambda: open_vectors(path), "v.vtkhdf: holds lfpiv-volume, expected lfpiv-vectors")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda file: file["VTKHDF"].attrs.__setitem__("WholeExtent", [0, 3, 0, 2, 0, 2]), "its extent says"),
        (lambda file: file["VTKHDF"].attrs.__setitem__("WholeExtent", [1, 3, 0, 2, 0, 1]), "starts at 0"),
        (lambda file: file["VTKHDF"].attrs.__setitem__("Spacing", [0.1, 0.0, 0.1]), "spacing"),
        (lambda file: file["VTKHDF"].attrs.__setitem__("Spacing", [0.1, 0.1]), "one entry for each axis"),
        (lambda file: file["VTKHDF"].attrs.__setitem__("Spacing", [0.1, 0.1, 1j]), "Spacing has type complex128"),
        (lambda file: file["VTKHDF"].attrs.__setitem__("Origin", [0.1, np.nan, 0.1]), "origin"),
        (lambda file: file["intensity"].__setitem__((0, 0, 0), np.nan), "1 voxels are not finite"),
        (lambda file: file.__delitem__("intensity"), "intensity"),
        (lambda file: (file.__delitem__("intensity"), file.create_group("intensity")), "is a group, expected an array"),
        (lambda file: (file.__delitem__("VTKHDF"), file.create_dataset("VTKHDF", data=[1])), "WholeExtent"),
        (lambda file: file.attrs.__setitem__("provenance", np.bytes_(b"[1]")), "its provenance is not a record"),
        (lambda file: file.attrs.__setitem__("provenance", np.bytes_(b"[" * 100_000)), "maximum recursion depth"),
        (lambda file: file.attrs.__setitem__("format_version", [1, 1]), "format_version"),
        (lambda file: file.__delitem__("VTKHDF"), "VTKHDF"),
    ],
)
def test_a_volume_that_contradicts_itself_is_refused(tmp_path: Path, damage: Callable, words: str) -> None:
    path = save_volume(tmp_path / "v.vtkhdf", np.zeros(GRID.shape_zyx))
    with edited(path) as file:
        damage(file)
    assert refused(lambda: open_volume(path), "v.vtkhdf", words)


# Provenance


def test_records_are_carried_along_and_say_nothing_of_time_or_place(tmp_path: Path) -> None:
    (tmp_path / "raw.tif").write_bytes(b"raw")
    first = record("simulate", {"a": (1, 2)}, {"image": tmp_path / "raw.tif"})
    write_tree(tmp_path / "w.h5", {}, format_name="w", format_version=1, provenance=first, overwrite=False)
    second = record("reconstruct", None, {"weights": tmp_path / "w.h5"})
    write_tree(tmp_path / "v.h5", {}, format_name="v", format_version=1, provenance=second, overwrite=False)
    third = record("correlate", None, {"b": tmp_path / "v.h5", "a": tmp_path / "w.h5"})
    assert third["inputs"]["b"]["name"] == "v.h5"
    assert {made["command"] for made in third["made_from"].values()} == {"simulate", "reconstruct"}
    assert third["made_from"][third["inputs"]["a"]["sha256"]]["config"] == {"a": [1, 2]}
    assert all("made_from" not in made for made in third["made_from"].values())
    text = json.dumps(third)
    assert str(tmp_path) not in text
    assert text == json.dumps(record("correlate", None, {"a": tmp_path / "w.h5", "b": tmp_path / "v.h5"}))


# Images

FRAMES = np.random.default_rng(1).integers(0, 4096, (3, 40, 50)).astype(np.uint16)


TIFF_KINDS = [
    {},
    {"byteorder": ">"},
    {"bigtiff": True},
    {"tile": (16, 16)},
    {"tile": (16, 16), "compression": "zlib"},
    {"compression": "zlib", "predictor": True},
    {"compression": "lzw", "predictor": True},
    {"compression": "zstd"},
    {"compression": "packbits"},
    {"rowsperstrip": 7, "compression": "lzw", "byteorder": ">"},
    {"imagej": True},
]


@pytest.mark.thorough
@pytest.mark.parametrize("options", TIFF_KINDS, ids=str)
def test_every_kind_of_tiff_gives_the_same_frames_and_none_is_lost(tmp_path: Path, options: dict) -> None:
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, FRAMES, photometric="minisblack", **options)
    assert count_pages(path) == 3
    np.testing.assert_array_equal(pages_of(path, (40, 50)), FRAMES)
    assert read_page(path, 2).dtype == np.float32
    whole = path.read_bytes()
    for percent in range(1, 100):
        path.write_bytes(whole[: len(whole) * percent // 100])
        assert refused(lambda: pages_of(path), "t.tif: "), percent


@pytest.mark.parametrize("kind", ["u1", "u2", "u4", "i2", "f4", "f8"])
def test_kinds_of_pixels(tmp_path: Path, kind: str) -> None:
    image = FRAMES[0].astype(kind)
    tifffile.imwrite(tmp_path / "t.tif", image, photometric="minisblack")
    np.testing.assert_array_equal(read_image(tmp_path / "t.tif"), image.astype(np.float32))


def test_not_a_number_is_passed_on(tmp_path: Path) -> None:
    image = np.array([[1.0, np.nan], [np.inf, 1e300]])
    tifffile.imwrite(tmp_path / "t.tif", image, photometric="minisblack")
    np.testing.assert_array_equal(read_image(tmp_path / "t.tif"), [[1.0, np.nan], [np.inf, np.inf]])


@pytest.mark.parametrize("bits", [8, 16])
def test_png(tmp_path: Path, bits: int) -> None:
    path = tmp_path / "t.png"
    image = FRAMES[0].astype(f"u{bits // 8}")
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    np.testing.assert_array_equal(read_image(path, (40, 50)), image)
    assert count_pages(path) == 1
    whole = path.read_bytes()
    for percent in range(1, 100):
        path.write_bytes(whole[: len(whole) * percent // 100])
        assert refused(lambda: read_image(path), "t.png: "), percent
    path.write_bytes(whole[:100] + bytes([whole[100] ^ 1]) + whole[101:])
    assert refused(lambda: read_image(path), "check sum")


GREY = FRAMES[0].astype(np.uint8)
# As other programs save a grey image: its channel three times, together or apart, an opaque one beside, or a palette.
IN_COLOUR = {
    "rgb": (np.stack([GREY] * 3, axis=-1), {"photometric": "rgb"}),
    "apart": (np.stack([GREY] * 3), {"photometric": "rgb", "planarconfig": "separate"}),
    "16 bits": (np.stack([FRAMES[0]] * 3, axis=-1), {"photometric": "rgb"}),
    "opaque": (np.stack([GREY] * 3 + [np.full_like(GREY, 255)], axis=-1), {"photometric": "rgb", "extrasamples": [2]}),
    "palette": (GREY, {"photometric": "palette", "colormap": np.tile(np.arange(256) * 257, (3, 1)).astype(np.uint16)}),
}


@pytest.mark.parametrize("kind", IN_COLOUR)
def test_grey_saved_as_colour_is_read(tmp_path: Path, kind: str) -> None:
    image, options = IN_COLOUR[kind]
    tifffile.imwrite(tmp_path / "t.tif", image, **options)
    grey = FRAMES[0] if kind == "16 bits" else GREY
    np.testing.assert_array_equal(read_image(tmp_path / "t.tif", (40, 50)), grey)
    if kind in ("rgb", "16 bits", "opaque"):
        (tmp_path / "t.png").write_bytes(imagecodecs.png_encode(image))
        np.testing.assert_array_equal(read_image(tmp_path / "t.png", (40, 50)), grey)


@pytest.mark.parametrize("kind", ["rgb", "apart", "opaque", "palette", "miniswhite"])
def test_colour_is_refused_with_a_hint(tmp_path: Path, kind: str) -> None:
    image, options = IN_COLOUR.get(kind, (GREY, {"photometric": kind}))
    if kind == "palette":
        options = options | {"colormap": options["colormap"] // np.array([[1], [1], [2]], np.uint16)}
    elif kind != "miniswhite":
        image = image.copy()
        # one pixel's blue, or how transparent it is
        image[(2, 5, 7) if kind == "apart" else (5, 7, -1)] ^= 1
    tifffile.imwrite(tmp_path / "t.tif", image, **options)
    assert refused(lambda: read_image(tmp_path / "t.tif"), "save the sensor's raw image as greyscale")
    if kind in ("rgb", "opaque"):
        (tmp_path / "t.png").write_bytes(imagecodecs.png_encode(image))
        assert refused(lambda: read_image(tmp_path / "t.png"), "save the sensor's raw image as greyscale")


def test_another_size_is_refused_with_both(tmp_path: Path) -> None:
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, FRAMES[0], photometric="minisblack")
    tifffile.imwrite(path, FRAMES[0, :30], photometric="minisblack", append=True)
    assert refused(lambda: pages_of(path, (40, 50)), "page 1 is 50 x 30 pixels", "50 x 40")
    assert refused(lambda: read_page(path, 0, (1768, 2352)), "page 0 is 50 x 40", "2352 x 1768")
    assert refused(lambda: read_page(path, 2), "no page 2, it holds 2")
    assert refused(lambda: read_image(path), "holds 2 pages, expected a single image")


@pytest.mark.parametrize("options", [{}, {"imagej": True}])
def test_frames_hidden_behind_one_page_are_not_lost_in_silence(tmp_path: Path, options: dict) -> None:
    tifffile.imwrite(tmp_path / "t.tif", FRAMES, photometric="minisblack", truncate=True, **options)
    assert refused(lambda: count_pages(tmp_path / "t.tif"), "holds 1 pages and says 3 frames")


def tiff(columns: int, rows: int, data: bytes, compression: int, following: int = 0, software_at: int = 8) -> bytes:
    """Return a TIFF file of one 16-bit strip that declares what it likes; its program's name has 8 letters."""
    entries = [(256, 1, columns), (257, 1, rows), (258, 1, 16), (259, 1, compression), (262, 1, 1)]
    entries += [(273, 1, 8 + 2 + 10 * 12 + 4), (277, 1, 1), (278, 1, rows), (279, 1, len(data)), (305, 8, software_at)]
    kinds = [2 if tag == 305 else 4 for tag, _, _ in entries]
    packed = [struct.pack("<HHII", tag, kind, *rest) for (tag, *rest), kind in zip(entries, kinds, strict=True)]
    directory = struct.pack("<H", len(entries)) + b"".join(packed)
    return b"II*\0" + struct.pack("<I", 8) + directory + struct.pack("<I", following) + data


def png(columns: int, rows: int, data: bytes) -> bytes:
    """Return a PNG file with right check sums that declares what it likes."""

    def part(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", columns, rows, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", data) + part(b"IEND", b"")


def test_an_honest_tiff_of_that_kind_is_read(tmp_path: Path) -> None:
    (tmp_path / "t.tif").write_bytes(tiff(100, 100, NOTHING, 8))
    np.testing.assert_array_equal(read_image(tmp_path / "t.tif"), np.zeros((100, 100)))


NOTHING = zlib.compress(bytes(20_000))


# What is no image that could be, and words of what is said of it.
ABSURD_IMAGES = [
    (tiff(400_000, 400_000, NOTHING, 8), "declares 400000 x 400000"),
    (tiff(12_000, 12_000, NOTHING, 8), "more than"),
    (tiff(100, 100, zlib.compress(bytes(10**8)), 8), "cannot be decoded"),
    (tiff(100, 100, imagecodecs.zstd_encode(bytes(10**8)), 50_000), "cannot be decoded"),
    (tiff(100, 100, zlib.compress(bytes(100)), 8), "cannot be decoded"),
    (tiff(100, 100, imagecodecs.lzw_encode(bytes(100)), 5), "cannot be decoded"),
    (tiff(100, 100, bytes(100), 1), "has 100 bytes, its pixels take 20000"),
    (tiff(100, 100, NOTHING, 8, following=8), "circle"),
    (tiff(100, 100, NOTHING, 8, following=10**9), "page 1 lies at byte"),
    (tiff(100, 100, NOTHING, 8, software_at=10**9), "tag 305 of page 0 ends at byte 1000000008"),
    (tiff(100, 100, b"", 1), "the data of page 0"),
    (tiff(100, 0, NOTHING, 8), "declares 100 x 0"),
    (b"II*\0\0\0\0\0", "no pages"),
    (b"II*\0\x08\0", "header"),
    (b"II+\0" + b"\xff" * 100, "t.img"),
    (png(400_000, 400_000, NOTHING), "declares 400000 x 400000"),
    (png(100, 100, zlib.compress(bytes(100))), "cannot be decoded"),
    (b"\x89PNG\r\n\x1a\n", "cut off"),
    (b"BM" + bytes(100), "neither a TIFF nor a PNG"),
]


@pytest.mark.parametrize(("content", "words"), ABSURD_IMAGES)
def test_absurd_images_are_refused_quickly(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "t.img"
    path.write_bytes(content)
    tracemalloc.start()
    start = time.perf_counter()
    assert refused(lambda: read_image(path), words)
    assert time.perf_counter() - start < 1.0
    assert tracemalloc.get_traced_memory()[1] < 100_000_000
    tracemalloc.stop()


@pytest.mark.thorough
def test_flipped_bits_in_a_tiff_lose_no_page_and_raise_nothing_else(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, FRAMES, photometric="minisblack", compression="zlib", rowsperstrip=16)
    whole = path.read_bytes()
    for place in [*range(0, 300, 2), *rng.integers(300, len(whole), 50)]:
        content = bytearray(whole)
        content[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        with contextlib.suppress(InputError):
            assert len(pages_of(path, (40, 50))) == 3


@pytest.mark.thorough
def test_written_images_read_back_and_hold_no_time(tmp_path: Path) -> None:
    for dtype in (np.uint8, np.uint16):
        image = FRAMES[0].astype(dtype)
        write_tiff(tmp_path / "a.tif", image, overwrite=True)
        time.sleep(0.01)
        write_tiff(tmp_path / "b.tif", image, overwrite=True)
        np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), image)
        assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert not {"DateTime", "Software"} & {tag.name for tag in file.pages[0].tags}


def test_the_experiments_images(data_folder: Path) -> None:
    image = read_image(data_folder / "channel" / "dark.tif", (1768, 2352))
    assert image.mean() == pytest.approx(96.0, abs=0.1)  # the dark level, read noise 6 over four million pixels


def test_what_a_killed_process_had_begun_to_write_is_removed(tmp_path: Path) -> None:
    killed = "import os, pathlib, signal, sys; from lfpiv_cli.files.atomic import write_atomically as write; " + (
        "write(pathlib.Path(sys.argv[1]), lambda path: os.kill(os.getpid(), signal.SIGKILL), overwrite=False)"
    )
    subprocess.run([sys.executable, "-c", killed, tmp_path / "x.json"], cwd=ROOT, check=False)
    (left,) = tmp_path.iterdir()
    found = atomic.PARTIAL.fullmatch(left.name)
    assert found is not None
    of_another_host = left.with_name(left.name.replace(found["host"], "0" * 8))
    of_a_living_one = left.with_name(left.name.replace(f"-{found['process']}-", f"-{os.getppid()}-"))
    for path in (of_another_host, of_a_living_one):
        path.write_bytes(b"")
    write_json(tmp_path / "x.json", {}, overwrite=False)
    assert sorted(tmp_path.iterdir()) == sorted([of_another_host, of_a_living_one, tmp_path / "x.json"])
