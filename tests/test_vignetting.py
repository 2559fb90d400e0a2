"""Vignetting: what a white image says slowly over the lenses, and the weights behind it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.calibration.white import fit_vignetting, relative_transmission, vignetting_surface
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic.render import render_white
from lfpiv_cli.weights.build import factorise
from lfpiv_cli.weights.columns import OnDemandOperator

SHAPE = (520, 760)


@pytest.fixture
def small(table2, layout):
    return replace(table2, rows=SHAPE[0], columns=SHAPE[1], lattice=Lattice.regular(0.1, layout))


def shading() -> np.ndarray:
    """cos^4 of a steep lens, 0.6 in the corners."""
    y, x = np.meshgrid(*((np.arange(n) - n / 2) / (n / 2) for n in SHAPE), indexing="ij")
    return 1.0 / (1.0 + 0.145 * (x**2 + y**2)) ** 2


@pytest.mark.thorough
def test_vignetting_is_found_under_the_rims_of_the_lens_images(small):
    white = render_white(small, 1000.0) * shading()
    lattice = small.micro_image_lattice_px()
    coefficients = fit_vignetting(relative_transmission(white.astype(np.float32), lattice), lattice)
    surface = vignetting_surface(coefficients, SHAPE)
    np.testing.assert_allclose(surface, shading(), atol=0.01)


@pytest.mark.parametrize("pitch_mm", [0.055, 0.1])
def test_even_light_on_a_small_sensor_stays_even_up_to_its_border(pitch_mm, table2, layout, rng):
    camera = replace(table2, rows=180, columns=210, lattice=Lattice.regular(pitch_mm, layout))
    lattice = camera.micro_image_lattice_px()
    white = rng.poisson(render_white(camera, 400.0)).astype(np.float32)
    coefficients = fit_vignetting(relative_transmission(white, lattice), lattice)
    # Medians of some twenty pixels with a twentieth of noise each, and some six times their error in the corners.
    np.testing.assert_allclose(vignetting_surface(coefficients, (180, 210)), 1.0, atol=0.09)


def test_too_few_lit_pixels_say_nothing():
    assert fit_vignetting(np.zeros((60, 60), np.float32), Lattice.regular(18.0)) is None


@pytest.mark.thorough
def test_weights_behind_a_transmission_scale_their_pixels(table2, water, rng):
    camera = replace(table2, rows=260, columns=380)
    grid = Grid.centred((3, 3, 2), (0.1, 0.1, 0.5), (0.1, 0.0, 1.0))
    transmission = rng.random((260, 380), dtype=np.float32)
    on_demand = OnDemandOperator(camera, ObjectSpace(water, None, "paraxial"), grid)
    volume = rng.random(grid.shape_zyx, dtype=np.float32)
    for operator in (factorise(camera, water, grid), on_demand, on_demand.restricted(np.ones((260, 380), np.float32))):
        dimmed = operator.behind(transmission)
        np.testing.assert_allclose(dimmed.forward(volume), operator.forward(volume) * transmission, atol=1e-6)
        image = rng.random((260, 380), dtype=np.float32)
        np.testing.assert_allclose(dimmed.adjoint(image), operator.adjoint(image * transmission), rtol=1e-5)
