"""The inner loops of the correlation against sums in double precision: float32 rounding is all that they differ by."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.flow.deformation import MOST_TAPS, NEIGHBOURS, gather_taps, interpolate
from lfpiv_cli.flow.moments import MOMENTS, pair_moments
from lfpiv_cli.flow.sums import map_sums, margins
from lfpiv_cli.flow.windows import layout_windows


def spline(s: np.ndarray) -> np.ndarray:
    """Return the cubic B-spline."""
    outer, inner = (np.maximum(0.0, reach - np.abs(s)) ** 3 for reach in (2.0, 1.0))
    return (outer - 4.0 * inner) / 6.0


@pytest.mark.parametrize(("spread", "fewer"), [((0.2, 0.7), False), ((-1.9, 2.0), False), ((-4.0, 4.0), True)])
def test_interpolation_sums_b_splines_at_mirrored_places(
    spread: tuple[float, float], fewer: bool, rng: np.random.Generator
) -> None:
    a, b = rng.standard_normal((2, 19 * 21 * 80), np.float32)
    moved = rng.uniform(*spread, (3, 3 * NEIGHBOURS)).astype(np.float32)
    weights, sums = np.zeros((3, MOST_TAPS * NEIGHBOURS), np.float32), np.zeros((2, NEIGHBOURS), np.float32)
    width, taps = gather_taps(moved, 5, weights)
    assert (width < NEIGHBOURS) == fewer
    at, plane, row = 9 * 21 * 80 + 10 * 80 + 30, 21 * 80, 80
    interpolate(sums, (a, b), (at, plane, row), weights, taps)
    steps = np.arange(-6, 7)
    away = steps[:, None, None] * plane + steps[:, None] * row + steps
    for k in range(width):
        x, y, z = (spline(steps - float(moved[axis, 5 + k])) for axis in range(3))
        share = z[:, None, None] * y[:, None] * x
        # float32 sums of up to 512 terms; taps that weigh less than 2e-7 are left out
        assert sums[0, k] == pytest.approx(np.sum(share * a[at + k - away]), abs=1e-5)
        assert sums[1, k] == pytest.approx(np.sum(share * b[at + k + away]), abs=1e-5)


@pytest.mark.parametrize("radius", [1, 2, 4])
def test_products_are_summed_over_windows_for_every_shift(radius: int, rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 5, 6, 80), np.float32)
    layout = layout_windows((80, 6, 5), (70, 4, 3), (0.5, 0.5, 0.5))
    before, after = margins(layout, a.shape, radius)
    padded_a, padded_b = (np.pad(one, list(zip(before, after, strict=True))) for one in (a, b))
    sums = map_sums(padded_a, padded_b, layout, before, radius)
    places = rng.integers(0, 2 * radius + 1, (20, 3))
    first = np.add(before, layout.first[::-1])
    here = tuple(slice(low, low + size) for low, size in zip(first, layout.size[::-1], strict=True))
    assert sums.blocks.per_window[:2] == (1, 1)
    for place in places:
        shift = place - radius
        there, back = (
            tuple(slice(s.start + k, s.stop + k) for s, k in zip(here, sign * shift, strict=True)) for sign in (1, -1)
        )
        wide_a, wide_b = padded_a.astype(np.float64), padded_b.astype(np.float64)
        expected = np.sum(wide_a[here] * wide_b[there] + wide_a[back] * wide_b[here])
        assert sums.products[0, 0, 0][tuple(place)] == pytest.approx(expected, abs=2e-4)


def test_moments_are_those_of_gradient_mean_and_difference(rng: np.random.Generator) -> None:
    a, b = rng.standard_normal((2, 6, 7, 12), np.float32)
    valid = (rng.random(a.shape) < 0.95).astype(np.uint8)
    layout = layout_windows((10, 5, 4), (10, 5, 4), (0.0, 0.0, 0.0))
    found = pair_moments(a, b, valid, layout, (1, 1, 1)).sum(axis=(0, 1, 2))
    wide_a, wide_b = a.astype(np.float64), b.astype(np.float64)
    inner = (slice(1, -1),) * 3
    gradients = [0.5 * (np.roll(wide_a + wide_b, -1, k) - np.roll(wide_a + wide_b, 1, k)) / 2.0 for k in (2, 1, 0)]
    slopes = [0.25 * (np.roll(wide_b - wide_a, -1, k) - np.roll(wide_b - wide_a, 1, k)) for k in (2, 1, 0)]
    kept = valid.copy()
    for k in range(3):
        kept &= np.roll(valid, 1, k) & np.roll(valid, -1, k)
    q, r = [*gradients, 0.5 * (wide_a + wide_b)], wide_b - wide_a
    pairs = [(q[i], q[j]) for i in range(4) for j in range(i, 4)] + [(one, r) for one in q] + [(s, s) for s in slopes]
    expected = [np.sum((one * other * kept)[inner]) for one, other in pairs]
    assert len(expected) == MOMENTS
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)
