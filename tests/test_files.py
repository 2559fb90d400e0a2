"""Files in and out, particles and tracks among them: what is refused, what survives faults, what other programs see."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lfpiv_cli.errors import InputError, OutputError, OutputExistsError, UsageError
from lfpiv_cli.files import atomic, hdf5, particle_file
from lfpiv_cli.files.atomic import ensure_writable, write_json, written_atomically
from lfpiv_cli.files.export_vtk import write_playback
from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.files.particle_file import (
    PARTICLES_FORMAT,
    POSITION,
    TRACKS_FORMAT,
    TRAJECTORIES_FORMAT,
    Points,
    StoredTracks,
    read_points,
    write_points,
)
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume, read_header, write_vectors, write_volume
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.grid import Grid, Reference
from tests.commands import ROOT, edited, refused
from tests.vector_fields import points_of
from tests.written_files import vtk_opened

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


def save_tree(path: Path) -> Path:
    units, made = {"array": "mm", "index": "1", "none_left": "1"}, {"command": "test"}
    form = {"format_name": "lfpiv-test", "format_version": 2}
    write_tree(path, TREE, **form, provenance=made, overwrite=False, units=units)
    return path


def load_tree(path: Path) -> dict:
    return read_tree(path, "lfpiv-test", 2)[0]


def test_an_array_has_a_unit_and_json_no_nan(tmp_path: Path) -> None:
    made = {"format_name": "lfpiv-test", "format_version": 1, "provenance": {}, "overwrite": False}
    with pytest.raises(ValueError, match="array has no unit"):
        write_tree(tmp_path / "t.h5", {"group": {"array": np.zeros(3)}}, **made)
    assert not os.listdir(tmp_path)
    value = {"a": float("nan"), "b": [np.float32("inf"), np.array([1.0, np.nan])], "c": {"d": np.int64(3), "e": True}}
    write_json(tmp_path / "out.json", value, overwrite=False)
    found = json.loads((tmp_path / "out.json").read_text(), parse_constant=lambda word: pytest.fail(word))
    assert found == {"a": None, "b": [None, [1.0, None]], "c": {"d": 3, "e": True}}


def wrong(path: Path) -> None:
    raise InputError("wrong")


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    target.write_bytes(b"old")

    def fail() -> None:
        with written_atomically(target, overwrite=True) as temporary:
            temporary.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    # What does not read back is not published.
    with pytest.raises(OutputError, match="not read back"), written_atomically(target, overwrite=True, check=wrong):
        pass
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with written_atomically(tmp_path / "out", overwrite=False):
            pass
    finally:
        os.umask(before)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o640


def test_early_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    # Root may write everywhere, and tests often run as root.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(OutputError, match="is read-only"):
        ensure_writable(tmp_path / "new" / "out", overwrite=False)
    assert sorted(os.listdir(tmp_path)) == ["link", "old"]


# HDF5


def test_tree_round_trip(tmp_path: Path) -> None:
    tree, provenance = read_tree(save_tree(tmp_path / "t.h5"), "lfpiv-test", 2)
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


def test_other_formats_versions_and_kinds_are_refused(tmp_path: Path) -> None:
    path = save_tree(tmp_path / "t.h5")
    assert refused(lambda: read_tree(path, "lfpiv-weights", 2), "holds lfpiv-test, expected lfpiv-weights")
    assert refused(lambda: read_tree(path, "lfpiv-test", 3), "version 2", "reads 3")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["a"] = 1.0
    assert refused(lambda: load_tree(tmp_path / "foreign.h5"), "no format of ours")
    path = save_volume(tmp_path / "v.vtkhdf", np.zeros(GRID.shape_zyx))
    assert refused(lambda: open_vectors(path), "v.vtkhdf: holds lfpiv-volume, expected lfpiv-vectors")


# Volumes and vectors


def vectors(grid: Grid = GRID, uncertainty: bool = True) -> VectorField:
    rng = np.random.default_rng(5)
    shape = grid.shape_zyx
    displacement = rng.normal(size=(*shape, 3))
    flag = rng.integers(0, 5, shape).astype(np.uint8)
    displacement[flag == 3] = np.nan
    raw, scalars = rng.normal(size=(*shape, 3)), [rng.random(shape) for _ in range(3)]
    sigma = rng.random((*shape, 3)) if uncertainty else None
    return VectorField(grid, displacement, raw, *scalars, flag, sigma, (0.1, 0.1, 0.2), 0.0018, (16, 16, 8))


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
        active = data.GetVectors() or data.GetScalars()
        assert active.GetName() == {"v.vtkhdf": "intensity", "w.vtkhdf": "velocity"}[name.name]
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


def test_what_a_killed_process_had_begun_to_write_is_removed(tmp_path: Path) -> None:
    killed = "import os, pathlib, sys; from lfpiv_cli.files.atomic import written_atomically as write; " + (
        "made = write(pathlib.Path(sys.argv[1]), overwrite=False); made.__enter__(); os.kill(os.getpid(), 9)"
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


@pytest.fixture
def path(tmp_path: Path, rng: np.random.Generator) -> Path:
    target = tmp_path / "particles.vtkhdf"
    points = points_of(PARTICLES_FORMAT, rng, 5, {"a": 1})
    points = replace(points, position_mm=np.arange(15.0).reshape(5, 3), reference=REFERENCE)
    write_points(target, PARTICLES_FORMAT, points, overwrite=False)
    return target


def test_what_is_written_is_read_and_vtk_opens_the_very_file(path: Path) -> None:
    points = read_points(path, PARTICLES_FORMAT)
    np.testing.assert_array_equal(points.position_mm, np.arange(15.0).reshape(5, 3))
    assert points.arrays["covariance_mm2"].shape == (5, 6)
    assert points.reference == REFERENCE
    assert points.provenance == {"a": 1}
    matrix = np.array([[[1.0, 4.0, 6.0], [4.0, 2.0, 5.0], [6.0, 5.0, 3.0]]])
    assert particle_file.symmetric(matrix).tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]
    data = vtk_opened(path).GetOutput()
    from vtkmodules.util.numpy_support import vtk_to_numpy

    assert data.GetPointData().GetScalars().GetName() == "intensity"
    assert data.GetPointData().GetVectors() is None
    assert data.GetNumberOfPoints() == data.GetNumberOfVerts() == 5
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPoints().GetData()), np.arange(15.0).reshape(5, 3))
    intensity = vtk_to_numpy(data.GetPointData().GetArray("intensity"))
    np.testing.assert_array_equal(intensity, read_points(path, PARTICLES_FORMAT).arrays["intensity"])


def test_values_that_are_no_numbers_are_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["chi2"][2] = np.nan
    with pytest.raises(InputError, match="chi2"):
        read_points(path, PARTICLES_FORMAT)


FRAMES, TRACKS = 9, 40


@pytest.fixture
def many_tracks(rng: np.random.Generator) -> Points:
    """Places of tracks by track, then by frame: some begin late, some miss frames, and the fifth frame has none."""
    there = rng.random((TRACKS, FRAMES)) < 0.7
    there[:, 4] = False
    there[7] = False
    track, frame = np.nonzero(there)
    n = len(track)
    probability = np.where(frame == 0, np.nan, rng.random(n))
    arrays = {"velocity": rng.random((n, 3)), "velocity_sigma": rng.random((n, 3)), "track": track, "frame": frame}
    arrays |= {"particle": rng.integers(0, 99, n), "link_probability": probability}
    return Points(rng.random((n, 3)), arrays, REFERENCE, {"dt_s": 0.1}, {"command": "follow"})


def test_vtk_plays_the_places_of_each_frame(many_tracks: Points, tmp_path: Path) -> None:
    write_playback(tmp_path / "playback.vtkhdf", many_tracks, FRAMES, 0.002, overwrite=False)
    with pytest.raises(OutputExistsError):
        write_playback(tmp_path / "playback.vtkhdf", many_tracks, 4, 0.002, overwrite=False)
    reader = vtk_opened(tmp_path / "playback.vtkhdf")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    assert reader.GetNumberOfSteps() == FRAMES
    for step in range(FRAMES):
        reader.SetStep(step)
        reader.Update()
        assert reader.GetTimeValue() == pytest.approx(0.002 * step)
        shown, here = reader.GetOutput(), many_tracks.arrays["frame"] == step
        assert shown.GetNumberOfPoints() == shown.GetNumberOfVerts() == here.sum()
        if here.any():
            np.testing.assert_array_equal(vtk_to_numpy(shown.GetPoints().GetData()), many_tracks.position_mm[here])
            assert shown.GetPointData().GetVectors().GetName() == "velocity"
            for name in ("track", "velocity"):
                stored = vtk_to_numpy(shown.GetPointData().GetArray(name))
                np.testing.assert_array_equal(stored, many_tracks.arrays[name][here])


def put(folder: Path, many_tracks: Points) -> StoredTracks:
    """Return many_tracks after they were put on a disk, frame by frame."""
    store = StoredTracks(folder, many_tracks.reference, many_tracks.attributes, many_tracks.provenance)
    for number in range(FRAMES):
        here = many_tracks.arrays["frame"] == number
        store.put({POSITION: many_tracks.position_mm[here]} | {k: v[here] for k, v in many_tracks.arrays.items()})
    return store


@pytest.mark.parametrize("block", [1, 20, 10_000])
def test_files_are_those_of_tracks_in_memory(
    many_tracks: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(hdf5, "CHUNK_BYTES", 400)
    monkeypatch.setattr(particle_file, "BLOCK_ROWS", block)
    monkeypatch.setattr(particle_file, "CHECKED_ROWS", 30)
    with put(tmp_path, many_tracks) as stored:
        for name, each in (("memory", many_tracks), ("disk", stored)):
            write_points(tmp_path / f"{name}.vtkhdf", TRAJECTORIES_FORMAT, each, overwrite=False)
            write_playback(tmp_path / f"{name}_played.vtkhdf", each, FRAMES, 0.1, overwrite=False)
    for name in ("{}.vtkhdf", "{}_played.vtkhdf"):
        memory, disk = ((tmp_path / name.format(each)).read_bytes() for each in ("memory", "disk"))
        assert memory == disk
    with h5py.File(tmp_path / "disk.vtkhdf") as file:
        for name, array in many_tracks.arrays.items():
            np.testing.assert_array_equal(file[name], array)
    assert len(list(tmp_path.iterdir())) == 4


def test_tracks_are_read_block_by_block(many_tracks: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(particle_file, "BLOCK_ROWS", 20)
    with put(tmp_path, many_tracks) as stored:
        pieces = list(stored.rows("track"))
    assert len(pieces) > 5
    # The last track of a block is whole.
    assert max(map(len, pieces)) < 20 + FRAMES


def test_no_tracks_are_written_too(tmp_path: Path, rng: np.random.Generator) -> None:
    empty = points_of(TRAJECTORIES_FORMAT, rng, 0)
    nothing = {POSITION: empty.position_mm} | empty.arrays
    with StoredTracks(tmp_path, REFERENCE, {}, {}) as store:
        store.put(nothing)
        store.put(nothing)
        write_points(tmp_path / "none.vtkhdf", TRAJECTORIES_FORMAT, store, overwrite=False)
        write_playback(tmp_path / "played.vtkhdf", store, 2, 0.1, overwrite=False)
    with h5py.File(tmp_path / "none.vtkhdf") as file:
        assert file[POSITION].shape == (0, 3)
    write_points(tmp_path / "t.vtkhdf", TRACKS_FORMAT, points_of(TRACKS_FORMAT, rng, 0), overwrite=False)
    assert read_points(tmp_path / "t.vtkhdf", TRACKS_FORMAT).position_mm.shape == (0, 3)


def test_full_disks_and_lost_folders_are_told(
    many_tracks: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OutputError, match="missing: tracks cannot be put there"):
        StoredTracks(tmp_path / "missing", REFERENCE, {}, {})
    full = open("/dev/full", "r+b", buffering=0)  # noqa: SIM115
    monkeypatch.setattr(particle_file.tempfile, "TemporaryFile", lambda **_: full)
    with pytest.raises(OutputError, match="No space left"):
        put(tmp_path, many_tracks)
