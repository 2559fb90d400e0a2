"""The filter between passes: what it keeps, what it damps, and what it says is not resolved."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.flow.outliers import INTERPOLATION_VOXEL, mixing, smooth_field, unresolved

SHAPE = (12, 16, 12)


def polynomial_field(degree: int) -> NDArray[np.float64]:
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in SHAPE), indexing="ij")
    return np.stack([0.7 * y**degree - 0.3 * z, 0.5 * x**degree, 0.2 * x - 0.1 * z**degree], axis=-1)


def test_filter_keeps_linear_flows_and_damps_noise_everywhere(rng: np.random.Generator) -> None:
    linear = polynomial_field(1)
    np.testing.assert_allclose(smooth_field(linear), linear, atol=1e-12)
    noise = rng.normal(size=(*SHAPE, 3))
    smoothed = smooth_field(noise)
    assert np.std(smoothed) < 0.6 * np.std(noise)
    assert np.std(smoothed[0, 0]) < np.std(noise[0, 0])


def test_filter_keeps_curved_flows_away_from_the_borders() -> None:
    cubic = polynomial_field(3)
    # The straight line at the ends is felt by two windows.
    inner = (slice(2, -2),) * 3
    np.testing.assert_allclose(smooth_field(cubic)[inner], cubic[inner], atol=1e-9)


def test_filter_leaves_short_axes_alone() -> None:
    field = np.arange(12.0).reshape(1, 2, 2, 3)
    np.testing.assert_allclose(smooth_field(field), field, rtol=1e-12)


def test_what_is_not_resolved_is_nothing_in_a_linear_flow_and_grows_around_a_spike() -> None:
    field = polynomial_field(1)
    np.testing.assert_allclose(unresolved(field), INTERPOLATION_VOXEL, rtol=1e-6)
    field[6, 8, 6, 1] += 1.0
    left = unresolved(field)[..., 1]
    # 1 - (10 / 16)^3 of the spike itself goes, shared with the 26 neighbours' smaller losses.
    lost = 1.0 - (10 / 16) ** 3
    assert lost / np.sqrt(27.0) < left[6, 8, 6] < 1.2 * lost / np.sqrt(27.0)
    assert left[5, 7, 7] > 0.9 * left[6, 8, 6]
    assert left[0, 0, 0] == pytest.approx(INTERPOLATION_VOXEL, rel=1e-6)


def test_filter_keeps_a_parabola_at_the_ends_better_than_a_line_does() -> None:
    parabola = polynomial_field(2)
    # With the straight line through the outer three values at the ends, 2 F - F F would miss -0.1 z^2 by 5/36 of that.
    lost = np.abs(smooth_field(parabola) - parabola)[0, 8, 6, 2]
    assert lost < 0.5 * 0.1 * 5.0 / 36.0


def test_mixing_is_the_mean_over_a_particle_s_length() -> None:
    sigma, step = 6.0, 8
    field = polynomial_field(2)
    places = np.linspace(-30.0, 30.0, 601)
    weights = np.exp(-((places / sigma) ** 2))
    mean = np.average(np.square(places), weights=weights) / step**2
    found = mixing(field, np.array([0.0, 0.0, sigma]), (step,) * 3)
    # Away from the ends, whose straight lines bend the parabola. Only the third component is curved along z, by -0.2.
    inner = (slice(2, -2),) * 3
    np.testing.assert_allclose(found[inner], np.broadcast_to([0.0, 0.0, -0.1 * mean], found[inner].shape), atol=1e-6)
    assert np.all(found[0] == 0.0)
    assert np.all(mixing(field, np.zeros(3), (step,) * 3) == 0.0)
