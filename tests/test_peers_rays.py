"""Rays through curved faces as other ray tracers have them (`pip install "lfpiv[peers]"`), where these are installed.

Batoid knows planes and spheres anywhere; Optiland biconic surfaces too, and a biconic one that is flat along x is a
cylinder. Each is given the same rays at the lens, and says where they meet planes in the fluid.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.shapes import Vector
from lfpiv_cli.optics.surfaces import Cylinder, Plane, Sphere, Surface, TiltedPlane
from lfpiv_cli.optics.tracing import disc_points

WATER = Media(1.0, 1.49, 1.33)
ALONG_X = (1.0, 0.0, 0.0)
TUBE = CurvedSpace(
    WATER, (Face(Cylinder((0.0, 0.0, 0.0), ALONG_X, 7.0), 1.49), Face(Cylinder((0.0, 0.0, 0.0), ALONG_X, 5.0), 1.33))
)
BALL = CurvedSpace(WATER, (Face(Sphere((0.0, 0.0, 1.0), 8.0), 1.49), Face(Sphere((0.0, 0.0, 2.0), 6.5), 1.33)))
# A hollow face in air, and a tilted plane.
MENISCUS = CurvedSpace(
    WATER,
    (
        Face(Sphere((0.0, 0.0, -60.0), 40.0, "concave"), 1.49),
        Face(Plane(-14.0), 1.6),
        Face(TiltedPlane((1.0, 0.5, -9.0), (0.1, -0.2, 1.0)), 1.33),
    ),
)
# Other programs find a crossing to 1e-10 mm or so, and 200 mm have 3e-14.
AGREEMENT_MM = 1e-9

Rays = NDArray[np.float64]
# From places (n, 3) and directions (n, 3) at the lens, and depths in the fluid, to places there.
Tracer = Callable[[CurvedSpace, Rays, Rays, Rays], Rays]


def radius_of(surface: Surface) -> float:
    """Return the radius of curvature, positive where the centre lies behind the surface; infinite of planes."""
    curvature = surface.shape().curvature_per_mm
    return np.inf if curvature == 0.0 else -1.0 / curvature


def axes_about(normal: Vector) -> Rays:
    """Return axes (3, 3), a column each, the last of them along a unit normal that is not x."""
    x = np.cross((0.0, 1.0, 0.0), normal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal], axis=1)


def by_batoid(space: CurvedSpace, places: Rays, directions: Rays, depths: Rays) -> Rays:
    batoid = pytest.importorskip("batoid")
    rays = batoid.RayVector(*places.T, *directions.T)
    before = batoid.ConstMedium(space.media.air)
    for face in space.faces:
        shape, behind = face.surface.shape(), batoid.ConstMedium(face.index)
        radius = radius_of(face.surface)
        surface = batoid.Plane() if np.isinf(radius) else batoid.Sphere(radius)
        # A plane turned, since batoid 0.9's `Tilted` has the sines of its angles for their tangents in its normal.
        here = batoid.CoordSys(shape.vertex_mm, axes_about(shape.normal))
        rays = surface.refract(rays, before, behind, coordSys=here)
        before = behind
    found = rays.toCoordSys(batoid.CoordSys())
    assert not found.failed.any()
    return np.asarray(found.r + (depths[:, np.newaxis] - found.r[:, 2:]) / found.v[:, 2:] * found.v)


def by_optiland(space: CurvedSpace, places: Rays, directions: Rays, depths: Rays) -> Rays:
    pytest.importorskip("optiland")
    from optiland.coordinate_system import CoordinateSystem
    from optiland.geometries import BiconicGeometry, Plane, StandardGeometry
    from optiland.rays import RealRays

    rays = RealRays(*places.T, *directions.T, np.ones(len(places)), np.full(len(places), 0.532))
    index = space.media.air
    for face in space.faces:
        shape, radius = face.surface.shape(), radius_of(face.surface)
        here = CoordinateSystem(*shape.vertex_mm)
        if isinstance(face.surface, Cylinder):
            geometry = BiconicGeometry(here, np.inf, radius, tol=1e-13)
        else:
            geometry = Plane(here) if np.isinf(radius) else StandardGeometry(here, radius, 0.0)
        geometry.localize(rays)
        path = geometry.distance(rays)
        rays.x, rays.y, rays.z = rays.x + path * rays.L, rays.y + path * rays.M, rays.z + path * rays.N
        rays.refract(*geometry.surface_normal(rays), index, face.index)
        geometry.globalize(rays)
        index = face.index
    found, along = np.stack([rays.x, rays.y, rays.z], axis=1), np.stack([rays.L, rays.M, rays.N], axis=1)
    return np.asarray(found + (depths[:, np.newaxis] - found[:, 2:]) / along[:, 2:] * along)


@pytest.mark.parametrize(
    ("tracer", "space"),
    [(by_batoid, BALL), (by_batoid, MENISCUS), (by_optiland, BALL), (by_optiland, TUBE)],
    ids=["batoid-ball", "batoid-meniscus", "optiland-ball", "optiland-tube"],
)
def test_rays_go_where_other_ray_tracers_have_them(
    table2: Camera, rng: np.random.Generator, tracer: Tracer, space: CurvedSpace
) -> None:
    # Further aside Optiland's iteration leaves its surface.
    points = np.concatenate([disc_points(1000, 3.0, rng), rng.uniform(-2, 2, (1000, 1))], axis=1)
    crossing = disc_points(1000, 12.5, rng)
    slopes, seen = space.slopes(table2, points, crossing)
    assert seen.all()
    directions = np.concatenate([-slopes, np.ones((len(slopes), 1))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = np.concatenate([crossing, np.full((len(crossing), 1), space.lens_z_mm(table2))], axis=1)
    np.testing.assert_allclose(tracer(space, places, directions, points[:, 2]), points, atol=AGREEMENT_MM)
