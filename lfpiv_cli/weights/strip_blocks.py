"""The blocks of weights in strips: how the volume and the aperture are parted, and the factors of each part.

For every part of a strip, `SLAB` planes deep, as many parts of the aperture and of the strip's length get factors of
their own as it takes for the light that goes astray to be less than a stated share.

Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.simd import GROUP, TILE
from lfpiv_cli.weights.axis import axis_weights, depth_nodes
from lfpiv_cli.weights.kernels import PLACES, SLAB, STRIP, Blocks
from lfpiv_cli.weights.lens_cells import Cells, Optics, aligned, aperture_mask, axis_optics, micro_image_cells
from lfpiv_cli.weights.quadrature import integrate_columns
from lfpiv_cli.weights.scene import lit_voxels, places_on_array
from lfpiv_cli.weights.strips import (
    DEGREE_ALONG,
    AxisFit,
    Factor,
    StripOperator,
    StripRays,
    evenly_spread,
    fit_axis,
    fit_part,
    joined,
    mixed_shares,
    strip_rays,
    through_lines,
)

# Parts of the aperture, side by side: by those along the strips column cells are sorted, so that those of a tile see
# the same and light through one part comes from some of the tiles only; of those across, blocks have neighbouring ones.
PARTS, FINE_PARTS = 6, 12
# Rays of each part of a strip.
RAYS = 8192
# Into how many parts the aperture is cut across the strips, for the factors along them; and how many tiles of column
# cells share a factor across them, all at first: in the order in which they are tried.
PARTS_ACROSS = (1, 2, 3, 4, 6)
TILES_SHARING = (10**6, 5, 2)
# Share of a voxel's light that may go to wrong pixels since its rays are taken for those of their part, by the factors
# along the strips and across them. Both together, and what a pixel's sharp part of the aperture is worth, make some
# 0.03. Parts of the aperture cost more time in each projection than tiles do.
STRAY_ALONG, STRAY_ACROSS = 0.022, 0.014
# Where a face runs aslant, light drifts across the strip as one goes along it. Factors across the strip are then made
# at places along it, at most this share of a lens pitch apart in drift, and mixed in between: a trapezoid so moved is
# off in L1 by a third of the share's square over the voxel's width in pitches, 0.004. Only where light goes astray
# otherwise, and with this share of it left.
LARGEST_DRIFT, DEGREE_OF_DRIFT, WORTH_DRIFT = 0.12, 2, 0.6
# Lenses beside those that rays were found to come to: more than a voxel's width and the rays' rarity make.
LENSES_BESIDE = 4
# Boxes along x, y and z of a part of a strip in each of which this holds.
BOXES = (4, 2, 2)
# Lines of a strip from which its factors along it are made, and by how much they may differ in L1 from what is made of
# them: else half as many lines share factors, but at least so many.
LINES_TAKEN = 4
LARGEST_MISFIT, FEWEST_LINES = 0.015, 4


@dataclass(frozen=True, eq=False)
class StripScene:
    """What the blocks are made of.

    Attributes
    ----------
    camera, space, grid : the voxels' in world axes
    optics : the camera's axes (columns, rows)
    cells : of each of these
    order, tile : along the strips, the cells sorted, and the tile of each cell; -1 where no light comes
    part : across the strips, which part of the aperture each cell sees
    lit : (planes, lines, voxels along) which voxels have light
    across : image axis across the strips
    """

    camera: Camera
    space: CurvedSpace
    grid: Grid
    optics: Optics
    cells: tuple[Cells, Cells]
    order: NDArray[np.int32]
    tile: Integers
    part: Integers
    lit: Flags
    across: int

    @property
    def along(self) -> int:
        """Image axis along the strips."""
        return 1 - self.across

    def centres_mm(self, axis: int) -> Floats:
        """Return the centres of the voxels along an image axis."""
        return self.grid.axis_mm(self.world(axis))

    def world(self, axis: int) -> int:
        """Return the world axis that an image axis follows."""
        return axis if axis == 2 or self.camera.column_axis == "x" else 1 - axis


class Block(NamedTuple):
    """One block: where it lies and its two factors."""

    plane: int
    line: int
    columns: Factor
    rows: Factor


def strip_scene(camera: Camera, space: CurvedSpace, grid: Grid, optics: Optics, lit: Flags, turned: bool) -> StripScene:
    """Return what blocks are made of, strips being of rows of voxels, or of columns where `turned`."""
    cells = micro_image_cells(optics[0]), micro_image_cells(optics[1])
    lines, across = (lit.swapaxes(1, 2), 0) if turned else (lit, 1)
    radius, along = camera.aperture_radius_mm, 1 - across
    # The lenses that light from the grid can come to, by rays from all over it.
    even, axis = evenly_spread(RAYS, 5), optics[along]
    bounds = camera.to_image_axes(np.array([grid.bounds_mm(k) for k in range(3)]).T)
    angle, away = 2.0 * np.pi * even[:, 3], radius * np.sqrt(even[:, 4])
    crossing = np.stack([away * np.cos(angle), away * np.sin(angle)], axis=1)
    array, valid = places_on_array(camera, space, bounds[0] + even[:, :3] * (bounds[1] - bounds[0]), crossing)
    lenses = 0, -1
    if valid.any():
        place = array[valid, along] * (1.0 + camera.distortion_per_mm2 * np.sum(array[valid] ** 2, axis=1))
        low, high = (np.array([place.min(), place.max()]) - axis.lens_origin_mm) / axis.lens_pitch_mm
        lenses = int(np.floor(low)) - LENSES_BESIDE, int(np.ceil(high)) + LENSES_BESIDE
    # Their cells by what part of the aperture they see; to and fro, so that neighbours are of neighbouring lenses.
    own, starts = cells[along], cells[along].start
    first, last = (int(np.clip(n - own.first_lens, 0, starts.size - 1)) for n in (lenses[0], lenses[1] + 1))
    cell = np.arange(starts[first], starts[last])
    sees = part_of_cells(own, radius, PARTS)[cell]
    order = cell[np.lexsort((np.where(sees % 2, -cell, cell), sees))].astype(np.int32)
    tile = np.full(own.pixel.size, -1)
    tile[order] = np.arange(order.size) // TILE
    part = part_of_cells(cells[across], radius, FINE_PARTS)
    return StripScene(camera, space, grid, optics, cells, order, tile, part, lines, across)


def part_of_cells(cells: Cells, radius_mm: float, parts: int) -> Integers:
    """Return which of so many equal parts of the aperture each cell sees; that of two that share their sums is one."""
    middle = cells.patch_mm.mean(axis=1)
    lens = np.searchsorted(cells.start, np.arange(middle.size), side="right") - 1
    pair = cells.start[lens] + (np.arange(middle.size) - cells.start[lens]) // GROUP * GROUP
    other = np.minimum(pair + GROUP - 1, cells.start[lens + 1] - 1)
    middle = 0.5 * (middle[pair] + middle[other])
    return np.clip((middle + radius_mm) * parts / (2.0 * radius_mm), 0, parts - 1).astype(np.int64)


def _blocks_of(scene: StripScene, planes: slice, lines: slice) -> list[Block]:
    """Return the blocks of some lines of voxels in some planes, of fewer lines each where need be."""
    lit = np.asarray(scene.lit[planes, lines].any(axis=2))
    if not lit.any():
        return []
    seen = np.flatnonzero(np.any(lit, axis=1))
    planes, lit = slice(planes.start + seen[0], planes.start + seen[-1] + 1), lit[seen[0] : seen[-1] + 1]
    rays = rays_of(scene, planes, lines, RAYS)
    if rays is None:
        scene.lit[planes, lines] = False
        return []
    along, misfit = _factors_along(scene, rays, planes, lines, lit)
    count = lines.stop - lines.start
    if misfit > LARGEST_MISFIT and count > FEWEST_LINES:
        middle = lines.start + count // 2
        halves = slice(lines.start, middle), slice(middle, lines.stop)
        return [block for half in halves for block in _blocks_of(scene, planes, half)]
    found = []
    for tiles, share, rows in _factors_across(scene, rays, planes, lines, lit):
        row_part = scene.part[rows.cell] * len(along) // FINE_PARTS
        for k, columns in enumerate(along):
            tile = scene.tile[columns.cell]
            held = columns.chosen((tile >= tiles.start) & (tile < tiles.stop)).scaled(share)
            if held.cell.size:
                found.append(Block(planes.start, lines.start, held, rows.chosen(row_part == k)))
    return found


def rays_of(scene: StripScene, planes: slice, lines: slice, rays: int) -> StripRays | None:
    """Return rays from the lit lines of a part of a strip."""
    plane, line = np.nonzero(scene.lit[planes, lines].any(axis=2))
    centres = [scene.centres_mm(scene.across)[lines][line], scene.centres_mm(2)[planes][plane]]
    sides = scene.camera.to_image_axes(np.asarray(scene.grid.spacing_mm))
    ends = np.array(scene.grid.bounds_mm(scene.world(scene.along)))
    return strip_rays(scene.camera, scene.space, np.stack(centres, axis=1), ends, sides, scene.across, rays)


def stray(rays: StripRays, left_mm: Floats, pitch_mm: float) -> float:
    """Return the share of light that goes astray in the worst box of a part of a strip, by what a fit leaves (n,).

    A ray that arrives d off is taken to another lens with the probability d / pitch, which two lenses notice.
    """
    start = (rays.start_mm - rays.middle_mm) / rays.half_mm
    order = [rays.along, rays.across, 2]
    places = [
        np.clip(((start[:, axis] + 1.0) * 0.5 * boxes).astype(np.int64), 0, boxes - 1)
        for axis, boxes in zip(order, BOXES, strict=True)
    ]
    box = np.ravel_multi_index(places, BOXES)
    total = np.bincount(box, np.abs(left_mm), int(np.prod(BOXES)))
    return float(np.max(2.0 * total / (np.maximum(np.bincount(box, minlength=total.size), 1) * pitch_mm)))


def fits_along(scene: StripScene, rays: StripRays) -> tuple[list[AxisFit], float]:
    """Return a fit along the strip for each part of the aperture across it, and the light that goes astray."""
    whole, left = fit_axis(rays, scene.along, DEGREE_ALONG)
    crossing, radius, pitch = rays.crossing_mm[:, scene.across], rays.radius_mm, scene.optics[scene.along].lens_pitch_mm
    for parts in PARTS_ACROSS:
        which = np.clip((crossing + radius) * parts / (2.0 * radius), 0, parts - 1).astype(np.int64)
        fits, off = _fits_of_parts(whole, left, which, parts, pitch)
        if off < STRAY_ALONG:
            break
    return fits, off


class AcrossFits(NamedTuple):
    """Fits across a strip.

    Attributes
    ----------
    fits : one each so many tiles of cells
    sharing : how many tiles
    off : share of the light that goes astray
    places_mm : along the strip, between which factors made at two of them are mixed; None: one factor is for all of it
    """

    fits: list[AxisFit]
    sharing: int
    off: float
    places_mm: Floats | None


def fits_across(scene: StripScene, rays: StripRays) -> AcrossFits:
    """Return fits across the strip: with what they know of the coordinate along it where that is worth it."""
    found = _fits_across(scene, rays, None)
    if found.off < STRAY_ACROSS:
        return found
    drifting = _fits_across(scene, rays, DEGREE_OF_DRIFT)
    return drifting if drifting.off < WORTH_DRIFT * found.off else found


def _fits_across(scene: StripScene, rays: StripRays, degree_beside: int | None) -> AcrossFits:
    """Return the fits across the strip with as many tiles sharing one as let little light go astray."""
    pitch = scene.optics[scene.across].lens_pitch_mm
    whole, left = fit_axis(rays, scene.across, degree_beside)
    places = None
    if degree_beside is not None:
        steps = int(np.ceil(whole.drift_mm() / (LARGEST_DRIFT * pitch)))
        places = rays.middle_mm[scene.along] + rays.half_mm[scene.along] * np.linspace(-1.0, 1.0, max(steps, 1) + 1)
    # The tile of the column cell that each ray comes to, or of one beside it.
    cells, optics = scene.cells[scene.along], scene.optics[scene.along]
    number = np.rint((rays.array_mm[:, scene.along] - optics.lens_origin_mm) / optics.lens_pitch_mm).astype(np.int64)
    lens = np.clip(number - cells.first_lens, 0, cells.start.size - 2)
    first, count = cells.start[lens], np.maximum(cells.start[lens + 1] - cells.start[lens], 1)
    # The first pixel of a lens sees the far end of the aperture.
    within = 0.5 * (1.0 - rays.crossing_mm[:, scene.along] / rays.radius_mm) * count
    cell = np.minimum(first + np.clip(within.astype(np.int64), 0, count - 1), scene.tile.size - 1)
    tile, tiles = np.maximum(scene.tile[cell], 0), -(-scene.order.size // TILE)
    for sharing in TILES_SHARING:
        fits, off = _fits_of_parts(whole, left, tile // sharing, -(-tiles // sharing), pitch)
        if off < STRAY_ACROSS:
            break
    return AcrossFits(fits, sharing, off, places)


def _fits_of_parts(
    whole: AxisFit, left_mm: Floats, which: Integers, parts: int, pitch_mm: float
) -> tuple[list[AxisFit], float]:
    """Return a fit for the rays (n,) of each part, and the light that goes astray."""
    fits, left = [], left_mm.copy()
    for k in range(parts):
        fit, left[which == k] = fit_part(whole, left_mm, which == k)
        fits.append(fit)
    return fits, stray(whole.rays, left, pitch_mm)


def _factors_along(
    scene: StripScene, rays: StripRays, planes: slice, lines: slice, lit: Flags
) -> tuple[list[Factor], float]:
    """Return the factors along a strip, one a part of the aperture across it, and the worst misfit of their lines."""
    axis, across = scene.along, scene.across
    z, width = scene.centres_mm(2)[planes], scene.grid.spacing_mm[2]
    own, line = scene.centres_mm(axis), scene.centres_mm(across)[lines]
    side, side_along = (scene.grid.spacing_mm[scene.world(each)] for each in (across, axis))
    # Lines within the fluid, where the roots of a polynomial that goes through them best would be.
    nodes = -np.cos(np.pi * (np.arange(LINES_TAKEN) + 0.5) / LINES_TAKEN)
    first, last = lit.argmax(axis=1), lit.shape[1] - 1 - lit[:, ::-1].argmax(axis=1)
    dark = ~lit.any(axis=1)
    first[dark], last[dark] = 0, lit.shape[1] - 1
    middle, half = 0.5 * (line[first] + line[last]), 0.5 * (line[last] - line[first]) + 0.25 * side
    taken = middle[:, np.newaxis] + half[:, np.newaxis] * nodes
    places = PLACES[0] + (taken - line[0]) / side * (PLACES[1] - PLACES[0])
    powers = places[..., np.newaxis] ** np.arange(3)
    through = np.linalg.pinv(powers)
    depths = np.repeat(depth_nodes(z, width), LINES_TAKEN, axis=0)
    found, misfit = [], 0.0
    for fit in fits_along(scene, rays)[0]:
        bent = fit.bending(depths, taken.ravel())
        weights = axis_weights(scene.optics[axis], own - rays.middle_mm[axis], side_along, bent)
        factor, off = through_lines(weights, powers, through)
        found.append(factor)
        misfit = max(misfit, float(np.percentile(off[~dark], 90)) if not dark.all() else 0.0)
    return found, misfit


def _factors_across(
    scene: StripScene, rays: StripRays, planes: slice, lines: slice, lit: Flags
) -> Iterator[tuple[range, Floats, Factor]]:
    """Yield some tiles of column cells, the share (voxels,) of each voxel's light, and the factor across for these."""
    axis = scene.across
    depths = depth_nodes(scene.centres_mm(2)[planes], scene.grid.spacing_mm[2])
    centres, side = scene.centres_mm(axis)[lines], scene.grid.spacing_mm[scene.world(axis)]
    along = scene.centres_mm(scene.along)
    across = fits_across(scene, rays)
    shares = np.ones((along.size, 1)) if across.places_mm is None else mixed_shares(along, across.places_mm)
    for k, fit in enumerate(across.fits):
        for place, share in enumerate(shares.T):
            at = None if across.places_mm is None else np.full(len(depths), across.places_mm[place])
            own = axis_weights(scene.optics[axis], centres - rays.middle_mm[axis], side, fit.bending(depths, at))
            entries = np.diff(own.start).reshape(lit.shape)
            counts = np.zeros((len(lit), STRIP), np.int64)
            counts[:, : lit.shape[1]] = entries * lit
            kept = np.repeat(lit.ravel(), entries.ravel())
            tiles = range(k * across.sharing, (k + 1) * across.sharing)
            yield tiles, share, Factor(counts, own.cell[kept], own.share[kept])


# From camera, curved faces and a grid to the weights in strips: which way the strips run, and how good they are.
#
# Axes: grids in world axes, z away from the camera from the nominal focal point.

# Share of the light that may go astray with as many parts as there can be, by each axis; where more does, rays do not
# separate even in strips.
LARGEST_STRAY_LEFT = 0.04
# Parts of strips, across and in depth, and rays of each, by which that is judged.
PARTS_JUDGED, RAYS_JUDGED = (5, 3), 2048
# Voxels whose columns are held against those of traced rays, and tiles across the aperture for these: their own error
# is then 0.003 to 0.005.
SAMPLE, SAMPLE_TILES = 48, 64


class StripLayout(NamedTuple):
    """How a volume is cut into strips.

    Attributes
    ----------
    scene : what their blocks are made of
    parts : how many pairs of factors each strip has, on average
    """

    scene: StripScene
    parts: float

    @property
    def strips(self) -> int:
        """How many there are."""
        return -(-self.scene.lit.shape[1] // STRIP)


def strips_of(camera: Camera, space: CurvedSpace, grid: Grid) -> StripLayout | None:
    """Return strips of rows of voxels or of columns, what needs fewer parts; None where rays separate in neither."""
    if not aligned(camera):
        return None
    lit, optics = lit_voxels(camera, space, grid), axis_optics(camera)
    scenes = [strip_scene(camera, space, grid, optics, lit, turned) for turned in (False, True)]
    judged = [(scene, *_judged(scene)) for scene in scenes]
    found = [StripLayout(scene, parts) for scene, off, parts in judged if off < LARGEST_STRAY_LEFT]
    return min(found, key=lambda layout: layout.parts, default=None)


def _judged(scene: StripScene) -> tuple[float, float]:
    """Return the share of light that goes astray with as many parts as are needed, and their mean number."""
    off, parts = 0.0, []
    # Some parts of strips, all over the volume.
    lines_from, planes_from = (
        np.unique(np.linspace(0, size - 1, most).astype(int) // step * step)
        for size, step, most in zip(scene.lit.shape[1::-1], (STRIP, SLAB), PARTS_JUDGED, strict=True)
    )
    for line, plane in product(lines_from, planes_from):
        planes = slice(plane, min(plane + SLAB, scene.lit.shape[0]))
        lines = slice(line, min(line + STRIP, scene.lit.shape[1]))
        if not scene.lit[planes, lines].any():
            continue
        rays = rays_of(scene, planes, lines, RAYS_JUDGED)
        if rays is None:
            continue
        along, off_along = fits_along(scene, rays)
        across = fits_across(scene, rays)
        mixed = 1 if across.places_mm is None else 2  # places that a voxel's light is shared among
        parts.append(len(along) * len(across.fits) * mixed)
        off = max(off, off_along, across.off)
    return (off, float(np.mean(parts))) if parts else (np.inf, 0.0)


def factorise_strips(scene: StripScene) -> StripOperator:
    """Return the weights of all voxels of a grid in strips."""
    camera, space, grid, optics = scene.camera, scene.space, scene.grid, scene.optics
    planes, lines, _ = scene.lit.shape
    blocks: list[Block] = []
    # Voxels that no rays are found for are taken out of what is lit.
    for plane in range(0, planes, SLAB):
        for line in range(0, lines, STRIP):
            blocks += _blocks_of(scene, slice(plane, min(plane + SLAB, planes)), slice(line, min(line + STRIP, lines)))
    columns = joined([each.columns for each in blocks], optics[scene.along], scene.cells[scene.along])
    rows = joined([each.rows for each in blocks], optics[scene.across], scene.cells[scene.across])
    mask = aperture_mask(columns.cells, rows.cells, camera.aperture_radius_mm)
    where = [(each.plane, len(each.rows.counts), each.line) for each in blocks]
    places = Blocks(*np.array(where, np.int64).reshape(-1, 3).T.copy())
    turned = scene.across == 0
    lit = scene.lit.swapaxes(1, 2) if turned else scene.lit
    operator = StripOperator(columns, rows, mask, places, scene.order, lit, turned, np.zeros(0))
    sample = sample_lit(camera, space, grid, lit, SAMPLE, np.random.default_rng(0))
    # How far columns of some voxels are from those of traced rays.
    sides, misfits = camera.to_image_axes(np.asarray(grid.spacing_mm)), []
    for voxel, centre in zip(sample, voxel_centres(camera, grid, sample), strict=True):
        image = integrate_columns(camera, space, [centre], sides, SAMPLE_TILES).image(0, operator.image_shape)
        rows_lit, columns_lit, weights = operator.column(*voxel.tolist())
        image[rows_lit, columns_lit] -= weights
        misfits.append(np.abs(image).sum())
    return replace(operator, misfit_l1=np.array(misfits))


def sample_lit(
    camera: Camera, space: CurvedSpace, grid: Grid, lit: Flags, count: int, rng: np.random.Generator
) -> Integers:
    """Return (n, 3) random voxels [plane, row voxel, column voxel], at most so many, all corners of which are seen."""
    inside = np.argwhere(lit)
    some = inside[rng.permutation(len(inside))[: 4 * count]]
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * camera.to_image_axes(np.asarray(grid.spacing_mm))
    points = (voxel_centres(camera, grid, some)[:, np.newaxis] + corners).reshape(-1, 3)
    seen = space.slopes(camera, points, np.zeros((len(points), 2)))[1].reshape(-1, len(corners)).all(axis=1)
    return np.asarray(some[seen][:count])


def voxel_centres(camera: Camera, grid: Grid, voxels: Integers) -> Floats:
    """Return the centres (n, 3), image axes, of voxels [plane, row voxel, column voxel]."""
    first, second = (0, 1) if camera.column_axis == "x" else (1, 0)
    axes = (grid.axis_mm(first)[voxels[:, 2]], grid.axis_mm(second)[voxels[:, 1]], grid.axis_mm(2)[voxels[:, 0]])
    return np.stack(axes, axis=1)
