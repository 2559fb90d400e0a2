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

from lfpiv_cli.arrays import Floats, Singles
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
        first, weights = _about((z - lines.first_depth_mm) / lines.depth_step_mm, len(lines.table))
        plane = np.tensordot(np.array(weights), lines.table[first : first + 4], 1)
        # From phases to places; sums end halfway between the offsets of the responses.
        offsets, _, terms, _ = plane.shape
        by_place = plane.transpose(0, 3, 1, 2).reshape(offsets, -1, terms)
        sums = np.cumsum(by_place, axis=0, dtype=np.float64)
        spot = (-back * position_mm[:2] - rays.ideal_mm) / lines.offset_step_mm + 0.5 * offsets - 1.0
        under = (rays.place_mm - camera.micro_image_scale * rays.lens_mm) / camera.pixel_mm
        half = 0.5 * strips.width_mm
        sides = np.stack([strips.begin_mm, strips.end_mm, strips.aside_mm - half, strips.aside_mm + half])
        shares = np.empty(len(spot))
        _add_strips(
            sums, spot, PHASES * under + 0.5 * sums.shape[1], back / lines.offset_step_mm * sides, lines.signs, shares
        )
        return shares


@njit(cache=True)
def _about(place: float, count: int) -> tuple[int, tuple[float, float, float, float]]:
    """Return the first of four coefficients about a place among so many, and their weights."""
    inside = min(max(place, 1.0), count - 2.001)
    return int(inside) - 1, spline_weights(inside - int(inside))


@njit(cache=True, nogil=True)
def _add_strips(sums: Floats, spot: Floats, under: Floats, sides: Floats, signs: Singles, shares: Floats) -> None:
    """Write the light (n,) of strips over that of light that fills the scene.

    Parameters
    ----------
    sums : (offsets, responses, terms) of the line responses up to an offset
    spot, under : (n, 2) the spot of the shape's place among offsets, and pixels among responses
    sides : (4, strips) where along x they begin and end, along y the same, from the shape's place, in offsets
    """
    offsets, responses, terms = sums.shape
    lines, ends, light = np.empty((2, offsets, terms)), np.empty((4, terms)), np.empty(terms)
    for n in range(len(spot)):
        for axis in range(2):
            first, (a, b, c, d) = _about(under[n, axis], responses)
            to_sides = sides[2 * axis : 2 * axis + 2]
            begin, _ = _about(spot[n, axis] - to_sides.max(), offsets)
            end, _ = _about(spot[n, axis] - to_sides.min(), offsets)
            for place in range(begin, end + 5):
                # the last one is that of all light
                offset = place if place < end + 4 else offsets - 1
                four, line = sums[offset, first : first + 4], lines[axis, offset]
                for term in range(terms):
                    line[term] = a * four[0, term] + b * four[1, term] + c * four[2, term] + d * four[3, term]
        light[:] = 0.0
        for strip in range(sides.shape[1]):
            for side in range(4):
                first, (a, b, c, d) = _about(spot[n, side // 2] - sides[side, strip], offsets)
                four = lines[side // 2, first : first + 4]
                for term in range(terms):
                    ends[side, term] = a * four[0, term] + b * four[1, term] + c * four[2, term] + d * four[3, term]
            for term in range(terms):
                light[term] += (ends[0, term] - ends[1, term]) * (ends[2, term] - ends[3, term])
        shares[n] = np.sum(signs * light) / np.sum(signs * lines[0, offsets - 1] * lines[1, offsets - 1])
