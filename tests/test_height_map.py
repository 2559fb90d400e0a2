"""Surfaces given by their heights, beside the surfaces that these were taken from; and what is no grid of heights."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.names import ColumnAxis
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.shapes import HeightMap, Vector, height_at, reliefs_of
from lfpiv_cli.optics.surfaces import Cylinder, Plane, Sphere, Surface, TiltedPlane, meet, normal_change
from lfpiv_cli.optics.tracing import disc_points
from tests.known_rays import assert_rays_go_back

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


def test_the_normal_changes_along_heights(table2: Camera) -> None:
    """Against the normals where lines half a step to either side meet them."""
    faces, step = behind(sampled(of_third_degree)).for_kernels(table2), 1e-4
    for towards in ((step, 0.0), (0.0, step)):
        places, normals = [], []
        for side in (-0.5, 0.0, 0.5):
            start = np.array([1.0 + side * towards[0], -0.5 + side * towards[1], -30.0])
            path, normal, _ = meet(faces.reliefs, faces, 0, tuple(start), (0.0, 0.0, 1.0))
            places.append(start + np.array([0.0, 0.0, path]))
            normals.append(np.array(normal))
        shift, change = (places[2] - places[0]) / step, (normals[2] - normals[0]) / step
        # of second order in the step, and roundings of 1e-15 over it
        np.testing.assert_allclose(
            normal_change(faces.reliefs, faces, 0, tuple(places[1]), tuple(shift)), change, atol=1e-10
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
    ],
)
def test_what_is_no_grid_is_refused(heights: tuple[tuple[float, ...], ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        HeightMap(heights, (1.0, 1.0))


def test_what_is_no_grid_or_beside_the_axis_is_refused() -> None:
    with pytest.raises(ConfigError, match="the optical axis goes past the grid of heights"):
        sampled(of_third_degree, half=(2.0, 1.5), centre=(2.1, 0.0, 0.0)).shape()
