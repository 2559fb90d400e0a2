"""What all `*.vtkhdf` files have in common: VTK's header, and what a file says about itself at its root."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import h5py
import numpy as np

from lfpiv_cli.files.hdf5 import RESERVED, from_attribute, read_provenance, to_attribute, write_header
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
