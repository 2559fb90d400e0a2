"""What a sensor makes of expected counts: the noise's mean and variance, the ends of the scale."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.synthetic.render import Readout


@pytest.mark.parametrize("photons_per_count", [0.5, 4.0])
def test_mean_and_variance(rng, photons_per_count):
    recorded = Readout(photons_per_count, 6.0, 96.0).record(np.full(40_000, 500.0), rng)
    # shot noise: counts / photons per count; read noise 6^2; rounding 1/12
    variance = 500.0 / photons_per_count + 36.0 + 1 / 12
    assert recorded.mean() == pytest.approx(596.0, abs=4 * np.sqrt(variance / 40_000))
    assert recorded.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / 40_000))


def test_a_dark_frame_is_the_dark_level_and_read_noise(rng):
    dark = Readout(0.5, 6.0, 96.0).record(np.zeros(40_000), rng)
    assert (dark.mean(), dark.std()) == (pytest.approx(96.0, abs=0.15), pytest.approx(6.0, abs=0.1))


@pytest.mark.parametrize(("bits", "top"), [(12, 4095), (16, 65535)])
def test_counts_end_at_the_bits(rng, bits, top):
    readout = Readout(None, 0.0, 0.0, bits)
    recorded = readout.record(np.array([0.0, 0.4, 0.6, top - 0.6, top + 10.0, 1e9]), rng)
    assert recorded.tolist() == [0, 0, 1, top - 1, top, top]
    assert recorded.dtype == np.uint16


def test_noise_below_zero_is_clipped_not_wrapped(rng):
    assert Readout(None, 50.0, 0.0).record(np.zeros(1000), rng).max() < 400


def test_the_seed_decides_the_noise():
    expected = np.linspace(0, 100, 50)
    first, second = (Readout().record(expected, np.random.default_rng(8)) for _ in range(2))
    assert np.array_equal(first, second)
