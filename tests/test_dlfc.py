"""Rays fitted to boards at several depths, against rays traced through the camera that saw them; and their files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tifffile
import yaml
from click.testing import CliRunner

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.dlfc import SeenBoard, aligned, entrance_pupil_mm, fit_rays, shown
from lfpiv_cli.calibration.sheet import entrance_pupil_notices
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError, LfpivError
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.optics.camera import Lattice, thin_lens
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points, trace
from lfpiv_cli.synthetic import board as synthetic_board
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from tests.known_rays import slopes_equivalent

BOARD = BoardGeometry((5, 4), 0.5, 0.2, medium="fluid")
DEPTHS = (-4.0, -1.0, 1.5, 5.0)
LEVEL = 20_000.0


@pytest.fixture(autouse=True)
def _few_rays(monkeypatch):
    monkeypatch.setattr(synthetic_board, "RAYS_PER_POINT", 150)  # 40,000 a dot, some 400 a lit pixel


def small(camera, columns=520, rows=440):
    lattice = Lattice.regular(0.1, camera.lattice.layout, 0.0, (0.013, -0.021))
    return replace(camera, columns=columns, rows=rows, lattice=lattice)


def pictures(camera, media, rng, places, board=BOARD):
    space = ObjectSpace(media, None, "paraxial")
    return [render_board(camera, space, board, place, LEVEL, rng) for place in places]


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_fitted_rays_meet_the_array_where_traced_ones_do_eq_1(camera, water, rng, column_axis):
    seen_by = replace(small(camera), distortion_per_mm2=2e-3, column_axis=column_axis)
    if column_axis == "y":
        seen_by = replace(seen_by, columns=440, rows=520)
    places = [BoardPlacement(z, (0.05, -0.03), rotation_deg=1.5) for z in DEPTHS]
    told = replace(seen_by, distortion_per_mm2=0.0)  # the data sheet knows nothing of it
    fit = fit_rays(pictures(seen_by, water, rng, places), DEPTHS, told, BOARD, water)
    assert fit.rays.degree == 3
    assert fit.sightings > 13_900  # of 14,160: 20 dots, 4 boards, 177 views
    points = seen_by.to_image_axes(rng.uniform((-0.8, -0.5, -4.0), (0.8, 0.5, 5.0), (500, 3)))
    lens = disc_points(500, 10.0, rng)
    truth = trace(seen_by, lens, slopes_equivalent(points, lens, seen_by, water)).array_mm
    # One sighting is off by 2.5 um, by the dot's phase against the microlenses, which views share: 80 dots and 56 terms
    # leave 0.6. The distortion moves rays by up to 2 um, the board's turn by 20.
    error = fit.rays.on_array(points, lens) - truth
    assert np.sqrt(np.mean(error**2)) < 0.9e-3


@pytest.mark.thorough
def test_boards_at_several_depths_show_the_entrance_pupil_and_rays_are_fitted_behind_it(table2, water, rng):
    """A lens of P = 1.3, told as a thin one: its entrance pupil is 100 (1/1.3 + 1) = 176.9 mm away, not 200."""
    told = replace(small(table2), aperture_mm=22.0)
    seen_by = thin_lens(told, 1.0 / 1.3)
    images = pictures(seen_by, water, rng, [BoardPlacement(z, (0.05, -0.03)) for z in DEPTHS])
    told = told.with_micro_images(seen_by.micro_image_lattice_px())  # as a white image has it
    fit = fit_rays(images, DEPTHS, told, BOARD, water)
    assert 0.3 < fit.entrance_pupil_sigma_mm < 1.5
    assert fit.entrance_pupil_mm == pytest.approx(100.0 / 1.3 + 100.0, abs=2.0 * fit.entrance_pupil_sigma_mm)
    camera = fit.behind_its_pupil(told)
    assert camera.focus_distance_mm == pytest.approx(fit.entrance_pupil_mm, rel=1e-12)
    assert fit.behind_its_pupil(camera) is camera
    points = rng.uniform((-0.8, -0.5, -4.0), (0.8, 0.5, 5.0), (500, 3))
    lens = disc_points(500, 10.0, rng)
    truth = trace(seen_by, lens, slopes_equivalent(points, lens, seen_by, water)).array_mm
    # The crossings of the thin lens are an eighth too far out: rays were off by 7 um.
    error = fit.rays.on_array(points, lens) - truth
    assert np.sqrt(np.mean(error**2)) < 0.9e-3
    (notice,) = entrance_pupil_notices(fit.entrance_pupil_mm, fit.entrance_pupil_sigma_mm, told)
    assert "pupil_ratio (1.3 if all else is right)" in notice.remedy


@pytest.mark.parametrize("entrance_over_exit", [1.25, 1.0, 0.6, 0.0])
def test_the_entrance_pupil_follows_from_how_boards_shrink(table2, rng, entrance_over_exit):
    camera = thin_lens(replace(table2, magnification=-0.6), entrance_over_exit)
    plate = rng.uniform(-2.0, 2.0, (9, 2))
    dot, crossing = np.repeat(np.arange(9), 20), rng.uniform(-9.0, 9.0, (180, 2))
    boards = []
    for z in (-4.0, -1.5, 2.0, 6.0):
        distance = camera.focus_distance_mm + (z + 0.7) / 1.33  # depths count from anywhere
        turned = np.stack([plate[:, 0] - 0.01 * plate[:, 1], plate[:, 1] + 0.01 * plate[:, 0]], axis=1) / np.hypot(
            1, 0.01
        )
        forward = camera.image_distance_mm / distance
        array = camera.defocus(distance) * crossing - forward * (turned + (0.3, -0.2))[dot]
        boards.append(shown(z, plate, dot, 1.1 * crossing, array))
    found, sigma = entrance_pupil_mm(boards, 1.0 / 1.33)
    assert found == pytest.approx(100.0 * (entrance_over_exit + 1.0 / 0.6), rel=1e-9)
    assert 0.0 < sigma < 0.01 * found
    assert entrance_pupil_mm(boards[:2], 1.0 / 1.33) is None
    assert entrance_pupil_mm([each * (-1.0, 1.0, 1.0, 1.0) for each in boards], 1.0 / 1.33) is None


@pytest.mark.thorough
def test_three_depths_give_degree_two_and_two_are_refused(table2, water, rng):
    camera = small(table2)
    images = pictures(camera, water, rng, [BoardPlacement(z) for z in (-4.0, 0.5, 5.0)])
    assert fit_rays(images, (-4.0, 0.5, 5.0), camera, BOARD, water).rays.degree == 2
    with pytest.raises(InputError, match="boards at 2 different depths"):
        fit_rays(images[:2], (-4.0, 0.5), camera, BOARD, water)
    with pytest.raises(InputError, match="the board at 2 mm"):
        fit_rays([np.zeros_like(images[0]), *images[1:]], (2.0, 0.5, 5.0), camera, BOARD, water)
    narrow = replace(BOARD, dots=(5, 2))
    images = pictures(camera, water, rng, [BoardPlacement(z) for z in DEPTHS], narrow)
    with pytest.raises(InputError, match="5 x 2 dots"):
        fit_rays(images, DEPTHS, camera, narrow, water)


def test_boards_that_lost_dots_are_numbered_as_the_others():
    index = np.stack(np.meshgrid(np.arange(5), np.arange(4), indexing="ij"), axis=-1).reshape(-1, 2)
    place = 0.5 * (index - np.array([2.0, 1.5])) + (0.02, 0.01)
    lost = index[:, 0] > 0  # its first column; the others were numbered from 0
    boards = [SeenBoard(np.zeros((1, 1)), z, 0.0, 1.0, place, index) for z in (-1.0, 1.0)]
    boards.append(SeenBoard(np.zeros((1, 1)), 2.0, 0.0, 1.0, place[lost], index[lost] - (1, 0)))
    np.testing.assert_array_equal(aligned(boards, BOARD)[2].index, index[lost])


RIG = {
    "camera": {
        "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
        "microlenses": {"pitch_mm": 0.1, "focal_length_mm": 0.8},
        "sensor": {"pixel_um": 5.5, "columns": 520, "rows": 440},
    },
    "media": {"air": 1.0, "window": 1.49, "fluid": 1.33},
    "board": {"dots": [5, 4], "spacing_mm": 0.5, "dot_diameter_mm": 0.2, "medium": "fluid"},
    "volume": {"shape_xyz": [5, 4, 3], "voxel_mm": 0.1, "centre_mm": [0.3, -0.2, 3.0]},
    "reconstruction": {"padding_voxel": [0, 0, 0]},
}


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(RIG))
    return path


def run(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.mark.thorough
def test_from_boards_at_depths_to_columns(rig, tmp_path, table2, water, rng):
    lattice = table2.lattice
    camera = replace(table2, columns=520, rows=440, lattice=lattice)
    boards = []
    for z, image in zip(DEPTHS, pictures(camera, water, rng, [BoardPlacement(z) for z in DEPTHS]), strict=True):
        path = tmp_path / f"board{z}.tif"
        tifffile.imwrite(path, np.rint(image).astype(np.uint16))
        boards += ["--board", path, "--depth-mm", z]
    assert run("calibrate-snapshot", rig, *boards, "-o", tmp_path / "c.h5").exit_code == 0
    told = ("build-weights", rig, "--calibration", tmp_path / "c.h5")
    for method in ("ert", "dlfc"):
        made = run(*told, "--method", method, "-o", tmp_path / method)
        assert made.exit_code == 0, made.output
    columns = []
    for method in ("ert", "dlfc"):
        weights = open_weights(tmp_path / method)
        assert not weights.weights.on_demand
        image = np.zeros(weights.image_shape)
        row, column, share = weights.column(2, 1, 3)
        image[row, column] = share
        columns.append(image)
    # What is left of 0.1 to 0.3 um on the array, and of two ways to integrate.
    assert np.abs(columns[0] - columns[1]).sum() < 0.06


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["calibrate-snapshot", "{rig}", "--board", "a.tif", "--board", "b.tif", "-o", "c.h5"], 2, "with its depth"),
        (
            ["calibrate-snapshot", "{rig}", "--white", "a.tif", "--depth-mm", "1", "--depth-mm", "2", "-o", "c.h5"],
            2,
            "0 --board and 2",
        ),
        (["build-weights", "{rig}", "--method", "dlfc", "-o", "w.h5"], 3, "boards at several depths"),
        (
            ["build-weights", "{rig}", "--method", "dlfc", "--refraction", "exact", "-o", "w.h5"],
            3,
            "no refraction besides",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(rig, arguments, code, message):
    result = run(*(argument.format(rig=rig) for argument in arguments))
    assert isinstance(result.exception, LfpivError)
    assert result.exception.exit_code == code
    assert message in str(result.exception)
