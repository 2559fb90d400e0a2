"""Particles and tracks on disk: what is written is read, VTK opens it, and what is broken is refused."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, Points, read_points, symmetric, write_points
from lfpiv_cli.reference import Reference

REFERENCE = Reference("mid_plane", -0.4)


@pytest.fixture
def path(tmp_path: Path, rng: np.random.Generator) -> Path:
    target = tmp_path / "particles.vtkhdf"
    arrays = {
        "intensity": rng.uniform(1.0, 2.0, 5),
        "covariance_mm2": rng.uniform(1.0, 2.0, (5, 6)),
        "chi2": np.ones(5),
        "seen": np.ones(5),
        "flag": np.zeros(5, np.uint8),
    }
    position = np.arange(15.0).reshape(5, 3)
    write_points(target, PARTICLES_FORMAT, Points(position, arrays, REFERENCE, {}, {"a": 1}), overwrite=False)
    return target


def test_what_is_written_is_read(path: Path) -> None:
    points = read_points(path, PARTICLES_FORMAT)
    np.testing.assert_array_equal(points.position_mm, np.arange(15.0).reshape(5, 3))
    assert points.arrays["covariance_mm2"].shape == (5, 6)
    assert points.reference == REFERENCE
    assert points.provenance == {"a": 1}


def test_vtk_opens_the_very_file(path: Path) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    assert data.GetNumberOfPoints() == data.GetNumberOfVerts() == 5
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPoints().GetData()), np.arange(15.0).reshape(5, 3))
    intensity = vtk_to_numpy(data.GetPointData().GetArray("intensity"))
    np.testing.assert_array_equal(intensity, read_points(path, PARTICLES_FORMAT).arrays["intensity"])


def test_an_empty_set_is_a_set(tmp_path: Path) -> None:
    target = tmp_path / "tracks.vtkhdf"
    vectors = {name: np.zeros((0, 3)) for name in ("velocity", "velocity_sigma", "displacement_mm")}
    numbers = {name: np.zeros(0, np.int64) for name in ("particle_a", "particle_b")}
    probability = {"link_probability": np.zeros(0)}
    empty = Points(np.zeros((0, 3)), vectors | numbers | probability, REFERENCE, {}, {})
    write_points(target, TRACKS_FORMAT, empty, overwrite=False)
    assert read_points(target, TRACKS_FORMAT).position_mm.shape == (0, 3)


def test_another_format_is_refused(path: Path) -> None:
    with pytest.raises(InputError, match="lfpiv-tracks"):
        read_points(path, TRACKS_FORMAT)


def test_values_that_are_no_numbers_are_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["chi2"][2] = np.nan
    with pytest.raises(InputError, match="chi2"):
        read_points(path, PARTICLES_FORMAT)


def test_tensors_are_in_vtks_order() -> None:
    matrix = np.array([[[1.0, 4.0, 6.0], [4.0, 2.0, 5.0], [6.0, 5.0, 3.0]]])
    assert symmetric(matrix).tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]
