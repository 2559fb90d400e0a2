"""`track` as a batch: a file for each pair of names, whatever is lost or broken, and sequences in the order of time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.errors import InputError, OutputExistsError, PartialError, UsageError
from lfpiv_cli.files.particle_file import TRACKS_FORMAT, TRAJECTORIES_FORMAT, read_points
from lfpiv_cli.files.vtkhdf import open_vectors
from tests.test_particle_stage import run, write_frame

MOVED_MM = np.array([0.1, -0.05, 0.0])


@pytest.fixture
def particles(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A folder of three pairs, all of which move by MOVED_MM."""
    folder = tmp_path / "particles"
    folder.mkdir()
    for number in range(3):
        start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (40, 3))
        for k, letter in enumerate("ab"):
            write_frame(folder / f"{letter}{number}.vtkhdf", start + k * MOVED_MM)
    return folder


def moved(path: Path) -> np.ndarray:
    return np.median(read_points(path, TRACKS_FORMAT).arrays["displacement_mm"], axis=0)


def test_each_pair_has_a_file_whatever_becomes_of_others(particles: Path, tmp_path: Path, capsys) -> None:
    folder, failures = tmp_path / "tracks", tmp_path / "failures.json"
    batch = ("track", particles, "--pairing", "ab", "--grid", "-o", folder)
    (particles / "b1.vtkhdf").unlink()
    with pytest.raises(InputError, match=r"a1.vtkhdf: the second frame of its pair is missing"):
        run(*batch)
    assert not folder.exists()
    (particles / "b2.vtkhdf").write_bytes(b"no file of ours")
    with pytest.raises(PartialError, match="2 of 3 pairs failed"):
        run(*batch, "--keep-going", "--failures", failures, "--json")
    assert [Path(each["name"]).stem for each in json.loads(failures.read_text())] == ["a1", "a2"]
    assert sorted(path.name for path in folder.iterdir()) == ["a0.vtkhdf", "a0_grid.vtkhdf"]
    np.testing.assert_allclose(moved(folder / "a0.vtkhdf"), MOVED_MM, atol=1e-9)
    assert "frame-unpaired" in capsys.readouterr().err


@pytest.mark.thorough
def test_what_is_complete_with_its_vectors_is_skipped(particles: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "tracks"
    batch = ("track", particles, "--pairing", "ab", "-o", folder, "--json")
    run(*batch)
    assert json.loads(capsys.readouterr().out)["tracks"] == 120
    with pytest.raises(OutputExistsError):
        run(*batch)
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    capsys.readouterr()
    run(*batch, "--resume")
    assert json.loads(capsys.readouterr().out)["skipped"] == 3
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    # The vectors are missing: tracks are made again with them.
    run(*batch, "--resume", "--grid")
    (folder / "a1_grid.vtkhdf").unlink()
    capsys.readouterr()
    run(*batch, "--resume", "--grid")
    told = json.loads(capsys.readouterr().out)
    assert (told["skipped"], told["tracks"]) == (2, 40)
    assert len(list(folder.iterdir())) == 6


@pytest.mark.thorough
def test_tracks_have_the_mean_of_their_vectors(particles: Path, tmp_path: Path) -> None:
    folder, alone = tmp_path / "tracks", tmp_path / "alone"
    run("track", particles, "--pairing", "ab", "--grid", "-o", folder)
    run("track", particles, "--pairing", "ab", "-o", alone)
    means = [tmp_path / f"{source.name}_mean.vtkhdf" for source in (folder, alone)]
    for source, mean in zip((folder, alone), means, strict=True):
        run("correlate", source, "--mean", mean)
    of_grids, of_tracks = map(open_vectors, means)
    np.testing.assert_array_equal(of_tracks.displacement_voxel, of_grids.displacement_voxel)
    np.testing.assert_array_equal(of_tracks.uncertainty_voxel, of_grids.uncertainty_voxel)
    np.testing.assert_allclose(np.nanmedian(of_grids.displacement_voxel, axis=(0, 1, 2)), MOVED_MM / 0.1, atol=1e-9)
    mixed = (folder / "a0.vtkhdf", means[0])
    with pytest.raises(InputError, match="was made by correlate mean, but .* by track; a mean is of one kind"):
        run("correlate", *mixed, "--mean", tmp_path / "mixed.vtkhdf")
    with pytest.raises(UsageError, match="--windows: is for volumes"):
        run("correlate", folder, "--windows", "8", "--mean", tmp_path / "mixed.vtkhdf")
    assert not (tmp_path / "mixed.vtkhdf").exists()


def test_one_pair_is_one_file(particles: Path, tmp_path: Path, capsys) -> None:
    pair = particles / "b0.vtkhdf", particles / "a0.vtkhdf"
    run("track", *pair, "--pairing", "ab", "-o", tmp_path / "tracks.vtkhdf")
    np.testing.assert_allclose(moved(tmp_path / "tracks.vtkhdf"), MOVED_MM, atol=1e-9)
    # Without it they are taken as they are given, and it is said.
    capsys.readouterr()
    run("track", *pair, "-o", tmp_path / "back.vtkhdf")
    np.testing.assert_allclose(moved(tmp_path / "back.vtkhdf"), -MOVED_MM, atol=1e-9)
    assert "pair-backwards" in capsys.readouterr().err


def test_a_sequence_is_in_the_order_of_its_numbers(tmp_path: Path, rng: np.random.Generator, capsys) -> None:
    start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (40, 3))
    paths = [tmp_path / f"frame_{number}.vtkhdf" for number in (8, 9, 10, 12)]
    for number, path in enumerate(paths):
        write_frame(path, start + number * MOVED_MM)
    # As a shell sorts them.
    run("track", *sorted(paths), "-o", tmp_path / "tracks.vtkhdf", "--json")
    told = json.loads(capsys.readouterr().out)
    assert [each["code"] for each in told["warnings"]] == ["frames-missing", "frames-reordered"]
    tracks = read_points(tmp_path / "tracks.vtkhdf", TRAJECTORIES_FORMAT)
    np.testing.assert_allclose(tracks.arrays["velocity"], np.tile(MOVED_MM / 2.0, (160, 1)), atol=1e-9)
    run("correlate", tmp_path / "tracks.vtkhdf", "--mean", tmp_path / "mean.vtkhdf")
    mean = open_vectors(tmp_path / "mean.vtkhdf").velocity
    np.testing.assert_allclose(np.nanmedian(mean, axis=(0, 1, 2)), MOVED_MM / 2.0, atol=1e-9)
