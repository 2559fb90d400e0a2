"""Particles and tracks on disk: what is written is read, VTK opens and plays it, what is broken is refused."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lfpiv_cli.errors import InputError, OutputError, OutputExistsError
from lfpiv_cli.files import hdf5, particle_file
from lfpiv_cli.files.export_vtk import write_playback
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
from lfpiv_cli.grid import Reference
from tests.vector_fields import points_of
from tests.written_files import vtk_opened

REFERENCE = Reference("mid_plane", -0.4)


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
