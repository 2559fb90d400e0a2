"""Configs that are YAML and nothing that could be: the command that reads them ends at once, with the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.hostile_files import ended

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"


def changed(keys: str, value: Any) -> dict[str, Any]:
    """Return the sample's config with another value of a key."""
    config = yaml.safe_load(SAMPLE.read_text())
    config["volume"] |= {"shape_xyz": [3, 2, 2], "reference": "focal_point"}
    *sections, key = keys.split(".")
    section = config
    for name in sections:
        section = section.setdefault(name, {})
    section[key] = value
    return config


@pytest.mark.parametrize("value", [1e300, 1e-300])
@pytest.mark.parametrize(
    "keys",
    [
        "camera.main_lens.aperture_mm",
        "camera.main_lens.magnification",
        "camera.main_lens.focal_length_mm",
        "camera.microlenses.focal_length_mm",
        "camera.sensor.microlens_distance_mm",
        "volume.voxel_mm",
        "correlation.dt_s",
        "simulation.distortion_per_mm2",
    ],
)
def test_numbers_that_no_bench_has_are_named(tmp_path: Path, keys: str, value: float) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(yaml.safe_dump(changed(keys, -value if keys.endswith("magnification") else value)))
    code, said = ended("check", rig)
    assert code == 3
    assert keys in said


@pytest.mark.parametrize("number", ["0x" + "f" * 20_000, "0o" + "7" * 20_000, "9" * 4_000, "-" + "9" * 20_000])
def test_integers_of_any_length_are_named(tmp_path: Path, number: str) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(SAMPLE.read_text().replace("seed: 3", f"seed: {number}"))
    code, said = ended("build-weights", rig, "-o", tmp_path / "w.h5")
    assert code == 3
    assert "simulation.seed: is too long a number" in said


def test_light_that_only_the_volumes_corners_lose_is_named(tmp_path: Path) -> None:
    config = changed("media", {"air": 2.2, "window": 1.0, "fluid": 1.0})
    lens = {"magnification": -8.0, "focal_length_mm": 100.0, "aperture_mm": 112.5}
    config["camera"]["main_lens"] = lens
    config["volume"]["voxel_mm"] = [4.0, 4.0, 0.01]
    rig = tmp_path / "rig.yaml"
    rig.write_text(yaml.safe_dump(config))
    code, said = ended("simulate", "particles", rig, "-o", tmp_path / "simulated")
    assert code == 3
    assert "totally reflected" in said


@pytest.mark.parametrize(
    ("keys", "value"),
    [("camera.microlenses.focal_length_mm", 1e-9), ("camera.main_lens.aperture_mm", 25_000.0)],
)
def test_lens_images_that_cannot_be_are_named(tmp_path: Path, keys: str, value: float) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(yaml.safe_dump(changed(keys, value)))
    assert ended("build-weights", rig, "--dry-run", "-o", tmp_path / "w.h5")[0] == 3
    assert ended("check", rig)[0] == 3
