"""NetCDF 3 with 64-bit offsets, which needs no library beyond scipy, here or where it is read.

Vectors follow pivpy's schema: `u`, `v`, `w` (m/s) and `chc` (1 where the velocity is known) over y, x, t, coordinates
in mm; with more than one plane z comes before these dimensions, so that one plane of it is what pivpy takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, OutputError
from lfpiv_cli.files.exports.content import COMPONENTS, Content
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT
from lfpiv_cli.flow.field import REJECTED

# The format counts the bytes of a variable in 32 bits.
LARGEST_BYTES = 2**32 - 4
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

    with netcdf_file(path, "w", version=2) as file:
        for name, value in contents[0].told().items():
            setattr(file, name, _attribute(value))
        if contents[0].format_name == VECTORS_FORMAT:
            _write_vectors(file, contents, times_s)
        elif contents[0].grid is not None:
            _write_axes(file, contents[0])
            _write_arrays(file, contents[0], ("z", "y", "x"))
        else:
            file.createDimension("point", len(next(iter(contents[0].arrays.values()))))
            _write_arrays(file, contents[0], ("point",))


def _write_vectors(file: Any, contents: Sequence[Content], times_s: Sequence[float] | None) -> None:
    first = contents[0]
    _write_axes(file, first)
    file.delta_t = _attribute(float(first.attributes.get("dt_s", 0.0)))
    file.pivpy_schema_version = PIVPY_SCHEMA
    file.createDimension("t", len(contents))
    _put(file, "t", np.arange(float(len(contents))) if times_s is None else np.asarray(times_s), ("t",))
    file.variables["t"].units = "frame" if times_s is None else "s"
    places = ("y", "x", "t") if first.arrays["flag"].shape[0] == 1 else ("z", "y", "x", "t")

    def over_time(name: str) -> NDArray[Any]:
        stacked = np.stack([content.arrays[name] for content in contents], axis=3)
        return stacked[0] if "z" not in places else stacked

    for k, name in enumerate("uvw"):
        _put(file, name, over_time("velocity")[..., k], places, "m/s")
        file.variables[name].standard_name = f"{name}_velocity"
    _put(file, "chc", (over_time("flag") < REJECTED).astype(np.uint8), places, "1")
    file.variables["chc"].standard_name = "validity_flag"
    for name in first.arrays:
        if name != "velocity":
            stacked = over_time(name)
            of_components = _component_dimension(file, stacked.shape[len(places) :])
            _put(file, name, stacked, places + of_components, first.units[name])


def _write_axes(file: Any, content: Content) -> None:
    if content.grid is None:
        raise ValueError("points have no axes")
    for k, axis in enumerate("xyz"):
        values = content.grid.axis_mm(k)
        if axis == "z" and len(values) == 1 and content.format_name == VECTORS_FORMAT:
            # A plane has its place as a scalar.
            _put(file, axis, values[0], (), "mm")
        else:
            file.createDimension(axis, len(values))
            _put(file, axis, values, (axis,), "mm")


def _write_arrays(file: Any, content: Content, places: tuple[str, ...]) -> None:
    for name, array in content.arrays.items():
        dimensions = places + _component_dimension(file, array.shape[len(places) :])
        _put(file, name, array, dimensions, content.units[name])


def _component_dimension(file: Any, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return the dimension of an array's components, none where it has none."""
    if not shape:
        return ()
    name = "component" if shape[0] == len(COMPONENTS[3]) else f"component_{shape[0]}"
    if name not in file.dimensions:
        file.createDimension(name, shape[0])
    return (name,)


def _put(file: Any, name: str, array: NDArray[Any], dimensions: tuple[str, ...], unit: str | None = None) -> None:
    if array.nbytes > LARGEST_BYTES:
        raise OutputError(f"{name} has {array.nbytes} bytes, a variable of NetCDF 3 holds {LARGEST_BYTES}")
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
