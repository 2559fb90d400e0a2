"""Rays through curved faces against plane layers, conserved quantities and known lenses; and images made of them."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.names import ColumnAxis
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace, Face, aim, trace_in
from lfpiv_cli.optics.media import Media, Window, fluid_path_to_focus
from lfpiv_cli.optics.surfaces import Cylinder, Plane, Sphere, Surface, TiltedPlane
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points, trace
from lfpiv_cli.synthetic import rays as of_rays
from lfpiv_cli.synthetic.rays import FITTED, SEQUENCE, TERMS, TOLERANCE_MM, fit_of_slopes, fitted_slopes, unseen
from lfpiv_cli.synthetic.render import Balls, render_points
from tests.commands import WATER
from tests.known_rays import assert_rays_go_back, rays_from_air, rays_to_air, slopes_exact, tube_of

# An acrylic tube: inner diameter 10 mm, wall 2 mm.
OUTER_MM, INNER_MM = 7.0, 5.0
tube = partial(tube_of, WATER)


def stack(*faces: tuple[Surface, float], air: float = 1.0) -> CurvedSpace:
    return CurvedSpace(Media(air, 1.49, faces[-1][1]), tuple(Face(*face) for face in faces))


def points_in_tube(rng: np.random.Generator, count: int, radius: float = 0.98 * INNER_MM) -> Floats:
    """Return points of a tube along x; in front of its rim, where light grazes, unless it is asked for."""
    return np.concatenate([rng.uniform(-6, 6, (count, 1)), disc_points(count, radius, rng)], axis=1)


def aimed(space: CurvedSpace, camera: Camera, points: Floats, crossing: Floats):
    slopes, valid = space.slopes(camera, points, crossing)
    assert valid.all()
    return slopes


def ray_at_point(space, camera, point, crossing):
    """Return the direction towards the camera at a point of its ray through a crossing, by two places on the ray."""
    slope = aimed(space, camera, point[np.newaxis], crossing[np.newaxis])
    (before,), valid = rays_from_air(space, camera, crossing, slope, point[2] - 0.01)
    assert valid.all()
    direction = np.array([*before, point[2] - 0.01]) - point
    return slope[0], direction / np.linalg.norm(direction)


def direction_in_air(slope: Floats) -> Floats:
    """Return the direction towards the camera of a ray with slopes (2,): in z, -1 for each slope."""
    direction = np.array([*slope, -1.0])
    return direction / np.linalg.norm(direction)


@pytest.mark.parametrize("column_axis", ["x", "y"])
@pytest.mark.parametrize("tilted", [False, True])
def test_planes_bend_rays_as_plane_layers_do(table2, rng, column_axis: ColumnAxis, tilted: bool):
    camera, window = replace(table2, column_axis=column_axis), Window(98.0, 2.0)
    path = fluid_path_to_focus(window, camera.focus_distance_mm, WATER)
    near, far = -path - window.thickness_mm, -path
    planes = [TiltedPlane((3.0, 1.0, z), (0.0, 0.0, -2.0)) if tilted else Plane(z) for z in (near, far)]
    space = stack((planes[0], 1.49), (planes[1], 1.33))
    assert space.lens_z_mm(camera) == pytest.approx(near - window.distance_mm, abs=1e-13)
    points, crossing = rng.uniform((-4, -4, -8), (4, 4, 8), (200, 3)), disc_points(200, 12.5, rng)
    slopes = aimed(space, camera, points, crossing)
    # slopes of 0.1; one step of Newton's from 1e-6 mm
    np.testing.assert_allclose(slopes, slopes_exact(points, crossing, camera, WATER, window), atol=1e-12)


@pytest.mark.parametrize("column_axis", ["x", "y"])
@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_rays_go_back_the_way_they_came(table2, rng, column_axis: ColumnAxis, tilt: float):
    camera = replace(table2, column_axis=column_axis)
    axis = (1.0, tilt, -0.5 * tilt) if column_axis == "x" else (tilt, 1.0, -0.5 * tilt)
    space = tube(axis, (0.2, 0.1, 0.5))
    assert_rays_go_back(space, camera, points_in_tube(rng, 200, 3.0), disc_points(200, 12.5, rng))


@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_the_camera_turns_with_the_tube(table2, rng, column_axis: ColumnAxis):
    """Along the columns a tube is the same, whichever world axis they follow."""
    axis = (1.0, 0.0, 0.0) if column_axis == "x" else (0.0, 1.0, 0.0)
    points, crossing = points_in_tube(rng, 50), disc_points(50, 12.5, rng)
    slopes = aimed(tube(axis), replace(table2, column_axis=column_axis), points, crossing)
    np.testing.assert_array_equal(slopes, aimed(tube(), table2, points, crossing))


def test_all_of_a_tube_is_seen(table2, rng):
    """n_w R_i < R_o: to its wall, through all of the lens."""
    points, crossing = points_in_tube(rng, 2000, INNER_MM), disc_points(2000, 12.5, rng)
    places, valid = rays_from_air(tube(), table2, crossing, aimed(tube(), table2, points, crossing), points[:, 2])
    assert valid.all()
    # where light grazes a micron is a hundred at the lens: Newton's last step is larger, but no more than this
    np.testing.assert_allclose(places, points[:, :2], atol=1e-9)


def test_concentric_cylinders_keep_what_their_symmetry_keeps(table2, rng):
    """n k.a, as faces are the same along the axis a, and n (r x k).a, as they are the same around it."""
    axis = np.array([1.0, 0.2, -0.1]) / np.linalg.norm([1.0, 0.2, -0.1])
    centre = np.array([0.3, -0.2, 0.4])
    space = tube(tuple(axis), tuple(centre))
    for point, crossing in zip(points_in_tube(rng, 50, 3.0), disc_points(50, 12.5, rng), strict=True):
        slope, direction = ray_at_point(space, table2, point, crossing)
        air = direction_in_air(slope)
        at_lens = np.array([*crossing, space.lens_z_mm(table2)])
        # the direction in the fluid is a difference over 0.01 mm: 1e-13, times 5 mm and the steps of Newton's
        assert air @ axis == pytest.approx(1.33 * direction @ axis, abs=1e-11)
        moment = 1.33 * np.cross(point - centre, direction) @ axis
        assert np.cross(at_lens - centre, air) @ axis == pytest.approx(moment, abs=1e-10)


def test_a_sphere_shows_its_aplanatic_point_sharply(table2, rng):
    """All rays from R/n behind the centre seem to come from n R behind it."""
    radius, index, centre = 10.0, 1.5, 2.0
    space = stack((Sphere((0.0, 0.0, centre), radius), index))
    crossing = disc_points(200, 100.0, rng)
    slopes = aimed(space, table2, np.tile([0.0, 0.0, centre + radius / index], (200, 1)), crossing)
    distance = centre + index * radius - space.lens_z_mm(table2)
    np.testing.assert_allclose(slopes, crossing / distance, atol=1e-13)
    # and from the centre all rays go straight
    slopes = aimed(space, table2, np.tile([0.0, 0.0, centre], (200, 1)), crossing)
    np.testing.assert_allclose(slopes, crossing / (centre - space.lens_z_mm(table2)), atol=1e-13)


def test_a_thick_lens_has_the_lens_makers_focal_length(table2):
    """1/f = (n - 1) (1/R1 + 1/R2 - (n - 1) d / (n R1 R2)), from the second face f (1 - (n - 1) d / (n R1))."""
    first, second, thickness, index = 60.0, 80.0, 4.0, 1.5
    near = -30.0
    space = stack(
        (Sphere((0.0, 0.0, near + first), first), index),
        (Sphere((0.0, 0.0, near + thickness - second), second, "concave"), 1.0),
    )
    bent = index - 1.0
    focal_length = 1.0 / (bent * (1 / first + 1 / second - bent * thickness / (index * first * second)))
    focus = near + thickness + focal_length * (1.0 - bent * thickness / (index * first))
    heights = np.array([[0.01, 0.0], [0.0, 0.01], [0.1, 0.0]])
    places, valid = rays_from_air(space, table2, heights, np.zeros((3, 2)), focus)
    assert valid.all()
    # spherical aberration: of third order in the height over some 60 mm
    np.testing.assert_allclose(places / heights.max(axis=1, keepdims=True) ** 3, 0.0, atol=1e-3)
    (far,), _ = rays_from_air(space, table2, heights[:1], np.zeros((1, 2)), focus + 1.0)
    assert far[0] == pytest.approx(-0.01 / focal_length, rel=1e-4)


def paraxial_section(space: CurvedSpace, camera: Camera, z: float, curvatures: tuple[float, ...]):
    """Return the apparent distance and scale of points near the axis at depth z, see `curved_space`."""
    depths = [shape.vertex_mm[2] for shape in space.shapes()]
    indices = [space.media.air, *(face.index for face in space.faces)]
    u, scale, behind = z - depths[-1], 1.0, None
    for k in reversed(range(len(depths))):
        u = u if behind is None else behind + depths[k + 1] - depths[k]
        behind = indices[k] / (indices[k + 1] / u - (indices[k + 1] - indices[k]) * curvatures[k])
        scale *= indices[k + 1] * behind / (indices[k] * u)
    return depths[0] - space.lens_z_mm(camera) + behind, scale


@pytest.mark.parametrize("z", [-4.0, 0.0, 3.0])
def test_the_two_apparent_distances_behind_a_tube(table2, z: float):
    space, aside = tube(), 1e-4
    (place,), (distance,), _ = space.equivalent(table2, [[aside, aside, z]])
    along, unmoved = paraxial_section(space, table2, z, (0.0, 0.0))
    across, enlarged = paraxial_section(space, table2, z, (1 / OUTER_MM, 1 / INNER_MM))
    # rays 1e-4 mm from the axis of faces of 5 mm: relative terms of second order
    np.testing.assert_allclose(distance, [along, across], rtol=1e-9)
    np.testing.assert_allclose(place, [aside * unmoved, aside * enlarged], rtol=1e-8)
    assert along == pytest.approx(float(ObjectSpace(space.media).distance(table2, z)), rel=1e-14)
    assert unmoved == pytest.approx(1.0, rel=1e-14)
    if z == 0.0:
        lifted = 2.0 * (1.0 - 1.0 / 1.49) + 5.0 * (1.0 - 1.0 / 1.33)
        assert across - along == pytest.approx(lifted, rel=1e-12)
        assert enlarged == pytest.approx(1.33, rel=1e-14)


def test_slopes_of_a_pencil_grow_as_the_equivalent_point_says(table2, rng):
    space, step = tube((1.0, 0.2, 0.1)), 0.01
    points = points_in_tube(rng, 50, 3.0)
    place, distance, valid = space.equivalent(table2, points)
    assert valid.all()
    for axis in (0, 1):
        crossing = np.zeros((2, len(points), 2))
        crossing[0, :, axis], crossing[1, :, axis] = -step, step
        low, high = (aimed(space, table2, points, part)[:, axis] for part in crossing)
        # third order in 0.01 mm over 200 mm, and roundings of 1e-16 over the step
        np.testing.assert_allclose((high - low) / (2 * step), 1 / distance[:, axis], rtol=1e-8)
        middle = -place[:, axis] / distance[:, axis]
        np.testing.assert_allclose((high + low) / 2, middle, atol=1e-9)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_kernels_do_as_the_readable_twin(table2, rng, tilt: float):
    space = tube((1.0, tilt, -0.5 * tilt), (0.1, 0.2, 0.3))
    faces = space.for_kernels(table2)
    crossing, slopes = disc_points(100, 12.5, rng), rng.uniform(-0.08, 0.08, (100, 2))
    for (X, Y), (slope_x, slope_y) in zip(crossing, slopes, strict=True):
        x, y, seen = trace_in(faces, X, Y, slope_x, slope_y, 1.0)
        expected = twin(space, table2, np.array([X, Y]), np.array([slope_x, slope_y]), 1.0)
        assert seen == (expected is not None)
        if expected is not None:
            # roundings of 200 mm, which grazing light magnifies
            np.testing.assert_allclose([x, y], expected, atol=1e-11)
            again_x, again_y, seen = aim(faces, x, y, 1.0, X, Y)
            assert seen
            np.testing.assert_allclose([again_x, again_y], [slope_x, slope_y], atol=1e-11)


def twin(space, camera, crossing, slope, z):
    """Return where a ray from the lens meets the plane of depth z inside convex cylinders; None where it does not."""
    place, direction = np.array([*crossing, space.lens_z_mm(camera)]), -direction_in_air(slope)
    index = space.media.air
    for face in space.faces:
        axis = np.array(face.surface.axis)
        across = np.eye(3) - np.outer(axis, axis) / (axis @ axis)
        offset, moving = across @ (place - face.surface.centre_mm), across @ direction
        a, b, c = moving @ moving, 2 * offset @ moving, offset @ offset - face.surface.radius_mm**2
        if b**2 - 4 * a * c <= 0:
            return None
        place = place + (-b - np.sqrt(b**2 - 4 * a * c)) / (2 * a) * direction
        normal = across @ (place - face.surface.centre_mm) / face.surface.radius_mm
        # Snell's law for the part along the face; the rest of the length goes along the normal
        tangent = index / face.index * (direction - (direction @ normal) * normal)
        if tangent @ tangent >= 1:
            return None
        direction, index = tangent - np.sqrt(1 - tangent @ tangent) * normal, face.index
    place = place + (z - place[2]) / direction[2] * direction
    return place[:2] if np.linalg.norm(across @ (place - face.surface.centre_mm)) <= face.surface.radius_mm else None


def test_a_prism_turns_light_by_its_angle(table2):
    """Straight through the first face, out of the second: asin(n sin A) - A, towards the thick end."""
    angle, index = 0.3, 1.5
    space = stack((Plane(-20.0), index), (TiltedPlane((0.0, 0.0, -10.0), (np.sin(angle), 0.0, np.cos(angle))), 1.0))
    (near, far), valid = rays_from_air(space, table2, np.zeros((2, 2)), np.zeros((2, 2)), [-10.0, 10.0])
    assert valid.all()
    np.testing.assert_allclose(near, 0.0, atol=1e-13)
    turned = np.arcsin(index * np.sin(angle)) - angle
    np.testing.assert_allclose(far, [-20.0 * np.tan(turned), 0.0], atol=1e-12)


def test_total_reflection_is_a_flag(table2):
    window = stack((Plane(-5.0), 1.49), (Plane(-3.0), 1.33))
    critical = np.arcsin(1 / 1.33)
    angles = critical + np.array([-1e-3, 1e-3])
    towards = np.stack([np.sin(angles), np.zeros(2), -np.cos(angles)], axis=1)
    crossing, slopes, valid = rays_to_air(window, table2, np.zeros((2, 3)), towards)
    assert valid.tolist() == [True, False]
    assert np.isfinite(slopes[0]).all()
    assert np.isnan(slopes[1]).all()
    assert np.isnan(crossing[1]).all()
    # from glass into air, behind a face that light meets at 45 degrees
    prism = stack((Plane(-20.0), 1.5), (TiltedPlane((0.0, 0.0, -10.0), (0.0, 1.0, 1.0)), 1.0))
    places, valid = rays_from_air(prism, table2, [[0.0, 0.0]], [[0.0, 0.0]], 0.0)
    assert not valid.any()
    assert np.isnan(places).all()


def test_rays_and_points_outside_the_fluid_are_flags(table2):
    space, middle = tube(), [[0.0, 0.0]]
    # a corner of the box around the pipe, in the wall, in front of the tube, behind it; and inside
    points = np.array([[0, 4.5, 4.5], [0, 0, -6], [0, 0, -20], [0, 0, 5.5], [0, 4.5, 2.0]], dtype=float)
    for crossing in ([0.0, 0.0], [0.0, 12.0]):
        slopes, valid = space.slopes(table2, points, np.tile(crossing, (5, 1)))
        assert valid.tolist() == [False, False, False, False, True]
        assert np.isnan(slopes[:4]).all()
    _, distance, valid = space.equivalent(table2, points)
    assert valid.tolist() == [False, False, False, False, True]
    assert np.isnan(distance[:4]).all()
    for place, towards in ([[0, 0, 0], [0, 0, 1]], [[0, 0, -6], [0, 0, -1]]):
        assert not rays_to_air(space, table2, [place], [towards])[2].any()
    places, valid = rays_from_air(space, table2, middle, [[0.0, 0.1]], 0.0)
    assert not valid.any()
    assert np.isnan(places).all()
    # through the tube and out of the fluid on the far side, which is no face: a place, but not a valid one
    places, valid = rays_from_air(space, table2, middle, [[0.0, 0.0]], 5.5)
    assert not valid.any()
    np.testing.assert_allclose(places, 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        ((), "at least one face"),
        ((Face(Plane(-2.0), 1.49),), "behind the last face the index is 1.49, not the fluid's 1.33"),
        ((Face(Plane(-2.0), 1.49), Face(Plane(-3.0), 1.33)), "face 2 meets the optical axis at z = -3 mm, face 1 at"),
        ((Face(Cylinder((0, 9, 0), (1, 0, 0), 5.0), 1.33),), "misses the cylinder"),
    ],
)
def test_faces_out_of_order_are_refused(faces: tuple[Face, ...], words: str):
    with pytest.raises(ConfigError, match=words):
        CurvedSpace(WATER, faces)


def test_a_face_behind_the_lens_is_refused(table2):
    with pytest.raises(ConfigError, match="behind the lens"):
        stack((Plane(-300.0), 1.33)).for_kernels(table2)


APERTURE_MM = 12.5


@pytest.fixture
def small(camera: Camera) -> Camera:
    """A corner of the camera, its array turned, shifted and distorted, with either kind of array."""
    lattice = Lattice.regular(0.1, camera.lattice.layout, 0.01, (0.013, -0.021))
    return replace(camera, columns=150, rows=120, lattice=lattice, distortion_per_mm2=1e-3)


def test_images_behind_a_tube_are_those_of_rays_aimed_one_by_one(small: Camera) -> None:
    """With balls in the middle, and so near the rim that the polynomial does not do."""
    wide, rays = replace(small, columns=400, rows=2800), 3000
    points, diameters = np.array([[0.1, 0.3, 2.0], [0.0, 4.97, 0.1], [-0.2, -3.0, -3.5]]), np.array([0.1, 0.05, 0.05])
    found = render_points(wide, tube_of(WATER), Balls(points, 1.0, diameters), np.random.default_rng(5), rays=rays)
    expected = np.zeros_like(found)
    for point, diameter, shift in zip(points, diameters, np.random.default_rng(5).random((3, 4)), strict=True):
        a, b, c, d = ((shift + np.arange(rays)[:, np.newaxis] * SEQUENCE) % 1.0).T
        lens = (
            APERTURE_MM * np.sqrt(a)[:, np.newaxis] * np.stack([np.cos(2 * np.pi * b), np.sin(2 * np.pi * b)], axis=1)
        )
        r = 0.5 * diameter * np.sqrt(1 - c ** (2 / 3))
        starts = point + np.stack([r * np.cos(2 * np.pi * d), r * np.sin(2 * np.pi * d), 0 * r], axis=1)
        slopes, leaves = tube_of(WATER).slopes(wide, wide.to_image_axes(starts), lens)
        assert leaves.all()
        column, row = np.rint(wide.mm_to_px(trace(wide, lens, slopes).sensor_mm)).astype(int).T
        inside = (column >= 0) & (column < wide.columns) & (row >= 0) & (row < wide.rows)
        np.add.at(expected, (row[inside], column[inside]), 1.0 / rays)
    assert expected.sum() > 2.5
    assert np.abs(expected - found).sum() < 2e-3 * expected.sum()


def test_fitted_slopes_are_right_where_they_say_so(camera: Camera, rng: np.random.Generator) -> None:
    """Within a nanometre on the array, of rays that the fit has not seen; near the rim they say that they are not."""
    faces, seen, radius = tube_of(WATER).for_kernels(camera), camera.for_kernels(), 0.025
    points = np.concatenate([rng.uniform(-6.5, 6.5, (60, 1)), disc_points(60, 4.97, rng)], axis=1)
    points = np.concatenate([points, [[0.0, 4.97, 0.0], [1.0, -4.96, 0.2]]])
    fits = []
    for point in points:
        coefficients, is_right = fitted_slopes(*point, radius, faces, seen, fit_of_slopes())
        fits.append(is_right)
        lens, ball = disc_points(300, 1.0, rng), disc_points(300, 1.0, rng)
        terms = np.empty((300, TERMS))
        for k in range(300):
            of_rays.write_terms(*lens[k], *ball[k], terms[k])
        starts = point + radius * np.column_stack([ball, np.zeros(300)])
        slopes, leaves = tube_of(WATER).slopes(camera, starts, APERTURE_MM * lens)
        if is_right:
            assert leaves.all()
            assert np.abs(terms @ coefficients - slopes).max() * camera.image_distance_mm < 2.0 * TOLERANCE_MM
    assert not any(fits[-2:])
    assert np.mean(fits) > 0.8
    assert fit_of_slopes()[1].shape == (TERMS, FITTED)


def test_points_outside_the_fluid_are_dark_and_told_on_any_number_of_threads(
    small: Camera, rng: np.random.Generator, one_thread: Callable[[], AbstractContextManager[None]]
) -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 5.5, 0.0], [0.1, 0.0, -6.0], [0.0, 0.0, -9.0]])
    np.testing.assert_array_equal(unseen(small, tube_of(WATER), points), [False, True, True, True])
    image = render_points(small, tube_of(WATER), Balls(points[1:], 1.0, 0.05), rng, rays=100)
    assert not image.any()
    # Same bits for any number of threads.
    balls = Balls(np.array([[0.05, -0.1, 3.0], [-0.2, 0.1, -4.0], [0.0, 4.97, 0.0]]), 1.0, 0.05)
    images = [render_points(small, tube_of(WATER), balls, np.random.default_rng(5), rays=500)]
    with one_thread():
        images.append(render_points(small, tube_of(WATER), balls, np.random.default_rng(5), rays=500))
    np.testing.assert_array_equal(*images)


def test_a_thin_wall_hides_what_no_ray_passes(camera: Camera) -> None:
    """Across cylinders n times a ray's distance from the axis stays (Bouguer); in air it is at most the outer radius.

    In the water it is at most R_out / n_w, where both walls have turned the ray towards the axis.
    """
    outer, lens_mm = 5.5, 193.0
    in_air = np.linspace(4.5, outer, 2001)
    incidence = np.arcsin([in_air / outer, in_air / (1.49 * INNER_MM)])
    turn = np.sum(incidence - np.arcsin([in_air / (1.49 * outer), in_air / (1.33 * INNER_MM)]), axis=0)
    # from a place on the lens: by so much a ray heads away from the axis before it is turned
    aside = (in_air - np.linspace(-APERTURE_MM, APERTURE_MM, 101)[:, np.newaxis]) / lens_mm
    along = np.deg2rad(40.0)
    farthest = np.max(in_air / 1.33 / np.cos(along - turn + aside))
    r = np.linspace(0.0, 4.99, 500)
    points = np.stack([0.0 * r, r * np.cos(along), r * np.sin(along)], axis=1)
    assert not unseen(camera, tube_of(WATER), points).any()
    hidden = unseen(camera, tube_of(WATER, outer_mm=outer), points)
    assert np.all(np.diff(hidden.astype(int)) >= 0)
    assert farthest < 4.3
    # places on the lens are not asked for its very rim
    assert r[hidden].min() == pytest.approx(farthest, abs=0.03)
