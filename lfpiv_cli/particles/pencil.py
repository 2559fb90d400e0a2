"""The rays of a particle behind curved faces: a point in air along each image axis, and what they differ from it.

Behind a cylinder the rays of a point are astigmatic: along its axis they seem to come from another depth than across
it, by millimetres. Along image axis k, the slopes of the rays over the main lens are written as

    s_k(X, Y) = (X_k - place_k) / distance_k + r_k(X, Y)

with the straight line that is closest to them over the aperture's disc, and a cubic r_k: coma, the aberration of the
rim, and the astigmatism of a point away from the planes of symmetry. In a water pipe of 10 mm and at f/4 the cubic
moves light by up to 9 um on the array, and what it leaves moves it by 0.3 um, 3 um a tenth of a millimetre before the
wall.

Both come from rays aimed through the nodes of a cubature, which is right for polynomials of degree 7. How the line
changes with the point's place follows from the same rays.

Axes: image axes, z away from the camera from the nominal focal point, mm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.optics.curved_space import aim, slope_turns, start_at_lens, trace_pencil
from lfpiv_cli.optics.surfaces import Faces

# Twelve nodes on the disc of radius 1 and their weights, exact up to degree 7 (Stroud's S2 7-1).
_ROOT = np.sqrt(29.0)
_ON_AXIS, _INNER, _OUTER = np.sqrt(0.75), np.sqrt((27.0 - 3.0 * _ROOT) / 104.0), np.sqrt((27.0 + 3.0 * _ROOT) / 104.0)
NODES = np.array(
    [(_ON_AXIS, 0.0), (-_ON_AXIS, 0.0), (0.0, _ON_AXIS), (0.0, -_ON_AXIS)]
    + [(sign_x * at, sign_y * at) for at in (_INNER, _OUTER) for sign_x in (1.0, -1.0) for sign_y in (1.0, -1.0)]
)
WEIGHTS = np.repeat([2.0 / 27.0, (551.0 + 41.0 * _ROOT) / 6264.0, (551.0 - 41.0 * _ROOT) / 6264.0], 4)
# The mean square of a coordinate over the disc.
MEAN_SQUARE = 0.25
# Powers (of X, of Y) of a cubic's terms: those that X does not change first, so that along a row of pixels each four,
# three, two and one are one coefficient.
POWERS = np.array([(i, j) for i in range(4) for j in range(4 - i)])
TERMS = len(POWERS)
_AT_NODES = NODES[:, :1] ** POWERS[:, 0] * NODES[:, 1:] ** POWERS[:, 1]
# From values at the nodes to the coefficients of the cubic that is closest over the disc.
TO_CUBIC = np.linalg.solve(_AT_NODES.T @ (WEIGHTS[:, np.newaxis] * _AT_NODES), _AT_NODES.T * WEIGHTS)
# A ray that misses the point by less is right after one more of Newton's steps, to a tenth of a nanometre.
CLOSE_MM = 1e-3
# Rays start close, from the middle one and its neighbours: one or two steps are the rule.
STEPS = 6


class Pencil(NamedTuple):
    """The rays of a particle over the main lens.

    Attributes
    ----------
    line : (2, 2) along each image axis place_k and distance_k; all 0 where part of the lens does not see the point
    line_moves : (2, 2, 3) their derivatives by x, y and z
    cubic : (2, TERMS) r_k in mm of X and Y, see `POWERS`
    slopes : (12, 2) of the rays through the nodes, from which the others follow
    """

    line: Floats
    line_moves: Floats
    cubic: Floats
    slopes: Floats


class Aimed(NamedTuple):
    """A ray from a point: its slopes at the lens, their derivatives by x, y and z, and whether there is one."""

    slope_x: float
    slope_y: float
    moves_x: tuple[float, float, float]
    moves_y: tuple[float, float, float]
    there: bool


@njit(cache=True)
def room_for_pencil() -> Pencil:
    """Return the room for the rays of a point."""
    return Pencil(np.zeros((2, 2)), np.zeros((2, 2, 3)), np.zeros((2, TERMS)), np.zeros((WEIGHTS.size, 2)))


@njit(cache=True, **COUNT_NO_REFERENCES)
def set_pencil(faces: Faces, radius: float, x: float, y: float, z: float, pencil: Pencil) -> None:
    """Fill in the rays of a point over a main lens of that radius."""
    line, line_moves, cubic, slopes = pencil
    _clear(pencil)
    if not (_sum_rays(faces, radius, (x, y, z), pencil) and line[0, 1] > 0.0 and line[1, 1] > 0.0):
        _clear(pencil)
        return
    for k in range(2):
        _set_cubic(slopes[:, k], radius, line[k, 0], line[k, 1], k, cubic[k])
        _set_line(line[k], line_moves[k])


@njit(cache=True, **COUNT_NO_REFERENCES)
def _clear(pencil: Pencil) -> None:
    """Fill in 0: a point that is not seen."""
    for k in range(2):
        for m in range(2):
            pencil.line[k, m] = 0.0
            for j in range(3):
                pencil.line_moves[k, m, j] = 0.0
        for term in range(TERMS):
            pencil.cubic[k, term] = 0.0


@njit(cache=True, **COUNT_NO_REFERENCES)
def _sum_rays(faces: Faces, radius: float, place: tuple[float, float, float], pencil: Pencil) -> bool:
    """Add up the slopes of a point's rays, their means and how they grow over the lens; return whether it is seen."""
    (x, y, z), (line, line_moves, _, slopes) = place, pencil
    middle_x, middle_y, there = aim(faces, x, y, z, 0.0, 0.0)
    if not there:
        return False
    growth = _growth(faces, middle_x, middle_y, z)
    for n in range(WEIGHTS.size):
        u, v = NODES[n]
        start_x = middle_x + radius * (growth[0] * u + growth[1] * v)
        start_y = middle_y + radius * (growth[2] * u + growth[3] * v)
        ray = _aimed(faces, place, radius * u, radius * v, start_x, start_y)
        if not ray.there:
            return False
        slopes[n, 0], slopes[n, 1] = ray.slope_x, ray.slope_y
        for k in range(2):
            moves = ray.moves_x if k == 0 else ray.moves_y
            rise = WEIGHTS[n] * NODES[n, k] / (MEAN_SQUARE * radius)
            line[k, 0] += WEIGHTS[n] * slopes[n, k]
            line[k, 1] += rise * slopes[n, k]
            for j in range(3):
                line_moves[k, 0, j] += WEIGHTS[n] * moves[j]
                line_moves[k, 1, j] += rise * moves[j]
    return True


@njit(cache=True, **COUNT_NO_REFERENCES)
def _growth(faces: Faces, slope_x: float, slope_y: float, z: float) -> tuple[float, float, float, float]:
    """Return how the slopes of rays of one point grow next to the middle of the lens: x by X and Y, y by X and Y."""
    point, direction = start_at_lens(faces, 0.0, 0.0, slope_x, slope_y)
    still, sideways = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    _, _, a, b, _ = trace_pencil(faces, point, direction, still, slope_turns(direction), z)
    _, _, c, d, _ = trace_pencil(faces, point, direction, sideways, still, z)
    determinant = a[0] * b[1] - b[0] * a[1]
    # The point stays: [a b] growth + [c d] = 0.
    return (
        (b[0] * c[1] - b[1] * c[0]) / determinant,
        (b[0] * d[1] - b[1] * d[0]) / determinant,
        (a[1] * c[0] - a[0] * c[1]) / determinant,
        (a[1] * d[0] - a[0] * d[1]) / determinant,
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def _aimed(
    faces: Faces, place: tuple[float, float, float], X: float, Y: float, slope_x: float, slope_y: float
) -> Aimed:
    """Return the ray from a place that crosses the lens at (X, Y), by Newton's iteration from slopes near its own."""
    x, y, z = place
    still, lost = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), False
    for step in range(STEPS):
        if lost or step == STEPS // 2:
            # Too far off to begin with: begin again, carefully.
            slope_x, slope_y, there = aim(faces, x, y, z, X, Y)
            if not there:
                break
        point, direction = start_at_lens(faces, X, Y, slope_x, slope_y)
        end, behind, first, second, met = trace_pencil(faces, point, direction, still, slope_turns(direction), z)
        determinant = first[0] * second[1] - second[0] * first[1]
        lost = not met or determinant == 0.0
        if lost:
            continue
        left_x, left_y = x - end[0], y - end[1]
        slope_x += (second[1] * left_x - second[0] * left_y) / determinant
        slope_y += (first[0] * left_y - first[1] * left_x) / determinant
        if left_x * left_x + left_y * left_y > CLOSE_MM * CLOSE_MM:
            continue
        # Where the ray's own end moves by with z, slopes must take back.
        by_z_x, by_z_y = behind[0] / behind[2], behind[1] / behind[2]
        moves_x = (
            second[1] / determinant,
            -second[0] / determinant,
            (second[0] * by_z_y - second[1] * by_z_x) / determinant,
        )
        moves_y = (
            -first[1] / determinant,
            first[0] / determinant,
            (first[1] * by_z_x - first[0] * by_z_y) / determinant,
        )
        return Aimed(slope_x, slope_y, moves_x, moves_y, True)
    return Aimed(0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_cubic(slopes: Floats, radius: float, offset: float, growth: float, k: int, cubic: Floats) -> None:
    """Set the cubic that slopes along axis k at the nodes leave of a straight line."""
    for term in range(TERMS):
        total = 0.0
        for n in range(WEIGHTS.size):
            total += TO_CUBIC[term, n] * (slopes[n] - offset - growth * radius * NODES[n, k])
        cubic[term] = total / radius ** (POWERS[term, 0] + POWERS[term, 1])


@njit(cache=True, **COUNT_NO_REFERENCES)
def _set_line(line: Floats, moves: Floats) -> None:
    """Turn the offset and the growth of a line of slopes, and their derivatives, into place and distance."""
    distance = 1.0 / line[1]
    place = -line[0] * distance
    for j in range(3):
        by_distance = -distance * distance * moves[1, j]
        moves[0, j] = -distance * moves[0, j] - line[0] * by_distance
        moves[1, j] = by_distance
    line[0], line[1] = place, distance


@njit(cache=True, **COUNT_NO_REFERENCES)
def in_row(cubic: Floats, Y: float) -> tuple[float, float, float, float]:
    """Return the coefficients of a cubic (TERMS,) in X where it crosses the lens at Y."""
    return (
        cubic[0] + Y * (cubic[1] + Y * (cubic[2] + Y * cubic[3])),
        cubic[4] + Y * (cubic[5] + Y * cubic[6]),
        cubic[7] + Y * cubic[8],
        cubic[9],
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def cubic_at(cubic: Floats, X: float, Y: float) -> float:
    """Return the value of a cubic (TERMS,) where it crosses the lens."""
    a, b, c, d = in_row(cubic, Y)
    return a + X * (b + X * (c + X * d))


@njit(cache=True, **COUNT_NO_REFERENCES)
def rises_at(cubic: Floats, X: float, Y: float) -> tuple[float, float]:
    """Return how the cubics along x and y (2, TERMS) rise, each along its own axis."""
    _, b, c, d = in_row(cubic[0], Y)
    e, f, g = cubic[1, 1] + X * (cubic[1, 5] + X * cubic[1, 8]), cubic[1, 2] + X * cubic[1, 6], cubic[1, 3]
    return b + X * (2.0 * c + X * 3.0 * d), e + Y * (2.0 * f + Y * 3.0 * g)


@njit(cache=True, **COUNT_NO_REFERENCES)
def largest_of(cubic: Floats, radius: float) -> float:
    """Return a bound of a cubic (TERMS,) on a disc."""
    total = 0.0
    for term in range(TERMS):
        total += abs(cubic[term]) * radius ** (POWERS[term, 0] + POWERS[term, 1])
    return total


@njit(cache=True)
def lines_of(faces: Faces, radius: float, points: Floats) -> tuple[Floats, ...]:
    """Return of points (n, 3 or more) `Pencil.line` (n, 2, 2), `line_moves` (n, 2, 2, 3), and a bound of r (n, 2)."""
    lines, moves, largest = np.empty((len(points), 2, 2)), np.empty((len(points), 2, 2, 3)), np.empty((len(points), 2))
    pencil = room_for_pencil()
    for n in range(len(points)):
        set_pencil(faces, radius, points[n, 0], points[n, 1], points[n, 2], pencil)
        for k in range(2):
            largest[n, k] = largest_of(pencil.cubic[k], radius)
            for m in range(2):
                lines[n, k, m] = pencil.line[k, m]
                for j in range(3):
                    moves[n, k, m, j] = pencil.line_moves[k, m, j]
    return lines, moves, largest
