"""Volumes and vector fields as `*.vtkhdf`: HDF5 that ParaView and xarray open as it is, with one copy of the data.

Layout: the arrays and the netCDF dimension scales `z`, `y`, `x`, `component` lie at the root, and `/VTKHDF/PointData`
holds hard links to the arrays. Arrays are `[z, y, x]` (and the component last), except that a single plane is `[y, x]`:
VTK reads the extent of nz = 1 so. `Origin` is the centre of the first cell, mm; origin and spacing are ordered x, y, z.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files import hdf5
from lfpiv_cli.files.hdf5 import RESERVED, created, open_h5, write_array
from lfpiv_cli.flow.field import REJECTED, VectorField
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.results import ArrayResult

# What all `*.vtkhdf` files have in common: VTK's header, and what a file says about itself at its root.

# The version of VTK's layout that ParaView 5.12 reads and later ones still do.
VTK_VERSION = (2, 0)
# Arrays that VTK's filters take where none is asked for, as what.
ACTIVE = {"velocity": "Vectors", "intensity": "Scalars"}


@dataclass(frozen=True, eq=False)
class Header:
    """What a file says about itself besides its arrays: its coordinates' origin, attributes at the root, provenance."""

    reference: Reference
    attributes: dict[str, Any]
    provenance: dict[str, Any]


def create_vtk_group(file: h5py.File, grid: Grid | None) -> h5py.Group:
    """Return a new group `/VTKHDF` that names its version and kind: an image on a grid, or points."""
    vtk = file.create_group("VTKHDF")
    vtk.attrs["Version"] = np.array(VTK_VERSION, dtype=np.int64)
    # A string of fixed length: VTK up to 9.4.2 fails on a variable one.
    vtk.attrs["Type"] = np.bytes_("PolyData" if grid is None else "ImageData")
    if grid is not None:
        nx, ny, nz = grid.shape_xyz
        vtk.attrs["WholeExtent"] = np.array([0, nx - 1, 0, ny - 1, 0, nz - 1], dtype=np.int64)
        vtk.attrs["Origin"] = np.array(grid.origin_mm, dtype=np.float64)
        vtk.attrs["Spacing"] = np.array(grid.spacing_mm, dtype=np.float64)
        vtk.attrs["Direction"] = np.eye(3).ravel()
    return vtk


def mark_active(dataset: h5py.Dataset, name: str) -> h5py.Dataset:
    """Return a point array, marked where it is one that VTK's filters take when none is asked for."""
    if name in ACTIVE:
        dataset.attrs["Attribute"] = np.bytes_(ACTIVE[name])
    return dataset


def write_steps(
    vtk: h5py.Group, times: Sequence[float], unit: str, begins: Mapping[str, NDArray[np.int64]]
) -> h5py.Group:
    """Write the steps of what changes in time, and where the rows of each point array begin in each; return them."""
    steps = vtk.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(len(times))
    write_array(steps, "Values", np.asarray(times, dtype=np.float64), unit)
    offsets = steps.create_group("PointDataOffsets")
    for name, of_steps in begins.items():
        write_array(offsets, name, of_steps)
    return steps


def write_root(
    file: h5py.File,
    format_name: str,
    format_version: int,
    reference: Reference,
    attributes: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> None:
    """Write what a file says about itself; its attributes are scalars, strings and short numeric arrays.

    What is None is not said, as netCDF knows no empty attribute.
    """
    hdf5.write_header(file, format_name, format_version, provenance)
    for name, value in (reference.attributes() | dict(attributes)).items():
        if name in RESERVED:
            raise ValueError(f"{name} is a name that every file uses for itself")
        if isinstance(value, (np.ndarray, list)):
            file.attrs[name] = np.asarray(value)
        elif value is not None:
            file.attrs[name] = hdf5.to_attribute(value)


def read_root(file: h5py.File) -> Header:
    """Return what a file says about itself, besides format and version.

    Raises
    ------
    KeyError, ValueError : it does not say where its coordinates begin, or how it was made
    """
    attributes = {
        name: value.tolist() if isinstance(value, np.ndarray) else hdf5.from_attribute(name, value)
        for name, value in file.attrs.items()
        if name not in RESERVED
    }
    return Header(Reference.from_attributes(attributes), attributes, hdf5.read_provenance(file))


VOLUME_FORMAT = "lfpiv-volume"
VECTORS_FORMAT = "lfpiv-vectors"
FORMAT_VERSION = 1

# Arrays of a vector field: name on disk, unit, and whether it has three components. `velocity` follows from the rest.
VECTOR_ARRAYS = {
    "displacement_voxel": ("voxel", True),
    "displacement_raw_voxel": ("voxel", True),
    "correlation": ("1", False),
    "peak_ratio": ("1", False),
    "valid_fraction": ("1", False),
    "flag": ("1", False),
}
UNCERTAINTY = "uncertainty_voxel"
FLAG_MEANINGS = "0 valid, 1 replaced, 2 second peak, 3 rejected and not replaced, 4 masked"
LARGEST_FLAG = 4


@dataclass(frozen=True, eq=False, repr=False)
class Volume(ArrayResult):
    """A volume with its place in the world.

    Attributes
    ----------
    array : (nz, ny, nx) float32
    grid : spacing and origin, mm, z from the reference
    reference : the origin of its coordinates
    attributes : what the file says about itself, the reference among it
    provenance : the record of how it was made
    """

    array: NDArray[np.float32]
    grid: Grid
    reference: Reference
    attributes: dict[str, Any]
    provenance: dict[str, Any]


def write_volume(
    path: Path,
    array_zyx: NDArray[np.floating[Any]],
    grid: Grid,
    reference: Reference,
    *,
    provenance: Mapping[str, Any],
    attributes: Mapping[str, Any],
    overwrite: bool,
) -> None:
    """Write a volume as the scalar `intensity`.

    Parameters
    ----------
    array_zyx : (nz, ny, nx), stored as float32
    reference : the origin that the grid's z counts from
    attributes : scalars, strings and short arrays for the root
    """
    if array_zyx.shape != grid.shape_zyx:
        raise ValueError(f"the array's shape is {array_zyx.shape}, the grid's {grid.shape_zyx}")
    with created(path, overwrite=overwrite, check=open_volume) as file:
        write_root(file, VOLUME_FORMAT, FORMAT_VERSION, reference, attributes, provenance)
        _write_on_grid(file, grid, {"intensity": (array_zyx.astype(np.float32), "1")})


def open_volume(path: Path | str) -> Volume:
    """Read a volume.

    Raises
    ------
    InputError : the file is missing, broken, not a volume, or holds values that are not finite
    """
    path = Path(path)
    with open_h5(path, VOLUME_FORMAT, FORMAT_VERSION) as file:
        grid = grid_in(file)
        array = read_on_grid(path, file, grid, {"intensity": False})["intensity"]
        root = read_root(file)
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise InputError(f"{path}: {bad} voxels are not finite numbers")
    return Volume(array.astype(np.float32, copy=False), grid, root.reference, root.attributes, root.provenance)


def write_vectors(
    path: Path,
    field: VectorField,
    reference: Reference,
    *,
    provenance: Mapping[str, Any],
    overwrite: bool,
    extra: Mapping[str, tuple[NDArray[Any], str]] | None = None,
    attributes: Mapping[str, Any] | None = None,
    tables: Mapping[str, Mapping[str, tuple[NDArray[Any], str]]] | None = None,
) -> None:
    """Write a vector field: `velocity` (m/s), the displacements (voxel) and what is known of their quality.

    Parameters
    ----------
    reference : the origin that the grid's z counts from
    extra : arrays (nz, ny, nx) or (nz, ny, nx, 3) to store besides, by their name, with their unit
    attributes : scalars, strings and short arrays for the root
    tables : arrays of other shapes, by the name of their group and their own, with their unit
    """
    with created(path, overwrite=overwrite, check=open_vectors) as file:
        said = attributes_of(field) | dict(attributes or {})
        write_root(file, VECTORS_FORMAT, FORMAT_VERSION, reference, said, provenance)
        _write_on_grid(file, field.grid, arrays_of(field) | dict(extra or {}))
        for table, columns in (tables or {}).items():
            group = file.create_group(table)
            for name, (array, unit) in columns.items():
                write_array(group, name, array, unit)


def attributes_of(field: VectorField) -> dict[str, Any]:
    """Return what a file of vectors says of itself, besides the origin of its coordinates."""
    return {
        "voxel_mm": np.asarray(field.voxel_mm, dtype=np.float64),
        "window_voxel": np.asarray(field.window_voxel, dtype=np.int64),
        "flag_meanings": FLAG_MEANINGS,
        "dt_s": None if field.dt_s is None else float(field.dt_s),
    }


def arrays_of(field: VectorField) -> dict[str, tuple[NDArray[Any], str]]:
    """Return the arrays of a file of vectors by name, with their units."""
    arrays: dict[str, tuple[NDArray[Any], str]] = {"velocity": (field.velocity, "m/s")}
    arrays |= {name: (getattr(field, name), unit) for name, (unit, _) in VECTOR_ARRAYS.items()}
    if field.uncertainty_voxel is not None:
        arrays[UNCERTAINTY] = (field.uncertainty_voxel, "voxel")
    return arrays


def open_vectors(path: Path | str) -> VectorField:
    """Read a vector field.

    Raises
    ------
    InputError : the file is missing, broken, not a vector field, or a vector counts as valid and is not finite
    """
    path = Path(path)
    with open_h5(path, VECTORS_FORMAT, FORMAT_VERSION) as file:
        grid = grid_in(file)
        components = {name: vector for name, (_, vector) in VECTOR_ARRAYS.items()}
        arrays = read_on_grid(path, file, grid, components | ({UNCERTAINTY: True} if UNCERTAINTY in file else {}))
        voxel = [float(v) for v in file.attrs["voxel_mm"]]
        window = [int(v) for v in file.attrs["window_voxel"]]
        dt_s = float(file.attrs["dt_s"]) if "dt_s" in file.attrs else None
        root = read_root(file)
    uncertainty = arrays.pop(UNCERTAINTY, None)
    if arrays["flag"].max() > LARGEST_FLAG:
        raise InputError(f"{path}: a flag is {arrays['flag'].max()}, allowed are 0 to {LARGEST_FLAG}")
    field = VectorField(
        grid=grid,
        voxel_mm=(voxel[0], voxel[1], voxel[2]),
        dt_s=dt_s,
        window_voxel=(window[0], window[1], window[2]),
        uncertainty_voxel=uncertainty,
        reference=root.reference,
        provenance=root.provenance,
        **arrays,
    )
    if not np.isfinite(field.displacement_voxel[field.flag < REJECTED]).all():
        raise InputError(f"{path}: a vector that counts as valid is not a finite number")
    return field


def read_extra(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, dict[str, NDArray[Any]]]]:
    """Read all arrays of vectors on the grid, three axes and components, and those of other shapes by their groups."""
    with open_h5(path, VECTORS_FORMAT, FORMAT_VERSION) as file:
        size, grid = path.stat().st_size, grid_in(file)
        places = 2 if grid.shape_zyx[0] == 1 else 3
        names = list(hdf5.member(hdf5.member(file, "VTKHDF"), "PointData"))
        arrays = read_on_grid(path, file, grid, {name: hdf5.array_member(file, name).ndim > places for name in names})
        groups = [name for name in file if name != "VTKHDF" and isinstance(hdf5.member(file, name), h5py.Group)]
        tables = {
            name: {each: hdf5.read_array(hdf5.array_member(file[name], each), size) for each in file[name]}
            for name in groups
        }
    return arrays, tables


def read_header(path: Path | str) -> Header:
    """Read what a volume, a vector field or points say about themselves."""
    with open_h5(Path(path)) as file:
        return read_root(file)


def _write_on_grid(file: h5py.File, grid: Grid, arrays: Mapping[str, tuple[NDArray[Any], str]]) -> None:
    """Write arrays with their units and dimension scales at the root, and link them under `/VTKHDF/PointData`."""
    for axis, name in enumerate("xyz"):
        write_array(file, name, grid.axis_mm(axis), "mm").make_scale(name)
    if "velocity" in arrays:
        write_array(file, "component", np.arange(3), "1").make_scale("component")
    points = create_vtk_group(file, grid).create_group("PointData")
    for name, (array, unit) in arrays.items():
        axes = ["z", "y", "x"] + ["component"] * (array.ndim - 3)
        if array.shape[0] == 1:
            array, axes = array[0], axes[1:]
        dataset = write_array(file, name, array, unit)
        for position, axis_name in enumerate(axes):
            dataset.dims[position].attach_scale(file[axis_name])
        points[name] = mark_active(dataset, name)


def grid_in(file: h5py.File) -> Grid:
    """Return the grid of an open file."""
    vtk = hdf5.member(file, "VTKHDF").attrs
    extent = [int(v) for v in vtk["WholeExtent"]]
    spacing = [float(v) for v in vtk["Spacing"]]
    origin = [float(v) for v in vtk["Origin"]]
    if len(extent) != 6 or len(spacing) != 3 or len(origin) != 3:
        raise ValueError("its extent, spacing or origin has not one entry for each axis")
    if extent[0::2] != [0, 0, 0] or min(extent) < 0:
        raise ValueError(f"its extent is {extent}, expected one that starts at 0")
    if not (np.isfinite(spacing).all() and min(spacing) > 0 and np.isfinite(origin).all()):
        raise ValueError(f"its spacing is {spacing} and its origin {origin}")
    return Grid(
        (extent[1] + 1, extent[3] + 1, extent[5] + 1),
        (spacing[0], spacing[1], spacing[2]),
        (origin[0], origin[1], origin[2]),
    )


def read_on_grid(path: Path, file: h5py.File, grid: Grid, components: Mapping[str, bool]) -> dict[str, NDArray[Any]]:
    """Read arrays of the grid's shape, with components or without, the third axis put back on a single plane."""
    found = {}
    for name, with_components in components.items():
        shape = grid.shape_zyx + ((3,) if with_components else ())
        stored = shape[1:] if shape[0] == 1 else shape
        dataset = hdf5.array_member(file, name)
        if dataset.shape != stored:
            raise ValueError(f"{name} has the shape {dataset.shape}, its extent says {stored}")
        found[name] = hdf5.read_array(dataset, path.stat().st_size).reshape(shape)
    return found
