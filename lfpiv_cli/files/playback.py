"""Tracks played in time: VTKHDF PolyData with a step for each frame, in which ParaView shows the places of that frame.

Layout: VTK's temporal PolyData, one part a step. The arrays lie under `/VTKHDF` in the order of frames, and within a
frame in that of tracks: `Points` (mm), and in `PointData` `track`, `velocity` and `velocity_sigma` (m/s). What is
measured is in the file of tracks; this one is for the eye.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from lfpiv_cli.files.hdf5 import create, ensure_format, open_h5, write_array, write_rows
from lfpiv_cli.files.particle_file import POSITION, TRAJECTORIES_FORMAT, UNITS, PointRows
from lfpiv_cli.files.vtk import create_vtk_group, write_root, write_steps

PLAYBACK_FORMAT, PLAYBACK_VERSION = "lfpiv-playback", 1
# Of `lfpiv-trajectories`: what is shown at each place.
SHOWN = ("track", "velocity", "velocity_sigma")
KINDS = ("Vertices", "Lines", "Polygons", "Strips")


def write_playback(path: Path, tracks: PointRows, frames: int, dt_s: float, *, overwrite: bool) -> None:
    """Write the tracks of a sequence of so many frames, `dt_s` apart, for playing them in time.

    Raises
    ------
    OutputExistsError, OutputError
    """
    counts, rows = tracks.in_frames(frames)
    before = np.cumsum(counts) - counts
    count = int(counts.sum())
    units = UNITS[TRAJECTORIES_FORMAT]

    def fill(file: h5py.File) -> None:
        write_root(file, PLAYBACK_FORMAT, PLAYBACK_VERSION, tracks.reference, tracks.attributes, tracks.provenance)
        vtk = create_vtk_group(file, "PolyData")
        write_rows(vtk, "Points", count, rows(POSITION), "mm")
        write_array(vtk, "NumberOfPoints", counts)
        for kind in KINDS:
            cells = counts if kind == "Vertices" else np.zeros_like(counts)
            group = vtk.create_group(kind)
            write_array(group, "NumberOfCells", cells)
            write_array(group, "NumberOfConnectivityIds", cells)
            # Each step has offsets of its own, one more than cells.
            ids = int(cells.sum())
            write_rows(group, "Offsets", ids + len(cells), (np.arange(each + 1) for each in cells))
            write_rows(group, "Connectivity", ids, (np.arange(each) for each in cells))
        data = vtk.create_group("PointData")
        for name in SHOWN:
            write_rows(data, name, count, rows(name), units[name])
        steps = write_steps(vtk, (dt_s * np.arange(frames)).tolist(), "s", dict.fromkeys(SHOWN, before))
        write_array(steps, "PartOffsets", np.arange(frames, dtype=np.int64))
        write_array(steps, "NumberOfParts", np.ones(frames, np.int64))
        write_array(steps, "PointOffsets", before)
        of_kinds = np.zeros((frames, len(KINDS)), np.int64)
        of_kinds[:, 0] = before
        write_array(steps, "CellOffsets", of_kinds)
        write_array(steps, "ConnectivityIdOffsets", of_kinds)

    def check(temporary: Path) -> None:
        with open_h5(temporary) as file:
            ensure_format(temporary, file, PLAYBACK_FORMAT, (PLAYBACK_VERSION,))

    create(path, fill, overwrite=overwrite, check=check)
