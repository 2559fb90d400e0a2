"""Tracks that are on a disk while they are put in order: the files are those of tracks in memory, byte for byte."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from lfpiv_cli.errors import OutputError
from lfpiv_cli.files import hdf5, particle_file
from lfpiv_cli.files.exports.vtk import write_playback
from lfpiv_cli.files.particle_file import POSITION, TRAJECTORIES_FORMAT, Points, StoredTracks, write_points
from lfpiv_cli.reference import Reference
from lfpiv_cli.verbs.track import KEPT_FRAMES, SeenFrames

FRAMES, TRACKS = 9, 40
REFERENCE = Reference("mid_plane", 0.5)


@pytest.fixture
def tracks(rng: np.random.Generator) -> Points:
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


def put(folder: Path, tracks: Points) -> StoredTracks:
    """Return tracks after they were put on a disk, frame by frame."""
    store = StoredTracks(folder, tracks.reference, tracks.attributes, tracks.provenance)
    for number in range(FRAMES):
        here = tracks.arrays["frame"] == number
        store.put({POSITION: tracks.position_mm[here]} | {k: v[here] for k, v in tracks.arrays.items()})
    return store


@pytest.mark.parametrize("block", [1, 20, 10_000])
def test_files_are_those_of_tracks_in_memory(
    tracks: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(hdf5, "CHUNK_BYTES", 400)
    monkeypatch.setattr(particle_file, "BLOCK_ROWS", block)
    monkeypatch.setattr(particle_file, "CHECKED_ROWS", 30)
    with put(tmp_path, tracks) as stored:
        for name, each in (("memory", tracks), ("disk", stored)):
            write_points(tmp_path / f"{name}.vtkhdf", TRAJECTORIES_FORMAT, each, overwrite=False)
            write_playback(tmp_path / f"{name}_played.vtkhdf", each, FRAMES, 0.1, overwrite=False)
    for name in ("{}.vtkhdf", "{}_played.vtkhdf"):
        memory, disk = ((tmp_path / name.format(each)).read_bytes() for each in ("memory", "disk"))
        assert memory == disk
    with h5py.File(tmp_path / "disk.vtkhdf") as file:
        for name, array in tracks.arrays.items():
            np.testing.assert_array_equal(file[name], array)
    assert len(list(tmp_path.iterdir())) == 4


def test_a_block_of_tracks_is_read_at_a_time(tracks: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(particle_file, "BLOCK_ROWS", 20)
    with put(tmp_path, tracks) as stored:
        pieces = list(stored.rows("track"))
    assert len(pieces) > 5
    # The last track of a block is whole.
    assert max(map(len, pieces)) < 20 + FRAMES


def test_no_tracks_are_written_too(tmp_path: Path) -> None:
    nothing = {name: np.zeros(0, np.int64) for name in ("track", "frame", "particle")}
    nothing |= {"link_probability": np.zeros(0)} | {
        name: np.zeros((0, 3)) for name in (POSITION, "velocity", "velocity_sigma")
    }
    with StoredTracks(tmp_path, REFERENCE, {}, {}) as store:
        store.put(nothing)
        store.put(nothing)
        write_points(tmp_path / "none.vtkhdf", TRAJECTORIES_FORMAT, store, overwrite=False)
        write_playback(tmp_path / "played.vtkhdf", store, 2, 0.1, overwrite=False)
    with h5py.File(tmp_path / "none.vtkhdf") as file:
        assert file[POSITION].shape == (0, 3)


def test_a_folder_that_takes_nothing_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="missing: tracks cannot be put there"):
        StoredTracks(tmp_path / "missing", REFERENCE, {}, {})


def test_a_full_disk_is_told(tracks: Points, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = open("/dev/full", "r+b", buffering=0)  # noqa: SIM115
    monkeypatch.setattr(particle_file.tempfile, "TemporaryFile", lambda **_: full)
    with pytest.raises(OutputError, match="No space left"):
        put(tmp_path, tracks)


def test_the_last_few_frames_stay_in_memory() -> None:
    read: list[int] = []

    def frame(number: int) -> Points:
        read.append(number)
        arrays = {"covariance_mm2": np.zeros((number, 6)), "intensity": np.ones(number)}
        return Points(np.zeros((number, 3)), arrays, REFERENCE, {}, {})

    frames = SeenFrames(KEPT_FRAMES + 2, frame)
    for number in range(len(frames)):
        for before in range(max(number - KEPT_FRAMES + 1, 0), number + 1):
            assert len(frames[before]) == before
    assert read == list(range(len(frames)))
    assert frames.particles(0) == 0
    assert len(read) == len(frames)
    assert len(frames[0]) == 0
    assert read[-1] == 0
