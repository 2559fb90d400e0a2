"""`refine-calibration` on the shipped sample: a mid plane that is wrong on purpose is found again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.calibration_file import open_calibration, write_calibration
from lfpiv_cli.files.hdf5 import open_h5, read_provenance

ROOT = Path(__file__).parent.parent
SAMPLE, CONFIG = ROOT / "sample_data", ROOT / "configs" / "sample.yaml"
WRONG_MM = 0.3


def run(*arguments: object) -> None:
    cli.main([str(argument) for argument in arguments], standalone_mode=False)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's calibration with its mid plane too far away."""
    folder = tmp_path_factory.mktemp("refine")
    stills = ("--white", SAMPLE / "white.tif", "--dark", SAMPLE / "dark.tif", "--board", SAMPLE / "board.tif")
    run("calibrate-snapshot", CONFIG, *stills, "-o", folder / "calibration.h5")
    right = open_calibration(folder / "calibration.h5")
    assert right.mid_plane_z_mm is not None
    path = folder / "wrong.h5"
    write_calibration(path, replace(right, mid_plane_z_mm=right.mid_plane_z_mm + WRONG_MM), {}, False)
    return path


@pytest.mark.slow
def test_a_wrong_mid_plane_is_found_and_mended(wrong: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image, dark = SAMPLE / "pair_a.tif", ("--dark", SAMPLE / "dark.tif")
    output, picture = tmp_path / "refined.h5", tmp_path / "walls.png"
    capsys.readouterr()
    targets = ("-o", output, "--picture", picture, "--json")
    run("refine-calibration", CONFIG, image, "--calibration", wrong, *dark, *targets)
    summary = json.loads(capsys.readouterr().out)
    truth = json.loads((SAMPLE / "particles.json").read_text())["reference_z_mm"]
    assert abs(summary["mid_plane_z_mm"] - truth) < 3 * summary["mid_plane_z_mm_sigma"]
    assert summary["mid_plane_z_mm_sigma"] < 0.03
    assert summary["mid_plane_correction_mm"] == pytest.approx(-WRONG_MM, abs=0.06)
    mended = open_calibration(output)
    assert mended.mid_plane_z_mm == summary["mid_plane_z_mm"]
    assert mended.pose is not None
    moved = mended.fit.centres((3, -2)) - open_calibration(wrong).fit.centres((3, -2))
    np.testing.assert_allclose(moved, summary["lattice_shift_px"], atol=1e-12)
    # The shipped images belong together: nothing has moved, and the tracers are 0.05 mm wide.
    assert np.abs(moved).max() < 0.01
    assert abs(summary["particle_diameter_mm"] - 0.05) < 3 * summary["particle_diameter_mm_sigma"]
    with open_h5(output) as file:
        made_by = read_provenance(file)
    assert made_by["command"] == "refine-calibration"
    assert {"calibration", "image", "dark"} <= set(made_by["inputs"])
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
def test_half_a_millimetre_on_the_recorded_pair(
    data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, config = data_folder / "channel", ROOT / "configs" / "channel.yaml"
    dark, off = ("--dark", data / "dark.tif"), tmp_path / "off.h5"
    stills = ("--white", data / "white.tif", "--board", data / "board.tif")
    run("calibrate-snapshot", config, *stills, *dark, "-o", tmp_path / "calibration.h5")
    right = open_calibration(tmp_path / "calibration.h5")
    assert right.mid_plane_z_mm is not None
    moved = replace(right.rectification, fit=right.fit.shifted(np.array([0.2, -0.1])))
    write_calibration(off, replace(right, rectification=moved, mid_plane_z_mm=right.mid_plane_z_mm + 0.5), {}, False)
    capsys.readouterr()
    run("refine-calibration", config, data / "pair_a.tif", "--calibration", off, *dark, "--json")
    summary = json.loads(capsys.readouterr().out)
    truth = json.loads((data / "truth.json").read_text())
    # Measured: 0.002 mm and 0.0004 px are left.
    left = summary["mid_plane_z_mm"] - truth["mid_plane_z_mm"]
    assert abs(left) < min(0.02, 2 * summary["mid_plane_z_mm_sigma"])
    np.testing.assert_allclose(summary["lattice_shift_px"], (-0.2, 0.1), atol=4e-3)
    assert np.all(np.abs(summary["wall_tilt_deg"]) < 2 * np.array(summary["wall_tilt_deg_sigma"]))
    for name, true in (("magnification", -1.0), ("aperture_mm", 25.0), ("particle_diameter_mm", 0.05)):
        assert abs(summary[name] - true) < 2 * summary[f"{name}_sigma"], name
    assert abs(summary["k1_per_mm2"] - truth["camera"]["k1"]) < 2 * summary["k1_per_mm2_sigma"]


@pytest.mark.thorough
def test_a_config_without_a_channel_is_refused(wrong: Path, tmp_path: Path) -> None:
    config = tmp_path / "rig.yaml"
    lines = [line for line in CONFIG.read_text().splitlines() if not line.startswith("channel")]
    config.write_text("\n".join(lines).replace("reference: mid_plane", "reference: focal_point"))
    with pytest.raises(ConfigError, match="channel: is missing"):
        run("refine-calibration", config, SAMPLE / "pair_a.tif", "--calibration", wrong)
