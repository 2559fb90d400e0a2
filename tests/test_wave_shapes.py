"""Dots and corners by waves, against images by full waves, which share nothing with the fit but the optics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.calibration.board import DotLook, disc_shape, locate_board
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.shape_fit import pixels_near
from lfpiv_cli.calibration.wave_shapes import Strips, WaveLight, WaveShapes, corner_strips, disc_strips
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.render import render_white

GREEN = WaveLight(532e-6, 0.3)
PLACE = np.array([0.13, 0.07, 0.3])
BOARD = BoardGeometry((1, 1), 0.6, 0.2)
RADIUS = 0.5 * BOARD.dot_diameter_mm


@pytest.fixture(scope="module")
def camera() -> Camera:
    """Table 2's optics before a small sensor."""
    return Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1, "square"), 0.0055, 160, 150, diffusion_px=0.3)


@pytest.fixture(scope="module")
def waves(camera: Camera) -> WaveShapes:
    """Shapes at the depth of the dot."""
    return WaveShapes.of(camera, Media(), GREEN, np.array([PLACE[2]]))


@pytest.fixture(scope="module")
def picture(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """A dot's light and that of a white image."""
    light = Waves(GREEN.wavelength_mm)
    place = BoardPlacement(0.3, (0.13, 0.07))
    seen = render_board(camera, ObjectSpace(Media()), BOARD, place, 1.0, np.random.default_rng(1), waves=light)
    return seen, render_white(camera, 1.0, waves=light).astype(np.float32)


def test_a_dot_by_waves_lies_where_it_is(
    camera: Camera, waves: WaveShapes, picture: tuple[NDArray[np.float64], NDArray[np.float32]]
) -> None:
    """By rays it does not: near focus its light comes through few lenses, of which some are lit in part."""
    look, start = DotLook(*picture, Media(), RADIUS, PLACE[np.newaxis, :2], PLACE[2]), PLACE + (0.004, -0.004, 0.02)
    by_rays, by_waves = (look.fitted(start, camera, BOARD, disc_shape(RADIUS), light) for light in (None, waves))
    assert by_rays is not None
    assert by_waves is not None
    # A dot of 256 points, 1 % of whose light is astray, is known to some 3 um of depth.
    assert np.all(np.abs(by_waves.position_mm - PLACE) < (3e-4, 3e-4, 5e-3))
    assert abs(by_rays.position_mm[2] - PLACE[2]) > 0.015
    assert by_waves.brightness == pytest.approx(1.0, abs=0.02)


def test_a_disc_that_fills_the_scene_is_uniform_light(camera: Camera, waves: WaveShapes) -> None:
    """Its share is 1 of every pixel, whatever the depth: what reaches a pixel comes from within a few lenses."""
    dark = np.zeros((camera.rows, camera.columns))
    near = pixels_near((dark, dark.astype(np.float32) + 1.0), camera, Media(), PLACE, 0.2, 10_000)
    assert near is not None
    shares = waves.shares(near.rays, PLACE, disc_strips(1.0, waves.lens_mm))
    np.testing.assert_allclose(shares, 1.0, atol=2e-3)


@pytest.mark.parametrize("turn_deg", [0.0, 0.4, -25.0, 45.0, 80.0])
def test_corners_are_two_squares(turn_deg: float) -> None:
    """Within a square's side of the corner a strip holds what lies in either quadrant, and no more."""
    turn = np.deg2rad(turn_deg)
    edges = 0.6 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    strips = corner_strips(edges, 0.1)
    points = np.random.default_rng(3).uniform(-0.4, 0.4, (500, 2))
    inside = np.prod(points @ np.linalg.inv(edges), axis=1) > 0.0
    assert np.mean(held(strips, points) == inside) > 0.98


def held(strips: Strips, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points lie on the strip nearest to them."""
    off = np.abs(strips.aside_mm - points[:, 1:])
    on = (strips.begin_mm <= points[:, :1]) & (points[:, :1] < strips.end_mm)
    return np.asarray(np.any((off <= 0.5 * strips.width_mm) & on, axis=1))


def test_strips_of_a_disc_hold_its_area() -> None:
    """And its mean square along both axes, a quarter of the radius's, to the square of the strips' distance."""
    begin, end, aside, width = disc_strips(0.1, 0.1)
    area = np.sum((end - begin) * width)
    assert area == pytest.approx(np.pi * 0.1**2, rel=1e-3)
    assert np.sum((end**3 - begin**3) / 3.0 * width) / area == pytest.approx(0.1**2 / 4.0, rel=2e-3)
    assert np.sum((end - begin) * width * aside**2) / area == pytest.approx(0.1**2 / 4.0, rel=2e-3)


def test_hexagons_are_refused_by_waves(camera: Camera) -> None:
    """Line responses are of square cells."""
    hexagonal = replace(camera, lattice=Lattice.regular(0.1, "hexagonal"))
    with pytest.raises(ConfigError, match="wavelength_nm"):
        locate_board(np.ones((150, 160), np.float32), hexagonal, BOARD, Media(), light=GREEN)
