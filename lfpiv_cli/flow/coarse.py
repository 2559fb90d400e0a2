"""The coarse pass: correlation of binned volumes, which finds displacements up to a quarter of its windows.

Axes: volumes `[z, y, x]`, triples and vectors (x, y, z) unless a name says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.flow.filtering import smooth_field
from lfpiv_cli.flow.maps import MapSums, map_sums, margins
from lfpiv_cli.flow.outliers import expected_noise, fill_field, validate_vectors
from lfpiv_cli.flow.peaks import ELONGATED_WIDTH, absolute, find_peaks, typical_width, undiluted
from lfpiv_cli.flow.windows import Triple, WindowLayout, layout_windows

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
    margin = list(zip(before, after, strict=True))
    binned_a, binned_b = (np.pad(_bin_volume(volume, coarse.bins), margin) for volume in (a, b))
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


def _bin_volume(volume: NDArray[np.float32], bins_xyz: tuple[int, ...]) -> NDArray[np.float32]:
    """Return sums over bins, the last ones filled up with zeros, scaled to a largest magnitude of 1."""
    summed = volume
    for axis, width in enumerate(bins_xyz[::-1]):
        short = -summed.shape[axis] % width
        padded = np.pad(summed, [(0, short if k == axis else 0) for k in range(3)])
        shape = (*padded.shape[:axis], padded.shape[axis] // width, width, *padded.shape[axis + 1 :])
        summed = padded.reshape(shape).sum(axis=axis + 1, dtype=np.float64)
    largest = float(np.max(np.abs(summed)))
    return (summed / largest if largest > 0.0 else summed).astype(np.float32)


def _triple(values: tuple[int, ...]) -> Triple:
    return values[0], values[1], values[2]
