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

import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.white import vignetting_surface
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import calibration_file, checks, sections
from lfpiv_cli.files.checks import LARGEST_NUMBER, SMALLEST_NUMBER
from lfpiv_cli.files.hdf5 import open_h5, read_provenance, read_tree, write_tree
from lfpiv_cli.files.inputs import physical_memory
from lfpiv_cli.files.sections import Index, Pair, Pixels, Section, Vector, Voxels, WindowSection, scene_of
from lfpiv_cli.files.yaml_nodes import Document, problem_of
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.names import ColumnAxis, Layout, Refraction, TracedMethod
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.surfaces import SURFACES
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.results import Result
from lfpiv_cli.simd import COEFFICIENTS
from lfpiv_cli.weights.axis import AxisWeights
from lfpiv_cli.weights.columns import ColumnOperator, OnDemandOperator
from lfpiv_cli.weights.kernels import SLAB, STRIP, Blocks
from lfpiv_cli.weights.lens_cells import AxisOptics, aperture_mask, axis_optics, micro_image_cells
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.operators import Column, FactorisedOperator, SeparatedOperator, WeightsOperator
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
# A kernel holds a volume, its padding, what it is made from, and as many numbers of each pixel.
BYTES_A_VOXEL, BYTES_A_PIXEL = 8, 8
# A basis whose vectors are nearly parallel is of no array: hexagons have 0.87.
LEAST_SINE = 0.5


# The camera, the grid and what rays cross, believed only as far as a config would be.
Size = Annotated[float, Field(ge=SMALLEST_NUMBER)]
Padding = Annotated[int, Field(ge=0, le=sections.MOST_VOXELS_PER_SIDE)]


class StoredCamera(Section):
    """The group `camera`, in the order of the file."""

    magnification: Annotated[float, Field(le=-SMALLEST_NUMBER)]
    focal_length_mm: Size
    aperture_mm: Size
    microlens_focal_length_mm: Size
    microlens_distance_mm: Size
    pixel_mm: Size
    entrance_over_exit: Size
    columns: Pixels
    rows: Pixels
    column_axis: ColumnAxis
    distortion_per_mm2: float
    layout: Layout
    lattice_origin_mm: Pair
    lattice_basis_mm: tuple[Pair, Pair]


class StoredGrid(Section):
    """What the group `grid` says of voxels."""

    shape_xyz: tuple[Voxels, Voxels, Voxels]
    spacing_mm: tuple[Size, Size, Size]
    origin_mm: Vector
    padding_xyz: tuple[Padding, Padding, Padding]


class StoredSpace(Section):
    """What the group `on_demand` says of what rays cross: the faces of a scene, or plane layers."""

    air: Index
    window: Index
    fluid: Index
    faces: tuple[sections.FaceSection, ...] | None = None
    method: TracedMethod
    refraction: Refraction
    window_face: WindowSection | None = None


Stored = TypeVar("Stored", bound=Section)


@dataclass(frozen=True, eq=False, repr=False)
class WeightsFile(Result):
    """Weights with what the file says about them.

    Attributes
    ----------
    weights : ready to use
    camera : the camera they were made for, its lattice in their frame
    reference : the origin of the coordinates of volumes; the weights' own grid counts z from the nominal focal point
    vignetting : of `calibration.transmission`, in the weights once they are read; None where it was not measured
    provenance : record of how the file was made
    stored : the weights without the vignetting, as a file holds them; None where `weights` are
    """

    weights: Weights
    camera: Camera
    reference: Reference
    provenance: dict[str, Any]
    vignetting: NDArray[np.float64] | None = None
    stored: WeightsOperator | None = None

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
        bare = self.weights.solver_operator
        behind = replace(self.weights, solver_operator=bare.behind(self.passed))
        return replace(self, weights=behind, stored=bare)


def write_weights(path: Path, content: WeightsFile, overwrite: bool) -> None:
    """Write a weights file."""
    weights, lattice = content.weights, content.camera.lattice
    arrays = {"lattice_origin_mm": lattice.origin, "lattice_basis_mm": lattice.basis, "layout": lattice.layout}
    tree: dict[str, Any] = {
        "camera": {
            name: arrays[name] if name in arrays else getattr(content.camera, name)
            for name in StoredCamera.model_fields
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
        "calibration": calibration_file.tree_of(weights.calibration) if weights.calibration else None,
    } | _operator_tree(content.stored or weights.solver_operator)
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
    tree, provenance = read_tree(path, FORMAT, VERSION)
    try:
        camera = _camera(_stored(StoredCamera, tree["camera"]))
        reported = _stored(StoredGrid, tree["grid"])
        grid, padding = Grid(reported.shape_xyz, reported.spacing_mm, reported.origin_mm), reported.padding_xyz
        voxels = math.prod(grid.padded(padding).shape_xyz)
        if BYTES_A_VOXEL * voxels > physical_memory():
            raise ValueError(f"{voxels} voxels do not fit into memory")
        calibration = calibration_file.calibration_of(tree["calibration"]) if tree.get("calibration") else None
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
    """Return the record that a weights file carries; the weights themselves are not read."""
    with open_h5(path, FORMAT, VERSION) as file:
        return read_provenance(file)


def _stored(kind: type[Stored], group: Any) -> Stored:
    """Return what a group says of a kind; what is missing, or nothing that it could have, is a `ValueError`."""
    if not isinstance(group, dict):
        raise ValueError("a group is missing")
    plain = {name: _plain(name, group[name]) for name in kind.model_fields if group.get(name) is not None}
    try:
        return kind.model_validate(plain)
    except ValidationError as error:
        problem = problem_of(Document(data=plain), error.errors()[0])
        raise ValueError(f"{problem.key}: {problem.message}") from error


def _plain(name: str, value: Any) -> Any:
    """Return arrays as tuples, as sections have them, and numbers up to the largest that a config may have."""
    if isinstance(value, dict):
        return {each: _plain(each, item) for each, item in value.items()}
    items = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(items, (list, tuple)):
        return tuple(_plain(name, item) for item in items)
    if isinstance(items, (int, float)) and not abs(items) <= LARGEST_NUMBER:
        raise ValueError(f"{name} is {items!r}, expected a number of at most {written(LARGEST_NUMBER)}")
    return items


def _numbers(tree: dict[str, Any], name: str, shape: tuple[int, ...]) -> NDArray[Any] | None:
    """Return an array of finite numbers of a shape, None where it is missing."""
    found = tree.get(name)
    if found is not None and (np.shape(found) != shape or not np.isfinite(found).all()):
        raise ValueError(f"{name} has the shape {np.shape(found)}, or is not finite; expected {shape}")
    return found


def _operator_tree(operator: WeightsOperator) -> dict[str, Any]:
    """Return the groups that hold an operator."""
    if isinstance(operator, ColumnOperator):
        columns = operator.columns
        return {"counted": {"start": columns.start, "pixel": columns.pixel, "share": columns.share}}
    axes: dict[str, Any] = {}
    if isinstance(operator, SeparatedOperator):
        for name, axis in (("columns", operator.columns), ("rows", operator.rows)):
            axes[name] = {"start": axis.start, "cell": axis.cell, "share": axis.share}
    if isinstance(operator, FactorisedOperator):
        return axes
    if isinstance(operator, StripOperator):
        strips = {
            "lit": operator.lit.astype(np.uint8),
            "turned": operator.turned,
            "order": operator.order,
            "misfit_l1": operator.misfit_l1,
        }
        strips |= {f"block_{name}": table for name, table in operator.blocks._asdict().items()}
        return {"strips": strips} | axes
    if not isinstance(operator, OnDemandOperator):
        raise TypeError("bricks stand for hexagonal cells where particles are looked for, and are not stored")
    space = operator.source
    if isinstance(space, CurvedSpace):
        kinds = {surface: kind for kind, surface in SURFACES.items()}
        faces: dict[str, dict[str, Any]] = {}
        for k, face in enumerate(space.faces):  # numbered from the camera on
            faces[str(k)] = {"kind": kinds[type(face.surface)], "index": face.index}
            for name, value in asdict(face.surface).items():  # type: ignore[call-overload]
                faces[str(k)][name] = np.asarray(value, dtype=np.float64) if isinstance(value, tuple) else value
        return {"on_demand": asdict(space.media) | {"method": "ert", "faces": faces}}
    if not isinstance(space, ObjectSpace):
        return {"on_demand": {"method": "dlfc"}}
    tracing = {"method": space.method, "refraction": space.refraction}
    window = None if space.window is None else asdict(space.window)
    return {"on_demand": asdict(space.media) | tracing | {"window_face": window}}


def _operator(tree: dict[str, Any], camera: Camera, grid: Grid, calibration: Calibration | None) -> WeightsOperator:
    """Return the operator of a padded grid from the groups that hold it."""
    nx, ny, nz = grid.shape_xyz
    across, along = (nx, ny) if camera.column_axis == "x" else (ny, nx)
    if "on_demand" in tree:
        return OnDemandOperator(camera, _source(tree["on_demand"], calibration), grid)
    if "counted" in tree:
        columns = Columns(*_table(tree["counted"], "pixel", nx * ny * nz, camera.rows * camera.columns))
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
    strips = tree["strips"]
    lit, turned, misfit = (strips[name] for name in ("lit", "turned", "misfit_l1"))
    if lit.shape != shape or lit.dtype != np.uint8 or type(turned) is not bool:
        raise ValueError(f"strips of a volume of {lit.shape}, expected {shape}")
    if misfit.ndim != 1 or not np.isfinite(misfit).all():
        raise ValueError("the strips' misfit is not a list of numbers")
    voxels, lines = shape[1:] if turned else shape[:0:-1]
    blocks = Blocks(*(strips[f"block_{name}"] for name in Blocks._fields))
    if any(each.shape != blocks.plane.shape or each.ndim != 1 or each.dtype != np.int64 for each in blocks):
        raise ValueError("the blocks' tables differ")
    last = blocks.plane + blocks.planes - 1
    if np.any(blocks.plane < 0) or np.any(blocks.planes < 1) or np.any(last >= shape[0]):
        raise ValueError(f"blocks beyond {shape[0]} planes")
    if np.any(blocks.plane // SLAB != last // SLAB) or np.any(blocks.line < 0) or np.any(blocks.line >= lines):
        raise ValueError(f"blocks across slabs, or beyond {lines} lines")

    planes = int(blocks.planes.sum())
    across, along = optics if turned else optics[::-1]
    by_row = _axis_weights(tree["rows"], planes, STRIP, across)
    by_column = _axis_weights(tree["columns"], planes, voxels, along, COEFFICIENTS)
    mask = aperture_mask(by_column.cells, by_row.cells, camera.aperture_radius_mm)
    # The column cells in an order that has every one that is lit, and none twice.
    order = np.asarray(strips["order"])
    if order.ndim != 1 or order.dtype != np.int32 or np.unique(order).size != order.size:
        raise ValueError("the order of the cells is none")
    is_whole = np.isin(by_column.cell, order).all() and order.min(initial=0) >= 0
    if not is_whole or order.max(initial=0) >= by_column.cells.pixel.size:
        raise ValueError("the order of the cells misses some")
    return StripOperator(by_column, by_row, mask, blocks, order, lit.astype(bool), turned, misfit.astype(np.float64))


def _source(tree: dict[str, Any], calibration: Calibration | None) -> Source:
    """Return what rays cross, or the calibration's own rays."""
    if tree["method"] == "dlfc":
        if calibration is None or calibration.ray_fit is None:
            raise ValueError("fitted rays are missing")
        return calibration.ray_fit.rays
    if "faces" in tree:
        numbered = [dict(tree["faces"][str(k)]) for k in range(len(tree["faces"]))]  # from the camera on
        faces = tuple(face | {"behind": face.pop("index")} for face in numbered)
        tree = tree | {"faces": faces, "refraction": "exact"}
    reported = _stored(StoredSpace, tree)
    media = Media(reported.air, reported.window, reported.fluid)
    if reported.faces is not None:
        return scene_of(reported.faces, media)
    window = None if reported.window_face is None else Window(**reported.window_face.model_dump())
    return ObjectSpace(media, window, reported.refraction, reported.method)


def _axis_weights(
    tree: dict[str, Any], planes: int, voxels: int, optics: AxisOptics, coefficients: int = 0
) -> AxisWeights:
    """Return the per-axis weights, or so many coefficients of each."""
    cells = micro_image_cells(optics)
    table = _table(tree, "cell", planes * voxels, cells.pixel.size, coefficients)
    return AxisWeights(planes, voxels, optics.pixels, cells, *table)


def _table(
    tree: dict[str, Any], name: str, rows: int, places: int, coefficients: int = 0
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """Return where the rows of a table of weights begin, the cell or pixel of each weight, and the weights.

    Refused are rows that do not follow each other, places outside their array, and weights that are no numbers,
    negative where they are no coefficients, or whose sums have no inverse in float32.
    """
    start, place, share = tree["start"], tree[name], tree["share"]
    if start.shape != (rows + 1,) or place.ndim != 1:
        raise ValueError(f"tables of {start.shape} and {place.shape} for {rows} voxels")
    if start[0] != 0 or start[-1] != place.size or np.any(np.diff(start) < 0):
        raise ValueError("the table's rows do not follow each other")
    if place.size and (place.min() < 0 or place.max() >= places):
        raise ValueError(f"cell or pixel {place.min()} or {place.max()} of {places}")
    shape = (*place.shape, coefficients) if coefficients else place.shape
    if share.shape != shape:
        raise ValueError(f"weights of the shape {share.shape}, expected {shape}")
    if not np.all(np.isfinite(share)) or (not coefficients and share.min(initial=0.0) < 0.0):
        raise ValueError("a weight that is negative or not a number")
    largest = float(np.abs(share).max(initial=0.0))
    if share.size and not SMALLEST_NUMBER <= largest <= LARGEST_NUMBER:
        raise ValueError(
            f"the largest weight is {written(largest)}, expected {SMALLEST_NUMBER:g} to {LARGEST_NUMBER:g}"
        )
    return start.astype(np.int64), place.astype(np.int32), share.astype(np.float32)


def _camera(reported: StoredCamera) -> Camera:
    """Return the camera of a weights file, if its lens images can be told apart and its images fit into memory."""
    if BYTES_A_PIXEL * reported.columns * reported.rows > physical_memory():
        raise ValueError(f"{reported.columns} x {reported.rows} pixels do not fit into memory")
    lattice = Lattice(np.array(reported.lattice_origin_mm), np.array(reported.lattice_basis_mm), reported.layout)
    if not lattice.cell_area >= LEAST_SINE * math.prod(lattice.pitch):
        raise ValueError(f"the lattice's basis {reported.lattice_basis_mm} is of no array of lenses")
    camera = Camera(lattice=lattice, **reported.model_dump(exclude={"layout", "lattice_origin_mm", "lattice_basis_mm"}))
    pitch_px = camera.lattice.pitch / camera.pixel_mm
    if not (pitch_px.min() >= checks.FEWEST_PIXELS_A_LENS and pitch_px.max() <= checks.MOST_PIXELS_A_LENS):
        raise ValueError(f"its lens images are {pitch_px.tolist()} px apart")
    for fault in checks.lens_image_faults(camera):
        raise ValueError(fault[1])
    return camera
