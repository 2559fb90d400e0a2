"""`lfpiv plot`: the figures of each kind of file, as PDF or PNG."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.hdf5 import write_tree
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.particle_file import (
    PARTICLES_FORMAT,
    TRACKS_FORMAT,
    TRAJECTORIES_FORMAT,
    UNITS,
    Points,
    write_points,
)
from lfpiv_cli.files.vtkhdf import write_volume
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import Reference
from lfpiv_cli.verbs.plot import figures_of
from tests.commands import table2_rig

pytest.importorskip("matplotlib")

AT_FOCUS = Reference("focal_point", 0.0)
N = 12
DOCS = Path(__file__).parents[1] / "docs"


def run(*arguments: str) -> str:
    return CliRunner().invoke(cli, list(arguments), catch_exceptions=False).stdout


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(table2_rig(240, 200, volume={"shape_xyz": [5, 4, 3], "voxel_mm": [0.1, 0.1, 0.4]}))
    return path


def points(rng: np.random.Generator, of_format: str, provenance: dict) -> Points:
    """Return points with every array that their format has."""
    tensors, vectors = ("covariance_mm2",), ("velocity", "velocity_sigma", "displacement_mm")
    arrays = {
        name: rng.random((N, 6) if name in tensors else (N, 3) if name in vectors else N) for name in UNITS[of_format]
    }
    for name in ("track", "frame", "particle", "particle_a", "particle_b", "flag"):
        if name in arrays:
            arrays[name] = np.arange(N) // 3
    return Points(rng.random((N, 3)), arrays, AT_FOCUS, {}, provenance)


@pytest.fixture
def volume(tmp_path):
    path = tmp_path / "volume.vtkhdf"
    grid = Grid.centred((2, 3, 4), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    array = np.arange(24.0).reshape(4, 3, 2)
    write_volume(path, array, grid, AT_FOCUS, provenance={}, attributes={}, overwrite=True)
    return path


@pytest.mark.thorough
def test_a_pdf_has_a_page_a_figure_and_the_same_bytes_again(volume, tmp_path):
    found = json.loads(run("plot", str(volume), "-o", str(tmp_path / "v.pdf"), "--json"))
    assert found["figures"] == ["projections", "depths"]
    content = (tmp_path / "v.pdf").read_bytes()
    assert len(re.findall(rb"/Type /Page\b(?!s)", content)) == 2
    run("plot", str(volume), "-o", str(tmp_path / "v.pdf"), "--overwrite")
    assert (tmp_path / "v.pdf").read_bytes() == content


@pytest.mark.thorough
def test_png_is_one_figure_or_one_for_each_name(volume, tmp_path):
    run("plot", str(volume), "-o", str(tmp_path / "one.png"), "--only", "depths")
    assert cv2.imread(str(tmp_path / "one.png")) is not None
    found = json.loads(run("plot", str(volume), "-o", str(tmp_path / "p.png"), "--json"))
    assert found["files"] == [str(tmp_path / f"p_{name}.png") for name in ("projections", "depths")]
    assert sorted(path.name for path in tmp_path.glob("p*.png")) == ["p_depths.png", "p_projections.png"]


def test_wrong_names_outputs_and_images_are_refused_before_drawing(volume, tmp_path):
    with pytest.raises(UsageError, match="projections, depths"):
        run("plot", str(volume), "-o", str(tmp_path / "p.png"), "--only", "planes")
    with pytest.raises(UsageError, match=r"\.png or \.pdf"):
        run("plot", str(volume), "-o", str(tmp_path / "p.jpg"))
    with pytest.raises(UsageError, match="--raw"):
        run("plot", str(volume), "-o", str(tmp_path / "p.png"), "--raw", str(volume))
    other = tmp_path / "other.h5"
    write_tree(other, {"a_mm": np.zeros(9)}, format_name="x", format_version=1, provenance={}, overwrite=True)
    with pytest.raises(InputError, match="x has no figures"):
        figures_of(other)


def test_documents_list_the_figures(volume, tmp_path):
    rows = re.findall(r"^\| ([\w ]+) \| (`.*`) \|$", (DOCS / "files.md").read_text(), re.MULTILINE)
    listed = {what: [name.strip("`") for name in names.split(", ")] for what, names in rows}
    rng = np.random.default_rng(1)
    for what, of_format in (("tracks of a pair", TRACKS_FORMAT), ("tracks of a sequence", TRAJECTORIES_FORMAT)):
        path = tmp_path / "t.vtkhdf"
        write_points(path, of_format, points(rng, of_format, {}), overwrite=True)
        assert listed[what] == list(figures_of(path))
    assert listed["volume"] == list(figures_of(volume))
    assert len(listed) == 7


def test_particles_bring_their_residual_and_are_drawn_on_the_raw_image(config, tmp_path):
    path, raw = tmp_path / "a.vtkhdf", tmp_path / "raw.tif"
    made = {"command": "reconstruct", "config": load_config(config).resolved()}
    write_points(path, PARTICLES_FORMAT, points(np.random.default_rng(1), PARTICLES_FORMAT, made), overwrite=True)
    assert list(figures_of(path)) == ["places", "depths", "chi2"]
    write_tiff(tmp_path / "a_residual.tif", np.ones((200, 240), np.float32), overwrite=True)
    write_tiff(raw, np.ones((200, 240), np.uint16), overwrite=True)
    figures = figures_of(path, raw)
    assert list(figures) == ["places", "image", "residual", "depths", "chi2"]
    assert len(figures["image"].draw().axes[0].collections[0].get_offsets()) == N
    write_tiff(raw, np.ones((20, 20), np.uint16), overwrite=True)
    with pytest.raises(InputError, match=r"raw\.tif"):
        figures_of(path, raw)


def test_tracks_of_pairs_and_of_sequences(tmp_path):
    rng = np.random.default_rng(1)
    path = tmp_path / "t.vtkhdf"
    write_points(path, TRACKS_FORMAT, points(rng, TRACKS_FORMAT, {}), overwrite=True)
    assert list(figures_of(path)) == ["space", "velocities", "links", "sigma"]
    write_points(path, TRAJECTORIES_FORMAT, points(rng, TRAJECTORIES_FORMAT, {}), overwrite=True)
    figures = figures_of(path)
    assert list(figures) == ["space", "lengths", "velocities", "links", "sigma"]
    assert figures["space"].draw().axes[0].get_title() == "4 trajectories"


def test_weights_show_the_middle_voxel_and_the_light_by_depth(config, tmp_path):
    path = tmp_path / "weights.h5"
    run("build-weights", str(config), "-o", str(path))
    figures = figures_of(path)
    assert list(figures) == ["column", "light"]
    title = figures["column"].draw().get_suptitle()
    assert title.startswith("voxel 2, 2, 1 at (0, 0.05, 0) mm")
    light = figures["light"].draw().axes[0].lines
    assert [line.get_label() for line in light] == ["middle", "half-way out", "corner"]
    np.testing.assert_allclose(light[0].get_xdata(), [-0.4, 0.0, 0.4], atol=1e-12)
    np.testing.assert_allclose(light[0].get_ydata(), 1.0, atol=0.01)
