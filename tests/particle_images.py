"""Images of particles whose places are known, and what of them is found: for the tests of searches."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.least_squares import lit_by, respond_all, room_for
from lfpiv_cli.particles.search import Task, task_of
from lfpiv_cli.particles.view import View, entry_capacity, raw_view
from lfpiv_cli.reconstruction.solvers import normalisers
from lfpiv_cli.weights.build import default_padding, factorise, factorise_bricks
from lfpiv_cli.weights.model import Weights


def light_on(view: View, particles: Floats, depths_mm: tuple[float, float]) -> Floats:
    """Return the light (pixels,) of particles (n, 4), of which those between two depths are seen, without noise."""
    image = np.zeros(view.camera.rows * view.camera.columns)
    add_all(view, particles, 1.0, image, depths_mm)
    return image


def seen_by(camera: Camera, media: Media, particles: Floats, depths_mm: tuple[float, float]) -> Floats:
    """Return the light (pixels,) that a camera sees of particles 0.05 mm wide, without noise."""
    return light_on(raw_view(camera, media, 0.025), particles, depths_mm)


def task_for(image: Floats, camera: Camera, media: Media, grid: Grid, radius_mm: float = 0.025, **known: Any) -> Task:
    """Return the task that an image sets, with weights of either layout that are padded as far as light spreads."""
    padding = default_padding(camera, media, grid)
    factorised = factorise if camera.lattice.layout == "square" else factorise_bricks
    weights = Weights(grid, padding, factorised(camera, media, grid.padded(padding)), camera.column_axis)
    shaped = image.reshape(camera.rows, camera.columns).astype(np.float32)
    view = raw_view(camera, media, radius_mm, light=known.pop("light", None))
    sums = normalisers(weights.padded, known.get("excluded"))
    return task_of(shaped, view, weights, camera, sums, **known)


def task_with(
    table2: Camera, water: Media, true: Floats, rng: np.random.Generator, noise: float = 6.0, gain: float = 0.0
) -> Task:
    """Return the task that a noisy image of particles sets; `noise` in counts, `gain` in counts a photon's charge."""
    camera = replace(table2, columns=500, rows=420)
    grid = Grid.centred((20, 16, 20), (0.1, 0.1, 0.1), (0.0, 0.0, 1.9))
    image = seen_by(camera, water, true, grid.bounds_mm(2))
    return task_for(image + np.sqrt(noise**2 + gain * image) * rng.normal(size=image.size), camera, water, grid)


def rows_of(view: View, place: ArrayLike) -> tuple[NDArray[np.int32], Floats]:
    """Return the pixels (n,) of a particle of unit light as fits have them, and its light and derivatives (n, 4)."""
    responses = room_for(1, entry_capacity(view, -5.0, 5.0), 0)
    respond_all(view, np.append(place, 1.0)[np.newaxis], responses)
    pixels, values = lit_by(responses, 0)
    return pixels, values[:, : pixels.size].T


def rows_image(view: View, place: ArrayLike) -> Floats:
    """Return the same as images (pixels, 4)."""
    image = np.zeros((view.camera.rows * view.camera.columns, 4))
    np.add.at(image, *rows_of(view, place))
    return image


def fit_moved(response: Floats, light: Floats) -> Floats:
    """Return by how much in x, y and z (3,) a fit of a response (pixels, 4) to other light (pixels,) would move."""
    lit = (response[:, 0] > 0.0) | (light > 0.0)
    columns = np.column_stack([response[lit, 1:], response[lit, 0]])
    return np.abs(np.linalg.lstsq(columns, (light - response[:, 0])[lit], rcond=None)[0][:3])


def found(particles: Floats, true: Floats) -> Flags:
    """Return which true particles (n, 4) have one within 0.02 mm laterally and 0.1 mm in depth."""
    distance, _ = KDTree(particles[:, :3] / (0.02, 0.02, 0.1)).query(true[:, :3] / (0.02, 0.02, 0.1))
    return np.asarray(distance < 1.0)
