"""Vectors on the grid of the interrogation windows from tracks: where there are none, there is no vector."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.flow.combining import Paths, WindowGrid, vectors_from_paths
from lfpiv_cli.flow.field import REJECTED, VALID
from lfpiv_cli.grid import Grid

VOLUME = Grid.centred((40, 30, 20), (0.1, 0.1, 0.2), (0.0, 0.0, 0.0))
WINDOWS = WindowGrid(VOLUME, (8, 8, 4), (0.5, 0.5, 0.5))


def paths_in(count: int, share: float, rng: np.random.Generator) -> Paths:
    """Tracks in a share of the volume's width, from its lower end on."""
    low, high = np.array([VOLUME.bounds_mm(axis) for axis in range(3)]).T
    high[0] = low[0] + share * (high[0] - low[0])
    points = rng.uniform(low, high, (count, 3))
    return Paths(points, np.tile((0.05, 0.0, 0.0), (count, 1)), np.full((count, 3), 0.002))


@pytest.mark.thorough
@pytest.mark.parametrize("count", [200, 1000])
def test_a_region_without_tracks_has_no_vectors(count: int, rng: np.random.Generator) -> None:
    field = vectors_from_paths(paths_in(count, 0.6, rng), WINDOWS, None)
    low, high = VOLUME.bounds_mm(0)
    away = field.grid.axis_mm(0) - (low + 0.6 * (high - low))
    # Nearer than the tracks are to each other nobody can tell.
    assert np.all(field.flag[:, :, away > (0.5 if count == 1000 else 0.9)] == REJECTED)
    assert np.isnan(field.displacement_voxel[field.flag == REJECTED]).all()
    assert np.all(field.flag[:, :, away < 0.0] == VALID)


@pytest.mark.parametrize("count", [80, 300, 3000])
def test_even_seeding_has_no_empty_regions(count: int, rng: np.random.Generator) -> None:
    # Where tracks are few the fit's reach may leave gaps of its own.
    wide = WindowGrid(VOLUME, (16, 16, 8), (0.5, 0.5, 0.5))
    field = vectors_from_paths(paths_in(count, 1.0, rng), wide, None)
    assert np.all(field.flag == VALID)
