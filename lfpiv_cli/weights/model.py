"""Weights as the later stages see them: a grid, an operator, and the way from a raw image into their frame.

Axes: volumes [z, y, x] on `grid`, in the frame that the microlens array is aligned with (`rectified`; `raw` when
nothing had to be undone). `to_world` turns a volume back to the axes of the raw sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.arrays import EVERYWHERE, Floats, Singles
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import ColumnAxis
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.weights.build import default_padding, factorise
from lfpiv_cli.weights.columns import OnDemandOperator
from lfpiv_cli.weights.operators import Column, FactorisedOperator, WeightsOperator, real_array, voxel_index
from lfpiv_cli.weights.strips import StripOperator

if TYPE_CHECKING:
    from lfpiv_cli.calibration.model import Calibration

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights of a volume.

    Attributes
    ----------
    grid : the voxels asked for
    padding_xyz : voxels around them that are solved for as well, because tracers there light the same pixels
    solver_operator : the weights of the padded grid, its lateral axes in the order of the sensor's
    column_axis : world axis along the sensor's columns
    calibration : undoes what keeps a raw image from fitting; None where nothing has to be undone
    scene_distortion_per_mm2 : (nz,) of the planes of `grid`: the operator takes a point at p for one at
        p (1 + k |p|^2), as the main lens's distortion is not in it; None where there is none
    window : rows and columns of the pixels that `prepare` is asked for
    """

    grid: Grid
    padding_xyz: tuple[int, int, int]
    solver_operator: WeightsOperator
    column_axis: ColumnAxis
    calibration: Calibration | None = None
    scene_distortion_per_mm2: Floats | None = None
    window: tuple[slice, slice] = EVERYWHERE

    @classmethod
    def factorised(cls, camera: Camera, media: Media, grid: Grid, calibration: Calibration | None = None) -> Weights:
        """Return weights in factorised form by equivalent ray tracing, padded as far as light spreads.

        Raises
        ------
        ConfigError : the array is hexagonal or turned against the sensor, so that its two axes do not separate
        """
        padding = default_padding(camera, media, grid)
        return cls(grid, padding, factorise(camera, media, grid.padded(padding)), camera.column_axis, calibration)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (z, y, x) of the volume."""
        return self.grid.shape_zyx

    @property
    def image_shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of the images, raw and prepared."""
        return self.solver_operator.image_shape

    @cached_property
    def voxels_outside_fluid(self) -> int:
        """How many voxels of `grid` have no light since they lie outside the fluid, behind curved faces."""
        lit = self.solver_operator.lit if isinstance(self.solver_operator, (StripOperator, OnDemandOperator)) else None
        if lit is None:
            return 0
        return int(np.count_nonzero(~self._to_sensor_order(lit)[self._inner]))

    @property
    def frame(self) -> str:
        """`raw` where images are used as they are, `rectified` where `prepare` moves them into the array's frame."""
        return "raw" if self.calibration is None else "rectified"

    def prepare(self, image: Singles) -> Singles:
        """Take a raw image (rows, columns) to the frame of the weights; of parts, what their voxels light."""
        image = real_array(image, self.image_shape, "an image")
        if self.calibration is None:
            return image.astype(np.float32)
        return self.calibration.rectification.apply(image, self.window)

    def forward(self, volume: Singles) -> Singles:
        """Return the image (rows, columns) that a volume [z, y, x] gives."""
        padded = np.zeros(self.grid.padded(self.padding_xyz).shape_zyx, np.float32)
        padded[self._inner] = real_array(volume, self.shape, "a volume")
        return self.solver_operator.forward(np.ascontiguousarray(self._to_sensor_order(padded)))

    def adjoint(self, image: Singles) -> Singles:
        """Return the volume [z, y, x] that an image is spread back to."""
        image = real_array(image, self.image_shape, "an image")
        volume = self.solver_operator.adjoint(np.asarray(image, dtype=np.float32))
        return np.ascontiguousarray(self._to_sensor_order(volume)[self._inner])

    def column(self, iz: int, iy: int, ix: int) -> Column:
        """Return the rows, columns and weights of the pixels that voxel (iz, iy, ix) lights."""
        iz, iy, ix = voxel_index((iz, iy, ix), self.shape)
        px, py, pz = self.padding_xyz
        row_voxel, column_voxel = (iy + py, ix + px) if self.column_axis == "x" else (ix + px, iy + py)
        return self.solver_operator.column(iz + pz, row_voxel, column_voxel)

    @cached_property
    def padded(self) -> Weights:
        """The same weights on the whole grid that is solved for."""
        if self.padding_xyz == (0, 0, 0):
            return self
        grid = self.grid.padded(self.padding_xyz)
        return Weights(grid, (0, 0, 0), self.solver_operator, self.column_axis, self.calibration)

    def around(self, middle_mm: Floats, reach_mm: float) -> Weights:
        """Return the weights of what of the padded grid lies about a point (x, y), through its whole depth.

        All where they are no two factors.
        """
        operator, grid = self.solver_operator, self.padded.grid
        if not isinstance(operator, FactorisedOperator):
            return self
        steps = (middle_mm - grid.origin_mm[:2]) / grid.spacing_mm[:2]
        reach = reach_mm / np.array(grid.spacing_mm[:2])
        last = np.array(grid.shape_xyz[:2]) - 1
        low, high = np.clip([np.floor(steps - reach), np.ceil(steps + reach)], 0, last).astype(int).tolist()
        x, y = (slice(first, end + 1) for first, end in zip(low, high, strict=True))
        part = operator.part(y, x) if self.column_axis == "x" else operator.part(x, y)
        shape = (x.stop - x.start, y.stop - y.start, grid.shape_xyz[2])
        origin = tuple(grid.voxel_to_mm(np.array([*low, 0.0])).tolist())
        within = Grid(shape, grid.spacing_mm, origin)
        return replace(self, grid=within, padding_xyz=(0, 0, 0), solver_operator=part, window=part.window)

    @property
    def on_demand(self) -> bool:
        """True where columns are made when asked for; solvers then want `for_image`."""
        return isinstance(self.solver_operator, OnDemandOperator)

    def for_image(self, image: Singles) -> Weights:
        """Return the weights to solve one prepared image with: columns on demand are made once and kept.

        Raises
        ------
        InputError : the columns that the image needs do not fit into memory
        """
        if not isinstance(self.solver_operator, OnDemandOperator):
            return self
        return replace(self, solver_operator=self.solver_operator.restricted(image))

    def to_world(self, padded_volume: Singles) -> Singles:
        """Return the volume (z, y, x) on `grid` in world axes, from one on the padded grid in the array's frame.

        A turned array is straightened by turning the image; the volume is turned back here, and the main lens's
        distortion undone, by cubic splines, negative overshoot cut off.
        """
        turning = self.calibration is not None and self.calibration.rectification.rotation_rad != 0.0
        if not turning and self.scene_distortion_per_mm2 is None:
            return np.ascontiguousarray(padded_volume[self._inner])
        y, x = np.meshgrid(self.grid.axis_mm(1), self.grid.axis_mm(0), indexing="ij")
        place = np.stack([x, y], axis=-1)
        if self.calibration is not None:
            place = self.calibration.rectification.from_world(place, self.column_axis)
        radius2 = np.sum(place**2, axis=-1, keepdims=True)
        bends = np.zeros(self.shape[0]) if self.scene_distortion_per_mm2 is None else self.scene_distortion_per_mm2
        grid = self.padded.grid
        pz = self.padding_xyz[2]
        result = np.empty(self.shape, dtype=np.float32)
        for k, bend in enumerate(bends):
            taken = place * (1.0 + bend * radius2)
            at = [(taken[..., axis] - grid.origin_mm[axis]) / grid.spacing_mm[axis] for axis in (1, 0)]
            result[k] = ndimage.map_coordinates(padded_volume[pz + k], at, order=3, mode="nearest")
        return np.maximum(result, 0.0)

    @property
    def _inner(self) -> tuple[slice, slice, slice]:
        """The part of the padded volume that was asked for."""
        (px, py, pz), (nz, ny, nx) = self.padding_xyz, self.shape
        return slice(pz, pz + nz), slice(py, py + ny), slice(px, px + nx)

    def _to_sensor_order(self, volume: NDArray[Scalar]) -> NDArray[Scalar]:
        """Exchange the lateral axes of a volume where the sensor's columns follow world y (its own inverse)."""
        return volume.swapaxes(1, 2) if self.column_axis == "y" else volume
