"""What all `*.vtkhdf` files have in common: VTK's header, and what a file says about itself at its root."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.hdf5 import RESERVED, from_attribute, read_provenance, to_attribute, write_array, write_header
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import Reference

# The version of VTK's layout that ParaView 5.12 reads and later ones still do.
VTK_VERSION = (2, 0)


@dataclass(frozen=True, eq=False)
class Header:
    """What a file says about itself besides its arrays: its coordinates' origin, attributes at the root, provenance."""

    reference: Reference
    attributes: dict[str, Any]
    provenance: dict[str, Any]


def create_vtk_group(file: h5py.File, kind: Literal["ImageData", "PolyData"]) -> h5py.Group:
    """Return a new group `/VTKHDF` that names its version and kind."""
    vtk = file.create_group("VTKHDF")
    vtk.attrs["Version"] = np.array(VTK_VERSION, dtype=np.int64)
    # A string of fixed length: VTK up to 9.4.2 fails on a variable one.
    vtk.attrs["Type"] = np.bytes_(kind)
    return vtk


def place_image(vtk: h5py.Group, grid: Grid) -> None:
    """Say where the points of an ImageData lie."""
    nx, ny, nz = grid.shape_xyz
    vtk.attrs["WholeExtent"] = np.array([0, nx - 1, 0, ny - 1, 0, nz - 1], dtype=np.int64)
    vtk.attrs["Origin"] = np.array(grid.origin_mm, dtype=np.float64)
    vtk.attrs["Spacing"] = np.array(grid.spacing_mm, dtype=np.float64)
    vtk.attrs["Direction"] = np.eye(3).ravel()


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
    write_header(file, format_name, format_version, provenance)
    for name, value in (reference.attributes() | dict(attributes)).items():
        if name in RESERVED:
            raise ValueError(f"{name} is a name that every file uses for itself")
        if isinstance(value, np.ndarray):
            file.attrs[name] = value
        elif value is not None:
            file.attrs[name] = to_attribute(value)


def read_root(file: h5py.File) -> Header:
    """Return what a file says about itself, besides format and version.

    Raises
    ------
    KeyError, ValueError : it does not say where its coordinates begin, or how it was made
    """
    attributes = {
        name: value.tolist() if isinstance(value, np.ndarray) else from_attribute(name, value)
        for name, value in file.attrs.items()
        if name not in RESERVED
    }
    return Header(Reference.from_attributes(attributes), attributes, read_provenance(file))
