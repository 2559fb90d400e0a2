"""Results in the formats of other programs: their content in one form, and how each format is written."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, OutputError
from lfpiv_cli.files import particle_file, vtkhdf
from lfpiv_cli.files.hdf5 import format_of, open_h5
from lfpiv_cli.files.particle_file import POSITION, TRAJECTORIES_FORMAT, Points
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT, VOLUME_FORMAT, Volume
from lfpiv_cli.flow.field import REJECTED, VectorField
from lfpiv_cli.grid import Grid

# What each format holds, as a person says it.
KINDS = {
    VOLUME_FORMAT: "a volume",
    VECTORS_FORMAT: "vectors",
    particle_file.PARTICLES_FORMAT: "particles",
    particle_file.TRACKS_FORMAT: "tracks of a pair",
    TRAJECTORIES_FORMAT: "tracks of a sequence",
}
ON_GRIDS = (VOLUME_FORMAT, VECTORS_FORMAT)
OF_POINTS = (particle_file.PARTICLES_FORMAT, particle_file.TRACKS_FORMAT, TRAJECTORIES_FORMAT)
# The last axis of an array, by its length: vectors, and symmetric tensors in VTK's order.
COMPONENTS = {3: ("x", "y", "z"), 6: ("xx", "yy", "zz", "xy", "yz", "xz")}
# What the components of these arrays are called; those of others have their name before them.
NAMES = {POSITION: ["x", "y", "z"], "velocity": ["u", "v", "w"]}
# What arrays hold whose names do not say it.
DESCRIPTIONS = {
    POSITION: "place",
    "intensity": "light",
    "covariance_mm2": "covariance of the place",
    "chi2": "residual squared over its variance, about 1 where all light is explained",
    "seen": "share of the light that meets the sensor",
    "displacement_mm": "displacement from the first frame to the second",
    "displacement_covariance_mm2": "covariance of the displacement",
    "particle_a": "row of the particle in the first frame",
    "particle_b": "row of the particle in the second frame",
    "particle": "row of the particle in its frame",
    "link_probability": "probability that the link is right",
    "displacement_voxel": "displacement between the volumes",
    "displacement_raw_voxel": "displacement before validation",
    "correlation": "normalised correlation at the peak",
    "peak_ratio": "highest peak over the second",
    "valid_fraction": "share of the window inside volumes and mask",
    "flag": vtkhdf.FLAG_MEANINGS,
    "uncertainty_voxel": "standard deviation of the displacement",
    **{f"gradient_{name}": f"gradient of {name} along x, y, z" for name in "uvw"},
    "samples": "vectors or tracks that the moments are of",
    "share_a": "weight of the first field",
    "disagreement": "how many standard errors the two fields are apart",
}
OUTSIDE = "1 outside the volume"


@dataclass(frozen=True, eq=False)
class Content:
    """The content of a file.

    Attributes
    ----------
    format_name : one of `KINDS`
    grid : of a volume and of vectors, None of points
    arrays : by name, (nz, ny, nx) or (n,), and with a last axis of components
    units : of the arrays
    attributes : what the file says about itself: scalars, strings and short lists
    provenance : the record of how it was made
    """

    format_name: str
    grid: Grid | None
    arrays: dict[str, NDArray[Any]]
    units: dict[str, str]
    attributes: dict[str, Any]
    provenance: dict[str, Any]

    def components(self, name: str) -> tuple[str, ...]:
        """Return what the components of an array are called; none where it has one value at each place."""
        array = self.arrays[name]
        if array.ndim == (1 if self.grid is None else 3):
            return ()
        return COMPONENTS.get(array.shape[-1], tuple(map(str, range(array.shape[-1]))))

    def descriptions(self) -> dict[str, str]:
        """Return what each array holds, for people."""
        other = {"flag": OUTSIDE} if self.format_name == particle_file.PARTICLES_FORMAT else {}
        return {name: (DESCRIPTIONS | other).get(name, name.replace("_", " ")) for name in self.arrays}

    def reported(self) -> dict[str, Any]:
        """Return what is told besides the arrays: the format, the attributes, and the provenance as JSON."""
        known = {name: value for name, value in self.attributes.items() if value is not None}
        return {"format": self.format_name, **known, "provenance": json.dumps(self.provenance)}

    def comments(self, units: Mapping[str, str]) -> Iterator[str]:
        """Yield the same as lines of comments, the provenance as JSON over as many as it needs; the units last."""
        for name, value in self.reported().items():
            if name != "provenance":
                yield f"# {name}: {json.dumps(value)}"
        yield "# provenance:"
        for line in json.dumps(self.provenance, indent=1).splitlines():
            yield f"# {line}"
        yield f"# units: {json.dumps(units)}"


def read_content(path: Path) -> Content:
    """Read a volume, vectors, particles or tracks."""
    name = format_of(path)
    if name not in KINDS:
        raise InputError(f"{path}: holds {name}, expected {', '.join(KINDS)}")
    if name == VOLUME_FORMAT:
        return content_of(vtkhdf.open_volume(path))
    if name == VECTORS_FORMAT:
        vtkhdf.open_vectors(path)  # for its checks
        found, _ = vtkhdf.read_extra(path)
        # All arrays, those that commands store besides, too; the velocity first, as it is what is asked for.
        arrays = dict(sorted(found.items(), key=lambda each: (each[0] != "velocity", each[0])))
        with open_h5(path) as file:
            grid, root = vtkhdf.grid_in(file), vtkhdf.read_root(file)
            units = {each: file[each].attrs["units"].decode() for each in arrays}
        return Content(name, grid, arrays, units, root.attributes, root.provenance)
    return content_of(particle_file.read_points(path, name))


def content_of(
    result: Volume | Points | VectorField,
    extra: Mapping[str, tuple[NDArray[Any], str]] = MappingProxyType({}),
    attributes: Mapping[str, Any] = MappingProxyType({}),
) -> Content:
    """Return what the file of a result holds; of vectors with arrays (units second) and attributes besides."""
    if isinstance(result, VectorField):
        both = vtkhdf.arrays_of(result) | dict(extra)
        arrays = {name: array for name, (array, _) in both.items()}
        units = {name: unit for name, (_, unit) in both.items()}
        said = result.reference.attributes() | vtkhdf.attributes_of(result) | dict(attributes)
        said = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in said.items()}
        return Content(VECTORS_FORMAT, result.grid, arrays, units, said, result.provenance)
    said = result.reference.attributes() | result.attributes
    if isinstance(result, Points):
        arrays = {POSITION: result.position_mm, **result.arrays}
        units = {POSITION: "mm", **particle_file.units_of(result.format_name, arrays)}
        return Content(result.format_name, None, arrays, units, said, result.provenance)
    return Content(VOLUME_FORMAT, result.grid, {"intensity": result.array}, {"intensity": "1"}, said, result.provenance)


def columns_of(content: Content) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return all as columns of one row for each place, coordinates before each component of each array; and the units.

    The velocity's are called u, v, w; x varies fastest on a grid, z slowest.
    """
    columns: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    if content.grid is not None:
        centres = content.grid.centres_mm().reshape(-1, 3)
        columns = {axis: centres[:, k] for k, axis in enumerate("xyz")}
        units = dict.fromkeys("xyz", "mm")
    for name, array in content.arrays.items():
        names = [name]
        if components := content.components(name):
            names = NAMES.get(name, [f"{name}_{suffix}" for suffix in components])
        columns |= dict(zip(names, array.reshape(-1, len(names)).T, strict=True))
        units |= dict.fromkeys(names, content.units[name])
    return columns, units


def frames_of(content: Content) -> list[NDArray[np.int64]]:
    """Return the rows of each frame of a sequence's tracks."""
    frame = content.arrays["frame"]
    return [np.flatnonzero(frame == number) for number in range(int(frame.max(initial=-1)) + 1)]


# NetCDF 3 with 64-bit offsets, which needs no library beyond scipy, here or where it is read.
#
# Vectors follow pivpy's schema: `u`, `v`, `w` (m/s) and `chc` (1 where the velocity is known) over y, x, t,
# coordinates in mm; with more than one plane z comes before these dimensions, so that one plane of it is what pivpy
# takes.

# The format counts the bytes of a variable in 32 bits.
LARGEST_VARIABLE = 2**32 - 4
SMALLEST_INTEGER, LARGEST_INTEGER = -(2**31), 2**31 - 1
# Signed, as NetCDF 3 has no others.
INTEGERS = {1: np.int16, 2: np.int32, 4: np.int32, 8: np.int32}
PIVPY_SCHEMA = "1"


def write_netcdf(path: Path, contents: Sequence[Content], times_s: Sequence[float] | None) -> None:
    """Write a volume, particles or tracks, or the vectors of one time or of several.

    Parameters
    ----------
    times_s : of each of several vectors, None where only their order is known

    Raises
    ------
    OutputError : an array is larger than the format allows
    """
    from scipy.io import netcdf_file

    first = contents[0]
    with netcdf_file(path, "w", version=2) as file:
        for name, value in first.reported().items():
            setattr(file, name, _attribute(value))
        if first.grid is None:
            file.createDimension("point", len(next(iter(first.arrays.values()))))
            _write_arrays(file, first.arrays.items(), first.units, ("point",))
            return
        of_vectors = first.format_name == VECTORS_FORMAT
        for k, axis in enumerate("xyz"):
            values = first.grid.axis_mm(k)
            if axis == "z" and len(values) == 1 and of_vectors:
                # A plane has its place as a scalar.
                _put(file, axis, values[0], (), "mm")
            else:
                file.createDimension(axis, len(values))
                _put(file, axis, values, (axis,), "mm")
        if not of_vectors:
            _write_arrays(file, first.arrays.items(), first.units, ("z", "y", "x"))
            return

        file.delta_t = _attribute(float(first.attributes.get("dt_s", 0.0)))
        file.pivpy_schema_version = PIVPY_SCHEMA
        file.createDimension("t", len(contents))
        _put(file, "t", np.arange(float(len(contents))) if times_s is None else np.asarray(times_s), ("t",))
        file.variables["t"].units = "frame" if times_s is None else "s"
        places = ("y", "x", "t") if first.grid.shape_xyz[2] == 1 else ("z", "y", "x", "t")

        def over_time(name: str) -> NDArray[Any]:
            stacked = np.stack([content.arrays[name] for content in contents], axis=3)
            return stacked if "z" in places else stacked[0]

        for k, name in enumerate("uvw"):
            _put(file, name, over_time("velocity")[..., k], places, "m/s")
            file.variables[name].standard_name = f"{name}_velocity"
        _put(file, "chc", (over_time("flag") < REJECTED).astype(np.uint8), places, "1")
        file.variables["chc"].standard_name = "validity_flag"
        others = ((name, over_time(name)) for name in first.arrays if name != "velocity")
        _write_arrays(file, others, first.units, places)


def _write_arrays(
    file: Any, arrays: Iterable[tuple[str, NDArray[Any]]], units: Mapping[str, str], places: tuple[str, ...]
) -> None:
    """Write arrays over dimensions that there are, and where they have components over a dimension of these."""
    for name, array in arrays:
        of_components: tuple[str, ...] = ()
        for count in array.shape[len(places) :]:
            of_components = ("component" if count == len(COMPONENTS[3]) else f"component_{count}",)
            if of_components[0] not in file.dimensions:
                file.createDimension(of_components[0], count)
        _put(file, name, array, places + of_components, units[name])


def _put(file: Any, name: str, array: NDArray[Any], dimensions: tuple[str, ...], unit: str | None = None) -> None:
    if array.nbytes > LARGEST_VARIABLE:
        raise OutputError(f"{name} has {array.nbytes} bytes, a variable of NetCDF 3 holds {LARGEST_VARIABLE}")
    stored = _integers(name, array) if array.dtype.kind in "iu" else array
    variable = file.createVariable(name, stored.dtype, dimensions)
    variable.data[...] = stored
    if unit is not None:
        variable.units = unit


def _integers(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return integers in a type that the format has."""
    if array.size and not SMALLEST_INTEGER <= int(array.min()) <= int(array.max()) <= LARGEST_INTEGER:
        raise InputError(f"{name} holds {array.max()}, NetCDF 3 knows integers up to {LARGEST_INTEGER}")
    return array.astype(INTEGERS[array.dtype.itemsize])


def _attribute(value: Any) -> Any:
    """Return an attribute in a type that the format has; scipy would store a plain float in 32 bits."""
    if isinstance(value, str):
        return value.encode()
    array = np.asarray(value)
    return _integers("an attribute", array.astype(np.int64)).ravel() if array.dtype.kind in "biu" else array.ravel()


# Matlab's MAT files, version 5: a variable for each array and for what the file says about itself; the structure
# `units` has the unit of each array.
#
# Tracks of a sequence come a second time as the list `tracks` of records, one for each track, which flowtracks reads:
# places `xf`, `yf`, `zf` (mm), velocities `uf`, `vf`, `wf` (mm/s), accelerations `axf`, `ayf`, `azf` (NaN, as they
# are not measured), frames `t` and the track's number `trajid`.

# The format counts the bytes of a variable in 32 bits, of which readers take 31.
LARGEST_BYTES = 2**31 - 1
# The first bytes of a file are words, in which scipy writes the time: the same work gives the same bytes.
WORDS = b"MATLAB 5.0 MAT-file, written by lfpiv".ljust(116)
MM_PER_M = 1000.0
FIELDS = ("xf", "yf", "zf", "uf", "vf", "wf", "axf", "ayf", "azf", "t", "trajid")


def write_mat(path: Path, content: Content) -> None:
    """Write everything under the names that it has; arrays on a grid are [z, y, x] and the component last.

    Raises
    ------
    OutputError : an array is larger than the format allows
    """
    from scipy.io import savemat

    for name, array in content.arrays.items():
        if array.nbytes > LARGEST_BYTES:
            raise OutputError(f"{name} has {array.nbytes} bytes, MAT files hold {LARGEST_BYTES}; netcdf holds more")
    variables: dict[str, Any] = {}
    if content.format_name == TRAJECTORIES_FORMAT:
        # First: flowtracks takes the first variable of a file.
        variables["tracks"] = _tracks(content)
    if content.grid is not None:
        variables |= {axis: content.grid.axis_mm(k) for k, axis in enumerate("xyz")}
    variables |= content.arrays | content.reported() | {"units": content.units}
    savemat(path, variables, appendmat=False, format="5", long_field_names=True, oned_as="column")
    with open(path, "rb+") as file:
        file.write(WORDS)


def _tracks(content: Content) -> NDArray[np.void]:
    """Return the tracks of a sequence as a column of records."""
    track, arrays = content.arrays["track"], content.arrays
    ends = np.flatnonzero(np.diff(track)) + 1
    rows = np.split(np.arange(len(track)), ends) if len(track) else []
    records = np.empty((len(rows), 1), dtype=[(name, object) for name in FIELDS])
    unknown = np.full(len(track), np.nan)
    columns = [*arrays[POSITION].T, *(MM_PER_M * arrays["velocity"]).T, unknown, unknown, unknown, arrays["frame"]]
    for number, here in enumerate(rows):
        parts = [column[here][:, np.newaxis] for column in columns]
        records[number, 0] = (*parts, np.array([[track[here[0]]]]))
    return records


# Tables of text: CSV, and Tecplot's ASCII format. Numbers have as many digits as bring back the same bits.


def write_csv(path: Path, content: Content) -> None:
    """Write one row for each place below the columns' names; lines of comments before them begin with #."""
    columns, units = columns_of(content)
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in content.comments(units))
        file.write(",".join(columns) + "\n")
        file.writelines(",".join(row) + "\n" for row in _rows(columns))


def write_tecplot(path: Path, content: Content) -> None:
    """Write an ordered zone on a grid, one of points, or of a sequence's tracks one for each frame with its time.

    Names of variables have no units, by which readers would not know coordinates as such: comments have them.
    """
    columns, units = columns_of(content)
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in content.comments(units))
        file.write(f'TITLE = "{KINDS[content.format_name]}"\n')
        file.write("VARIABLES = " + " ".join(f'"{name}"' for name in columns) + "\n")
        kind = KINDS[content.format_name]
        if content.grid is not None:
            nx, ny, nz = content.grid.shape_xyz
            zones: list[tuple[str, Any]] = [(f'T="{kind}", I={nx}, J={ny}, K={nz}', slice(None))]
        elif content.format_name == TRAJECTORIES_FORMAT:
            dt_s = float(content.attributes["dt_s"])
            zones = [
                (f'T="frame {k}", STRANDID=1, SOLUTIONTIME={k * dt_s!r}, I={rows.size}, J=1, K=1', rows)
                for k, rows in enumerate(frames_of(content))
                if rows.size
            ]
        else:
            zones = [(f'T="{kind}", I={len(content.arrays[POSITION])}, J=1, K=1', slice(None))]
        for head, rows in zones:
            file.write(f"ZONE {head}, DATAPACKING=POINT\nDT=({'DOUBLE ' * len(columns)})\n")
            here = {name: column[rows] for name, column in columns.items()}
            file.writelines(" ".join(row) + "\n" for row in _rows(here))


def _rows(columns: dict[str, NDArray[np.generic]]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of columns as text."""
    return zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True)
