"""What is in a volume, vectors, particles or tracks, all of it, in the one form that the formats are written from."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import format_of
from lfpiv_cli.files.particle_file import (
    PARTICLES_FORMAT,
    POSITION,
    TRACKS_FORMAT,
    TRAJECTORIES_FORMAT,
    read_points,
    units_of,
)
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT, VOLUME_FORMAT, open_vectors, open_volume, read_arrays, read_header
from lfpiv_cli.grid import Grid

# What each format holds, as a person says it.
KINDS = {
    VOLUME_FORMAT: "a volume",
    VECTORS_FORMAT: "vectors",
    PARTICLES_FORMAT: "particles",
    TRACKS_FORMAT: "tracks of a pair",
    TRAJECTORIES_FORMAT: "tracks of a sequence",
}
ON_GRIDS = (VOLUME_FORMAT, VECTORS_FORMAT)
OF_POINTS = (PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT)
# The last axis of an array, by its length: vectors, and symmetric tensors in VTK's order.
COMPONENTS = {3: ("x", "y", "z"), 6: ("xx", "yy", "zz", "xy", "yz", "xz")}
# What the components of these arrays are called; those of others have their name before them.
NAMES = {POSITION: ["x", "y", "z"], "velocity": ["u", "v", "w"]}


@dataclass(frozen=True, eq=False)
class Content:
    """The content of a file.

    Attributes
    ----------
    format_name : one of `KINDS`
    grid : of a volume and of vectors, None of points
    arrays : by name, (nz, ny, nx) or (n,), and with a last axis of components
    units : of the arrays
    attributes : what the file says about itself: scalars, strings and short lists
    provenance : the record of how it was made
    """

    format_name: str
    grid: Grid | None
    arrays: dict[str, NDArray[Any]]
    units: dict[str, str]
    attributes: dict[str, Any]
    provenance: dict[str, Any]

    def told(self) -> dict[str, Any]:
        """Return what is told besides the arrays: the format, the attributes, and the provenance as JSON."""
        known = {name: value for name, value in self.attributes.items() if value is not None}
        return {"format": self.format_name, **known, "provenance": json.dumps(self.provenance)}

    def comments(self, units: Mapping[str, str]) -> Iterator[str]:
        """Yield the same as lines of comments, the provenance as JSON over as many as it needs; the units last."""
        for name, value in self.told().items():
            if name != "provenance":
                yield f"# {name}: {json.dumps(value)}"
        yield "# provenance:"
        for line in json.dumps(self.provenance, indent=1).splitlines():
            yield f"# {line}"
        yield f"# units: {json.dumps(units)}"


def read_content(path: Path) -> Content:
    """Read a volume, vectors, particles or tracks."""
    name = format_of(path)
    if name not in KINDS:
        raise InputError(f"{path}: holds {name}, expected {', '.join(KINDS)}")
    if name == VOLUME_FORMAT:
        volume = open_volume(path)
        return Content(
            name, volume.grid, {"intensity": volume.array}, {"intensity": "1"}, volume.attributes, volume.provenance
        )
    if name == VECTORS_FORMAT:
        open_vectors(path)  # for its checks
        grid, found = read_arrays(path)
        header = read_header(path)
        # The velocity comes first, as it is what is asked for.
        names = sorted(found, key=lambda each: (each != "velocity", each))
        arrays, units = {each: found[each][0] for each in names}, {each: found[each][1] for each in names}
        return Content(name, grid, arrays, units, header.attributes, header.provenance)
    points = read_points(path, name)
    arrays = {POSITION: points.position_mm, **points.arrays}
    units = {POSITION: "mm", **units_of(name, arrays)}
    return Content(name, None, arrays, units, points.attributes, points.provenance)


def columns_of(content: Content) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return all as columns of one row for each place, coordinates before each component of each array; and the units.

    The velocity's are called u, v, w; x varies fastest on a grid, z slowest.
    """
    columns: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    if content.grid is not None:
        centres = content.grid.centres_mm().reshape(-1, 3)
        columns = {axis: centres[:, k] for k, axis in enumerate("xyz")}
        units = dict.fromkeys("xyz", "mm")
    places = 1 if content.grid is None else 3
    for name, array in content.arrays.items():
        names = [name]
        if array.ndim > places:
            count = array.shape[-1]
            names = NAMES.get(name, [f"{name}_{suffix}" for suffix in COMPONENTS.get(count, range(count))])
        columns |= dict(zip(names, array.reshape(-1, len(names)).T, strict=True))
        units |= dict.fromkeys(names, content.units[name])
    return columns, units


def frames_of(content: Content) -> list[NDArray[np.int64]]:
    """Return the rows of each frame of a sequence's tracks."""
    frame = content.arrays["frame"]
    return [np.flatnonzero(frame == number) for number in range(int(frame.max(initial=-1)) + 1)]
