"""Particles by Snell's law.

Behind plane faces rays do not all come from one point: those through the rim of the main lens come from nearer by,
some 6 um behind 5 mm of acrylic and 5 mm of water at f/4, a tenth of a millimetre behind 10 cm of water. Particles are
fitted with straight rays from the point that is closest to all of them (a cubic's slopes over a disc have their
least-squares line where it spreads to sqrt(2/3) of the radius), and with what the real rays differ from those
(`bend_of`, `displaced`).

The same point is where a volume, which comes from paraxial rays, has the particle; `places_by_snell` turns such places
into true ones.

Behind curved faces the point in air is one along each image axis, see `pencil`.

Axes: world or image axes, z away from the camera from the nominal focal point; lengths in mm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.optics.curved_space import aim, trace_in
from lfpiv_cli.optics.tracing import SLOPE_NODES, set_slope_polynomial, shallowest_mm, slope_ratio
from lfpiv_cli.particles.pencil import Pencil, cubic_at, largest_of, room_for_pencil, set_pencil
from lfpiv_cli.particles.view import View

# The shift changes by some 1e-3 of what a point moves: twice leaves a millionth of it.
REPEATS = 2


class Bend(NamedTuple):
    """Rays from a particle, and the straight ones from a point in air that stand for them.

    Attributes
    ----------
    x, y : the particle's lateral place
    nodes, factors : of its rays' slopes, see `tracing.slope_ratio`; empty where these rays are straight, and
        behind curved faces
    seen_x, seen_y, distance_x, distance_y : the point in air, and its distances from the lens along both image axes;
        0 where the lens does not see the particle
    line_moves, cubic : see `pencil.Pencil`; empty where no face is curved
    """

    x: float
    y: float
    nodes: Floats
    factors: Floats
    seen_x: float
    seen_y: float
    distance_x: float
    distance_y: float
    line_moves: Floats
    cubic: Floats


class Rays(NamedTuple):
    """Room for the rays of a particle: nodes and factors behind plane faces, and a pencil behind curved ones."""

    nodes: Floats
    factors: Floats
    pencil: Pencil


@njit(cache=True, **COUNT_NO_REFERENCES)
def _in_fluid(view: View, z: float) -> float:
    """Return a depth, or that just behind the window where it lies in front of the fluid."""
    return max(z, shallowest_mm(view.layers, view.scale.depth_mm))


@njit(cache=True)
def room_for_rays() -> Rays:
    """Return the room for the rays of a particle."""
    return Rays(np.zeros(SLOPE_NODES), np.zeros(SLOPE_NODES), room_for_pencil())


@njit(cache=True, **COUNT_NO_REFERENCES)
def bend_of(view: View, x: float, y: float, z: float, rays: Rays) -> Bend:
    """Return the rays of a particle, image axes, whose arrays stand in that room.

    The point in air has their slopes in the middle of the lens, and at sqrt(2/3) of its radius.
    """
    camera, faces, (nodes, factors, pencil) = view.camera, view.faces, rays
    line, flat, straight, none = pencil.line, pencil.line_moves[:0], pencil.cubic[:0], nodes[:0]
    if faces.ratios.size > 0:
        set_pencil(faces, camera.aperture_radius_mm, x, y, z, pencil)
        place_x, place_y, distance_x, distance_y = line[0, 0], line[1, 0], line[0, 1], line[1, 1]
        return Bend(x, y, none, none, place_x, place_y, distance_x, distance_y, pencil.line_moves, pencil.cubic)
    if view.layers.indices.size < 2:
        distance = camera.focus_distance_mm + view.depth_ratio * z
        return Bend(x, y, none, none, x, y, distance, distance, flat, straight)
    lateral2, radius = x * x + y * y, camera.aperture_radius_mm
    set_slope_polynomial(radius + np.sqrt(lateral2), view.layers, _in_fluid(view, z), nodes, factors)
    distance = 1.0 / slope_ratio(lateral2 + radius * radius / 1.5, nodes, factors)
    middle = distance * slope_ratio(lateral2, nodes, factors)
    return Bend(x, y, nodes, factors, middle * x, middle * y, distance, distance, flat, straight)


@njit(cache=True, **COUNT_NO_REFERENCES)
def is_seen(bend: Bend) -> bool:
    """Return whether the main lens sees the particle: not behind a pipe's wall."""
    return bend.distance_x > 0.0


@njit(cache=True, **COUNT_NO_REFERENCES)
def displaced(bend: Bend, at_x: float, at_y: float) -> tuple[float, float]:
    """Return by how much the real ray's slope (x, y) exceeds the straight one's where they cross the main lens."""
    if bend.cubic.shape[0] > 0:
        return cubic_at(bend.cubic[0], at_x, at_y), cubic_at(bend.cubic[1], at_x, at_y)
    if bend.nodes.size == 0:
        return 0.0, 0.0
    dx, dy = at_x - bend.x, at_y - bend.y
    ratio = slope_ratio(dx * dx + dy * dy, bend.nodes, bend.factors)
    return ratio * dx - (at_x - bend.seen_x) / bend.distance_x, ratio * dy - (at_y - bend.seen_y) / bend.distance_y


@njit(cache=True, **COUNT_NO_REFERENCES)
def largest_displacement(bend: Bend, radius: float) -> float:
    """Return a bound of what `displaced` returns on a main lens of that radius."""
    if bend.cubic.shape[0] > 0:
        return max(largest_of(bend.cubic[0], radius), largest_of(bend.cubic[1], radius))
    if bend.nodes.size == 0:
        return 0.0
    reach = radius + np.sqrt(bend.x * bend.x + bend.y * bend.y)
    middle = slope_ratio(0.0, bend.nodes, bend.factors)
    return abs(slope_ratio(reach * reach, bend.nodes, bend.factors) - middle) * reach


@njit(cache=True, **COUNT_NO_REFERENCES)
def on_line_of_sight(view: View, x: float, y: float, z: float, depth: float) -> tuple[float, float]:
    """Return where the ray from a point through the middle of the lens is at another depth: x and y.

    Where it is not in the fluid there, the point's own.
    """
    camera, faces = view.camera, view.faces
    if faces.ratios.size == 0:
        distance = camera.focus_distance_mm + view.depth_ratio * z
        stretch = (camera.focus_distance_mm + view.depth_ratio * depth) / distance
        return x * stretch, y * stretch
    slope_x, slope_y, seen = aim(faces, x, y, z, 0.0, 0.0)
    if seen:
        at_x, at_y, seen = trace_in(faces, 0.0, 0.0, slope_x, slope_y, depth)
        if seen:
            return at_x, at_y
    return x, y


def places_by_snell(points_mm: Floats, view: View) -> Floats:
    """Return the points (n, 3) that paraxial rays see at the given ones, mm.

    Behind curved faces volumes come from exact rays: there they are the given ones.
    """
    places = points_mm
    for _ in range(REPEATS):
        places = points_mm - paraxial_shift(places, view)
    return places


def paraxial_shift(points_mm: Floats, view: View) -> Floats:
    """Return how far (n, 3) from their places points are seen by who takes rays for paraxial, mm."""
    shift = np.zeros_like(points_mm)
    if view.layers.indices.size >= 2:
        _fill_shift(points_mm, view, room_for_rays(), shift)
    return shift


@njit(cache=True, **COUNT_NO_REFERENCES)
def _fill_shift(points_mm: Floats, view: View, rays: Rays, shift: Floats) -> None:
    """Fill in `paraxial_shift` (n, 3) of points behind layers."""
    for n in range(points_mm.shape[0]):
        x, y, z = points_mm[n, 0], points_mm[n, 1], _in_fluid(view, points_mm[n, 2])
        bend = bend_of(view, x, y, z, rays)
        depth = (bend.distance_x - view.camera.focus_distance_mm) / view.depth_ratio
        shift[n, 0], shift[n, 1], shift[n, 2] = bend.seen_x - x, bend.seen_y - y, depth - z
