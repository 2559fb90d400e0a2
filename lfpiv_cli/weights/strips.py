"""Weights of a volume in strips of neighbouring voxels, each strip factorised on its own.

Behind a curved window rays do not separate into two axes over the whole volume: along a tube's axis the apparent depth
changes with the distance from it. Within a strip along the axis they do, nearly. The image of a volume is the sum of
the images of its strips, and what an image is spread back to are the strips side by side. All strips together are one
factorised operator whose planes are those of one strip after the other, so the compiled loops are the same.

Axes: volumes [plane, row voxel, column voxel] in the order of the sensor's axes, images [row, column].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.weights.arguments import real_array, voxel_index
from lfpiv_cli.weights.operators import Column, FactorisedOperator


@dataclass(frozen=True, eq=False)
class StripOperator:
    """Weights in strips.

    Attributes
    ----------
    strips : the weights of all strips; plane s * planes + k is plane k of strip s, the last strip filled up with voxels
        without light
    lit : (planes, row voxels, column voxels) which voxels have light: not those outside the fluid
    turned : the strips are of columns of voxels, and rows and columns are exchanged in `strips`, of image and volume
    coupling_mm : how far on the array, rms, traced rays are from those that separate within each strip
    """

    strips: FactorisedOperator
    lit: NDArray[np.bool_]
    turned: bool
    coupling_mm: float

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a volume: (planes, voxels along the rows, voxels along the columns)."""
        planes, rows, columns = self.lit.shape
        return planes, rows, columns

    @property
    def image_shape(self) -> tuple[int, int]:
        """Shape of an image."""
        rows, columns = self.strips.image_shape
        return (columns, rows) if self.turned else (rows, columns)

    def forward(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image (rows, columns) of a volume."""
        volume = real_array(volume, self.shape, "a volume")
        image = self.strips.forward(self.cut(volume * self.lit))
        return np.ascontiguousarray(image.T) if self.turned else image

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the volume that an image is spread back to."""
        image = real_array(image, self.image_shape, "an image")
        strips = self.strips.adjoint(np.ascontiguousarray(image.T) if self.turned else image)
        volume = np.empty(self.shape, np.float32)
        lines = self._in_strips_order(volume)
        height = strips.shape[1]
        for k, strip in enumerate(strips.reshape(-1, len(volume), *strips.shape[1:])):
            part = lines[:, k * height : (k + 1) * height]
            part[:] = strip[:, : part.shape[1]]
        volume *= self.lit
        return volume

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        """Return the rows, columns (int64) and weights (float32) of the pixels that one voxel lights."""
        plane, row_voxel, column_voxel = voxel_index((plane, row_voxel, column_voxel), self.shape)
        if not self.lit[plane, row_voxel, column_voxel]:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32)
        line, along = (column_voxel, row_voxel) if self.turned else (row_voxel, column_voxel)
        strip, within = divmod(line, self.strips.shape[1])
        row, column, weight = self.strips.column(strip * self.shape[0] + plane, within, along)
        if not self.turned:
            return row, column, weight
        order = np.lexsort((row, column))
        return column[order], row[order], weight[order]

    def cut(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a volume as `strips` takes it: (strips * planes, voxels across a strip, voxels along)."""
        lines = self._in_strips_order(volume)
        height, planes = self.strips.shape[1], len(volume)
        found = np.zeros((self.strips.shape[0] // planes, planes, height, lines.shape[2]), np.float32)
        for k, strip in enumerate(found):
            part = lines[:, k * height : (k + 1) * height]
            strip[:, : part.shape[1]] = part
        return found.reshape(-1, *found.shape[2:])

    def _in_strips_order(self, volume: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a view of a volume whose second axis runs across the strips."""
        return volume.swapaxes(1, 2) if self.turned else volume
