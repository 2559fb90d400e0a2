"""What lies between the scene and the main lens where its faces are not plane: round pipes, spheres, tilted windows.

The same questions as `ObjectSpace` answers for plane layers, by exact rays. There is no paraxial point in air that all
rays of a point come from: behind a cylinder a pencil of rays is astigmatic, and its two apparent distances (see
`equivalent`) differ by far more than the depth over which light spreads.

Axes: image axes (x along the columns, see `camera`), z away from the camera from the nominal focal point, mm. Surfaces
are given in world axes, and these lie along the rectified image: the camera's rotation, where a calibration has found
one, is taken out of the images and turns no surface.

Notes
-----
The two apparent distances on the optical axis, paraxially. Let the pencil in a plane through the axis meet, in the
order of the light from the camera, faces of curvature c_k in that plane (1/R where they bulge towards the camera, 0
along a cylinder's axis), with index n_(k-1) in front and n_k behind, t_k apart. To rays close to the axis a point u_k
behind face k seems to lie, seen from in front of it, u'_k behind it. Snell's law for small angles from the normal,
which at height h is tilted by h c, is n_(k-1) (h/u' - h c) = n_k (h/u - h c), so

    n_(k-1) / u'_k = n_k / u_k - (n_k - n_(k-1)) c_k,     u_(k-1) = t_(k-1) + u'_k

from the fluid to the first face; the apparent distance is d_1 + u'_1, and each face shows the image n_k u'_k /
(n_(k-1) u_k) times as large. With c = 0 these are Eqs. 6 and 9 of plane layers. A point at the common centre of
concentric cylinders stays where it is across them (u' = u = R), whatever the indices, where the planes along the axis
lift it by sum t_k (1 - n_a / n_k): 1.9 mm for 5 mm of water behind 2 mm of acrylic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.shapes import RigidMotion, Shape, Vector, dot, plus, reliefs_of, scaled
from lfpiv_cli.optics.surfaces import Faces, Surface, height_behind, meet, normal_change

# Rays through the faces by Snell's law, compiled: from the lens into the fluid, and from a point aimed.
#
# Slopes are those of `tracing`: how fast a ray moves away from where it is, towards larger |lateral| position, on its
# way to the lens. Lines are followed with directions of length 1 away from the camera, whichever way the light goes.
# Snell's law in vectors, with r the refractive index in front of a face over that behind it, n its unit normal and
# c, c' the cosines of incidence and refraction:
#
#     d' = r d + (c' - r c) n,    c'^2 = 1 - r^2 (1 - c^2)
#
# A ray that misses a face, is totally reflected, or ends outside the fluid is told by a flag, never by an exception.

# What a point may lie in front of the face that it touches, and a path go backwards, by rounding.
ROUNDING_MM = 1e-9
# Newton's iteration for the ray through a point converges quadratically: from this near a last step reaches 1e-13 mm.
CLOSE_MM = 1e-6
# It takes four steps, ten close to where light grazes; the limit guards against points that no ray reaches.
MOST_STEPS = 40

Place = tuple[float, float, bool]
NOWHERE: Place = (np.nan, np.nan, False)
Met = tuple[float, Vector, Vector, Vector, float, float]


@njit(cache=True, **COUNT_NO_REFERENCES)
def refracted(direction: Vector, normal: Vector, cosine: float, ratio: float) -> tuple[Vector, float]:
    """Return the direction behind a face and its cosine of refraction, 0 where light is totally reflected."""
    squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    if squared <= 0.0:
        return direction, 0.0
    cosine_behind = np.sqrt(squared)
    return plus(scaled(ratio, direction), cosine_behind - ratio * cosine, normal), cosine_behind


@njit(cache=True, **COUNT_NO_REFERENCES)
def start_at_lens(faces: Faces, X: float, Y: float, slope_x: float, slope_y: float) -> tuple[Vector, Vector]:
    """Return where a ray crosses the main lens and its direction into the scene."""
    shortening = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    return (X, Y, faces.lens_z_mm), (-slope_x * shortening, -slope_y * shortening, shortening)


@njit(cache=True, **COUNT_NO_REFERENCES)
def in_fluid(faces: Faces, point: Vector) -> bool:
    """Return whether a point lies behind the last face, or no further in front of it than may be."""
    return height_behind(faces.reliefs, faces, faces.ratios.size - 1, point) >= -ROUNDING_MM - faces.beyond_mm


@njit(cache=True, **COUNT_NO_REFERENCES)
def trace_in(faces: Faces, X: float, Y: float, slope_x: float, slope_y: float, z: float) -> Place:
    """Return where a ray from the lens meets the plane of depth z in the fluid: x, y and whether it does."""
    point, direction = start_at_lens(faces, X, Y, slope_x, slope_y)
    for k in range(faces.ratios.size):
        path, normal, cosine = meet(faces.reliefs, faces, k, point, direction)
        if cosine == 0.0 or path < -ROUNDING_MM:
            return NOWHERE
        point = plus(point, path, direction)
        direction, cosine = refracted(direction, normal, cosine, faces.ratios[k])
        if cosine == 0.0 or direction[2] <= 0.0:
            return NOWHERE
    path = (z - point[2]) / direction[2]
    if path < -ROUNDING_MM:
        return NOWHERE
    point = plus(point, path, direction)
    return point[0], point[1], in_fluid(faces, point)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _neighbour(faces: Faces, k: int, shift: Vector, turn: Vector, ray: Met) -> tuple[Vector, Vector]:
    """Return the first-order shift and turn of a ray beside the one that `meet` and `refracted` took through face k.

    Parameters
    ----------
    shift, turn : how its point and direction differ before the face
    ray : how far the ray itself went to which place on the face, its direction in front of it, and what it met there:
        normal and cosines of incidence and refraction
    """
    path, place, direction, normal, cosine, cosine_behind = ray
    ratio = faces.ratios[k]
    shift = plus(shift, path, turn)
    shift = plus(shift, -dot(normal, shift) / cosine, direction)
    tilt = normal_change(faces.reliefs, faces, k, place, shift)
    cosine_change = dot(tilt, direction) + dot(normal, turn)
    bend_change = ratio * (ratio * cosine / cosine_behind - 1.0) * cosine_change
    turned = plus(plus(scaled(ratio, turn), bend_change, normal), cosine_behind - ratio * cosine, tilt)
    return shift, turned


@njit(cache=True, **COUNT_NO_REFERENCES)
def trace_pencil(
    faces: Faces,
    point: Vector,
    direction: Vector,
    shifts: tuple[Vector, Vector],
    turns: tuple[Vector, Vector],
    z: float,
) -> tuple[Vector, Vector, Vector, Vector, bool]:
    """Return where a ray from the lens meets the plane of depth z, its direction, and how two beside it are shifted.

    The path may go backwards in the fluid, as Newton's iteration needs it.

    Parameters
    ----------
    point, direction : of the ray at the lens, from `start_at_lens`
    shifts, turns : of both rays beside it there, first order
    """
    first, second = shifts
    first_turn, second_turn = turns
    for k in range(faces.ratios.size):
        path, normal, cosine = meet(faces.reliefs, faces, k, point, direction)
        if cosine == 0.0 or path < -ROUNDING_MM:
            return point, direction, first, second, False
        point = plus(point, path, direction)
        behind, cosine_behind = refracted(direction, normal, cosine, faces.ratios[k])
        if cosine_behind == 0.0 or behind[2] <= 0.0:
            return point, direction, first, second, False
        ray = path, point, direction, normal, cosine, cosine_behind
        first, first_turn = _neighbour(faces, k, first, first_turn, ray)
        second, second_turn = _neighbour(faces, k, second, second_turn, ray)
        direction = behind
    path = (z - point[2]) / direction[2]
    first, second = plus(first, path, first_turn), plus(second, path, second_turn)
    first = plus(first, -first[2] / direction[2], direction)
    second = plus(second, -second[2] / direction[2], direction)
    return plus(point, path, direction), direction, first, second, True


@njit(cache=True, **COUNT_NO_REFERENCES)
def slope_turns(direction: Vector) -> tuple[Vector, Vector]:
    """Return how a direction at the lens turns with each of its slopes."""
    along_x = plus((-direction[2], 0.0, 0.0), direction[2] * direction[0], direction)
    along_y = plus((0.0, -direction[2], 0.0), direction[2] * direction[1], direction)
    return along_x, along_y


@njit(cache=True, **COUNT_NO_REFERENCES)
def aim(faces: Faces, x: float, y: float, z: float, X: float, Y: float) -> Place:
    """Return the slopes at the lens of the ray from a point that crosses it at (X, Y), and whether there is one.

    Newton's iteration on `trace_in` from the ray through planes at the vertices, its steps halved where they miss.
    """
    if not in_fluid(faces, (x, y, z)):
        return NOWHERE
    distance = faces.focus_distance_mm + faces.depth_ratio * z
    # A ray towards the optical axis always meets the faces: steps are halved towards it.
    slope_x, slope_y = X / distance, Y / distance
    step_x, step_y = -x / distance, -y / distance
    share, nearest = 1.0, np.inf
    still = (0.0, 0.0, 0.0)
    for _ in range(MOST_STEPS):
        point, direction = start_at_lens(faces, X, Y, slope_x + share * step_x, slope_y + share * step_y)
        end, _, first, second, met = trace_pencil(faces, point, direction, (still, still), slope_turns(direction), z)
        left_x, left_y = x - end[0], y - end[1]
        missed = np.sqrt(left_x * left_x + left_y * left_y)
        if not met or missed >= nearest:
            share *= 0.5
            continue
        slope_x, slope_y, share, nearest = slope_x + share * step_x, slope_y + share * step_y, 1.0, missed
        determinant = first[0] * second[1] - second[0] * first[1]
        if determinant == 0.0:
            return NOWHERE
        step_x = (second[1] * left_x - second[0] * left_y) / determinant
        step_y = (first[0] * left_y - first[1] * left_x) / determinant
        if missed <= CLOSE_MM:
            return slope_x + step_x, slope_y + step_y, True
    return NOWHERE


@njit(cache=True)
def aim_all(faces: Faces, points: Floats, crossing: Floats) -> tuple[Floats, Flags]:
    """Return `aim` from each point through each crossing: slopes (n, 2) and whether they are valid (n,)."""
    slopes, valid = np.empty((len(points), 2)), np.empty(len(points), dtype=np.bool_)
    for i in range(len(points)):
        slopes[i, 0], slopes[i, 1], valid[i] = aim(
            faces, points[i, 0], points[i, 1], points[i, 2], crossing[i, 0], crossing[i, 1]
        )
    return slopes, valid


@njit(cache=True)
def pencils(faces: Faces, points: Floats) -> tuple[Floats, Floats, Flags]:
    """Return, for the ray from each point through the lens' middle, its slopes (n, 2) and their growth (n, 2, 2).

    The growth [k, l] is how slope k grows with the crossing along axis l.
    """
    slopes, growth = np.full((len(points), 2), np.nan), np.full((len(points), 2, 2), np.nan)
    valid = np.empty(len(points), dtype=np.bool_)
    still = (0.0, 0.0, 0.0)
    for i in range(len(points)):
        slopes[i, 0], slopes[i, 1], valid[i] = aim(faces, points[i, 0], points[i, 1], points[i, 2], 0.0, 0.0)
        if not valid[i]:
            continue
        point, direction = start_at_lens(faces, 0.0, 0.0, slopes[i, 0], slopes[i, 1])
        turns, sideways = slope_turns(direction), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        _, _, a, b, _ = trace_pencil(faces, point, direction, (still, still), turns, points[i, 2])
        _, _, c, d, _ = trace_pencil(faces, point, direction, sideways, (still, still), points[i, 2])
        determinant = a[0] * b[1] - b[0] * a[1]
        # The place stays: [a b] growth + [c d] = 0.
        growth[i, 0, 0] = (b[0] * c[1] - b[1] * c[0]) / determinant
        growth[i, 0, 1] = (b[0] * d[1] - b[1] * d[0]) / determinant
        growth[i, 1, 0] = (a[1] * c[0] - a[0] * c[1]) / determinant
        growth[i, 1, 1] = (a[1] * d[0] - a[0] * d[1]) / determinant
    return slopes, growth, valid


@dataclass(frozen=True)
class Face:
    """A surface, and the refractive index behind it as seen from the camera."""

    surface: Surface
    index: float


@dataclass(frozen=True)
class CurvedSpace:
    """Refracting faces in front of the lens, in the order in which light from the camera would meet them.

    Attributes
    ----------
    media : refractive indices; of these the air in front of the first face and the fluid behind the last count
    faces : from the camera on

    Raises
    ------
    ConfigError : no face, one that the optical axis misses, faces not in order, or no fluid behind the last
    """

    media: Media
    faces: tuple[Face, ...]

    def __post_init__(self) -> None:
        """Refuse faces that light cannot cross one after another along the optical axis."""
        if not self.faces:
            raise ConfigError("a scene needs at least one face")
        if self.faces[-1].index != self.media.fluid:
            raise ConfigError(
                f"behind the last face the index is {self.faces[-1].index:g}, not the fluid's {self.media.fluid:g}"
            )
        depths = [shape.vertex_mm[2] for shape in self.shapes()]
        for k, (front, back) in enumerate(zip(depths, depths[1:], strict=False)):
            if back <= front:
                raise ConfigError(
                    f"face {k + 2} meets the optical axis at z = {back:g} mm, face {k + 1} at {front:g}; expected them "
                    "from the camera on"
                )

    def moved(self, motion: RigidMotion) -> CurvedSpace:
        """Return the faces moved as one rigid body.

        Raises
        ------
        ConfigError : the optical axis misses one then, or one cannot be turned
        """
        return CurvedSpace(self.media, tuple(Face(face.surface.moved(motion), face.index) for face in self.faces))

    def shapes(self) -> tuple[Shape, ...]:
        """Return the faces near the optical axis.

        Raises
        ------
        ConfigError : the optical axis misses one
        """
        return tuple(face.surface.shape() for face in self.faces)

    def lens_z_mm(self, camera: Camera) -> float:
        """Return z of the main lens, from which planes at the faces' vertices show the focal point in focus.

        Raises
        ------
        ConfigError : the first face lies behind the lens
        """
        depths = np.array([*(shape.vertex_mm[2] for shape in self.shapes()), 0.0])
        indices = np.array([face.index for face in self.faces])
        in_front = camera.focus_distance_mm - self.media.air * float(np.sum(np.diff(depths) / indices))
        if in_front <= 0.0:
            raise ConfigError(f"the first face, at z = {depths[0]:g} mm, lies behind the lens")
        return float(depths[0] - in_front)

    def for_kernels(self, camera: Camera) -> Faces:
        """Return the faces as compiled kernels take them, in image axes.

        Raises
        ------
        ConfigError : the first face lies behind the lens
        """
        shapes = self.shapes()
        heights = [shape.relief for shape in shapes]
        if camera.column_axis == "y":
            heights = [each and each.exchanged() for each in heights]
        indices = np.array([self.media.air, *(face.index for face in self.faces)])
        return Faces(
            lens_z_mm=self.lens_z_mm(camera),
            focus_distance_mm=camera.focus_distance_mm,
            depth_ratio=self.media.depth_ratio,
            vertices_mm=_rows(camera.to_image_axes([shape.vertex_mm for shape in shapes]), 3),
            normals=_rows(camera.to_image_axes([shape.normal for shape in shapes]), 3),
            axes=_rows(camera.to_image_axes([shape.axis for shape in shapes]), 3),
            curvatures_per_mm=np.array([shape.curvature_per_mm for shape in shapes]),
            ratios=indices[:-1] / indices[1:],
            reliefs=reliefs_of(heights) if any(heights) else None,
        )

    def slopes(self, camera: Camera, points_mm: ArrayLike, crossing_mm: ArrayLike) -> tuple[Floats, Flags]:
        """Return the slopes (n, 2) at the lens of the rays from points (n, 3) that cross it at (n, 2), if they do."""
        crossing = _rows(crossing_mm, 2)
        points = np.ascontiguousarray(np.broadcast_to(_rows(points_mm, 3), (len(crossing), 3)))
        return aim_all(self.for_kernels(camera), points, crossing)

    def equivalent(self, camera: Camera, points_mm: ArrayLike) -> tuple[Floats, Floats, Flags]:
        """Return where points (n, 3) seem to lie in air, along each image axis, to rays near the middle of the lens.

        Along image axis k the slope of such a ray is (X_k - place_k) / distance_k. Away from a cylinder's two planes of
        symmetry it also changes with the crossing along the other axis; that is left out.

        Returns
        -------
        Places and distances (n, 2), mm, NaN where there are none, and (n,) whether the point is in the fluid and seen
        from the middle of the lens.
        """
        slopes, growth, valid = pencils(self.for_kernels(camera), _rows(points_mm, 3))
        distance = 1.0 / growth[:, [0, 1], [0, 1]]
        return -slopes * distance, distance, valid


def _rows(values: ArrayLike, columns: int) -> Floats:
    """Return rows of so many coordinates."""
    return np.ascontiguousarray(values, dtype=np.float64).reshape(-1, columns)
