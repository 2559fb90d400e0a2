"""The shipped pipes at a small size, from simulated images to vectors that are judged."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli.cli.main import cli
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.particle_file import open_particles
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.flow.field import MASKED
from lfpiv_cli.weights.strips import StripOperator

CONFIGS = Path(__file__).parent.parent / "configs"
# What stands in the files, and what makes of them a section of the pipe's middle on a part of the sensor.
SMALL = {
    r"columns: 2352, rows: 1768": "columns: 1000, rows: 1000",
    r"shape_xyz: \[\d+, 100, 100\]": "shape_xyz: [24, 32, 32]",
    r"centre_mm: \[0, 0, 0\]}$": "centre_mm: [0, 0, {z}]}}",
    r"windows: \[32, 16\]": "windows: [16]",
    r"particles: \d+ .*": "particles: 220\n  rays: 6000",
}


def run(*words: object) -> None:
    cli.main([str(word) for word in words], standalone_mode=False)


def small(folder: Path, name: str, z_mm: float) -> Path:
    """Write a shipped config with a volume that begins at the camera's side of the pipe's section."""
    text = (CONFIGS / f"{name}.yaml").read_text()
    for old, new in SMALL.items():
        text, count = re.subn(old, new.format(z=z_mm) if "{z}" in new else new, text, flags=re.MULTILINE)
        assert count == 1, old
    (folder / f"{name}.yaml").write_text(text)
    return folder / f"{name}.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pipe", "pipe_box"])
def test_a_pipes_flow_is_measured_through_its_walls(tmp_path: Path, name: str) -> None:
    rig = small(tmp_path, name, -3.8)
    run("simulate", "particles", rig, "-o", tmp_path / "sim")
    run("build-weights", rig, "-o", tmp_path / "weights.h5")
    images = (tmp_path / "sim" / f"pair_{k}.tif" for k in "ab")
    run("reconstruct", tmp_path / "weights.h5", *images, "-o", tmp_path / "vol", "--iterations", "12")
    volumes = (tmp_path / "vol" / f"pair_{k}.vtkhdf" for k in "ab")
    run("correlate", *volumes, "-o", tmp_path / "vectors.vtkhdf")
    run("validate", "flow", rig, "--vectors", tmp_path / "vectors.vtkhdf", "-o", tmp_path / "report")
    field = open_vectors(tmp_path / "vectors.vtkhdf")
    # corners of windows lie in the wall, and count as far as they are inside
    assert not np.isfinite(field.velocity[field.flag == MASKED]).any()
    figures = json.loads((tmp_path / "report" / "flow.json").read_text())["figures"]
    assert figures["vectors_missing"] == 0
    assert abs(figures["streamwise_mean_error"]) < 0.1
    assert figures["within_25_percent_streamwise"] > 0.7


@pytest.mark.slow
def test_a_pipes_wall_may_be_given_by_its_heights(tmp_path: Path) -> None:
    """Frames, weights and found particles are those of the cylinder that the heights were taken from."""
    y = np.arange(-48, 49) / 10.0
    np.savetxt(tmp_path / "wall.csv", np.repeat(-np.sqrt(49.0 - y[:, np.newaxis] ** 2), 20, axis=1), delimiter=",")
    rig, heights = small(tmp_path, "pipe", 0.3), tmp_path / "heights.yaml"
    wall = "kind: cylinder, axis: x, radius_mm: 7.0, centre_mm: [0, 0, 0]"
    text = rig.read_text().replace("columns: 1000, rows: 1000", "columns: 500, rows: 400")
    text = text.replace("shape_xyz: [24, 32, 32]", "shape_xyz: [8, 10, 8]").replace("particles: 220", "particles: 5")
    rig.write_text(text)
    assert wall in text
    heights.write_text(text.replace(wall, "kind: height_map, file: wall.csv, spacing_mm: [0.5, 0.1]"))
    images, light, places = [], [], []
    for config in (rig, heights):
        folder = tmp_path / config.stem
        run("simulate", "particles", config, "-o", folder)
        run("build-weights", config, "-o", folder / "weights.h5")
        images.append(tifffile.imread(folder / "pair_a.tif").astype(float))
        weights = open_weights(folder / "weights.h5")
        volume = np.zeros(weights.shape, np.float32)
        volume[4, 5, 4] = 1000.0
        light.append(weights.forward(volume))
        found = folder / "found.vtkhdf"
        run("reconstruct", folder / "weights.h5", folder / "pair_a.tif", "-o", found, "--solver", "particles")
        places.append(open_particles(found).position_mm)
    # slopes differ by 1e-9: hardly a ray strikes the neighbouring pixel, none moves by a nanometre
    assert np.abs(images[1] - images[0]).sum() < 1e-3 * images[0].sum()
    np.testing.assert_allclose(light[1], light[0], atol=1e-4 * light[0].max())
    assert len(places[0]) > 3
    np.testing.assert_allclose(places[1], places[0], atol=1e-3)


# Where a pipe is said to be, and where it is: aside, and tilted in the image and away from the camera by 0.25 degrees.
TOLD, BESIDE = "centre_mm: [0, 0, 0]", "centre_mm: [0, -0.1, 0.15]"
TILT_DEG = (-0.25, 0.25)
ASLANT = "axis: [1, -0.0043634, 0.0043634]"


@pytest.mark.slow
def test_a_pipe_that_is_not_where_it_was_said_is_found_and_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Images of one pipe, the rig file of another: its axis is found, and with it the flow is right."""
    told = (CONFIGS / "pipe.yaml").read_text()
    for old, new in {
        "rows: 1768": "rows: 500",
        "shape_xyz: [100, 100, 100]": "shape_xyz: [22, 100, 100]",
        "particles: 5000": "particles: 1100",
        "seed: 7": "seed: 23",
    }.items():
        assert told.count(old) == 1, old
        told = told.replace(old, new)
    true, faces = re.subn(f"axis: x, (radius_mm: .*), {re.escape(TOLD)}", rf"{ASLANT}, \1, {BESIDE}", told)
    true, sections = re.subn(r"axis: x([,}])", rf"{ASLANT}, {BESIDE}\1", true)
    assert (faces, sections) == (2, 3)  # of these the pipe, the flow and what it is judged by
    # Whole: the true pipe reaches beyond the volume that is told.
    true = true.replace("shape_xyz: [22, 100, 100]", "shape_xyz: [22, 106, 106]")
    for name, text in (("told", told), ("true", true)):
        (tmp_path / f"{name}.yaml").write_text(text)
    run("simulate", "particles", tmp_path / "true.yaml", "-o", tmp_path / "sim")
    run("simulate", "white", tmp_path / "true.yaml", "-o", tmp_path)
    lattice, refined, images = tmp_path / "lattice.h5", tmp_path / "refined.h5", tmp_path / "sim"
    dark = ("--dark", tmp_path / "dark.tif")
    run("calibrate-snapshot", tmp_path / "told.yaml", "--white", tmp_path / "white.tif", *dark, "-o", lattice)
    capsys.readouterr()
    words = ("--calibration", lattice, *dark, "-o", refined, "--picture", tmp_path / "walls.png", "--json")
    run("refine-calibration", tmp_path / "told.yaml", images / "pair_a.tif", *words)
    figures = json.loads(capsys.readouterr().out)
    # Measured: within 2 um and 0.01 degrees by the images; by the wall of so little pipe within its error, some 40 um.
    np.testing.assert_allclose(figures["axis_shift_mm"], (-0.1, 0.15), atol=0.01)
    np.testing.assert_allclose(figures["axis_tilt_deg"], TILT_DEG, atol=0.06)
    by_wall, sigma = np.array(figures["axis_by_wall_shift_mm"]), np.array(figures["axis_by_wall_shift_mm_sigma"])
    assert np.all(np.abs(by_wall - (-0.1, 0.15)) < 3.0 * sigma)
    assert (tmp_path / "walls.png").stat().st_size > 10_000
    pipe = load_config(tmp_path / "told.yaml").with_scene_of(open_calibration(refined)).pipe
    assert pipe is not None
    np.testing.assert_allclose(pipe.centre_mm[1:], (-0.1, 0.15), atol=0.01)

    run("build-weights", tmp_path / "told.yaml", "--calibration", refined, "-o", tmp_path / "weights.h5")
    assert isinstance(open_weights(tmp_path / "weights.h5").weights.solver_operator, StripOperator)
    pair = [images / f"pair_{k}.tif" for k in "ab"]
    words = ("--solver", "particles", "--pairing", "ab", "--no-residual")
    run("reconstruct", tmp_path / "weights.h5", *pair, *dark, *words, "-o", tmp_path / "found")
    run("track", *(tmp_path / "found" / f"pair_{k}.vtkhdf" for k in "ab"), "-o", tmp_path / "tracks.vtkhdf", "--grid")
    vectors = tmp_path / "tracks_grid.vtkhdf"
    run("validate", "flow", tmp_path / "true.yaml", "--vectors", vectors, "-o", tmp_path / "report")
    figures = json.loads((tmp_path / "report" / "flow.json").read_text())["figures"]
    # Measured: 0.0002; behind the scene as it is told more than 0.01.
    assert abs(figures["streamwise_mean_error"]) < 0.003
    assert figures["within_25_percent_vector_inner"] > 0.98
