"""Weighted windows: their sums written out, a flow of one displacement, and how much less of a curved one they lose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.volumes import Seeding, volume_pair
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.config import load_config
from lfpiv_cli.flow.correlation import Coarse, correlate, plan
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.moments import gauss_newton, pair_moments
from lfpiv_cli.flow.sums import map_sums, margins
from lfpiv_cli.flow.windows import WEIGHTINGS, CorrelationSettings, WindowLayout, cells_of, layout_windows
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import Weighting, names_in
from lfpiv_cli.verbs.correlate import CorrelateOptions

HALF = (0.5, 0.5, 0.5)
TABLE2 = Path(__file__).parents[1] / "configs" / "table2.yaml"
# An odd size, shared and unshared cells, windows that overhang and leave gaps.
LAYOUTS = [((8, 7, 6), HALF), ((8, 8, 8), HALF), ((9, 6, 4), (0.75, 0.0, 0.5))]


def layout_of(size: tuple[int, int, int], overlap: tuple[float, float, float]) -> WindowLayout:
    return replace(layout_windows((22, 20, 18), size, overlap), weighting="gaussian")


def weights_in(layout: WindowLayout) -> NDArray[np.float64]:
    """The weights [z, y, x] of a window's voxels, by the definition: a Gaussian of a quarter of the size."""
    axes = [(np.arange(n) - 0.5 * (n - 1)) / n for n in layout.size[::-1]]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    return np.exp(-0.5 * (x**2 + y**2 + z**2) / 0.25**2)


def window(volume: NDArray, layout: WindowLayout, index: tuple[int, ...], begin: tuple[int, ...]) -> NDArray:
    """The voxels of a window in a volume whose first voxel has the index `begin` less."""
    places = zip(layout.first[::-1], layout.step[::-1], layout.size[::-1], index, begin, strict=True)
    return volume[tuple(slice(f + k * s + b, f + k * s + b + n) for f, s, n, k, b in places)].astype(np.float64)


def test_the_registry_has_the_names_that_the_configuration_takes() -> None:
    assert tuple(WEIGHTINGS) == names_in(Weighting)
    with pytest.raises(ConfigError, match="weighting of the windows is round"):
        CorrelationSettings([(8, 8, 8)], HALF, weighting="round").layout((16, 16, 16))


def test_config_and_option_choose_the_weighting() -> None:
    config, voxel_mm = load_config(TABLE2), (0.1, 0.1, 0.1)
    assert config.correlation_settings(voxel_mm).weighting == "uniform"
    chosen = config.overridden_by("correlation", CorrelateOptions(weighting="gaussian")).correlation_settings(voxel_mm)
    assert {step.layout.weighting for step in plan((100, 100, 100), chosen)} == {"gaussian"}
    assert Coarse.over((100, 100, 100), chosen).layout.weighting == "gaussian"


@pytest.mark.parametrize(("size", "overlap"), LAYOUTS)
def test_maps_are_the_weighted_correlation(
    size: tuple[int, int, int], overlap: tuple[float, float, float], rng: np.random.Generator
) -> None:
    layout, radius = layout_of(size, overlap), 1
    a, b = rng.random((2, 18, 20, 22)).astype(np.float32)
    before, after = margins(layout, a.shape, radius)
    padded_a, padded_b = (np.pad(volume, list(zip(before, after, strict=True))) for volume in (a, b))
    maps = map_sums(padded_a, padded_b, layout, before, radius).correlation()
    weights = weights_in(layout)
    for index in [(0, 0, 0), (1, 1, 0), tuple(n - 1 for n in layout.count[::-1])]:
        for shift in np.ndindex(3, 3, 3):
            there, back = (
                tuple(m + sign * (s - radius) for m, s in zip(before, shift, strict=True)) for sign in (1, -1)
            )
            still_a, still_b = (window(volume, layout, index, before) for volume in (padded_a, padded_b))
            moved_a, moved_b = window(padded_a, layout, index, back), window(padded_b, layout, index, there)
            products = np.sum(weights * (still_a * moved_b + moved_a * still_b))
            energies = [
                np.sum(weights * (still**2 + moved**2)) for still, moved in ((still_a, moved_a), (still_b, moved_b))
            ]
            assert maps[index][shift] == pytest.approx(products / np.sqrt(np.prod(energies)), rel=1e-5)


@pytest.mark.parametrize(("size", "overlap"), LAYOUTS)
def test_moments_are_weighted_sums_of_those_of_single_voxels(
    size: tuple[int, int, int], overlap: tuple[float, float, float], rng: np.random.Generator
) -> None:
    layout, single = layout_of(size, overlap), layout_windows((22, 20, 18), (1, 1, 1), (0.0, 0.0, 0.0))
    a, b = rng.random((2, 18, 20, 22)).astype(np.float32)
    valid = (rng.random(a.shape) < 0.97).astype(np.uint8)
    before, after = margins(layout, a.shape, 1)
    padded = [np.pad(volume, list(zip(before, after, strict=True))) for volume in (a, b, valid)]
    found, cells = pair_moments(*padded, layout, before), cells_of(layout)
    margin = [(m, n) for m, n in zip(before, after, strict=True)]
    of_voxels = np.pad(pair_moments(*padded, single, before), [*margin, (0, 0)])
    parts, weights = cells.per_window, weights_in(layout)[..., np.newaxis]
    for index in np.ndindex(2, 2, 2):
        own = found[tuple(slice(k * n, (k + 1) * n) for k, n in zip(index, parts, strict=True))]
        expected = np.sum(weights * window(of_voxels, layout, index, before), axis=(0, 1, 2))
        np.testing.assert_allclose(own.sum(axis=(0, 1, 2)), expected, rtol=1e-4, atol=1e-5)


def test_a_weighted_step_is_the_weighted_least_squares_solution(rng: np.random.Generator) -> None:
    a, b = volume_pair(
        lambda points: np.tile((0.1, -0.2, 0.3), (len(points), 1)), (32, 40, 36), Seeding(12.0, (1.2, 1.2, 2.0)), rng
    )
    layout = replace(layout_windows((32, 40, 36), (16, 16, 16), HALF), weighting="gaussian")
    before, after = margins(layout, a.shape, 1)
    padded = (np.pad(each, list(zip(before, after, strict=True))) for each in (a, b, np.ones(a.shape, np.uint8)))
    found = gauss_newton(pair_moments(*padded, layout, before), layout, np.ones(3))[0]
    mean, inside = 0.5 * (a.astype(float) + b), (0, 0, 0)
    basis = [window(g, layout, (1, 1, 1), inside).ravel() for g in [*np.gradient(mean)[::-1], mean]]
    root = np.sqrt(weights_in(layout)).ravel()
    right = root * window(b.astype(float) - a, layout, (1, 1, 1), inside).ravel()
    expected = -np.linalg.lstsq(root[:, np.newaxis] * np.stack(basis, axis=1), right, rcond=None)[0][:3]
    np.testing.assert_allclose(found[1, 1, 1], expected, atol=1e-4)


def measured(flow, weighting: str, rng: np.random.Generator, noise: float = 0.0) -> VectorField:
    """Vectors in a cube of 48 voxels, windows of 16."""
    a, b = volume_pair(flow, (48, 48, 48), Seeding(12.0, (1.0, 1.0, 1.0), noise), rng)
    grid = Grid((48, 48, 48), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    return correlate([(a, b)], grid, CorrelationSettings([(16, 16, 16)], HALF, weighting=weighting))


@pytest.mark.thorough
def test_one_displacement_is_found_without_bias_and_its_errors_are_stated(rng: np.random.Generator) -> None:
    shift = np.array((1.3, -0.6, 0.4))
    field = measured(lambda points: np.tile(shift, (len(points), 1)), "gaussian", rng, noise=0.1)
    inner = (slice(1, -1),) * 3
    error = (field.displacement_voxel - shift)[inner]
    assert field.uncertainty_voxel is not None
    stated = field.uncertainty_voxel[inner]
    # 64 windows, each voxel of which counts in eight of them.
    assert np.all(np.abs(error.mean(axis=(0, 1, 2))) < 4.0 * np.sqrt(np.mean(error**2, axis=(0, 1, 2)) / 8.0))
    ratio = np.sqrt(np.mean(error**2, axis=(0, 1, 2)) / np.mean(stated**2, axis=(0, 1, 2)))
    assert np.all((ratio > 0.4) & (ratio < 1.5))


@pytest.mark.thorough
def test_a_curved_shear_loses_less_than_in_uniform_windows(rng: np.random.Generator) -> None:
    def wave(points: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = np.zeros(points.shape)
        moved[:, 0] = 0.8 * np.sin(2.0 * np.pi * points[:, 1] / 32.0)
        return moved

    kept = []
    for weighting in names_in(Weighting):
        field = measured(wave, weighting, np.random.default_rng(5))
        centres = field.grid.centres_mm()
        truth = wave(centres.reshape(-1, 3)).reshape(centres.shape)[1:-1, 1:-1, 1:-1, 0]
        found = field.displacement_raw_voxel[1:-1, 1:-1, 1:-1, 0]
        kept.append(np.sum(found * truth) / np.sum(truth**2))
    uniform, gaussian = kept
    assert uniform < gaussian < 1.02
    assert 1.0 - gaussian < 0.8 * (1.0 - uniform)
