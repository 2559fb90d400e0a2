"""The main lens's distortion is undone on writing a volume: against rays traced through the distorted camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import disc_points, trace
from lfpiv_cli.weights.build import factorise, scene_distortion
from lfpiv_cli.weights.model import Weights
from tests.known_rays import slopes_equivalent

RAYS = 200_000
# Far more than a real lens has, as the sensor is small: at 2 mm from the axis 1.2 % or 0.03 mm.
K1_PER_MM2 = 3e-3


def spot(camera: Camera, media: Media, place: tuple[float, float, float], rng: np.random.Generator) -> NDArray:
    """Count the rays of a glowing point on the pixels."""
    points = camera.to_image_axes(np.broadcast_to(place, (RAYS, 3)))
    lens = disc_points(RAYS, camera.aperture_radius_mm, rng)
    hits = trace(camera, lens, slopes_equivalent(points, lens, camera, media))
    column, row = np.rint(camera.mm_to_px(hits.sensor_mm)).astype(int).T
    counts = np.bincount(row * camera.columns + column, minlength=camera.rows * camera.columns)
    return counts.reshape(camera.rows, camera.columns).astype(np.float32)


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_a_point_off_the_axis_comes_back_to_its_place(table2: Camera, water: Media, rng, column_axis: str) -> None:
    lattice = Lattice.regular(0.1, origin=(0.013, -0.021))
    camera = replace(
        table2, columns=900, rows=900, lattice=lattice, column_axis=column_axis, distortion_per_mm2=K1_PER_MM2
    )
    true = (1.62, -1.13, 2.5)
    grid = Grid.centred((30, 30, 1), (0.05, 0.05, 0.1), true)
    bend = scene_distortion(camera, water, grid)
    assert bend is not None
    # (s_i/s_o)^2 by hand: 200 / (200 + 2.5/1.33), squared.
    assert bend[0] == pytest.approx(K1_PER_MM2 * (200.0 / (200.0 + 2.5 / 1.33)) ** 2)
    weights = Weights(grid, (0, 0, 0), factorise(camera, water, grid), column_axis, None, bend)
    volume = weights.adjoint(spot(camera, water, true, rng))
    found = [centre(grid, taken) for taken in (volume, weights.to_world(volume))]
    off = np.hypot(*(np.array(found) - true[:2]).T)
    assert off[0] == pytest.approx(bend[0] * np.hypot(*true[:2]) ** 3, rel=0.3)
    # The adjoint is a blur as wide as a microlens, 0.1 mm; its middle is known to a tenth of that.
    assert off[1] < 0.2 * off[0]


def centre(grid: Grid, volume: NDArray) -> list[float]:
    """Return the centre (x, y) of the bright part of a plane."""
    plane = np.clip(volume[0] - 0.3 * volume[0].max(), 0.0, None)
    y, x = np.meshgrid(grid.axis_mm(1), grid.axis_mm(0), indexing="ij")
    return [float((plane * axis).sum() / plane.sum()) for axis in (x, y)]


def test_without_distortion_nothing_is_bent(table2: Camera, water: Media) -> None:
    assert scene_distortion(table2, water, Grid.centred((2, 2, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))) is None
