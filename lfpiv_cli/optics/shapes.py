"""What surfaces are made of: vectors in space, and a surface near the point where the optical axis meets it.

Axes: world axes, z away from the camera from the nominal focal point, mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit

Vector = tuple[float, float, float]

NO_AXIS: Vector = (0.0, 0.0, 0.0)


class Relief(NamedTuple):
    """Heights z over x and y as a bicubic spline, see `HeightMap`.

    Attributes
    ----------
    first_mm, step_mm : (2,) x and y of the first node, and from one node to the next
    coefficients : (ny - 1, nx - 1, 4, 4) of each cell: powers 0 to 3 of y, then of x, from its first node, in steps
    """

    first_mm: Floats
    step_mm: Floats
    coefficients: Floats

    def exchanged(self) -> Relief:
        """Return the heights with x and y exchanged."""
        return Relief(self.first_mm[::-1], self.step_mm[::-1], self.coefficients.transpose(1, 0, 3, 2))


class Shape(NamedTuple):
    """A surface near the optical axis, world axes.

    Attributes
    ----------
    vertex_mm : v, where the optical axis meets it
    normal : n there, unit, away from the camera
    axis : a, unit along a cylinder's axis, else 0
    curvature_per_mm : k, negative where the surface bulges towards the camera
    relief : where the surface is given by its heights, these, and they stand in place of the curvature
    """

    vertex_mm: Vector
    normal: Vector
    axis: Vector
    curvature_per_mm: float
    relief: Relief | None = None


def unit(direction: Sequence[float], name: str) -> Vector:
    """Return a direction with length 1.

    Raises
    ------
    ConfigError : it has none
    """
    length = float(np.linalg.norm(direction))
    if not length > 0.0:
        raise ConfigError(f"{name} is {list(direction)}, expected a direction")
    return direction[0] / length, direction[1] / length, direction[2] / length


def vector(values: Floats) -> Vector:
    """Return a vector of an array (3,)."""
    x, y, z = values.tolist()
    return x, y, z


@njit(cache=True, **COUNT_NO_REFERENCES)
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, **COUNT_NO_REFERENCES)
def plus(a: Vector, factor: float, b: Vector) -> Vector:
    """Return a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@njit(cache=True, **COUNT_NO_REFERENCES)
def scaled(factor: float, a: Vector) -> Vector:
    """Return factor a."""
    return factor * a[0], factor * a[1], factor * a[2]


@njit(cache=True, **COUNT_NO_REFERENCES)
def row(rows: Floats, k: int) -> Vector:
    """Return row k of an array (n, 3)."""
    return rows[k, 0], rows[k, 1], rows[k, 2]


@dataclass(frozen=True)
class RigidMotion:
    """How a body on the bench is moved: turned about a point, then shifted.

    Attributes
    ----------
    shift_mm : along the world axes
    turn_rad : vector along the axis of the turn, as long as its angle, right-handed
    pivot_mm : the point that only the shift moves
    """

    shift_mm: Vector = (0.0, 0.0, 0.0)
    turn_rad: Vector = (0.0, 0.0, 0.0)
    pivot_mm: Vector = (0.0, 0.0, 0.0)

    @property
    def turns(self) -> bool:
        """Whether it is more than a shift."""
        return any(self.turn_rad)

    def points(self, points_mm: ArrayLike) -> Floats:
        """Return where points (..., 3) are moved to."""
        pivot = np.asarray(self.pivot_mm)
        return self.directions(np.asarray(points_mm, dtype=np.float64) - pivot) + pivot + np.asarray(self.shift_mm)

    def directions(self, directions: ArrayLike) -> Floats:
        """Return how directions (..., 3) are turned."""
        return np.asarray(np.asarray(directions, dtype=np.float64) @ self._rotation.as_matrix().T)

    def point(self, point_mm: Sequence[float]) -> Vector:
        """Return where one point is moved to."""
        return vector(self.points(point_mm))

    def direction(self, direction: Sequence[float]) -> Vector:
        """Return how one direction is turned."""
        return vector(self.directions(direction))

    def then(self, later: RigidMotion) -> RigidMotion:
        """Return this motion followed by another, about this one's pivot."""
        shift = later.points(self.points(self.pivot_mm)) - np.asarray(self.pivot_mm)
        return RigidMotion(vector(shift), vector((later._rotation * self._rotation).as_rotvec()), self.pivot_mm)

    @property
    def _rotation(self) -> Rotation:
        return Rotation.from_rotvec(np.asarray(self.turn_rad, dtype=np.float64))


# Surfaces given by their heights on a regular grid: lenses, moulds, blades.
#
# Between the nodes the height is a bicubic spline, whose slopes and curvatures are continuous, as Newton's iteration
# for rays needs them. A line p + t d meets it where z(x, y) = z, by Newton's iteration in t; there, with the slopes
# z_x and z_y, the normal away from the camera is (-z_x, -z_y, 1) / sqrt(1 + z_x^2 + z_y^2).
#
# `Reliefs` are in image axes.

# Of a cubic spline along each axis whose ends are as smooth as its middle.
FEWEST_NODES = 4
# Newton's iteration converges quadratically: after a step of this length a line is on the surface to 1e-14 mm. It takes
# three to five; the limit guards against lines that graze.
CLOSE_MM = 1e-8
MOST_STEPS = 30

# The height, its two slopes, its second derivatives (xx, xy, yy), and whether the place is on the grid.
Height = tuple[float, float, float, float, float, float, bool]


@dataclass(frozen=True)
class HeightMap:
    """A smooth surface through heights on a regular grid; beyond the grid there is none.

    Attributes
    ----------
    heights_mm : rows along y of heights along x, away from the camera from centre_mm
    spacing_mm : between nodes along x and y
    centre_mm : of the grid, of height 0

    Raises
    ------
    ConfigError : rows of different length, or too few heights
    """

    heights_mm: tuple[tuple[float, ...], ...]
    spacing_mm: tuple[float, float]
    centre_mm: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse what is no grid."""
        lengths = {len(row) for row in self.heights_mm}
        if len(lengths) != 1 or min(len(self.heights_mm), *lengths) < FEWEST_NODES:
            raise ConfigError(
                f"{len(self.heights_mm)} rows of {' or '.join(map(str, sorted(lengths))) or 'no'} heights are no grid; "
                f"expected rows of the same length, and {FEWEST_NODES} or more heights along each axis"
            )

    @cached_property
    def relief(self) -> Relief:
        """The spline through the heights."""
        heights, step = np.array(self.heights_mm, dtype=np.float64), np.array(self.spacing_mm)
        rows, columns = (np.arange(length, dtype=np.float64) for length in heights.shape)
        along_y = CubicSpline(rows, heights + self.centre_mm[2], axis=0).c[::-1]
        # Powers of x, cells along x, powers of y, cells along y.
        along_both = CubicSpline(columns, along_y, axis=2).c[::-1]
        first = np.array(self.centre_mm[:2]) - 0.5 * (np.array(heights.shape[::-1]) - 1) * step
        return Relief(first, step, np.ascontiguousarray(along_both.transpose(3, 1, 2, 0)))

    def moved(self, motion: RigidMotion) -> HeightMap:
        """Return the surface shifted.

        Raises
        ------
        ConfigError : it is to be turned, but its grid lies along x and y
        """
        if motion.turns:
            raise ConfigError("a face of kind height_map cannot be turned: its grid lies along x and y")
        return replace(self, centre_mm=motion.point(self.centre_mm))

    def shape(self) -> Shape:
        """Return the surface near the optical axis, with its heights.

        Raises
        ------
        ConfigError : the optical axis goes past the grid
        """
        z, slope_x, slope_y, _, _, _, on_grid = height_at(reliefs_of([self.relief]), 0, 0.0, 0.0)
        if not on_grid:
            raise ConfigError(f"the optical axis goes past the grid of heights about {list(self.centre_mm)}")
        return Shape((0.0, 0.0, z), unit((-slope_x, -slope_y, 1.0), "normal"), NO_AXIS, 0.0, self.relief)


class Reliefs(NamedTuple):
    """The heights of all faces that are given by them, as compiled kernels take them.

    Attributes
    ----------
    starts : (m,) of each face, where its coefficients begin; -1 where it has no heights
    cells : (m, 2) along x and y
    firsts_mm, steps_mm : (m, 2), see `Relief`
    coefficients : of all, flat
    """

    starts: Integers
    cells: Integers
    firsts_mm: Floats
    steps_mm: Floats
    coefficients: Floats


def reliefs_of(reliefs: Sequence[Relief | None]) -> Reliefs:
    """Return the heights of faces, None where a face has none, for kernels."""
    count = len(reliefs)
    starts, cells = np.full(count, -1), np.zeros((count, 2), np.int64)
    firsts, steps = np.zeros((count, 2)), np.ones((count, 2))
    flat: list[Floats] = []
    for k, relief in enumerate(reliefs):
        if relief is not None:
            starts[k] = sum(part.size for part in flat)
            cells[k] = relief.coefficients.shape[1::-1]
            firsts[k], steps[k] = relief.first_mm, relief.step_mm
            flat.append(relief.coefficients.ravel())
    return Reliefs(starts, cells, firsts, steps, np.concatenate(flat))


@njit(cache=True, **COUNT_NO_REFERENCES)
def height_at(reliefs: Reliefs, k: int, x: float, y: float) -> Height:
    """Return the height of face k at (x, y), with its derivatives; beyond the grid its outermost cell goes on."""
    u = (x - reliefs.firsts_mm[k, 0]) / reliefs.steps_mm[k, 0]
    v = (y - reliefs.firsts_mm[k, 1]) / reliefs.steps_mm[k, 1]
    wide, high = reliefs.cells[k, 0], reliefs.cells[k, 1]
    on_grid = 0.0 <= u <= wide and 0.0 <= v <= high
    column = int(min(max(np.floor(u), 0.0), wide - 1.0))
    row = int(min(max(np.floor(v), 0.0), high - 1.0))
    u -= column
    v -= row
    start = reliefs.starts[k] + 16 * (row * wide + column)
    z, z_u, z_v, z_uu, z_uv, z_vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    # Horner's rule along v over polynomials of u.
    for power in range(3, -1, -1):
        place = start + 4 * power
        a, b = reliefs.coefficients[place], reliefs.coefficients[place + 1]
        c, d = reliefs.coefficients[place + 2], reliefs.coefficients[place + 3]
        z_vv = 2.0 * z_v + v * z_vv
        z_uv = z_u + v * z_uv
        z_v = z + v * z_v
        z = a + u * (b + u * (c + u * d)) + v * z
        z_u = b + u * (2.0 * c + 3.0 * u * d) + v * z_u
        z_uu = 2.0 * c + 6.0 * u * d + v * z_uu
    step_x, step_y = reliefs.steps_mm[k, 0], reliefs.steps_mm[k, 1]
    return (
        z,
        z_u / step_x,
        z_v / step_y,
        z_uu / (step_x * step_x),
        z_uv / (step_x * step_y),
        z_vv / (step_y * step_y),
        on_grid,
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def meet_heights(
    reliefs: Reliefs, k: int, vertex_z: float, point: Vector, direction: Vector
) -> tuple[float, Vector, float]:
    """Return `surfaces.meet` of a face that is given by its heights; Newton's iteration from the vertex's depth on."""
    path = (vertex_z - point[2]) / direction[2]
    normal = (0.0, 0.0, 1.0)
    for _ in range(MOST_STEPS):
        place = plus(point, path, direction)
        z, slope_x, slope_y, _, _, _, on_grid = height_at(reliefs, k, place[0], place[1])
        normal = (-slope_x, -slope_y, 1.0)
        rise = dot(normal, direction)
        if not rise > 0.0:
            return 0.0, normal, 0.0
        step = (z - place[2]) / rise
        path += step
        if abs(step) <= CLOSE_MM:
            shortening = 1.0 / np.sqrt(dot(normal, normal))
            return path, scaled(shortening, normal), rise * shortening if on_grid else 0.0
    return 0.0, normal, 0.0


@njit(cache=True, **COUNT_NO_REFERENCES)
def normal_change_of_heights(reliefs: Reliefs, k: int, place: Vector, shift: Vector) -> Vector:
    """Return `surfaces.normal_change` of a face that is given by its heights."""
    _, slope_x, slope_y, xx, xy, yy, _ = height_at(reliefs, k, place[0], place[1])
    shortening = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    normal = (-slope_x * shortening, -slope_y * shortening, shortening)
    turn = (-shortening * (xx * shift[0] + xy * shift[1]), -shortening * (xy * shift[0] + yy * shift[1]), 0.0)
    return plus(turn, -dot(normal, turn), normal)


@dataclass(frozen=True, eq=False)
class ScenePose:
    """How a scene lies beside the one of the config, as one rigid body, and how well that is known; world axes.

    Attributes
    ----------
    shift_mm, turn_deg : (3,) of all its faces, turned about the pivot first; the turn is a vector along its axis
    pivot_mm : (3,)
    shift_sigma_mm, turn_sigma_deg : (3,) standard errors; 0 of what nothing shows and stays as the config has it
    faces_sha256 : of the config's scene that it is counted from
    """

    shift_mm: Floats
    turn_deg: Floats
    pivot_mm: Floats
    shift_sigma_mm: Floats
    turn_sigma_deg: Floats
    faces_sha256: str

    @property
    def motion(self) -> RigidMotion:
        """The motion from where the config has the scene."""
        return RigidMotion(vector(self.shift_mm), vector(np.deg2rad(self.turn_deg)), vector(self.pivot_mm))

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain lists, units in their names."""
        return {
            "scene_shift_mm": self.shift_mm.tolist(),
            "scene_shift_mm_sigma": self.shift_sigma_mm.tolist(),
            "scene_turn_deg": self.turn_deg.tolist(),
            "scene_turn_deg_sigma": self.turn_sigma_deg.tolist(),
        }
