"""What a small bright shape in the scene looks like on the sensor by waves, which lenses diffract and cut off.

A shape is a stack of strips. Under a lens the light of a point is a sum of products of line responses (see
`optics.line_responses`), and so is that of a strip: along either axis the response is a difference of its integral. Of
light that fills the scene it is the whole integral, which is what a white image shows: a pixel's share is the shape's
light over that one. By rays (`shape_fit`) a disc near the focal plane is taken for one that lies 0.02 mm nearer, as
lenses beside it are lit on one side.

Axes: image axes (x along the columns, y along the rows), mm, z away from the camera from the focal plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.calibration.shape_fit import PixelRays, SharesAndSlopes, Strips
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.line_responses import PHASES, LineResponses, line_responses, of_tracers, spline_weights
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.tracing import ObjectSpace

# Strips of a shape per lens that it is wide.
STRIPS_PER_LENS = 24
# Slopes are differences over this share of the fit's steps, a hundredth of how well it settles.
DIFFERENCE = 1e-3
# Shapes lie up to a fiftieth of the depth over which light spreads by a lens from where rays have them; with room for
# as much again and more.
BY_RAYS = 0.05
# Below this slope a strip is parallel to an edge.
PARALLEL = 1e-9


@dataclass(frozen=True)
class WaveLight:
    """Light of one wavelength in air, and by how many pixels charge diffuses in the sensor."""

    wavelength_mm: float
    diffusion_px: float


def disc_strips(radius_mm: float, lens_mm: float) -> Strips:
    """Return the strips of a disc where a lens sees so many mm of the scene, each as large as its part of the disc."""
    count = int(np.ceil(STRIPS_PER_LENS * 2.0 * radius_mm / lens_mm))
    turn = np.pi * (np.arange(count + 1) / count - 0.5)
    edges, below = radius_mm * np.sin(turn), 0.5 * radius_mm**2 * (turn + 0.5 * np.sin(2.0 * turn))
    width = np.diff(edges)
    half = np.asarray(np.diff(below) / width, dtype=np.float64)
    return Strips(-half, half, edges[:-1] + 0.5 * width, width)


def corner_strips(edges_mm: Floats, lens_mm: float) -> Strips:
    """Return the strips of two squares that meet in a corner, those where both of u and v have one sign.

    Parameters
    ----------
    edges_mm : (2, 2) rows: the squares' sides, x and y, along which u and v are counted
    """
    side = float(np.hypot(edges_mm[:, 0], edges_mm[:, 1]).mean())
    half = int(np.ceil(STRIPS_PER_LENS * side / lens_mm))
    width = np.full(2 * half, side / half)
    aside = width * (np.arange(2 * half) + 0.5 - half)
    to_edges = np.linalg.inv(edges_mm)
    # Each of u and v is 0 in one place of a strip; a strip along an edge meets it far away.
    slope = np.where(np.abs(to_edges[0]) * side < PARALLEL, PARALLEL / side, to_edges[0])
    cuts = np.sort(np.clip(-aside[:, np.newaxis] * to_edges[1] / slope, -side, side), axis=1)
    if slope.prod() < 0.0:
        return Strips(cuts[:, 0], cuts[:, 1], aside, width)
    end = np.full(2 * half, side)
    begins, ends = np.concatenate([-end, cuts[:, 1]]), np.concatenate([cuts[:, 0], end])
    return Strips(begins, ends, np.tile(aside, 2), np.tile(width, 2))


@dataclass(frozen=True, eq=False)
class WaveShapes:
    """Shapes between two depths, as square microlenses that stand upright show them.

    Attributes
    ----------
    camera, medium : with the lattice of the rectified frame; what the shapes stand in
    lines : responses of points
    """

    camera: Camera
    medium: Media
    lines: LineResponses

    @classmethod
    def of(cls, camera: Camera, medium: Media, light: WaveLight, depths_mm: Floats) -> WaveShapes:
        """Compute the line responses about depths (n,) that rays tell, some seconds' work."""
        space, beyond = ObjectSpace(medium, refraction="paraxial"), BY_RAYS * camera.scale(medium).depth_mm
        ends = float(depths_mm.min()) - beyond, float(depths_mm.max()) + beyond
        lines = line_responses(camera, space, light.wavelength_mm, ends)
        return cls(camera, medium, of_tracers(lines, 0.0, light.diffusion_px))

    @property
    def lens_mm(self) -> float:
        """What a lens sees of the focal plane."""
        return float(self.camera.lattice.pitch.mean()) / abs(self.camera.magnification)

    def shares_and_slopes(
        self, rays: PixelRays, strips: Strips, steps_mm: Floats, position_mm: Floats
    ) -> SharesAndSlopes:
        """Return the shares (n,) of a shape, and slopes (n, 3), by differences over parts of steps (3,), per mm."""
        shares = self.shares(rays, position_mm, strips)
        moved = [self.shares(rays, position_mm + step, strips) for step in DIFFERENCE * np.diag(steps_mm)]
        return shares, (np.stack(moved, axis=1) - shares[:, np.newaxis]) / (DIFFERENCE * steps_mm)

    def shares(self, rays: PixelRays, position_mm: Floats, strips: Strips) -> Floats:
        """Return for each pixel the light (n,) of a shape over that of light that fills the scene."""
        camera, lines, z = self.camera, self.lines, float(position_mm[2])
        back = camera.image_distance_mm / float(equivalent_object_distance(z, camera.focus_distance_mm, self.medium))
        (of_column, x, u), (of_row, y, v) = (self._lines_of(rays, -back * position_mm[:2], axis) for axis in (0, 1))
        first, weights = _about((z - lines.first_depth_mm) / lines.depth_step_mm, len(lines.table))
        plane = np.tensordot(np.array(weights), lines.table[first : first + 4], 1)
        # From phases to places: (offsets, terms, responses).
        offsets, _, terms, _ = plane.shape
        by_place = np.ascontiguousarray(plane.transpose(0, 2, 3, 1).reshape(offsets, terms, -1), dtype=np.float64)
        sums = np.cumsum(by_place, axis=0)
        begin, end = (self._read(sums, x - back * at, u) for at in (strips.begin_mm, strips.end_mm))
        half = 0.5 * strips.width_mm
        low, high = (self._read(sums, y - back * at, v) for at in (strips.aside_mm - half, strips.aside_mm + half))
        light = ((begin - end) * lines.signs).reshape(len(x), -1) @ (low - high).reshape(len(y), -1).T
        along, across = (self._read(sums[-1:], np.zeros_like(at), px)[:, 0] for at, px in ((x, u), (y, v)))
        filled = (along * lines.signs) @ across.T
        return np.asarray((light / filled)[of_column, of_row])

    def _lines_of(self, rays: PixelRays, spot_mm: Floats, axis: int) -> tuple[Integers, Floats, Floats]:
        """Return the column or row of each pixel (n,), and of each of these where spot (m, 1) and pixels (m,) lie.

        The spot from the lens, mm, and the pixels from the middle of the lens image. Distortion moves the lenses of one
        column apart by less than a thousandth of their width.
        """
        _, first, number = np.unique(rays.place_mm[:, axis], return_index=True, return_inverse=True)
        beside = spot_mm[axis] - np.bincount(number, rays.ideal_mm[:, axis]) / np.bincount(number)
        under = rays.place_mm[first, axis] - self.camera.micro_image_scale * rays.lens_mm[first, axis]
        return number, beside[:, np.newaxis], under / self.camera.pixel_mm

    def _read(self, sums: Floats, beside_mm: Floats, under_px: Floats) -> Floats:
        """Return sums (offsets, terms, responses) up to where spots (n, m) light pixels (n,): (n, m, terms).

        They end halfway between the offsets of the responses.
        """
        offset = beside_mm / self.lines.offset_step_mm + 0.5 * len(sums) - 1.0
        found = np.empty((*beside_mm.shape, sums.shape[1]))
        _interpolate(sums, offset, PHASES * under_px + 0.5 * sums.shape[2], found)
        return found


@njit(cache=True)
def _about(place: float, count: int) -> tuple[int, tuple[float, float, float, float]]:
    """Return the first of four coefficients about a place among so many, and their weights."""
    inside = min(max(place, 1.0), count - 2.001)
    return int(inside) - 1, spline_weights(inside - int(inside))


@njit(cache=True)
def _interpolate(table: Floats, offset: Floats, response: Floats, found: Floats) -> None:
    """Write a table (offsets, terms, responses) at places (n, m) and (n,): (n, m, terms).

    A table of one offset is that of all.
    """
    few = min(len(table), 4)
    for n in range(offset.shape[0]):
        first_response, of_response = _about(response[n], table.shape[2])
        for m in range(offset.shape[1]):
            first, of_offset = _about(offset[n, m], len(table)) if few == 4 else (0, (1.0, 0.0, 0.0, 0.0))
            for term in range(table.shape[1]):
                total = 0.0
                for a in range(few):
                    line = table[first + a, term]
                    for b in range(4):
                        total += of_offset[a] * of_response[b] * line[first_response + b]
                found[n, m, term] = total
