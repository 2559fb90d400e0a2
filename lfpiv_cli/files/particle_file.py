"""Particles and tracks as VTKHDF PolyData, which ParaView opens: one vertex for each, a line for each long track.

Layout: the arrays lie at the root (`position_mm` (n, 3) and one array of n rows for each quantity, unit in the
attribute `units`) and are linked under `/VTKHDF`, so that readers of HDF5 and of VTK find the same data. Positions are
(x, y, z) in mm, z from the reference that the root's attributes name.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import (
    create,
    ensure_format,
    format_of,
    open_h5,
    read_array,
    write_array,
)
from lfpiv_cli.files.hdf5_checks import array_member
from lfpiv_cli.files.vtk import create_vtk_group, read_root, write_root
from lfpiv_cli.reference import Reference

PARTICLES_FORMAT = "lfpiv-particles"
TRACKS_FORMAT = "lfpiv-tracks"
TRAJECTORIES_FORMAT = "lfpiv-trajectories"
FORMAT_VERSION = 1

POSITION = "position_mm"

# Units of the arrays, by format; tensors are symmetric, as xx, yy, zz, xy, yz, xz (VTK's order).
UNITS = {
    PARTICLES_FORMAT: {
        "intensity": "count",
        "covariance_mm2": "mm^2",
        "chi2": "1",
        "seen": "1",
        "flag": "1",
    },
    TRACKS_FORMAT: {
        "velocity": "m/s",
        "velocity_sigma": "m/s",
        "displacement_mm": "mm",
        "particle_a": "1",
        "particle_b": "1",
        "link_probability": "1",
    },
    # Rows are ordered by track, then by frame.
    TRAJECTORIES_FORMAT: {
        "velocity": "m/s",
        "velocity_sigma": "m/s",
        "track": "1",
        "frame": "1",
        "particle": "1",
        "link_probability": "1",
    },
}
# Arrays in which NaN stands for what is not known.
MAY_BE_UNKNOWN = {"link_probability"}


@dataclass(frozen=True, eq=False)
class Points:
    """Points with their quantities.

    Attributes
    ----------
    position_mm : (n, 3), z from the reference
    arrays : n rows each, by name
    reference : the origin of its coordinates
    attributes, provenance : what the file says about itself
    """

    position_mm: NDArray[np.float64]
    arrays: dict[str, NDArray[Any]]
    reference: Reference
    attributes: dict[str, Any]
    provenance: dict[str, Any]


def no_points(format_name: str, reference: Reference) -> Points:
    """Return points of a format of which there are none."""
    arrays = {name: np.zeros((0, 6) if name.startswith("covariance") else 0) for name in UNITS[format_name]}
    return Points(np.zeros((0, 3)), arrays, reference, {}, {})


def write_points(path: Path, format_name: str, points: Points, *, overwrite: bool) -> None:
    """Write points; their arrays are all that the format has, each with as many rows as there are points.

    Raises
    ------
    OutputExistsError, OutputError
    """
    units, position_mm, arrays = UNITS[format_name], points.position_mm, points.arrays
    if set(arrays) != set(units) or any(len(array) != len(position_mm) for array in arrays.values()):
        raise ValueError(f"{format_name} has the arrays {sorted(units)} of {len(position_mm)} rows each")

    def fill(file: h5py.File) -> None:
        write_root(file, format_name, FORMAT_VERSION, points.reference, points.attributes, points.provenance)
        vtk = create_vtk_group(file, "PolyData")
        vtk["Points"] = write_array(file, POSITION, position_mm, "mm")
        write_array(vtk, "NumberOfPoints", np.array([len(position_mm)], dtype=np.int64))
        _write_cells(vtk, len(position_mm), lines_of(arrays["track"]) if "track" in arrays else np.zeros(1, np.int64))
        data = vtk.create_group("PointData")
        for name, unit in units.items():
            data[name] = write_array(file, name, arrays[name], unit)

    def check(temporary: Path) -> None:
        read_points(temporary, format_name)

    create(path, fill, overwrite=overwrite, check=check)


def read_points(path: Path | str, format_name: str) -> Points:
    """Read points.

    Raises
    ------
    InputError
        If the file is missing, broken, of another format, or holds values that are not finite.
    """
    path = Path(path)
    with open_h5(path) as file:
        ensure_format(path, file, format_name, (FORMAT_VERSION,))
        size = path.stat().st_size
        position = read_array(array_member(file, POSITION), size)
        arrays = {name: read_array(array_member(file, name), size) for name in UNITS[format_name]}
        root = read_root(file)
    if position.ndim != 2 or position.shape[1] != 3:
        raise InputError(f"{path}: its positions have the shape {position.shape}, expected (n, 3)")
    for name, array in (arrays | {POSITION: position}).items():
        known = array[~np.isnan(array)] if name in MAY_BE_UNKNOWN else array
        if len(array) != len(position) or not np.isfinite(known).all():
            raise InputError(f"{path}: {name} has not one finite value for each of its {len(position)} points")
    return Points(position.astype(np.float64), arrays, root.reference, root.attributes, root.provenance)


def read_tracks(path: Path | str) -> Points:
    """Read tracks, of two frames or of a sequence.

    Raises
    ------
    InputError
        As `read_points`.
    """
    is_sequence = format_of(Path(path)) == TRAJECTORIES_FORMAT
    return read_points(path, TRAJECTORIES_FORMAT if is_sequence else TRACKS_FORMAT)


def symmetric(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return symmetric matrices (n, 3, 3) as (n, 6): xx, yy, zz, xy, yz, xz."""
    return np.stack([matrices[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))], axis=1)


def lines_of(track: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where each track's rows begin, and where the last one's end."""
    return np.concatenate([[0], np.flatnonzero(np.diff(track)) + 1, [len(track)]]) if len(track) else np.zeros(1, int)


def _write_cells(vtk: h5py.Group, count: int, lines: NDArray[np.int64]) -> None:
    """Write one vertex for each point, lines of consecutive points that begin and end as told, and no other cells."""
    offsets = {"Vertices": np.arange(count + 1, dtype=np.int64), "Lines": lines.astype(np.int64)}
    for name in ("Vertices", "Lines", "Polygons", "Strips"):
        of_cells = offsets.get(name, np.zeros(1, dtype=np.int64))
        group = vtk.create_group(name)
        write_array(group, "NumberOfCells", np.array([len(of_cells) - 1], dtype=np.int64))
        write_array(group, "NumberOfConnectivityIds", of_cells[-1:])
        write_array(group, "Offsets", of_cells)
        write_array(group, "Connectivity", np.arange(of_cells[-1], dtype=np.int64))
