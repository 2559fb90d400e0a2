"""The displacement field between two volumes: coarse to fine, with deformation, validation and replacement.

A coarse pass on binned volumes finds displacements up to a quarter of its windows. Each later pass deforms both
volumes half-way towards each other by what is known, correlates what is left, adds it, and validates. Between passes
outliers are replaced and the field is filtered: without the filter the passes diverge.

Axes: volumes `[z, y, x]`, vectors (u, v, w) along (x, y, z); a particle that moves towards +x has u > 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.flow import outliers
from lfpiv_cli.flow.deformation import Spline, deform_pair, matrices_to_voxels, spline_coefficients, spline_matrix
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.moments import MOMENTS, gauss_newton, pair_moments
from lfpiv_cli.flow.peaks import ELONGATED_WIDTH, Peaks, absolute, find_peaks, typical_width, undiluted
from lfpiv_cli.flow.sums import MapSums, map_sums, margins, valid_shares
from lfpiv_cli.flow.windows import CorrelationSettings, Triple, WindowLayout, cells_of, triple
from lfpiv_cli.grid import Grid
from lfpiv_cli.kernels import njit
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


@dataclass(frozen=True)
class Coarse:
    """The windows of the coarse pass, in cells of `bins` voxels along (x, y, z)."""

    layout: WindowLayout
    bins: Triple
    cells_zyx: Triple

    @classmethod
    def over(cls, shape_xyz: Triple, settings: CorrelationSettings) -> Coarse:
        """Return the windows that fill a volume of so many voxels."""
        size = coarse_size(settings.windows)
        bins = triple(max(1, round(w / COARSE_CELLS)) for w in size)
        cells = triple(-(-n // width) for n, width in zip(shape_xyz, bins, strict=True))
        binned_size = triple(max(2, round(w / width)) for w, width in zip(size, bins, strict=True))
        return cls(settings.layout(cells, binned_size), bins, cells[::-1])

    def sums(self, volumes: Iterable[Singles]) -> MapSums:
        """Return what the correlation of two volumes is made of after binning."""
        before, after = margins(self.layout, self.cells_zyx, COARSE_RADIUS)
        inside = tuple(slice(m, m + n) for m, n in zip(before, self.cells_zyx, strict=True))
        binned = []
        for volume in volumes:
            # Scaled to a largest magnitude of 1, with margins of zeros; the last bins may be cut.
            sums = np.zeros(np.add(np.add(before, self.cells_zyx), after), dtype=np.float32)
            share_out(sum_bins, self.cells_zyx[0], volume, self.bins[::-1], sums[inside])
            largest = float(max(np.max(sums), -np.min(sums)))
            if largest > 0.0:
                sums *= np.float32(1.0 / largest)
            binned.append(sums)
        return map_sums(binned[0], binned[1], self.layout, before, COARSE_RADIUS)

    def field(self, sums: MapSums) -> tuple[Floats, WindowLayout, bool]:
        """Return a filled and filtered field, its windows, both in voxels, and whether particle images are long."""
        peaks = find_peaks(sums.correlation())
        raw, second = absolute(peaks, np.zeros(peaks.offset.shape))
        nowhere = np.zeros(peaks.found.shape, dtype=np.bool_)
        displacement, _ = outliers.validate_vectors(
            raw, second, peaks.found, nowhere, outliers.expected_noise(peaks.width)
        )
        width = undiluted(typical_width(peaks.width) * np.asarray(self.bins))
        is_elongated = bool(np.any(width >= ELONGATED_WIDTH))
        size, step, first = (
            triple(n * width for n, width in zip(cells, self.bins, strict=True))
            for cells in (self.layout.size, self.layout.step, self.layout.first)
        )
        found = outliers.smooth_field(outliers.fill_field(displacement), is_elongated) * np.asarray(self.bins)
        return found, WindowLayout(size, step, self.layout.count, first), is_elongated


@njit(cache=True, nogil=True)
def sum_bins(part: tuple[int, int], volume: Singles, bins: Triple, sums: Singles) -> None:
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


# Strong curvature leaves up to two voxels after the coarse pass and after each change of windows; later one is enough.
FIRST_RADIUS = 2
LATER_RADIUS = 1
# Passes with the final windows. With one fewer the borders of sheared flows are a third worse; more only add noise.
FINAL_PASSES = 4
# The last pass looks two voxels far again: one has no room for a second peak.
LAST_RADIUS = 2
# Share of a Gauss-Newton step in the place of a peak of short particles, and how far apart they are at most, in voxels.
# More of it takes more of the error in clean volumes, and adds noise where particles are lost.
STEP_SHARE = 0.25
LARGEST_DIFFERENCE = 0.5
# With less of its voxels seen in both volumes a window is masked rather than judged by the few particles in it.
SMALLEST_VALID_FRACTION = 0.25


@dataclass(frozen=True)
class Pass:
    """One pass over the deformed volumes: its windows, how far it looks, and whether its vectors are the result."""

    layout: WindowLayout
    radius: int
    is_last: bool = False


# Two volumes ready for deformation: their splines, and where both may be used (size 0 for everywhere).
Pair = tuple[Spline, Spline, Flags]


@dataclass(frozen=True, eq=False)
class Measured:
    """What one pass measured, at the centres of its windows, and the typical width of the peaks along x, y, z."""

    raw: Floats
    displacement: Floats
    flag: NDArray[np.uint8]
    peaks: Peaks
    valid_fraction: Floats
    uncertainty: Floats
    width: Floats


def correlate(
    pairs: Iterable[tuple[Singles, Singles]],
    grid: Grid,
    settings: CorrelationSettings,
    *,
    mask: Flags | None = None,
    progress: Callable[[int], None] | None = None,
) -> VectorField:
    """Return the displacements from the first to the second volume of a pair, or those that several have in common.

    For a flow that does not change, correlations are summed over the pairs, under one predictor, before a peak is
    sought: where single pairs hold too few particles, and with an error that falls as the root of their number.

    Parameters
    ----------
    pairs : volumes (z, y, x), intensities on `grid`; voxels that are not finite are masked. Of each pair only the
        splines are kept, pairs may be read one by one
    mask : (z, y, x) True where the volumes are to be used; None for everywhere
    progress : called with 1 after each of `count_passes(windows)` passes

    Raises
    ------
    InputError
        There is no pair, or the volumes or the mask do not have the grid's shape.
    ConfigError
        No window, one smaller than 2 voxels, an overlap outside 0 to 1, or a time or an exponent out of range.
    """
    _ensure_possible(settings)
    report = progress or (lambda units: None)
    coarse = Coarse.over(grid.shape_xyz, settings)
    sums, ready = None, []
    # One BLAS thread: with more, the bits of products of matrices would depend on their number.
    with threadpool_limits(limits=1, user_api="blas"):
        for pair in pairs:
            usable, *volumes = _usable_voxels(*pair, mask, grid)
            if settings.exponent != 1.0:
                power = np.float32(settings.exponent)
                volumes = [np.power(np.maximum(volume, np.float32(0.0)), power) for volume in volumes]
            found = coarse.sums(volumes)
            sums = found if sums is None else sums + found
            a, b = (spline_coefficients(volume) for volume in volumes)
            ready.append((a, b, usable))
        if sums is None:
            raise InputError("there are no pairs of volumes to correlate")
        predictor, layout, is_elongated = coarse.field(sums)
        report(1)
        for step in plan(grid.shape_xyz, settings):
            if layout != step.layout:
                old, layout = layout, step.layout
                x, y, z = (spline_matrix(old.centres_voxel(k), layout.centres_voxel(k)) for k in range(3))
                predictor = np.einsum("ck,bj,ai,kjid->cbad", z, y, x, predictor, optimize=True)
            measured = _refine(ready, predictor, step, is_elongated)
            is_long = measured.width >= ELONGATED_WIDTH
            filled, is_elongated = outliers.fill_field(measured.displacement), bool(is_long.any())
            predictor = outliers.smooth_field(filled, is_elongated)
            report(1)
    # Long particles mix the flow into the components that are located well; along their length noise is worse.
    sigma = np.where(is_long, measured.width / np.sqrt(2.0), 0.0)
    mixed = np.where(is_long, 0.0, outliers.mixing(filled, sigma, layout.step))
    return VectorField(
        grid=layout.grid(grid),
        displacement_voxel=measured.displacement - mixed,
        displacement_raw_voxel=measured.raw,
        correlation=measured.peaks.height,
        peak_ratio=measured.peaks.ratio,
        valid_fraction=measured.valid_fraction,
        flag=measured.flag,
        uncertainty_voxel=np.hypot(measured.uncertainty, outliers.unresolved(filled, is_elongated)),
        voxel_mm=grid.spacing_mm,
        dt_s=settings.dt_s,
        window_voxel=layout.size,
    )


def count_passes(windows: Sequence[Triple]) -> int:
    """Return how often `correlate` reports progress."""
    return 1 + len(_refined_sizes(windows))


def _ensure_possible(settings: CorrelationSettings) -> None:
    """Refuse settings that no volumes can be correlated with."""
    windows, overlap, dt_s, exponent = settings.windows, settings.overlap, settings.dt_s, settings.exponent
    if not windows or min(min(window) for window in windows) < 2:
        raise ConfigError(f"correlation windows are {list(windows)} voxels; each must be at least 2 along every axis")
    if not all(0.0 <= share < 1.0 for share in overlap):
        raise ConfigError(f"the overlap of the correlation windows is {overlap}; it must be at least 0 and below 1")
    if dt_s is not None and not dt_s > 0.0:
        raise ConfigError(f"the time between the volumes is {dt_s} s; it must be positive")
    if not 0.0 < exponent <= 1.0:
        raise ConfigError(f"the exponent of the correlated intensities is {exponent}; it must be above 0 and at most 1")


def _usable_voxels(a: Singles, b: Singles, mask: Flags | None, grid: Grid) -> tuple[Flags, Singles, Singles]:
    """Return where both volumes may be used (size 0 for everywhere), and both with zeros elsewhere."""
    for name, array in (("first volume", a), ("second volume", b), ("mask", mask)):
        if array is not None and array.shape != grid.shape_zyx:
            raise InputError(f"the {name} has shape {array.shape} (z, y, x); its grid has {grid.shape_zyx}")
    # What is not finite in a volume shows in its extremes.
    if mask is None and all(np.isfinite(end(volume)) for volume in (a, b) for end in (np.min, np.max)):
        return np.zeros((0, 0, 0), dtype=np.bool_), a, b
    finite = np.isfinite(a) & np.isfinite(b)
    usable = finite if mask is None else finite & mask
    zero = np.float32(0.0)
    return usable, np.where(usable, a, zero), np.where(usable, b, zero)


def _refined_sizes(windows: Sequence[Triple]) -> list[Triple]:
    """Return the windows of the passes after the coarse one: each larger one once, the final one `FINAL_PASSES` times.

    Without the first where it is the coarse pass's own: measured again at full resolution it changes no figure.
    """
    larger = windows[1:-1] if len(windows) > 1 and coarse_size(windows) == windows[0] else windows[:-1]
    return [*larger, *[windows[-1]] * FINAL_PASSES]


def plan(shape_xyz: Triple, settings: CorrelationSettings) -> list[Pass]:
    """Return the passes after the coarse one."""
    sizes = _refined_sizes(settings.windows)
    passes = []
    for number, size in enumerate(sizes):
        changed = number == 0 or size != sizes[number - 1]
        radius = FIRST_RADIUS if changed else LATER_RADIUS
        passes.append(Pass(settings.layout(shape_xyz, size), radius))
    passes[-1] = Pass(passes[-1].layout, LAST_RADIUS, is_last=True)
    return passes


def _refine(pairs: Sequence[Pair], predictor: Floats, step: Pass, is_elongated: bool) -> Measured:
    """Return what is measured in volumes deformed by `predictor`, given at the windows of `step`, in voxels."""
    layout, shape_zyx = step.layout, pairs[0][0].shape_zyx
    before, after = margins(layout, shape_zyx, step.radius)
    to_voxels = matrices_to_voxels(layout, shape_zyx[::-1])
    parts = []
    for pair in pairs:
        a, b, valid = deform_pair(*pair, predictor, to_voxels, before, after)
        fraction = valid_shares(valid, layout, before)
        moments = pair_moments(a, b, valid, layout, before) if step.is_last or is_elongated else None
        parts.append((map_sums(a, b, layout, before, step.radius), fraction, moments))
    sums, fractions, moments_of = zip(*parts, strict=True)
    total = reduce(add, sums)
    peaks = find_peaks(total.correlation())
    valid_fraction = np.asarray(np.mean(fractions, axis=0, dtype=np.float64))
    width = undiluted(typical_width(peaks.width))
    elongated = width >= ELONGATED_WIDTH
    if step.is_last:
        amplitude = total.amplitude() / np.sqrt(np.maximum(valid_fraction, SMALLEST_VALID_FRACTION))
        tails = outliers.in_tails(amplitude, np.where(elongated, width / np.sqrt(2.0), 0.0), layout)
        peaks = replace(peaks, height=np.where(tails, 0.0, peaks.height))
    rest = uncertainty = np.full(peaks.offset.shape, np.nan)
    if moments_of[0] is not None:
        rest, deviation, response = gauss_newton(reduce(add, moments_of), layout, width / np.sqrt(2.0))
        uncertainty = deviation / response
    # Gauss-Newton steps take the place of offsets along elongated axes. One longer than the peak is wide lies outside
    # the range in which the volumes change linearly. Where all axes are short, steps and peaks err in part
    # independently, and a share of the step is taken; where they differ by half a voxel it has met a lost particle.
    differ = rest - peaks.offset
    elsewhere = 0.0 if elongated.any() else STEP_SHARE * (np.abs(differ) < LARGEST_DIFFERENCE)
    share = np.where(elongated, np.abs(rest) <= width, elsewhere)
    offset = np.where(share > 0.0, peaks.offset + share * differ, peaks.offset)
    raw, second = absolute(replace(peaks, offset=offset), predictor)
    masked = valid_fraction < SMALLEST_VALID_FRACTION
    displacement, flag = outliers.validate_vectors(
        raw, second, peaks.found, masked, outliers.expected_noise(peaks.width)
    )
    uncertainty[~peaks.found | masked] = np.nan
    return Measured(raw, displacement, flag, peaks, valid_fraction, uncertainty, width)


# How much memory a correlation takes, from the size of its volumes and its windows.
#
# Measured on two threads, with the program's 0.25 GB: 0.30 GB for 80 x 80 x 120 voxels, 0.41 for 128 x 128 x 160 and
# 0.75 for 240 x 200 x 160 with windows of 24 and 12 voxels; 1.63 for the first with windows of 16 and 8 and an
# overlap of 0.75, of which 0.8 are the moments of the cells.

# Two volumes, their splines, and both of them deformed, with what is made in between.
VOXEL_BYTES = 34
# Of each window and shift the products and their sum, the two maps, and twice the energies of two volumes.
SHIFT_BYTES = 40
MOMENT_BYTES = 8


def held_bytes(shape_xyz: Triple, settings: CorrelationSettings) -> float:
    """Return what a correlation of two volumes holds in memory at once, in bytes, without the program."""
    of_passes = []
    for step in plan(shape_xyz, settings):
        # Moments are those of the last pass, and of few others.
        cells = math.prod(starts.size for starts in cells_of(step.layout).start) if step.is_last else 0
        shifts = (2 * step.radius + 1) ** 3 * math.prod(step.layout.count)
        of_passes.append(SHIFT_BYTES * shifts + MOMENT_BYTES * MOMENTS * cells)
    return float(VOXEL_BYTES * math.prod(shape_xyz) + max(of_passes))
