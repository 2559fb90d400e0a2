"""The vectorised inner loops of the correlation against their plain twins."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from lfpiv_cli.simd import block_sums
from lfpiv_cli.simd.block_sums import FEW_SHIFTS, MANY_SHIFTS, MOMENTS, MOST_TAPS, NEIGHBOURS
from lfpiv_cli.simd.vectors import LANES

# Fused multiply-adds round once where the twins round twice.
ROUNDING = {"rtol": 1e-5, "atol": 1e-5}


@njit
def interpolated(out, to, a, b, places, weights, taps):
    block_sums.interpolate(out, to, a, b, places, weights, taps)


@njit
def weighted(weights, at, places, places_at, low, taps):
    block_sums.spline_weights(weights, at, places, places_at, low, taps)


@njit
def multiplied(out, to, a, b, places, extent, shifts):
    block_sums.products(out, to, a, b, places, extent, shifts)


@njit
def gathered(out, to, a, b, valid, places, extent):
    block_sums.moments(out, to, a, b, valid, places, extent)


@njit
def extremes(places, at):
    return block_sums.range_of_all(places, at)


@pytest.mark.parametrize("taps_x", range(1, MOST_TAPS + 1))
def test_interpolation_equals_its_reference(taps_x: int, rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 3000), np.float32)
    weights = rng.random((3 + 4 + taps_x) * NEIGHBOURS, np.float32)
    found, expected = np.zeros((2, 5 + 2 * NEIGHBOURS), np.float32)
    places = ((3, NEIGHBOURS + 1), a, b, (1503, 400, 20), weights, (-1, -2, 0, 3, 4, taps_x))
    interpolated(found, *places)
    block_sums.interpolate_reference(expected, *places)
    np.testing.assert_allclose(found, expected, **ROUNDING)


@pytest.mark.parametrize(("low", "taps", "places"), [(-2, 5, (-1.0, 1.0)), (-3, 4, (-2.0, -1.0)), (0, 4, (1.0, 2.0))])
def test_spline_weights_equal_their_reference_and_sum_to_one(
    low: int, taps: int, places: tuple[float, float], rng: np.random.Generator
) -> None:
    places = rng.uniform(*places, 3 * NEIGHBOURS).astype(np.float32)
    found, expected = np.zeros((2, 7 * NEIGHBOURS), np.float32)
    weighted(found, NEIGHBOURS, places, 5, low, taps)
    block_sums.spline_weights_reference(expected, NEIGHBOURS, places, 5, low, taps)
    np.testing.assert_allclose(found, expected, **ROUNDING)
    np.testing.assert_allclose(found.reshape(7, NEIGHBOURS).sum(axis=0), 1.0, atol=1e-6)


@pytest.mark.parametrize("shifts", [FEW_SHIFTS, MANY_SHIFTS])
def test_products_equal_their_reference(shifts: int, rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 5000), np.float32)
    found, expected = np.zeros((2, 3 + 6 * LANES), np.float32)
    places = ((3, LANES + 1), a, b, (2000, 400, 20), (3, 4), (-421, shifts))
    multiplied(found, *places)
    block_sums.products_reference(expected, *places)
    np.testing.assert_allclose(found, expected, **ROUNDING)


def test_moments_equal_their_reference(rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 5000), np.float32)
    valid = (rng.random(5000) < 0.9).astype(np.uint8)
    found, expected = np.zeros((2, 3 + MOMENTS * (LANES + 1)), np.float32)
    places = ((3, LANES + 1), a, b, valid, (2000, 400, 20), (3, 4))
    gathered(found, *places)
    block_sums.moments_reference(expected, *places)
    np.testing.assert_allclose(found, expected, **ROUNDING)


@pytest.mark.parametrize("extreme", range(NEIGHBOURS))
def test_extremes_are_those_of_sixteen(extreme: int, rng: np.random.Generator) -> None:
    places = rng.random(3 * NEIGHBOURS, np.float32)
    places[4 + extreme] = -3.0
    places[4 + (extreme + 7) % NEIGHBOURS] = 5.0
    places[4 + NEIGHBOURS] = 9.0
    assert extremes(places, 4) == (-3.0, 5.0)
