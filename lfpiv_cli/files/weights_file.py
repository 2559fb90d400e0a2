"""The weights file: everything that a reconstruction needs besides the images.

Layout, version 4 (HDF5; lengths in mm): `camera` (scalars of `optics.camera.Camera`, `lattice_origin_mm` (2,),
`lattice_basis_mm` (2, 2)), `grid` (`shape_xyz`, `spacing_mm`, `origin_mm`, `padding_xyz`, `reference`,
`scene_distortion_per_mm2` of its planes), `columns` and
`rows` (the per-axis weights: `start`, `cell`, `share`), and `calibration` where one was made. The cells and the
aperture's mask follow from the camera and are computed again on reading.

Where the axes do not separate there is, in place of `columns` and `rows`, `on_demand` (what rays cross: `method`,
`refraction`, refractive indices, window; or the method dlfc alone, whose rays the calibration has), from which columns
are integrated when needed; where rays were counted, `counted` (`start`, `pixel`, `share` of each voxel in the order of
the sensor's axes). `vignetting` (coefficients, see `calibration.white`) scales the pixels on reading.

Behind curved faces `columns` and `rows` are those of strips (`strips`: `lit` of the padded grid, `turned`, `misfit_l1`,
`order`, `block_plane`, `block_planes`, `block_line`, see `weights.strips`), and `on_demand` holds the `faces`; `grid`
says how many voxels lie outside the fluid. Weights of earlier versions are refused: they are to be built again.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.white import vignetting_surface
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import calibration_file
from lfpiv_cli.files.checks import LARGEST_NUMBER, SMALLEST_NUMBER
from lfpiv_cli.files.hdf5 import ensure_format, open_h5, read_provenance, read_tree, write_tree
from lfpiv_cli.files.weights_fields import (
    CAMERA_SCALARS,
    faces_tree,
    read_camera,
    read_face,
    read_grid,
    read_media,
    read_number,
)
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import Refraction, TracedMethod, names_in
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reference import Reference
from lfpiv_cli.simd import COEFFICIENTS
from lfpiv_cli.weights.axis import AxisWeights
from lfpiv_cli.weights.build import axis_optics
from lfpiv_cli.weights.columns import ColumnOperator, OnDemandOperator
from lfpiv_cli.weights.kernels import SLAB, STRIP, Blocks
from lfpiv_cli.weights.lens_cells import AxisOptics, aperture_mask, micro_image_cells
from lfpiv_cli.weights.model import Weights, WeightsOperator, behind_transmission
from lfpiv_cli.weights.operators import BrickOperator, Column, FactorisedOperator
from lfpiv_cli.weights.quadrature import Columns
from lfpiv_cli.weights.scene import Source
from lfpiv_cli.weights.strips import StripOperator

FORMAT = "lfpiv-weights"
VERSION = 4
# Of the arrays whose names do not say them.
NUMBERS = ("start", "cell", "share", "pixel", "vignetting", "lit", "order", "misfit_l1", "normal", "axis")
BLOCKS = [f"block_{name}" for name in Blocks._fields]
UNITS = calibration_file.UNITS | dict.fromkeys((*NUMBERS, *BLOCKS), "1")
UNITS |= dict.fromkeys(("shape_xyz", "padding_xyz"), "voxel")
# Coefficients of `white.vignetting_surface`.
VIGNETTING_SHAPE = (5, 5)


@dataclass(frozen=True, eq=False)
class WeightsFile:
    """Weights with what the file says about them.

    Attributes
    ----------
    weights : ready to use
    camera : the camera they were made for, its lattice in their frame
    reference : the origin of the coordinates of volumes; the weights' own grid counts z from the nominal focal point
    vignetting : of `calibration.transmission`, in the weights once they are read; None where it was not measured
    provenance : record of how the file was made
    """

    weights: Weights
    camera: Camera
    reference: Reference
    provenance: dict[str, Any]
    vignetting: NDArray[np.float64] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (z, y, x) of the volume."""
        return self.weights.shape

    @property
    def image_shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of the images, raw and prepared."""
        return self.weights.image_shape

    @property
    def frame(self) -> str:
        """`raw` where images are used as they are, `rectified` where `prepare` moves them into the array's frame."""
        return self.weights.frame

    def prepare(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take a raw image (rows, columns) to the frame of the weights."""
        return self.weights.prepare(image)

    def forward(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image (rows, columns) that a volume [z, y, x] gives."""
        return self.weights.forward(volume)

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the volume [z, y, x] that an image is spread back to."""
        return self.weights.adjoint(image)

    def column(self, iz: int, iy: int, ix: int) -> Column:
        """Return the rows, columns and weights of the pixels that voxel (iz, iy, ix) lights."""
        return self.weights.column(iz, iy, ix)

    @cached_property
    def passed(self) -> NDArray[np.float32] | None:
        """Share (rows, columns) of the middle's light that reaches each pixel; None where it was not measured."""
        return None if self.vignetting is None else vignetting_surface(self.vignetting, self.image_shape)

    def behind_vignetting(self) -> WeightsFile:
        """Return the same with the vignetting in the weights, as a file has it once it is read."""
        if self.passed is None:
            return self
        operator = behind_transmission(self.weights.solver_operator, self.passed)
        return replace(self, weights=replace(self.weights, solver_operator=operator))


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
            **content.reference.attributes(),
            "scene_distortion_per_mm2": weights.scene_distortion_per_mm2,
            "voxels_outside_fluid": weights.voxels_outside_fluid,
        },
        "vignetting": content.vignetting,
        "calibration": weights.calibration.to_tree() if weights.calibration else None,
    } | _operator_tree(weights.solver_operator)
    made = content.provenance
    write_tree(
        path, tree, format_name=FORMAT, format_version=VERSION, provenance=made, overwrite=overwrite, units=UNITS
    )


def open_weights(path: Path | str) -> WeightsFile:
    """Read a weights file.

    Raises
    ------
    InputError : the file is missing, broken, of another format or version, or contradicts itself.
    """
    path = Path(path)
    tree, provenance = read_tree(path, FORMAT, (VERSION,))
    try:
        camera = read_camera(_group(tree, "camera"))
        grid, padding = read_grid(_group(tree, "grid"))
        calibration = Calibration.from_tree(tree["calibration"]) if tree.get("calibration") else None
        if calibration:
            calibration.ensure_images_of(camera)
        operator = _operator(tree, camera, grid.padded(padding), calibration)
        vignetting = _numbers(tree, "vignetting", VIGNETTING_SHAPE)
        bend = _numbers(tree["grid"], "scene_distortion_per_mm2", (grid.shape_xyz[2],))
        reference = Reference.from_attributes(tree["grid"])
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, MemoryError, InputError) as error:
        raise InputError(f"{path}: not a whole weights file: {error}") from error
    weights = Weights(grid, padding, operator, camera.column_axis, calibration, bend)
    return WeightsFile(weights, camera, reference, provenance, vignetting).behind_vignetting()


def read_weights_record(path: Path) -> dict[str, Any]:
    """Return the record that a weights file carries; the weights themselves are not read.

    Raises
    ------
    InputError : as `open_weights`
    """
    with open_h5(path) as file:
        ensure_format(path, file, FORMAT, (VERSION,))
        return read_provenance(file)


def _group(tree: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a group of a tree."""
    found = tree[name]
    if not isinstance(found, dict):
        raise ValueError(f"{name} is no group")
    return found


def _numbers(tree: dict[str, Any], name: str, shape: tuple[int, ...]) -> NDArray[Any] | None:
    """Return an array of finite numbers of a shape, None where it is missing."""
    found = tree.get(name)
    if found is not None and (np.shape(found) != shape or not np.isfinite(found).all()):
        raise ValueError(f"{name} has the shape {np.shape(found)}, or is not finite; expected {shape}")
    return found


def _operator_tree(operator: WeightsOperator) -> dict[str, Any]:
    """Return the groups that hold an operator."""
    if isinstance(operator, FactorisedOperator):
        return {"columns": _axis_tree(operator.columns), "rows": _axis_tree(operator.rows)}
    if isinstance(operator, ColumnOperator):
        columns = operator.columns
        return {"counted": {"start": columns.start, "pixel": columns.pixel, "share": columns.share}}
    if isinstance(operator, StripOperator):
        strips = {
            "lit": operator.lit.astype(np.uint8),
            "turned": operator.turned,
            "order": operator.order,
            "misfit_l1": operator.misfit_l1,
        }
        strips |= {f"block_{name}": table for name, table in operator.blocks._asdict().items()}
        return {"strips": strips, "columns": _axis_tree(operator.columns), "rows": _axis_tree(operator.rows)}
    if isinstance(operator, BrickOperator):
        raise TypeError("bricks stand for hexagonal cells where particles are looked for, and are not stored")
    space = operator.source
    if isinstance(space, CurvedSpace):
        return {"on_demand": asdict(space.media) | {"method": "ert", "faces": faces_tree(space)}}
    if not isinstance(space, ObjectSpace):
        return {"on_demand": {"method": "dlfc"}}
    tracing = {"method": space.method, "refraction": space.refraction}
    face = None if space.window is None else asdict(space.window)
    return {"on_demand": asdict(space.media) | tracing | {"window_face": face}}


def _operator(tree: dict[str, Any], camera: Camera, grid: Grid, calibration: Calibration | None) -> WeightsOperator:
    """Return the operator of a padded grid from the groups that hold it."""
    nx, ny, nz = grid.shape_xyz
    across, along = (nx, ny) if camera.column_axis == "x" else (ny, nx)
    if "on_demand" in tree:
        return OnDemandOperator(camera, _source(tree["on_demand"], calibration), grid)
    if "counted" in tree:
        columns = _counted(tree["counted"], nx * ny * nz, camera.rows * camera.columns)
        return ColumnOperator((nz, along, across), (camera.rows, camera.columns), np.arange(nx * ny * nz), columns)
    optics = axis_optics(camera)
    if "strips" in tree:
        return _strips(tree, (nz, along, across), camera, optics)
    column_axis = _axis_weights(tree["columns"], nz, across, optics[0])
    row_axis = _axis_weights(tree["rows"], nz, along, optics[1])
    mask = aperture_mask(column_axis.cells, row_axis.cells, camera.aperture_radius_mm)
    return FactorisedOperator(column_axis, row_axis, mask)


def _strips(
    tree: dict[str, Any], shape: tuple[int, int, int], camera: Camera, optics: tuple[AxisOptics, AxisOptics]
) -> StripOperator:
    """Return weights in strips of a volume of `shape` (planes, row voxels, column voxels)."""
    strips = _group(tree, "strips")
    lit, turned, misfit = (strips[name] for name in ("lit", "turned", "misfit_l1"))
    if lit.shape != shape or lit.dtype != np.uint8 or type(turned) is not bool:
        raise ValueError(f"strips of a volume of {lit.shape}, expected {shape}")
    if misfit.ndim != 1 or not np.isfinite(misfit).all():
        raise ValueError("the strips' misfit is not a list of numbers")
    voxels, lines = shape[1:] if turned else shape[:0:-1]
    blocks = _blocks(strips, shape[0], lines)
    planes = int(blocks.planes.sum())
    across, along = optics if turned else optics[::-1]
    by_row = _axis_weights(tree["rows"], planes, STRIP, across)
    by_column = _axis_weights(tree["columns"], planes, voxels, along, COEFFICIENTS)
    mask = aperture_mask(by_column.cells, by_row.cells, camera.aperture_radius_mm)
    order = _order_of_cells(strips, by_column)
    return StripOperator(by_column, by_row, blocks, mask, order, lit.astype(bool), turned, misfit.astype(np.float64))


def _order_of_cells(strips: dict[str, Any], columns: AxisWeights) -> NDArray[np.int32]:
    """Return the order of the column cells, after checking that it has every cell that is lit, and none twice."""
    order = strips["order"]
    if order.ndim != 1 or order.dtype != np.int32 or np.unique(order).size != order.size:
        raise ValueError("the order of the cells is none")
    if (
        not np.isin(columns.cell, order).all()
        or order.min(initial=0) < 0
        or order.max(initial=0) >= columns.cells.pixel.size
    ):
        raise ValueError("the order of the cells misses some")
    return np.asarray(order)


def _blocks(strips: dict[str, Any], planes: int, lines: int) -> Blocks:
    """Return where the blocks of a volume lie, after checking that none leads outside it."""
    blocks = Blocks(*(strips[f"block_{name}"] for name in Blocks._fields))
    if any(each.shape != blocks.plane.shape or each.ndim != 1 or each.dtype != np.int64 for each in blocks):
        raise ValueError("the blocks' tables differ")
    last = blocks.plane + blocks.planes - 1
    if np.any(blocks.plane < 0) or np.any(blocks.planes < 1) or np.any(last >= planes):
        raise ValueError(f"blocks beyond {planes} planes")
    if np.any(blocks.plane // SLAB != last // SLAB) or np.any(blocks.line < 0) or np.any(blocks.line >= lines):
        raise ValueError(f"blocks across slabs, or beyond {lines} lines")
    return blocks


def _source(tree: dict[str, Any], calibration: Calibration | None) -> Source:
    """Return what rays cross, or the calibration's own rays."""
    if tree["method"] == "dlfc":
        if calibration is None or calibration.ray_fit is None:
            raise ValueError("fitted rays are missing")
        return calibration.ray_fit.rays
    media = read_media(tree)
    if "faces" in tree:
        faces = _group(tree, "faces")
        return CurvedSpace(media, tuple(read_face(faces[str(k)]) for k in range(len(faces))))
    face = tree.get("window_face")
    if tree["method"] not in names_in(TracedMethod) or tree["refraction"] not in names_in(Refraction):
        raise ValueError(f"unknown tracing: {tree['method']}, {tree['refraction']}")
    window = Window(**{name: read_number(name, value) for name, value in face.items()}) if face else None
    return ObjectSpace(media, window, tree["refraction"], tree["method"])


def _counted(tree: dict[str, Any], voxels: int, pixels: int) -> Columns:
    """Return counted columns after checking that no index leads outside its array."""
    start, pixel, share = tree["start"], tree["pixel"], tree["share"]
    _ensure_table(start, pixel, voxels, pixels)
    _ensure_shares(share, pixel.shape, signed=False)
    return Columns(start.astype(np.int64), pixel.astype(np.int32), share.astype(np.float32))


def _axis_tree(axis: AxisWeights) -> dict[str, Any]:
    return {"start": axis.start, "cell": axis.cell, "share": axis.share}


def _axis_weights(
    tree: dict[str, Any], planes: int, voxels: int, optics: AxisOptics, coefficients: int = 0
) -> AxisWeights:
    """Return the per-axis weights, or so many coefficients of each, after checking that no index leads outside."""
    cells = micro_image_cells(optics)
    start, cell, share = tree["start"], tree["cell"], tree["share"]
    _ensure_table(start, cell, planes * voxels, cells.pixel.size)
    _ensure_shares(share, (*cell.shape, coefficients) if coefficients else cell.shape, signed=coefficients > 0)
    return AxisWeights(
        planes,
        voxels,
        optics.pixels,
        cells,
        start.astype(np.int64),
        cell.astype(np.int32),
        share.astype(np.float32),
    )


def _ensure_table(start: NDArray[Any], place: NDArray[Any], rows: int, places: int) -> None:
    """Refuse a table whose rows do not follow each other, or that has a cell or pixel outside its array."""
    if start.shape != (rows + 1,) or place.ndim != 1:
        raise ValueError(f"tables of {start.shape} and {place.shape} for {rows} voxels")
    if start[0] != 0 or start[-1] != place.size or np.any(np.diff(start) < 0):
        raise ValueError("the table's rows do not follow each other")
    if place.size and (place.min() < 0 or place.max() >= places):
        raise ValueError(f"cell or pixel {place.min()} or {place.max()} of {places}")


def _ensure_shares(share: NDArray[Any], shape: tuple[int, ...], signed: bool) -> None:
    """Refuse weights that are no numbers, negative where they may not be, or whose sums have no inverse in float32."""
    if share.shape != shape:
        raise ValueError(f"weights of the shape {share.shape}, expected {shape}")
    if not np.all(np.isfinite(share)) or (not signed and share.min(initial=0.0) < 0.0):
        raise ValueError("a weight that is negative or not a number")
    largest = float(np.abs(share).max(initial=0.0))
    if share.size and not SMALLEST_NUMBER <= largest <= LARGEST_NUMBER:
        raise ValueError(
            f"the largest weight is {written(largest)}, expected {SMALLEST_NUMBER:g} to {LARGEST_NUMBER:g}"
        )
