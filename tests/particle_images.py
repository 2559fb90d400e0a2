"""Images of particles whose places are known, and what of them is found: for the tests of searches."""

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.search import Task, task_of
from lfpiv_cli.particles.view import View, raw_view
from lfpiv_cli.reconstruction.solvers import normalisers
from lfpiv_cli.weights.model import Weights


def light_on(view: View, particles: Floats, depths_mm: tuple[float, float]) -> Floats:
    """Return the light (pixels,) of particles (n, 4), of which those between two depths are seen, without noise."""
    image = np.zeros(view.camera.rows * view.camera.columns)
    add_all(view, particles, 1.0, image, depths_mm)
    return image


def task_with(table2: Camera, water: Media, true: Floats, rng: np.random.Generator, noise: float = 6.0) -> Task:
    """Return the task that a noisy image of particles sets; `noise` in counts."""
    camera = replace(table2, columns=500, rows=420)
    grid = Grid.centred((20, 16, 20), (0.1, 0.1, 0.1), (0.0, 0.0, 1.9))
    weights = Weights.factorised(camera, water, grid)
    view, depths = raw_view(camera, water, 0.025), grid.bounds_mm(2)
    image = light_on(view, true, depths)
    image += rng.normal(0.0, noise, image.size)
    shaped = image.reshape(camera.rows, camera.columns).astype(np.float32)
    return task_of(shaped, view, weights, camera, normalisers(weights.padded), None)


def found(particles: Floats, true: Floats) -> Flags:
    """Return which true particles (n, 4) have one within 0.02 mm laterally and 0.1 mm in depth."""
    distance, _ = KDTree(particles[:, :3] / (0.02, 0.02, 0.1)).query(true[:, :3] / (0.02, 0.02, 0.1))
    return np.asarray(distance < 1.0)
