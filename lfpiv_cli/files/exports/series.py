"""What changes in time in one file, which ParaView plays: VTKHDF with a step for each time.

Volumes or vectors are VTK's temporal ImageData: `/VTKHDF` with the grid's attributes and `Steps`, and in `PointData`
the arrays [t, z, y, x], components last; of a single plane [t, y, x], and of a single time without t and `Steps`, as
VTK reads them. What is measured is in the files of the single times; this one is for the eye. Tracks of a sequence are
what `playback` writes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lfpiv_cli.files.exports.content import Content
from lfpiv_cli.files.hdf5 import FILTERS, create, ensure_format, open_h5
from lfpiv_cli.files.particle_file import POSITION, Points
from lfpiv_cli.files.playback import write_playback
from lfpiv_cli.files.vtk import create_vtk_group, place_image, write_root, write_steps
from lfpiv_cli.reference import Reference

SERIES_FORMAT, SERIES_VERSION = "lfpiv-series", 1


def write_series(
    path: Path,
    first: Content,
    read: Callable[[int], Content],
    count: int,
    times_s: Sequence[float] | None,
    provenance: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Write volumes or vectors on one grid.

    Parameters
    ----------
    first : the one that the grid, the names of the arrays and the attributes are taken from
    read : gives that of each number, which has the same; one at a time is held in memory
    count : how many there are
    times_s : of each, None where only their order is known

    Raises
    ------
    OutputExistsError, OutputError
    """
    if first.grid is None:
        raise ValueError("points are no image")
    grid = first.grid
    of_one = count == 1  # VTK takes one step for none, and its axis for one of the place
    times, unit = (list(map(float, range(count))), "frame") if times_s is None else (times_s, "s")

    def fill(file: h5py.File) -> None:
        told = {name: np.asarray(value) if isinstance(value, list) else value for name, value in _others(first).items()}
        write_root(file, SERIES_FORMAT, SERIES_VERSION, Reference.from_attributes(first.attributes), told, provenance)
        vtk = create_vtk_group(file, "ImageData")
        place_image(vtk, grid)
        points = vtk.create_group("PointData")
        if "velocity" in first.arrays:
            points.attrs["Vectors"] = np.bytes_("velocity")
        for name, array in first.arrays.items():
            shape = array.shape[array.shape[0] == 1 :]
            options = {"chunks": (1, *shape)[of_one:], "track_times": False, **FILTERS}
            dataset = points.create_dataset(name, (count, *shape)[of_one:], array.dtype, **options)
            dataset.attrs["units"] = np.bytes_(first.units[name])
        if not of_one:
            write_steps(vtk, times, unit, dict.fromkeys(first.arrays, np.arange(count, dtype=np.int64)))
        for number in range(count):
            for name, array in read(number).arrays.items():
                points[name][... if of_one else number] = array[0] if array.shape[0] == 1 else array

    def check(temporary: Path) -> None:
        with open_h5(temporary) as file:
            ensure_format(temporary, file, SERIES_FORMAT, (SERIES_VERSION,))

    create(path, fill, overwrite=overwrite, check=check)


def write_tracks_series(path: Path, tracks: Content, provenance: Mapping[str, Any], *, overwrite: bool) -> None:
    """Write the tracks of a sequence for playing them in time."""
    reference = Reference.from_attributes(tracks.attributes)
    points = Points(tracks.arrays[POSITION], tracks.arrays, reference, _others(tracks), dict(provenance))
    frames = int(tracks.arrays["frame"].max(initial=0)) + 1
    write_playback(path, points, frames, float(tracks.attributes["dt_s"]), overwrite=overwrite)


def _others(content: Content) -> dict[str, Any]:
    """Return what a file says about itself besides where its coordinates begin, which is written by its own rule."""
    return {name: value for name, value in content.attributes.items() if not name.startswith("reference")}
