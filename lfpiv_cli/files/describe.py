"""What is in a file of ours, without its numbers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lfpiv_cli.files.hdf5 import RESERVED, format_of, from_attribute, open_h5, read_provenance
from lfpiv_cli.files.hdf5_checks import member
from lfpiv_cli.files.provenance import recorded_warnings

# Arrays that are told whole: places, sizes, a lattice's basis.
TOLD_SHAPES = ((2,), (3,), (2, 2))
# Groups that show our data to other programs once more.
VIEWS = ("VTKHDF",)


def describe(path: Path) -> dict[str, Any]:
    """Return format, version, how the file was made, and the scalars and the shapes of the arrays in it.

    Raises
    ------
    InputError : the file is missing, broken or not one of ours
    """
    file_format = format_of(path)
    with open_h5(path) as file:
        found: dict[str, Any] = {
            "file_bytes": path.stat().st_size,
            "format": file_format,
            "format_version": int(file.attrs["format_version"]),
        }
        found |= _made(read_provenance(file))
        _list_group(file, "", found)
    return found


def _made(record: dict[str, Any]) -> dict[str, Any]:
    """Return the short form of a provenance record."""
    inputs = [f"{role} {entry['name']}" for role, entry in record.get("inputs", {}).items()]
    made: dict[str, Any] = {
        "command": record.get("command"),
        "program_version": record.get("version"),
        "inputs": inputs,
    }
    warnings = recorded_warnings(record)
    if warnings:
        made["warnings_recorded"] = warnings
    weights = (record.get("config") or {}).get("weights")
    if weights:
        made |= {name: weights.get(name) for name in ("method", "refraction", "sampling")}
    return made


def _list_group(group: h5py.Group, prefix: str, found: dict[str, Any]) -> None:
    """Add the scalars and arrays of a group and of those in it."""
    for name, value in group.attrs.items():
        if (prefix or name not in RESERVED) and getattr(value, "ndim", 0) == 0 and name not in ("CLASS", "NAME"):
            scalar = from_attribute(name, value)
            if not isinstance(scalar, float) or math.isfinite(scalar):
                found[prefix + name] = scalar
    for name in group:
        if not prefix and name in VIEWS:
            continue
        item = member(group, name)
        if isinstance(item, h5py.Group):
            _list_group(item, f"{prefix}{name}/", found)
        elif item.shape in TOLD_SHAPES and np.isfinite(item[()]).all():
            found[prefix + name] = item[()].tolist()
        else:
            found[prefix + name] = f"{item.dtype} {list(item.shape)}"
