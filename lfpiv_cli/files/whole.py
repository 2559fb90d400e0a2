"""Whether a file of ours is whole: all that it holds is read back, through its checksums."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py

from lfpiv_cli.files.hdf5 import open_h5, read_array, read_provenance


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
