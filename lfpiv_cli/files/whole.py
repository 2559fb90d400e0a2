"""Whether a file of ours is there, and whether it is whole: all that it holds read back, through its checksums."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import BROKEN_FILE_ERRORS, open_h5, read_array, read_provenance
from lfpiv_cli.files.inputs import ensure_regular_file, reason


def read_whole(path: Path) -> dict[str, Any] | None:
    """Read all that a file of ours holds; return the record that it carries, None for a file that is not ours.

    Raises
    ------
    InputError
        The file is broken, in any of its parts.
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
    """Refuse a file that is missing, cut or no HDF5, in a fraction of the time that it takes to look at what it holds.

    Raises
    ------
    InputError
    """
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
    """Return what the arrays of a file of ours take without compression.

    Raises
    ------
    InputError
    """
    sizes: list[int] = []

    def add(_name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            sizes.append(item.size * item.dtype.itemsize)

    with open_h5(path) as file:
        file.visititems(add)
    return sum(sizes)
