"""Places by Snell's law: rays traced one by one, fitted with paraxial ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, Window, exact_lateral_mm
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import observation_of
from lfpiv_cli.particles.refraction import paraxial_shift, places_by_snell
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.synthetic.render import Balls, render_points

# The fits take half a minute to compile.
pytestmark = pytest.mark.thorough

DEPTHS = (-4.5, 4.5)


def behind(camera: Camera, media: Media, fluid_mm: float, wall_mm: float) -> ObjectSpace:
    """Return a wall and so much fluid before the focal point."""
    distance = camera.focus_distance_mm - fluid_mm * media.depth_ratio - wall_mm / media.window
    return ObjectSpace(media, Window(distance, wall_mm), "exact")


@pytest.mark.parametrize("fluid_mm", [5.0, 100.0])
def test_particles_are_fitted_with_refracted_rays(
    table2: Camera, water: Media, rng: np.random.Generator, fluid_mm: float
) -> None:
    camera = replace(table2, columns=900, rows=600)
    space = behind(camera, water, fluid_mm, 5.0)
    true = np.array([(-1.2, 0.3, 2.5), (0.4, -0.8, 3.1), (1.5, 0.6, -2.2), (-0.3, 1.1, -3.0), (1.6, 0.0, 1.2)])
    image = render_points(camera, space, Balls(true, np.full(5, 4e5), 0.05), rng, rays=100_000).ravel()
    view = raw_view(camera, water, 0.025, space=space)
    found = np.column_stack([true, np.full(5, 4e5)])
    residual = image.copy()
    add_all(view, found, -1.0, residual, DEPTHS)
    for _ in range(5):
        refine(observation_of(view, residual, 1.0 / (image + 36.0), DEPTHS), found)
    error = found[:, :3] - true
    # What the noise of so many rays moves a depth by; straight rays put the particles up to 0.1 mm too near.
    assert np.abs(error[:, 2]).max() < 0.003
    assert np.abs(error[:, :2]).max() < 3e-4


def test_shift_is_that_of_the_best_focus(table2: Camera, water: Media) -> None:
    space = behind(table2, water, 60.0, 5.0)
    view = raw_view(table2, water, 0.025, space=space)
    shift = paraxial_shift(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), view)
    # On the axis a ray at height h seems to come from nearer by c h^2; by least squares over a disc that is 2/3 c R^2.
    for z, found in zip((-1.0, 1.0), shift, strict=True):
        layers, indices = space.layers(table2)
        layers = layers + (0.0, 0.0, z)
        slope = table2.aperture_radius_mm / float(space.distance(table2, z))
        height = float(exact_lateral_mm(slope, layers, indices, 1.0))
        at_rim = (table2.aperture_radius_mm - height) / slope / water.depth_ratio
        assert found[2] == pytest.approx(-2.0 / 3.0 * at_rim, rel=0.02)
        assert np.abs(found[:2]).max() < 1e-12
    assert shift[1, 2] < shift[0, 2] < -0.03


def test_air_shifts_nothing_and_the_wall_does(table2: Camera, water: Media) -> None:
    points = np.array([[1.0, -2.0, -5.3], [0.5, 0.5, 2.0]])
    in_air = raw_view(table2, water.in_air(), 0.025, space=ObjectSpace(water.in_air()))
    np.testing.assert_array_equal(places_by_snell(points, in_air), points)
    # A point in the window has the window's own shift, not an error.
    shift = paraxial_shift(points, raw_view(table2, water, 0.025, space=behind(table2, water, 5.0, 5.0)))
    assert np.all(shift[:, 2] < -0.002)
