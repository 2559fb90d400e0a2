"""The response by rows against the response by pixels, and the vector code against its readable twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.cells import rim_table
from lfpiv_cli.particles.least_squares import lit_by, respond_all, room_for
from lfpiv_cli.particles.noise import Noise, pixel_weights
from lfpiv_cli.particles.view import View, entry_capacity, raw_view
from lfpiv_cli.simd import micro_images
from lfpiv_cli.simd.micro_images import OF_ROW, PROFILE_ROWS, RIM_ROWS, STRIDE, WHOLE, CurvedNumbers, JoinNumbers
from tests.particle_twin import respond_once

# In, near and out of focus, on both sides, off the axis, and over the sensor's edge; one on the corner of four lenses.
PLACES = [(0.31, -0.2, 3.0), (0.53, 0.21, 0.02), (-0.063, 0.07, 0.2), (0.2, 0.3, -4.0), (1.08, 0.2, 1.0)]
COLUMNS = 11


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


@njit
def filled(out, count, numbers):
    micro_images.fill_profile(out, count, numbers)


@njit
def covered(rim, across, columns, down, row, table, numbers):
    micro_images.cover_row(rim, across, columns, down, row, table, numbers)


@njit
def joined(pixels, values, to, across, columns, down, row, rim, numbers):
    micro_images.join_row(pixels, values, to, across, columns, down, row, rim, numbers)


@njit
def joined_behind_faces(pixels, values, to, across, columns, down, row, rim, numbers):
    micro_images.join_curved_row(pixels, values, to, across, columns, down, row, rim, numbers)


def profile(first: float, offset: float) -> NDArray[np.float64]:
    """Return a profile's table of a lens that sees the ball in part."""
    numbers = (first, -1.4, 1.4, offset, 0.009, -0.7, 0.3, 0.002, 0.05, 40.0, -0.03, 0.4)
    found, expected = np.zeros((2, PROFILE_ROWS * STRIDE))
    filled(found, COLUMNS, numbers)
    micro_images.fill_profile_reference(expected, COLUMNS, numbers)
    found, expected = (table.reshape(PROFILE_ROWS, STRIDE)[:, :COLUMNS] for table in (found, expected))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
    table = np.zeros((PROFILE_ROWS, STRIDE))
    table[:, :COLUMNS] = expected
    return table.ravel()


@pytest.mark.thorough
def test_rows_equal_their_references() -> None:
    across, down = profile(9.0, 0.02), profile(13.4, -0.08)
    table, reach = rim_table(12.5, 1.375)
    rims = np.zeros((2, 2 * RIM_ROWS * STRIDE))
    rims[:, WHOLE : WHOLE + STRIDE] = 1.0
    known = (12.5, 1.4, 1.0 / 1.4, 16.0 / reach, 16.0 * 1.4, 16.0, 31.999, 15.999, 11.0**2)
    covered(rims[0], across, (1, COLUMNS - 1), down, 2, table, known)
    micro_images.cover_row_reference(rims[1], across, (1, COLUMNS - 1), down, 2, table, known)
    ours, theirs = rims.reshape(2, 2, RIM_ROWS, STRIDE)[:, :, :, 1:COLUMNS]
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    assert np.ptp(theirs[1, 0]) > 0.1
    for kind, join, reference in (
        (JoinNumbers, joined, micro_images.join_row_reference),
        (CurvedNumbers, joined_behind_faces, micro_images.join_curved_row_reference),
    ):
        # Bent rays change little.
        numbers = np.linspace(0.1, 0.4, len(kind._fields))
        numbers[-4:] *= 1e-4
        for left in (WHOLE, OF_ROW):
            pixels, values = np.zeros((2, 40), np.int32), np.zeros((2, 4, 40))
            arguments = ((5, 100), across, (1, COLUMNS - 1, left), down, 2, rims[1], numbers)
            join(pixels[0], values[0], *arguments)
            reference(pixels[1], values[1], *arguments)
            written = slice(5, 5 + COLUMNS - 1)
            np.testing.assert_array_equal(pixels[0, written], pixels[1, written])
            np.testing.assert_allclose(values[0, :, written], values[1, :, written], rtol=1e-9, atol=1e-12)
            assert np.count_nonzero(values[1, 0]) > 3


def test_weights_of_pixels_are_those_of_the_noise(rng: np.random.Generator) -> None:
    noise = Noise(5.0, 0.7, 0.03)
    image, residual = rng.normal(100.0, 90.0, 500), rng.normal(0.0, 60.0, 500)
    usable = rng.random(500) < 0.9
    found = pixel_weights(noise, image, residual, usable, 0.1)
    expected = np.where(usable, noise.weights(image - residual, residual, 0.1), 0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
