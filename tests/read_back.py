"""What other programs read of an export is what the file holds, to the last bit: a reader for each format."""

import csv
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, netcdf_file

from lfpiv_cli.files.export_formats import Content, columns_of
from lfpiv_cli.files.export_vtk import SHOWN
from lfpiv_cli.files.particle_file import POSITION
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT
from lfpiv_cli.flow.field import REJECTED


def same(found: np.ndarray, expected: np.ndarray) -> None:
    """Assert that two arrays are the same to the last bit, in floating point also by type."""
    if expected.dtype.kind == "f":
        assert found.dtype.newbyteorder("=") == expected.dtype
    assert np.array_equal(found, expected, equal_nan=expected.dtype.kind == "f")


def ensure_record(text: str, content: Content) -> None:
    """Assert that a record is that of the export, with the record of what was exported in it."""
    made = json.loads(text)
    assert made["command"].startswith("export ")
    assert {name: value for name, value in content.provenance.items() if name != "made_from"} in made[
        "made_from"
    ].values()


def by_hdf5(path: Path, content: Content) -> None:
    """Assert that the content is all that is in a file of ours, but for tables, which are groups (of statistics)."""
    with h5py.File(path) as file:
        arrays = {name for name, member in file.items() if isinstance(member, h5py.Dataset)}
        assert set(content.arrays) == arrays - {"x", "y", "z", "component"}
        for name, array in content.arrays.items():
            same(array, file[name][()])
            assert content.units[name] == file[name].attrs["units"].decode()


def by_netcdf(path: Path, content: Content) -> None:
    with netcdf_file(path, mmap=False) as file:
        ensure_record(file.provenance.decode(), content)
        assert file.format.decode() == content.format_name
        assert file.reference_z_mm.item() == content.attributes["reference_z_mm"]
        found = {name: variable[...].copy() for name, variable in file.variables.items()}
        units = {name: variable.units.decode() for name, variable in file.variables.items()}
    if content.grid is not None:
        for k, axis in enumerate("xyz"):
            same(found[axis], content.grid.axis_mm(k))
    of_vectors = content.format_name == VECTORS_FORMAT
    for name, array in content.arrays.items():
        if name == "velocity" and of_vectors:
            same(np.stack([found[each][..., 0] for each in "uvw"], axis=-1), array)
            continue
        same(found[name][:, :, :, 0] if of_vectors else found[name], array)
        assert units[name] == content.units[name]
    if of_vectors:
        same(found["chc"][..., 0], (content.arrays["flag"] < REJECTED).astype(np.uint8))


def by_matlab(path: Path, content: Content) -> None:
    assert path.read_bytes()[:128].startswith(b"MATLAB 5.0 MAT-file, written by lfpiv  ")
    found = loadmat(path)
    ensure_record(found["provenance"].item(), content)
    assert found["reference_z_mm"].item() == content.attributes["reference_z_mm"]
    for name, array in content.arrays.items():
        same(found[name].reshape(array.shape), array)
        assert found["units"][name].item().item() == content.units[name]


def by_csv(path: Path, content: Content) -> None:
    lines, units = _without_comments(path, content)
    head, *rows = csv.reader(lines)
    _ensure_columns(head, rows, units, content)


def by_tecplot(path: Path, content: Content) -> None:
    lines, units = _without_comments(path, content)
    names = next(line for line in lines if line.startswith("VARIABLES"))
    rows = [line.split() for line in lines if line[0] in "-0123456789n"]
    # The rows of a sequence stand in the order of its frames.
    order = np.argsort(content.arrays["frame"], kind="stable") if "frame" in content.arrays else None
    _ensure_columns(names.split('"')[1::2], rows, units, content, order)


def _without_comments(path: Path, content: Content) -> tuple[list[str], dict[str, str]]:
    """Return the lines of a text but for its comments, and the units that these say."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line.removeprefix("# ") for line in lines if line.startswith("#")]
    ensure_record("".join(comments[comments.index("provenance:") + 1 : -1]), content)
    return [line for line in lines if not line.startswith("#")], json.loads(comments[-1].removeprefix("units: "))


def _ensure_columns(
    head: list[str], rows: list[list[str]], units: dict[str, str], content: Content, order: np.ndarray | None = None
) -> None:
    expected, _ = columns_of(content)
    assert head == list(expected) == list(units)
    assert (units["x"], units.get("u", "m/s")) == ("mm", "m/s")
    found = dict(zip(head, np.array(rows).reshape(-1, len(head)).T, strict=True))
    for name, column in expected.items():
        same(found[name].astype(column.dtype), column if order is None else column[order])


def by_vtk(path: Path, content: Content) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOXML")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkXMLPolyDataReader() if content.grid is None else vtk.vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    assert reader.GetErrorCode() == 0
    data = reader.GetOutput()
    reported = data.GetFieldData()
    ensure_record(reported.GetAbstractArray("provenance").GetValue(0), content)
    assert reported.GetArray("reference_z_mm").GetValue(0) == content.attributes["reference_z_mm"]
    if content.grid is not None:
        place = data.GetDimensions(), data.GetOrigin(), data.GetSpacing()
        assert place == (content.grid.shape_xyz, content.grid.origin_mm, content.grid.spacing_mm)
    for name, array in content.arrays.items():
        stored = data.GetPoints().GetData() if name == POSITION else data.GetPointData().GetArray(name)
        same(vtk_to_numpy(stored).reshape(array.shape), array)
    if content.grid is None:
        count = len(content.arrays[POSITION])
        assert data.GetNumberOfVerts() == count
        lines = [data.GetCell(count + k).GetNumberOfPoints() for k in range(data.GetNumberOfLines())]
        lengths = (
            np.unique(content.arrays["track"], return_counts=True)[1].tolist() if "track" in content.arrays else []
        )
        assert lines == lengths


def vtk_opened(path: Path) -> Any:
    """Return VTK's reader of its own HDF5 files, which has read a file."""
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader


def by_playing(path: Path, content: Content) -> None:
    reader = vtk_opened(path)
    from vtkmodules.util.numpy_support import vtk_to_numpy

    frames = content.arrays.get("frame", np.zeros(1, int))
    assert reader.GetNumberOfSteps() == frames.max() + 1
    for step in range(reader.GetNumberOfSteps()):
        reader.SetStep(step)
        reader.Update()
        here = ... if content.grid is not None else np.flatnonzero(frames == step)
        data = reader.GetOutput().GetPointData()
        for name in content.arrays if content.grid is not None else SHOWN:
            array = content.arrays[name][here]
            same(vtk_to_numpy(data.GetArray(name)).reshape(array.shape), array)
    with h5py.File(path) as file:
        ensure_record(file.attrs["provenance"], content)


READERS = {
    "netcdf": by_netcdf,
    "tecplot": by_tecplot,
    "csv": by_csv,
    "mat": by_matlab,
    "vti": by_vtk,
    "vtp": by_vtk,
    "vtkhdf-series": by_playing,
}
