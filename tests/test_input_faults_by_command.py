"""Inputs that are damaged, of another kind, or made to do harm, each through a command that reads them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.files.vtkhdf import open_vectors, write_vectors, write_volume
from lfpiv_cli.files.weights_file import FORMAT, UNITS, VERSION
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import FOCAL_POINT
from tests.commands import CONFIG, SAMPLE
from tests.hostile_files import edited, ended
from tests.vector_fields import SHAPE, field_of

# Inputs that are no file of the kind


COMMANDS = {
    "a config": ("build-weights", "{input}"),
    "an image": ("check", CONFIG, "{input}"),
    "a white image": ("calibrate-snapshot", CONFIG, "--white", "{input}"),
    "weights": ("reconstruct", "{input}", SAMPLE / "pair_a.tif"),
    "a page": ("report", "{input}"),
    "frames": ("reconstruct", SAMPLE / "no.h5", "{input}"),
    "volumes": ("correlate", "{input}", "{input}"),
    "particles": ("track", "{input}", "{input}"),
    "vectors": ("combine", "{input}", "{input}"),
    "vectors to judge": ("validate", "flow", CONFIG, "--vectors", "{input}"),
    "what is exported": ("export", "{input}", "--to", "csv"),
}


@pytest.mark.parametrize("what", COMMANDS)
def test_a_name_that_is_too_long_is_refused_by_each_command(tmp_path: Path, what: str) -> None:
    path = tmp_path / f"{'x' * 300}input.tif"
    words = [str(word).format(input=path) for word in COMMANDS[what]]
    output = tmp_path / ("output.vtkhdf" if what in ("weights", "volumes", "particles", "vectors") else "output.html")
    words += [] if words[0] == "check" else ["-o", str(output)]
    code, said = ended(*words)
    assert (code, "input.tif" in said) == (4, True), said
    assert not output.exists()


@pytest.mark.parametrize(
    "command",
    [
        ("check", "{input}"),
        ("build-weights", "{input}", "-o", "{output}"),
        ("calibrate-snapshot", "{input}", "--white", SAMPLE / "white.tif", "-o", "{output}"),
        ("run", "{input}", *[SAMPLE / "pair_a.tif"] * 2, "--white", SAMPLE / "white.tif", "-o", "{output}"),
        ("simulate", "white", "{input}", "-o", "{output}"),
        ("validate", "board", "{input}", "-o", "{output}"),
        ("correlate", "{volume}", "{copy}", "--config", "{input}", "-o", "{output}.vtkhdf"),
    ],
    ids=lambda command: command[0],
)
def test_an_image_or_a_result_in_place_of_a_config_is_told(tmp_path: Path, command: tuple[object, ...]) -> None:
    volume, copy, png = tmp_path / "v.vtkhdf", tmp_path / "copy.vtkhdf", tmp_path / "rig.png"
    grid = Grid.centred((3, 3, 3), (0.1,) * 3, (0.0,) * 3)
    write_volume(volume, np.ones((3, 3, 3)), grid, FOCAL_POINT, provenance={}, attributes={}, overwrite=False)
    copy.write_bytes(volume.read_bytes())
    png.write_bytes(imagecodecs.png_encode(np.ones((9, 9), np.uint8)))
    kinds = {SAMPLE / "white.tif": "an image (TIFF)", png: "an image (PNG)", volume: "an HDF5 file"}
    for given, kind in kinds.items():
        words = [
            str(word).format(input=given, output=tmp_path / "output", volume=volume, copy=copy) for word in command
        ]
        assert ended(*words) == (3, f"{given}: is {kind}; expected a rig file")
    assert sorted(os.listdir(tmp_path)) == ["copy.vtkhdf", "rig.png", "v.vtkhdf"]


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


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["cut", "flipped", "zero tail", "version", "index"])
def test_damaged_weights_reconstruct_nothing(tmp_path: Path, weights: Path, kind: str) -> None:
    """At their end, within, in what they say of themselves, or in what they point at."""
    broken, content = tmp_path / "broken.h5", bytearray(weights.read_bytes())
    half = len(content) // 2
    if kind == "cut":
        del content[half:]
    elif kind == "flipped":
        content[half] ^= 1
    elif kind == "zero tail":
        content[half:] = bytes(len(content) - half)
    broken.write_bytes(content)
    if kind == "version":
        with edited(broken) as file:
            file.attrs["format_version"] = 999
    elif kind == "index":
        tree, made = read_tree(broken, FORMAT, (VERSION,))
        tree["rows"]["cell"][7] = 10**6
        form = {"format_name": FORMAT, "format_version": VERSION, "units": UNITS}
        write_tree(broken, tree, **form, provenance=made, overwrite=True)
    code, said = ended("reconstruct", broken, SAMPLE / "pair_a.tif", "-o", tmp_path / "v.vtkhdf")
    assert (code, "broken.h5" in said, kind != "index" or "1000000" in said) == (4, True, True), said
    assert not (tmp_path / "v.vtkhdf").exists()
