"""The camera of Table 2: its lengths, its pixels and its axes, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.optics.camera import Lattice


def test_table2_lengths(table2):
    # S_i = F_m (1 - M) = 200, F_m (M - 1)/M = 200 at M = -1; at M = -0.5: 150 and 300
    assert (table2.image_distance_mm, table2.focus_distance_mm) == (200.0, 200.0)
    half = replace(table2, magnification=-0.5)
    assert (half.image_distance_mm, half.focus_distance_mm) == (150.0, 300.0)


@pytest.mark.parametrize("magnification", [-0.5, -1.0, -3.0])
def test_focal_point_has_no_defocus(table2, magnification):
    camera = replace(table2, magnification=magnification)
    assert camera.defocus(camera.focus_distance_mm) == pytest.approx(0.0, abs=1e-14)


def test_defocus_by_hand(table2):
    # alpha = 1 + 200/190 - 200/100 = 0.0526316: nearer than the focal point spreads with X
    assert table2.defocus(190.0) == pytest.approx(0.0526316, abs=1e-7)


def test_micro_image_pitch_is_not_the_array_s(table2, camera):
    # 0.1 mm * (1 + 0.8/200)/0.0055 mm = 18.254545 px
    assert table2.micro_image_lattice_px().pitch == pytest.approx([18.2545, 18.2545], abs=1e-4)
    assert camera.micro_image_lattice_px().pitch == pytest.approx([18.2545, 18.2545], abs=1e-4)


def test_axis_meets_the_sensor_between_the_middle_pixels(table2):
    assert table2.sensor_centre_px == pytest.approx([1175.5, 883.5])
    assert table2.mm_to_px((0.0, 0.0)) == pytest.approx([1175.5, 883.5])
    # pixel 1176 is centred half a pixel, 0.00275 mm, along +x of the axis
    assert table2.px_to_mm((1176, 883)) == pytest.approx([0.00275, -0.00275])


def test_px_and_mm_invert(table2, rng):
    px = rng.uniform(0, 2000, (20, 2))
    assert table2.mm_to_px(table2.px_to_mm(px)) == pytest.approx(px)


def test_with_micro_images_inverts_micro_image_lattice(camera):
    moved = Lattice.regular(18.3, camera.lattice.layout, 0.01, (1180.0, 880.0))
    found = camera.with_micro_images(moved).micro_image_lattice_px()
    assert found.origin == pytest.approx(moved.origin)
    assert found.basis == pytest.approx(moved.basis)


def test_column_axis_y_exchanges_x_and_y(table2):
    points = np.array([(1.0, 2.0, 3.0)])
    assert table2.to_image_axes(points).tolist() == [[1.0, 2.0, 3.0]]
    assert replace(table2, column_axis="y").to_image_axes(points).tolist() == [[2.0, 1.0, 3.0]]
    assert points.tolist() == [[1.0, 2.0, 3.0]]  # the caller's array is left alone
