"""Weights that somebody has edited, and arguments that do not fit them: refused with what is wrong."""

import multiprocessing
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numba
import numpy as np
import pytest
import yaml

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.weights_file import WeightsFile, open_weights
from tests.commands import ROOT, SAMPLE, edited, ended


def built(folder: Path, *options: object, layout: str = "square", padding: int = 0, **volume: object) -> Path:
    """Return weights of a few voxels of the sample."""
    config = yaml.safe_load((ROOT / "configs" / "sample.yaml").read_text())
    config["volume"] |= {"shape_xyz": [3, 2, 2]} | volume
    config["camera"]["microlenses"]["layout"] = layout
    config["reconstruction"]["padding_voxel"] = [padding, padding, 0]
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    assert ended("build-weights", folder / "rig.yaml", *options, "-o", folder / "w.h5") == (0, "")
    return folder / "w.h5"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of factorised weights."""
    return built(tmp_path_factory.mktemp("weights"), reference="focal_point").read_bytes()


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[bytes, tuple[object, ...]]]:
    """The bytes of a calibration, and of weights made with it, each with the command that takes it as {file}."""
    folder = tmp_path_factory.mktemp("calibrated")
    rig, calibration = folder / "rig.yaml", folder / "c.h5"
    built(folder, reference="focal_point")
    rig.write_text(rig.read_text().replace("focal_point", "mid_plane"))
    pictures = ("--white", SAMPLE / "white.tif", "--board", SAMPLE / "board.tif")
    assert ended("calibrate-snapshot", rig, *pictures, "-o", calibration) == (0, "")
    weights = built(folder, "--calibration", calibration, "--overwrite").read_bytes()
    build = ("build-weights", rig, "--calibration", "{file}", "-o", "{folder}/out.h5")
    use = ("reconstruct", "{file}", SAMPLE / "pair_a.tif", "--iterations", 1, "-o", "{folder}/out.vtkhdf")
    return {"calibration": (calibration.read_bytes(), build), "weights": (weights, use)}


def put(file: h5py.File, name: str, value: Any) -> None:
    """Put another value in the place of an array (`group/name`), if there is one, or an attribute (`group@name`)."""
    if "@" in name:
        group, attribute = name.split("@")
        file[group].attrs[attribute] = value
    else:
        file.pop(name, None)
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
    return ended("reconstruct", path, SAMPLE / "pair_a.tif", "--iterations", 1, "-q", "-o", folder / "v.vtkhdf")


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
    for put_in_place in (lambda file: None, lambda file: put(file, name, [1.0]), lambda file: file.create_group(name)):
        edit = lambda file, then=put_in_place: (file.__delitem__(name), then(file))  # noqa: E731
        assert wrong(weights, tmp_path, edit)[0] == 4


def test_tracing_through_what_cannot_be_and_an_earlier_version_are_named(tmp_path: Path, weights: WeightsFile) -> None:
    for media in ((0.5, 1.0, 1.0), (1.0, np.nan, 1.0), (1.0, 1.0, 1e300)):
        reported = dict(zip(("air", "window", "fluid"), media, strict=True))
        reported |= {"method": np.bytes_("ert"), "refraction": np.bytes_("exact")}
        code, said = wrong(
            weights, tmp_path, lambda file, reported=reported: file.create_group("on_demand").attrs.update(reported)
        )
        assert (code, "not a whole weights file" in said) == (4, True)
    code, said = wrong(weights, tmp_path, lambda file: file.attrs.__setitem__("format_version", 3))
    assert code == 4
    assert "w.h5: has lfpiv-weights version 3, this program reads 4; make it again with this program" in said


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [1e-40, 1e-20, 1e20])
def test_shares_whose_sums_have_no_inverse_are_named(tmp_path: Path, weights: bytes, factor: float) -> None:
    def dim(file: h5py.File) -> None:
        for axis in ("columns", "rows"):
            file[f"{axis}/share"][...] = file[f"{axis}/share"][()] * np.float32(factor)

    code, said = wrong(weights, tmp_path, dim)
    assert (code, "w.h5: not a whole weights file: the largest weight is" in said) == (4, True), said


# In a calibration, and by what; in that of weights they lie in the group `calibration`.
CALIBRATION_EDITS: list[tuple[str, Callable[[h5py.File, str], object]]] = [
    ("image_shape", lambda file, name: put(file, name, [10, 10])),
    *(
        (name, lambda file, name: put(file, name, 0.5))
        for name in ("transmission", "lattice/basis_px", "board/dots_mm")
    ),
    *(
        (name, lambda file, name: (file.__delitem__(name), file.create_dataset(f"{name}/part", data=np.ones(3))))
        for name in ("transmission", "lattice/centres_px")
    ),
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


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> WeightsFile:
    """Factorised weights with padding, and those on demand without."""
    padding, folder = 2 if request.param == "square" else 0, tmp_path_factory.mktemp("weights")
    volume = {"shape_xyz": [4, 3, 2], "reference": "focal_point"}
    return open_weights(built(folder, layout=request.param, padding=padding, **volume))


@pytest.mark.thorough
@pytest.mark.parametrize("shape", [(), (600,), (448, 1), (447, 600), (448, 601), (600, 448), (1, 448, 600)])
def test_images_of_another_shape_are_refused(opened: WeightsFile, shape: tuple[int, ...]) -> None:
    for adjoint in (opened.adjoint, opened.weights.solver_operator.adjoint):
        with pytest.raises(InputError, match="does not fit weights made for"):
            adjoint(np.ones(shape, np.float32))


@pytest.mark.parametrize("shape", [(), (4,), (3, 4), (1, 3, 4), (2, 3, 5), (4, 3, 2), (1, 2, 3, 4)])
def test_volumes_of_another_shape_are_not_stretched(opened: WeightsFile, shape: tuple[int, ...]) -> None:
    for forward in (opened.forward, opened.weights.solver_operator.forward):
        with pytest.raises(InputError, match="does not fit weights made for"):
            forward(np.ones(shape, np.float32))


def test_what_is_no_real_number_and_voxels_outside_the_volume_are_refused(opened: WeightsFile) -> None:
    for verb, shape in ((opened.forward, opened.shape), (opened.adjoint, opened.image_shape)):
        for wrong in (*(np.zeros(shape, kind) for kind in (complex, object, "U1")), None):
            with pytest.raises(InputError, match="expected real numbers"):
                verb(wrong)
    with pytest.raises(InputError, match="expected real numbers"):
        opened.prepare(np.zeros(opened.image_shape, complex))
    for index in ((-1, 0, 0), (0, -1, 0), (0, 0, -1), (2, 0, 0), (0, 3, 0), (0, 0, 4)):
        with pytest.raises(IndexError, match="outside a volume"):
            opened.column(*index)
    with pytest.raises(TypeError):
        opened.column(0.5, 0, 0)
    # Lists of whole numbers are taken.
    volume = np.ones(opened.shape, np.int64)
    np.testing.assert_array_equal(opened.forward(volume.tolist()), opened.forward(volume.astype(np.float32)))


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="workers are not forked")
def test_a_forked_worker_says_that_it_has_lost_its_threads(tmp_path: Path) -> None:
    found = open_weights(built(tmp_path, reference="focal_point"))
    volume = np.ones(found.shape, np.float32)
    found.forward(volume)
    if numba.threading_layer() != "omp":
        pytest.skip("these threads outlive a fork, or begin anew")
    with multiprocessing.get_context("fork").Pool(1) as pool:
        waiting = pool.apply_async(found.forward, [volume])
        with pytest.raises(UsageError, match="spawn"):
            waiting.get(10.0)
