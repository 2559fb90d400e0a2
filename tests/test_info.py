"""`lfpiv info`: what a file holds, and the picture of one voxel's column."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from lfpiv_cli.cli import cli
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.hdf5 import write_tree

RIG = {
    "camera": {
        "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
        "microlenses": {"pitch_mm": 0.1, "focal_length_mm": 0.8},
        "sensor": {"pixel_um": 5.5, "columns": 240, "rows": 200},
    },
    "media": {"air": 1.0, "window": 1.49, "fluid": 1.33},
    "volume": {"shape_xyz": [5, 4, 3], "voxel_mm": [0.1, 0.1, 0.4]},
}


@pytest.fixture
def weights(tmp_path):
    config, output = tmp_path / "rig.yaml", tmp_path / "weights.h5"
    config.write_text(yaml.safe_dump(RIG))
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


def test_info_draws_a_column(weights, tmp_path):
    picture = tmp_path / "column.png"
    run("info", str(weights), "--picture", str(picture), "--voxel", "4", "0", "2")
    assert picture.stat().st_size > 5_000
    with pytest.raises(UsageError, match="5 x 4 x 3"):
        run("info", str(weights), "--picture", str(picture), "--overwrite", "--voxel", "5", "0", "0")


def test_info_refuses_what_is_not_ours(tmp_path):
    path = tmp_path / "other.h5"
    path.write_bytes(b"no HDF5")
    with pytest.raises(InputError, match="other.h5"):
        run("info", str(path))
    write_tree(path, {"a": np.zeros(9)}, format_name="x", format_version=1, provenance={}, overwrite=True)
    assert json.loads(run("info", str(path), "--json"))["a"] == "float64 [9]"
