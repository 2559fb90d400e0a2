"""Factors of weights along one axis, as blocks of strips have them, and how they change from line to line.

Axes: image axes (x along the columns), mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.axis import SMALLEST_SHARE, AxisWeights
from lfpiv_cli.weights.axis_cells import AxisOptics, Cells


class Factor(NamedTuple):
    """Weights along one axis: entries (planes, voxels) of each voxel, and cell and share of each."""

    counts: NDArray[np.int64]
    cell: NDArray[np.int32]
    share: NDArray[np.float32]

    def chosen(self, keep: NDArray[np.bool_]) -> Factor:
        """Return the entries that are kept."""
        first = np.concatenate([[0], np.cumsum(keep)])
        ends = first[np.concatenate([[0], np.cumsum(self.counts)])]
        return Factor(np.diff(ends).reshape(self.counts.shape), self.cell[keep], self.share[keep])

    def scaled(self, voxel_share: NDArray[np.float64]) -> Factor:
        """Return a share of each voxel's light (voxels,), alike in all planes; without entries where it is none."""
        of_entry = np.repeat(np.tile(voxel_share, len(self.counts)), self.counts.ravel())
        scale = of_entry.astype(np.float32).reshape(-1, *[1] * (self.share.ndim - 1))
        return self._replace(share=self.share * scale).chosen(of_entry > 0.0)


def mixed_shares(along_mm: NDArray[np.float64], places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share (n, places) of ascending places in what is mixed linearly at (n,); beyond them the last's."""
    return np.stack([np.interp(along_mm, places_mm, each) for each in np.eye(len(places_mm))], axis=1)


def through_lines(
    weights: AxisWeights, powers: NDArray[np.float64], through: NDArray[np.float64]
) -> tuple[Factor, NDArray[np.float64]]:
    """Return the polynomials (planes, voxels) through the weights on some lines of each plane, and their misfit in L1.

    Parameters
    ----------
    powers, through : (planes, lines, 3) of the lines' places, and (planes, 3, lines) what inverts them
    """
    planes = len(powers)
    room = np.zeros((weights.cell.size, 3), np.float32)
    cell, counts = np.zeros(weights.cell.size, np.int32), np.zeros((planes, weights.voxels), np.int64)
    off = np.zeros((planes, weights.voxels))
    first = weights.start[:: weights.voxels * powers.shape[1]]
    arrays = (weights.start, weights.cell, weights.share, powers, through, cell, room, counts, off)
    share_out(_write_polynomials, planes, first, weights.cells.pixel.size, *arrays)
    kept = np.concatenate([np.arange(first[p], first[p] + counts[p].sum()) for p in range(planes)])
    return Factor(counts, cell[kept], room[kept]), off


@njit(cache=True, nogil=True)
def _write_polynomials(
    part: tuple[int, int],
    first: NDArray[np.int64],
    cells: int,
    start: NDArray[np.int64],
    cell: NDArray[np.int32],
    share: NDArray[np.float32],
    powers: NDArray[np.float64],
    through: NDArray[np.float64],
    found_cell: NDArray[np.int32],
    found: NDArray[np.float32],
    counts: NDArray[np.int64],
    off: NDArray[np.float64],
) -> None:
    """Write what `through_lines` returns for some planes, those of plane p from entry `first[p]` on."""
    lines, voxels = powers.shape[1], counts.shape[1]
    table = np.zeros((cells, lines))
    for plane in range(part[0], part[1]):
        at = first[plane]
        for voxel in range(voxels):
            low, high = cells, 0
            for line in range(lines):
                row = (plane * lines + line) * voxels + voxel
                for k in range(start[row], start[row + 1]):
                    table[cell[k], line] = share[k]
                    low, high = min(low, cell[k]), max(high, cell[k] + 1)
            for k in range(low, high):
                largest = table[k].max()
                if largest > SMALLEST_SHARE:
                    for c in range(3):
                        total = 0.0
                        for line in range(lines):
                            total += through[plane, c, line] * table[k, line]
                        found[at, c] = total
                    for line in range(lines):
                        shown = 0.0
                        for c in range(3):
                            shown += powers[plane, line, c] * found[at, c]
                        off[plane, voxel] += abs(max(shown, 0.0) - table[k, line]) / lines
                    found_cell[at] = k
                    at += 1
                    counts[plane, voxel] += 1
                table[k] = 0.0


def joined(factors: Sequence[Factor], optics: AxisOptics, cells: Cells) -> AxisWeights:
    """Return the weights of all blocks along one axis, the planes of one after the other."""
    counts, cell, share = (np.concatenate([getattr(each, name) for each in factors]) for name in Factor._fields)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return AxisWeights(len(counts), counts.shape[1], optics.pixels, cells, start, cell, share)
