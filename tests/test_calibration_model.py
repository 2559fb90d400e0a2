"""The lattice fit against known spots and photographs; the calibration as one thing: Eq. 21, its file, its camera."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration import model
from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose, pose_of_dots
from lfpiv_cli.calibration.lattice import LatticeFit, fit_lattice, shadowed, without_strays
from lfpiv_cli.calibration.model import Calibration, Channel, DataSheet, Photographs, Rig, calibrate, with_mid_plane
from lfpiv_cli.calibration.white import index_spots
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.calibration_file import calibration_of, tree_of
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media

BOARD = BoardGeometry((7, 7), 1.0, 0.2)
CHANNEL = Channel(width_mm=10.0, wall_mm=5.0)
SHAPE = (180, 220)
LENS = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, SHAPE[1], SHAPE[0])
# The contract's names; whatever has an uncertainty has it under the same name with _sigma.
MEASURED = [
    "lenses pitch_px rotation_deg origin_px residual_px k1_per_mm2 board_z_mm tilt_deg offset_mm magnification",
    "camera_move_mm mid_plane_z_mm layout distortion_model residual_affine_px image_distance_mm",
    "dots_found mid_plane_given dlfc_depths_mm dlfc_degree dlfc_sightings dlfc_residual_mm dlfc_entrance_pupil_mm",
]
UNCERTAIN = "pitch_px rotation_deg origin_px k1_per_mm2 board_z_mm tilt_deg offset_mm magnification mid_plane_z_mm"
UNCERTAIN += " image_distance_mm dlfc_entrance_pupil_mm"


def white_image() -> Floats:
    lattice = Lattice.regular(14.3, "square", np.deg2rad(1.5), (108.0, 91.0))
    row, column = np.indices(SHAPE)
    place = np.stack([column, row], axis=-1)
    distance2 = np.sum((place - lattice.points(lattice.nearest(place))) ** 2, axis=-1)
    return 100.0 + 1000.0 * np.exp(-distance2 / (2 * 3.5**2))


def exact_pose(z_mm: float, magnification: float = -1.0) -> BoardPose:
    """A board at z, its dots a micrometre off at random places, so that standard errors are not zero."""
    i, j = np.meshgrid(np.arange(7) - 3.0, np.arange(7) - 3.0, indexing="ij")
    dots = np.stack([i.ravel(), j.ravel(), np.full(49, z_mm)], axis=1)
    dots += 1e-3 * np.sin(np.arange(147.0).reshape(49, 3) ** 2)
    return pose_of_dots(dots, np.full((49, 3), 1e-3), -dots[:, :2], replace(LENS, magnification=magnification), BOARD)


@pytest.fixture(scope="module")
def plain() -> Calibration:
    return calibrate(Photographs([white_image()]))


@pytest.fixture
def rig(table2: Camera, water: Media) -> Rig:
    return Rig(replace(table2, columns=SHAPE[1], rows=SHAPE[0]), water, BOARD, CHANNEL)


def test_eq21_by_hand(water: Media) -> None:
    # t_b + t_w/n_ag + D/(2 n_w) = 1.5 + 5/1.49 + 10/2.66
    advised = model.advised_move_mm(replace(BOARD, thickness_mm=1.5), CHANNEL, water)
    assert advised == pytest.approx(1.5 + 3.3557047 + 3.7593985)


def test_mid_plane_follows_from_board_and_move(plain: Calibration, rig: Rig) -> None:
    pose = exact_pose(-0.35)
    advised = with_mid_plane(plain, pose, rig)
    # A board 0.35 mm in front of the focal plane in air: in water the mid plane is 1.33 times as far in front of it.
    assert advised.mid_plane_z_mm == pytest.approx(1.33 * pose.z0_mm)
    assert advised.mid_plane_z_sigma_mm == pytest.approx(1.33 * pose.z0_sigma_mm)
    # A camera moved 0.1 mm too near has its focal plane 0.133 mm behind, the mid plane that much in front of it.
    nearer = replace(rig, channel=replace(CHANNEL, camera_move_mm=advised.camera_move_mm + 0.1))
    assert with_mid_plane(plain, pose, nearer).mid_plane_z_mm == pytest.approx(1.33 * (pose.z0_mm - 0.1))
    assert with_mid_plane(plain, pose, replace(rig, channel=None)).mid_plane_z_mm is None
    in_water = replace(rig, board=replace(BOARD, medium="fluid"))
    assert with_mid_plane(plain, pose, in_water).camera_move_mm is None
    # Mid plane follows from a board in the fluid.
    near_wall = replace(
        rig, board=replace(BOARD, medium="fluid"), channel=replace(CHANNEL, board_from_mid_plane_mm=-5.0)
    )
    advised = with_mid_plane(plain, pose, near_wall)
    # From the near wall it is 5 mm of water, for the camera 3.76 mm of air; what is missed is missed before and after.
    assert advised.camera_move_mm == pytest.approx(5.0 / 1.33)
    assert advised.mid_plane_z_mm == pytest.approx(pose.z0_mm)
    assert advised.mid_plane_z_sigma_mm == pytest.approx(pose.z0_sigma_mm)
    unmoved = replace(near_wall, channel=replace(near_wall.channel, camera_move_mm=0.0))
    assert with_mid_plane(plain, pose, unmoved).mid_plane_z_mm == pytest.approx(pose.z0_mm + 5.0)


@pytest.mark.parametrize("with_board", [False, True])
def test_summary_and_tree_bring_everything_back_without_nan(plain: Calibration, rig: Rig, with_board: bool) -> None:
    calibration = plain
    if with_board:
        pose = exact_pose(0.2)
        calibration = with_mid_plane(replace(plain, pose=pose), pose, rig)
    summary = calibration.summary()
    assert set(summary) == set(" ".join(MEASURED).split()) | {f"{name}_sigma" for name in UNCERTAIN.split()}
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    unknown = {name for name, value in summary.items() if value is None and not name.startswith("dlfc_")}
    assert (unknown == {"image_distance_mm", "image_distance_mm_sigma"}) == with_board
    assert summary["lenses"] == plain.fit.lenses
    tree = tree_of(calibration)
    assert all(isinstance(leaf, np.ndarray | int | float | str | None) for leaf in leaves(tree))
    back = calibration_of(tree)
    assert back.summary() == calibration.summary()
    assert back.image_shape == calibration.image_shape
    np.testing.assert_array_equal(back.transmission, calibration.transmission)
    for field in fields(LatticeFit):
        if field.name != "lattice_px":
            np.testing.assert_array_equal(getattr(back.fit, field.name), getattr(calibration.fit, field.name))
    image = white_image()
    np.testing.assert_array_equal(back.rectification.apply(image), calibration.rectification.apply(image))
    if with_board:
        np.testing.assert_array_equal(back.pose.dots_mm, calibration.pose.dots_mm)


def leaves(tree: dict[str, Any]) -> list[Any]:
    return [leaf for value in tree.values() for leaf in (leaves(value) if isinstance(value, dict) else [value])]


def test_a_tree_with_a_hole_and_a_board_of_another_shape_are_refused(plain: Calibration, rig: Rig) -> None:
    tree = tree_of(plain)
    del tree["lattice"]["indices"]
    with pytest.raises(InputError, match="not complete"):
        calibration_of(tree)
    with pytest.raises(InputError, match=r"\(180, 220\), \(3, 3\)"):
        calibrate(Photographs([white_image()], board=np.zeros((3, 3))), rig)


def test_the_camera_takes_the_upright_lattice_and_a_magnification_that_differs(plain: Calibration, rig: Rig) -> None:
    camera = plain.camera(rig.camera)
    micro_images = camera.micro_image_lattice_px()
    upright = plain.rectification.lattice_px
    np.testing.assert_allclose(micro_images.origin, upright.origin, atol=1e-9)
    np.testing.assert_allclose(micro_images.basis, upright.basis, atol=1e-9)
    assert camera.magnification == -1.0
    with pytest.raises(InputError, match=r"180 x 220.*181 x 220"):
        plain.camera(replace(rig.camera, rows=181))
    pose = exact_pose(0.0)
    within = replace(pose, magnification=-1.0 + 2 * pose.magnification_sigma)
    beyond = replace(pose, magnification=-1.0 + 5 * pose.magnification_sigma)
    assert replace(plain, pose=within).camera(rig.camera).magnification == -1.0
    assert replace(plain, pose=beyond).camera(rig.camera).magnification == beyond.magnification


@pytest.mark.thorough
def test_the_picture_shows_lattice_and_board(plain: Calibration, rig: Rig, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from lfpiv_cli.pictures.calibration import calibration_figure

    without = calibration_figure(plain, white_image())
    pose = exact_pose(0.2)
    full = calibration_figure(with_mid_plane(replace(plain, pose=pose), pose, rig), white_image(), white_image())
    full.savefig(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
    titles = [axis.get_title() for axis in full.axes]
    assert any("z = 0.200 mm" in title for title in titles)
    assert not any("z =" in axis.get_title() for axis in without.axes)
    # No title is wider than its panel, so that none runs over another one or over the colours beside it.
    full.draw_without_rendering()
    for axis in full.axes:
        assert axis.title.get_window_extent().width <= axis.get_window_extent().width, axis.get_title()


def test_the_summary_shows_residuals_and_dots_without_the_pictures(plain: Calibration, rig: Rig) -> None:
    pytest.importorskip("matplotlib")
    from lfpiv_cli.pictures.calibration import summary_figure

    pose = exact_pose(0.2)
    along_columns, _, passed, board = summary_figure(replace(plain, pose=pose)).axes[:4]
    residual = (plain.fit.centres_px - plain.fit.centres(plain.fit.indices))[:, 0]
    np.testing.assert_array_equal(along_columns.collections[0].get_array(), residual)
    np.testing.assert_array_equal(passed.images[0].get_array(), plain.transmission)
    np.testing.assert_array_equal(board.collections[0].get_offsets(), pose.dots_px)
    assert "z = 0.200 mm" in board.get_title()
    bare = summary_figure(replace(plain, transmission=None)).axes
    assert [axes.texts[0].get_text() for axes in bare if axes.texts] == ["transmission not measured", "no board"]


def test_each_view_is_named_by_its_point_and_none_is_black(plain: Calibration, rig: Rig) -> None:
    pytest.importorskip("matplotlib")
    from lfpiv_cli.pictures.calibration import views_figure

    panels = views_figure(plain, rig.camera, rig.media, white_image()).axes
    views = [axes for axes in panels if axes.get_title().startswith("X = ")]
    assert len(views) == 21
    assert {axes.get_title() for axes in views} >= {"X = 0, Y = 0 mm", "X = 10, Y = -5 mm"}
    assert min(axes.images[0].get_array().mean() for axes in views) > 100.0
    assert len({axes.images[0].get_clim() for axes in views}) == 1
    assert sum(axes.get_title().startswith("refocused at z = ") for axes in panels) == 5


@pytest.mark.thorough
def test_experiment(data_folder: Path, table2: Camera, water: Media) -> None:
    """Against the experiment's truth, from its pictures and data sheet alone."""
    folder = data_folder / "channel"
    truth = json.loads((folder / "truth.json").read_text())
    pictures = [
        cv2.imread(str(folder / f"{name}.tif"), cv2.IMREAD_UNCHANGED).astype(np.uint16)
        for name in ("white", "dark", "board")
    ]
    calibration = calibrate(
        Photographs(pictures[:1], *pictures[1:]), Rig(table2, water, BOARD, CHANNEL), DataSheet(camera=table2)
    )
    pose = calibration.pose
    assert len(pose.indices) == 49
    assert pose.z0_mm == pytest.approx(truth["board_z_mm"], abs=0.01)
    np.testing.assert_allclose(pose.tilt_deg, truth["board"]["tilt_deg"], atol=4 * pose.tilt_sigma_deg.max())
    np.testing.assert_allclose(pose.offset_mm, truth["board"]["offset"], atol=1e-3)
    assert pose.k1_per_mm2 == pytest.approx(truth["camera"]["k1"], rel=0.3)
    assert pose.k1_sigma_per_mm2 < 0.2 * truth["camera"]["k1"]
    assert pose.magnification == pytest.approx(truth["camera"]["M"], abs=2e-4)
    # 1 + s_mu/s_i is known to 3e-7 here, s_mu/s_i = 0.004 thus to 1e-4.
    assert calibration.image_distance_mm == pytest.approx(200.0, abs=0.1)
    assert calibration.camera_move_mm == pytest.approx(truth["eq21_d_m_mm"])
    assert calibration.mid_plane_z_mm == pytest.approx(truth["mid_plane_z_mm"], abs=0.02)


IMAGE_SHAPE = (220, 260)


def discs(centres: Floats, radius_px: float, shape: tuple[int, int] = IMAGE_SHAPE) -> Floats:
    """Draw bright discs with a rim one pixel wide, centred at (column, row)."""
    image = np.full(shape, 100.0)
    reach = int(radius_px) + 2
    for x, y in centres:
        row, column = int(round(y)), int(round(x))
        rows = np.arange(max(0, row - reach), max(0, min(shape[0], row + reach + 1)))[:, np.newaxis]
        columns = np.arange(max(0, column - reach), max(0, min(shape[1], column + reach + 1)))
        image[rows, columns] += 4000.0 * np.clip(radius_px + 0.5 - np.hypot(columns - x, rows - y), 0.0, 1.0)
    return image


def lens_centres(lattice: Lattice, shape: tuple[int, int] = IMAGE_SHAPE) -> Floats:
    """All lattice points that can touch the image."""
    reach = np.arange(-60, 61)
    points = lattice.points(np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2))
    margin = 2 * float(lattice.pitch.max())
    return points[((points > -margin) & (points < np.array(shape[::-1]) + margin)).all(axis=1)]


def disc_image(lattice: Lattice, rng: np.random.Generator, radius_per_pitch: float = 0.42) -> Floats:
    image = discs(lens_centres(lattice), radius_per_pitch * float(lattice.pitch[0]))
    return image + rng.normal(0.0, 40.0, image.shape)


def tilted(layout: str, pitch: float = 13.37, angle_deg: float = 3.0) -> Lattice:
    return Lattice.regular(pitch, layout, np.deg2rad(angle_deg), (127.3, 108.9))


def test_pitch_rotation_and_origin_are_found_from_the_lens_in_the_middle(layout: str, rng: np.random.Generator) -> None:
    truth = tilted(layout)
    fit = fit_lattice(disc_image(truth, rng), layout=layout)
    # 1 % noise moves a centroid by about 0.02 px; some 200 lenses over 100 px leave a tenth of the tolerances.
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, atol=2e-3)
    assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(3.0, abs=0.01)
    np.testing.assert_allclose(fit.lattice_px.origin, truth.points(truth.nearest(fit.lattice_px.origin)), atol=0.02)
    assert not fit.cubic_used
    assert np.all(fit.residual_px < 0.05)
    fit = fit_lattice(disc_image(tilted(layout), rng), layout=layout)
    middle = (np.array(IMAGE_SHAPE[::-1]) - 1) / 2
    distance = np.hypot(*(fit.centres_px - middle).T)
    np.testing.assert_array_equal(fit.indices[np.argmin(distance)], [0, 0])


@pytest.mark.parametrize(
    ("layout", "pitch", "angle_deg"), [("square", 8.0, 0.3), ("square", 10.0, 0.3), ("hexagonal", 8.12, 0.1)]
)
def test_whole_pixels_between_lens_images_are_no_distortion(
    layout: str, pitch: float, angle_deg: float, rng: np.random.Generator
) -> None:
    """As behind a telecentric lens, or where rows of hexagons are: a centroid's own error changes slowly over them."""
    truth = tilted(layout, pitch, angle_deg)
    fit = fit_lattice(disc_image(truth, rng, 0.48))
    assert not fit.cubic_used
    found = fit.centres(fit.indices)
    # The centroids themselves leave 0.02 to 0.035 px, and a cubic through them 0.1; 4 % noise leaves 0.003.
    assert np.abs(found - truth.points(truth.nearest(found))).max() < 0.008


@pytest.mark.thorough
@pytest.mark.parametrize("radius_per_pitch", [0.2, 0.45])
@pytest.mark.parametrize(("pitch", "angle_deg"), [(6.1, 2.7), (7.2, 44.0), (10.3, -41.0), (23.0, 20.0), (60.0, -2.0)])
def test_lattices_are_found_stopped_down_or_at_working_aperture(
    layout: str, pitch: float, angle_deg: float, radius_per_pitch: float, rng: np.random.Generator
) -> None:
    side = (480, 520) if pitch > 20.0 else (240, 280)
    truth = Lattice.regular(pitch, layout, np.deg2rad(angle_deg), (130.3, 120.9))
    image = discs(lens_centres(truth, side), radius_per_pitch * pitch, side) + rng.normal(0.0, 80.0, side)
    fit = fit_lattice(image)
    assert fit.lattice_px.layout == layout
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, rtol=3e-4)
    # On hexagons the first vector is within 30 degrees of the columns: -41 is seen as 19.
    turn = np.rad2deg(fit.lattice_px.rotation_rad) - angle_deg
    beyond = layout == "hexagonal" and abs(angle_deg) > 30.0
    assert turn == pytest.approx(-60.0 * np.sign(angle_deg) if beyond else 0.0, abs=0.03)


def test_pixels_behind_specks_are_known_and_noise_is_none(layout: str, rng: np.random.Generator) -> None:
    lattice = tilted(layout)
    row, column = np.indices(IMAGE_SHAPE)
    passing = np.ones(IMAGE_SHAPE)
    for i, j in ((-3, 2), (1, -4), (5, 1)):
        x, y = lattice.points((i, j))
        passing *= 1.0 - 0.3 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2.0 * 1.5**2))
    light = rng.poisson((discs(lens_centres(lattice), 5.5) - 100.0) * passing) + rng.normal(0.0, 40.0, IMAGE_SHAPE)
    found = shadowed(light, fit_lattice(light, layout=layout), np.ones(1))
    # Where a tenth is missing or more, and hardly where less than a hundredth is.
    assert found[passing < 0.9].all()
    assert found[passing > 0.99].sum() < 0.2 * found.sum()
    assert not shadowed(light / passing, fit_lattice(light, layout=layout), np.ones(1)).any()


def test_dirty_photographs(layout: str, rng: np.random.Generator) -> None:
    """Eight bits, speckle, dead lenses, dust, light that falls to a third on one side, lenses that the sensor cuts."""
    truth = tilted(layout)
    centres = lens_centres(truth)
    image = discs(centres[rng.random(len(centres)) > 0.05], 5.5)
    image *= rng.gamma(8.0, 1.0 / 8.0, IMAGE_SHAPE) * np.linspace(0.33, 1.0, IMAGE_SHAPE[1])
    for _ in range(15):
        row, column = rng.integers(0, IMAGE_SHAPE[0] - 6), rng.integers(0, IMAGE_SHAPE[1] - 6)
        image[row : row + 6, column : column + 6] = 50.0
    fit = fit_lattice(np.clip(image / 40.0, 0, 255).astype(np.uint8))
    assert fit.lattice_px.layout == layout
    within = np.sum(((centres > 6.0) & (centres < np.array(IMAGE_SHAPE[::-1]) - 7.0)).all(axis=1))
    assert fit.lenses > 0.85 * within
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, rtol=2e-3)
    error = fit.centres((0, 0)) - truth.points(truth.nearest(fit.centres((0, 0))))
    assert np.all(np.abs(error) < 0.15)


def test_cubic_distortion_is_found_and_plain_lattices_stay_plain(rng: np.random.Generator) -> None:
    truth = tilted("square")
    middle = (np.array(IMAGE_SHAPE[::-1]) - 1) / 2
    centres = lens_centres(truth)
    offset = centres - middle
    bent = centres + 1e-6 * offset * np.sum(offset**2, axis=1, keepdims=True)
    fit = fit_lattice(discs(bent, 5.2) + rng.normal(0.0, 40.0, IMAGE_SHAPE))
    assert fit.cubic_used
    assert np.all(fit.residual_px < 0.05)
    # A radial distortion of 3 px in the corners is no plain lattice.
    assert np.all(fit.residual_affine_px > 0.15)
    np.testing.assert_allclose(fit.centres(fit.indices), fit.centres_px, atol=0.2)


def test_dirt_missing_and_half_vignetted_lenses_do_not_bend_the_lattice(rng: np.random.Generator) -> None:
    truth = tilted("square")
    image = disc_image(truth, rng)
    image[60:75, 60:85] = 100.0
    image[150:158, 40:44] = 9000.0
    fit = fit_lattice(image)
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, atol=4e-3)
    assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(3.0, abs=0.02)
    # Lens images in the corners that the rim of the lens cuts on their outer side are not the lattice's distortion.
    truth = tilted("square")
    image = disc_image(truth, rng)
    row, column = np.indices(IMAGE_SHAPE)
    place = np.stack([column, row], axis=-1).astype(float)
    lens = truth.points(truth.nearest(place)) - (np.array(IMAGE_SHAPE[::-1]) - 1) / 2
    radius = np.hypot(lens[..., 0], lens[..., 1])
    outward = np.sum((place - (np.array(IMAGE_SHAPE[::-1]) - 1) / 2 - lens) * lens, axis=-1) / np.maximum(radius, 1.0)
    image[(radius > 145.0) & (outward > 2.0)] = 100.0
    fit = fit_lattice(image)
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, atol=2e-3)


@pytest.mark.thorough
def test_standard_errors_match_the_scatter_of_repeats(rng: np.random.Generator) -> None:
    turns, pitches = [], []
    for _ in range(20):
        angle, pitch = rng.uniform(-20.0, 20.0), rng.uniform(12.5, 13.5)
        fit = fit_lattice(
            discs(lens_centres(tilted("square", pitch, angle)), 5.6) + rng.normal(0.0, 250.0, IMAGE_SHAPE)
        )
        turns.append((fit.lattice_px.rotation_rad - np.deg2rad(angle)) / fit.rotation_sigma_rad)
        pitches.append((fit.lattice_px.pitch - pitch) / fit.pitch_sigma_px)
    # Twenty repeats (forty pitches) know a standard deviation to a sixth (a ninth).
    assert 0.6 < np.std(turns) < 1.6
    assert 0.6 < np.std(pitches) < 1.5


def test_the_walk_numbers_lenses_and_one_with_a_wrong_number_is_dropped() -> None:
    lattice = Lattice.regular(10.0, "square", 0.1, (3.0, 4.0))
    indices = np.array([(i, j) for i in range(-3, 4) for j in range(-2, 3) if (i, j) != (1, 0)])
    found, reached = index_spots(lattice.points(indices), 17, lattice.basis)
    assert reached.all()
    np.testing.assert_array_equal(found, indices - indices[17])
    indices = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
    points = lattice.points(indices)
    indices[17] += (1, 0)
    kept, _ = without_strays(indices, points, 10.0)
    np.testing.assert_array_equal(kept, np.delete(indices, 17, axis=0))


def test_images_that_cannot_serve_are_refused_with_advice(rng: np.random.Generator) -> None:
    image, noise = disc_image(tilted("square"), rng), rng.normal(100.0, 5.0, (2, *IMAGE_SHAPE))
    twelve_bits = np.clip(2.0 * image, 0.0, 4095.0).astype(np.uint16)
    for pictures, options, advice in (
        ((np.zeros(IMAGE_SHAPE),), {}, "one value everywhere"),
        ((rng.normal(1000.0, 30.0, IMAGE_SHAPE),), {}, "no lattice"),
        ((twelve_bits,), {}, "saturated.*less light"),
        ((twelve_bits << 4,), {}, "saturated.*less light"),
        ((np.minimum(image, 2000.0),), {}, "saturated.*less light"),
        (noise, {}, "more light"),
        ((np.where(image > 3900.0, np.nan, image),), {}, "not numbers"),
        ((image, image[:-1]), {}, "dark frame is"),
        ((image,), {"layout": "hexagonal"}, "shows a square array"),
    ):
        with pytest.raises(InputError, match=advice):
            fit_lattice(*pictures, **options)


def read(path: Path) -> Floats:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "lenses", "pitch", "tolerance"), [("seaurchin", 13500, 17.195, 0.02), ("guv", 650, 15.40, 0.02)]
)
def test_photographs(data_folder: Path, name: str, lenses: int, pitch: float, tolerance: float) -> None:
    folder = data_folder / "real"
    fit = fit_lattice(read(folder / f"{name}_white.tif"), read(folder / f"{name}_dark.tif"))
    assert fit.lenses >= lenses
    np.testing.assert_allclose(fit.lattice_px.pitch, pitch, atol=tolerance)
    assert fit.cubic_used
    assert np.all(fit.residual_px < (0.18, 0.13) if name == "seaurchin" else (0.02, 0.02))
    if name == "seaurchin":
        assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(0.177, abs=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["spots_b", "spots_c"])
def test_hexagonal_spots_with_known_centres(data_folder: Path, name: str) -> None:
    fit = fit_lattice(read(data_folder / "real" / f"{name}.png"))
    known = np.loadtxt(data_folder / "real" / f"{name}_centres.txt")[:, ::-1]
    error = fit.centres(fit.lattice_px.nearest(known)) - known
    assert np.hypot(*error.T).mean() < 0.03


@pytest.mark.thorough
def test_experiment_gives_the_true_rotation_and_shift(data_folder: Path) -> None:
    folder = data_folder / "channel"
    fit = fit_lattice(read(folder / "white.tif"), read(folder / "dark.tif"))
    # Made with 0.12 degrees and a shift of (3.4, -2.1) px at the array: 1 + s_mu/s_i = 1.004 of it on the sensor.
    assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(0.12, abs=0.002)
    on_axis = np.array([1175.5, 883.5]) + 1.004 * np.array([3.4, -2.1])
    np.testing.assert_allclose(fit.lattice_px.points(fit.lattice_px.nearest(on_axis)), on_axis, atol=0.02)
    assert not fit.cubic_used


@pytest.mark.parametrize("cubic_used", [False, True])
def test_a_shift_moves_all_lens_images_alike(rng: np.random.Generator, cubic_used: bool) -> None:
    fit = replace(fit_lattice(disc_image(tilted("square"), rng)), cubic_used=cubic_used)
    moved = fit.shifted(np.array([0.3, -0.2]))
    indices = np.array([(0, 0), (5, -3), (-4, 6)])
    np.testing.assert_allclose(moved.centres(indices) - fit.centres(indices), np.tile((0.3, -0.2), (3, 1)), atol=1e-10)
    np.testing.assert_allclose(moved.lattice_px.origin - fit.lattice_px.origin, (0.3, -0.2), atol=1e-10)
    off, before = moved.centres_px - moved.centres(moved.indices), fit.centres_px - fit.centres(fit.indices)
    np.testing.assert_allclose(off, before)
