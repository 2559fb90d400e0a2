"""The factorised weights of strips of a volume behind curved faces.

Of every strip rays are traced to random points in the fluid, and each coordinate of where they meet the array is fitted
by a polynomial of the same coordinate of start and crossing, and of the depth: what is left is what the other axis
says, and how far the axes do not separate.

Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.face_tracing import aim
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.optics.tracing import disc_points
from lfpiv_cli.threads import share_out
from lfpiv_cli.weights.aperture import aperture_mask
from lfpiv_cli.weights.axis import AxisWeights, FittedBending, axis_weights, depth_nodes
from lfpiv_cli.weights.axis_cells import AxisOptics, micro_image_cells
from lfpiv_cli.weights.operators import FactorisedOperator
from lfpiv_cli.weights.strips import StripOperator

# Of own coordinate, depth and crossing: of degree 4 the polynomials are off by 0.3 um near the wall of a tube of 10 mm,
# of degree 5 by less than 0.1 um, far below what the axes know of each other.
DEGREE = 5
EXPONENTS = np.array([powers for powers in product(range(DEGREE + 1), repeat=3) if sum(powers) <= DEGREE])
# Rays of each strip; with twice as many the fit's error, a seventh of the misfit, falls to a tenth.
STRIP_RAYS = 3000
# Voxels across a strip, where the whole volume is too wide for one. What a register takes at once is 8 or 16, and
# narrower strips leave some of it empty.
HEIGHTS = (16, 8, 4, 2)
# Straight pieces of a ray's place on the array over X, as behind plane windows.
PIECES = 8
# Rays by which a voxel is judged to lie in the fluid and to be seen through the whole aperture: the middle and the rim.
RIM = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True, eq=False)
class StripFit:
    """Where the rays of a strip meet the array, as the two axes have it.

    Attributes
    ----------
    middle_mm, half_mm : (3,) of the rays' starts
    coefficients_mm : (2, terms) of each coordinate on the array
    misfit_mm2 : mean square of what the axes do not tell, over both coordinates
    rays : how many were traced
    """

    middle_mm: NDArray[np.float64]
    half_mm: NDArray[np.float64]
    coefficients_mm: NDArray[np.float64]
    misfit_mm2: float
    rays: int

    def bending(self, axis: int, depths_mm: NDArray[np.float64], radius_mm: float) -> FittedBending:
        """Return the polynomials along one axis at depths (planes, nodes), own coordinate from the middle."""
        table = np.zeros((*depths_mm.shape, DEGREE + 1, DEGREE + 1))
        depth = (depths_mm - self.middle_mm[2]) / self.half_mm[2]
        for powers, coefficient in zip(EXPONENTS, self.coefficients_mm[axis], strict=True):
            table[..., powers[0], powers[2]] += coefficient * depth ** powers[1]
        return FittedBending(table, np.array([self.half_mm[axis], radius_mm]), PIECES)


@dataclass(frozen=True, eq=False)
class StripPlan:
    """How a volume is cut into strips.

    Attributes
    ----------
    turned : strips of columns of voxels, not of rows
    height : voxels across a strip
    fits : of each strip; None where none of it is seen
    coupling_mm : rms over the rays of all strips
    """

    turned: bool
    height: int
    fits: Sequence[StripFit | None]
    coupling_mm: float


def strip_plan(camera: Camera, space: CurvedSpace, grid: Grid, largest_mm: float) -> StripPlan | None:
    """Return the widest strips within which the axes separate up to `largest_mm`, rms on the array; None if none do."""
    size = grid.shape_xyz[:2] if camera.column_axis == "x" else grid.shape_xyz[1::-1]
    for height in (None, *HEIGHTS):
        for turned in (False, True):
            voxels = size[0 if turned else 1]
            if height is not None and height >= voxels:
                continue
            plan = _plan(camera, space, grid, turned, height or voxels)
            if plan.coupling_mm < largest_mm:
                return plan
    return None


def _plan(camera: Camera, space: CurvedSpace, grid: Grid, turned: bool, height: int) -> StripPlan:
    """Return the strips of so many voxels, and how well the axes separate in them."""
    rng = np.random.default_rng(0)
    fits = [strip_fit(camera, space, bounds, rng) for bounds in _bounds_of_strips(camera, grid, turned, height)]
    seen = [fit for fit in fits if fit is not None]
    rays = max(sum(fit.rays for fit in seen), 1)
    return StripPlan(turned, height, fits, float(np.sqrt(sum(fit.misfit_mm2 * fit.rays for fit in seen) / rays)))


def _bounds_of_strips(camera: Camera, grid: Grid, turned: bool, height: int) -> Iterator[NDArray[np.float64]]:
    """Yield the faces (2, 3) of each strip, image axes."""
    bounds = camera.to_image_axes(np.array([grid.bounds_mm(axis) for axis in range(3)]).T)
    sides = camera.to_image_axes(np.asarray(grid.spacing_mm))
    across = 0 if turned else 1
    low, high = bounds[:, across]
    for first in np.arange(low, high - 0.5 * sides[across], height * sides[across]):
        strip = bounds.copy()
        strip[:, across] = first, min(first + height * sides[across], high)
        yield strip


def strip_fit(
    camera: Camera, space: CurvedSpace, bounds_mm: NDArray[np.float64], rng: np.random.Generator
) -> StripFit | None:
    """Return where the rays of a strip with faces (2, 3), image axes, meet the array; None where too few are seen."""
    start = rng.uniform(bounds_mm[0], bounds_mm[1], (STRIP_RAYS, 3))
    crossing = disc_points(STRIP_RAYS, camera.aperture_radius_mm, rng)
    array, valid = places_on_array(camera, space, start, crossing)
    start, crossing, array = start[valid], crossing[valid], array[valid]
    if len(start) <= 2 * len(EXPONENTS):
        return None
    array *= 1.0 + camera.distortion_per_mm2 * np.sum(array**2, axis=1, keepdims=True)
    low, high = start.min(axis=0), start.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    coefficients, misfit = np.empty((2, len(EXPONENTS))), 0.0
    for axis in range(2):
        own = (start[:, axis] - middle[axis]) / half[axis]
        depth = (start[:, 2] - middle[2]) / half[2]
        terms = _terms(np.stack([own, depth, crossing[:, axis] / camera.aperture_radius_mm], axis=1))
        coefficients[axis] = np.linalg.lstsq(terms, array[:, axis], rcond=None)[0]
        # What the fit itself takes away of a random misfit is put back.
        misfit += np.sum((array[:, axis] - terms @ coefficients[axis]) ** 2) / (2.0 * (len(terms) - terms.shape[1]))
    return StripFit(middle, half, coefficients, float(misfit), len(start))


def places_on_array(
    camera: Camera, space: CurvedSpace, points_mm: NDArray[np.float64], crossing_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return where rays from (n, 3) through (n, 2) meet the array, without the distortion, and whether they do."""
    slopes, valid = space.slopes(camera, points_mm, crossing_mm)
    return crossing_mm + camera.image_distance_mm * (slopes - crossing_mm / camera.focal_length_mm), valid


def _terms(variables: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each term (n, terms) of scaled own coordinate, depth and crossing (n, 3)."""
    powers = variables[:, :, np.newaxis] ** np.arange(DEGREE + 1)
    return np.asarray(np.prod([powers[:, k, EXPONENTS[:, k]] for k in range(3)], axis=0))


def factorise_strips(
    optics: tuple[AxisOptics, AxisOptics], camera: Camera, space: CurvedSpace, grid: Grid, plan: StripPlan
) -> StripOperator:
    """Return the weights of all voxels of a grid in strips, through an array whose two axes are given."""
    lit = lit_voxels(camera, space, grid)
    lines = lit.swapaxes(1, 2) if plan.turned else lit
    across, along = (0, 1) if plan.turned else (1, 0)
    world = (0, 1) if camera.column_axis == "x" else (1, 0)
    centres = [grid.axis_mm(axis) for axis in world]
    rows, columns = [], []
    for k, fit in enumerate(plan.fits):
        part = slice(k * plan.height, (k + 1) * plan.height)
        if fit is None:
            lines[:, part] = False
        seen = np.asarray(lines[:, part].any(axis=2))
        strip = _Strip(fit, camera, grid, np.flatnonzero(seen.any(axis=1)))
        rows.append(strip.axis(across, optics[across], centres[across][part], seen, plan.height))
        everywhere = np.ones((len(lit), centres[along].size), dtype=bool)
        columns.append(strip.axis(along, optics[along], centres[along], everywhere, centres[along].size))
    by_row, by_column = _joined(rows, optics[across]), _joined(columns, optics[along])
    mask = aperture_mask(by_column.cells, by_row.cells, camera.aperture_radius_mm)
    return StripOperator(FactorisedOperator(by_column, by_row, mask), lit, plan.turned, plan.coupling_mm)


class _Part(NamedTuple):
    """The weights of one strip along one axis: entries (planes, voxels) of each voxel, and cell and share of each."""

    counts: NDArray[np.int64]
    cell: NDArray[np.int32]
    share: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class _Strip:
    """One strip, and in which planes any of it is lit."""

    fit: StripFit | None
    camera: Camera
    grid: Grid
    planes: NDArray[np.int64]

    def axis(
        self, axis: int, optics: AxisOptics, centres_mm: NDArray[np.float64], kept: NDArray[np.bool_], filled: int
    ) -> _Part:
        """Return the weights along one axis of voxels at centres (n,), those kept (planes, n), filled up."""
        counts = np.zeros((len(kept), filled), np.int64)
        if self.fit is None or not self.planes.size:
            return _Part(counts, np.zeros(0, np.int32), np.zeros(0, np.float32))
        world = axis if self.camera.column_axis == "x" else 1 - axis
        nodes = depth_nodes(self.grid.axis_mm(2)[self.planes], self.grid.spacing_mm[2])
        bending = self.fit.bending(axis, nodes, self.camera.aperture_radius_mm)
        own = axis_weights(optics, centres_mm - self.fit.middle_mm[axis], self.grid.spacing_mm[world], bending)
        entries = np.diff(own.start).reshape(self.planes.size, -1)
        stays = kept[self.planes]
        counts[self.planes, : centres_mm.size] = entries * stays
        taken = np.repeat(stays.ravel(), entries.ravel())
        return _Part(counts, own.cell[taken], own.share[taken])


def _joined(parts: Sequence[_Part], optics: AxisOptics) -> AxisWeights:
    """Return the weights of all strips along one axis, the planes of one strip after the other."""
    counts, cell, share = (np.concatenate([getattr(part, name) for part in parts]) for name in _Part._fields)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return AxisWeights(len(counts), counts.shape[1], optics.pixels, micro_image_cells(optics), start, cell, share)


def lit_voxels(camera: Camera, space: CurvedSpace, grid: Grid) -> NDArray[np.bool_]:
    """Return which voxels (planes, row voxels, column voxels) have their middle in the fluid, wholly in view."""
    first, second = (0, 1) if camera.column_axis == "x" else (1, 0)
    axes = (grid.axis_mm(first), grid.axis_mm(second), grid.axis_mm(2))
    lit = np.empty(tuple(axis.size for axis in axes[::-1]), np.bool_)
    rim = camera.aperture_radius_mm * RIM
    share_out(_write_lit, axes[2].size, space.for_kernels(camera), axes, rim, lit)
    return lit


@njit(cache=True, nogil=True)
def _write_lit(
    part: tuple[int, int],
    faces: Faces,
    axes: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    rim: NDArray[np.float64],
    lit: NDArray[np.bool_],
) -> None:
    """Write planes `part` of `lit_voxels`."""
    for plane in range(part[0], part[1]):
        for row in range(axes[1].size):
            for column in range(axes[0].size):
                seen = True
                for k in range(rim.shape[0]):
                    if seen:
                        crossing = rim[k, 0], rim[k, 1]
                        seen = aim(faces, axes[0][column], axes[1][row], axes[2][plane], crossing[0], crossing[1])[2]
                lit[plane, row, column] = seen
