"""Tracks and their grid: flows with a known answer, strays, noise and what the uncertainty promises."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.scale import Scale
from lfpiv_cli.synthetic.flows import taylor_green
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.gridding import on_grid
from lfpiv_cli.tracks.tracking import track

BOX_MM = np.array([4.0, 4.0, 4.0])
# Table 2's camera.
SCALE = Scale(0.1, 1.064)
NOISE_MM = np.array([0.003, 0.003, 0.02])


def moved(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return displacements of a sheared flow that is also turned: up to 0.5 mm, more than the particles' distance."""
    x, y, z = (points - 2.0).T
    return np.stack([0.3 + 0.05 * z, 0.04 * x, -0.1 + 0.03 * y], axis=1)


@pytest.fixture
def frames(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two frames of 500 particles in 64 mm3, a tenth of each frame alone in it; the first 450 belong together."""
    both = rng.uniform(0.0, BOX_MM, (450, 3))
    lone = rng.uniform(0.0, BOX_MM, (2, 50, 3))
    noise = rng.normal(0.0, (0.003, 0.003, 0.02), (2, 450, 3))
    return np.concatenate([both + noise[0], lone[0]]), np.concatenate([both + moved(both) + noise[1], lone[1]])


def test_particles_are_followed_further_than_their_distance(
    frames: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> None:
    tracks = track(*map(Seen, frames), 0.6, SCALE)
    right = (tracks.first == tracks.second) & (tracks.first < 450)
    assert right.sum() > 0.9 * 450
    assert right.mean() > 0.98
    assert np.unique(tracks.second).size == tracks.second.size


def test_frames_without_common_particles_give_few_tracks(rng: np.random.Generator) -> None:
    first, second = (Seen(points) for points in rng.uniform(0.0, BOX_MM, (2, 300, 3)))
    assert len(track(first, second, 0.3, SCALE).first) < 60


def test_no_particles_give_no_track() -> None:
    assert track(Seen(np.zeros((0, 3))), Seen(np.zeros((3, 3))), 0.5, SCALE).first.size == 0
    assert track(Seen(np.zeros((3, 3))), Seen(np.zeros((0, 3))), 0.5, SCALE).first.size == 0


@pytest.mark.thorough
@pytest.mark.parametrize("count", [1, 2, 5, 12, 27])
def test_few_particles_are_followed_among_ghosts(count: int, rng: np.random.Generator) -> None:
    """A fifth as many ghosts, at least one, in each frame; forty pairs of frames for the few."""
    ghosts, right, linked, pairs = -(-count // 5), 0, 0, 40
    for _ in range(pairs):
        both = rng.uniform(0.0, BOX_MM, (count, 3))
        start, end = (each + rng.normal(0.0, NOISE_MM, each.shape) for each in (both, both + moved(both)))
        alone = rng.uniform(0.0, BOX_MM, (2, ghosts, 3))
        frames = np.concatenate([start, alone[0]]), np.concatenate([end, alone[1]])
        links = track(*map(Seen, frames), 0.6, SCALE)
        right += np.count_nonzero((links.first == links.second) & (links.first < count))
        linked += len(links.first)
    # A ghost has another within reach in one frame of forty for each particle there.
    assert right > 0.9 * count * pairs
    assert right > 0.93 * linked


@pytest.mark.parametrize("factor", [10.0, 0.2])
@pytest.mark.parametrize("count", [4, 20, 500])
def test_a_world_of_another_size_has_the_same_links(
    count: int, factor: float, frames: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> None:
    some = slice(max(0, 448 - count), 452)
    first, second = frames[0][some], frames[1][some]
    here = track(Seen(first), Seen(second), 0.6, SCALE)
    there = track(Seen(factor * first), Seen(factor * second), factor * 0.6, Scale(factor * 0.1, factor * 1.064))
    np.testing.assert_array_equal(there.first, here.first)
    np.testing.assert_array_equal(there.second, here.second)
    np.testing.assert_allclose(there.probability, here.probability, atol=1e-9)


def test_grid_takes_a_quadratic_flow_exactly(rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, BOX_MM, (800, 3))
    nodes = rng.uniform(0.5, 3.5, (20, 3))

    def flow(at: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = at.T
        return np.stack([1.0 - x**2 + x * z, 0.3 * y + z**2, x * y - y * z], axis=1)

    value, error = on_grid(points, flow(points), np.full(points.shape, 0.01), nodes, 1.0)
    np.testing.assert_allclose(value, flow(nodes), atol=1e-9)
    assert error.max() < 1e-9


def test_grid_states_its_error_and_ignores_strays(rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, BOX_MM, (1500, 3))
    sigma = np.broadcast_to((0.002, 0.002, 0.02), points.shape)
    values = moved(points) + rng.normal(0.0, sigma)
    values[::25] += rng.uniform(-0.5, 0.5, values[::25].shape)
    nodes = rng.uniform(0.5, 3.5, (200, 3))
    value, error = on_grid(points, values, sigma, nodes, 1.0)
    ratio = (value - moved(nodes)) / error
    # A linear flow: nothing is missed, and what is stated for it is what chance makes of nothing. Neighbouring nodes
    # share tracks, so 200 nodes make some 60 independent ones: 10 %.
    assert np.all(np.sqrt(np.mean(ratio**2, axis=0)) < 1.2)
    assert np.all(np.sqrt(np.mean(ratio**2, axis=0)) > 0.55)
    # As well as the sixty tracks of the widest line, and not the ten unknowns of a parabola, let it.
    assert np.all(np.median(np.abs(value - moved(nodes)), axis=0) < 0.25 * sigma[0])


@pytest.mark.thorough
@pytest.mark.parametrize(("wavelength_mm", "tracks"), [(4.0, 1500), (8.0, 300), (2.5, 1500)])
def test_errors_are_stated_whatever_the_density_and_the_flow(
    wavelength_mm: float, tracks: int, rng: np.random.Generator
) -> None:
    """Vortices seen by many tracks and by few: a component that is all noise, and two that bend."""
    flow = taylor_green(0.1, wavelength_mm, (2.0, 2.0, 2.0), "xy")
    points = rng.uniform(0.0, BOX_MM, (tracks, 3))
    sigma = np.full(points.shape, 0.001)
    nodes = np.stack(np.meshgrid(*[np.linspace(0.4, 3.6, 7)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    value, error = on_grid(points, 2.0 * flow(points) + rng.normal(0.0, sigma), sigma, nodes, 4.0)
    covered = np.mean(np.abs(value - 2.0 * flow(nodes)) < 1.96 * error, axis=0)
    # One fit for all, a parabola through 45, covers about .82 of x and y, and has nearly twice the noise in z.
    assert np.all(covered > 0.88)
    assert np.sqrt(np.mean(value[:, 2] ** 2)) < 0.5 * sigma[0, 2]


def test_a_node_without_tracks_has_no_vector(rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, 1.0, (100, 3))
    value, error = on_grid(points, moved(points), np.full(points.shape, 0.01), np.array([[0.5] * 3, [3.0] * 3]), 0.8)
    assert np.isfinite(value[0]).all()
    assert np.isnan(value[1]).all()
    assert np.isnan(error[1]).all()
