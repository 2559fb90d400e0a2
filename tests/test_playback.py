"""Tracks played in time: what VTK's own reader shows at each step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.errors import OutputExistsError
from lfpiv_cli.files.exports.vtk import write_playback
from lfpiv_cli.files.particle_file import Points
from lfpiv_cli.reference import Reference


@pytest.fixture
def tracks() -> Points:
    """Three tracks in four frames, by track: through all, from the second on, and in the last two; none in a fifth."""
    track = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2])
    frame = np.array([0, 1, 2, 3, 1, 2, 3, 2, 3])
    position = np.column_stack([track, frame, 0.5 * track + frame]).astype(np.float64)
    velocity = np.column_stack([10.0 * track + frame, np.zeros(9), np.ones(9)])
    arrays = {"track": track, "frame": frame, "velocity": velocity, "velocity_sigma": 0.1 * np.ones((9, 3))}
    return Points(position, arrays, Reference("mid_plane", 0.5), {}, {"command": "follow"})


def test_vtk_plays_the_places_of_each_frame(tracks: Points, tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    write_playback(tmp_path / "playback.vtkhdf", tracks, 5, 0.002, overwrite=False)
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "playback.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 5
    for step in range(5):
        reader.SetStep(step)
        reader.Update()
        assert reader.GetTimeValue() == pytest.approx(0.002 * step)
        shown, here = reader.GetOutput(), tracks.arrays["frame"] == step
        assert shown.GetNumberOfPoints() == shown.GetNumberOfVerts() == here.sum()
        if here.any():
            np.testing.assert_array_equal(vtk_to_numpy(shown.GetPoints().GetData()), tracks.position_mm[here])
            for name in ("track", "velocity"):
                np.testing.assert_array_equal(
                    vtk_to_numpy(shown.GetPointData().GetArray(name)), tracks.arrays[name][here]
                )


def test_an_existing_file_is_kept(tracks: Points, tmp_path: Path) -> None:
    write_playback(tmp_path / "playback.vtkhdf", tracks, 4, 0.002, overwrite=False)
    with pytest.raises(OutputExistsError):
        write_playback(tmp_path / "playback.vtkhdf", tracks, 4, 0.002, overwrite=False)
