"""Images through curved windows: against plane layers, aimed rays one by one, and what a rim hides."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media, Window, fluid_path_to_focus
from lfpiv_cli.optics.surfaces import Plane
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points, trace
from lfpiv_cli.synthetic import rays as of_rays
from lfpiv_cli.synthetic.rays import FITTED, SEQUENCE, TERMS, TOLERANCE_MM, fit_of_slopes, fitted_slopes, unseen
from lfpiv_cli.synthetic.render import Balls, render_points
from tests.known_rays import tube_of

WATER = Media(1.0, 1.49, 1.33)
OUTER_MM, INNER_MM, APERTURE_MM = 7.0, 5.0, 12.5


@pytest.fixture
def small(camera: Camera) -> Camera:
    """A corner of the camera, its array turned, shifted and distorted, with either kind of array."""
    lattice = Lattice.regular(0.1, camera.lattice.layout, 0.01, (0.013, -0.021))
    return replace(camera, columns=150, rows=120, lattice=lattice, distortion_per_mm2=1e-3)


def moved_light(a: Floats, b: Floats) -> float:
    """Return the share of the light that lies in other pixels."""
    return float(np.abs(a - b).sum() / a.sum())


def test_plane_faces_make_the_images_of_plane_layers(small: Camera) -> None:
    window = Window(98.0, 2.0)
    path = fluid_path_to_focus(window, small.focus_distance_mm, WATER)
    faces = CurvedSpace(WATER, (Face(Plane(-path - 2.0), 1.49), Face(Plane(-path), 1.33)))
    balls = Balls(np.array([[0.05, -0.1, 3.0], [-0.2, 0.1, -4.0]]), np.array([1.0, 3.0]), np.array([0.05, 0.2]))
    spaces = faces, ObjectSpace(WATER, window, "exact")
    images = [render_points(small, space, balls, np.random.default_rng(5), rays=4000) for space in spaces]
    assert images[0].sum() > 3.0
    # 1e-6 mm move one ray of five thousand over a pixel's border
    assert moved_light(*images) < 2e-3


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
    assert moved_light(expected, found) < 2e-3


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
