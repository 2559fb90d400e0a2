"""Inputs that are damaged, of another kind, or made to do harm, each through a command that reads them."""

import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import imagecodecs
import numpy as np
import pytest
import yaml

from lfpiv_cli.files import particle_file
from lfpiv_cli.files.hdf5 import DIGEST, read_tree, write_tree
from lfpiv_cli.files.images import count_pages
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT
from lfpiv_cli.files.vtkhdf import open_vectors, write_vectors, write_volume
from lfpiv_cli.files.weights_file import FORMAT, VERSION
from lfpiv_cli.files.weights_file import UNITS as WEIGHT_UNITS
from lfpiv_cli.grid import FOCAL_POINT, Grid
from tests.commands import CONFIG, SAMPLE, edited, ended
from tests.vector_fields import SHAPE, field_of, points_of


@pytest.mark.parametrize("kind", ["an image (TIFF)", "an image (PNG)", "an HDF5 file"])
def test_what_stands_in_place_of_a_config_is_told(tmp_path: Path, kind: str) -> None:
    given = SAMPLE / "white.tif" if "TIFF" in kind else tmp_path / "given"
    if "PNG" in kind:
        given.write_bytes(imagecodecs.png_encode(np.ones((9, 9), np.uint8)))
    elif "HDF5" in kind:
        h5py.File(given, "w").close()
    assert ended("check", given) == (3, f"{given}: is {kind}; expected a rig file")


def correlated(folder: Path, value: float, other: float) -> tuple[int, str]:
    """Correlate two volumes that are a value all over, but for one voxel of one of them, which is another value."""
    grid = Grid.centred((16, 16, 16), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    pair, made = [folder / f"{name}.vtkhdf" for name in "ab"], {"provenance": {}, "attributes": {}, "overwrite": False}
    for path in pair:
        write_volume(path, np.full(grid.shape_zyx, value), grid, FOCAL_POINT, **made)
    with edited(pair[1]) as file:
        file["intensity"][3, 4, 5] = other
    words = ("--config", CONFIG, "--dt-s", 0.001, "--windows", 8, "-o", folder / "v.vtkhdf")
    return ended("correlate", *pair, *words)


@pytest.mark.thorough
@pytest.mark.parametrize("value", [0.0, 1.0, 65535.0, 1e30])
def test_no_vector_of_constant_volumes_is_an_unflagged_nan(tmp_path: Path, value: float) -> None:
    assert correlated(tmp_path, value, value) == (0, "")
    field = open_vectors(tmp_path / "v.vtkhdf")
    assert np.isfinite(field.displacement_voxel[field.flag == 0]).all()
    assert value or field.flag.all()


@pytest.mark.thorough
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_volumes_that_hold_no_numbers_are_refused(tmp_path: Path, value: float) -> None:
    code, said = correlated(tmp_path, 1.0, value)
    assert (code, "b.vtkhdf" in said) == (4, True), said
    assert not (tmp_path / "v.vtkhdf").exists()


# Vectors


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("dt_s", [0.1, None])
def test_displacements_that_are_no_numbers_are_refused(tmp_path: Path, value: float, dt_s: float | None) -> None:
    path = tmp_path / "v.vtkhdf"
    field = replace(field_of(np.ones((*SHAPE, 3)), None), dt_s=dt_s)
    write_vectors(path, field, FOCAL_POINT, provenance={}, overwrite=False)
    with edited(path) as file:
        file["displacement_voxel"][1, 2, 3, 0] = value
    for words in (("combine", path, path, "-o", tmp_path / "c.vtkhdf"), ("export", path, "--to", "csv")):
        code, said = ended(*words)
        assert (code, "v.vtkhdf: a vector that counts as valid is not a finite number" in said) == (4, True), said


def test_weights_that_point_beyond_their_image_reconstruct_nothing(tmp_path: Path, weights: Path) -> None:
    broken, form = tmp_path / "broken.h5", {"format_name": FORMAT, "format_version": VERSION, "units": WEIGHT_UNITS}
    tree, made = read_tree(weights, FORMAT, VERSION)
    tree["rows"]["cell"][7] = 10**6
    write_tree(broken, tree, **form, provenance=made, overwrite=False)
    code, said = ended("reconstruct", broken, SAMPLE / "pair_a.tif", "-o", tmp_path / "v.vtkhdf")
    assert (code, "broken.h5" in said, "1000000" in said) == (4, True, True), said
    assert not (tmp_path / "v.vtkhdf").exists()


# Longer than what HDF5 keeps under a check sum of its own.
PROVENANCE = {"command": "test", "config": {"numbers": list(range(2000))}}
KINDS = ("vectors", "volume", "particles", "tracks", "trajectories", "weights")


def write_kind(path: Path, kind: str) -> None:
    """Write a small file of a kind."""
    rng = np.random.default_rng(1)
    if kind == "vectors":
        field = field_of(rng.normal(size=(*SHAPE, 3)), None)
        write_vectors(path, field, FOCAL_POINT, provenance=PROVENANCE, overwrite=False)
    elif kind == "volume":
        grid = Grid.centred((4, 3, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
        reported = {"residual": np.ones(3), "excluded_pixels": 0, "support_voxels": 24}
        array = rng.random(grid.shape_zyx)
        write_volume(path, array, grid, FOCAL_POINT, provenance=PROVENANCE, attributes=reported, overwrite=False)
    elif kind == "weights":
        config = yaml.safe_load(CONFIG.read_text())
        config["volume"] |= {"shape_xyz": [3, 2, 2], "reference": "focal_point"}
        rig = path.with_name("rig.yaml")
        rig.write_text(yaml.safe_dump(config))
        assert ended("build-weights", rig, "-o", path) == (0, "")
    else:
        names = {"particles": PARTICLES_FORMAT, "tracks": TRACKS_FORMAT, "trajectories": TRAJECTORIES_FORMAT}
        reported = {"dt_s": 0.1, "residual": 0.1, "refraction": "exact", "excluded_pixels": 0, "read_noise_counts": 1.0}
        made = points_of(names[kind], rng, provenance=PROVENANCE, particle_diameter_mm=0.1, **reported)
        particle_file.write_points(path, names[kind], made, overwrite=False)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of a small file of each kind."""
    folder = tmp_path_factory.mktemp("whole")
    for kind in KINDS:
        write_kind(folder / kind, kind)
    return {kind: (folder / kind).read_bytes() for kind in KINDS}


@pytest.mark.parametrize("kind", ["vectors", "particles"])
def test_no_damage_of_a_long_provenance_is_read_as_data(tmp_path: Path, whole: dict[str, bytes], kind: str) -> None:
    at = whole[kind].index(b"1000, 1001")
    (tmp_path / "file").write_bytes(whole[kind][:at] + b"1009" + whole[kind][at + 4 :])
    code, said = ended("info", tmp_path / "file")
    assert (code, "attributes" in said) == (4, True), said


def test_every_array_has_a_check_sum_and_files_from_before_it_are_read(tmp_path: Path, whole: dict[str, bytes]) -> None:
    def ensure(name: str, item: h5py.Dataset | h5py.Group) -> None:
        assert not isinstance(item, h5py.Dataset) or item.fletcher32 or not item.size, name

    for kind in KINDS:
        (tmp_path / kind).write_bytes(whole[kind])
        with h5py.File(tmp_path / kind, "r+") as file:
            file.visititems(ensure)
            del file.attrs[DIGEST]
        assert ended("info", tmp_path / kind) == (0, "")


def virtual(file: h5py.File, other: Path) -> None:
    """Add an array whose shape is that of another file's."""
    layout = h5py.VirtualLayout((4, 24), "f8", maxshape=(None, 24))
    unlimited = h5py.VirtualSource(str(other), "array", (4, 24), maxshape=(None, 24))
    layout[: h5py.h5s.UNLIMITED, :] = unlimited[: h5py.h5s.UNLIMITED, :]
    file.create_virtual_dataset("extra", layout)


def secret(other: Path) -> str:
    """Write a file that somebody else's data is in; return its name."""
    with h5py.File(other.with_name("secret.h5"), "w") as file:
        file["array"] = np.full((4, 24), 7.0)
    return str(other.with_name("secret.h5"))


def grown(group: h5py.Group) -> None:
    """Add groups ten deep, each with ten names for the next one: a path has ten billion ends."""
    for _ in range(10):
        below = group.create_group("0")
        for number in range(1, 10):
            group[str(number)] = below
        group = below


HOSTILE: dict[str, Callable[[h5py.File, Path], object]] = {
    "external storage": lambda file, other: file.create_dataset(
        "extra", (3,), "f8", external=[(str(other), 0, h5py.h5f.UNLIMITED)]
    ),
    "virtual": virtual,
    "external link": lambda file, other: file.__setitem__("extra", h5py.ExternalLink(str(other), "/array")),
    "soft link": lambda file, other: file.__setitem__("extra", h5py.SoftLink("/none")),
    "soft link to what is there": lambda file, other: file.__setitem__("extra", h5py.SoftLink("/" + next(iter(file)))),
    "external link to data": lambda file, other: file.__setitem__("extra", h5py.ExternalLink(secret(other), "/array")),
    "external storage of data": lambda file, other: file.create_dataset(
        "extra", (9,), "f8", external=[(secret(other), 0, h5py.h5f.UNLIMITED)]
    ),
    "virtual of data": lambda file, other: virtual(file, Path(secret(other))),
    "strings": lambda file, other: file.create_dataset("extra", (3,), h5py.string_dtype()),
    "compound": lambda file, other: file.create_dataset("extra", (3,), [("a", "f8"), ("b", "i4")]),
    "complex": lambda file, other: file.create_dataset("extra", data=np.array([1j])),
    "long doubles": lambda file, other: file.create_dataset("extra", data=np.ones(3, np.longdouble)),
    "long doubles as attribute": lambda file, other: file.attrs.__setitem__("extra", np.ones(3, np.longdouble)),
    "huge": lambda file, other: file.create_dataset("extra", (10**6, 10**6, 10**3), "f8", chunks=(100, 100, 100)),
    "few never written": lambda file, other: file.create_dataset("extra", (100,), "f8"),
    "chunks not written": lambda file, other: file.create_dataset("extra", (100, 100), "f8", chunks=(10, 10)),
    "circle": lambda file, other: file.create_group("extra").__setitem__("again", file["extra"]),
    "many links": lambda file, other: grown(file.create_group("extra")),
    "three names of an array": lambda file, other: [
        file.__setitem__(f"extra{number}", file["extra"] if number else np.ones(3)) for number in ("", 1, 2)
    ],
    "a type": lambda file, other: file.__setitem__("extra", np.dtype("f8")),
    "never written": lambda file, other: file.create_dataset("extra", (10**9,), "f8"),
    "chunks of a gigabyte": lambda file, other: file.create_dataset(
        "extra", (2**30,), "u1", chunks=(2**30,), compression="gzip"
    ),
    "strings as attribute": lambda file, other: file.attrs.__setitem__("extra", "text"),
    "compound as attribute": lambda file, other: file.attrs.__setitem__("extra", np.zeros(2, [("a", "f8")])),
    "many groups": lambda file, other: [file.create_group(f"extra/{number}") for number in range(10_001)],
    "a record that is a list": lambda file, other: file.attrs.__setitem__("provenance", np.bytes_(b"[1]")),
    "inputs that are a list": lambda file, other: file.attrs.__setitem__(
        "provenance", np.bytes_(b'{"inputs": [1], "config": [2], "warnings": 3, "made_from": "x", "command": {}}')
    ),
}


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes in folders")
@pytest.mark.parametrize("harm", HOSTILE)
@pytest.mark.parametrize(
    "kind", ["vectors", *(pytest.param(kind, marks=pytest.mark.thorough) for kind in ("tracks", "weights"))]
)
def test_what_no_file_of_ours_has_is_refused(tmp_path: Path, whole: dict[str, bytes], kind: str, harm: str) -> None:
    path, other = tmp_path / "file", tmp_path / "other"
    path.write_bytes(whole[kind])
    with edited(path) as file:
        HOSTILE[harm](file, other)
    os.mkfifo(other)  # whoever opens it waits for ever
    code, said = ended("info", path)
    assert code == 4
    assert "file: " in said


def test_what_memory_does_not_hold_gives_7(
    tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(array: h5py.Dataset, _: object) -> None:
        raise MemoryError

    path = tmp_path / "file.h5"
    path.write_bytes(whole["weights"])
    monkeypatch.setattr(h5py.Dataset, "__getitem__", refused)
    words = ("reconstruct", path, SAMPLE / "pair_a.tif", "-o", tmp_path / "v.vtkhdf")
    code, said = ended(*words)
    assert code == 7
    assert re.search(r"too little memory: /\S+ of \S+file\.h5 needs 0\.00 GB", said), said


def test_each_array_of_a_camera_s_file_is_met_once(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "frames.h5", "w") as file:
        file["frames"] = np.ones((2, 448, 600), np.uint16)
        file["again"] = file["frames"]
        grown(file.create_group("extra"))
    assert count_pages(tmp_path / "frames.h5") == 2
