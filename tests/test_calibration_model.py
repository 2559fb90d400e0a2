"""The calibration as one thing: Eq. 21, what goes into a file and comes back, what the camera takes from it."""

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
from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.model import Calibration, Channel, DataSheet, Photographs, Rig, calibrate, with_mid_plane
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
