"""Rectification, transmission and views: where a pixel goes, which way the frame turns, what is left in place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.calibration.lattice import LatticeFit, fit_lattice
from lfpiv_cli.calibration.rectification import (
    EXPONENT_ARRAY,
    Rectification,
    sample_rows,
    turn_matrix,
    write_shift,
)
from lfpiv_cli.calibration.shape_fit import lens_crossings, pixel_rays
from lfpiv_cli.calibration.views import lens_table, sub_aperture_view
from lfpiv_cli.calibration.white import relative_transmission
from lfpiv_cli.errors import InputError
from lfpiv_cli.optics.camera import Camera, Lattice

SHAPE = (120, 150)
CENTRE = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])


def known_fit(lattice: Lattice, cubic: NDArray[np.float64] | None = None) -> LatticeFit:
    """A fit that is exactly `lattice`, or `lattice` plus cubic terms."""
    coefficients = np.zeros((10, 2))
    coefficients[0], coefficients[1:3] = lattice.origin, lattice.basis
    if cubic is not None:
        coefficients[3:] = cubic
    two = np.zeros(2)
    none = np.zeros((0, 2))
    return LatticeFit(lattice, none.astype(int), none, coefficients, cubic is not None, two, two, two, two, 0.0)


def turned_lattice(layout: str, angle_deg: float = 5.0) -> Lattice:
    return Lattice.regular(12.5, layout, np.deg2rad(angle_deg), (70.3, 61.2))


def test_nothing_to_undo_is_the_identity(layout: str, rng: np.random.Generator) -> None:
    rectification = Rectification(known_fit(turned_lattice(layout, 0.0)), SHAPE)
    image = rng.random(SHAPE)
    # Float32 of values up to 1, and of places that are known to 1e-12 px.
    np.testing.assert_allclose(rectification.apply(image), image, atol=1e-6)
    np.testing.assert_allclose(rectification.shift_px, 0.0, atol=1e-9)


def test_a_lens_image_lands_on_its_upright_lattice_point(layout: str) -> None:
    cubic = np.zeros((7, 2))
    cubic[0] = (0.02, -0.015)
    cubic[4] = (0.003, 0.004)
    fit = known_fit(turned_lattice(layout), cubic)
    rectification = Rectification(fit, SHAPE)
    row, column = np.indices(SHAPE)
    for index in [(0, 0), (3, -2), (-2, 3)]:
        x, y = fit.centres(index)
        moved = rectification.apply(np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * 2.0**2)))
        found = np.array([(moved * column).sum(), (moved * row).sum()]) / moved.sum()
        # Half a percent of the spot lies beyond the lens's cell, where the neighbour's offset moves it.
        np.testing.assert_allclose(found, rectification.lattice_px.points(index), atol=0.02)


def test_the_upright_lattice_is_the_raw_one_turned_about_the_centre(layout: str) -> None:
    raw = turned_lattice(layout)
    upright = Rectification(known_fit(raw), SHAPE).lattice_px
    assert upright.rotation_rad == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(upright.pitch, raw.pitch, rtol=1e-12)
    angle = np.deg2rad(-5.0)
    offset = raw.origin - CENTRE
    by_hand = np.array(
        [np.cos(angle) * offset[0] - np.sin(angle) * offset[1], np.sin(angle) * offset[0] + np.cos(angle) * offset[1]]
    )
    np.testing.assert_allclose(upright.origin, CENTRE + by_hand, atol=1e-9)


def test_a_rectified_white_image_shows_no_rotation(layout: str) -> None:
    raw = turned_lattice(layout, 2.0)
    row, column = np.indices(SHAPE)
    offset = np.stack([column, row], axis=-1) - raw.points(raw.nearest(np.stack([column, row], axis=-1)))
    white = 100.0 + 1000.0 * np.exp(-np.sum(offset**2, axis=-1) / (2 * 3.0**2))
    rectification = Rectification(fit_lattice(white, layout=layout), SHAPE)
    again = fit_lattice(rectification.apply(white), layout=layout)
    assert np.rad2deg(again.lattice_px.rotation_rad) == pytest.approx(0.0, abs=0.01)
    # Centroids of these spots are good to some hundredths of a pixel.
    origin = again.lattice_px.origin
    upright = rectification.lattice_px
    np.testing.assert_allclose(origin, upright.points(upright.nearest(origin)), atol=0.03)


def test_sampling_is_the_cubic_spline(rng: np.random.Generator) -> None:
    image = rng.random(SHAPE)
    rectification = Rectification(known_fit(turned_lattice("square")), SHAPE)
    row, column = np.indices(SHAPE)
    shift = rectification.shift_px.astype(np.float64)
    expected = ndimage.map_coordinates(image, [row + shift[..., 1], column + shift[..., 0]], order=3, mode="mirror")
    inside = rectification.inside
    assert 0.8 < inside.mean() < 1.0
    np.testing.assert_allclose(rectification.apply(image)[inside], expected[inside], atol=1e-6)
    assert np.all(rectification.apply(image)[~inside] == 0.0)


def test_compiled_kernels_equal_their_python(rng: np.random.Generator) -> None:
    rectification = Rectification(known_fit(turned_lattice("hexagonal")), (14, 17))
    fit, upright = rectification.fit, rectification.lattice_px
    turn = turn_matrix(rectification.rotation_rad)
    plain, sampled = np.empty((14, 17, 2), np.float32), np.zeros((14, 17), np.float32)
    python = getattr(write_shift, "py_func", write_shift)
    python((0, 14), upright.origin, upright.basis, (fit.coefficients_px, EXPONENT_ARRAY), turn, plain)
    np.testing.assert_allclose(rectification.shift_px, plain, atol=1e-6)
    coefficients = rng.random((14, 17))
    python = getattr(sample_rows, "py_func", sample_rows)
    python((0, 14), coefficients, plain, rectification.inside, sampled)
    assert np.any(sampled)
    compiled = np.zeros_like(sampled)
    sample_rows((0, 14), coefficients, plain, rectification.inside, compiled)
    np.testing.assert_allclose(compiled, sampled, rtol=1e-6)


@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_the_scene_turns_with_the_image(table2: Camera, column_axis: str) -> None:
    """A point's image through the middle of the lens lies at M times its place, in either frame."""
    camera = replace(table2, column_axis=column_axis, columns=SHAPE[1], rows=SHAPE[0])
    rectification = Rectification(known_fit(turned_lattice("square", 30.0)), SHAPE)
    world = np.array([[0.05, 0.0], [0.03, -0.1]])
    raw_px = camera.mm_to_px(-1.0 * camera.to_image_axes(world))
    upright_px = camera.mm_to_px(-1.0 * camera.to_image_axes(rectification.from_world(world, column_axis)))
    shift = rectification.shift_px
    column, row = np.rint(upright_px).astype(int).T
    # By the map of the pixels: within a lens it is the turn about the centre, but for the rounding to whole pixels.
    mapped = np.stack([column, row], axis=1) + shift[row, column]
    np.testing.assert_allclose(mapped, raw_px, atol=0.75)
    back = rectification.to_world(rectification.from_world(world, column_axis), column_axis)
    np.testing.assert_allclose(back, world, atol=1e-12)


def test_an_image_of_another_shape_is_refused() -> None:
    with pytest.raises(InputError, match=r"\(5, 5\).*\(120, 150\)"):
        Rectification(known_fit(turned_lattice("square")), SHAPE).apply(np.zeros((5, 5)))


def test_transmission_is_one_in_the_middle_and_zero_in_the_gaps() -> None:
    lattice = turned_lattice("square", 0.0)
    row, column = np.indices(SHAPE)
    place = np.stack([column, row], axis=-1)
    distance = np.hypot(*np.moveaxis(place - lattice.points(lattice.nearest(place)), -1, 0))
    white = np.where(distance < 5.0, 800.0, 20.0).astype(np.float32)
    white[:, :20] *= 0.5
    passed = relative_transmission(white, lattice)
    np.testing.assert_allclose(passed[(distance < 5.0) & (column >= 20)], 1.0)
    np.testing.assert_allclose(passed[(distance < 5.0) & (column < 20)], 0.5)
    assert np.all(passed[distance >= 5.0] == 0.0)


def test_a_view_shows_its_own_point_of_the_main_lens(camera: Camera) -> None:
    camera = replace(camera, columns=200, rows=160)
    row, column = np.mgrid[:160, :200]
    crossing = lens_crossings(pixel_rays(camera, column.ravel(), row.ravel()), camera).reshape(160, 200, 2)
    for point in [(0.0, 0.0), (4.0, -3.0)]:
        for axis in (0, 1):
            view = sub_aperture_view(crossing[..., axis], camera, point)
            # The outermost lenses are cut by the sensor's edge.
            np.testing.assert_allclose(view[1:-1, 1:-1], point[axis], atol=1e-6)


def test_neighbours_in_the_lens_table_are_neighbours_on_the_array(camera: Camera) -> None:
    camera = replace(camera, columns=300, rows=260)
    table = lens_table(camera)
    lens = camera.lattice.points(table)
    np.testing.assert_allclose(np.hypot(*np.moveaxis(np.diff(lens, axis=1), -1, 0)), 0.1)
    np.testing.assert_allclose(np.hypot(*np.moveaxis(np.diff(lens, axis=0), -1, 0)), 0.1)
    px = camera.micro_image_lattice_px().points(table)
    assert np.all((px >= 0) & (px <= [299, 259]))
    # No lens row and not more than half a lens column is left out.
    assert table.shape[0] >= 260 / 18.26 - 1 if camera.lattice.layout == "square" else table.shape[0] >= 15
    assert table.shape[1] >= 300 / 18.26 - 2
