"""Weights that somebody has edited: refused with what is wrong, before anything large is made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml

from tests.hostile_files import edited, ended

ROOT = Path(__file__).parent.parent


SAMPLE = ROOT / "sample_data"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of factorised weights of a few voxels."""
    folder = tmp_path_factory.mktemp("weights")
    config = yaml.safe_load((ROOT / "configs" / "sample.yaml").read_text())
    config["volume"] |= {"shape_xyz": [3, 2, 2], "reference": "focal_point"}
    config["reconstruction"]["padding_voxel"] = [0, 0, 0]
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    assert ended("build-weights", folder / "rig.yaml", "-o", folder / "w.h5") == (0, "")
    return (folder / "w.h5").read_bytes()


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[bytes, tuple[object, ...]]]:
    """The bytes of a calibration, and of weights made with it, each with the command that takes it as {file}."""
    folder = tmp_path_factory.mktemp("calibrated")
    config = yaml.safe_load((ROOT / "configs" / "sample.yaml").read_text())
    config["volume"] |= {"shape_xyz": [3, 2, 2]}
    config["reconstruction"]["padding_voxel"] = [0, 0, 0]
    rig, calibration = folder / "rig.yaml", folder / "c.h5"
    rig.write_text(yaml.safe_dump(config))
    pictures = ("--white", SAMPLE / "white.tif", "--board", SAMPLE / "board.tif")
    assert ended("calibrate-snapshot", rig, *pictures, "-o", calibration) == (0, "")
    assert ended("build-weights", rig, "--calibration", calibration, "-o", folder / "w.h5") == (0, "")
    build = ("build-weights", rig, "--calibration", "{file}", "-o", "{folder}/out.h5")
    use = ("reconstruct", "{file}", SAMPLE / "pair_a.tif", "--iterations", 1, "-o", "{folder}/out.vtkhdf")
    return {"calibration": (calibration.read_bytes(), build), "weights": ((folder / "w.h5").read_bytes(), use)}


def put(file: h5py.File, name: str, value: Any) -> None:
    """Put another value in the place of an array (`group/name`) or an attribute (`group@name`)."""
    if "@" in name:
        group, attribute = name.split("@")
        file[group].attrs[attribute] = value
    else:
        del file[name]
        file[name] = value


EDITS: list[tuple[str, Any]] = [
    ("grid/spacing_mm", [0.0, 0.1, 0.1]),
    ("grid/spacing_mm", [np.nan, 0.1, 0.1]),
    ("grid/spacing_mm", [-0.1, 0.1, 0.1]),
    ("grid/spacing_mm", [1e-300, 0.1, 0.1]),
    ("grid/spacing_mm", 0.1),
    ("grid/spacing_mm", [0.1, 0.1]),
    ("grid/origin_mm", [np.nan, 0.0, 0.0]),
    ("grid/origin_mm", [1e300, 0.0, 0.0]),
    ("grid/shape_xyz", [3.5, 2.0, 2.0]),
    ("grid/shape_xyz", [0, 2, 2]),
    ("grid/shape_xyz", [10**9, 10**9, 10**9]),
    ("grid/shape_xyz", [10_000, 10_000, 10_000]),
    ("grid/padding_xyz", [-1, 0, 0]),
    ("grid/padding_xyz", [9_999, 9_999, 9_999]),
    ("grid@reference", np.bytes_("nowhere")),
    ("grid@reference_z_mm", np.nan),
    ("camera/lattice_basis_mm", np.full((2, 2), np.nan)),
    ("camera/lattice_basis_mm", np.eye(2) * 1e-9),
    ("camera/lattice_basis_mm", np.zeros((2, 2))),
    ("camera/lattice_basis_mm", np.full((2, 2), 0.1)),
    ("camera/lattice_basis_mm", np.eye(3)),
    ("camera/lattice_origin_mm", [np.inf, 0.0]),
    ("camera@magnification", 0.0),
    ("camera@magnification", 1.0),
    ("camera@magnification", np.nan),
    ("camera@magnification", -1e300),
    ("camera@focal_length_mm", 0.0),
    ("camera@aperture_mm", 1e9),
    ("camera@microlens_focal_length_mm", 1e-9),
    ("camera@pixel_mm", 1e-9),
    ("camera@pixel_mm", np.bytes_("small")),
    ("camera@rows", 10**9),
    ("camera@rows", 448.5),
    ("camera@columns", -600),
    ("camera@column_axis", np.bytes_("z")),
    ("camera@layout", 3),
    ("camera@layout", np.bytes_("round")),
    ("camera@distortion_per_mm2", np.nan),
    ("camera@entrance_over_exit", 0.0),
    ("columns/start", [0, 1]),
    ("columns/start", [[0, 1]]),
    ("columns/cell", [-1]),
    ("columns/share", [np.nan]),
    ("rows/share", [[1.0]]),
]


def wrong(weights: bytes, folder: Path, edit: Callable[[h5py.File], object]) -> tuple[int, str]:
    """Reconstruct with edited weights; return how it ends."""
    path = folder / "w.h5"
    path.write_bytes(weights)
    with edited(path) as file:
        edit(file)
    image = ROOT / "sample_data" / "pair_a.tif"
    return ended("reconstruct", path, image, "--iterations", 1, "-q", "-o", folder / "v.vtkhdf")


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "value"), EDITS, ids=[f"{name}={value}" for name, value in EDITS])
def test_an_edit_that_cannot_be_is_named(tmp_path: Path, weights: bytes, name: str, value: Any) -> None:
    code, said = wrong(weights, tmp_path, lambda file: put(file, name, value))
    assert code == 4
    assert "w.h5: not a whole weights file: " in said
    assert not (tmp_path / "v.vtkhdf").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["camera", "grid", "columns", "rows", "columns/share", "grid/spacing_mm"])
def test_what_is_missing_or_of_another_kind_is_named(tmp_path: Path, weights: bytes, name: str) -> None:
    assert wrong(weights, tmp_path, lambda file: file.__delitem__(name))[0] == 4
    assert wrong(weights, tmp_path, lambda file: put(file, name, [1.0, 2.0]))[0] == 4
    assert wrong(weights, tmp_path, lambda file: (file.__delitem__(name), file.create_group(name)))[0] == 4


def test_weights_of_an_earlier_version_are_to_be_built_again(tmp_path: Path, weights: bytes) -> None:
    code, said = wrong(weights, tmp_path, lambda file: file.attrs.__setitem__("format_version", 3))
    assert code == 4
    assert "w.h5: has lfpiv-weights version 3, this program reads 4; make it again with this program" in said


@pytest.mark.parametrize("media", [(0.5, 1.0, 1.0), (1.0, np.nan, 1.0), (1.0, 1.0, 1e300)])
def test_tracing_through_what_cannot_be_is_named(
    tmp_path: Path, weights: bytes, media: tuple[float, float, float]
) -> None:
    def trace(file: h5py.File) -> None:
        group = file.create_group("on_demand")
        told = dict(zip(("air", "window", "fluid"), media, strict=True))
        for name, value in (told | {"method": np.bytes_("ert"), "refraction": np.bytes_("exact")}).items():
            group.attrs[name] = value

    code, said = wrong(weights, tmp_path, trace)
    assert code == 4
    assert "not a whole weights file" in said


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [1e-40, 1e-20, 1e20])
def test_shares_whose_sums_have_no_inverse_are_named(tmp_path: Path, weights: bytes, factor: float) -> None:
    def dim(file: h5py.File) -> None:
        for axis in ("columns", "rows"):
            file[f"{axis}/share"][...] = file[f"{axis}/share"][()] * np.float32(factor)

    code, said = wrong(weights, tmp_path, dim)
    assert (code, "w.h5: not a whole weights file: the largest weight is" in said) == (4, True), said


def grouped(file: h5py.File, name: str) -> None:
    """Put a group in the place of an array."""
    del file[name]
    file.create_group(name).create_dataset("part", data=np.ones(3))


# In a calibration, and by what; in that of weights they lie in the group `calibration`.
CALIBRATION_EDITS: list[tuple[str, Callable[[h5py.File, str], object]]] = [
    ("image_shape", lambda file, name: put(file, name, [10, 10])),
    *(
        (name, lambda file, name: put(file, name, 0.5))
        for name in ("transmission", "lattice/basis_px", "board/dots_mm")
    ),
    *((name, grouped) for name in ("transmission", "lattice/centres_px")),
    ("transmission", lambda file, name: file[name].__setitem__((3, 4), np.nan)),
]


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["calibration", "weights"])
@pytest.mark.parametrize(("name", "edit"), CALIBRATION_EDITS)
def test_a_calibration_with_other_shapes_is_refused(
    tmp_path: Path,
    calibrated: dict[str, tuple[bytes, tuple[object, ...]]],
    kind: str,
    name: str,
    edit: Callable[[h5py.File, str], object],
) -> None:
    content, command = calibrated[kind]
    path = tmp_path / "file.h5"
    path.write_bytes(content)
    with edited(path) as file:
        edit(file, name if kind == "calibration" else f"calibration/{name}")
    code, said = ended(*(str(word).format(file=path, folder=tmp_path) for word in command))
    assert (code, "file.h5: " in said, "calibration" in said) == (4, True, True), said
    assert [path.name] == [each.name for each in tmp_path.iterdir()]
