"""Frames in an HDF5 file: a dataset (frames, rows, columns), named as FILE.h5:/PATH, or the only one of three axes.

Where a dataset `time_s` with a number for each frame lies beside it, these are its times.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import DEEPEST, open_h5
from lfpiv_cli.files.hdf5_checks import member
from lfpiv_cli.files.recordings.recording import CUT, Image, Recording, Shape, as_counts, ensure_size

START = b"\x89HDF\r\n\x1a\n"
TIMES = "time_s"
# A chunk is unpacked whole for each frame in it; cameras' programs write a frame or a few in each.
MOST_CHUNK_BYTES = 2**28
# Names of datasets that an error lists.
MOST_LISTED = 5


def frames(path: Path, name: str | None = None) -> Recording:
    """Return the frames of a dataset, of one with two dimensions the only frame; by default of the only one of three.

    Raises
    ------
    InputError : there is no such dataset, there are several, or it is a file of ours
    """
    with open_h5(path) as file:
        if name is not None:
            return _frames_in(path, _dataset(path, file, name))
        if "format" in file.attrs and "provenance" in file.attrs:
            raise InputError(f"{path}: is a result of this program, expected images")
        names = [dataset.name for dataset in _datasets(file, DEEPEST, set()) if dataset.ndim == 3]
        if len(names) != 1:
            listed = ", ".join(f"{path.name}:{name}" for name in names[:MOST_LISTED])
            raise InputError(
                f"{path}: holds {len(names)} datasets of frames, expected one, or to be told which"
                + (f": {listed}" if names else "")
            )
        return _frames_in(path, file[names[0]])


def _datasets(group: h5py.Group, levels: int, seen: set[int]) -> Iterator[h5py.Dataset]:
    """Yield the numeric datasets of a group and of those in it, whose places in the file are not among those seen."""
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        place = h5py.h5o.get_info(item.id).addr
        if place in seen:
            continue
        seen.add(place)
        if isinstance(item, h5py.Group) and levels:
            yield from _datasets(item, levels - 1, seen)
        elif isinstance(item, h5py.Dataset) and item.dtype.kind in "uif":
            yield item


def _dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Return a dataset by its path of hard links."""
    found: h5py.Group | h5py.Dataset = file
    for part in name.strip("/").split("/"):
        if not isinstance(found, h5py.Group) or part not in found:
            raise InputError(f"{path}: holds no dataset {name}")
        found = member(found, part)
    if not isinstance(found, h5py.Dataset):
        raise InputError(f"{path}: {name} is a group, expected a dataset of frames")
    return found


def _frames_in(path: Path, dataset: h5py.Dataset) -> Recording:
    """Return the frames of a dataset whose bytes are all in this very file, with the times beside it."""
    name = dataset.name
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{path}: {name} lies in another file")
    if dataset.shape is None or dataset.ndim not in (2, 3) or dataset.dtype.kind not in "uif" or not dataset.size:
        raise InputError(
            f"{path}: {name} is {dataset.dtype} {dataset.shape}, expected numbers of (frames, rows, columns)"
        )
    shape, item_bytes = (int(dataset.shape[-2]), int(dataset.shape[-1])), dataset.dtype.itemsize
    ensure_size(f"{path}: a frame of {name}", shape, item_bytes, None, path.stat().st_size)

    # Parts that were never written would be read as zeros.
    if dataset.chunks is None:
        stored = dataset.id.get_storage_size()
        if stored < dataset.size * item_bytes:
            raise InputError(f"{path}: {name} has {stored} of its {dataset.size * item_bytes} bytes: {CUT}")
    else:
        if math.prod(dataset.chunks) * item_bytes > MOST_CHUNK_BYTES:
            raise InputError(f"{path}: {name} has chunks of {dataset.chunks}, more than {MOST_CHUNK_BYTES} bytes each")
        expected = math.prod(-(-n // c) for n, c in zip(dataset.shape, dataset.chunks, strict=True))
        found = dataset.id.get_num_chunks()
        if found != expected:
            raise InputError(f"{path}: {name} has {found} of its {expected} chunks: {CUT}")

    pages, time_s = int(dataset.shape[0]) if dataset.ndim == 3 else 1, None
    times = member(dataset.parent, TIMES) if TIMES in dataset.parent else None
    if isinstance(times, h5py.Dataset) and times.shape == (pages,) and times.dtype.kind in "uif":
        told = np.asarray(times[()], np.float64)
        time_s = told if np.isfinite(told).all() else None
    return Recording(pages, shape, 8 * item_bytes, partial(_read_page, path, name), time_s)


def _read_page(path: Path, name: str, page: int, shape: Shape | None) -> Image:
    with open_h5(path) as file:
        dataset = _dataset(path, file, name)
        ensure_size(f"{path}: frame {page}", dataset.shape[-2:], dataset.dtype.itemsize, shape, path.stat().st_size)
        return as_counts(dataset[page] if dataset.ndim == 3 else dataset[()])
