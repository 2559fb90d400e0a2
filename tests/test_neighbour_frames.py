"""A second pass: what a neighbour frame found is found here too, and its ghosts are not."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.neighbour_frames import second_pass
from tests.particle_images import found, task_with

MOVED_MM = np.array([0.12, -0.05, 0.04, 0.0])


@pytest.mark.thorough
def test_what_a_neighbour_found_is_found(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    true = rng.uniform((-1.0, -0.8, 1.0, 4e5), (1.0, 0.8, 2.8, 6e5), (45, 4))
    # One beside an overlapping one that splitting may not have separated: what it explains is not free.
    true[1] = true[0] + (0.03, -0.02, 0.2, 0.0)
    task = task_with(table2, water, true, rng)
    own = true[3:].copy()
    own = np.concatenate([own, [[*(0.5 * (true[0] + true[1]))[:3], true[0, 3] + true[1, 3]]]])
    ghosts = rng.uniform((-0.9, -0.7, 1.2, 4e5), (0.9, 0.7, 2.6, 6e5), (3, 4))
    before = np.concatenate([true, ghosts]) - MOVED_MM
    alone = second_pass(task, own, [], 0.6).particles
    assert not found(alone, true)[2]
    beside = second_pass(task, own, [before], 0.6).particles
    assert found(beside, true).all()
    assert len(beside) == len(true)
    # Two neighbours that know the same name it once.
    both = second_pass(task, own, [before, np.concatenate([true, ghosts]) + MOVED_MM], 0.6).particles
    assert found(both, true).all()
    assert len(both) == len(true)
