"""Weights of a volume in strips of neighbouring lines of voxels, behind curved faces.

Behind a curved window rays do not separate into two axes over the whole volume: along a tube the apparent depth changes
with the distance from its axis. Each voxel has a product of two factors even so, w = C a b:

- a, along the strip, of the pixel's column, changes with the line within a strip as a polynomial of the second degree;
- b, across the strips, of the pixel's row, is each line's own. Where faces run a little aslant, so that the light of a
  line drifts across the strip, it is mixed linearly from those of two places along the strip, one on either side.

Where the two axes know too much of each other, the light through different parts of the aperture has factors of its
own. What has one pair of factors is a block: up to `SLAB` planes of a strip, a range of voxels along it, or the share
that one place has in them, and the light through a rectangle of the aperture, told by which cells its factors have.

Axes: volumes [plane, row voxel, column voxel] in the order of the sensor's axes, images [row, column].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.weights import kernels
from lfpiv_cli.weights.kernels import PLACES, SLAB, STRIP, Blocks, BlockShape
from lfpiv_cli.weights.operators import Column, SeparatedOperator

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False)
class StripOperator(SeparatedOperator):
    """Weights in strips.

    Attributes
    ----------
    columns, rows : a and b; share (entries, COEFFICIENTS) of the former by the powers of `PLACES`, the latter of the
        `STRIP` lines of each plane
    blocks : where they lie; none crosses a multiple of `SLAB` planes
    order : of the lit column cells
    lit : (planes, row voxels, column voxels) which voxels have light: not those outside the fluid
    turned : the strips are of columns of voxels, and rows and columns of image and volume are exchanged but in `lit`
    misfit_l1 : (samples,) how far columns of a sample of voxels are from those of traced rays, in L1
    """

    blocks: Blocks
    order: NDArray[np.int32]
    lit: Flags
    turned: bool
    misfit_l1: Floats

    @property
    def lit_cells(self) -> NDArray[np.int32]:
        """As they were sorted."""
        return self.order

    @property
    def forward_blocks(self) -> tuple[Blocks, BlockShape]:
        """Parts of strips."""
        return self.blocks, BlockShape(SLAB, STRIP)

    back_blocks = forward_blocks

    @property
    def shape(self) -> tuple[int, int, int]:
        planes, rows, columns = self.lit.shape
        return planes, rows, columns

    @property
    def image_shape(self) -> tuple[int, int]:
        return super().image_shape[::-1] if self.turned else super().image_shape

    def behind(self, transmission: Singles) -> Self:
        return super().behind(np.ascontiguousarray(transmission.T) if self.turned else transmission)

    def _image_of(self, volume: Singles) -> Singles:
        lines = self._as_lines(volume * self.lit)
        image = self.project(kernels.turned(lines, (lines.shape[2], self._height)))
        return np.ascontiguousarray(image.T) if self.turned else image

    def _volume_of(self, image: Singles) -> Singles:
        seen = np.ascontiguousarray(image.T) if self.turned else image
        lines, along = self._as_lines(self.lit).shape[1:]
        volume = self.back_project(seen, (len(self.lit), along, self._height))
        return np.ascontiguousarray(self._as_lines(kernels.turned(volume, (lines, along)))) * self.lit

    def _column_of(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        image = np.zeros(self.image_shape, np.float32)
        seen = image.T if self.turned else image
        line, along = (column_voxel, row_voxel) if self.turned else (row_voxel, column_voxel)
        if self.lit[plane, row_voxel, column_voxel]:
            blocks, first = self.blocks, np.concatenate([[0], np.cumsum(self.blocks.planes)])
            own = (blocks.plane <= plane) & (plane < blocks.plane + blocks.planes)
            own &= (blocks.line <= line) & (line < blocks.line + STRIP)
            for block in np.flatnonzero(own):
                virtual, within = int(first[block] + plane - blocks.plane[block]), int(line - blocks.line[block])
                row, across = self.rows.row(virtual, within)
                column, share = self.columns.row(virtual, along)
                t = PLACES[within]
                shares = np.maximum(share[:, 0] + t * (share[:, 1] + t * share[:, 2]), 0.0)
                by_cell = np.outer(across, shares) * self.mask[np.ix_(row, column)]
                pixels = np.ix_(self.rows.cells.pixel[row], self.columns.cells.pixel[column])
                np.add.at(seen, pixels, by_cell)
        lit = np.nonzero(image)
        return lit[0].astype(np.int64), lit[1].astype(np.int64), image[lit]

    def _as_lines(self, volume: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return a view of a volume whose second axis runs across the strips; its own inverse."""
        return volume.swapaxes(1, 2) if self.turned else volume

    @cached_property
    def _height(self) -> int:
        """Lines with those that the last strip has beyond the volume."""
        return int(max(self.blocks.line.max(initial=0) + STRIP, self._as_lines(self.lit).shape[1]))
