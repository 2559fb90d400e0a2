"""Fields kriged as vectors: what must come out exactly, the stated errors, sources and outliers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.fields.fit import KrigedField, is_rough, kriged_field
from lfpiv_cli.fields.structure import INDEPENDENT, Samples, VectorStructure, estimated, unknown_variance

BOX_MM = np.array([6.0, 5.0, 5.0])
LATERAL_MM, DEPTH_MM = 0.001, 0.015


def turbulence(points: NDArray[np.float64], seed: int = 3, potential: bool = False) -> NDArray[np.float64]:
    """Return displacements (n, 3) by random waves, across their directions or along them."""
    rng = np.random.default_rng(seed)
    wave = 2.0 * np.pi / np.exp(rng.uniform(np.log(0.7), np.log(20.0), 60))
    direction = rng.normal(size=(60, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.cross(direction, rng.normal(size=(60, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    amplitude = 0.05 * wave[:, np.newaxis] ** (-1.0 / 3.0) * (direction if potential else across)
    return np.asarray(np.cos(points @ (wave[:, np.newaxis] * direction).T + rng.uniform(0, 6, 60)) @ amplitude)


def samples_of(points: NDArray[np.float64], value: NDArray[np.float64], seed: int = 1) -> Samples:
    """Return samples with errors that are ten times as large in depth as laterally."""
    sigma = np.array([LATERAL_MM, LATERAL_MM, DEPTH_MM])
    noise = np.random.default_rng(seed).normal(size=points.shape) * sigma
    covariance = np.broadcast_to(np.diag(sigma**2), (len(points), 3, 3))
    return Samples(points, value + noise, covariance, np.full(len(points), 0.98))


def places(count: int, seed: int = 0) -> NDArray[np.float64]:
    return (np.random.default_rng(seed).random((count, 3)) - 0.5) * BOX_MM


def structure(potential_share: float) -> VectorStructure:
    return VectorStructure(0.03, 1.0, 0.4, 5.0, 1e-7, 1.0, potential_share)


@pytest.fixture
def field() -> KrigedField:
    """Return a field without divergence of 100 tracks."""
    points = places(100)
    return KrigedField(samples_of(points, turbulence(points)), structure(0.0), np.ones((100, 3)), 0)


@pytest.mark.parametrize("share", [0.0, INDEPENDENT, 1.0])
def test_structure_of_solenoidal_and_potential_parts(share: float) -> None:
    """Incompressibility: D_NN = D_LL + (r/2) dD_LL/dr; without rotation D_LL = D_NN + r dD_NN/dr; or both alike."""
    r, step = 0.7, 1e-5

    def longitudinal_and_transverse(distance: float) -> NDArray[np.float64]:
        level, along = structure(share).parts(np.array(distance**2))
        return np.array([level + along * distance**2, level])

    here = longitudinal_and_transverse(r)
    slope = (longitudinal_and_transverse(r + step) - longitudinal_and_transverse(r - step)) / (2.0 * step)
    if share == 0.0:
        assert here[1] == pytest.approx(here[0] + 0.5 * r * slope[0], rel=1e-8)
    elif share == 1.0:
        assert here[0] == pytest.approx(here[1] + r * slope[1], rel=1e-8)
    else:
        assert here[0] == pytest.approx(here[1], rel=1e-12)


def test_slopes_of_the_structure_are_its_derivatives() -> None:
    square, step = np.array([0.1, 1.0, 30.0]), 1e-6
    model = structure(0.2)
    above, below = model.parts(square + step), model.parts(square - step)
    for found, high, low in zip(model.slopes(square), above, below, strict=True):
        np.testing.assert_allclose(found, (high - low) / (2.0 * step), rtol=1e-6, atol=1e-12)


def test_constant_is_kept(field: KrigedField) -> None:
    """Whatever is added to all samples is added to all estimates."""
    moved = Samples(
        field.samples.points_mm,
        field.samples.value_mm + [7.0, -3.0, 1.0],
        field.samples.covariance_mm2,
        field.samples.probability,
    )
    other = KrigedField(moved, field.structure, field.off_by, field.kept)
    at = places(5, seed=9)
    np.testing.assert_allclose(other.value_at(at), field.value_at(at) + [7.0, -3.0, 1.0], atol=1e-9)


def test_divergence_is_zero(field: KrigedField) -> None:
    gradient = field.gradient_at(places(20, seed=9))
    assert np.abs(np.einsum("mii->m", gradient)).max() < 1e-10 * np.abs(gradient).max()


def test_gradient_is_that_of_the_estimate_with_its_samples_held() -> None:
    """Also of a flow with sources, and off the middle of the neighbourhood."""
    points = places(30)
    samples = samples_of(points, turbulence(points))
    found = KrigedField(samples, structure(0.2), np.ones((30, 3)), 0)
    at, near, step = places(2, seed=9), np.tile(np.arange(30), (2, 1)), 1e-4
    unknown = unknown_variance(samples)

    def moved(by: NDArray[np.float64]) -> NDArray[np.float64]:
        return estimated(at + by, near, samples, found.structure, unknown)[0]

    expected = np.stack([(moved(step * axis) - moved(-step * axis)) / (2.0 * step) for axis in np.eye(3)], axis=2)
    gradient = found.gradient_at(at)
    np.testing.assert_allclose(gradient, expected, atol=1e-6 * np.abs(gradient).max())


def test_variance_is_that_of_many_flows() -> None:
    """Displacements drawn with the model's own covariances are missed by as much as the equations say."""
    rng = np.random.default_rng(5)
    points, at = places(25), places(1, seed=9)
    model = VectorStructure(0.03, 1.0, 0.4, 1.0, 1e-6, 2.0, 0.0)
    everywhere = np.concatenate([points, at])
    offset = everywhere[:, np.newaxis] - everywhere
    level, along = model.parts(np.sum(offset**2, axis=2))
    half = 0.5 * (
        level[..., np.newaxis, np.newaxis] * np.eye(3)
        + along[..., np.newaxis, np.newaxis] * (offset[..., :, np.newaxis] * offset[..., np.newaxis, :])
    )
    # at infinity the structure function is twice the variance
    covariance = (0.5 * 0.03 * 0.4 * 1.0 * np.eye(3) - half).transpose(0, 2, 1, 3).reshape(78, 78)
    drawn = (np.linalg.cholesky(covariance + 1e-12 * np.eye(78)) @ rng.normal(size=(78, 3000))).T.reshape(3000, 26, 3)
    error = np.array([LATERAL_MM, LATERAL_MM, DEPTH_MM])
    noisy = drawn[:, :25] + rng.normal(size=(3000, 25, 3)) * np.sqrt(2.0 * error**2 + 1e-6)
    stated = np.broadcast_to(np.diag(error**2), (75000, 3, 3))
    samples = Samples(np.tile(points, (3000, 1)), noisy.reshape(-1, 3), stated, np.ones(75000))
    value, covariance = estimated(np.tile(at, (3000, 1)), np.arange(75000).reshape(3000, 25), samples, model, 1.0)
    missed = value - drawn[:, 25]
    # the variance of 3,000 draws is known to 2.6 %
    np.testing.assert_allclose(np.cov(missed.T, bias=True).diagonal(), covariance[0].diagonal(), rtol=0.1)


@pytest.mark.thorough
def test_errors_are_as_stated_where_the_samples_understate_theirs() -> None:
    points, at = places(800), places(300, seed=9)
    honest = samples_of(points, turbulence(points))
    samples = Samples(points, honest.value_mm, honest.covariance_mm2 / 1.5**2, honest.probability)
    value, covariance = kriged_field(samples, "free").estimates_at(at)
    sigma = np.sqrt(np.einsum("mii->mi", covariance))
    inside = np.mean(np.abs(value - turbulence(at)) < 1.96 * sigma)
    assert 0.9 <= inside <= 0.98


@pytest.mark.thorough
def test_sources_are_found_where_there_are_some() -> None:
    points = places(400)
    shares = [
        kriged_field(samples_of(points, value), "penalised").structure.potential_share
        for value in (turbulence(points), turbulence(points) + turbulence(points, potential=True))
    ]
    assert shares[0] == 0.0
    assert shares[1] >= 0.1


@pytest.mark.thorough
def test_choices_of_divergence() -> None:
    points = places(80)
    samples = samples_of(points, turbulence(points))
    assert kriged_field(samples, "off").structure.potential_share == INDEPENDENT
    assert kriged_field(samples, "free").told()["potential_share"] == 0.0


@pytest.mark.thorough
def test_outliers_are_dropped() -> None:
    points = places(300)
    honest = samples_of(points, turbulence(points))
    value = honest.value_mm.copy()
    value[:9] += np.random.default_rng(4).normal(size=(9, 3)) * 0.4
    found = kriged_field(Samples(points, value, honest.covariance_mm2, honest.probability), "free")
    kept = np.isin(points[:, 0], found.samples.points_mm[:, 0])
    assert not kept[:9].any()
    assert np.mean(kept[9:]) > 0.98


@pytest.mark.thorough
def test_rough_is_turbulence_and_not_a_smooth_flow() -> None:
    points = places(400)
    smooth = 0.2 * np.stack([np.sin(points[:, 2]), np.cos(points[:, 0]), np.sin(points[:, 1])], axis=1)
    assert is_rough(samples_of(points, turbulence(points)))
    assert not is_rough(samples_of(points, smooth))


@pytest.mark.parametrize("count", [2, 10])
def test_few_samples_without_stated_errors_that_are_all_alike(count: int) -> None:
    points = places(count)
    samples = Samples(points, np.ones((count, 3)), np.zeros((count, 3, 3)), np.ones(count))
    np.testing.assert_allclose(kriged_field(samples, "penalised").value_at(places(2, seed=9)), 1.0, atol=1e-6)
    assert not is_rough(samples)


def test_two_samples_at_one_place_without_errors() -> None:
    points = places(20)
    points[1] = points[0]
    model = VectorStructure(0.03, 1.0, 0.4, 5.0, 0.0, 1.0, 0.0)
    samples = Samples(points, turbulence(points), np.zeros((20, 3, 3)), np.ones(20))
    found = KrigedField(samples, model, np.ones((20, 3)), 0)
    np.testing.assert_allclose(found.value_at(points[:2]), samples.value_mm[:2], atol=1e-6)
