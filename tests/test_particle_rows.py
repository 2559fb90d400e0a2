"""The response by rows against the response by pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.least_squares import lit_by, respond_all, room_for
from lfpiv_cli.particles.noise import Noise, pixel_weights
from lfpiv_cli.particles.view import View, entry_capacity, raw_view
from tests.particle_twin import respond_once

# In, near and out of focus, on both sides, off the axis, and over the sensor's edge; one on the corner of four lenses.
PLACES = [(0.31, -0.2, 3.0), (0.53, 0.21, 0.02), (-0.063, 0.07, 0.2), (0.2, 0.3, -4.0), (1.08, 0.2, 1.0)]


@pytest.fixture(scope="module", params=["square", "hexagonal", "behind a wall"])
def view(table2: Camera, water: Media, request: pytest.FixtureRequest) -> View:
    layout = "hexagonal" if request.param == "hexagonal" else "square"
    lattice = Lattice.regular(0.1, layout, np.deg2rad(0.12), (0.013, -0.02))
    camera = replace(table2, lattice=lattice, columns=400, rows=360, distortion_per_mm2=2e-4)
    wall = Window(camera.focus_distance_mm - 60.0, 5.0)
    space = ObjectSpace(water, wall, "exact") if request.param == "behind a wall" else None
    return raw_view(camera, water, 0.025, space=space)


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_rows_are_the_pixels_one_by_one(view: View, place: tuple[float, float, float]) -> None:
    capacity = entry_capacity(view, -5.0, 5.0)
    pixels, values = np.empty(capacity, np.int32), np.empty((capacity, 4))
    count = respond_once(view, *place, pixels, values)
    responses = room_for(1, capacity, 0)
    respond_all(view, np.array([[*place, 1.0]]), responses)
    named, rows = lit_by(responses, 0)
    found = rows.T
    images = np.zeros((2, view.camera.rows * view.camera.columns, 4))
    np.add.at(images[0], named, found[: named.size])
    np.add.at(images[1], pixels[:count], values[:count])
    largest = np.abs(images[1]).max(axis=0)
    np.testing.assert_allclose(images[0] / largest, images[1] / largest, atol=1e-11)
    # In chi-squared light is squared: each pixel has all of it in one entry.
    lit = found[: named.size, 0] > 0.0
    assert np.unique(named[lit]).size == np.count_nonzero(lit) == np.count_nonzero(images[1][:, 0])


def test_weights_of_pixels_are_those_of_the_noise(rng: np.random.Generator) -> None:
    noise = Noise(5.0, 0.7, 0.03)
    image, residual = rng.normal(100.0, 90.0, 500), rng.normal(0.0, 60.0, 500)
    usable = rng.random(500) < 0.9
    found = pixel_weights(noise, image, residual, usable, 0.1)
    expected = np.where(usable, noise.weights(image - residual, residual, 0.1), 0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
