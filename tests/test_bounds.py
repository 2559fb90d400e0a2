"""The Cramer-Rao bound against finite differences, the inverse of the whole matrix, and fits to many noisy images."""

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.view import Light, View, raw_view
from lfpiv_cli.synthetic.render import Readout
from lfpiv_cli.validation.planning import UNKNOWNS, cramer_rao_bound, expected_image, pixel_variance, slopes

# Two that overlap, and one alone on the other side of the focal plane.
PARTICLES = np.array([[0.21, -0.2, 2.0, 4e5], [0.25, -0.18, 2.1, 5e5], [-0.42, 0.33, -1.5, 3e5]])
READOUT = Readout(photons_per_count=0.5, read_noise_counts=6.0)
IMAGES = 150
# Gauss-Newton steps of a fit: from the truth the second is a thousandth of a standard error already.
STEPS = 2


@pytest.fixture(scope="module", params=["square", "hexagonal", pytest.param("waves", marks=pytest.mark.thorough)])
def view(request: pytest.FixtureRequest) -> View:
    """The paper's camera with a small sensor, either kind of array, seen through distortion; and by waves."""
    by_waves = request.param == "waves"
    lattice = Lattice.regular(0.1, "square" if by_waves else request.param)
    camera = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, lattice, 0.0055, 290, 260, distortion_per_mm2=2e-4)
    light = Light(532e-6, 0.3, (-1.6, 2.2)) if by_waves else None
    return raw_view(camera, Media(1.0, 1.49, 1.33), 0.025, light=light)


def fitted(view: View, image: Floats, weight: Floats) -> Floats:
    """Return the particles (n, 4) that fit an image best, by weighted least squares from the truth."""
    particles = PARTICLES.copy()
    for _ in range(STEPS):
        slope = slopes(view, particles)
        weighted = slope.T * weight
        matrix, right = (weighted @ slope).toarray(), weighted @ (image - expected_image(slope, particles))
        particles += np.linalg.solve(matrix, right).reshape(particles.shape)
    return particles


@pytest.mark.thorough
def test_slopes_are_finite_differences(view: View) -> None:
    slope = slopes(view, PARTICLES)
    for unknown, step in enumerate((1e-3, 1e-3, 1e-2, 1.0)):
        moved = np.zeros_like(PARTICLES)
        moved[1, unknown] = step
        there = [expected_image(slopes(view, each), each) for each in (PARTICLES + moved, PARTICLES - moved)]
        difference = (there[0] - there[1]) / (2.0 * step)
        analytic = slope[:, [UNKNOWNS + unknown]].toarray().ravel()
        # Steps that are small against the ball's 0.05 mm; the kinks of its profile within them remain.
        assert np.abs(analytic - difference).sum() < 0.04 * np.abs(difference).sum()


@pytest.mark.thorough
def test_bound_is_the_inverse_of_the_whole_matrix(view: View) -> None:
    # A chain: the first and the last share no pixel, the middle one some with both.
    chain = np.array([[-0.4, 0.0, 2.0, 4e5], [0.0, 0.02, 2.1, 5e5], [0.38, 0.0, 1.9, 3e5]])
    slope = slopes(view, chain)
    variance = pixel_variance(expected_image(slope, chain), READOUT)
    dense = slope.toarray()
    matrix = dense.T @ (dense / variance[:, np.newaxis])
    bound = cramer_rao_bound(slope, variance)
    for number in range(len(chain)):
        part = slice(UNKNOWNS * number, UNKNOWNS * (number + 1))
        assert bound.alone[number] == pytest.approx(np.linalg.inv(matrix[part, part]), rel=1e-5)
        # What is two steps away is held.
        assert np.diag(bound.joint[number]) == pytest.approx(np.diag(np.linalg.inv(matrix)[part, part]), rel=0.02)


@pytest.mark.thorough
def test_no_fit_is_better_and_a_good_one_as_good(view: View) -> None:
    slope = slopes(view, PARTICLES)
    expected = expected_image(slope, PARTICLES)
    variance = pixel_variance(expected, READOUT)
    bound = cramer_rao_bound(slope, variance)
    rng = np.random.default_rng(6)
    errors = []
    for _ in range(IMAGES):
        image = READOUT.record(expected, rng) - READOUT.dark_level_counts
        errors.append(fitted(view, image, 1.0 / variance) - PARTICLES)
    ratio = np.std(errors, axis=0) / np.sqrt(np.diagonal(bound.joint, axis1=1, axis2=2))
    # A standard deviation of so many is known to 1/sqrt(2 n), here to 6 %.
    assert np.abs(ratio - 1.0).max() < 3.0 / np.sqrt(2.0 * IMAGES)


@pytest.mark.thorough
def test_neighbours_cost_accuracy_and_only_where_they_are(view: View) -> None:
    particles = PARTICLES.copy()
    particles[1] = particles[0] + (0.01, 0.01, 0.05, 0.0)
    slope = slopes(view, particles)
    bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, particles), READOUT))
    price = bound.sigma_mm(joint=True) / bound.sigma_mm(joint=False)
    assert price[2] == pytest.approx(1.0)
    assert price[:2].min() > 1.0
    assert price[:2].max() > 1.5


def test_place_is_hardly_known_in_focus_and_not_at_all_off_the_sensor(view: View) -> None:
    # Well within its lens, whose micro-image follows it by the ratio of the distances behind the array and before it.
    particles = np.array([[0.003, -0.002, 0.0, 5e5], [0.003, -0.002, 2.0, 5e5], [9.0, 0.0, 2.0, 5e5]])
    slope = slopes(view, particles)
    sigma = cramer_rao_bound(slope, pixel_variance(expected_image(slope, particles), READOUT)).sigma_mm(joint=False)
    assert np.all(sigma[0, :2] > 20.0 * sigma[1, :2])
    assert np.all(np.isinf(sigma[2]))
    # No particles have no bound.
    slope = slopes(view, np.zeros((0, UNKNOWNS)))
    bound = cramer_rao_bound(slope, np.ones(view.camera.rows * view.camera.columns))
    assert bound.joint.shape == (0, UNKNOWNS, UNKNOWNS)


def test_variance_adds_up() -> None:
    light = np.array([-1.0, 0.0, 100.0])
    base = 6.0**2 + 1.0 / 12.0  # of rounding to whole counts
    assert pixel_variance(light, READOUT) == pytest.approx([base, base, base + 200.0])
    assert pixel_variance(light, replace(READOUT, photons_per_count=None)) == pytest.approx([base] * 3)
    assert pixel_variance(light, READOUT, counts_per_ray=10.0)[2] > base + 200.0
