"""What an HDF5 file of ours may hold, asked of every object before anything is read; a check sum of its attributes.

HDF5 keeps no check sum of an attribute of more than 4 kB, as a long provenance is, once its object has more than eight
attributes. So the root has one of all attributes in the file: `attributes_sha256`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, TypeAlias

import h5py
import numpy as np

from lfpiv_cli.files.inputs import physical_memory

DIGEST = "attributes_sha256"
# Deflate cannot shrink data by more than 1032; a dataset that claims more was never written.
LARGEST_RATIO = 1100
# Our deepest tree has four levels, and some fifty objects; hard links can form circles.
DEEPEST, MOST_OBJECTS, MOST_ATTRIBUTES = 12, 10_000, 1_000
# Bytes; numerical libraries take no long doubles.
WIDEST_NUMBER = 8
# netCDF's dimension scales refer to each other in these; nothing here reads them.
OF_DIMENSION_SCALES = (b"DIMENSION_LIST", b"REFERENCE_LIST")

Item: TypeAlias = h5py.Group | h5py.Dataset


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


def ensure_ours(file: h5py.File, file_bytes: int) -> None:
    """Refuse a file with anything in it that no file of ours has, whether somebody would read it or not.

    Raises
    ------
    ValueError : links, arrays or attributes that lead elsewhere, of other kinds, or larger than the file can hold; or
        attributes that are not those of the check sum
    """
    objects, memory = list(_objects(file)), physical_memory()
    for path, item in objects:
        if isinstance(item, h5py.h5d.DatasetID):
            ensure_array(_text(path), item, file_bytes, memory)
    found, written = _digest(objects, file_bytes)
    if written not in (None, found):
        raise ValueError("its attributes are not those that were written: it is damaged, or was edited")


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
        for name in _told(item):
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


def _told(item: h5py.h5g.GroupID | h5py.h5d.DatasetID) -> list[bytes]:
    """Return the names of an object's attributes, sorted, without those of dimension scales."""
    names: list[bytes] = []

    def note(name: bytes) -> bool | None:
        names.append(name)
        return True if len(names) > MOST_ATTRIBUTES else None

    if h5py.h5a.iterate(item, note):
        raise ValueError(f"an object has more than {MOST_ATTRIBUTES} attributes")
    return sorted(name for name in names if name not in OF_DIMENSION_SCALES)


def _text(name: bytes) -> str:
    return name.decode("utf-8", "replace")
