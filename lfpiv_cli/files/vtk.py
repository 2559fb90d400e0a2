"""What all `*.vtkhdf` files have in common: VTK's header, and what a file says about itself at its root."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import h5py
import numpy as np

from lfpiv_cli.files.hdf5 import RESERVED, from_attribute, to_attribute

# The version of VTK's layout that ParaView 5.12 reads and later ones still do.
VTK_VERSION = (2, 0)


def create_vtk_group(file: h5py.File, kind: Literal["ImageData", "PolyData"]) -> h5py.Group:
    """Return a new group `/VTKHDF` that names its version and kind."""
    vtk = file.create_group("VTKHDF")
    vtk.attrs["Version"] = np.array(VTK_VERSION, dtype=np.int64)
    # A string of fixed length: VTK up to 9.4.2 fails on a variable one.
    vtk.attrs["Type"] = np.bytes_(kind)
    return vtk


def write_attributes(file: h5py.File, attributes: Mapping[str, Any]) -> None:
    """Write scalars, strings and short numeric arrays at the root.

    What is None is not said, as netCDF knows no empty attribute.
    """
    for name, value in attributes.items():
        if name in RESERVED:
            raise ValueError(f"{name} is a name that every file uses for itself")
        if isinstance(value, np.ndarray):
            file.attrs[name] = value
        elif value is not None:
            file.attrs[name] = to_attribute(value)


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """Return what the root says besides format, version and provenance."""
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else from_attribute(name, value)
        for name, value in file.attrs.items()
        if name not in RESERVED
    }
