"""The shipped pipes at a small size, from simulated images to vectors that are judged."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli import open_particles, open_vectors, open_weights
from lfpiv_cli.cli import cli
from lfpiv_cli.flow.field import MASKED

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
