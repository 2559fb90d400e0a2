"""`follow` as a command and in memory: a small sequence whose tracks are known, interrupted and gone on with."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest

import lfpiv_cli as lf
from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import InputError, OutputExistsError, PartialError, StoppedEarlyError, UsageError
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.inputs import Deadline
from lfpiv_cli.files.particle_file import TRAJECTORIES_FORMAT, Points, read_points
from lfpiv_cli.particles.view import raw_view
from tests.commands import contents, run, sample_weights
from tests.particle_images import light_on

FRAMES, COUNT = 4, 12
# 0.8, -0.4 and 0.5 voxels a frame.
MOVED_MM = np.array([0.08, -0.04, 0.05])
DT_S, DARK_COUNTS = 0.002, 100.0


def true_places() -> Floats:
    """Return the particles' places (frames, n, 3) from the focal point, mm: all are in the volume in each frame."""
    low, high = np.array([-0.4, -0.2, 1.5]), np.array([0.1, 0.35, 2.2])
    start = np.random.default_rng(1).uniform(low, high, (COUNT, 3))
    return start + MOVED_MM * np.arange(FRAMES)[:, np.newaxis, np.newaxis]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with weights of the sample's rig, a smaller one, and images of particles."""
    folder = tmp_path_factory.mktemp("rig")
    small = ("columns: 600, rows: 448", "columns: 290, rows: 270"), ("shape_xyz: [30, 22, 40]", "shape_xyz: [9, 8, 10]")
    sample_weights(folder, *small, ("centre_mm: [0, 0, 0]", "centre_mm: [0, 0, 1.9]"))
    content, settings = lf.open_weights(folder / "weights.h5"), lf.load_rig(folder / "rig.yaml")
    view = raw_view(content.camera, settings.media_model(), 0.025)
    rng = np.random.default_rng(2)
    light = rng.uniform(4e5, 6e5, COUNT)
    for number, places in enumerate(true_places()):
        particles = np.column_stack([content.camera.to_image_axes(places), light])
        image = light_on(view, particles, content.weights.grid.bounds_mm(2))
        counts = np.rint(DARK_COUNTS + image + rng.normal(0.0, 6.0, image.size)).clip(0, 65535)
        write_tiff(
            folder / f"frame_{number}.tif", counts.astype(np.uint16).reshape(content.image_shape), overwrite=True
        )
    dark = np.full(content.image_shape, DARK_COUNTS, np.uint16)
    write_tiff(folder / "dark.tif", dark, overwrite=True)
    return folder


def images(rig: Path) -> list[Path]:
    return [rig / f"frame_{number}.tif" for number in range(FRAMES)]


def follow(rig: Path, output: Path, *options: object, frames: list[Path] | None = None) -> None:
    run("follow", rig / "weights.h5", *(frames or images(rig)), "--dark", rig / "dark.tif", *options, "-o", output)


@pytest.fixture(scope="module")
def followed(rig: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("followed") / "run"
    follow(rig, output, "--threads", 1)
    return output


def particle_files(output: Path) -> list[Path]:
    return [output / "particles" / f"frame_{number}.vtkhdf" for number in range(FRAMES)]


def tracks_of(output: Path) -> Points:
    return read_points(output / "tracks.vtkhdf", TRAJECTORIES_FORMAT)


def assert_right(tracks: Points) -> None:
    """Check that each particle has one track, which is where it is, and moves as it does."""
    true = tracks.reference.points_from_focal_point(true_places().reshape(-1, 3)).reshape(FRAMES, COUNT, 3)
    frame, track = tracks.arrays["frame"], tracks.arrays["track"]
    distance = np.abs(true[frame] - tracks.position_mm[:, np.newaxis]) / (0.01, 0.01, 0.1)
    nearest = distance.max(axis=2).argmin(axis=1)
    assert len(track) == FRAMES * COUNT
    assert distance.max(axis=2).min(axis=1).max() < 1.0
    assert len(set(zip(track.tolist(), nearest.tolist(), strict=True))) == len(set(track.tolist())) == COUNT
    velocity = np.median(tracks.arrays["velocity"], axis=0)
    assert np.all(np.abs(velocity - MOVED_MM * 1e-3 / DT_S) < (2e-4, 2e-4, 2e-3))


@pytest.mark.thorough
def test_tracks_are_right_and_those_that_track_links(followed: Path, tmp_path: Path) -> None:
    assert [path.is_file() for path in particle_files(followed)] == [True] * FRAMES
    assert_right(tracks_of(followed))
    # Track links the same.
    run("track", *particle_files(followed), "--shortest", 4, "-o", tmp_path / "tracks.vtkhdf")
    again, tracks = read_points(tmp_path / "tracks.vtkhdf", TRAJECTORIES_FORMAT), tracks_of(followed)
    np.testing.assert_array_equal(again.position_mm, tracks.position_mm)
    for name, array in tracks.arrays.items():
        np.testing.assert_array_equal(again.arrays[name], array)


@pytest.mark.thorough
def test_the_same_in_memory(rig: Path, followed: Path, one_thread: Callable[[], AbstractContextManager[None]]) -> None:
    pictures = [lf.read_image(path) for path in images(rig)]
    with one_thread():
        found = lf.follow(lf.open_weights(rig / "weights.h5"), pictures, dark=lf.read_image(rig / "dark.tif"))
    for points, path in zip(found.particles, particle_files(followed), strict=True):
        written = lf.open_particles(path)
        np.testing.assert_array_equal(points.position_mm, written.position_mm)
        for name, array in written.arrays.items():
            np.testing.assert_array_equal(points.arrays[name], array)
    np.testing.assert_array_equal(found.tracks.points.position_mm, tracks_of(followed).position_mm)


@pytest.mark.thorough
def test_what_is_there_is_replaced_when_asked(rig: Path, followed: Path) -> None:
    before = contents(followed)
    with pytest.raises(OutputExistsError):
        follow(rig, followed)
    assert contents(followed) == before
    with pytest.raises(OutputExistsError, match="other inputs or settings"):
        follow(rig, followed, "--search", 3, "--resume")
    assert contents(followed) == before


def test_two_frames_or_a_share_are_refused(weights: Path, images: list[Path], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"3 frames at least, got 2; for a pair: .*track"):
        run("follow", weights, *images[:2], "-o", tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(UsageError, match="3 frames"):
        lf.follow(lf.open_weights(weights), [lf.read_image(path) for path in images[:2]])
    with pytest.raises(UsageError, match="cannot be divided"):
        run("follow", tmp_path / "weights.h5", tmp_path / "a.tif", "--shard", "1/2", "-o", tmp_path / "run")


@pytest.mark.thorough
def test_a_frame_of_another_sequence_is_said(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.tif"
    write_tiff(other, np.ascontiguousarray(lf.read_image(rig / "frame_2.tif")[::-1]), overwrite=False)
    frames = [*images(rig)[:2], other]
    capsys.readouterr()
    follow(rig, tmp_path / "run", "--shortest", 2, "--threads", 1, "--json", frames=frames)
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert [each["about"] for each in warnings if each["code"] == "frame-apart"] == ["other"]


@pytest.mark.thorough
def test_both_ways_keep_what_was_found_forwards(rig: Path, followed: Path, tmp_path: Path) -> None:
    follow(rig, tmp_path / "run", "--both-ways", "--residuals", "--threads", 1)
    assert_right(tracks_of(tmp_path / "run"))
    forwards = lf.open_particles(tmp_path / "run" / "forwards" / "frame_2.vtkhdf")
    one_way = particle_files(followed)[2]
    np.testing.assert_array_equal(forwards.position_mm, lf.open_particles(one_way).position_mm)
    for number in range(FRAMES):
        assert (tmp_path / "run" / "forwards" / f"frame_{number}.vtkhdf").is_file()
        left = lf.read_image(tmp_path / "run" / "particles" / f"frame_{number}_residual.tif")
        # The noise is 6 counts.
        assert np.std(left) < 7.0


@pytest.mark.thorough
def test_tracks_end_before_a_frame_that_is_lost(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # It begins with the first two that can be read.
    names = [tmp_path / f"t_{number}.tif" for number in (7, 8, 9, 10, 11, 13)]
    for path, source in zip(names, [None, 0, 1, 2, None, 3], strict=True):
        path.write_bytes(b"II" if source is None else images(rig)[source].read_bytes())
    output, failures = tmp_path / "out", tmp_path / "failures.json"
    options = ("--shortest", 2, "--keep-going", "--failures", failures)
    with pytest.raises(InputError, match="t_7"):
        follow(rig, output, frames=names)
    # As a shell sorts them.
    capsys.readouterr()
    with pytest.raises(PartialError, match="2 of 6 frames failed"):
        follow(rig, output, *options, frames=sorted(names))
    reported = capsys.readouterr().err
    assert all(code in reported for code in ("frames-reordered", "frames-missing", "frame-failed"))
    assert [each["name"] for each in json.loads(failures.read_text())] == ["t_7", "t_11"]
    assert sorted(path.stem for path in (output / "particles").iterdir()) == ["t_10", "t_13", "t_8", "t_9"]
    tracks = tracks_of(output)
    assert tracks.arrays["frame"].tolist() == COUNT * [0, 1, 2]
    velocity = np.median(tracks.arrays["velocity"], axis=0)
    assert np.all(np.abs(velocity - MOVED_MM * 1e-3 / DT_S) < (3e-4, 3e-4, 3e-3))
    before = {path: path.stat().st_mtime_ns for path in (output / "particles").iterdir()}
    with pytest.raises(PartialError):
        follow(rig, output, *options, "--resume", frames=names)
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.mark.thorough
@pytest.mark.parametrize("ways", [(), ("--both-ways",)])
def test_it_stops_before_its_time_limit_and_goes_on(
    rig: Path,
    followed: Path,
    tmp_path: Path,
    ways: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output, asked = tmp_path / "run", 0

    def leaves_time(_: Deadline) -> bool:
        nonlocal asked
        asked += 1
        return asked <= 3

    options = ("--threads", 1, *ways)
    follow(rig, output, *options, "--dry-run", "--json")
    reported = json.loads(capsys.readouterr().out)
    assert (reported["frames"], reported["to_make"], output.exists()) == (FRAMES, FRAMES, False)
    with monkeypatch.context() as patch:
        patch.setattr(Deadline, "leaves_time", leaves_time)
        with pytest.raises(StoppedEarlyError, match=f"3 of {FRAMES} frames are done"):
            follow(rig, output, *options, "--time-limit", "1h")
    assert not (output / "tracks.vtkhdf").exists()
    follow(rig, output, *options, "--dry-run", "--resume", "--json")
    reported = json.loads(capsys.readouterr().out)
    assert reported["to_make"] == (FRAMES if ways else 1)
    follow(rig, output, "--threads", 2, *ways, "--time-limit", "1h", "--resume")
    if ways:
        return
    # As if it had not stopped, on other threads; so does what has lost a file, and the frame after it is left alone.
    assert contents(output) == contents(followed)
    lost, last = particle_files(output)[2:]
    made = last.stat().st_mtime_ns
    lost.unlink()
    (output / "tracks.vtkhdf").unlink()
    follow(rig, output, *options, "--resume")
    assert contents(output) == contents(followed)
    assert last.stat().st_mtime_ns == made
