"""HDF5, written so that a full disk raises and read so that a broken or hostile file does no harm.

A tree is a nested dict of numpy arrays, scalars, strings and None: dicts are groups, arrays datasets (each with
its unit, the attribute `units`), all else attributes. The root says `format`, `format_version` and `provenance` (JSON).

Here and in the modules of each format what reads a file raises `InputError` where it is missing, broken, of another
format or version, or leads outside itself; what writes one raises as `atomic.write_atomically` does.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, LfpivError, OutputError
from lfpiv_cli.files.atomic import write_atomically
from lfpiv_cli.files.hdf5_checks import DEEPEST, DIGEST, ensure_array, ensure_ours, member, write_digest
from lfpiv_cli.files.inputs import ensure_regular_file, physical_memory, reason

Tree = Mapping[str, Any]

# Root attributes that a tree cannot use for itself.
RESERVED = ("format", "format_version", "provenance", DIGEST)
# With the chunk cache on, a full disk kills the process with SIGSEGV; without it the write raises.
CHUNK_CACHE_BYTES = 0
# The 1.10 format has checksums on all metadata, so that a flipped bit there is noticed too.
LIBRARY_VERSIONS = ("v110", "v110")
# Filters that every reader of HDF5 has; without fletcher32 a flipped bit is read as data without a word.
FILTERS = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
# A chunk of 1 MiB is read in one piece and compresses as well as a larger one.
CHUNK_BYTES = 2**20
# The units of arrays whose names end so; longer ends come before those that end them.
UNITS_IN_NAMES = {"_per_mm2": "1/mm^2", "_mm2": "mm^2", "_mm": "mm", "_px": "pixel", "_deg": "degree"}
# What h5py raises on a broken file, depending on where it breaks.
BROKEN_FILE_ERRORS = (OSError, KeyError, ValueError, TypeError, RuntimeError, OverflowError, AttributeError)


def write_tree(
    path: Path,
    tree: Tree,
    *,
    format_name: str,
    format_version: int,
    provenance: Mapping[str, Any],
    overwrite: bool,
    units: Mapping[str, str] | None = None,
) -> None:
    """Write a tree with its format, version and provenance.

    Parameters
    ----------
    tree : nested dict of arrays (float, int, uint8), scalars, strings and None
    units : of arrays by their names, where these do not say them (`UNITS_IN_NAMES`); 1 of pure numbers
    """

    def fill(file: h5py.File) -> None:
        write_header(file, format_name, format_version, provenance)
        _write_group(file, tree, units or {})

    def check(temporary: Path) -> None:
        read_tree(temporary, format_name, (format_version,))

    create(path, fill, overwrite=overwrite, check=check)


def read_tree(path: Path, format_name: str, format_versions: Collection[int]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a file that `write_tree` wrote: the tree and its provenance.

    Raises
    ------
    InputError : the file is missing, broken, of another format or version, or leads outside itself
    """
    with open_h5(path) as file:
        ensure_format(path, file, format_name, format_versions)
        provenance = read_provenance(file)
        tree = _read_group(file, path.stat().st_size, DEEPEST)
    for name in RESERVED:
        tree.pop(name, None)
    return tree, provenance


def create(
    path: Path, fill: Callable[[h5py.File], None], *, overwrite: bool, check: Callable[[Path], object] | None = None
) -> None:
    """Create an HDF5 file atomically; `fill` writes into it, `check` reads it back: by default its format."""

    def write(temporary: Path) -> None:
        try:
            with h5py.File(temporary, "w", libver=LIBRARY_VERSIONS, rdcc_nbytes=CHUNK_CACHE_BYTES) as file:
                fill(file)
                write_digest(file)
        except RuntimeError as error:  # h5py's word for a write that fails on closing
            raise OutputError(f"{path}: cannot be written: {reason(error)}") from error

    write_atomically(path, write, overwrite=overwrite, check=check or format_of)


def write_array(group: h5py.Group, name: str, array: NDArray[Any], units: str | None = None) -> h5py.Dataset:
    """Write a numeric array with checksums; an array without elements has nothing to check."""
    array = np.ascontiguousarray(array)
    dataset = group.create_dataset(name, data=array, track_times=False, **_storage(name, array.shape, array.dtype))
    if units is not None:
        dataset.attrs["units"] = np.bytes_(units)
    return dataset


def write_rows(
    group: h5py.Group, name: str, count: int, pieces: Iterable[NDArray[Any]], units: str | None = None
) -> h5py.Dataset:
    """Write as `write_array` does an array of so many rows that comes in pieces of them, one at least."""
    pieces = iter(pieces)
    held = next(pieces)
    shape, dtype = (count, *held.shape[1:]), held.dtype
    dataset = group.create_dataset(name, shape, dtype, track_times=False, **_storage(name, shape, dtype))
    done = 0
    # Chunks are written whole: without a cache each part of one would be unpacked and packed again.
    for piece in chain(pieces, [held[:0]]):
        whole = len(held) if done + len(held) == count else len(held) // dataset.chunks[0] * dataset.chunks[0]
        if whole:
            dataset[done : done + whole] = held[:whole]
        done += whole
        held = np.concatenate([held[whole:], piece]) if whole < len(held) else piece
    if units is not None:
        dataset.attrs["units"] = np.bytes_(units)
    return dataset


def _storage(name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> dict[str, Any]:
    """Return how an array is stored: in chunks of whole rows and planes below `CHUNK_BYTES`, where it has elements."""
    if dtype.kind not in "fiu":
        raise TypeError(f"{name}: arrays are floating point or integer, not {dtype}")
    if not shape or 0 in shape:
        return {}
    left, chunk = max(CHUNK_BYTES // dtype.itemsize, 1), []
    for n in reversed(shape):
        chunk.append(max(min(n, left), 1))
        left //= chunk[-1]
    return {"chunks": tuple(reversed(chunk)), **FILTERS}


def read_array(dataset: h5py.Dataset, file_bytes: int) -> NDArray[Any]:
    """Read a numeric array whose bytes lie in this very file, all of them.

    Parameters
    ----------
    file_bytes : size of the file, the bound on what may be declared

    Raises
    ------
    OutputError : an array that the file does hold does not fit into memory
    """
    ensure_array(dataset.name, dataset.id, file_bytes, physical_memory())
    try:
        return dataset[()]
    except MemoryError as error:
        size_gb = dataset.size * dataset.dtype.itemsize / 1e9
        raise OutputError(
            f"too little memory: {dataset.name} of {dataset.file.filename} needs {size_gb:.2f} GB"
        ) from error


@contextmanager
def open_h5(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; what fails inside, but for want of memory, is an `InputError` of it."""
    ensure_regular_file(path)
    try:
        with h5py.File(path, "r", locking="best-effort") as file:
            if "format" in file.attrs:
                try:
                    ensure_ours(file, path.stat().st_size)
                except MemoryError as error:  # something says a size there that it cannot have
                    raise ValueError(reason(error)) from error
            yield file
    except LfpivError:
        raise
    except BROKEN_FILE_ERRORS as error:
        raise InputError(f"{path}: not a readable HDF5 file of ours: {reason(error)}") from error


def format_of(path: Path) -> str:
    """Return the name of a file's format."""
    with open_h5(path) as file:
        found = file.attrs.get("format")
        if not isinstance(found, bytes):
            raise InputError(f"{path}: says no format of ours")
        return found.decode()


def ensure_format(path: Path, file: h5py.File, format_name: str, format_versions: Collection[int]) -> None:
    """Check the root's `format` and `format_version`."""
    found = file.attrs.get("format")
    if not isinstance(found, bytes) or found.decode() != format_name:
        name = found.decode("utf-8", "replace") if isinstance(found, bytes) else "no format of ours"
        raise InputError(f"{path}: holds {name}, expected {format_name}")
    version = from_attribute("format_version", file.attrs["format_version"])
    if version not in format_versions:
        known = ", ".join(str(v) for v in sorted(format_versions))
        remedy = "; make it again with this program" if version < min(format_versions) else ""
        raise InputError(f"{path}: has {format_name} version {version}, this program reads {known}{remedy}")


def write_header(file: h5py.File, format_name: str, format_version: int, provenance: Mapping[str, Any]) -> None:
    """Write what every file says at its root: format, version, and the provenance record as JSON."""
    file.attrs["format"] = np.bytes_(format_name)
    file.attrs["format_version"] = np.int64(format_version)
    file.attrs["provenance"] = np.bytes_(json.dumps(provenance, allow_nan=False))


def replace_provenance(path: Path, provenance: Mapping[str, Any]) -> None:
    """Give a file another record, its data as they are."""

    def write(temporary: Path) -> None:
        shutil.copyfile(path, temporary)
        with h5py.File(temporary, "r+", libver=LIBRARY_VERSIONS) as file:
            file.attrs["provenance"] = np.bytes_(json.dumps(provenance, allow_nan=False))
            write_digest(file)

    def check(temporary: Path) -> None:
        with open_h5(temporary) as file:
            read_provenance(file)

    write_atomically(path, write, overwrite=True, check=check)


def read_provenance(file: h5py.File) -> dict[str, Any]:
    """Return the provenance record.

    Raises
    ------
    KeyError, ValueError, RecursionError : there is none, or it is no record
    """
    text = file.attrs["provenance"]
    if not isinstance(text, bytes):
        raise ValueError(f"its provenance is a {type(text).__name__}, expected bytes")
    record = json.loads(text)
    made_from = record.get("made_from", {}) if isinstance(record, dict) else None
    if not isinstance(made_from, dict) or not all(map(_is_record, (record, *made_from.values()))):
        raise ValueError("its provenance is not a record")
    return record


def _is_record(value: Any) -> bool:
    """Return whether a value is built as `provenance.record` builds records, as far as it says anything."""
    if not isinstance(value, dict) or not isinstance(value.get("command", ""), str):
        return False
    inputs, warnings, config = (value.get(name) or {} for name in ("inputs", "warnings", "config"))
    return (
        isinstance(config, dict)
        and isinstance(inputs, dict)
        and all(_are_texts(entry, "name", "sha256") for entry in inputs.values())
        and (not warnings or isinstance(warnings, list))
        and all(_are_texts(entry, "code", "about", "text", "remedy") for entry in warnings)
    )


def _are_texts(entry: Any, *names: str) -> bool:
    """Return whether an object has a text under each of the names."""
    return isinstance(entry, dict) and all(isinstance(entry.get(name), str) for name in names)


def _write_group(group: h5py.Group, tree: Tree, units: Mapping[str, str]) -> None:
    for name, value in tree.items():
        if group.name == "/" and name in RESERVED:
            raise ValueError(f"{name} is a name that every file uses for itself")
        if isinstance(value, Mapping):
            _write_group(group.create_group(name), value, units)
        elif isinstance(value, np.ndarray):
            said = [unit for end, unit in UNITS_IN_NAMES.items() if name.endswith(end)]
            if not said and name not in units:
                raise ValueError(f"{name} has no unit: its name ends in none, and none is given")
            write_array(group, name, value, said[0] if said else units[name])
        else:
            group.attrs[name] = to_attribute(value)


def _read_group(group: h5py.Group, file_bytes: int, levels: int) -> dict[str, Any]:
    if levels == 0:
        raise ValueError(f"{group.name} lies deeper than {DEEPEST} groups")
    tree = {name: from_attribute(name, value) for name, value in group.attrs.items()}
    for name in group:
        item = member(group, name)
        if isinstance(item, h5py.Group):
            tree[name] = _read_group(item, file_bytes, levels - 1)
        else:
            tree[name] = read_array(item, file_bytes)
    return tree


def to_attribute(value: Any) -> Any:
    """Return what HDF5 stores for a scalar, a string or None; strings of fixed length lie under the checksums."""
    if value is None:
        return h5py.Empty("f8")
    if isinstance(value, str):
        return np.bytes_(value.encode()) if value else h5py.Empty("S1")
    if isinstance(value, (bool, int, float, np.number, np.bool_)):
        return value
    raise TypeError(f"cannot store a {type(value).__name__} as an attribute")


def from_attribute(name: str, value: Any) -> Any:
    """Return the scalar, string or None that an attribute stands for, as plain Python."""
    if isinstance(value, h5py.Empty):
        return "" if value.dtype.kind == "S" else None
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.generic):
        return value.item()
    raise ValueError(f"the attribute {name} is a {type(value).__name__}, expected a scalar or a string")


# Whether a file of ours is there, and whether it is whole: all that it holds read back, through its checksums.


def read_whole(path: Path) -> dict[str, Any] | None:
    """Read all that a file of ours holds; return the record that it carries, None for a file that is not ours.

    Raises
    ------
    InputError : the file is broken, in any of its parts
    """
    with open_h5(path) as file:
        if "format" not in file.attrs or "provenance" not in file.attrs:
            return None
        size = path.stat().st_size

        def read(_name: str, item: h5py.Group | h5py.Dataset) -> None:
            dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                read_array(item, size)

        dict(file.attrs)
        # Hard links to one array are followed once, and soft or external ones not at all.
        file.visititems(read)
        return read_provenance(file)


def ensure_opens(path: Path) -> None:
    """Refuse a file that is missing, cut or no HDF5, in a fraction of the time that looking at what it holds takes."""
    ensure_regular_file(path)
    try:
        with h5py.File(path, "r", locking="best-effort"):
            return
    except BROKEN_FILE_ERRORS as error:
        raise InputError(f"{path}: not a readable HDF5 file of ours: {reason(error)}") from error


def fault_of(paths: Iterable[Path]) -> str | None:
    """Return why one of these files cannot be opened, None where all can."""
    for path in paths:
        try:
            ensure_opens(path)
        except InputError as error:
            return str(error)
    return None


def unpacked_bytes(path: Path) -> int:
    """Return what the arrays of a file of ours take without compression."""
    sizes: list[int] = []

    def add(_name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            sizes.append(item.size * item.dtype.itemsize)

    with open_h5(path) as file:
        file.visititems(add)
    return sum(sizes)
