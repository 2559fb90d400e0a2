"""Validation: it finds what is wrong and leaves alone what is right."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, SECOND_PEAK, VALID
from lfpiv_cli.flow.outliers import EXPECTED_NOISE_VOXEL, expected_noise, fill_field, predict, validate_vectors

SHAPE = (12, 16, 12)
NOISE = np.full(3, EXPECTED_NOISE_VOXEL)


def indices() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in SHAPE), indexing="ij")
    return x, y, z


def linear_field() -> NDArray[np.float64]:
    x, y, z = indices()
    return np.stack([0.7 * y - 0.3 * z, 0.5 * x, 0.2 * x - 0.4 * y + 0.1 * z], axis=-1)


def channel_field() -> NDArray[np.float64]:
    """The parabola of the paper's channel: 4 voxels at its middle, nothing at the walls; flow along y."""
    x, _, z = indices()
    profile = 4.0 * (1.0 - ((x - 5.5) / 6.0) ** 2) * (1.0 - ((z - 5.5) / 6.0) ** 2)
    return np.stack([np.zeros(SHAPE), profile, np.zeros(SHAPE)], axis=-1)


def check(
    raw: NDArray[np.float64], second: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Validate a field whose NaN are windows without a peak."""
    measured = np.isfinite(raw).all(axis=-1)
    nowhere = np.zeros(raw.shape[:3], dtype=np.bool_)
    return validate_vectors(raw, np.full(raw.shape, np.nan) if second is None else second, measured, nowhere, NOISE)


@pytest.mark.parametrize("field", [linear_field(), channel_field()], ids=["linear", "channel"])
def test_clean_shear_raises_no_false_alarm(field: NDArray[np.float64], rng: np.random.Generator) -> None:
    noisy = field + rng.normal(0.0, 0.06, field.shape)
    displacement, flag = check(noisy)
    assert np.all(flag == VALID)
    np.testing.assert_array_equal(displacement, noisy)


@pytest.mark.parametrize("component", [0, 1, 2])
def test_scattered_outliers_are_found_and_replaced(component: int, rng: np.random.Generator) -> None:
    truth = channel_field()
    wrong = rng.random(SHAPE) < 0.05
    raw = truth + rng.normal(0.0, 0.02, truth.shape)
    raw[wrong, component] += 2.0
    displacement, flag = check(raw)
    np.testing.assert_array_equal(flag == REPLACED, wrong)
    # The neighbours' parabola bends by up to 0.2 voxel between two windows.
    assert np.max(np.abs(displacement - truth)) < 0.3


def test_replacement_is_exact_in_a_linear_flow_also_at_corners() -> None:
    truth = linear_field()
    raw = truth.copy()
    for place in ((0, 0, 0), (11, 15, 11), (0, 7, 5), (6, 0, 11), (5, 5, 5)):
        raw[place] += (3.0, -2.0, 5.0)
    displacement, flag = check(raw)
    assert np.sum(flag == REPLACED) == 5
    np.testing.assert_allclose(displacement, truth, atol=1e-12)


def test_second_peak_is_taken_where_it_fits() -> None:
    truth = linear_field()
    raw, second = truth.copy(), np.full(truth.shape, np.nan)
    raw[4, 4, 4] += 3.0
    second[4, 4, 4] = truth[4, 4, 4] + 0.05
    raw[8, 8, 8] += 3.0
    second[8, 8, 8] = truth[8, 8, 8] - 3.0
    displacement, flag = check(raw, second)
    assert flag[4, 4, 4] == SECOND_PEAK
    np.testing.assert_array_equal(displacement[4, 4, 4], second[4, 4, 4])
    assert flag[8, 8, 8] == REPLACED


def test_windows_without_peak_are_rejected() -> None:
    raw = linear_field()
    raw[3, 3, 3] = np.nan
    raw[:, :, 8:] = np.nan
    displacement, flag = check(raw)
    np.testing.assert_array_equal(flag == REJECTED, np.isnan(raw).any(axis=-1))
    np.testing.assert_array_equal(np.isnan(displacement).any(axis=-1), flag >= REJECTED)


def test_masked_vectors_neither_count_nor_judge() -> None:
    truth = linear_field()
    raw = truth.copy()
    masked = np.zeros(SHAPE, dtype=np.bool_)
    masked[:, :, 6:] = True
    raw[masked] = 50.0
    raw[5, 5, 5] += 2.0
    everywhere = np.ones(SHAPE, dtype=np.bool_)
    displacement, flag = validate_vectors(raw, np.full(raw.shape, np.nan), everywhere, masked, NOISE)
    assert np.all(flag[masked] == MASKED)
    assert flag[5, 5, 5] == REPLACED
    np.testing.assert_allclose(displacement[5, 5, 5], truth[5, 5, 5], atol=1e-12)
    assert np.all(flag[~masked] <= REPLACED)
    assert np.sum(flag[~masked] == REPLACED) == 1


def test_expected_noise_follows_the_peak_s_width() -> None:
    width = np.full((2, 2, 2, 3), np.sqrt(2.0)) * (0.8, 1.0, 8.0)
    width[0, 0, 0] = np.nan
    np.testing.assert_allclose(expected_noise(width), EXPECTED_NOISE_VOXEL * np.array([1.0, 1.0, 8.0]))
    np.testing.assert_allclose(expected_noise(np.full((1, 1, 1, 3), np.nan)), EXPECTED_NOISE_VOXEL)


def test_prediction_is_the_median_of_neighbours_carried_by_median_slopes(rng: np.random.Generator) -> None:
    field = rng.standard_normal((4, 5, 4, 3))
    counted = rng.random(field.shape[:3]) < 0.9
    usable = counted & (rng.random(field.shape[:3]) < 0.7)
    told = predict(field, usable, counted, np.arange(usable.size))
    known = np.pad(np.where(usable[..., np.newaxis], field, np.nan), [(1, 1)] * 3 + [(0, 0)], constant_values=np.nan)
    places = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1)
    for number, (z, y, x) in enumerate(np.ndindex(usable.shape)):
        cube = known[z : z + 3, y : y + 3, x : x + 3].copy()
        cube[1, 1, 1] = np.nan
        seen = np.pad(counted, 1)[z : z + 3, y : y + 3, x : x + 3].copy()
        seen[1, 1, 1] = False
        slopes = []
        for axis in range(3):
            first, middle, last = np.moveaxis(cube, axis, 0)
            pairs = np.stack([middle - first, last - middle, 0.5 * (last - first)]).reshape(-1, 3)
            slopes.append([np.median(s[np.isfinite(s)]) if np.isfinite(s).any() else 0.0 for s in pairs.T])
        carried = (cube - places @ np.array(slopes))[np.isfinite(cube[..., 0])]
        assert len(carried) > 0
        middle = np.median(carried, axis=0)
        np.testing.assert_allclose(told[0][number], middle, atol=1e-12)
        np.testing.assert_allclose(told[1][number], np.median(np.abs(carried - middle), axis=0), atol=1e-12)
        assert told[2][number] == pytest.approx(len(carried) / seen.sum())


def test_filling_continues_a_linear_flow() -> None:
    truth = linear_field()
    holed = truth.copy()
    holed[4:7, 4:7, 4:7] = np.nan
    np.testing.assert_allclose(fill_field(holed), truth, atol=1e-9)


def test_filling_nothing_gives_zero() -> None:
    assert np.all(fill_field(np.full((3, 3, 3, 3), np.nan)) == 0.0)
