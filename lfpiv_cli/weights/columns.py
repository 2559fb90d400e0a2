"""Weights as columns, for cameras whose two axes do not separate: made on demand, or kept for chosen voxels.

`OnDemandOperator` keeps nothing and integrates columns
as they are asked for, a block at a time; `ColumnOperator` keeps those of the voxels that can be lit at all. A column of
Table 2's camera has some 1,500 pixels, 12 kB.

Axes: volumes [plane, row voxel, column voxel] in the order of the sensor's axes, images [row, column].
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.errors import InputError
from lfpiv_cli.grid import Grid
from lfpiv_cli.kernels import njit
from lfpiv_cli.neighbourhoods import with_neighbours
from lfpiv_cli.optics.camera import Camera, nearest_point
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import struck_pixel
from lfpiv_cli.robust import BRIGHTEST_PERCENTILE, LIT_SHARE
from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.build import factorise_through, separates
from lfpiv_cli.weights.operators import Column, FactorisedOperator, WeightsOperator, real_array, voxel_index
from lfpiv_cli.weights.quadrature import DEPTH_NODES, TILES, Columns, integrate_columns
from lfpiv_cli.weights.scene import Scene, Source, kernel_scene, lit_voxels, on_array, on_sensor, rays_from
from lfpiv_cli.weights.strip_blocks import factorise_strips, strips_of, voxel_centres
from lfpiv_cli.weights.strips import StripOperator

# Columns may take this much memory: two thirds of a machine with 24 GiB, the rest is for volumes and images.
LARGEST_BYTES = 16 * 2**30
BYTES_PER_SHARE = 8
# Voxels whose columns are made together.
VOXELS_AT_ONCE = 8192
# Light is added up in this many images side by side, whatever the number of threads, so that the bits are the same.
PARTS = 8
# A voxel can be lit when this share of its lines of sight ends on lit pixels or their neighbours. Noise and a voxel's
# width cost some lines.
SEEN_SHARE = 0.9
# Lines of sight: tiles across the aperture.
SIGHT_TILES = 8
# Voxels along each axis by which a volume is judged to be in view.
SEEN_SAMPLES = 5


class CompressedOperator(WeightsOperator):
    """Weights by columns of voxels; these go by their numbers in a volume read plane by plane and row by row."""

    @abstractmethod
    def parts(self, voxel: Integers) -> Iterator[tuple[Integers, Columns]]:
        """Yield ascending voxels and their columns, part by part: at least those of some that have any."""

    def forward(self, volume: Singles) -> Singles:
        volume = real_array(volume, self.shape, "a volume")
        light, image = np.ascontiguousarray(volume).ravel(), np.zeros(math.prod(self.image_shape), np.float32)
        for voxel, columns in self.parts(np.flatnonzero(light)):
            images = np.zeros((PARTS, image.size), np.float32)
            share_out(_add_parts, PARTS, light[voxel], columns, images)
            image += images.sum(axis=0)
        return image.reshape(self.image_shape)

    def adjoint(self, image: Singles) -> Singles:
        image = real_array(image, self.image_shape, "an image")
        pixels, volume = np.ascontiguousarray(image, dtype=np.float32).ravel(), np.zeros(self.shape, np.float32)
        for voxel, columns in self.parts(np.arange(volume.size)):
            values = np.empty(voxel.size, np.float32)
            share_out(_gather_part, voxel.size, pixels, columns, values)
            volume.ravel()[voxel] = values
        return volume

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        own = np.ravel_multi_index(voxel_index((plane, row_voxel, column_voxel), self.shape), self.shape)
        voxel, columns = next(self.parts(np.array([own])))
        part = slice(*columns.start[np.searchsorted(voxel, [own, own + 1])])
        row, column = np.divmod(columns.pixel[part].astype(np.int64), self.image_shape[1])
        return row, column, columns.share[part]


@dataclass(frozen=True, eq=False)
class ColumnOperator(CompressedOperator):
    """The weights of chosen voxels; the others are dark and stay so.

    Attributes
    ----------
    of_shape, of_image_shape : shapes of volume and image
    voxel : (n,) of the voxels that have columns, ascending
    columns : their columns
    """

    of_shape: tuple[int, int, int]
    of_image_shape: tuple[int, int]
    voxel: Integers
    columns: Columns

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.of_shape

    @property
    def image_shape(self) -> tuple[int, int]:
        return self.of_image_shape

    def behind(self, transmission: Singles) -> ColumnOperator:
        return replace(self, columns=self.columns.dimmed(transmission))

    def parts(self, voxel: Integers) -> Iterator[tuple[Integers, Columns]]:
        """Yield all that there are."""
        yield self.voxel, self.columns


@dataclass(frozen=True, eq=False)
class OnDemandOperator(CompressedOperator):
    """The weights of all voxels of a grid, integrated when asked for.

    Attributes
    ----------
    camera : with any lattice
    source : where rays meet the array
    grid : the voxels, world axes
    transmission : (rows, columns) share of the light that each pixel passes; None for all of it
    """

    camera: Camera
    source: Source
    grid: Grid
    transmission: Singles | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        nz, ny, nx = self.grid.shape_zyx
        return (nz, ny, nx) if self.camera.column_axis == "x" else (nz, nx, ny)

    @property
    def image_shape(self) -> tuple[int, int]:
        return self.camera.rows, self.camera.columns

    def behind(self, transmission: Singles) -> OnDemandOperator:
        return replace(self, transmission=transmission)

    def parts(self, voxel: Integers) -> Iterator[tuple[Integers, Columns]]:
        """Yield those that are asked for, made anew."""
        for first in range(0, voxel.size, VOXELS_AT_ONCE):
            part = voxel[first : first + VOXELS_AT_ONCE]
            yield part, self.columns_of(part)

    def columns_of(self, voxel: Integers) -> Columns:
        """Return the columns of voxels given by their flat indices."""
        if not voxel.size:
            return Columns(np.zeros(1, np.int64), np.zeros(0, np.int32), np.zeros(0, np.float32))
        centres = self.centres_mm(voxel)
        columns = integrate_columns(self.camera, self.source, centres, self.sides_mm, TILES, DEPTH_NODES)
        return columns if self.transmission is None else columns.dimmed(self.transmission)

    def restricted(self, image: Singles) -> ColumnOperator:
        """Return the columns of the voxels that the light of an image can have come from.

        Raises
        ------
        InputError : they would take more than `LARGEST_BYTES`
        """
        voxel = np.flatnonzero(self.can_be_lit(image))
        needed = self._bytes_of(voxel)
        if needed > LARGEST_BYTES:
            raise InputError(
                f"the image can come from {voxel.size} voxels, whose columns would take {needed / 2**30:.0f} GiB, more "
                f"than {LARGEST_BYTES // 2**30}; subtract the background, or take fewer voxels"
            )
        return ColumnOperator(self.shape, self.image_shape, voxel, self.columns_of(voxel))

    def kept(self) -> OnDemandOperator | ColumnOperator:
        """Return the columns of all voxels, made once, for many steps; these weights where those do not fit."""
        voxel = np.arange(int(np.prod(self.shape)))
        if self._bytes_of(voxel) > LARGEST_BYTES:
            return self
        return ColumnOperator(self.shape, self.image_shape, voxel, self.columns_of(voxel))

    def _bytes_of(self, voxel: Integers) -> float:
        """Return what the columns of voxels take, from those of some of them."""
        sample = self.columns_of(voxel[:: max(1, voxel.size // 64)])
        return float(BYTES_PER_SHARE * sample.pixel.size / max(1, sample.start.size - 1) * voxel.size)

    def can_be_lit(self, image: Singles) -> Flags:
        """Return which voxels (flat) see only lit pixels along nearly all their lines of sight."""
        lit = image > LIT_SHARE * np.percentile(image, BRIGHTEST_PERCENTILE)
        near = with_neighbours(lit)
        result = np.empty(int(np.prod(self.shape)), np.bool_)
        for first in range(0, result.size, VOXELS_AT_ONCE * 16):
            part = np.arange(first, min(first + VOXELS_AT_ONCE * 16, result.size))
            scene = kernel_scene(self.camera, self.source, self.centres_mm(part), self.sides_mm, SIGHT_TILES, 1)
            seen = np.empty(part.size)
            share_out(_seen_shares, part.size, scene, near.ravel(), seen)
            result[part] = seen >= SEEN_SHARE
        return result

    @cached_property
    def lit(self) -> Flags | None:
        """Which voxels (planes, row voxels, column voxels) lie in the fluid; None where there are no curved faces."""
        return lit_voxels(self.camera, self.source, self.grid) if isinstance(self.source, CurvedSpace) else None

    @cached_property
    def sides_mm(self) -> Floats:
        """Sides (3,) of a voxel, image axes."""
        return self.camera.to_image_axes(np.asarray(self.grid.spacing_mm))

    def centres_mm(self, voxel: Integers) -> Floats:
        """Return the centres (n, 3) of voxels, image axes."""
        return voxel_centres(self.camera, self.grid, np.stack(np.unravel_index(voxel, self.shape), axis=1))


def operator_of(camera: Camera, source: Source, grid: Grid) -> FactorisedOperator | StripOperator | OnDemandOperator:
    """Return the weights of a grid: factorised where array and rays separate into two axes, else made on demand.

    Behind curved faces they separate in strips at most.

    Raises
    ------
    ConfigError : a voxel lies where it cannot be
    """
    if isinstance(source, CurvedSpace):
        if layout := strips_of(camera, source, grid):
            return factorise_strips(layout.scene)
    elif separates(camera, source, grid):
        return factorise_through(camera, source, grid)
    return OnDemandOperator(camera, source, grid)


def seen_share(camera: Camera, source: Source, grid: Grid) -> tuple[float, float]:
    """Return the smallest and the largest share of a voxel's light that meets the sensor, over a sample of a grid.

    Voxels outside the fluid do not count; where all are, both are 0.
    """
    operator = OnDemandOperator(camera, source, grid)
    places = [np.unique(np.linspace(0, n - 1, SEEN_SAMPLES).round().astype(int)) for n in operator.shape]
    sample = np.ravel_multi_index(tuple(axis.ravel() for axis in np.meshgrid(*places)), operator.shape)
    centres = operator.centres_mm(sample)
    if isinstance(source, CurvedSpace):
        centres = centres[source.slopes(camera, centres, np.zeros((len(centres), 2)))[1]]
        if not len(centres):
            return 0.0, 0.0
    columns = integrate_columns(camera, source, centres, operator.sides_mm, SIGHT_TILES, 1)
    sums = np.array([columns.share[a:b].sum() for a, b in zip(columns.start, columns.start[1:], strict=False)])
    return float(sums.min()), float(sums.max())


@njit(cache=True, nogil=True)
def _add_parts(parts: tuple[int, int], light: Singles, columns: Columns, images: Singles) -> None:
    """Add the light of each of `parts` of the voxels to an image of its own, (PARTS, pixels)."""
    start, pixel, share = columns
    size = -(-light.size // PARTS)
    for part in range(parts[0], parts[1]):
        for n in range(part * size, min((part + 1) * size, light.size)):
            if light[n] != 0.0:
                for at in range(start[n], start[n + 1]):
                    images[part, pixel[at]] += light[n] * share[at]


@njit(cache=True, nogil=True)
def _gather_part(part: tuple[int, int], image: Singles, columns: Columns, values: Singles) -> None:
    """Write for each voxel of `part` the sum of its weights times the pixels."""
    start, pixel, share = columns
    for n in range(part[0], part[1]):
        total = np.float32(0.0)
        for at in range(start[n], start[n + 1]):
            total += share[at] * image[pixel[at]]
        values[n] = total


@njit(cache=True, nogil=True)
def _seen_shares(part: tuple[int, int], scene: Scene, lit: Flags, seen: Floats) -> None:
    """Write the shares (n,) of the lines of sight, among those that meet the sensor, that end on lit pixels.

    Those of voxels `part`; `lit` is flat.
    """
    camera, middle = scene.camera, scene.depth_share.size // 2
    for n in range(part[0], part[1]):
        point, total, found = scene.centres_mm[n], 0.0, 0.0
        rays = rays_from(scene, point, scene.plane[n], middle)
        for t in range(scene.tiles.share.size if rays.shape[1] > 0 else 0):
            crossing = scene.tiles.middle_mm[t]
            x, y = on_array(scene, point, rays, crossing[0], crossing[1])
            distorted = 1.0 + camera.distortion_per_mm2 * (x * x + y * y)
            m_x, m_y = x * distorted, y * distorted
            centre_x, centre_y = nearest_point(m_x, m_y, camera.origin_mm, camera.basis_mm)
            x = on_sensor(camera, x, crossing[0], m_x, centre_x)
            y = on_sensor(camera, y, crossing[1], m_y, centre_y)
            pixel = struck_pixel(camera, x, y)
            if pixel >= 0:
                total += scene.tiles.share[t]
                found += scene.tiles.share[t] * lit[pixel]
        seen[n] = found / total if total > 0.0 else 0.0
