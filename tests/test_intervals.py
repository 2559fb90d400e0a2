"""The time between frames, by the recordings that their images are from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.batch import frames_of
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, read_points, read_tracks, write_points
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.verbs import run as run_stage
from lfpiv_cli.verbs.frames import frames_dt_notices
from lfpiv_cli.verbs.run_steps import RunOptions
from tests.camera_files import STEP_US, write_cine
from tests.test_particle_stage import run, write_frame

RIG = Path(__file__).parent.parent / "configs" / "sample.yaml"


def made(time_s: float | None, digest: str = "x") -> dict[str, Any]:
    return {
        "inputs": {"image": {"name": "run.cine", "sha256": digest} | ({} if time_s is None else {"time_s": time_s})}
    }


def test_frames_of_a_recording_tell_their_time(tmp_path: Path) -> None:
    write_cine(tmp_path / "run.cine", np.arange(24, dtype=np.uint16).reshape(4, 2, 3))
    frames, dt_s = frames_of([tmp_path / "run.cine"]), STEP_US * 1e-6
    for stated, codes in ((dt_s, []), (1.005 * dt_s, []), (1.02 * dt_s, ["time-between-frames"]), (None, [])):
        assert [notice.code for notice in frames_dt_notices(stated, frames)] == codes
    # One that was dropped is found among the others.
    (notice,) = frames_dt_notices(dt_s, [*frames[:2], frames[3]])
    assert notice.measured == pytest.approx(2.0 * dt_s, rel=1e-6)
    assert not frames_dt_notices(2.0 * dt_s, [frames[0], replace(frames[1], fault="lost")])


@pytest.fixture
def pair(tmp_path: Path, rng: np.random.Generator) -> list[Path]:
    """Particles of two frames that were recorded 4 ms apart, and whose config has no time."""
    start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (40, 3))
    paths = [tmp_path / "a.vtkhdf", tmp_path / "b.vtkhdf"]
    resolved = load_config(RIG).resolved()
    for k, path in enumerate(paths):
        write_frame(path, start + 0.1 * k, correlation=resolved["correlation"] | {"dt_s": None})
        points = read_points(path, PARTICLES_FORMAT)
        provenance = points.provenance | made(0.25 + 0.004 * k)
        write_points(path, PARTICLES_FORMAT, replace(points, provenance=provenance), overwrite=True)
    return paths


def test_track_takes_the_recorded_time(pair: list[Path], tmp_path: Path, capsys) -> None:
    run("track", *pair, "--grid", "-o", tmp_path / "tracks.vtkhdf")
    tracks = read_tracks(tmp_path / "tracks.vtkhdf")
    np.testing.assert_allclose(tracks.arrays["velocity"], 0.025)
    assert open_vectors(tmp_path / "tracks_grid.vtkhdf").dt_s == pytest.approx(0.004)
    capsys.readouterr()
    run("track", *pair, "--dt-s", 0.00401, "-o", tmp_path / "near.vtkhdf", "--json")
    assert "time-between-frames" not in capsys.readouterr().out
    run("track", *pair, "--dt-s", 0.002, "-o", tmp_path / "stated.vtkhdf", "--json")
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    assert (warning["code"], warning["expected"]) == ("time-between-frames", "0.002")
    assert warning["measured"] == pytest.approx(0.004)
    np.testing.assert_allclose(read_tracks(tmp_path / "stated.vtkhdf").arrays["velocity"], 0.05)
    points = read_points(pair[1], PARTICLES_FORMAT)
    unknown = points.provenance | made(None)
    write_points(pair[1], PARTICLES_FORMAT, replace(points, provenance=unknown), overwrite=True)
    with pytest.raises(InputError, match="--dt-s"):
        run("track", *pair, "-o", tmp_path / "none.vtkhdf")


def test_run_needs_no_time_where_the_images_tell_it(tmp_path: Path) -> None:
    text = RIG.read_text()
    settings = tmp_path / "rig.yaml"
    assert ", dt_s: 0.002" in text
    settings.write_text(text.replace(", dt_s: 0.002", "").replace("columns: 600, rows: 448", "columns: 60, rows: 45"))
    stack = np.random.default_rng(1).integers(0, 4000, (4, 45, 60)).astype(np.uint16)
    write_cine(tmp_path / "run.cine", stack)
    options = RunOptions(images=[tmp_path / "run.cine"], white=[tmp_path / "run.cine"], report=False, pairing="ab")
    _, pairs = run_stage._ensure_possible(load_config(settings), options)
    assert pairs.pairs == ((0, 1), (2, 3))
    followed = run_stage._ensure_possible(load_config(settings), replace(options, follow=True))[1]
    assert followed.pairs == ((0, 1), (1, 2), (2, 3))
    tifffile.imwrite(tmp_path / "run.tif", stack, photometric="minisblack")
    with pytest.raises(ConfigError, match="dt_s: is missing"):
        run_stage._ensure_possible(load_config(settings), replace(options, images=[tmp_path / "run.tif"]))
