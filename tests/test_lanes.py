"""The vectorised inner loops of the correlation against their plain twins."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from lfpiv_cli.flow import lanes
from lfpiv_cli.flow.lanes import FEW_SHIFTS, LANES, MANY_SHIFTS

# Fused multiply-adds round once where the twins round twice.
ROUNDING = {"rtol": 1e-5, "atol": 1e-5}


@njit
def interpolated(out, a, b, at, plane, row, weights, low_z, low_y, low_x, taps_z, taps_y, taps_x):
    lanes.interpolate(out, a, b, at, plane, row, weights, low_z, low_y, low_x, taps_z, taps_y, taps_x)


@njit
def weighted(weights, at, places, places_at, low, taps):
    lanes.spline_weights(weights, at, places, places_at, low, taps)


@njit
def few(out, out_at, out_step, a, b, at, shift, plane, row, planes, rows):
    lanes.few_products(out, out_at, out_step, a, b, at, shift, plane, row, planes, rows)


@njit
def many(out, out_at, out_step, a, b, at, shift, plane, row, planes, rows):
    lanes.many_products(out, out_at, out_step, a, b, at, shift, plane, row, planes, rows)


@njit
def extremes(places, at):
    return lanes.lowest(places, at), lanes.highest(places, at)


def test_interpolation_equals_its_reference(rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 3000), np.float32)
    weights = rng.random((3 + 4 + 5) * LANES, np.float32)
    found, expected = np.zeros((2, 2 * LANES), np.float32)
    places = (1503, 400, 20, weights, -1, -2, 0, 3, 4, 5)
    interpolated(found, a, b, *places)
    lanes.interpolate_reference(expected, a, b, *places)
    np.testing.assert_allclose(found, expected, **ROUNDING)


def test_spline_weights_equal_their_reference_and_sum_to_one(rng: np.random.Generator) -> None:
    places = rng.uniform(-1.0, 1.0, 3 * LANES).astype(np.float32)
    found, expected = np.zeros((2, 7 * LANES), np.float32)
    weighted(found, LANES, places, 5, -2, 5)
    lanes.spline_weights_reference(expected, LANES, places, 5, -2, 5)
    np.testing.assert_allclose(found, expected, **ROUNDING)
    np.testing.assert_allclose(found.reshape(7, LANES).sum(axis=0), 1.0, atol=1e-6)


@pytest.mark.parametrize(("compiled", "shifts"), [(few, FEW_SHIFTS), (many, MANY_SHIFTS)])
def test_products_equal_their_reference(compiled, shifts: int, rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 5000), np.float32)
    found, expected = np.zeros((2, 3 + 6 * LANES), np.float32)
    places = (3, LANES + 1, a, b, 2000, -421, 400, 20, 3, 4)
    compiled(found, *places)
    lanes.products_reference(expected, *places, shifts)
    np.testing.assert_allclose(found, expected, **ROUNDING)


@pytest.mark.parametrize("extreme", range(LANES))
def test_extremes_are_those_of_sixteen(extreme: int, rng: np.random.Generator) -> None:
    places = rng.random(3 * LANES, np.float32)
    places[4 + extreme] = -3.0
    places[4 + (extreme + 7) % LANES] = 5.0
    places[4 + LANES] = 9.0
    assert extremes(places, 4) == (-3.0, 5.0)
