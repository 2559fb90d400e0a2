"""Particles by tiles of the image, so that threads work on them at once and their number does not matter.

The image is cut into square tiles at least as wide as two footprints. Tiles whose numbers are even along both axes form
one group, and so on: four groups. Particles of different tiles of one group light no common pixel, so a group's tiles
can be worked on at once; within a tile particles follow each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.particles.view import View, footprint_radius_mm, on_array_mm

# How far a particle may be moved within one sweep, on the array: footprints must not grow into other tiles.
LARGEST_MOVE_MM = 0.15


class Tiles(NamedTuple):
    """Particles by tile.

    Attributes
    ----------
    order : (n,) particle numbers, tile by tile, in the order given within each
    start : (tiles + 1,) where each tile begins in `order`
    groups : (5,) where each of the four groups of tiles begins
    """

    order: NDArray[np.int64]
    start: NDArray[np.int64]
    groups: NDArray[np.int64]


def share_out(view: View, points: NDArray[np.float64], z_low_mm: float, z_high_mm: float) -> Tiles:
    """Return the tiles of particles (n, 3 or more), image axes, whose depths stay between two limits."""
    side = tile_side_mm(view, z_low_mm, z_high_mm)
    tile = np.floor(on_array_mm(view, points) / side).astype(np.int64)
    group = tile[:, 0] % 2 + 2 * (tile[:, 1] % 2)
    order = np.lexsort((np.arange(len(points)), tile[:, 0], tile[:, 1], group))
    keys = np.column_stack([group, tile])[order]
    begins = np.ones(len(points), dtype=bool)
    begins[1:] = np.any(keys[1:] != keys[:-1], axis=1)
    start = np.flatnonzero(begins)
    groups = np.searchsorted(keys[start, 0], np.arange(5))
    return Tiles(order, np.append(start, len(points)).astype(np.int64), groups.astype(np.int64))


def tile_side_mm(view: View, z_low_mm: float, z_high_mm: float) -> float:
    """Return the side of a tile, on the array: two footprints of particles that move in one sweep."""
    widest = float(footprint_radius_mm(view, np.linspace(z_low_mm, z_high_mm, 11)).max())
    # Light that touches a lens's cell lands within its micro-image: two cells to each side.
    return 2.0 * (widest + 4.0 * max(view.half_x_mm, view.half_y_mm) + LARGEST_MOVE_MM)


def footprint_px(view: View, z_low_mm: float, z_high_mm: float) -> int:
    """Return the side of a square of pixels that holds any particle's footprint."""
    return int(np.ceil(tile_side_mm(view, z_low_mm, z_high_mm) / view.camera.pixel_mm))
