"""`lfpiv info`: what a file holds, and the picture of one voxel's column."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.hdf5 import write_tree
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, Points, write_points
from lfpiv_cli.files.vtkhdf import write_vectors, write_volume
from lfpiv_cli.flow.field import REJECTED, REPLACED, VALID
from lfpiv_cli.grid import Grid, Reference
from tests.commands import table2_rig
from tests.vector_fields import field_on

AT_FOCUS = Reference("focal_point", 0.0)
VOXELS = Grid.centred((1, 2, 3), (0.1, 0.1, 0.2), (0.0, 0.0, 0.0))


@pytest.fixture
def weights(tmp_path):
    config, output = tmp_path / "rig.yaml", tmp_path / "weights.h5"
    config.write_text(table2_rig(240, 200, volume={"shape_xyz": [5, 4, 3], "voxel_mm": [0.1, 0.1, 0.4]}))
    run("build-weights", str(config), "-o", str(output))
    return output


def run(*arguments: str) -> str:
    return CliRunner().invoke(cli, list(arguments), catch_exceptions=False).stdout


def test_info_names_format_method_shapes_and_origin(weights):
    found = json.loads(run("info", str(weights), "--json"))
    assert found["format"] == "lfpiv-weights"
    assert (found["method"], found["refraction"], found["sampling"]) == ("ert", "paraxial", "exact")
    assert found["grid/shape_xyz"] == [5, 4, 3]
    assert found["columns/share"].startswith("float32")
    assert found["inputs"] == ["config rig.yaml"]


@pytest.mark.thorough
def test_info_draws_a_column(weights, tmp_path):
    picture = tmp_path / "column.png"
    run("info", str(weights), "--picture", str(picture), "--voxel", "4", "0", "2")
    assert picture.stat().st_size > 5_000
    with pytest.raises(UsageError, match="5 x 4 x 3"):
        run("info", str(weights), "--picture", str(picture), "--overwrite", "--voxel", "5", "0", "0")


def test_info_draws_weights_alone_and_names_plot_for_the_rest(tmp_path):
    path = tmp_path / "volume.vtkhdf"
    write_volume(path, np.ones((3, 2, 1)), VOXELS, AT_FOCUS, provenance={}, attributes={}, overwrite=True)
    with pytest.raises(UsageError, match=r"lfpiv plot .*volume\.vtkhdf"):
        run("info", str(path), "--picture", str(tmp_path / "p.png"))
    found = json.loads(run("info", str(path), "--json"))
    assert (found["voxels_xyz"], found["largest_intensity"], found["lit_share"]) == ([1, 2, 3], 1.0, 1.0)
    assert found["bounds_mm"][2] == pytest.approx([-0.3, 0.3])


def test_info_counts_vectors_by_flag_and_gives_medians(tmp_path):
    path = tmp_path / "vectors.vtkhdf"
    displacement = np.array([[1.0, 0.0, 5.0], [3.0, 0.0, 6.0], [99.0, 0.0, 99.0]]).reshape(3, 1, 1, 3)
    sigma = np.array([[0.1, np.nan, 1.0], [0.3, np.nan, 2.0], [9.0, 9.0, 9.0]]).reshape(3, 1, 1, 3)
    flag = np.array([VALID, REPLACED, REJECTED], np.uint8).reshape(3, 1, 1)
    grid = Grid.centred((1, 1, 3), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    field = field_on(grid, displacement, flag, sigma)
    made = {
        "command": "correlate",
        "warnings": [dict.fromkeys(("about", "text", "remedy"), "a") | {"code": "few-tracers"}],
    }
    write_vectors(path, field, AT_FOCUS, provenance=made, overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    assert (found["vectors"], found["valid_share"]) == (3, pytest.approx(1.0 / 3.0))
    counts = [found[f"vectors_{name}"] for name in ("valid", "replaced", "second_peak", "rejected", "masked")]
    assert counts == [1, 1, 0, 1, 0]
    assert found["median_displacement_voxel"] == [2.0, 0.0, 5.5]
    assert found["median_velocity_m_s"] == pytest.approx([0.2, 0.0, 0.55])
    assert found["median_sigma_voxel"] == pytest.approx([0.2, None, 1.5])
    assert found["median_velocity_sigma_m_s"] == pytest.approx([0.02, None, 0.15])
    assert "few-tracers" in found["warnings_recorded"][0]


def test_info_tells_of_particles_and_tracks_what_a_person_wants(tmp_path):
    path = tmp_path / "points.vtkhdf"
    places = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
    tensors = np.tile([1e-6, 4e-6, 9e-6, 0.0, 0.0, 0.0], (3, 1))
    arrays = {"intensity": np.array([1.0, 2.0, 9.0]), "covariance_mm2": tensors, "chi2": np.ones(3), "seen": np.ones(3)}
    outside = np.array([0, 0, 1], np.uint8)
    write_points(path, PARTICLES_FORMAT, Points(places, arrays | {"flag": outside}, AT_FOCUS, {}, {}), overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    assert (found["particles"], found["particles_outside"], found["depths_mm"]) == (3, 1, [-1.0, 3.0])
    assert found["median_sigma_mm"] == pytest.approx([1e-3, 2e-3, 3e-3])
    assert (found["median_light_counts"], found["median_chi2"]) == (2.0, 1.0)
    links = {"velocity": places, "velocity_sigma": np.ones((3, 3)), "link_probability": np.array([np.nan, 0.5, 1.0])}
    pair = links | {"displacement_mm": places, "particle_a": outside, "particle_b": outside}
    write_points(path, TRACKS_FORMAT, Points(places, pair, AT_FOCUS, {}, {}), overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    # Three numbers are told as they are, but for one that is none.
    assert found["link_probability"] == "float64 [3]"
    assert (found["tracks"], found["expected_wrong_links"], found["links_of_unknown_probability"]) == (3, 0.5, 1)
    assert found["median_velocity_m_s"] == [0.0, 0.0, 2.0]
    paths = links | {"track": np.array([4, 4, 7]), "frame": np.array([0, 1, 1]), "particle": outside}
    write_points(path, TRAJECTORIES_FORMAT, Points(places, paths, AT_FOCUS, {}, {}), overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    assert (found["tracks"], found["frames"], found["median_frames_of_a_track"]) == (2, 2, 1.5)


def test_info_tells_of_files_of_other_formats(tmp_path):
    path = tmp_path / "other.h5"
    write_tree(path, {"a_mm": np.zeros(9)}, format_name="x", format_version=1, provenance={}, overwrite=True)
    assert json.loads(run("info", str(path), "--json"))["a_mm"] == "float64 [9]"
