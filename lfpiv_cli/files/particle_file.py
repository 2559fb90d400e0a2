"""Particles and tracks as VTKHDF PolyData, which ParaView opens: one vertex for each, a line for each long track.

Simulated particles are a list of its own, as NumPy's npz: `position_mm` and `velocity_mm_s` (n, 3), float32, at the
middle of a pair or sequence, z from the nominal focal point; `brightness` and `diameter_mm` (n,); of each frame
`frame_position_mm` (frames, n, 3) and `frame_brightness` (frames, n), 0 where there is no light.

Layout: the arrays lie at the root (`position_mm` (n, 3) and one array of n rows for each quantity, unit in the
attribute `units`) and are linked under `/VTKHDF`, so that readers of HDF5 and of VTK find the same data. Positions are
(x, y, z) in mm, z from the reference that the root's attributes name.
"""

from __future__ import annotations

import math
import tempfile
import zipfile
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, OutputError
from lfpiv_cli.files import hdf5
from lfpiv_cli.files.atomic import written_atomically
from lfpiv_cli.files.hdf5 import write_array, write_rows
from lfpiv_cli.files.inputs import ensure_regular_file, reason
from lfpiv_cli.files.vtkhdf import create_vtk_group, mark_active, read_root, write_root
from lfpiv_cli.grid import Reference
from lfpiv_cli.notice import written
from lfpiv_cli.results import ArrayResult

MM_PER_M = 1000.0

# What a list need not tell, in the order of the attributes of `Particles`.
SOMETIMES_THERE = ("brightness", "diameter_mm", "frame_position_mm", "frame_brightness")
# Places, which deflate can hardly shrink, tell how large the others may be, which can all be alike.
PLACES, LARGEST_PLACES_RATIO = "position_mm", 300
# Arrays are of 8 bytes a number at most, float64 in memory.
NUMBER_BYTES = 8
# Of what is measured in mm, mm/s and counts; squares of more leave the range of float32.
LARGEST_VALUE = 1e15


@dataclass(frozen=True, eq=False)
class Particles:
    """Particles, and where they are in each frame.

    Attributes
    ----------
    positions_mm, velocities_m_s : (n, 3)
    brightness : (n,), 1 where the file tells none
    diameters_mm : (n,), None where the file tells none
    frame_positions_mm, frame_brightness : (frames, n, 3) and (frames, n), None where the file tells none
    """

    positions_mm: NDArray[np.float64]
    velocities_m_s: NDArray[np.float64]
    brightness: NDArray[np.float64]
    diameters_mm: NDArray[np.float64] | None = None
    frame_positions_mm: NDArray[np.float64] | None = None
    frame_brightness: NDArray[np.float64] | None = None


def read_particles(path: Path) -> Particles:
    """Read a list of particles.

    Raises
    ------
    InputError : the file is missing or broken, an array is missing, or their shapes or values make no list.
    """
    ensure_regular_file(path)
    try:
        with zipfile.ZipFile(path) as stored:
            arrays: dict[str, NDArray[np.float64]] = {}
            # A name in the archive's list must be that before the array itself, of arrays that are not read, too: one
            # that is damaged would be an array that is not told.
            for entry in stored.infolist():
                stored.open(entry).close()
            there = set(stored.namelist())
            names = ["position_mm", "velocity_mm_s", *(name for name in SOMETIMES_THERE if f"{name}.npy" in there)]
            # Places first, by which the size of the others is judged.
            for name in sorted(names, key=lambda name: not name.endswith(PLACES)):
                arrays[name] = _read_array(stored, name, max((array.size for array in arrays.values()), default=0))
    except Exception as error:  # a damaged archive can raise anything in zipfile and NumPy
        raise InputError(f"{path}: not a list of particles: {reason(error)}") from error
    position, velocity = arrays.pop("position_mm"), arrays.pop("velocity_mm_s")
    if position.ndim != 2 or position.shape[1:] != (3,) or position.shape != velocity.shape or not position.size:
        raise InputError(f"{path}: positions {position.shape} and velocities {velocity.shape}, expected twice (n, 3)")
    arrays.setdefault("brightness", np.ones(len(position)))
    frames = arrays["frame_position_mm"].shape[:1] if "frame_position_mm" in arrays else ()
    for name, array in arrays.items():
        of_frames = frames if name.startswith("frame") else ()
        expected = of_frames + (position.shape if name == "frame_position_mm" else position.shape[:1])
        if array.shape != expected:
            raise InputError(f"{path}: {name} {array.shape} for {len(position)} particles, expected {expected}")
    if not all((np.abs(values) < LARGEST_VALUE).all() for values in (position, velocity, *arrays.values())):
        what = f"is not a finite number below {written(LARGEST_VALUE)}"
        raise InputError(f"{path}: a position, velocity, brightness or diameter {what}")
    return Particles(position, velocity / MM_PER_M, arrays["brightness"], *map(arrays.get, SOMETIMES_THERE[1:]))


def _read_array(stored: zipfile.ZipFile, name: str, largest: int) -> NDArray[np.float64]:
    """Return an array of an archive, after asking its header whether it is what the archive's list says.

    Parameters
    ----------
    largest : numbers of the largest array before it

    Raises
    ------
    ValueError : it is of no real numbers, of another size than it declares, or too large
    """
    with stored.open(entry := stored.getinfo(f"{name}.npy")) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError(f"{name} has another version of NumPy's format than 1.0")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        if dtype.kind not in "fiu" or dtype.itemsize > NUMBER_BYTES or min(shape, default=0) < 0:
            raise ValueError(f"{name} is of {dtype} {shape}, expected real numbers")
        begin, count = file.tell(), math.prod(shape)
        if entry.file_size - begin != count * dtype.itemsize:
            raise ValueError(f"{name} declares {shape} numbers of {dtype}, it has {entry.file_size - begin} bytes")
        allowed = LARGEST_PLACES_RATIO * entry.compress_size // dtype.itemsize if name.endswith(PLACES) else largest
        if count > allowed:
            raise ValueError(f"{name} declares {shape} numbers, more than the {allowed} that are possible")
    with stored.open(entry) as file:
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False), np.float64)


def write_particles(path: Path, particles: Particles, overwrite: bool) -> None:
    """Write the particles of a simulated pair or sequence."""
    arrays = {
        "position_mm": particles.positions_mm,
        "velocity_mm_s": particles.velocities_m_s * MM_PER_M,
        "brightness": particles.brightness,
        "diameter_mm": particles.diameters_mm,
        "frame_position_mm": particles.frame_positions_mm,
        "frame_brightness": particles.frame_brightness,
    }
    known: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items() if array is not None}
    with written_atomically(path, overwrite=overwrite) as target, open(target, "wb") as file:
        np.savez_compressed(file, **known)


# The places of a sequence's tracks on a disk: put there a frame at a time, read by frame or by track.
#
# However long a sequence is, a block of tracks, or a frame, is all of it that is in memory.

# Rows of the tracks that are put in order together: a few megabytes.
BLOCK_ROWS = 2**16


class StoredTracks:
    """Tracks of a sequence in a file without a name, which ends with the process, in place of `Points` in memory.

    Rows are put there by frame, and by track within one.

    Attributes
    ----------
    reference : the origin of their coordinates
    attributes, provenance : what their file says about itself
    """

    def __init__(
        self, folder: Path, reference: Reference, attributes: dict[str, Any], provenance: dict[str, Any]
    ) -> None:
        """Begin a file in a folder, on the disk that the tracks will be written to."""
        self.reference, self.attributes, self.provenance = reference, attributes, provenance
        self._folder = folder
        # For each frame, where its arrays begin in the file, and its number of rows.
        self._begins: list[dict[str, int]] = []
        self._counts: list[int] = []
        self._kinds: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        # Of each track, its number of rows.
        self._lengths: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        try:
            self._file = tempfile.TemporaryFile(buffering=0, dir=folder)  # noqa: SIM115
        except OSError as error:
            raise self._error(error) from error

    def __enter__(self) -> StoredTracks:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the file."""
        self._file.close()

    def put(self, rows: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of one more frame, in the order of `track`, in which no number comes twice."""
        track = rows["track"]
        if len(track) and track[-1] >= len(self._lengths):
            self._lengths = np.append(self._lengths, np.zeros(track[-1] + 1 - len(self._lengths), np.int64))
        self._lengths[track] += 1
        self._counts.append(len(track))
        self._kinds = self._kinds or {name: (array.dtype, array.shape[1:]) for name, array in rows.items()}
        begins = {}
        try:
            for name, array in rows.items():
                begins[name] = self._file.tell()
                left = np.ascontiguousarray(array).data.cast("B") if array.size else memoryview(b"")
                while left:
                    left = left[self._file.write(left) :]
        except OSError as error:
            raise self._error(error) from error
        self._begins.append(begins)

    def with_record(self, provenance: dict[str, Any]) -> StoredTracks:
        """Return the same tracks with another record."""
        other = copy(self)
        other.provenance = provenance
        return other

    @property
    def count(self) -> int:
        """How many places there are."""
        return sum(self._counts)

    def rows(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield the rows of an array by track, then by frame, in blocks of whole tracks; one at least."""
        for begins, ends in pairwise(self._cuts.T):
            tracks = self._block("track", begins, ends)
            order = np.argsort(tracks, kind="stable")
            yield (tracks if name == "track" else self._block(name, begins, ends))[order]

    def lines(self) -> NDArray[np.int64]:
        """Return where each track's rows begin, and where the last one's end."""
        return np.concatenate([[0], np.cumsum(self._lengths[self._lengths > 0])])

    def in_frames(self, _frames: int) -> tuple[NDArray[np.int64], Callable[[str], Iterator[NDArray[Any]]]]:
        """Return how many places each frame has, and what yields an array's rows in each."""
        return np.array(self._counts, dtype=np.int64), self._by_frame

    def _by_frame(self, name: str) -> Iterator[NDArray[Any]]:
        return (self._read(frame, name, 0, count) for frame, count in enumerate(self._counts))

    @cached_property
    def _cuts(self) -> NDArray[np.int64]:
        """Where in each frame's rows the blocks of tracks begin, and where the last one ends: (frames, blocks + 1)."""
        ends = np.cumsum(self._lengths)
        inner = np.searchsorted(ends, np.arange(BLOCK_ROWS, ends[-1] if len(ends) else 0, BLOCK_ROWS), "right")
        edges = np.array([0, *inner, len(ends)])
        return np.array([np.searchsorted(track, edges) for track in self._by_frame("track")])

    def _block(self, name: str, begins: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[Any]:
        """Return rows of an array from each frame, one frame after the other."""
        spans = enumerate(zip(begins.tolist(), ends.tolist(), strict=True))
        return np.concatenate([self._read(frame, name, begin, end) for frame, (begin, end) in spans])

    def _read(self, frame: int, name: str, begin: int, end: int) -> NDArray[Any]:
        dtype, shape = self._kinds[name]
        rows = np.empty((end - begin, *shape), dtype)
        if rows.size:
            self._file.seek(self._begins[frame][name] + begin * dtype.itemsize * math.prod(shape))
            if self._file.readinto(rows.data.cast("B")) != rows.nbytes:
                raise OutputError(f"{self._folder}: what was put there for a while cannot be read")
        return rows

    def _error(self, error: OSError) -> OutputError:
        return OutputError(f"{self._folder}: tracks cannot be put there for a while: {reason(error)}")


PARTICLES_FORMAT = "lfpiv-particles"
TRACKS_FORMAT = "lfpiv-tracks"
TRAJECTORIES_FORMAT = "lfpiv-trajectories"
FORMAT_VERSION = 1

POSITION = "position_mm"
# So many rows are read back or counted at a time: a few megabytes.
CHECKED_ROWS = 2**16

# Units of the arrays, by format; tensors are symmetric, as xx, yy, zz, xy, yz, xz (VTK's order).
UNITS = {
    PARTICLES_FORMAT: {"intensity": "count", "covariance_mm2": "mm^2", "chi2": "1", "seen": "1", "flag": "1"},
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
# Arrays that a file may have besides: those of earlier versions have them not.
OPTIONAL = {PARTICLES_FORMAT: {"intensity_sigma": "count"}, TRACKS_FORMAT: {"displacement_covariance_mm2": "mm^2"}}
# Arrays in which NaN stands for what is not known.
MAY_BE_UNKNOWN = {"link_probability"}
NOT_ONE_VALUE = "{}: {} has not one finite value for each of its {} points"
# VTK's kinds of cells, of which these files have the first two.
CELLS = ("Vertices", "Lines", "Polygons", "Strips")


@dataclass(frozen=True, eq=False, repr=False)
class Points(ArrayResult):
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

    def with_record(self, provenance: dict[str, Any]) -> Points:
        """Return the same points with another record."""
        return replace(self, provenance=provenance)

    @property
    def count(self) -> int:
        """How many points there are."""
        return len(self.position_mm)

    @property
    def format_name(self) -> str:
        """The format of a file of such points."""
        tracks = TRACKS_FORMAT if "displacement_mm" in self.arrays else PARTICLES_FORMAT
        return TRAJECTORIES_FORMAT if "track" in self.arrays else tracks

    def rows(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield the rows of an array, or of the positions, all in one piece."""
        yield self.position_mm if name == POSITION else self.arrays[name]

    def lines(self) -> NDArray[np.int64]:
        """Return where each track's rows begin, and where the last one's end."""
        return lines_of(self.arrays["track"]) if "track" in self.arrays else np.zeros(1, np.int64)

    def in_frames(self, frames: int) -> tuple[NDArray[np.int64], Callable[[str], Iterator[NDArray[Any]]]]:
        """Return how many places of tracks each of so many frames has, and what yields an array's rows in each."""
        order = np.lexsort((self.arrays["track"], self.arrays["frame"]))
        counts = np.bincount(self.arrays["frame"], minlength=frames).astype(np.int64)

        def rows(name: str) -> Iterator[NDArray[Any]]:
            (array,) = self.rows(name)
            return (array[each] for each in np.split(order, np.cumsum(counts)[:-1]))

        return counts, rows


# Points whose arrays can be had in pieces, in memory or not.
PointRows: TypeAlias = Points | StoredTracks


def write_points(path: Path, format_name: str, points: PointRows, *, overwrite: bool) -> None:
    """Write points; their arrays are all that the format needs or may have, each with a row for each point."""
    units = UNITS[format_name]
    if isinstance(points, Points):
        units = units_of(format_name, points.arrays)
        if set(points.arrays) != set(units) or any(len(array) != points.count for array in points.arrays.values()):
            raise ValueError(f"{format_name} has the arrays {sorted(units)} of {points.count} rows each")

    def check(temporary: Path) -> None:
        with _opened(temporary, format_name) as (file, datasets):
            read_root(file)
            for name, dataset in datasets.items():
                for begin in range(0, len(dataset), CHECKED_ROWS):
                    _ensure_finite(temporary, name, dataset[begin : begin + CHECKED_ROWS], len(dataset))

    with hdf5.created(path, overwrite=overwrite, check=check) as file:
        write_root(file, format_name, FORMAT_VERSION, points.reference, points.attributes, points.provenance)
        vtk = create_vtk_group(file, None)
        vtk["Points"] = write_rows(file, POSITION, points.count, points.rows(POSITION), "mm")
        write_array(vtk, "NumberOfPoints", np.array([points.count], dtype=np.int64))
        # One vertex for each point, lines of consecutive points, and no other cells.
        count, lines = points.count, points.lines().astype(np.int64)
        counts: dict[str, tuple[int, int, Iterable[NDArray[np.int64]]]] = {
            "Vertices": (count, count, _counted(count + 1)),
            "Lines": (len(lines) - 1, int(lines[-1]), [lines]),
        }
        for name in CELLS:
            cells, ids, offsets = counts.get(name, (0, 0, [np.zeros(1, dtype=np.int64)]))
            group = vtk.create_group(name)
            write_array(group, "NumberOfCells", np.array([cells], dtype=np.int64))
            write_array(group, "NumberOfConnectivityIds", np.array([ids], dtype=np.int64))
            write_rows(group, "Offsets", cells + 1, offsets)
            write_rows(group, "Connectivity", ids, _counted(ids))
        data = vtk.create_group("PointData")
        for name, unit in units.items():
            data[name] = mark_active(write_rows(file, name, points.count, points.rows(name), unit), name)


def units_of(format_name: str, names: Container[str]) -> dict[str, str]:
    """Return the units of the arrays that a format has, and of those among the names that it may have besides."""
    return UNITS[format_name] | {name: unit for name, unit in OPTIONAL.get(format_name, {}).items() if name in names}


def read_points(path: Path | str, format_name: str) -> Points:
    """Read points.

    Raises
    ------
    InputError : the file is missing, broken, of another format, or holds values that are not finite
    """
    path = Path(path)
    with _opened(path, format_name) as (file, datasets):
        size = path.stat().st_size
        arrays = {name: hdf5.read_array(dataset, size) for name, dataset in datasets.items()}
        root = read_root(file)
    for name, array in arrays.items():
        _ensure_finite(path, name, array, len(array))
    position = arrays.pop(POSITION).astype(np.float64)
    return Points(position, arrays, root.reference, root.attributes, root.provenance)


@contextmanager
def _opened(path: Path, format_name: str) -> Iterator[tuple[h5py.File, dict[str, h5py.Dataset]]]:
    """Open a file of points; its arrays, positions first, have as many rows each."""
    with hdf5.open_h5(path, format_name, FORMAT_VERSION) as file:
        names = [POSITION, *units_of(format_name, file)]
        datasets = {name: hdf5.array_member(file, name) for name in names}
        shape = datasets[POSITION].shape
        if len(shape) != 2 or shape[1] != 3:
            raise InputError(f"{path}: its positions have the shape {shape}, expected (n, 3)")
        for name, dataset in datasets.items():
            if len(dataset) != shape[0]:
                raise InputError(NOT_ONE_VALUE.format(path, name, shape[0]))
        yield file, datasets


def _ensure_finite(path: Path, name: str, rows: NDArray[Any], count: int) -> None:
    """Raise where rows of an array of so many are not numbers, or not known where they must be."""
    known = rows[~np.isnan(rows)] if name in MAY_BE_UNKNOWN else rows
    if not np.isfinite(known).all():
        raise InputError(NOT_ONE_VALUE.format(path, name, count))


def open_particles(path: Path | str) -> Points:
    """Read the particles of a frame.

    Returns
    -------
    Points
        As `find_particles` gives them.

    Raises
    ------
    InputError
        The file is missing, broken, or of another format or version.
    """
    return read_points(path, PARTICLES_FORMAT)


def open_tracks(path: Path | str) -> Points:
    """Read the tracks of two frames or of a sequence.

    Returns
    -------
    Points
        As the `points` that `track` gives.

    Raises
    ------
    InputError
        The file is missing, broken, or of another format or version.
    """
    is_sequence = hdf5.format_of(Path(path)) == TRAJECTORIES_FORMAT
    return read_points(path, TRAJECTORIES_FORMAT if is_sequence else TRACKS_FORMAT)


def symmetric(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return symmetric matrices (n, 3, 3) as (n, 6): xx, yy, zz, xy, yz, xz."""
    return np.stack([matrices[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))], axis=1)


def matrices(symmetric_parts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return symmetric matrices (n, 3, 3) of what `symmetric` gives, (n, 6)."""
    return np.asarray(symmetric_parts[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2]]])


def lines_of(track: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where each track's rows begin, and where the last one's end."""
    return np.concatenate([[0], np.flatnonzero(np.diff(track)) + 1, [len(track)]]) if len(track) else np.zeros(1, int)


def _counted(count: int) -> Iterator[NDArray[np.int64]]:
    """Yield the numbers from 0 on, so many, in pieces; one at least."""
    for begin in range(0, max(count, 1), CHECKED_ROWS):
        yield np.arange(begin, min(begin + CHECKED_ROWS, count), dtype=np.int64)
