"""Images whose pixels are no counts, through the commands that read them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml

from lfpiv_cli.cli.options import print_json
from tests.hostile_files import ended

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data"
ROWS, COLUMNS = 448, 600


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a few voxels."""
    folder = tmp_path_factory.mktemp("weights")
    config = yaml.safe_load((ROOT / "configs" / "sample.yaml").read_text())
    config["volume"] |= {"shape_xyz": [12, 12, 12], "reference": "focal_point"}
    config["reconstruction"] |= {"padding_voxel": [0, 0, 0], "iterations": 2}
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    assert ended("build-weights", folder / "rig.yaml", "-o", folder / "w.h5") == (0, "")
    return folder / "w.h5"


def picture(path: Path, value: float) -> Path:
    """Write an image with one pixel of a value among others of 100 counts."""
    counts = np.full((ROWS, COLUMNS), 100.0)
    counts[3, 4] = value
    tifffile.imwrite(path, counts)
    return path


@pytest.mark.thorough
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e30])
@pytest.mark.parametrize("option", ["--dark", "--background", "--mask"])
def test_a_reference_that_holds_no_counts_is_the_inputs_fault(
    tmp_path: Path, weights: Path, option: str, value: float
) -> None:
    image = picture(tmp_path / "reference.tif", value)
    code, said = ended("reconstruct", weights, SAMPLE / "pair_a.tif", option, image, "-o", tmp_path / "v.vtkhdf")
    assert code == 4
    assert "reference.tif: 1 of its 268800 pixels are not counts" in said
    assert not (tmp_path / "v.vtkhdf").exists()


@pytest.mark.parametrize("option", ["--white", "--dark", "--board"])
def test_so_it_is_in_a_calibration(tmp_path: Path, option: str) -> None:
    given = {"--white": SAMPLE / "white.tif", option: picture(tmp_path / "reference.tif", np.nan)}
    words = [word for pair in given.items() for word in pair]
    code, said = ended("calibrate-snapshot", ROOT / "configs" / "sample.yaml", *words, "-o", tmp_path / "c.h5")
    assert code == 4
    assert "reference.tif: 1 of its" in said


@pytest.mark.thorough
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e30])
def test_frames_with_such_pixels_give_volumes_of_numbers(tmp_path: Path, weights: Path, value: float) -> None:
    frame = picture(tmp_path / "frame.tif", value)
    code, said = ended("reconstruct", weights, frame, "-o", tmp_path / "v.vtkhdf")
    assert (code, said) == (0, "")
    assert ended("info", tmp_path / "v.vtkhdf") == (0, "")


def test_figures_that_are_no_numbers_are_null(capsys) -> None:
    print_json({"error": np.float64(np.nan), "by_plane": [1.0, np.inf]})
    assert json.loads(capsys.readouterr().out) == {"error": None, "by_plane": [1.0, None]}


@pytest.mark.thorough
def test_images_without_a_number_are_judged_in_json(tmp_path: Path, weights: Path, capsys) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.full((ROWS, COLUMNS), np.nan, np.float32))
    assert ended("check", weights.with_name("rig.yaml"), tmp_path / "a.tif", "--json")[0] in (0, 4)
    text = capsys.readouterr().out
    assert not text or json.loads(text, parse_constant=lambda word: pytest.fail(f"JSON holds {word}"))
