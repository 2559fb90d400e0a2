"""The camera and the grid that a weights file holds, believed only as far as a config would be.

What is missing, of another kind, or nothing that they could have raises KeyError, TypeError or ValueError.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.checks import (
    FEWEST_PIXELS_A_LENS,
    LARGEST_NUMBER,
    MOST_PIXELS_A_LENS,
    SMALLEST_NUMBER,
    lens_image_faults,
)
from lfpiv_cli.files.inputs import physical_memory
from lfpiv_cli.files.sections import MOST_PIXELS_PER_SIDE, MOST_VOXELS_PER_SIDE
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import ColumnAxis, Facing, Layout, names_in
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import Face
from lfpiv_cli.optics.surfaces import SURFACES

# Of the camera, those above 0; what else there is of numbers may have any sign.
POSITIVE = (
    *("focal_length_mm", "aperture_mm", "microlens_focal_length_mm", "microlens_distance_mm"),
    *("pixel_mm", "entrance_over_exit"),
)
CAMERA_SCALARS = ("magnification", *POSITIVE, "columns", "rows", "column_axis", "distortion_per_mm2")
# A kernel holds a volume, its padding, what it is made from, and as many numbers of each pixel.
BYTES_A_VOXEL, BYTES_A_PIXEL = 8, 8
# A basis whose vectors are nearly parallel is of no array: hexagons have 0.87.
LEAST_SINE = 0.5
LARGEST_INDEX = 5.0


def read_camera(tree: dict[str, Any]) -> Camera:
    """Return the camera of a weights file."""
    values: dict[str, Any] = {name: _positive(name, tree[name]) for name in POSITIVE}
    values |= {name: _whole(name, tree[name], 1, MOST_PIXELS_PER_SIDE) for name in ("columns", "rows")}
    values["magnification"] = -_positive(
        "the reverse of magnification", -read_number("magnification", tree["magnification"])
    )
    values["distortion_per_mm2"] = read_number("distortion_per_mm2", tree["distortion_per_mm2"])
    for name, allowed in (("column_axis", names_in(ColumnAxis)), ("layout", names_in(Layout))):
        if tree[name] not in allowed:
            raise ValueError(f"{name} is {tree[name]!r}, expected one of {', '.join(allowed)}")
    values["column_axis"] = tree["column_axis"]
    pixels = values["columns"] * values["rows"]
    if BYTES_A_PIXEL * pixels > physical_memory():
        raise ValueError(f"{values['columns']} x {values['rows']} pixels do not fit into memory")
    basis = _array("lattice_basis_mm", tree, (2, 2))
    lattice = Lattice(_array("lattice_origin_mm", tree, (2,)), basis, tree["layout"])
    if not lattice.cell_area >= LEAST_SINE * math.prod(lattice.pitch):
        raise ValueError(f"the lattice's basis {basis.tolist()} is of no array of lenses")
    camera = Camera(lattice=lattice, **values)
    pitch_px = camera.lattice.pitch / camera.pixel_mm
    if not (pitch_px.min() >= FEWEST_PIXELS_A_LENS and pitch_px.max() <= MOST_PIXELS_A_LENS):
        raise ValueError(f"its lens images are {pitch_px.tolist()} px apart")
    for fault in lens_image_faults(camera):
        raise ValueError(fault[1])
    return camera


def read_grid(tree: dict[str, Any]) -> tuple[Grid, tuple[int, int, int]]:
    """Return the grid of a weights file and its padding."""
    shape, padding = (
        _triple(name, tree[name], lambda name, value, least=least: _whole(name, value, least, MOST_VOXELS_PER_SIDE))
        for name, least in (("shape_xyz", 1), ("padding_xyz", 0))
    )
    spacing = _triple("spacing_mm", tree["spacing_mm"], _positive)
    origin = _triple("origin_mm", tree["origin_mm"], read_number)
    grid = Grid(shape, spacing, origin)
    voxels = math.prod(grid.padded(padding).shape_xyz)
    if BYTES_A_VOXEL * voxels > physical_memory():
        raise ValueError(f"{voxels} voxels do not fit into memory")
    return grid, padding


def read_face(tree: dict[str, Any]) -> Face:
    """Return a face that rays cross."""
    if tree["kind"] not in SURFACES:
        raise ValueError(f"a face is a {tree['kind']!r}, expected one of {', '.join(SURFACES)}")
    kind = SURFACES[tree["kind"]]
    values: dict[str, Any] = {}
    for name in (field.name for field in fields(kind)):  # type: ignore[arg-type]
        value = values[name] = tree[name]
        if name == "facing":
            if value not in names_in(Facing):
                raise ValueError(f"facing is {value!r}, expected one of {', '.join(names_in(Facing))}")
        elif name == "heights_mm":
            heights = _array(name, tree, np.shape(value) if np.ndim(value) == 2 else (0, 0))
            values[name] = tuple(tuple(row) for row in heights.tolist())
        elif name == "spacing_mm":
            values[name] = tuple(_positive(name, each) for each in _array(name, tree, (2,)).tolist())
        elif isinstance(value, np.ndarray):
            values[name] = _triple(name, value, read_number)
        else:
            values[name] = (_positive if name == "radius_mm" else read_number)(name, value)
    index = read_number("index", tree["index"])
    if not 1.0 <= index <= LARGEST_INDEX:
        raise ValueError(f"the index behind a face is {index:g}, expected 1 to {LARGEST_INDEX:g}")
    return Face(kind(**values), index)


def _array(name: str, tree: dict[str, Any], shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.asarray(tree[name])
    if array.shape != shape or array.dtype.kind not in "fiu" or not (np.abs(array) <= LARGEST_NUMBER).all():
        raise ValueError(f"{name} is {array.tolist()}, expected numbers of the shape {shape}")
    return array.astype(np.float64)


def _triple(name: str, values: Any, kind: Any) -> tuple[Any, Any, Any]:
    if np.shape(values) != (3,):
        raise ValueError(f"{name} has the shape {np.shape(values)}, expected (3,)")
    first, second, third = (kind(name, value.item()) for value in np.asarray(values))
    return first, second, third


def read_number(name: str, value: Any) -> float:
    """Return a number of a file; a `ValueError` says which is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST_NUMBER:
        raise ValueError(f"{name} is {value!r}, expected a number")
    return float(value)


def _positive(name: str, value: Any) -> float:
    if not read_number(name, value) >= SMALLEST_NUMBER:
        raise ValueError(f"{name} is {value!r}, expected {written(SMALLEST_NUMBER)} or more")
    return float(value)


def _whole(name: str, value: Any, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ValueError(f"{name} is {value!r}, expected a whole number from {least} to {most}")
    return value
