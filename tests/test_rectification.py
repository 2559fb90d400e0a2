"""Rectification, transmission, views and the stage of calibrate-snapshot on small pictures."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.lattice import LatticeFit, fit_lattice
from lfpiv_cli.calibration.rectification import Rectification, turn_matrix
from lfpiv_cli.calibration.shape_fit import lens_crossings, pixel_rays
from lfpiv_cli.calibration.views import lens_table, refocused_stack, sub_aperture_view, views_across
from lfpiv_cli.calibration.white import relative_transmission
from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, UsageError
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import disc_points
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot
from tests.known_rays import points_counted

SHAPE = (120, 150)
CENTRE = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])


def known_fit(lattice: Lattice, cubic: Floats | None = None) -> LatticeFit:
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


def test_a_lens_image_lands_on_its_upright_lattice_point_turned_about_the_centre(layout: str) -> None:
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
    raw = turned_lattice(layout)
    upright = Rectification(known_fit(raw), SHAPE).lattice_px
    assert upright.rotation_rad == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(upright.pitch, raw.pitch, rtol=1e-12)
    angle = np.deg2rad(-5.0)
    offset = raw.origin - CENTRE
    by_hand = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ offset
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
    window = slice(50, 71), slice(33, 90)
    only = np.zeros(SHAPE)
    only[window] = rectification.apply(image)[window]
    np.testing.assert_allclose(rectification.apply(image, window), only, atol=1e-7)
    with pytest.raises(InputError, match=r"\(5, 5\).*\(120, 150\)"):
        Rectification(known_fit(turned_lattice("square")), SHAPE).apply(np.zeros((5, 5)))


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


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_a_nearest_pixel_lies_beside_its_place_as_it_does_in_its_lens_image(layout: str) -> None:
    rectification = Rectification(known_fit(turned_lattice(layout)), SHAPE)
    row, column = np.indices(SHAPE)
    raw = np.stack([rectification.nearest(each) for each in (column, row)], axis=-1)
    lens = rectification.lattice_px.nearest(np.stack([column, row], axis=-1))
    from_centre = (raw - rectification.fit.centres(lens)) @ turn_matrix(rectification.rotation_rad)
    place = rectification.lattice_px.points(lens) + from_centre - np.stack([column, row], axis=-1)
    inside = rectification.inside
    np.testing.assert_allclose(rectification.off_px[inside], place[inside], atol=1e-4)
    assert 0.4 < np.abs(place[inside]).max() < 0.75


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


def test_views_show_their_own_points_of_the_main_lens(camera: Camera) -> None:
    camera = replace(camera, columns=200, rows=160)
    row, column = np.mgrid[:160, :200]
    crossing = lens_crossings(pixel_rays(camera, column.ravel(), row.ravel()), camera).reshape(160, 200, 2)
    for point in [(0.0, 0.0), (4.0, -3.0)]:
        for axis in (0, 1):
            view = sub_aperture_view(crossing[..., axis], camera, point)
            # The outermost lenses are cut by the sensor's edge.
            np.testing.assert_allclose(view[1:-1, 1:-1], point[axis], atol=1e-6)
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


RAYS = 100_000
POINT = (0.42, -0.31, 4.0)


@pytest.fixture
def small(camera: Camera) -> Camera:
    lattice = camera.lattice.transformed(np.eye(2), (0.013, -0.021))
    return replace(camera, columns=500, rows=420, lattice=lattice)


@pytest.fixture
def image(small: Camera, water: Media, rng: np.random.Generator) -> Floats:
    """A small glowing disc, as wide as a microlens."""
    start = np.column_stack([disc_points(RAYS, 0.05, rng), np.zeros(RAYS)]) + POINT
    return points_counted(start, small, water, rng)


def test_refocused_at_its_depth_a_point_is_sharp_and_views_in_order(small: Camera, water: Media, image) -> None:
    depths = (0.0, 2.0, 4.0, 6.0, 8.0)
    stack = refocused_stack(image, small, water, depths)
    assert np.argmax(np.sum(stack**2, axis=(1, 2))) == 2
    sharp = stack[2]
    row, column = ndimage.center_of_mass(np.where(sharp > 0.2 * sharp.max(), sharp, 0.0))
    found = (np.array([column, row]) - (np.array(sharp.shape[::-1]) - 1) / 2) * small.lattice.pitch.min()
    # One sample per microlens, 0.1 mm; a centroid over two of them is good to a quarter.
    np.testing.assert_allclose(found, POINT[:2], atol=0.03)
    views = views_across(image, small, 5)
    radius = small.aperture_radius_mm
    point, right = views[2, 4]
    np.testing.assert_allclose(point, (0.8 * radius, 0.0))
    np.testing.assert_array_equal(right, sub_aperture_view(image, small, point))
    np.testing.assert_allclose(views[0, 1][0], (-0.4 * radius, -0.8 * radius))
    corners = {(row, column) for row in (0, 4) for column in (0, 4)}
    assert set(views) == {(row, column) for row in range(5) for column in range(5)} - corners


WHITE_SHAPE = (200, 240)
CONFIG = """
camera:
  microlenses: {{pitch_mm: {pitch}, {layout}}}
  sensor:      {{pixel_um: 5.0, columns: 240, rows: 200}}
"""
QUIET = Console(quiet=True)


def white(path: Path, lattice: Lattice, radius_px: float) -> Path:
    row, column = np.indices(WHITE_SHAPE)
    place = np.stack([column, row], axis=-1).astype(float)
    distance = np.linalg.norm(place - lattice.points(lattice.nearest(place)), axis=-1)
    image: NDArray[Any] = 200.0 + 20000.0 * np.clip(radius_px + 0.5 - distance, 0.0, 1.0)
    noise = np.random.default_rng(3).normal(0.0, 50.0, WHITE_SHAPE)
    cv2.imwrite(str(path), (image + noise).astype(np.uint16))
    return path


def config(folder: Path, pitch: float = 0.07, layout: str = "f_number: 8") -> Path:
    path = folder / "rig.yaml"
    path.write_text(CONFIG.format(pitch=pitch, layout=layout))
    return path


def calibrated(folder: Path, rig: Path, whites: list[Path], dark: Path | None = None) -> dict[str, Any]:
    return calibrate_snapshot(
        rig, folder / "c.h5", CalibrateOptions(white=whites, dark=dark), overwrite=True, console=QUIET
    )


@pytest.fixture
def square() -> Lattice:
    return Lattice.regular(14.2, "square", np.deg2rad(0.7), (117.3, 98.4))


def test_layout_and_pitch_are_found_and_checked(tmp_path: Path, square: Lattice) -> None:
    hexagons = Lattice.regular(14.2, "hexagonal", np.deg2rad(0.7), (117.3, 98.4))
    picture = white(tmp_path / "w.tif", hexagons, 5.5)
    assert calibrated(tmp_path, config(tmp_path), [picture])["layout"] == "hexagonal"
    with pytest.raises(InputError, match="shows a hexagonal array, and microlenses.layout is square"):
        calibrated(tmp_path, config(tmp_path, layout="layout: square"), [picture])
    picture = white(tmp_path / "w.tif", square, 5.5)
    assert calibrated(tmp_path, config(tmp_path, pitch=0.0745), [picture])["lenses"] > 150
    with pytest.raises(InputError, match=r"14\.2 px apart and 15 px by the data sheet, 5 % off.*pixel_um"):
        calibrated(tmp_path, config(tmp_path, pitch=0.075), [picture])
    with pytest.raises(UsageError, match="--white, --board or both"):
        calibrated(tmp_path, config(tmp_path), [])


@pytest.mark.thorough
def test_small_aperture_gives_the_lattice_and_wide_the_transmission(tmp_path: Path, square: Lattice) -> None:
    # The array has moved between the two pictures, so that it shows which one the lattice is from.
    moved = Lattice(square.origin + (0.5, 0.0), square.basis)
    wide, small = white(tmp_path / "wide.tif", square, 6.0), white(tmp_path / "small.tif", moved, 3.0)
    for whites in ([wide, small], [small, wide]):
        origin = calibrated(tmp_path, config(tmp_path), whites)["origin_px"]
        np.testing.assert_allclose(origin, moved.points(moved.nearest(origin)), atol=0.03)
        transmission = open_calibration(tmp_path / "c.h5").transmission
        assert transmission is not None
        # pi 6^2 / 14.2^2 of the pixels are lit in the wide picture, a quarter of that in the small one.
        assert np.mean(transmission > 0.5) == pytest.approx(np.pi * 36 / 14.2**2, abs=0.06)


def test_a_known_focus_needs_no_board(tmp_path: Path, square: Lattice) -> None:
    """The mid plane is where it is told to be; a board measures it."""
    rig, picture = config(tmp_path), white(tmp_path / "w.tif", square, 5.5)
    options = CalibrateOptions(white=[picture], depth_mm=[-0.35])
    with pytest.raises(ConfigError, match="section `channel` is missing"):
        calibrate_snapshot(rig, tmp_path / "c.h5", options, console=QUIET)
    rig.write_text(rig.read_text() + "channel: {width_mm: 4.0, wall_mm: 2.0}\n")
    figures = calibrate_snapshot(rig, tmp_path / "c.h5", options, console=QUIET)
    assert [figures[f"mid_plane_{name}"] for name in ("z_mm", "z_mm_sigma", "given")] == [-0.35, None, True]
    assert open_calibration(tmp_path / "c.h5").summary() == figures
    for depths, words in (([0.0, 1.0], "0 --board and 2 --depth-mm"), ([np.nan], "a depth of nan mm")):
        with pytest.raises(UsageError, match=words):
            calibrate_snapshot(rig, tmp_path / "d.h5", replace(options, depth_mm=depths), console=QUIET)


@pytest.mark.thorough
def test_a_whole_camera_tells_its_image_distance_and_shows_views(tmp_path: Path, square: Lattice) -> None:
    pytest.importorskip("matplotlib")
    rig = config(tmp_path, pitch=14.2 * 0.005 / 1.004, layout="focal_length_mm: 0.8")
    lens = "  main_lens: {magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 20.0}"
    rig.write_text(rig.read_text().replace("camera:", f"camera:\n{lens}"))
    picture = white(tmp_path / "w.tif", square, 5.5)
    views = tmp_path / "views.png"
    figures = calibrate_snapshot(rig, tmp_path / "c.h5", CalibrateOptions(white=[picture], views=views), console=QUIET)
    # 0.8 mm / 0.004; the pitch of 200 lenses is good to 2e-5, the excess thus to 1 %.
    assert figures["image_distance_mm"] == pytest.approx(200.0, abs=max(5.0, 4 * figures["image_distance_mm_sigma"]))
    assert views.stat().st_size > 10_000
