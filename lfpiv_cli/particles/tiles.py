"""Particles by tiles of the image, so that threads work on them at once and their number does not matter.

The image is cut into square tiles at least as wide as two footprints. Tiles whose numbers are even along both axes form
one group, and so on: four groups. Particles of different tiles of one group light no common pixel, so a group's tiles
can be worked on at once; within a tile particles follow each other.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.particles.view import View, largest_stretch, lens_on_array_mm, on_array_mm, widest_footprint_mm
from lfpiv_cli.threads import in_threads

# How far a particle may be moved within one sweep, in microlenses: footprints must not grow into other tiles.
LARGEST_MOVE_LENSES = 1.5


def over_tiles(
    work: Callable[[NDArray[np.int64]], None], view: View, points: NDArray[np.float64], depths_mm: tuple[float, float]
) -> None:
    """Call work(numbers) with the particles of each tile, in their order, on all threads: one group after another.

    Parameters
    ----------
    points : (n, 3 or more), image axes
    depths_mm : between which particles stay
    """
    for tiles in groups_of_tiles(view, points, depths_mm):
        in_threads(work, tiles)


def groups_of_tiles(
    view: View, points: NDArray[np.float64], depths_mm: tuple[float, float]
) -> list[list[NDArray[np.int64]]]:
    """Return the numbers of the particles of each tile, for the four groups of tiles."""
    tile = np.floor(on_array_mm(view, points) / tile_side_mm(view, *depths_mm)).astype(np.int64)
    group = tile[:, 0] % 2 + 2 * (tile[:, 1] % 2)
    groups = []
    for number in range(4):
        members = np.flatnonzero(group == number)
        members = members[np.lexsort((members, tile[members, 0], tile[members, 1]))]
        ends = np.flatnonzero(np.any(np.diff(tile[members], axis=0) != 0, axis=1)) + 1
        groups.append([numbers for numbers in np.split(members, ends) if numbers.size])
    return groups


def tile_side_mm(view: View, z_low_mm: float, z_high_mm: float) -> float:
    """Return the side of a tile, on the array: two footprints of particles that move in one sweep."""
    widest = widest_footprint_mm(view, z_low_mm, z_high_mm)
    # Light that touches a lens's cell lands within its micro-image: two cells to each side.
    move = LARGEST_MOVE_LENSES * lens_on_array_mm(view) * largest_stretch(view, z_low_mm, z_high_mm)
    return 2.0 * (widest + 4.0 * max(view.half_x_mm, view.half_y_mm) + move)


def footprint_px(view: View, z_low_mm: float, z_high_mm: float) -> int:
    """Return the side of a square of pixels that holds any particle's footprint."""
    return int(np.ceil(tile_side_mm(view, z_low_mm, z_high_mm) / view.camera.pixel_mm))
