"""The weights file: everything that a reconstruction needs besides the images.

Layout, version 1 (HDF5; lengths in mm): `camera` (scalars of `optics.camera.Camera`, `lattice_origin_mm` (2,),
`lattice_basis_mm` (2, 2)), `grid` (`shape_xyz`, `spacing_mm`, `origin_mm`, `padding_xyz`, `reference`,
`scene_distortion_per_mm2` of its planes), `columns` and
`rows` (the per-axis weights: `start`, `cell`, `share`), and `calibration` where one was made. The cells and the
aperture's mask follow from the camera and are computed again on reading.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.microlenses import Lattice
from lfpiv_cli.weights.aperture import aperture_mask
from lfpiv_cli.weights.axis import AxisOptics, AxisWeights, micro_image_cells
from lfpiv_cli.weights.build import axis_optics
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.operators import FactorisedOperator

FORMAT = "lfpiv-weights"
VERSION = 1

CAMERA_SCALARS = (
    "magnification",
    "focal_length_mm",
    "aperture_mm",
    "microlens_focal_length_mm",
    "microlens_distance_mm",
    "pixel_mm",
    "columns",
    "rows",
    "column_axis",
    "distortion_per_mm2",
)


@dataclass(frozen=True, eq=False)
class WeightsFile:
    """Weights with what the file says about them.

    Attributes
    ----------
    weights : ready to use
    camera : the camera they were made for, its lattice in their frame
    reference : origin of the volume's coordinates, `focal_point` or `mid_plane`
    reference_z_mm : where that origin lies, z from the nominal focal point
    provenance : record of how the file was made
    """

    weights: Weights
    camera: Camera
    reference: str
    reference_z_mm: float
    provenance: dict[str, Any]


def write_weights(path: Path, content: WeightsFile, overwrite: bool) -> None:
    """Write a weights file."""
    weights, camera = content.weights, content.camera
    tree: dict[str, Any] = {
        "camera": {name: getattr(camera, name) for name in CAMERA_SCALARS}
        | {
            "layout": camera.lattice.layout,
            "lattice_origin_mm": camera.lattice.origin,
            "lattice_basis_mm": camera.lattice.basis,
        },
        "grid": {
            "shape_xyz": np.asarray(weights.grid.shape_xyz),
            "spacing_mm": np.asarray(weights.grid.spacing_mm),
            "origin_mm": np.asarray(weights.grid.origin_mm),
            "padding_xyz": np.asarray(weights.padding_xyz),
            "reference": content.reference,
            "reference_z_mm": content.reference_z_mm,
            "scene_distortion_per_mm2": weights.scene_distortion_per_mm2,
        },
        "columns": _axis_tree(weights.solver_operator.columns),
        "rows": _axis_tree(weights.solver_operator.rows),
        "calibration": weights.calibration.to_tree() if weights.calibration else None,
    }
    write_tree(
        path, tree, format_name=FORMAT, format_version=VERSION, provenance=content.provenance, overwrite=overwrite
    )


def read_weights(path: Path) -> WeightsFile:
    """Read a weights file.

    Raises
    ------
    InputError : the file is missing, broken, of another format or version, or contradicts itself.
    """
    tree, provenance = read_tree(path, FORMAT, (VERSION,))
    try:
        camera = _camera(tree["camera"])
        grid = Grid(
            _triple(tree["grid"]["shape_xyz"], int),
            _triple(tree["grid"]["spacing_mm"], float),
            _triple(tree["grid"]["origin_mm"], float),
        )
        padding = _triple(tree["grid"]["padding_xyz"], int)
        calibration = Calibration.from_tree(tree["calibration"]) if tree.get("calibration") else None
        nx, ny, nz = grid.padded(padding).shape_xyz
        across, along = (nx, ny) if camera.column_axis == "x" else (ny, nx)
        optics = axis_optics(camera)
        columns = _axis_weights(tree["columns"], nz, across, optics[0])
        rows = _axis_weights(tree["rows"], nz, along, optics[1])
        bend = tree["grid"].get("scene_distortion_per_mm2")
        if bend is not None and (bend.shape != (grid.shape_xyz[2],) or not np.isfinite(bend).all()):
            raise ValueError(f"a distortion of shape {bend.shape} for {grid.shape_xyz[2]} planes")
        reference, reference_z = str(tree["grid"]["reference"]), float(tree["grid"]["reference_z_mm"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a whole weights file: {error}") from error
    operator = FactorisedOperator(columns, rows, aperture_mask(columns.cells, rows.cells, camera.aperture_radius_mm))
    weights = Weights(grid, padding, operator, camera.column_axis, calibration, bend)
    return WeightsFile(weights, camera, reference, reference_z, provenance)


def open_weights(path: str | Path) -> Weights:
    """Return the weights stored in a file: `shape`, `image_shape`, `prepare`, `forward`, `adjoint`, `column`."""
    return read_weights(Path(path)).weights


def _axis_tree(axis: AxisWeights) -> dict[str, Any]:
    return {"start": axis.start, "cell": axis.cell, "share": axis.share}


def _axis_weights(tree: dict[str, Any], planes: int, voxels: int, optics: AxisOptics) -> AxisWeights:
    """Return the per-axis weights after checking that no index leads outside its array."""
    cells = micro_image_cells(optics)
    start, cell, share = tree["start"], tree["cell"], tree["share"]
    if start.shape != (planes * voxels + 1,) or cell.shape != share.shape or cell.ndim != 1:
        raise ValueError(f"tables of {start.shape} and {cell.shape} for {planes} planes of {voxels} voxels")
    if start[0] != 0 or start[-1] != cell.size or np.any(np.diff(start) < 0):
        raise ValueError("the table's rows do not follow each other")
    if cell.size and (cell.min() < 0 or cell.max() >= cells.pixel.size):
        raise ValueError(f"cell {cell.min()} or {cell.max()} of {cells.pixel.size}")
    if not np.all(np.isfinite(share)) or share.min(initial=0.0) < 0.0:
        raise ValueError("a weight that is negative or not a number")
    return AxisWeights(
        planes,
        voxels,
        optics.pixels,
        cells,
        start.astype(np.int64),
        cell.astype(np.int32),
        share.astype(np.float32),
    )


def _camera(tree: dict[str, Any]) -> Camera:
    lattice = Lattice(tree["lattice_origin_mm"], tree["lattice_basis_mm"], tree["layout"])
    return Camera(lattice=lattice, **{name: tree[name] for name in CAMERA_SCALARS})


def _triple(values: Any, kind: type) -> tuple[Any, Any, Any]:
    first, second, third = (kind(value) for value in values)
    return first, second, third
