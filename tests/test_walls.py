"""Walls from particles that were put between known ones."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.self_calibration.nuisances import Nuisances
from lfpiv_cli.self_calibration.refinement import Refinement
from lfpiv_cli.self_calibration.walls import Walls, find_walls

WIDTH, MIDDLE, SLOPE = 8.0, -0.37, np.array([0.02, -0.013])
SEARCHED = (-6.0, 6.0)


def between_walls(count: int, rng: np.random.Generator, blur: float = 0.02, strays: int = 0) -> np.ndarray:
    """Particles (n, 3) denser at the far wall, seen with errors in depth, and strays anywhere in what is searched."""
    lateral = rng.uniform((-6.0, -4.0), (6.0, 4.0), (count, 2))
    t = rng.uniform(-1.0, 1.0, 4 * count)
    t = t[rng.random(4 * count) < (1.0 + 0.2 * t) / 1.3][:count]
    depth = MIDDLE + 0.5 * WIDTH * t + lateral @ SLOPE + rng.normal(0.0, blur, count)
    found = np.column_stack([lateral, depth])
    found[:strays, 2] = rng.uniform(*SEARCHED, strays)
    return found


def walls_of(position: np.ndarray, **options: int) -> Walls:
    return find_walls(position, np.full(len(position), 0.005), SEARCHED, WIDTH, **options)


@pytest.mark.thorough
@pytest.mark.parametrize(("count", "largest_sigma"), [(300, 0.2), (3000, 0.02)])
def test_walls_are_found_within_their_errors(count: int, largest_sigma: float, rng: np.random.Generator) -> None:
    walls = walls_of(between_walls(count, rng, strays=count // 50))
    assert walls.middle_sigma_mm < largest_sigma
    assert abs(walls.middle_mm - MIDDLE) < 3 * walls.middle_sigma_mm
    assert abs(walls.width_mm - WIDTH) < 3 * walls.width_sigma_mm
    assert np.all(np.abs(walls.slope - SLOPE) < 3 * walls.slope_sigma)
    assert walls.stray_share < 0.05


@pytest.mark.thorough
def test_standard_errors_are_what_repetitions_scatter_by(rng: np.random.Generator) -> None:
    found = [walls_of(between_walls(1000, rng)) for _ in range(12)]
    off = [(walls.middle_mm - MIDDLE) / walls.middle_sigma_mm for walls in found]
    tilted = [(walls.slope - SLOPE) / walls.slope_sigma for walls in found]
    # Twelve values tell a standard deviation to a fifth; errors may be stated too large by half, not too small.
    assert 0.2 < np.std(off) < 1.4
    assert 0.2 < np.std(tilted) < 1.4


@pytest.mark.thorough
def test_the_same_particles_again_tell_no_more(rng: np.random.Generator) -> None:
    once = between_walls(1500, rng)
    twice = np.concatenate([once, once + (0.1, 0.05, 0.0)])
    assert walls_of(twice, frames=2).middle_sigma_mm > 0.8 * walls_of(once).middle_sigma_mm


def test_what_is_not_the_channel_is_refused(rng: np.random.Generator) -> None:
    seeded = between_walls(500, rng)
    with pytest.raises(InputError, match="only 90 particles"):
        walls_of(seeded[:90])
    with pytest.raises(InputError, match="is the whole depth seeded"):
        walls_of(seeded[seeded[:, 2] < 2.0])
    with pytest.raises(InputError, match="where the search ended"):
        find_walls(seeded, np.full(500, 0.005), (-6.0, 3.6), WIDTH)


def test_the_picture_shows_all_particles_and_both_walls(rng: np.random.Generator) -> None:
    pytest.importorskip("matplotlib")
    from lfpiv_cli.pictures.calibration import walls_figure

    position = between_walls(300, rng)
    walls = walls_of(position)
    camera = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1, "square"), 0.0055, 100, 100)
    refined = Refinement(walls, Nuisances(), Nuisances(), position, SEARCHED, 2, 0.0, None, 0.01, WIDTH, 0.05, camera)
    whole, across, near, far = walls_figure(refined).axes
    assert whole.get_title() == "300 particles in 2 images"
    assert sum(bar.get_height() for bar in whole.patches) == 300
    for axes, side in ((near, -1.0), (far, 1.0)):
        assert f"z = {walls.middle_mm + side * 0.5 * walls.width_mm:.3f} mm" in axes.get_title()
        assert axes.get_xlim()[0] < side * 0.5 * walls.width_mm < axes.get_xlim()[1]
    np.testing.assert_array_equal(across.lines[0].get_ydata(), position[:, 2])
