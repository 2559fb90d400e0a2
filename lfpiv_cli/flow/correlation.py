"""The displacement field between two volumes: coarse to fine, with deformation, validation and replacement.

A coarse pass on binned volumes finds displacements up to a quarter of its windows. Each later pass deforms both
volumes half-way towards each other by what is known, correlates what is left, adds it, and validates. Between passes
outliers are replaced and the field is filtered: without the filter the passes diverge.

Axes: volumes `[z, y, x]`, vectors (u, v, w) along (x, y, z); a particle that moves towards +x has u > 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.flow.deformation import (
    Spline,
    deform_pair,
    expand_lateral,
    resample_field,
    spline_coefficients,
    spline_matrix,
)
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.filtering import smooth_field, unresolved
from lfpiv_cli.flow.maps import correlation_maps, margins, window_sums
from lfpiv_cli.flow.moments import gauss_newton
from lfpiv_cli.flow.outliers import expected_noise, fill_field, validate_vectors
from lfpiv_cli.flow.peaks import Peaks, find_peaks, typical_width
from lfpiv_cli.flow.windows import Triple, WindowLayout, layout_windows
from lfpiv_cli.grid import Grid

# The coarse pass: windows twice the final ones at least (and those that come first), binned to about 16 cells, with
# shifts of up to 4 cells. That is a quarter of the window, beyond which too few particles are in both volumes.
COARSE_FACTOR = 2
COARSE_CELLS = 16
COARSE_RADIUS = 4
# Strong curvature leaves up to two voxels after the coarse pass and after each change of windows; later one is enough.
FIRST_RADIUS = 2
LATER_RADIUS = 1
# Passes with the final windows. With one fewer the borders of sheared flows are a third worse; more only add noise.
FINAL_PASSES = 4
# The last pass looks two voxels far again: one has no room for a second peak.
LAST_RADIUS = 2
# Standard deviation in voxels of a correlation peak from which on an axis counts as elongated and takes Gauss-Newton
# steps. Particles of 1 voxel make peaks of 1.4; three points of a peak of 2.2 span less than a tenth of its height.
ELONGATED_WIDTH = 2.2
# With less of its voxels seen in both volumes a window is masked rather than judged by the few particles in it.
SMALLEST_VALID_FRACTION = 0.25


@dataclass(frozen=True)
class Pass:
    """One pass over the deformed volumes: its windows, how far it looks, and whether its vectors are the result."""

    layout: WindowLayout
    radius: int
    is_last: bool = False


@dataclass(frozen=True, eq=False)
class Pair:
    """Two volumes ready for deformation: their splines, and where both may be used (size 0 for everywhere)."""

    a: Spline
    b: Spline
    mask: NDArray[np.bool_]
    shape_xyz: Triple


@dataclass(frozen=True, eq=False)
class Measured:
    """What one pass measured, at the centres of its windows."""

    raw: NDArray[np.float64]
    displacement: NDArray[np.float64]
    flag: NDArray[np.uint8]
    peaks: Peaks
    valid_fraction: NDArray[np.float64]
    uncertainty: NDArray[np.float64]


def correlate(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    grid: Grid,
    windows: Sequence[Triple],
    overlap: tuple[float, float, float],
    dt_s: float | None,
    mask: NDArray[np.bool_] | None = None,
    progress: Callable[[int], None] | None = None,
    exponent: float = 1.0,
) -> VectorField:
    """Return the displacements from volume `a` to volume `b`.

    Parameters
    ----------
    a, b : (z, y, x) intensities on `grid`; voxels that are not finite are masked
    windows : window sizes in voxels along (x, y, z), coarse to fine; the last one gives the vectors
    overlap : share of a window in common with the next one along (x, y, z), 0 <= overlap < 1
    dt_s : time from `a` to `b`, or None where it is not known
    mask : (z, y, x) True where the volumes are to be used; None for everywhere
    progress : called with 1 after each of `count_passes(windows)` passes
    exponent : power of the intensities that is correlated, 0 < exponent <= 1, negative ones being zero where it is
        below 1. In volumes of a solver that sharpens, as EM does, the brightest particles outweigh all others and are
        narrower than a voxel: the root lets the others speak and makes peaks wide enough to be located. In volumes with
        a noisy background it raises that, and harms.

    Raises
    ------
    InputError
        The volumes or the mask do not have the grid's shape.
    ConfigError
        No window, one smaller than 2 voxels, an overlap outside 0 to 1, or a time or an exponent out of range.
    """
    _check(a, b, grid, windows, overlap, dt_s, mask, exponent)
    report = progress or (lambda units: None)
    usable, a, b = _usable_voxels(a, b, mask)
    a, b = _compressed(a, exponent), _compressed(b, exponent)
    layout, predictor = _coarse_field(a, b, windows, overlap)
    report(1)
    pair = Pair(spline_coefficients(a), spline_coefficients(b), usable, grid.shape_xyz)
    # One BLAS thread: with more, the bits of the predictor would depend on their number.
    with threadpool_limits(1, user_api="blas"):
        for step in _plan(grid.shape_xyz, windows, overlap):
            measured = _refine(pair, _between_layouts(predictor, layout, step.layout), step)
            predictor = smooth_field(fill_field(measured.displacement))
            layout = step.layout
            report(1)
    uncertainty = np.hypot(measured.uncertainty, unresolved(fill_field(measured.displacement)))
    return VectorField(
        grid=layout.grid(grid),
        displacement_voxel=measured.displacement,
        displacement_raw_voxel=measured.raw,
        correlation=measured.peaks.height,
        peak_ratio=measured.peaks.ratio,
        valid_fraction=measured.valid_fraction,
        flag=measured.flag,
        uncertainty_voxel=uncertainty,
        voxel_mm=grid.spacing_mm,
        dt_s=dt_s,
        window_voxel=layout.size,
    )


def count_passes(windows: Sequence[Triple]) -> int:
    """Return how often `correlate` reports progress."""
    return 1 + len(_refined_sizes(windows))


def _check(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    grid: Grid,
    windows: Sequence[Triple],
    overlap: tuple[float, float, float],
    dt_s: float | None,
    mask: NDArray[np.bool_] | None,
    exponent: float,
) -> None:
    """Raise where the arguments of `correlate` do not belong together."""
    for name, array in (("first volume", a), ("second volume", b), ("mask", mask)):
        if array is not None and array.shape != grid.shape_zyx:
            raise InputError(f"the {name} has shape {array.shape} (z, y, x); its grid has {grid.shape_zyx}")
    if not windows or min(min(window) for window in windows) < 2:
        raise ConfigError(f"correlation windows are {list(windows)} voxels; each must be at least 2 along every axis")
    if not all(0.0 <= share < 1.0 for share in overlap):
        raise ConfigError(f"the overlap of the correlation windows is {overlap}; it must be at least 0 and below 1")
    if dt_s is not None and not dt_s > 0.0:
        raise ConfigError(f"the time between the volumes is {dt_s} s; it must be positive")
    if not 0.0 < exponent <= 1.0:
        raise ConfigError(f"the exponent of the correlated intensities is {exponent}; it must be above 0 and at most 1")


def _usable_voxels(
    a: NDArray[np.float32], b: NDArray[np.float32], mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
    """Return where both volumes may be used (size 0 for everywhere), and both with zeros elsewhere."""
    finite = np.isfinite(a) & np.isfinite(b)
    if mask is None and finite.all():
        return np.zeros((0, 0, 0), dtype=np.bool_), a, b
    usable = finite if mask is None else finite & mask
    zero = np.float32(0.0)
    return usable, np.where(usable, a, zero), np.where(usable, b, zero)


def _compressed(volume: NDArray[np.float32], exponent: float) -> NDArray[np.float32]:
    """Return a power of the intensities, zero where they are negative; the volume itself for an exponent of 1."""
    if exponent == 1.0:
        return volume
    return np.power(np.maximum(volume, np.float32(0.0)), np.float32(exponent))


def _refined_sizes(windows: Sequence[Triple]) -> list[Triple]:
    """Return the windows of the passes after the coarse one: each larger one once, the final one `FINAL_PASSES` times.

    Without the first where it is the coarse pass's own: measured again at full resolution it changes no figure.
    """
    larger = windows[1:-1] if len(windows) > 1 and _coarse_size(windows) == windows[0] else windows[:-1]
    return [*larger, *[windows[-1]] * FINAL_PASSES]


def _coarse_size(windows: Sequence[Triple]) -> Triple:
    """Return the windows of the coarse pass in voxels."""
    x, y, z = (max(first, COARSE_FACTOR * last) for first, last in zip(windows[0], windows[-1], strict=True))
    return x, y, z


def _plan(shape_xyz: Triple, windows: Sequence[Triple], overlap: tuple[float, float, float]) -> list[Pass]:
    """Return the passes after the coarse one."""
    sizes = _refined_sizes(windows)
    passes = []
    for number, size in enumerate(sizes):
        changed = number == 0 or size != sizes[number - 1]
        radius = FIRST_RADIUS if changed else LATER_RADIUS
        passes.append(Pass(layout_windows(shape_xyz, size, overlap), radius))
    passes[-1] = Pass(passes[-1].layout, LAST_RADIUS, is_last=True)
    return passes


def _coarse_field(
    a: NDArray[np.float32], b: NDArray[np.float32], windows: Sequence[Triple], overlap: tuple[float, float, float]
) -> tuple[WindowLayout, NDArray[np.float64]]:
    """Return a filled and filtered field of displacements in voxels and the layout of its windows."""
    nz, ny, nx = a.shape
    size = _coarse_size(windows)
    bins = tuple(max(1, round(w / COARSE_CELLS)) for w in size)
    cells = tuple(-(-n // width) for n, width in zip((nx, ny, nz), bins, strict=True))
    binned_size = tuple(max(2, round(w / width)) for w, width in zip(size, bins, strict=True))
    binned = layout_windows(_triple(cells), _triple(binned_size), overlap)
    before, after = margins(binned, _triple(cells[::-1]), COARSE_RADIUS)
    margin = list(zip(before, after, strict=True))
    maps = correlation_maps(
        np.pad(_bin_volume(a, bins), margin), np.pad(_bin_volume(b, bins), margin), binned, before, COARSE_RADIUS
    )
    peaks = find_peaks(maps)
    raw, second = _absolute(peaks, np.zeros(peaks.offset.shape))
    nowhere = np.zeros(peaks.found.shape, dtype=np.bool_)
    displacement, _ = validate_vectors(raw, second, peaks.found, nowhere, expected_noise(peaks.width))
    field = smooth_field(fill_field(displacement)) * np.asarray(bins)
    return _unbinned(binned, bins), field


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


def _unbinned(layout: WindowLayout, bins: tuple[int, ...]) -> WindowLayout:
    """Return a layout of binned cells in voxels."""

    def scaled(triple: Triple) -> Triple:
        return _triple(tuple(n * width for n, width in zip(triple, bins, strict=True)))

    return WindowLayout(scaled(layout.size), scaled(layout.step), layout.count, scaled(layout.first))


def _triple(values: tuple[int, ...]) -> Triple:
    return values[0], values[1], values[2]


def _between_layouts(field: NDArray[np.float64], old: WindowLayout, new: WindowLayout) -> NDArray[np.float64]:
    """Return a field at the centres of other windows."""
    if old == new:
        return field
    along_x, along_y, along_z = (spline_matrix(old.centres_voxel(k), new.centres_voxel(k)) for k in range(3))
    return resample_field(field, (along_x, along_y, along_z))


def _absolute(peaks: Peaks, predictor: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the displacements of the first and the second peak, NaN where there is none."""
    first = np.where(peaks.found[..., np.newaxis], predictor + peaks.offset, np.nan)
    has_second = (peaks.second_height > 0.0)[..., np.newaxis]
    return first, np.where(has_second, predictor + peaks.second_offset, np.nan)


def _refine(pair: Pair, predictor: NDArray[np.float64], step: Pass) -> Measured:
    """Return what is measured in volumes deformed by `predictor`, given at the windows of `step`, in voxels."""
    layout, shape = step.layout, pair.shape_xyz
    before, after = margins(layout, (shape[2], shape[1], shape[0]), step.radius)
    along_x, along_y, along_z = _matrices_to_voxels(layout, shape)
    lateral = expand_lateral(predictor, along_x, along_y)
    a, b, valid = deform_pair(pair.a, pair.b, pair.mask, lateral, along_z, before, after)
    peaks = find_peaks(correlation_maps(a, b, layout, before, step.radius))
    sums = window_sums(valid, layout, before).astype(np.float64)
    valid_fraction = sums.reshape(layout.count_zyx) / float(np.prod(layout.size))
    width = _width_when_sparse(typical_width(peaks.width))
    if step.is_last or np.any(width >= ELONGATED_WIDTH):
        rest, uncertainty = gauss_newton(a, b, valid, layout, before, width / np.sqrt(2.0))
    else:
        rest = uncertainty = np.full(peaks.offset.shape, np.nan)
    raw, second = _absolute(_along_elongated(peaks, rest, width), predictor)
    masked = valid_fraction < SMALLEST_VALID_FRACTION
    displacement, flag = validate_vectors(raw, second, peaks.found, masked, expected_noise(peaks.width))
    uncertainty[~peaks.found | masked] = np.nan
    return Measured(raw, displacement, flag, peaks, valid_fraction, uncertainty)


@lru_cache(maxsize=4)
def _matrices_to_voxels(
    layout: WindowLayout, shape_xyz: Triple
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the spline matrices along x, y, z from window centres to all voxels; most passes have the same ones."""
    along_x, along_y, along_z = (
        spline_matrix(layout.centres_voxel(k), np.arange(shape_xyz[k], dtype=np.float64)) for k in range(3)
    )
    return along_x, along_y, along_z


def _width_when_sparse(width: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the widths of peaks without the pedestal of dense seeding, which widens all axes by about one factor.

    Taken as undiluted where the narrowest is that of particles of up to 1 voxel, which volumes are made for.
    """
    return width * min(1.0, float(np.sqrt(2.0) / width.min()))


def _along_elongated(peaks: Peaks, rest: NDArray[np.float64], width: NDArray[np.float64]) -> Peaks:
    """Return the peaks with Gauss-Newton steps in place of their offsets along elongated axes.

    A step longer than the peak is wide lies outside the range in which the volumes change linearly.
    """
    taken = (width >= ELONGATED_WIDTH) & (np.abs(rest) <= width)
    return replace(peaks, offset=np.where(taken, rest, peaks.offset))
