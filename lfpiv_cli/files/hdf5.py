"""HDF5, written so that a full disk raises and read so that a broken or hostile file does no harm.

A tree is a nested dict of numpy arrays, scalars, strings and None: dicts are groups, arrays datasets (each with
its unit, the attribute `units`), all else attributes. The root says `format`, `format_version` and `provenance` (JSON),
and `attributes_sha256`, a check sum of all attributes: HDF5 keeps none of an attribute of more than 4 kB, as a long
provenance is, once its object has more than eight attributes.

Here and in the modules of each format what reads a file raises `InputError` where it is missing, broken, of another
format or version, or leads outside itself; what writes one raises as `atomic.written_atomically` does. What may be in a
file is asked of every object before anything is read; what is wrong there is a `ValueError`, which `open_h5` renames.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, OutputError
from lfpiv_cli.files.atomic import written_atomically
from lfpiv_cli.files.inputs import ensure_regular_file, physical_memory, reason

Tree = Mapping[str, Any]
Item: TypeAlias = h5py.Group | h5py.Dataset

DIGEST = "attributes_sha256"
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
# Deflate cannot shrink data by more than 1032; a dataset that claims more was never written.
LARGEST_RATIO = 1100
# Our deepest tree has four levels, and some fifty objects; hard links can form circles.
DEEPEST, MOST_OBJECTS, MOST_ATTRIBUTES = 12, 10_000, 1_000
# Bytes; numerical libraries take no long doubles.
WIDEST_NUMBER = 8
# netCDF's dimension scales refer to each other in these; nothing here reads them.
OF_DIMENSION_SCALES = (b"DIMENSION_LIST", b"REFERENCE_LIST")
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

    def fill_group(group: h5py.Group, tree: Tree) -> None:
        for name, value in tree.items():
            if group.name == "/" and name in RESERVED:
                raise ValueError(f"{name} is a name that every file uses for itself")
            if isinstance(value, Mapping):
                fill_group(group.create_group(name), value)
            elif isinstance(value, np.ndarray):
                said = [unit for end, unit in UNITS_IN_NAMES.items() if name.endswith(end)]
                if not said and name not in (units or {}):
                    raise ValueError(f"{name} has no unit: its name ends in none, and none is given")
                write_array(group, name, value, said[0] if said else (units or {})[name])
            else:
                group.attrs[name] = to_attribute(value)

    with created(path, overwrite=overwrite, check=lambda made: read_tree(made, format_name, format_version)) as file:
        write_header(file, format_name, format_version, provenance)
        fill_group(file, tree)


def read_tree(path: Path, format_name: str, format_version: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a file that `write_tree` wrote: the tree and its provenance.

    Raises
    ------
    InputError : the file is missing, broken, of another format or version, or leads outside itself
    """
    with open_h5(path, format_name, format_version) as file:
        size = path.stat().st_size

        def read_group(group: h5py.Group, levels: int) -> dict[str, Any]:
            if levels == 0:
                raise ValueError(f"{group.name} lies deeper than {DEEPEST} groups")
            tree = {name: from_attribute(name, value) for name, value in group.attrs.items()}
            for name in group:
                item = member(group, name)
                tree[name] = read_group(item, levels - 1) if isinstance(item, h5py.Group) else read_array(item, size)
            return tree

        tree = read_group(file, DEEPEST)
        return {name: value for name, value in tree.items() if name not in RESERVED}, read_provenance(file)


@contextmanager
def created(path: Path, *, overwrite: bool, check: Callable[[Path], object] | None = None) -> Iterator[h5py.File]:
    """Create an HDF5 file atomically, to be filled; `check` reads it back: by default its format."""
    with written_atomically(path, overwrite=overwrite, check=check or format_of) as temporary:
        try:
            with h5py.File(temporary, "w", libver=LIBRARY_VERSIONS, rdcc_nbytes=CHUNK_CACHE_BYTES) as file:
                yield file
                write_digest(file)
        except RuntimeError as error:  # h5py's word for a write that fails on closing
            raise OutputError(f"{path}: cannot be written: {reason(error)}") from error


def write_array(group: h5py.Group, name: str, array: NDArray[Any], units: str | None = None) -> h5py.Dataset:
    """Write a numeric array with checksums; an array without elements has nothing to check."""
    return write_rows(group, name, len(np.atleast_1d(array)), [np.ascontiguousarray(array)], units)


def write_rows(
    group: h5py.Group, name: str, count: int, pieces: Iterable[NDArray[Any]], units: str | None = None
) -> h5py.Dataset:
    """Write as `write_array` does an array of so many rows that comes in pieces of them, one at least."""
    pieces = iter(pieces)
    held = next(pieces)
    shape, dtype = (count, *held.shape[1:]), held.dtype
    if dtype.kind not in "fiu":
        raise TypeError(f"{name}: arrays are floating point or integer, not {dtype}")
    storage: dict[str, Any] = {}
    if 0 not in shape:  # chunks of whole rows and planes below `CHUNK_BYTES`
        left, chunk = max(CHUNK_BYTES // dtype.itemsize, 1), []
        for n in reversed(shape):
            chunk.append(max(min(n, left), 1))
            left //= chunk[-1]
        storage = {"chunks": tuple(reversed(chunk)), **FILTERS}
    dataset = group.create_dataset(name, shape, dtype, track_times=False, **storage)
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
def open_h5(path: Path, format_name: str | None = None, format_version: int = 1) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading, of a format and version where these are given.

    What fails inside, but for want of memory, is an `InputError` of it. A file of ours is refused with anything in it
    that none of ours has, whether somebody would read it or not: links, arrays or attributes that lead elsewhere, of
    other kinds, or larger than the file can hold; or attributes that are not those of the check sum.
    """
    ensure_regular_file(path)
    try:
        with h5py.File(path, "r", locking="best-effort") as file:
            if "format" in file.attrs:
                size, memory = path.stat().st_size, physical_memory()
                try:
                    objects = list(_objects(file))
                    for name, item in objects:
                        if isinstance(item, h5py.h5d.DatasetID):
                            ensure_array(_text(name), item, size, memory)
                    digest, written = _digest(objects, size)
                except MemoryError as error:  # something says a size there that it cannot have
                    raise ValueError(reason(error)) from error
                if written not in (None, digest):
                    raise ValueError("its attributes are not those that were written: it is damaged, or was edited")
            if format_name is not None:
                found = file.attrs.get("format")
                says = found.decode("utf-8", "replace") if isinstance(found, bytes) else "no format of ours"
                if says != format_name:
                    raise InputError(f"{path}: holds {says}, expected {format_name}")
                version = from_attribute("format_version", file.attrs["format_version"])
                if version != format_version:
                    remedy = "; make it again with this program" if version < format_version else ""
                    ours = f"this program reads {format_version}"
                    raise InputError(f"{path}: has {format_name} version {version}, {ours}{remedy}")
            yield file
    except BROKEN_FILE_ERRORS as error:
        raise InputError(f"{path}: not a readable HDF5 file of ours: {reason(error)}") from error


def format_of(path: Path) -> str:
    """Return the name of a file's format."""
    with open_h5(path) as file:
        found = file.attrs.get("format")
        if not isinstance(found, bytes):
            raise InputError(f"{path}: says no format of ours")
        return found.decode()


def write_header(file: h5py.File, format_name: str, format_version: int, provenance: Mapping[str, Any]) -> None:
    """Write what every file says at its root: format, version, and the provenance record as JSON."""
    file.attrs["format"] = np.bytes_(format_name)
    file.attrs["format_version"] = np.int64(format_version)
    file.attrs["provenance"] = np.bytes_(json.dumps(provenance, allow_nan=False))


def read_provenance(file: h5py.File) -> dict[str, Any]:
    """Return the provenance record.

    Raises
    ------
    KeyError, ValueError, RecursionError : there is none, or it is no record
    """
    text = file.attrs["provenance"]
    if not isinstance(text, bytes):
        raise ValueError(f"its provenance is a {type(text).__name__}, expected bytes")

    def are_texts(entry: Any, *names: str) -> bool:
        return isinstance(entry, dict) and all(isinstance(entry.get(name), str) for name in names)

    def is_record(value: Any) -> bool:
        """Return whether a value is built as `provenance.record` builds records, as far as it says anything."""
        if not isinstance(value, dict) or not isinstance(value.get("command", ""), str):
            return False
        inputs, warnings, config = (value.get(name) or {} for name in ("inputs", "warnings", "config"))
        return (
            isinstance(config, dict)
            and isinstance(inputs, dict)
            and all(are_texts(entry, "name", "sha256") for entry in inputs.values())
            and (not warnings or isinstance(warnings, list))
            and all(are_texts(entry, "code", "about", "text", "remedy") for entry in warnings)
        )

    record = json.loads(text)
    made_from = record.get("made_from", {}) if isinstance(record, dict) else None
    if not isinstance(made_from, dict) or not all(map(is_record, (record, *made_from.values()))):
        raise ValueError("its provenance is not a record")
    return record


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


def items_in(file: h5py.File) -> list[Item]:
    """Return the groups and arrays of a file but its root, each once; soft and external links are not followed."""
    found: list[Item] = []
    file.visititems(lambda _, item: found.append(item))
    return found


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
        for item in (file, *items_in(file)):
            dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                read_array(item, size)
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
    with open_h5(path) as file:
        return sum(item.size * item.dtype.itemsize for item in items_in(file) if isinstance(item, h5py.Dataset))


# What a file may hold, and the check sum of its attributes.


def member(group: h5py.Group, name: str) -> Item:
    """Return a group's member by hard link only: soft and external links can lead anywhere."""
    link = group.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        raise ValueError(f"{group.name}/{name} is not a hard link")
    return group[name]


def array_member(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a group's member that is an array."""
    item = member(group, name)
    if not isinstance(item, h5py.Dataset):
        raise ValueError(f"{item.name} is a group, expected an array")
    return item


def write_digest(file: h5py.File) -> None:
    """Write the check sum of all attributes; nothing may be written after it."""
    file.attrs[DIGEST] = np.bytes_(_digest(list(_objects(file)), None)[0])


# Below, h5py's plain handles: its groups and arrays take ten times as long to open. A handle takes some 10 us, one of a
# type or a shape, too: as few as possible are asked for.


def ensure_array(name: str, array: h5py.h5d.DatasetID, file_bytes: int, memory: int) -> None:
    """Refuse an array that is not numbers, or whose bytes do not lie in this very file, all of them.

    Parameters
    ----------
    file_bytes, memory : of the file and of the machine, the bounds on what may be declared
    """
    # Asked of the list of properties alone: the shape of a virtual dataset would open the files that it leads to.
    properties = array.get_create_plist()
    layout = properties.get_layout()
    if layout == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise ValueError(f"{name} lies in another file")
    dtype, shape = array.dtype, array.shape
    if dtype.kind not in "fiu" or dtype.itemsize > WIDEST_NUMBER or shape is None:
        raise ValueError(f"{name} has type {dtype}, expected numbers of at most {8 * WIDEST_NUMBER} bits")
    stored = min(array.get_storage_size(), file_bytes)
    allowed = min(LARGEST_RATIO * stored, memory)
    declared = math.prod(shape) * dtype.itemsize
    if declared > allowed:
        raise ValueError(f"{name} declares {declared} bytes, more than the {allowed} that are possible")
    if layout != h5py.h5d.CHUNKED:
        if stored < declared:
            raise ValueError(f"{name} was never written")
        return
    chunk = properties.get_chunk()
    expected = math.prod(-(-n // c) for n, c in zip(shape, chunk, strict=True))
    if declared and array.get_num_chunks() != expected:
        raise ValueError(f"{name} has {array.get_num_chunks()} of its {expected} chunks")
    if declared and math.prod(chunk) * dtype.itemsize > LARGEST_RATIO * stored:
        raise ValueError(f"{name} has chunks of {math.prod(chunk)} numbers, more than its {stored} bytes can hold")


def _objects(file: h5py.File) -> Iterator[tuple[bytes, h5py.h5g.GroupID | h5py.h5d.DatasetID]]:
    """Yield every group and array of a file once, by hard links alone, with its first path in the order of names."""
    links: list[tuple[bytes, int, int]] = []

    def note(name: bytes, link: h5py.h5l.LinkInfo) -> bool | None:
        # Of a hard link, the last is where its object lies in the file.
        links.append((name, link.type, link.u))
        return True if len(links) > MOST_OBJECTS else None

    root = h5py.h5g.open(file.id, b"/")
    if root.links.visit(note, info=True):
        raise ValueError(f"it holds more than {MOST_OBJECTS} groups and arrays")
    yield b"", root
    # How many more links may lead to an object: our arrays have two at most, and a group that has two is read twice.
    further = {h5py.h5o.get_info(root).addr: 0}
    for name, kind, address in sorted(links):
        if kind != h5py.h5l.TYPE_HARD:
            raise ValueError(f"/{_text(name)} is not a hard link")
        if name.count(b"/") > DEEPEST:
            raise ValueError(f"/{_text(name)} lies deeper than {DEEPEST} groups")
        if address in further:
            further[address] -= 1
            if further[address] < 0:
                raise ValueError(f"/{_text(name)} leads to a group or an array that other names lead to, too")
            continue
        item = h5py.h5o.open(root, name)
        further[address] = 1 if isinstance(item, h5py.h5d.DatasetID) else 0
        if not isinstance(item, (h5py.h5g.GroupID, h5py.h5d.DatasetID)):
            raise ValueError(f"/{_text(name)} is neither a group nor an array")
        yield b"/" + name, item


def _digest(
    objects: list[tuple[bytes, h5py.h5g.GroupID | h5py.h5d.DatasetID]], file_bytes: int | None
) -> tuple[bytes, bytes | None]:
    """Return the SHA-256 of the names, types, shapes and bytes of all attributes, and the one that the file has.

    Both in hexadecimal digits. Attributes that are neither numbers nor strings of fixed length, or larger than the
    file, are refused.
    """
    found, written = hashlib.sha256(), None
    for path, item in objects:
        names: list[bytes] = []
        if h5py.h5a.get_num_attrs(item) > MOST_ATTRIBUTES:
            raise ValueError(f"an object has more than {MOST_ATTRIBUTES} attributes")
        h5py.h5a.iterate(item, names.append)
        for name in sorted(set(names).difference(OF_DIMENSION_SCALES)):
            attribute = h5py.h5a.open(item, name)
            stored = attribute.get_type()
            # An empty attribute has no shape, nor anything to read.
            dtype, shape = _dtype(stored.encode()), attribute.shape
            if dtype.kind not in "biufS" or (dtype.kind != "S" and dtype.itemsize > WIDEST_NUMBER):
                raise ValueError(f"the attribute {_text(name)} has type {dtype}, expected numbers or bytes")
            declared = math.prod(shape or ()) * dtype.itemsize
            if file_bytes is not None and declared > file_bytes:
                raise ValueError(f"the attribute {_text(name)} declares {declared} bytes, the file has {file_bytes}")
            value = np.zeros(0 if shape is None else shape, dtype)
            if value.size:
                # As it is stored, where numpy has that very type: a type of the value's would be one more handle.
                attribute.read(value, stored if stored.get_size() == dtype.itemsize else None)
            if name == DIGEST.encode():
                written = value.tobytes()
                continue
            found.update(path + f"\0{_text(name)}\0{dtype.str}\0{shape}\0".encode() + value.tobytes())
    return found.hexdigest().encode(), written


@lru_cache(maxsize=64)
def _dtype(encoded: bytes) -> np.dtype[Any]:
    """Return numpy's type for one of HDF5's, as this describes it in bytes."""
    return h5py.h5t.decode(encoded).dtype


def _text(name: bytes) -> str:
    return name.decode("utf-8", "replace")
