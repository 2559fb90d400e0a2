"""The board's pose by hand and as a rigid plate, and the light of its dots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres, render_board
from lfpiv_cli.synthetic.render import render_white

BOARD = BoardGeometry(dots=(3, 2), spacing_mm=1.0, dot_diameter_mm=0.2)
AIR = ObjectSpace(Media())


def test_dots_of_an_upright_board_by_hand():
    found = dot_centres(BOARD, BoardPlacement(-0.35, (0.13, -0.07)))
    expected = [(x + 0.13, y - 0.07, -0.35) for y in (-0.5, 0.5) for x in (-1, 0, 1)]
    assert found == pytest.approx(np.array(expected))


def test_rotation_goes_from_x_towards_y():
    first, second = dot_centres(replace(BOARD, dots=(2, 1)), BoardPlacement(0.0, rotation_deg=30.0))
    assert second - first == pytest.approx([np.sqrt(0.75), 0.5, 0.0])


def test_tilt_is_the_plane_z0_plus_tan_a_x_plus_tan_b_y():
    placement = BoardPlacement(0.5, (0.2, 0.1), (12.0, -7.0), 20.0)
    dots = dot_centres(BOARD, placement)
    x, y = (dots[:, :2] - placement.offset_mm).T
    assert dots[:, 2] == pytest.approx(0.5 + np.tan(np.deg2rad(12.0)) * x - np.tan(np.deg2rad(7.0)) * y)


def test_a_tilted_board_stays_rigid(rng):
    plate = rng.uniform(-3, 3, (10, 2))
    moved = BoardPlacement(0.5, (0.2, 0.1), (12.0, -7.0), 20.0).to_world(plate)
    distances = np.linalg.norm(moved[:, np.newaxis] - moved, axis=2)
    assert distances == pytest.approx(np.linalg.norm(plate[:, np.newaxis] - plate, axis=2))


@pytest.mark.thorough
def test_a_wide_dot_is_as_bright_as_white_light(camera, rng):
    """Where a dot fills the field of a lens, its pixels are those of a white image of the same level."""
    camera = replace(camera, columns=90, rows=90)
    dot = BoardGeometry((1, 1), 1.0, 1.6)
    for z in (0.0, 2.0):
        image = render_board(camera, AIR, dot, BoardPlacement(z), 1000.0, rng)
        white = render_white(camera, 1000.0)
        lit = white > 999.0
        # rays: a million on 50,000 pixels' worth of light, 20 to a pixel of the mean of a thousand pixels
        assert image[lit].mean() == pytest.approx(1000.0, rel=0.01), z


@pytest.mark.thorough
def test_a_dark_dot_is_what_a_bright_one_leaves_of_white_light(camera):
    camera = replace(camera, columns=90, rows=90)
    bright = BoardGeometry((1, 1), 1.0, 0.2)
    images = [
        render_board(camera, AIR, board, BoardPlacement(-1.0), 1000.0, np.random.default_rng(2))
        for board in (bright, replace(bright, polarity="dark"))
    ]
    white = render_white(camera, 1000.0)
    clipped = images[1] == 0.0
    assert (images[0] + images[1])[~clipped] == pytest.approx(white[~clipped])
    assert images[0].sum() > 0.0
