"""Decoded pictures of points traced ray by ray: where they stand in views and refocused pictures, and how sharp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.calibration.views import refocused_stack, sub_aperture_view, views_across
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import disc_points, trace
from tests.known_rays import slopes_equivalent

RAYS = 100_000
POINT = (0.42, -0.31, 4.0)


@pytest.fixture
def small(camera: Camera) -> Camera:
    lattice = camera.lattice.transformed(np.eye(2), (0.013, -0.021))
    return replace(camera, columns=500, rows=420, lattice=lattice)


@pytest.fixture
def image(small: Camera, water: Media, rng: np.random.Generator) -> NDArray[np.float64]:
    """A small glowing disc, as wide as a microlens."""
    start = np.column_stack([disc_points(RAYS, 0.05, rng), np.zeros(RAYS)]) + POINT
    lens = disc_points(RAYS, small.aperture_radius_mm, rng)
    hits = trace(small, lens, slopes_equivalent(start, lens, small, water))
    column, row = np.rint(small.mm_to_px(hits.sensor_mm)).astype(int).T
    counts = np.bincount(row * small.columns + column, minlength=small.columns * small.rows)
    return counts.reshape(small.rows, small.columns).astype(float)


def test_refocused_at_its_depth_a_point_is_sharp_and_in_its_place(small: Camera, water: Media, image) -> None:
    depths = (0.0, 2.0, 4.0, 6.0, 8.0)
    stack = refocused_stack(image, small, water, depths)
    assert np.argmax(np.sum(stack**2, axis=(1, 2))) == 2
    sharp = stack[2]
    row, column = ndimage.center_of_mass(np.where(sharp > 0.2 * sharp.max(), sharp, 0.0))
    found = (np.array([column, row]) - (np.array(sharp.shape[::-1]) - 1) / 2) * small.lattice.pitch.min()
    # One sample per microlens, 0.1 mm; a centroid over two of them is good to a quarter.
    np.testing.assert_allclose(found, POINT[:2], atol=0.03)


def test_views_stand_in_the_order_of_their_points_and_none_beyond_the_rim(small: Camera, image) -> None:
    views = views_across(image, small, 5)
    radius = small.aperture_radius_mm
    point, right = views[2, 4]
    np.testing.assert_allclose(point, (0.8 * radius, 0.0))
    np.testing.assert_array_equal(right, sub_aperture_view(image, small, point))
    np.testing.assert_allclose(views[0, 1][0], (-0.4 * radius, -0.8 * radius))
    corners = {(row, column) for row in (0, 4) for column in (0, 4)}
    assert set(views) == {(row, column) for row in range(5) for column in range(5)} - corners
