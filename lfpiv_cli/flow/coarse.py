"""The coarse pass: correlation of binned volumes, which finds displacements up to a quarter of its windows.

Axes: volumes `[z, y, x]`, triples and vectors (x, y, z) unless a name says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.flow.filtering import smooth_field
from lfpiv_cli.flow.maps import MapSums, map_sums, margins
from lfpiv_cli.flow.outliers import expected_noise, fill_field, validate_vectors
from lfpiv_cli.flow.peaks import ELONGATED_WIDTH, absolute, find_peaks, typical_width, undiluted
from lfpiv_cli.flow.windows import Triple, WindowLayout, layout_windows
from lfpiv_cli.threads import share_out

# The coarse pass: windows twice the final ones at least (and those that come first), binned to about 16 cells, with
# shifts of up to 4 cells. That is a quarter of the window, beyond which too few particles are in both volumes.
COARSE_FACTOR = 2
COARSE_CELLS = 16
COARSE_RADIUS = 4


def coarse_size(windows: Sequence[Triple]) -> Triple:
    """Return the windows of the coarse pass in voxels."""
    x, y, z = (max(first, COARSE_FACTOR * last) for first, last in zip(windows[0], windows[-1], strict=True))
    return x, y, z


def _check_windows(windows: Sequence[Triple], overlap: tuple[float, float, float]) -> None:
    """Raise where windows cannot be."""
    if not windows or min(min(window) for window in windows) < 2:
        raise ConfigError(f"correlation windows are {list(windows)} voxels; each must be at least 2 along every axis")
    if not all(0.0 <= share < 1.0 for share in overlap):
        raise ConfigError(f"the overlap of the correlation windows is {overlap}; it must be at least 0 and below 1")


@dataclass(frozen=True)
class CoarseLayout:
    """The windows of the coarse pass, in cells of `bins` voxels along (x, y, z)."""

    binned: WindowLayout
    bins: Triple
    cells_zyx: Triple

    @property
    def in_voxels(self) -> WindowLayout:
        """The same windows in voxels."""

        def scaled(triple: Triple) -> Triple:
            return _triple(tuple(n * width for n, width in zip(triple, self.bins, strict=True)))

        layout = self.binned
        return WindowLayout(scaled(layout.size), scaled(layout.step), layout.count, scaled(layout.first))


def coarse_layout(shape_xyz: Triple, windows: Sequence[Triple], overlap: tuple[float, float, float]) -> CoarseLayout:
    """Return the windows of the coarse pass."""
    _check_windows(windows, overlap)
    size = coarse_size(windows)
    bins = tuple(max(1, round(w / COARSE_CELLS)) for w in size)
    cells = tuple(-(-n // width) for n, width in zip(shape_xyz, bins, strict=True))
    binned_size = tuple(max(2, round(w / width)) for w, width in zip(size, bins, strict=True))
    return CoarseLayout(
        layout_windows(_triple(cells), _triple(binned_size), overlap), _triple(bins), _triple(cells[::-1])
    )


def coarse_sums(a: NDArray[np.float32], b: NDArray[np.float32], coarse: CoarseLayout) -> MapSums:
    """Return what the correlation of two volumes is made of after binning."""
    before, after = margins(coarse.binned, coarse.cells_zyx, COARSE_RADIUS)
    binned_a, binned_b = (bin_volume(volume, coarse, before, after) for volume in (a, b))
    return map_sums(binned_a, binned_b, coarse.binned, before, COARSE_RADIUS)


def coarse_field(sums: MapSums, coarse: CoarseLayout) -> tuple[NDArray[np.float64], bool]:
    """Return a filled and filtered field of displacements in voxels, and whether particle images are long."""
    peaks = find_peaks(sums.correlation())
    raw, second = absolute(peaks, np.zeros(peaks.offset.shape))
    nowhere = np.zeros(peaks.found.shape, dtype=np.bool_)
    displacement, _ = validate_vectors(raw, second, peaks.found, nowhere, expected_noise(peaks.width))
    width = undiluted(typical_width(peaks.width) * np.asarray(coarse.bins))
    is_elongated = bool(np.any(width >= ELONGATED_WIDTH))
    return smooth_field(fill_field(displacement), is_elongated) * np.asarray(coarse.bins), is_elongated


def bin_volume(volume: NDArray[np.float32], coarse: CoarseLayout, before: Triple, after: Triple) -> NDArray[np.float32]:
    """Return sums over bins, scaled to a largest magnitude of 1, with margins of zeros; the last bins may be cut."""
    padded = tuple(m + n + k for m, n, k in zip(before, coarse.cells_zyx, after, strict=True))
    sums = np.zeros(padded, dtype=np.float32)
    inside = tuple(slice(m, m + n) for m, n in zip(before, coarse.cells_zyx, strict=True))
    share_out(sum_bins, coarse.cells_zyx[0], volume, coarse.bins[::-1], sums[inside])
    largest = float(max(np.max(sums), -np.min(sums)))
    if largest > 0.0:
        sums *= np.float32(1.0 / largest)
    return sums


@njit(cache=True, nogil=True)
def sum_bins(part: tuple[int, int], volume: NDArray[np.float32], bins: Triple, sums: NDArray[np.float32]) -> None:
    """Write sums over bins of `bins` voxels along (z, y, x), planes `part` of them."""
    for cell_z in range(part[0], part[1]):
        line = np.empty(volume.shape[2])
        for cell_y in range(sums.shape[1]):
            line[:] = 0.0
            for z in range(cell_z * bins[0], min((cell_z + 1) * bins[0], volume.shape[0])):
                for y in range(cell_y * bins[1], min((cell_y + 1) * bins[1], volume.shape[1])):
                    row = volume[z, y]
                    for x in range(row.size):
                        line[x] += row[x]
            for cell_x in range(sums.shape[2]):
                total = 0.0
                for x in range(cell_x * bins[2], min((cell_x + 1) * bins[2], line.size)):
                    total += line[x]
                sums[cell_z, cell_y, cell_x] = total


def _triple(values: tuple[int, ...]) -> Triple:
    return values[0], values[1], values[2]
