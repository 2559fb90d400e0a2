"""Surfaces in closed form and by their heights, as kernels meet them, and as other ray tracers have them."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.names import ColumnAxis, Facing, SurfaceKind
from lfpiv_cli.optics import surfaces
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.shapes import HeightMap, Vector, height_at, reliefs_of
from lfpiv_cli.optics.surfaces import SURFACES, Cylinder, Faces, Plane, Sphere, Surface, TiltedPlane, meet
from lfpiv_cli.optics.tracing import disc_points
from tests.commands import WATER
from tests.known_rays import assert_rays_go_back, tube_of

PLANE = Plane(-3.0)
TILTED = TiltedPlane((0.5, 0.2, -3.0), (0.1, -0.2, 1.5))
# Each beside the optical axis, and the cylinder's axis along none of ours.
CYLINDER = Cylinder((0.4, -0.7, 1.0), (1.0, 0.3, 0.2), 6.0)
HOLLOW_CYLINDER = Cylinder((0.4, -0.7, -9.0), (0.2, -1.0, 0.1), 6.0, "concave")
SPHERE = Sphere((0.5, 0.9, 2.0), 7.0)
HOLLOW_SPHERE = Sphere((0.5, 0.9, -9.0), 7.0, "concave")
# A plane again, which the spline has exactly; curved ones are tried in `test_height_map`.
SLANTED = TiltedPlane((0.5, 0.2, -3.0), (0.3, -0.2, 1.5))
HEIGHTS = HeightMap(
    tuple(tuple(-3.0 - 0.2 * (x - 0.5) + 2.0 / 15.0 * (y - 0.2) for x in range(-8, 9)) for y in range(-9, 10)),
    (1.0, 1.0),
)
ALL = (PLANE, TILTED, CYLINDER, HOLLOW_CYLINDER, SPHERE, HOLLOW_SPHERE, HEIGHTS)


def distance_beyond(surface: Surface, point: np.ndarray) -> float:
    """Return how far behind a surface a point lies, by school geometry."""
    if isinstance(surface, Plane):
        return float(point[2] - surface.z_mm)
    if isinstance(surface, HeightMap):
        surface = SLANTED
    if isinstance(surface, TiltedPlane):
        return float((point - surface.point_mm) @ surface.normal / np.linalg.norm(surface.normal))
    assert isinstance(surface, (Cylinder, Sphere))
    offset = point - np.array(surface.centre_mm)
    if isinstance(surface, Cylinder):
        offset = np.cross(offset, surface.axis) / np.linalg.norm(surface.axis)
    inside = surface.radius_mm - np.linalg.norm(offset)
    return float(inside if surface.facing == "convex" else -inside)


def one_face(surface: Surface, camera: Camera) -> Faces:
    """Return a surface alone as kernels take it; the index behind it is of no matter."""
    return CurvedSpace(Media(fluid=1.33), (Face(surface, 1.33),)).for_kernels(camera)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("surface", ALL)
def test_the_optical_axis_meets_a_surface_at_its_vertex(surface: Surface) -> None:
    vertex, normal, axis = surface.shape()[:3]
    # a few roundings of 10 mm
    assert vertex[:2] == (0.0, 0.0)
    assert distance_beyond(surface, np.array(vertex)) == pytest.approx(0.0, abs=1e-14)
    places = [(np.add(vertex, step), np.subtract(vertex, step)) for step in 1e-5 * np.eye(3)]
    gradient = [distance_beyond(surface, ahead) - distance_beyond(surface, behind) for ahead, behind in places]
    # third derivatives of at most 1/R^2 times 1e-10, and roundings over the step
    np.testing.assert_allclose(normal, np.array(gradient) / 2e-5, atol=1e-9)
    assert normal[2] > 0.0
    assert np.dot(normal, axis) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("surface", ALL)
def test_a_line_meets_a_surface_from_both_sides(surface: Surface, table2: Camera, rng: np.random.Generator) -> None:
    # The place lies on it, the normal points there, and the cosine is that between line and normal.
    faces = one_face(surface, table2)
    for _ in range(20):
        start, direction = np.array([*rng.uniform(-3, 3, 2), -200.0]), unit(np.array([*rng.uniform(-0.01, 0.01, 2), 1]))
        path, normal, cosine = meet(faces.reliefs, faces, 0, tuple(start), tuple(direction))
        place = start + path * direction
        # some ten roundings of 200 mm
        assert distance_beyond(surface, place) == pytest.approx(0.0, abs=2e-13)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-14)
        assert np.dot(normal, direction) == pytest.approx(cosine, abs=1e-14)
        assert distance_beyond(surface, place + 1e-3 * np.array(normal)) == pytest.approx(1e-3, abs=1e-12)
    start, direction = np.array([1.0, -0.5, -30.0]), unit(np.array([0.02, 0.05, 1.0]))
    path, normal, cosine = meet(faces.reliefs, faces, 0, tuple(start), tuple(direction))
    beyond = tuple(start + (path + 1.5) * direction)
    back, normal_back, cosine_back = meet(faces.reliefs, faces, 0, beyond, tuple(direction))
    assert back == pytest.approx(-1.5, abs=1e-13)
    np.testing.assert_allclose([*normal_back, cosine_back], [*normal, cosine], atol=1e-13)
    vertex = np.array(surface.shape().vertex_mm)
    points = vertex + rng.uniform(-4, 4, (200, 3))
    expected = [distance_beyond(surface, point) > 0.0 for point in points]
    assert [surfaces.height_behind(faces.reliefs, faces, 0, tuple(point)) > 0.0 for point in points] == expected
    assert len(set(expected)) == 2


def test_a_line_beside_a_surface_misses_it_and_the_side_that_refracts(table2: Camera) -> None:
    along_axis = (0.0, 0.0, 1.0)
    for surface in (Cylinder((0, 0, 0), (1, 0, 0), 5.0), Cylinder((0, 0, -9), (1, 0, 0), 5.0, "concave")):
        faces = one_face(surface, table2)
        assert meet(faces.reliefs, faces, 0, (0.0, 4.999, -20.0), along_axis)[2] > 0.0
        assert meet(faces.reliefs, faces, 0, (0.0, 5.001, -20.0), along_axis)[2] == 0.0
    for facing, vertex in zip(get_args(Facing), (-4.0, 6.0), strict=True):
        for surface in (Cylinder((3, 0, 1), (1, 0, 0), 5.0, facing), Sphere((0, 0, 1), 5.0, facing)):
            assert surface.shape().vertex_mm[2] == vertex
    assert list(SURFACES) == list(get_args(SurfaceKind))
    assert {type(surface) for surface in ALL} == set(SURFACES.values())


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (TiltedPlane((0, 0, 0), (1, 0, 0)), "lies along the optical axis"),
        (TiltedPlane((0, 0, 0), (0, 0, 0)), "expected a direction"),
        (Cylinder((0, 0, 0), (0, 0, 0), 5.0), "expected a direction"),
        (Cylinder((0, 5.1, 0), (1, 0, 0), 5.0), "misses the cylinder of radius 5 mm"),
        (Cylinder((0, 0, 0), (0, 0, 2), 5.0), "misses the cylinder"),
        (Sphere((0, 5.1, 0), 5.0), "misses the sphere"),
    ],
)
def test_what_the_optical_axis_never_meets_is_refused(surface: Surface, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        surface.shape()


TUBE = tube_of(WATER)
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

Rays = Floats
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


INNER = Face(Cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5.0), 1.33)
OUTER = Cylinder((0.0, 0.3, 0.0), (1.0, 0.0, 0.0), 7.0)
DOME = Sphere((0.4, -0.3, 1.0), 8.0)

Heights = Callable[[Floats, Floats], Floats]


def sampled(
    heights: Heights,
    spacing: tuple[float, float] = (0.4, 0.3),
    half: tuple[float, float] = (4.8, 3.9),
    centre: Vector = (0.0, 0.0, 0.0),
) -> HeightMap:
    """Return the heights of a function of x and y on a grid of so many mm to either side of its middle."""
    steps = [round(side / step) for side, step in zip(half, spacing, strict=True)]
    x, y = (centre[k] + spacing[k] * np.arange(-steps[k], steps[k] + 1) for k in range(2))
    rows = heights(*np.meshgrid(x, y)) - centre[2]
    return HeightMap(tuple(map(tuple, rows.tolist())), spacing, centre)


def of_cylinder(x: Floats, y: Floats) -> Floats:
    return 0.0 * x - np.sqrt(49.0 - (y - 0.3) ** 2)


def of_sphere(x: Floats, y: Floats) -> Floats:
    return 1.0 - np.sqrt(64.0 - (x - 0.4) ** 2 - (y + 0.3) ** 2)


def of_third_degree(x: Floats, y: Floats) -> Floats:
    """Heights that the spline has exactly."""
    return -6.0 + 0.1 * x - 0.05 * y + 0.03 * x * y + 0.04 * y**2 + 1e-3 * x**3 * y - 2e-4 * x**2 * y**3


def behind(surface: Surface) -> CurvedSpace:
    """Return a water pipe's inner wall behind a surface of acrylic."""
    return CurvedSpace(Media(1.0, 1.49, 1.33), (Face(surface, 1.49), INNER))


def points_and_crossings(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    points = np.concatenate([rng.uniform(-3, 3, (count, 1)), disc_points(count, 2.5, rng)], axis=1)
    return points, disc_points(count, 12.5, rng)


def test_heights_of_third_degree_and_their_derivatives_are_exact(rng: np.random.Generator) -> None:
    reliefs = reliefs_of([None, sampled(of_third_degree, centre=(0.2, 0.5, -2.0)).relief])
    for x, y in rng.uniform((-4.6, -3.4), (5.0, 4.4), (50, 2)):
        expected = (
            of_third_degree(x, y),
            0.1 + 0.03 * y + 3e-3 * x**2 * y - 4e-4 * x * y**3,
            -0.05 + 0.03 * x + 0.08 * y + 1e-3 * x**3 - 6e-4 * x**2 * y**2,
            6e-3 * x * y - 4e-4 * y**3,
            0.03 + 3e-3 * x**2 - 12e-4 * x * y**2,
            0.08 - 12e-4 * x**2 * y,
        )
        # roundings of 6 mm, over the square of a step of 0.3 mm, through a spline of thirty nodes
        np.testing.assert_allclose(height_at(reliefs, 1, x, y), [*expected, 1.0], atol=1e-12)
    # Curvature goes on from cell to cell.
    reliefs = reliefs_of([sampled(of_sphere).relief])
    for node in ((0.4, 0.1), (0.1, 0.3), (-1.2, 0.6)):
        before, after = (height_at(reliefs, 0, *(np.array(node) + side)) for side in (-1e-9, 1e-9))
        # third derivatives of 0.01 / mm^2 over 2e-9 mm, and roundings of 1e-15 over the square of a step
        np.testing.assert_allclose(before, after, atol=1e-9)


@pytest.mark.parametrize("column_axis", ["x", "y"])
@pytest.mark.parametrize(("surface", "heights"), [(OUTER, of_cylinder), (DOME, of_sphere)], ids=["cylinder", "sphere"])
def test_rays_are_those_of_the_surface_that_heights_were_taken_from(
    table2: Camera, rng: np.random.Generator, column_axis: ColumnAxis, surface: Surface, heights: Heights
) -> None:
    """The slopes of the spline err by the fourth power of the spacing, at its rim by the third."""
    camera = replace(table2, column_axis=column_axis)
    points, crossing = points_and_crossings(rng, 200)
    points = camera.to_image_axes(points)
    expected, seen = behind(surface).slopes(camera, points, crossing)
    assert seen.all()
    off = []
    for spacing in ((0.2, 0.15), (0.1, 0.075)):
        space = behind(sampled(heights, spacing, centre=(0.2, 0.0, -4.0)))
        found, seen = space.slopes(camera, points, crossing)
        assert seen.all()
        off.append(np.abs(found - expected).max())
    # 0.2 um of a tracer's place, seen from 200 mm, where the sphere is steep; and roughly 2^3: by chance, rays fall
    # elsewhere in their cells
    assert off[0] < 1e-6
    assert off[1] < off[0] / 5.0


def test_a_plane_by_its_heights_is_that_plane(table2: Camera, rng: np.random.Generator) -> None:
    """And the faces before and behind it are met as without heights."""
    front, tilted = Face(Plane(-9.0), 1.49), TiltedPlane((1.0, 2.0, -7.0), (0.02, -0.1, 1.0))
    heights = sampled(lambda x, y: -7.0 - 0.02 * (x - 1.0) + 0.1 * (y - 2.0), centre=(0.4, 0.3, 1.0))
    expected, found = (
        CurvedSpace(behind(tilted).media, (front, Face(surface, 1.4), INNER)) for surface in (tilted, heights)
    )
    points, crossing = points_and_crossings(rng, 100)
    slopes, seen = found.slopes(table2, points, crossing)
    assert seen.all()
    # a step of Newton's from 1e-6 mm
    np.testing.assert_allclose(slopes, expected.slopes(table2, points, crossing)[0], atol=1e-12)


def test_rays_through_heights_go_back_the_way_they_came(table2: Camera, rng: np.random.Generator) -> None:
    assert_rays_go_back(behind(sampled(of_third_degree)), table2, *points_and_crossings(rng, 200))


@pytest.mark.parametrize(("surface", "off"), [*((each, 3e-10) for each in ALL), (sampled(of_third_degree), 1e-10)])
def test_the_normal_changes_along_a_surface(surface: Surface, off: float, table2: Camera) -> None:
    """Against the normals where lines half a step to either side meet the surface."""
    faces, direction, step = one_face(surface, table2), (0.0, 0.0, 1.0), 1e-4
    for towards in ((step, 0.0), (0.0, step)):
        places, normals = [], []
        for side in (-0.5, 0.0, 0.5):
            start = np.array([1.0 + side * towards[0], -0.5 + side * towards[1], -30.0])
            path, normal, _ = meet(faces.reliefs, faces, 0, tuple(start), direction)
            places.append(start + path * np.array(direction))
            normals.append(np.array(normal))
        shift, change = (places[2] - places[0]) / step, (normals[2] - normals[0]) / step
        # of second order in a step of 1e-4 mm beside radii of 6 mm, and roundings of 1e-15 over it
        np.testing.assert_allclose(
            surfaces.normal_change(faces.reliefs, faces, 0, tuple(places[1]), tuple(shift)), change, atol=off
        )


def test_beyond_the_grid_there_is_no_surface(table2: Camera) -> None:
    """Rays past its edge are flags, as points there are not in the fluid."""
    space = CurvedSpace(Media(fluid=1.33), (Face(sampled(of_sphere, half=(2.0, 1.5)), 1.33),))
    faces = space.for_kernels(table2)
    for x, y, met in ((1.999, 0.0, True), (2.001, 0.0, False), (0.0, -1.499, True), (0.0, -1.501, False)):
        assert (meet(faces.reliefs, faces, 0, (x, y, -20.0), (0.0, 0.0, 1.0))[2] > 0.0) == met
    points = np.array([[0.0, 0.0, 3.0], [2.1, 0.0, 3.0], [0.0, 0.0, -8.0]])
    slopes, seen = space.slopes(table2, points, np.zeros((3, 2)))
    assert seen.tolist() == [True, False, False]
    assert np.isnan(slopes[1:]).all()


@pytest.mark.parametrize(
    ("heights", "words"),
    [
        ((), "0 rows of no heights are no grid"),
        (((0.0,) * 5,) * 3, "3 rows of 5 heights are no grid; expected rows of the same length, and 4 or more"),
        (((0.0,) * 4,) * 3 + ((0.0,) * 5,), "4 rows of 4 or 5 heights"),
        (((0.0,) * 4,) * 4, "the optical axis goes past the grid of heights"),
    ],
)
def test_what_is_no_grid_or_beside_the_axis_is_refused(heights: tuple[tuple[float, ...], ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        HeightMap(heights, (1.0, 1.0), (1.6, 0.0, 0.0)).shape()
