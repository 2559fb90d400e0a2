"""What an image tells of the camera that saw it: rendered with a camera that differs, the difference is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.noise import Noise
from lfpiv_cli.particles.view import Light, View, raw_view
from lfpiv_cli.self_calibration.nuisances import Nuisances, fit_nuisances

DEPTHS = (-4.0, 4.0)
# Half a pixel and a third; a hundredth of the aperture; a fifth of the radius; 2e-4 of stretch at the corner.
TRUE = Nuisances(2.7e-3, -1.8e-3, -0.12, 5e-3, 3e-5)
NOISE = Noise(6.0, 2.0)


@pytest.fixture
def view(table2: Camera, water: Media) -> View:
    return raw_view(replace(table2, columns=460, rows=420), water, 0.025)


def picture(view: View, particles: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """The light of particles with the noise that is stated for it."""
    image = np.zeros(view.camera.rows * view.camera.columns)
    add_all(view, particles, 1.0, image, DEPTHS)
    return image + rng.normal(0.0, np.sqrt(NOISE.read_counts**2 + NOISE.gain_counts * image))


@pytest.mark.thorough
def test_what_the_camera_lacks_is_found(view: View, rng: np.random.Generator) -> None:
    true = rng.uniform((-1.0, -0.9, -3.5, 4e5), (1.0, 0.9, 3.5, 6e5), (60, 4))
    image = picture(TRUE.applied(view), true, rng)
    start = true + rng.normal(0.0, (2e-3, 2e-3, 0.03, 1e4), true.shape)
    fit = fit_nuisances(image, view, start, NOISE, DEPTHS)
    off, sigma = fit.found.whole[:5] - TRUE.whole[:5], fit.sigma.whole[:5]
    assert np.all(np.abs(off) < 4.0 * sigma)
    # All but the distortion, which so small a sensor does not show, are far outside their errors before.
    assert np.all(np.abs(TRUE.whole[:5][:4]) > 8.0 * sigma[:4])
    np.testing.assert_allclose(fit.view.centres_mm, TRUE.applied(view).centres_mm, atol=4.0 * sigma[0])
    depth_error = np.median(np.abs(fit.particles[:, 2] - true[:, 2]))
    assert depth_error < 0.01


@pytest.mark.thorough
def test_a_camera_that_is_right_is_left_as_it_is(view: View, rng: np.random.Generator) -> None:
    true = rng.uniform((-1.0, -0.9, -3.5, 4e5), (1.0, 0.9, 3.5, 6e5), (30, 4))
    fit = fit_nuisances(picture(view, true, rng), view, true, NOISE, DEPTHS)
    assert np.all(np.abs(fit.found.whole[:5]) < 4.0 * fit.sigma.whole[:5])


@pytest.mark.thorough
def test_by_waves_the_aperture_is_believed(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    """All else is found, by the light and the derivatives of line responses."""
    small, depths = replace(table2, columns=300, rows=280), (1.0, 1.6)
    view = raw_view(small, water, 0.025, light=Light(532e-6, 0.3, depths))
    true = rng.uniform((-0.6, -0.5, 1.1, 4e5), (0.6, 0.5, 1.5, 6e5), (20, 4))
    # So near focus four rounds do not settle what half a pixel and a fifth of the radius spoil.
    planted = Nuisances(9e-4, -6e-4, 0.0, 3e-3)
    image = picture(planted.applied(view), true, rng)
    start = true + rng.normal(0.0, (2e-3, 2e-3, 0.03, 1e4), true.shape)
    fit = fit_nuisances(image, view, start, NOISE, depths)
    off, sigma = fit.found.whole[:5] - planted.whole[:5], fit.sigma.whole[:5]
    assert fit.found.aperture_radius_mm == 0.0
    assert np.isnan(sigma[2])
    assert np.all(np.abs(off[[0, 1, 3]]) < 4.0 * sigma[[0, 1, 3]])
    assert np.all(np.abs(planted.whole[:5][[0, 1, 3]]) > 8.0 * sigma[[0, 1, 3]])
