"""The vectorised inner loops of the correlation against their plain twins."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from lfpiv_cli.flow import lane_sums, lanes
from lfpiv_cli.simd.block_sums import FEW_SHIFTS, MANY_SHIFTS, MOMENTS
from lfpiv_cli.simd.splines import MOST_TAPS
from lfpiv_cli.simd.vectors import LANES

# Fused multiply-adds round once where the twins round twice.
ROUNDING = {"rtol": 1e-5, "atol": 1e-5}


@njit
def interpolated(out_a, out_b, out_at, a, b, at, plane, row, weights, low_z, low_y, low_x, taps_z, taps_y, taps_x):
    lanes.interpolate(out_a, out_b, out_at, a, b, at, plane, row, weights, low_z, low_y, low_x, taps_z, taps_y, taps_x)


@njit
def weighted(weights, at, places, places_at, low, taps):
    lanes.spline_weights(weights, at, places, places_at, low, taps)


@njit
def multiplied(out, out_at, out_step, a, b, at, shift, plane, row, planes, rows, shifts):
    lane_sums.products(out, out_at, out_step, a, b, at, shift, plane, row, planes, rows, shifts)


@njit
def gathered(out, out_at, out_step, a, b, valid, at, plane, row, planes, rows):
    lane_sums.moments(out, out_at, out_step, a, b, valid, at, plane, row, planes, rows)


@njit
def extremes(places, at):
    return lanes.lowest(places, at), lanes.highest(places, at)


@pytest.mark.parametrize("taps_x", range(1, MOST_TAPS + 1))
def test_interpolation_equals_its_reference(taps_x: int, rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 3000), np.float32)
    weights = rng.random((3 + 4 + taps_x) * LANES, np.float32)
    found, expected = np.zeros((2, 2, 3 * LANES), np.float32)
    places = (5, a, b, 1503, 400, 20, weights, -1, -2, 0, 3, 4, taps_x)
    interpolated(*found, *places)
    lanes.interpolate_reference(*expected, *places)
    np.testing.assert_allclose(found, expected, **ROUNDING)


@pytest.mark.parametrize(("low", "taps", "places"), [(-2, 5, (-1.0, 1.0)), (-3, 4, (-2.0, -1.0)), (0, 4, (1.0, 2.0))])
def test_spline_weights_equal_their_reference_and_sum_to_one(
    low: int, taps: int, places: tuple[float, float], rng: np.random.Generator
) -> None:
    places = rng.uniform(*places, 3 * LANES).astype(np.float32)
    found, expected = np.zeros((2, 7 * LANES), np.float32)
    weighted(found, LANES, places, 5, low, taps)
    lanes.spline_weights_reference(expected, LANES, places, 5, low, taps)
    np.testing.assert_allclose(found, expected, **ROUNDING)
    np.testing.assert_allclose(found.reshape(7, LANES).sum(axis=0), 1.0, atol=1e-6)


@pytest.mark.parametrize("shifts", [FEW_SHIFTS, MANY_SHIFTS])
def test_products_equal_their_reference(shifts: int, rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 5000), np.float32)
    found, expected = np.zeros((2, 3 + 6 * LANES), np.float32)
    places = (3, LANES + 1, a, b, 2000, -421, 400, 20, 3, 4, shifts)
    multiplied(found, *places)
    lane_sums.products_reference(expected, *places)
    np.testing.assert_allclose(found, expected, **ROUNDING)


def test_moments_equal_their_reference(rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 5000), np.float32)
    valid = (rng.random(5000) < 0.9).astype(np.uint8)
    found, expected = np.zeros((2, 3 + MOMENTS * (LANES + 1)), np.float32)
    places = (3, LANES + 1, a, b, valid, 2000, 400, 20, 3, 4)
    gathered(found, *places)
    lane_sums.moments_reference(expected, *places)
    np.testing.assert_allclose(found, expected, **ROUNDING)


@pytest.mark.parametrize("extreme", range(LANES))
def test_extremes_are_those_of_sixteen(extreme: int, rng: np.random.Generator) -> None:
    places = rng.random(3 * LANES, np.float32)
    places[4 + extreme] = -3.0
    places[4 + (extreme + 7) % LANES] = 5.0
    places[4 + LANES] = 9.0
    assert extremes(places, 4) == (-3.0, 5.0)
