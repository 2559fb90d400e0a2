"""What an HDF5 file of ours may hold, asked of every object before anything is read; a check sum of its attributes.

HDF5 keeps no check sum of an attribute of more than 4 kB, as a long provenance is, once its object has more than eight
attributes. So the root has one of all attributes in the file: `attributes_sha256`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from typing import TypeAlias

import h5py
import numpy as np

from lfpiv_cli.files.inputs import physical_memory

DIGEST = "attributes_sha256"
# Deflate cannot shrink data by more than 1032; a dataset that claims more was never written.
LARGEST_RATIO = 1100
# Our deepest tree has four levels, and some fifty objects; hard links can form circles.
DEEPEST, MOST_OBJECTS, MOST_ATTRIBUTES = 12, 10_000, 1_000
# netCDF's dimension scales refer to each other in these; nothing here reads them.
OF_DIMENSION_SCALES = ("DIMENSION_LIST", "REFERENCE_LIST")

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
    objects = list(_objects(file))
    for _, item in objects:
        _ensure_attributes(item, file_bytes)
        if isinstance(item, h5py.Dataset):
            ensure_array(item, file_bytes)
    if DIGEST in file.attrs and file.attrs[DIGEST] != _digest(objects):
        raise ValueError("its attributes are not those that were written: it is damaged, or was edited")


def write_digest(file: h5py.File) -> None:
    """Write the check sum of all attributes; nothing may be written after it."""
    file.attrs[DIGEST] = _digest(list(_objects(file)))


def ensure_array(dataset: h5py.Dataset, file_bytes: int) -> None:
    """Refuse an array that is not numbers, or whose bytes do not lie in this very file, all of them.

    Parameters
    ----------
    file_bytes : size of the file, the bound on what may be declared
    """
    name = dataset.name
    # Asked of the list of properties alone: the shape of a virtual dataset would open the files that it leads to.
    properties = dataset.id.get_create_plist()
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise ValueError(f"{name} lies in another file")
    if dataset.dtype.kind not in "fiu" or dataset.shape is None:
        raise ValueError(f"{name} has type {dataset.dtype}, expected numbers")
    stored = min(dataset.id.get_storage_size(), file_bytes)
    allowed = min(LARGEST_RATIO * stored, physical_memory())
    declared = math.prod(dataset.shape) * dataset.dtype.itemsize
    if declared > allowed:
        raise ValueError(f"{name} declares {declared} bytes, more than the {allowed} that are possible")
    if dataset.chunks is None and stored < declared:
        raise ValueError(f"{name} was never written")
    if dataset.chunks is not None and dataset.size:
        expected = math.prod(-(-n // c) for n, c in zip(dataset.shape, dataset.chunks, strict=True))
        found = dataset.id.get_num_chunks()
        if found != expected:
            raise ValueError(f"{name} has {found} of its {expected} chunks")
        chunk_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
        if chunk_bytes > LARGEST_RATIO * stored:
            raise ValueError(f"{name} has chunks of {chunk_bytes} bytes, more than its {stored} can hold")


def _objects(file: h5py.File) -> Iterator[tuple[str, Item]]:
    """Yield every group and array of a file once, by hard links alone, with its first path in the order of names."""
    seen: set[int] = set()
    waiting: list[tuple[str, Item, int]] = [("", file, 0)]
    while waiting:
        path, item, level = waiting.pop()
        address = h5py.h5o.get_info(item.id).addr
        if address in seen:
            continue
        seen.add(address)
        if len(seen) > MOST_OBJECTS:
            raise ValueError(f"it holds more than {MOST_OBJECTS} groups and arrays")
        if level > DEEPEST:
            raise ValueError(f"{path} lies deeper than {DEEPEST} groups")
        if not isinstance(item, (h5py.Group, h5py.Dataset)):
            raise ValueError(f"{path} is neither a group nor an array")
        yield path, item
        if isinstance(item, h5py.Group):
            if len(item) > MOST_OBJECTS:
                raise ValueError(f"{path} holds more than {MOST_OBJECTS} groups and arrays")
            waiting += [(f"{path}/{name}", member(item, name), level + 1) for name in sorted(item, reverse=True)]


def _ensure_attributes(item: Item, file_bytes: int) -> None:
    """Refuse attributes that are neither numbers nor strings of fixed length, or larger than the file."""
    if h5py.h5a.get_num_attrs(item.id) > MOST_ATTRIBUTES:
        raise ValueError(f"{item.name} has more than {MOST_ATTRIBUTES} attributes")
    for name in _told(item):
        attribute = h5py.h5a.open(item.id, name)
        if attribute.dtype.kind not in "biufS":
            raise ValueError(f"the attribute {_text(name)} has type {attribute.dtype}, expected numbers or bytes")
        declared = math.prod(attribute.shape or ()) * attribute.dtype.itemsize
        if declared > file_bytes:
            raise ValueError(f"the attribute {_text(name)} declares {declared} bytes, the file has {file_bytes}")


def _digest(objects: list[tuple[str, Item]]) -> np.bytes_:
    """Return the SHA-256 of the names, types, shapes and bytes of all attributes, in hexadecimal digits."""
    found = hashlib.sha256()
    for path, item in objects:
        for name in _told(item):
            attribute = h5py.h5a.open(item.id, name)
            if name == DIGEST.encode():
                continue
            # An empty attribute has no shape, nor anything to read.
            shape = attribute.shape
            value = np.zeros(0 if shape is None else shape, attribute.dtype)
            if value.size:
                attribute.read(value)
            head = f"{path}\0{_text(name)}\0{value.dtype.str}\0{shape}\0"
            found.update(head.encode("utf-8", "surrogateescape") + value.tobytes())
    return np.bytes_(found.hexdigest())


def _told(item: Item) -> list[bytes]:
    """Return the names of an object's attributes, sorted, without those of dimension scales."""
    names: list[bytes] = []
    h5py.h5a.iterate(item.id, names.append)
    return sorted(name for name in names if _text(name) not in OF_DIMENSION_SCALES)


def _text(name: bytes) -> str:
    return name.decode("utf-8", "replace")
