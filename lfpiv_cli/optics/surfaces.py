"""Refracting surfaces, each by what it is on the bench and as compiled kernels meet it.

Axes: z away from the camera from the nominal focal point, mm. Surfaces are given in world axes, whose x and y lie along
the edges of the rectified image: what a calibration knows of the camera's rotation is taken out of the images, so no
surface is turned with it. `Faces` are in image axes (see `camera`).

Planes, cylinders and spheres are one form near the point v where the optical axis meets them, q = p - v:

    F(p) = n.q + k/2 (q.q - (a.q)^2) = 0

with n the unit normal at v away from the camera, k the curvature (0 of a plane, negative where the surface bulges
towards the camera) and a the unit vector along a cylinder's axis (0 of a sphere). F is negative in front of the surface
and positive behind it; on the surface its gradient is the unit normal, and along a ray of unit direction its derivative
there is the cosine of incidence, which the quadratic equation of the crossing gives with the crossing itself.
Surfaces given by their heights are of another form (`shapes.HeightMap`).

A new kind is one dataclass with `shape` and `moved`, and one line of `SURFACES`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.names import Facing, SurfaceKind
from lfpiv_cli.optics.shapes import (
    NO_AXIS,
    HeightMap,
    Reliefs,
    RigidMotion,
    Shape,
    Vector,
    dot,
    height_at,
    meet_heights,
    normal_change_of_heights,
    plus,
    row,
    scaled,
    unit,
)


class Surface(Protocol):
    """What each kind of surface has."""

    def shape(self) -> Shape:
        """Return the surface near the optical axis.

        Raises
        ------
        ConfigError : the optical axis does not meet it
        """

    def moved(self, motion: RigidMotion) -> Surface:
        """Return the surface moved as a rigid body.

        Raises
        ------
        ConfigError : it cannot be
        """


@dataclass(frozen=True)
class Plane:
    """A plane square to the optical axis, at depth z_mm."""

    z_mm: float

    def shape(self) -> Shape:
        """Return the plane near the optical axis."""
        return Shape((0.0, 0.0, self.z_mm), (0.0, 0.0, 1.0), NO_AXIS, 0.0)

    def moved(self, motion: RigidMotion) -> Plane | TiltedPlane:
        """Return the plane moved as a rigid body."""
        point = motion.point((0.0, 0.0, self.z_mm))
        return TiltedPlane(point, motion.direction((0.0, 0.0, 1.0))) if motion.turns else Plane(point[2])


@dataclass(frozen=True)
class TiltedPlane:
    """A plane through a point, square to a direction of any length and sense."""

    point_mm: Vector
    normal: Vector

    def shape(self) -> Shape:
        """Return the plane near the optical axis."""
        normal = unit(self.normal, "normal")
        if normal[2] == 0.0:
            raise ConfigError(
                f"a plane of normal {list(self.normal)} lies along the optical axis, which never meets it"
            )
        away = normal if normal[2] > 0.0 else scaled(-1.0, normal)
        return Shape((0.0, 0.0, dot(away, self.point_mm) / away[2]), away, NO_AXIS, 0.0)

    def moved(self, motion: RigidMotion) -> TiltedPlane:
        """Return the plane moved as a rigid body."""
        return TiltedPlane(motion.point(self.point_mm), motion.direction(self.normal))


@dataclass(frozen=True)
class Cylinder:
    """A circular cylinder.

    Attributes
    ----------
    centre_mm : a point on its axis
    axis : along its axis, of any length and sense
    radius_mm : radius
    facing : convex where the side nearer to the camera refracts and the medium behind it is inside; concave where the
        farther side does, and it is outside
    """

    centre_mm: Vector
    axis: Vector
    radius_mm: float
    facing: Facing = "convex"

    def shape(self) -> Shape:
        """Return the cylinder near the optical axis."""
        return _round_shape(self.centre_mm, unit(self.axis, "axis"), self.radius_mm, self.facing, "cylinder")

    def moved(self, motion: RigidMotion) -> Cylinder:
        """Return the cylinder moved as a rigid body."""
        return replace(self, centre_mm=motion.point(self.centre_mm), axis=motion.direction(self.axis))


@dataclass(frozen=True)
class Sphere:
    """A sphere.

    Attributes
    ----------
    centre_mm, radius_mm : centre and radius
    facing : as of a `Cylinder`
    """

    centre_mm: Vector
    radius_mm: float
    facing: Facing = "convex"

    def shape(self) -> Shape:
        """Return the sphere near the optical axis."""
        return _round_shape(self.centre_mm, NO_AXIS, self.radius_mm, self.facing, "sphere")

    def moved(self, motion: RigidMotion) -> Sphere:
        """Return the sphere moved as a rigid body."""
        return replace(self, centre_mm=motion.point(self.centre_mm))


SURFACES: dict[SurfaceKind, type[Surface]] = {
    "plane": Plane,
    "tilted_plane": TiltedPlane,
    "cylinder": Cylinder,
    "sphere": Sphere,
    "height_map": HeightMap,
}


def _round_shape(centre: Vector, axis: Vector, radius: float, facing: Facing, name: str) -> Shape:
    """Return a cylinder, or a sphere where `axis` is 0, near the optical axis."""
    # The distance of (0, 0, z) from the axis or centre, squared: a z^2 - 2 b z + c.
    across = 1.0 - axis[2] ** 2
    b = centre[2] - axis[2] * dot(axis, centre)
    c = dot(centre, centre) - dot(axis, centre) ** 2
    discriminant = b**2 - across * (c - radius**2)
    if across == 0.0 or discriminant <= 0.0:
        raise ConfigError(f"the optical axis misses the {name} of radius {radius:g} mm about {list(centre)}")
    side = -1.0 if facing == "convex" else 1.0
    vertex = (0.0, 0.0, (b + side * float(np.sqrt(discriminant))) / across)
    outwards = plus(vertex, -1.0, centre)
    outwards = plus(outwards, -dot(axis, outwards), axis)
    return Shape(vertex, scaled(side / radius, outwards), axis, side / radius)


class Faces(NamedTuple):
    """The refracting faces from the lens on as compiled kernels take them, image axes.

    Attributes
    ----------
    lens_z_mm : z of the main lens, negative
    focus_distance_mm, depth_ratio : apparent distance of the focal point, and how it grows with z, both paraxially
        through planes at the vertices
    vertices_mm, normals, axes : (m, 3), and curvatures_per_mm : (m,), see `Shape`
    ratios : (m,) refractive index in front of each face over that behind it
    reliefs : the heights of those faces that are given by them; None where none is, and kernels are compiled without
    beyond_mm : how far in front of the last face, or beyond its far side, points still count as in the fluid: the
        fluid's straight rays go on there as if there were more of it
    """

    lens_z_mm: float
    focus_distance_mm: float
    depth_ratio: float
    vertices_mm: Floats
    normals: Floats
    axes: Floats
    curvatures_per_mm: Floats
    ratios: Floats
    reliefs: Reliefs | None = None
    beyond_mm: float = 0.0


# The functions below take the faces' heights as an argument of its own: where it is None, the compiler leaves out what
# follows the question, and other faces are met as fast as if there were no heights.


@njit(cache=True, **COUNT_NO_REFERENCES)
def meet(
    reliefs: Reliefs | None, faces: Faces, k: int, point: Vector, direction: Vector
) -> tuple[float, Vector, float]:
    """Return how far along a line face k is met, the unit normal there, and the cosine of incidence.

    Of the crossings the one where the line goes from in front of the face to behind it. The direction has length 1 and
    points away from the camera. The cosine is 0 where the line misses the face.
    """
    if reliefs is not None and reliefs.starts[k] >= 0:
        return meet_heights(reliefs, k, faces.vertices_mm[k, 2], point, direction)
    vertex, axis, curvature = row(faces.vertices_mm, k), row(faces.axes, k), faces.curvatures_per_mm[k]
    # From the point at the vertex's depth on: seen from as far as the lens the crossing would lose digits.
    ahead = (vertex[2] - point[2]) / direction[2]
    offset = plus(plus(point, ahead, direction), -1.0, vertex)
    from_axis = plus(offset, -dot(axis, offset), axis)
    normal = plus(row(faces.normals, k), curvature, from_axis)
    # F along the line is height + rise t + bend t^2 / 2.
    height = 0.5 * (dot(row(faces.normals, k), offset) + dot(normal, offset))
    rise = dot(normal, direction)
    across = plus(direction, -dot(axis, direction), axis)
    bend = curvature * dot(across, across)
    discriminant = rise * rise - 2.0 * bend * height
    if rise <= 0.0 or discriminant <= 0.0:
        return 0.0, normal, 0.0
    cosine = np.sqrt(discriminant)
    further = -2.0 * height / (rise + cosine)
    return ahead + further, plus(normal, curvature * further, across), cosine


@njit(cache=True, **COUNT_NO_REFERENCES)
def normal_change(reliefs: Reliefs | None, faces: Faces, k: int, place: Vector, shift: Vector) -> Vector:
    """Return how the unit normal of face k changes with a small shift along the face from a place on it."""
    if reliefs is not None and reliefs.starts[k] >= 0:
        return normal_change_of_heights(reliefs, k, place, shift)
    # The same all along lines of curvature.
    axis = row(faces.axes, k)
    return scaled(faces.curvatures_per_mm[k], plus(shift, -dot(axis, shift), axis))


@njit(cache=True, **COUNT_NO_REFERENCES)
def height_behind(reliefs: Reliefs | None, faces: Faces, k: int, point: Vector) -> float:
    """Return F, in mm near the face: positive behind face k, negative in front of it."""
    if reliefs is not None and reliefs.starts[k] >= 0:
        z, _, _, _, _, _, on_grid = height_at(reliefs, k, point[0], point[1])
        return point[2] - z if on_grid else -np.inf
    axis = row(faces.axes, k)
    offset = plus(point, -1.0, row(faces.vertices_mm, k))
    along_axis = dot(axis, offset)
    squared = dot(offset, offset) - along_axis * along_axis
    return dot(row(faces.normals, k), offset) + 0.5 * faces.curvatures_per_mm[k] * squared
