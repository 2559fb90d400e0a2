"""Files for ParaView and VTK: what changes in time, tracks played, and VTK's XML.

What changes in time is VTKHDF with a step for each time. Volumes or vectors are VTK's temporal ImageData: `/VTKHDF`
with the grid's attributes and `Steps`, and in `PointData` the arrays [t, z, y, x], components last; of a single plane
[t, y, x], and of a single time without t and `Steps`, as VTK reads them. What is measured is in the files of the single
times; this one is for the eye.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.export_formats import Content
from lfpiv_cli.files.hdf5 import FILTERS, created, write_array, write_rows
from lfpiv_cli.files.particle_file import CELLS, POSITION, TRAJECTORIES_FORMAT, UNITS, PointRows, Points, lines_of
from lfpiv_cli.files.vtkhdf import create_vtk_group, mark_active, write_root, write_steps
from lfpiv_cli.grid import Reference

# VTK's XML files: images (`.vti`) and points (`.vtp`), for programs that do not read VTKHDF.
#
# The arrays lie behind the XML as raw bytes, each after its length, so that nothing is rounded.

LENGTH = np.dtype("<u8")


def _element(appended: list[NDArray[Any]], name: str, array: NDArray[Any], unit: str | None = None) -> str:
    """Add an array, a row for each place, to those behind the XML; return the element that speaks of it."""
    kind = {"f": "Float", "i": "Int", "u": "UInt"}[array.dtype.kind]
    components = array.shape[1] if array.ndim == 2 else 1
    offset = sum(LENGTH.itemsize + each.nbytes for each in appended)
    appended.append(np.ascontiguousarray(array, array.dtype.newbyteorder("<")))
    head = (
        f'<DataArray type="{kind}{8 * array.itemsize}" Name={quoteattr(name)} NumberOfComponents="{components}" '
        f'format="appended" offset="{offset}"'
    )
    if unit is None:
        return f"{head}/>\n"
    label = f'<InformationKey name="UNITS_LABEL" location="vtkDataArray">{unit}</InformationKey>'
    return f"{head}>{label}</DataArray>\n"


def write_vti(path: Path, content: Content) -> None:
    """Write a volume or vectors as an image of VTK, a point for each voxel or window."""
    if content.grid is None:
        raise ValueError("points are no image")
    appended: list[NDArray[Any]] = []
    grid = content.grid
    extent = " ".join(f"0 {count - 1}" for count in grid.shape_xyz)
    vectors = ' Vectors="velocity"' if "velocity" in content.arrays else ""
    arrays = "".join(
        _element(appended, name, array.reshape(-1, *array.shape[3:]), content.units[name])
        for name, array in content.arrays.items()
    )
    origin, spacing = (" ".join(map(repr, map(float, each))) for each in (grid.origin_mm, grid.spacing_mm))
    body = (
        f'<ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}">\n{_field_data(content)}'
        f'<Piece Extent="{extent}">\n<PointData{vectors}>\n{arrays}</PointData>\n</Piece>\n</ImageData>\n'
    )
    _write(path, "ImageData", body, appended)


def write_vtp(path: Path, content: Content) -> None:
    """Write particles or tracks as points of VTK: a vertex for each, and a line for each track of a sequence."""
    appended: list[NDArray[Any]] = []
    position = content.arrays[POSITION]
    arrays = {name: array for name, array in content.arrays.items() if name != POSITION}
    lines = lines_of(arrays["track"]) if "track" in arrays else np.zeros(1, np.int64)
    data = "".join(_element(appended, name, array, content.units[name]) for name, array in arrays.items())
    points = _element(appended, "Points", position, content.units[POSITION])
    vertices = _cells("Verts", np.arange(len(position) + 1), appended)
    body = (
        f'<PolyData>\n{_field_data(content)}<Piece NumberOfPoints="{len(position)}" NumberOfVerts="{len(position)}" '
        f'NumberOfLines="{len(lines) - 1}" NumberOfStrips="0" NumberOfPolys="0">\n'
        f"<PointData>\n{data}</PointData>\n<Points>\n{points}</Points>\n{vertices}{_cells('Lines', lines, appended)}"
        "</Piece>\n</PolyData>\n"
    )
    _write(path, "PolyData", body, appended)


def _cells(name: str, begins: NDArray[np.int64], appended: list[NDArray[Any]]) -> str:
    """Return the element of cells of consecutive points, each of which begins where the one before ends."""
    connectivity = _element(appended, "connectivity", np.arange(begins[-1], dtype=np.int64))
    offsets = _element(appended, "offsets", begins[1:].astype(np.int64))
    return f"<{name}>\n{connectivity}{offsets}</{name}>\n"


def _field_data(content: Content) -> str:
    """Return what the file says about itself, as arrays of text and numbers."""
    fields = []
    for name, value in content.reported().items():
        if isinstance(value, str):
            # Text is stored as the numbers of its bytes, and ends with a zero.
            kind, count, numbers = "String", 1, " ".join(map(str, [*value.encode(), 0]))
        else:
            array = np.atleast_1d(np.asarray(value))
            kind, count = "Float64" if array.dtype.kind == "f" else "Int64", array.size
            numbers = " ".join(map(repr, array.tolist()))
        head = f'<DataArray Name={quoteattr(name)} type="{kind}" NumberOfTuples="{count}" format="ascii">'
        fields.append(f"{head}{numbers}</DataArray>\n")
    return f"<FieldData>\n{''.join(fields)}</FieldData>\n"


def _write(path: Path, kind: str, body: str, appended: list[NDArray[Any]]) -> None:
    head = (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n{body}<AppendedData encoding="raw">\n_'
    )
    with open(path, "wb") as file:
        file.write(head.encode())
        for array in appended:
            file.write(np.array(array.nbytes, LENGTH).tobytes())
            file.write(array.tobytes())
        file.write(b"\n</AppendedData>\n</VTKFile>\n")


# Tracks played in time: VTKHDF PolyData with a step for each frame, in which ParaView shows the places of that frame.
#
# Layout: VTK's temporal PolyData, one part a step. The arrays lie under `/VTKHDF` in the order of frames, and within
# a frame in that of tracks: `Points` (mm), and in `PointData` `track`, `velocity` and `velocity_sigma` (m/s). What is
# measured is in the file of tracks; this one is for the eye.


PLAYBACK_FORMAT, PLAYBACK_VERSION = "lfpiv-playback", 1
# Of `lfpiv-trajectories`: what is shown at each place.
SHOWN = ("track", "velocity", "velocity_sigma")


def write_playback(path: Path, tracks: PointRows, frames: int, dt_s: float, *, overwrite: bool) -> None:
    """Write the tracks of a sequence of so many frames, `dt_s` apart, for playing them in time."""
    counts, rows = tracks.in_frames(frames)
    before = np.cumsum(counts) - counts
    count = int(counts.sum())
    units = UNITS[TRAJECTORIES_FORMAT]

    with created(path, overwrite=overwrite) as file:
        write_root(file, PLAYBACK_FORMAT, PLAYBACK_VERSION, tracks.reference, tracks.attributes, tracks.provenance)
        vtk = create_vtk_group(file, None)
        write_rows(vtk, "Points", count, rows(POSITION), "mm")
        write_array(vtk, "NumberOfPoints", counts)
        for kind in CELLS:
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
            mark_active(write_rows(data, name, count, rows(name), units[name]), name)
        steps = write_steps(vtk, (dt_s * np.arange(frames)).tolist(), "s", dict.fromkeys(SHOWN, before))
        write_array(steps, "PartOffsets", np.arange(frames, dtype=np.int64))
        write_array(steps, "NumberOfParts", np.ones(frames, np.int64))
        write_array(steps, "PointOffsets", before)
        of_kinds = np.zeros((frames, len(CELLS)), np.int64)
        of_kinds[:, 0] = before
        write_array(steps, "CellOffsets", of_kinds)
        write_array(steps, "ConnectivityIdOffsets", of_kinds)


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
    """Write volumes or vectors on one grid, or the tracks of a sequence for playing them in time.

    Parameters
    ----------
    first : the one that the grid, the names of the arrays and the attributes are taken from
    read : gives that of each number, which has the same; one at a time is held in memory
    count : how many there are
    times_s : of each, None where only their order is known
    """
    reference = Reference.from_attributes(first.attributes)
    # Where coordinates begin is written by its own rule.
    others = {name: value for name, value in first.attributes.items() if not name.startswith("reference")}
    if first.grid is None:
        points = Points(first.arrays[POSITION], first.arrays, reference, others, dict(provenance))
        frames = int(first.arrays["frame"].max(initial=0)) + 1
        write_playback(path, points, frames, float(first.attributes["dt_s"]), overwrite=overwrite)
        return
    grid = first.grid
    of_one = count == 1  # VTK takes one step for none, and its axis for one of the place
    times, unit = (list(map(float, range(count))), "frame") if times_s is None else (times_s, "s")

    with created(path, overwrite=overwrite) as file:
        write_root(file, SERIES_FORMAT, SERIES_VERSION, reference, others, provenance)
        vtk = create_vtk_group(file, grid)
        points = vtk.create_group("PointData")
        for name, array in first.arrays.items():
            shape = array.shape[array.shape[0] == 1 :]
            options = {"chunks": (1, *shape)[of_one:], "track_times": False, **FILTERS}
            dataset = points.create_dataset(name, (count, *shape)[of_one:], array.dtype, **options)
            mark_active(dataset, name).attrs["units"] = np.bytes_(first.units[name])
        if not of_one:
            write_steps(vtk, times, unit, dict.fromkeys(first.arrays, np.arange(count, dtype=np.int64)))
        for number in range(count):
            for name, array in read(number).arrays.items():
                points[name][... if of_one else number] = array[0] if array.shape[0] == 1 else array
