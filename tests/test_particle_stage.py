"""`reconstruct --solver particles` and `track` as commands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.spatial import KDTree

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError, OutputExistsError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.config import carried_config, load_config
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.particle_file import (
    PARTICLES_FORMAT,
    TRACKS_FORMAT,
    TRAJECTORIES_FORMAT,
    Points,
    read_points,
    write_points,
)
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.reference import Reference

ROOT = Path(__file__).parent.parent
SAMPLE, CONFIG = ROOT / "sample_data", ROOT / "configs" / "sample.yaml"


def run(*arguments: object) -> None:
    cli.main([str(argument) for argument in arguments], standalone_mode=False)


def write_frame(path: Path, position_mm: np.ndarray, **changes: object) -> None:
    """Write particles as `reconstruct` does, for the sample's volume."""
    n = len(position_mm)
    covariance = np.tile([1e-6, 1e-6, 1e-4, 0.0, 0.0, 0.0], (n, 1))
    arrays = {"intensity": np.ones(n), "covariance_mm2": covariance, "chi2": np.ones(n), "seen": np.ones(n)}
    resolved = load_config(CONFIG).resolved() | changes
    arrays["flag"] = np.zeros(n, np.uint8)
    points = Points(position_mm, arrays, Reference("mid_plane", 0.5), {}, {"config": resolved})
    write_points(path, PARTICLES_FORMAT, points, overwrite=True)


@pytest.fixture
def pair(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, Path]:
    """Particles of two frames in the sample's volume, all moved by (2, -1, 0.5) voxels."""
    start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (300, 3))
    paths = tmp_path / "a.vtkhdf", tmp_path / "b.vtkhdf"
    write_frame(paths[0], start)
    write_frame(paths[1], start + (0.2, -0.1, 0.05))
    return paths


def test_track_writes_tracks_and_vectors(pair: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    run("track", *pair, "-o", tmp_path / "tracks.vtkhdf", "--grid", "--json")
    summary = json.loads(capsys.readouterr().out)
    assert summary["tracks"] > 290
    tracks = read_points(tmp_path / "tracks.vtkhdf", TRACKS_FORMAT)
    # 2 voxels of 0.1 mm in 2 ms.
    np.testing.assert_allclose(np.median(tracks.arrays["velocity"], axis=0), (0.1, -0.05, 0.025), atol=1e-9)
    assert tracks.reference == Reference("mid_plane", 0.5)
    # What tracking chose stands beside the config's sections.
    assert tracks.provenance["config"]["search_mm"] > 0.0
    assert carried_config(tracks.provenance, "tracks").resolved() == load_config(CONFIG).resolved()
    field = vtkhdf.open_vectors(tmp_path / "tracks_grid.vtkhdf")
    assert field.flag.shape == (6, 3, 5)
    assert np.abs(field.displacement_voxel[field.flag == 0] - (2.0, -1.0, 0.5)).max() < 1e-6
    assert field.uncertainty_voxel is not None


def frames_of(counts: list[int], folder: Path, rng: np.random.Generator) -> list[Path]:
    """Write frames with so many particles each, all of which move by one voxel."""
    start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (max(counts), 3))
    paths = [folder / f"frame_{number}.vtkhdf" for number in range(len(counts))]
    for number, (path, count) in enumerate(zip(paths, counts, strict=True)):
        write_frame(path, start[:count] + (0.1 * number, 0.0, 0.0))
    return paths


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("counts", "said", "tracks"),
    [
        ([3, 3], "3 particles at most", 3),
        ([40, 40], "", 40),
        ([40, 2], "holds 2 particles, another frame 40", 2),
        ([5, 5, 5], "5 particles at most", 5),
        ([40, 40, 40, 0], "there are no particles in it", 40),
    ],
)
def test_few_particles_are_tracked_and_said(
    counts: list[int], said: str, tracks: int, tmp_path: Path, rng: np.random.Generator, capsys
) -> None:
    paths = frames_of(counts, tmp_path, rng)
    run("track", *paths, "-o", tmp_path / "tracks.vtkhdf")
    told = capsys.readouterr().err
    assert said in told
    assert ("lfpiv:" in told) == bool(said)
    run("track", *paths, "-o", tmp_path / "tracks.vtkhdf", "--json", "--overwrite")
    summary = json.loads(capsys.readouterr().out)
    assert summary["tracks"] == tracks
    # Forty tracks of three places show no noise: a parabola takes them all.
    assert summary.get("noise_over_stated") is None


def test_no_tracks_are_said(tmp_path: Path, rng: np.random.Generator, capsys) -> None:
    paths = frames_of([9, 9], tmp_path, rng)
    write_frame(paths[1], rng.uniform(8.0, 9.0, (9, 3)))
    run("track", *paths, "-o", tmp_path / "tracks.vtkhdf")
    assert "[no-tracks]" in capsys.readouterr().err


@pytest.mark.parametrize("counts", [[40, 0], [0, 0], [0, 40, 0]])
def test_nothing_to_track_is_an_error(counts: list[int], tmp_path: Path, rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="no particles; tracks need some in two frames"):
        run("track", *frames_of(counts, tmp_path, rng), "-o", tmp_path / "tracks.vtkhdf")
    assert not (tmp_path / "tracks.vtkhdf").exists()


def test_vectors_beyond_the_walls_are_masked(tmp_path: Path, rng: np.random.Generator) -> None:
    start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (300, 3))
    resolved = load_config(CONFIG).resolved()
    changes = {
        "correlation": resolved["correlation"] | {"mask": "channel"},
        "channel": resolved["channel"] | {"width_mm": 2.0},
    }
    paths = tmp_path / "a.vtkhdf", tmp_path / "b.vtkhdf"
    for path, moved in zip(paths, (0.0, 0.1), strict=True):
        write_frame(path, start + (moved, 0.0, 0.0), **changes)
    run("track", *paths, "-o", tmp_path / "tracks.vtkhdf", "--grid")
    field = vtkhdf.open_vectors(tmp_path / "tracks_grid.vtkhdf")
    # Windows of 1.2 mm, 0.6 mm apart from z = -1.5 mm, of which 0.1, 0.7 and all 1.2 mm lie within 1 mm of the middle.
    assert field.flag[:, 0, 0].tolist() == [4, 0, 0, 0, 0, 4]
    np.testing.assert_allclose(field.valid_fraction[:3, 1, 1], [0.1 / 1.2, 0.7 / 1.2, 1.0])


def test_track_replaces_nothing_unasked(pair: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "tracks_grid.vtkhdf").write_text("mine")
    with pytest.raises(OutputExistsError):
        run("track", *pair, "-o", tmp_path / "tracks.vtkhdf", "--grid")
    assert not (tmp_path / "tracks.vtkhdf").exists()


@pytest.mark.thorough
def test_a_sequence_gives_tracks_and_vectors_of_each_interval(tmp_path: Path, rng: np.random.Generator) -> None:
    start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (300, 3))
    frames = [tmp_path / f"frame_{number}.vtkhdf" for number in range(4)]
    for number, path in enumerate(frames):
        write_frame(path, start + number * np.array([0.1, -0.05, 0.025]))
    run("track", *frames, "-o", tmp_path / "tracks.vtkhdf", "--grid", "--shortest", 4)
    tracks = read_points(tmp_path / "tracks.vtkhdf", TRAJECTORIES_FORMAT)
    # 1 voxel of 0.1 mm in 2 ms; each place is a row, in the order of tracks and frames.
    np.testing.assert_allclose(tracks.arrays["velocity"], np.tile((0.05, -0.025, 0.0125), (len(tracks.position_mm), 1)))
    number, frame = tracks.arrays["track"].reshape(-1, 4), tracks.arrays["frame"].reshape(-1, 4)
    assert len(number) > 290
    assert np.all(number == number[:, :1])
    assert np.all(frame == np.arange(4))
    for name in ("0000", "0002"):
        field = vtkhdf.open_vectors(tmp_path / f"tracks_grid_{name}.vtkhdf")
        assert np.abs(field.displacement_voxel[field.flag == 0] - (1.0, -0.5, 0.25)).max() < 1e-6
    assert not (tmp_path / "tracks_grid_0003.vtkhdf").exists()
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "tracks.vtkhdf"))
    reader.Update()
    data = reader.GetOutput()
    assert (data.GetNumberOfPoints(), data.GetNumberOfLines()) == (number.size, len(number))
    assert data.GetCell(number.size).GetNumberOfPoints() == 4


@pytest.mark.parametrize("arguments", [["a.vtkhdf"], ["a.vtkhdf", "b.vtkhdf", "--shortest", "3"]])
def test_what_no_sequence_is_is_refused(arguments: list[str], tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        run("track", *arguments, "-o", tmp_path / "tracks.vtkhdf")


def test_frames_made_with_other_settings_are_refused(pair: tuple[Path, Path], tmp_path: Path) -> None:
    write_frame(pair[1], np.zeros((1, 3)), channel=None)
    with pytest.raises(InputError, match="another config"):
        run("track", *pair, "-o", tmp_path / "tracks.vtkhdf")


@pytest.mark.slow
def test_the_sample_from_images_to_vectors(tmp_path: Path) -> None:
    calibration, weights = tmp_path / "calibration.h5", tmp_path / "weights.h5"
    still = [SAMPLE / f"{name}.tif" for name in ("white", "dark", "board", "pair_a", "pair_b")]
    dark = ("--dark", still[1])
    run("calibrate-snapshot", CONFIG, "--white", still[0], *dark, "--board", still[2], "-o", calibration)
    run("build-weights", CONFIG, "--calibration", calibration, "-o", weights)
    mask = np.full(read_image(still[1]).shape, 255, np.uint8)
    mask[:20, :30] = 0
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    masked = (*dark, "--mask", tmp_path / "mask.tif")
    beside = (*masked, "--solver", "particles", "--pairing", "ab", "-o", tmp_path / "particles")
    run("reconstruct", weights, *still[3:], *beside)
    frames = [tmp_path / "particles" / f"pair_{name}.vtkhdf" for name in "ab"]
    # A frame that is made again alone is the same, its neighbour being looked at again; what is there stays.
    written = [frame.read_bytes() for frame in frames]
    # Without its residual image it is the same, too.
    frames[1].unlink()
    (tmp_path / "particles" / "pair_b_residual.tif").unlink()
    made = frames[0].stat().st_mtime_ns
    run("reconstruct", weights, *still[3:], *beside, "--resume", "--no-residual")
    assert [frame.read_bytes() for frame in frames] == written
    assert not (tmp_path / "particles" / "pair_b_residual.tif").exists()
    run("reconstruct", weights, *still[3:], *beside, "--resume")
    assert frames[0].stat().st_mtime_ns == made
    attributes = vtkhdf.read_header(frames[0]).attributes
    assert attributes["excluded_pixels"] == 600
    left = read_image(tmp_path / "particles" / "pair_a_residual.tif")
    assert not left[:20, :30].any()
    rms = np.sqrt(np.sum(left**2, dtype=np.float64) / (left.size - 600))
    assert attributes["residual_rms_counts"] == pytest.approx(rms, rel=1e-5)
    run("track", *frames, "-o", tmp_path / "tracks.vtkhdf", "--grid")

    truth = read_particles(SAMPLE / "particles.npz")
    first = read_points(frames[0], PARTICLES_FORMAT)
    start = truth.positions_mm - truth.velocities_m_s * 1e3 * 0.5 * 0.002
    start = first.reference.points_from_focal_point(start)
    inside = first.arrays["flag"] == 0
    distance, _ = KDTree(start / (0.05, 0.05, 0.2)).query(first.position_mm[inside] / (0.05, 0.05, 0.2))
    assert np.mean(distance < 1.0) > 0.9

    field = vtkhdf.open_vectors(tmp_path / "tracks_grid.vtkhdf")
    z, y, x = np.meshgrid(*(field.grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    true = load_config(CONFIG).true_flow()(np.stack([x, y, z], axis=-1).reshape(-1, 3)).reshape(*x.shape, 3)
    error = field.displacement_voxel - true * 0.002 * 1e4
    rms = np.sqrt(np.mean(error**2, axis=(0, 1, 2)))
    # Measured 0.002, 0.001 and 0.04 voxel; correlation of volumes makes 0.1 and, in depth, one.
    assert np.all(rms < (0.01, 0.01, 0.1))


@pytest.mark.slow
def test_velocities_of_a_sequence_are_better_than_those_of_a_pair(tmp_path: Path) -> None:
    rig, images, frames = tmp_path / "rig.yaml", tmp_path / "images", 5
    rig.write_text(CONFIG.read_text().replace("simulation:\n", f"simulation:\n  frames: {frames}\n"))
    for kind in ("white", "board", "particles"):
        run("simulate", kind, rig, "-o", images)
    dark = ("--dark", images / "dark.tif")
    stills = ("--white", images / "white.tif", "--board", images / "board.tif")
    run("calibrate-snapshot", rig, *stills, *dark, "-o", tmp_path / "calibration.h5")
    run("build-weights", rig, "--calibration", tmp_path / "calibration.h5", "-o", tmp_path / "weights.h5")
    shots = [images / f"frame_{number:04d}.tif" for number in range(frames)]
    run("reconstruct", tmp_path / "weights.h5", *shots, *dark, "--solver", "particles", "-o", tmp_path / "particles")
    places = [tmp_path / "particles" / f"{shot.stem}.vtkhdf" for shot in shots]
    run("track", *places[1:3], "-o", tmp_path / "pair.vtkhdf", "--grid")
    run("track", *places, "-o", tmp_path / "tracks.vtkhdf", "--grid")
    flow = load_config(rig).true_flow()

    def spread(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        inside = np.all(np.abs(position) < (1.5, 1.1, 2.0), axis=1)
        return np.median(np.abs(velocity - flow(position))[inside], axis=0)

    pair = read_points(tmp_path / "pair.vtkhdf", TRACKS_FORMAT)
    tracks = read_points(tmp_path / "tracks.vtkhdf", TRAJECTORIES_FORMAT)
    of_pair, of_tracks = (spread(found.position_mm, found.arrays["velocity"]) for found in (pair, tracks))
    # Measured 0.0027 and 0.0009, 0.083 and 0.025 voxel along y and z; along x the calibration's error of depth, 3 um in
    # a flow that is sheared, remains.
    assert np.all(of_tracks[1:] < 0.5 * of_pair[1:])
    assert of_tracks[0] < of_pair[0]
    ratio = (tracks.arrays["velocity"] - flow(tracks.position_mm))[:, 1:] / tracks.arrays["velocity_sigma"][:, 1:]
    assert np.median(np.abs(ratio)) / 0.6745 == pytest.approx(1.0, abs=0.2)
    rms = []
    for name in ("pair_grid", "tracks_grid_0001"):
        field = vtkhdf.open_vectors(tmp_path / f"{name}.vtkhdf")
        z, y, x = np.meshgrid(*(field.grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
        error = field.velocity.reshape(-1, 3) - flow(np.stack([x, y, z], axis=-1).reshape(-1, 3))
        rms.append(np.sqrt(np.mean(error**2, axis=0)))
    assert rms[1][2] < 0.7 * rms[0][2]
