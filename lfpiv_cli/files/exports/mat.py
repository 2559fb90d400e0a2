"""Matlab's MAT files, version 5: a variable for each array and for what the file says about itself; the structure
`units` has the unit of each array.

Tracks of a sequence come a second time as the list `tracks` of records, one for each track, which flowtracks reads:
places `xf`, `yf`, `zf` (mm), velocities `uf`, `vf`, `wf` (mm/s), accelerations `axf`, `ayf`, `azf` (NaN, as they are
not measured), frames `t` and the track's number `trajid`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import OutputError
from lfpiv_cli.files.exports.content import Content
from lfpiv_cli.files.particle_file import POSITION, TRAJECTORIES_FORMAT

# The format counts the bytes of a variable in 32 bits, of which readers take 31.
LARGEST_BYTES = 2**31 - 1
# The first bytes of a file are words, in which scipy writes the time: the same work gives the same bytes.
WORDS = b"MATLAB 5.0 MAT-file, written by lfpiv".ljust(116)
MM_PER_M = 1000.0
FIELDS = ("xf", "yf", "zf", "uf", "vf", "wf", "axf", "ayf", "azf", "t", "trajid")


def write_mat(path: Path, content: Content) -> None:
    """Write everything under the names that it has; arrays on a grid are [z, y, x] and the component last.

    Raises
    ------
    OutputError : an array is larger than the format allows
    """
    from scipy.io import savemat

    for name, array in content.arrays.items():
        if array.nbytes > LARGEST_BYTES:
            raise OutputError(f"{name} has {array.nbytes} bytes, MAT files hold {LARGEST_BYTES}; netcdf holds more")
    variables: dict[str, Any] = {}
    if content.format_name == TRAJECTORIES_FORMAT:
        # First: flowtracks takes the first variable of a file.
        variables["tracks"] = _tracks(content)
    if content.grid is not None:
        variables |= {axis: content.grid.axis_mm(k) for k, axis in enumerate("xyz")}
    variables |= content.arrays | content.told() | {"units": content.units}
    savemat(path, variables, appendmat=False, format="5", long_field_names=True, oned_as="column")
    with open(path, "rb+") as file:
        file.write(WORDS)


def _tracks(content: Content) -> NDArray[np.void]:
    """Return the tracks of a sequence as a column of records."""
    track, arrays = content.arrays["track"], content.arrays
    ends = np.flatnonzero(np.diff(track)) + 1
    rows = np.split(np.arange(len(track)), ends) if len(track) else []
    records = np.empty((len(rows), 1), dtype=[(name, object) for name in FIELDS])
    unknown = np.full(len(track), np.nan)
    columns = [*arrays[POSITION].T, *(MM_PER_M * arrays["velocity"]).T, unknown, unknown, unknown, arrays["frame"]]
    for number, here in enumerate(rows):
        parts = [column[here][:, np.newaxis] for column in columns]
        records[number, 0] = (*parts, np.array([[track[here[0]]]]))
    return records
