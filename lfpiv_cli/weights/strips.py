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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import complete_exponents, polynomial_terms
from lfpiv_cli.threads import ensure_own_threads, share_out
from lfpiv_cli.weights import kernels
from lfpiv_cli.weights.axis import SMALLEST_SHARE, AxisWeights, Bending
from lfpiv_cli.weights.kernels import PLACES, SLAB, STRIP, Blocks, BlockShape
from lfpiv_cli.weights.lens_cells import AxisOptics, Cells
from lfpiv_cli.weights.operators import Column, SeparatedOperator, real_array, voxel_index
from lfpiv_cli.weights.scene import places_on_array

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

    def forward(self, volume: Singles) -> Singles:
        ensure_own_threads()
        volume = real_array(volume, self.shape, "a volume")
        lines = self._as_lines(volume * self.lit)
        image = self.project(kernels.turned(lines, (lines.shape[2], self._height)))
        return np.ascontiguousarray(image.T) if self.turned else image

    def adjoint(self, image: Singles) -> Singles:
        ensure_own_threads()
        image = real_array(image, self.image_shape, "an image")
        seen = np.ascontiguousarray(image.T) if self.turned else image
        lines, along = self._as_lines(self.lit).shape[1:]
        volume = self.back_project(seen, (len(self.lit), along, self._height))
        return np.ascontiguousarray(self._as_lines(kernels.turned(volume, (lines, along)))) * self.lit

    def column(self, plane: int, row_voxel: int, column_voxel: int) -> Column:
        plane, row_voxel, column_voxel = voxel_index((plane, row_voxel, column_voxel), self.shape)
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


# Factors of weights along one axis, as blocks of strips have them, and how they change from line to line. From here on
# axes are image axes (x along the columns), mm, z away from the camera from the nominal focal point.


class Factor(NamedTuple):
    """Weights along one axis: entries (planes, voxels) of each voxel, and cell and share of each."""

    counts: Integers
    cell: NDArray[np.int32]
    share: Singles

    def chosen(self, keep: Flags) -> Factor:
        """Return the entries that are kept."""
        first = np.concatenate([[0], np.cumsum(keep)])
        ends = first[np.concatenate([[0], np.cumsum(self.counts)])]
        return Factor(np.diff(ends).reshape(self.counts.shape), self.cell[keep], self.share[keep])

    def scaled(self, voxel_share: Floats) -> Factor:
        """Return a share of each voxel's light (voxels,), alike in all planes; without entries where it is none."""
        of_entry = np.repeat(np.tile(voxel_share, len(self.counts)), self.counts.ravel())
        scale = of_entry.astype(np.float32).reshape(-1, *[1] * (self.share.ndim - 1))
        return self._replace(share=self.share * scale).chosen(of_entry > 0.0)


def mixed_shares(along_mm: Floats, places_mm: Floats) -> Floats:
    """Return the share (n, places) of ascending places in what is mixed linearly at (n,); beyond them the last's."""
    return np.stack([np.interp(along_mm, places_mm, each) for each in np.eye(len(places_mm))], axis=1)


def through_lines(weights: AxisWeights, powers: Floats, through: Floats) -> tuple[Factor, Floats]:
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
    first: Integers,
    cells: int,
    start: Integers,
    cell: NDArray[np.int32],
    share: Singles,
    powers: Floats,
    through: Floats,
    found_cell: NDArray[np.int32],
    found: Singles,
    counts: Integers,
    off: Floats,
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


# Where the rays of a part of a strip meet the array, as polynomials along each axis.
#
# Of each part rays are traced through the faces, and each coordinate of where they meet the array is fitted by a
# polynomial of what its factor of the weights may know: along the strip own coordinate and crossing, depth and line;
# across it own coordinate and crossing, and depth, and where faces run aslant the place along the strip. What is left
# is what the other axis says. Where that is too much, rays through different parts of the aperture, or from different
# parts of the strip, have polynomials of their own.

# Near the wall of a tube of 10 mm the polynomials are off by less than 0.2 um along it, where slabs are thin, and by
# about 1 um across it, where the rays' places end with a root; in the middle by nothing.
DEGREE_ALONG, DEGREE_ACROSS = 5, 7
# What rays through a part of the aperture add to that is smooth: of this degree where there are so many of them.
DEGREE_OF_PARTS = {3: 120, 1: 16}
# Straight pieces of a ray's place on the array over X, as behind plane windows.
PIECES = 8
# Of the normal equations' diagonal; keeps them solvable where rays say nothing about a term.
RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class StripRays:
    """Rays from a part of a strip.

    Attributes
    ----------
    start_mm, crossing_mm, array_mm : (n, 3), (n, 2) on the main lens and (n, 2) on the array
    along, across : which image axis runs along the strip, and which across it
    middle_mm, half_mm : (3,) of the starts
    radius_mm : of the aperture
    """

    start_mm: Floats
    crossing_mm: Floats
    array_mm: Floats
    along: int
    across: int
    middle_mm: Floats
    half_mm: Floats
    radius_mm: float

    def variables(self, axis: int, beside: bool) -> Floats:
        """Return what the factor along an image axis knows of each ray, (n, 3) or (n, 4), each from -1 to 1.

        Own coordinate, depth and crossing, and `beside`, where it is known, the coordinate along the other axis.
        """
        start = (self.start_mm - self.middle_mm) / self.half_mm
        known = [start[:, axis], start[:, 2], self.crossing_mm[:, axis] / self.radius_mm]
        return np.stack([*known, start[:, 1 - axis]] if beside else known, axis=1)


@dataclass(frozen=True, eq=False)
class AxisFit:
    """The coordinate on the array along one axis, as a polynomial of `StripRays.variables`.

    Attributes
    ----------
    exponents, coefficients_mm : (terms, variables), (terms,)
    rays : what it was fitted to
    axis : image axis
    degree_beside : highest power of the coordinate along the other axis; None: it is not known
    """

    exponents: Integers
    coefficients_mm: Floats
    rays: StripRays
    axis: int
    degree_beside: int | None

    def drift_mm(self) -> float:
        """Return how far places move from one end of the other axis to the other, for nine rays in ten at most."""
        known = self.rays.variables(self.axis, True)
        ends = []
        for end in (-1.0, 1.0):
            known[:, 3] = end
            ends.append(polynomial_terms(known, self.exponents) @ self.coefficients_mm)
        return float(np.percentile(np.abs(ends[1] - ends[0]), 90.0))

    def bending(self, depths_mm: Floats, beside_mm: Floats | None = None) -> Bending:
        """Return the polynomials in own coordinate, from the middle, and crossing, at depths (planes, nodes).

        Where the coordinate along the other axis is known, at one place of it in each plane, (planes,).
        """
        middle, half = self.rays.middle_mm, self.rays.half_mm
        depth = (depths_mm - middle[2]) / half[2]
        degree = int(self.exponents.max())
        factors = [depth[..., np.newaxis] ** np.arange(degree + 1)]
        if beside_mm is not None:
            other = 1 - self.axis
            place = (beside_mm - middle[other]) / half[other]
            factors.append((place[:, np.newaxis] ** np.arange(degree + 1))[:, np.newaxis])
        table = np.zeros((*depths_mm.shape, degree + 1, degree + 1))
        for powers, coefficient in zip(self.exponents, self.coefficients_mm, strict=True):
            part = coefficient * factors[0][..., powers[1]]
            if beside_mm is not None:
                part = part * factors[1][..., powers[3]]
            table[..., powers[0], powers[2]] += part
        return Bending.fitted(table, np.array([half[self.axis], self.rays.radius_mm]), PIECES)


def strip_rays(
    camera: Camera, space: CurvedSpace, lines_mm: Floats, ends_mm: Floats, sides_mm: Floats, across: int, rays: int
) -> StripRays | None:
    """Return rays from the lines of voxels at (n, 2) across the strip and in depth, image axes; None if none are seen.

    Parameters
    ----------
    ends_mm : (2,) of the lines
    sides_mm : (3,) of a voxel
    """
    even = evenly_spread(rays, 6)
    along, radius = 1 - across, camera.aperture_radius_mm
    line = lines_mm[(even[:, 0] * len(lines_mm)).astype(np.int64)]
    start = np.empty((rays, 3))
    start[:, along] = ends_mm[0] + even[:, 1] * (ends_mm[1] - ends_mm[0])
    start[:, across] = line[:, 0] + (even[:, 2] - 0.5) * sides_mm[across]
    start[:, 2] = line[:, 1] + (even[:, 3] - 0.5) * sides_mm[2]
    angle = 2.0 * np.pi * even[:, 4]
    crossing = radius * np.sqrt(even[:, 5:]) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    array, valid = places_on_array(camera, space, start, crossing)
    if np.count_nonzero(valid) < rays // 8:
        return None
    start, crossing, array = start[valid], crossing[valid], array[valid]
    array *= 1.0 + camera.distortion_per_mm2 * np.sum(array**2, axis=1, keepdims=True)
    low, high = start.min(axis=0), start.max(axis=0)
    return StripRays(start, crossing, array, along, across, 0.5 * (low + high), 0.5 * (high - low), radius)


def evenly_spread(count: int, dimensions: int) -> Floats:
    """Return points (count, dimensions) that fill the unit cube evenly: multiples of the roots of x^(d+1) = x + 1."""
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.arange(1, count + 1)[:, np.newaxis] * steps) % 1.0)


def _exponents(degree: int, degree_beside: int | None) -> Integers:
    """Return the powers (terms, 3), with the other axis's coordinate (terms, 4), of polynomials of a degree."""
    return complete_exponents(degree, *3 * [degree], *([] if degree_beside is None else [min(degree_beside, degree)]))


def fit_axis(rays: StripRays, axis: int, degree_beside: int | None) -> tuple[AxisFit, Floats]:
    """Return the fit to all rays along an axis, and what it leaves of each (n,), mm.

    Of the coordinate along the other axis it knows powers up to `degree_beside`; None: nothing of it.
    """
    variables, place = rays.variables(axis, degree_beside is not None), rays.array_mm[:, axis]
    exponents = _exponents(DEGREE_ALONG if axis == rays.along else DEGREE_ACROSS, degree_beside)
    coefficients, left = _solved(variables, exponents, place)
    return AxisFit(exponents, coefficients, rays, axis, degree_beside), left


def fit_part(fit: AxisFit, left_mm: Floats, chosen: Flags) -> tuple[AxisFit, Floats]:
    """Return the fit that suits some of the rays (n,), and what it leaves of these, from what the fit to all leaves."""
    degree = next((each for each, rays in DEGREE_OF_PARTS.items() if np.count_nonzero(chosen) >= rays), None)
    if degree is None:
        return fit, left_mm[chosen]
    variables = fit.rays.variables(fit.axis, fit.degree_beside is not None)[chosen]
    exponents = _exponents(degree, fit.degree_beside)
    further, left = _solved(variables, exponents, left_mm[chosen])
    coefficients = fit.coefficients_mm.copy()
    for powers, coefficient in zip(exponents, further, strict=True):
        coefficients[np.all(fit.exponents == powers, axis=1)] += coefficient
    return replace(fit, coefficients_mm=coefficients), left


def _solved(variables: Floats, exponents: Integers, place: Floats) -> tuple[Floats, Floats]:
    """Return the coefficients that follow places best, and what they leave."""
    terms = polynomial_terms(variables, exponents)
    normal = terms.T @ terms
    normal[np.diag_indices_from(normal)] += RIDGE * len(terms)
    coefficients = np.asarray(np.linalg.solve(normal, terms.T @ place), dtype=np.float64)
    return coefficients, place - terms @ coefficients
