"""Warnings: their one form, on the terminal, in JSON, in files and in Python; and planted faults that must be told."""

import json
import re
import warnings
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lfpiv_cli as lf
from lfpiv_cli.calibration import sheet
from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose
from lfpiv_cli.calibration.lattice import fit_lattice
from lfpiv_cli.calibration.light_checks import check_residual, residual_share, white_notices
from lfpiv_cli.calibration.sheet import board_notices, check_f_numbers, image_distance_notices, sheet_fit
from lfpiv_cli.calibration.white import lens_image_width
from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.batch import Target, pending
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.hdf5 import write_tree
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.particle_file import Points
from lfpiv_cli.files.provenance import earlier_record, with_warnings
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.grid import FOCAL_POINT
from lfpiv_cli.notice import Notice
from lfpiv_cli.optics.camera import Camera, Lattice, thin_lens
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.tracing import refraction_error_mm, sine_error_mm
from lfpiv_cli.synthetic.render import render_white
from lfpiv_cli.verbs.build_weights import plan_of
from lfpiv_cli.verbs.checks import doubt_notices, few_notices, still_notices
from lfpiv_cli.verbs.tracers import light_notices
from lfpiv_cli.verbs.weights_cost import cost_notices, cost_of
from tests.commands import AT_FOCUS, CONFIG, ROOT, SAMPLE, run, sample_rig, summary_of

SHAPE = (200, 240)
PITCH_PX = 14.2
RIG = """
camera:
  microlenses: {pitch_mm: 0.071, f_number: 8}
  sensor:      {pixel_um: 5.0, columns: 240, rows: 200}
"""
NOTICE = Notice("no-tracks", "a.vtkhdf", "no tracks", "look", 0.0, "some")


def white(
    radius_px: float = 6.5, jitter_px: float = 0.0, unevenness: float = 0.0, lit: float = 1.0
) -> NDArray[np.uint16]:
    """Return a white image of discs whose places and brightness differ at random, on a share of the columns."""
    lattice = Lattice.regular(PITCH_PX, "square", np.deg2rad(0.7), (117.3, 98.4))
    row, column = np.indices(SHAPE)
    place = np.stack([column, row], axis=-1).astype(float)
    index = lattice.nearest(place)
    lens = index - index.min(axis=(0, 1))
    rng = np.random.default_rng(3)
    moved = rng.normal(0.0, jitter_px, (*lens.max(axis=(0, 1)) + 1, 2))
    brightness = np.clip(rng.normal(1.0, unevenness, moved.shape[:2]), 0.3, 2.0)
    distance = np.linalg.norm(place - lattice.points(index) - moved[lens[..., 0], lens[..., 1]], axis=-1)
    disc = np.clip(radius_px + 0.5 - distance, 0.0, 1.0) * (np.abs(column - 120) < 0.5 * lit * SHAPE[1])
    image = 200.0 + 2e4 * brightness[lens[..., 0], lens[..., 1]] * disc
    return (image + rng.normal(0.0, 50.0, SHAPE)).astype(np.uint16)


def codes(picture: NDArray[np.uint16], folder: Path) -> list[str]:
    """Return the codes of what is warned of a white image, from Python."""
    (folder / "rig.yaml").write_text(RIG)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        lf.calibrate(picture, None, lf.load_rig(folder / "rig.yaml"))
    assert all(each.filename == __file__ for each in caught)
    return [each.message.notice.code for each in caught if isinstance(each.message, lf.LfpivWarning)]


def test_documents_list_all_codes() -> None:
    made = set()
    for path in (ROOT / "lfpiv_cli").rglob("*.py"):
        made |= set(re.findall(r'(?:\b(?:Notice|against)\(\s*|code=)"([^"]*)"', path.read_text(encoding="utf-8")))
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `([a-z-]+)` \|", page.split("## Warnings")[1].split("\n## ")[0], re.MULTILINE)
    assert sorted(listed) == sorted(made)


@pytest.mark.thorough
def test_a_warning_is_printed_in_json_and_in_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tiff(tmp_path / "white.tif", white(radius_px=2.5), overwrite=False)
    output = tmp_path / "c.h5"
    (tmp_path / "rig.yaml").write_text(RIG)
    rig, white_tif = tmp_path / "rig.yaml", tmp_path / "white.tif"
    command = ["calibrate-snapshot", rig, "--white", white_tif, "-o", output, "--overwrite"]

    def reported(*options: str) -> Any:
        run(*command, *options)
        return capsys.readouterr()

    printed = reported("--json")
    (warning,) = json.loads(printed.out)["warnings"]
    assert set(warning) == {"code", "about", "text", "remedy", "measured", "expected"}
    assert warning["code"] == "white-stopped-down"
    assert warning["measured"] == pytest.approx(5.0 / PITCH_PX, rel=0.1)
    line = f"lfpiv: warning: {warning['about']}: {warning['text']}; {warning['remedy']} [white-stopped-down]\n"
    assert printed.err == line
    assert line in reported().err
    assert reported("-q").err == ""
    record = earlier_record(output)
    assert record is not None
    assert record["warnings"] == [warning]
    assert open_calibration(output).transmission is None
    run("info", output, "--json")
    (recorded,) = json.loads(capsys.readouterr().out)["warnings_recorded"]
    assert recorded == f"calibrate-snapshot: {line.removeprefix('lfpiv: warning: ').strip()}"


def test_warnings_are_collected_and_recorded(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    Console(only_warnings=True).warn([NOTICE])
    Console(only_warnings=True, verbose=True).detail("more")
    assert capsys.readouterr().err == "lfpiv: warning: a.vtkhdf: no tracks; look [no-tracks]\n"
    target = Target(tmp_path / "a.vtkhdf", lambda: {"command": "track"})
    made = with_warnings(target.record, [NOTICE])
    assert made["warnings"] == [NOTICE.record()]
    assert with_warnings(target.record, []) == target.record
    write_tree(target.path, {}, format_name="lfpiv-tracks", format_version=1, provenance=made, overwrite=False)
    assert pending([target], [], False, True) == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({}, None),
        ({"radius_px": 4.6}, None),
        ({"radius_px": 2.5}, "white-stopped-down"),
        ({"jitter_px": 0.03 * PITCH_PX}, "lattice-residual"),
        ({"unevenness": 0.15}, "white-not-uniform"),
        ({"lit": 0.4}, "lattice-incomplete"),
    ],
)
def test_faults_of_a_white_image_are_told(fault: dict[str, float], code: str | None, tmp_path: Path) -> None:
    assert codes(white(**fault), tmp_path) == ([] if code is None else [code])


def test_width_of_lens_images_and_what_is_no_lattice(tmp_path: Path) -> None:
    lattice = Lattice.regular(PITCH_PX, "square", np.deg2rad(0.7), (117.3, 98.4))
    for radius in (2.5, 4.0, 6.0):
        # a disc's rim is a pixel wide, half of it beyond the radius
        found = lens_image_width(white(radius).astype(np.float32) - 200.0, lattice)
        assert found == pytest.approx(2.0 * radius / PITCH_PX, rel=0.03)
    with pytest.raises(InputError, match="off a lattice by .* not a white image"):
        codes(white(jitter_px=0.09 * PITCH_PX), tmp_path)
    # Microlenses whose focal length is a tenth off the data sheet's, either way.
    good = white() - 200.0
    for width, found in ((0.87, []), (0.9, []), (0.81, ["aperture-not-as-told"]), (0.99, ["aperture-not-as-told"])):
        assert [each.code for each in white_notices(good, fit_lattice(good), width, 0.9)] == found


def test_lens_images_of_long_microlenses_are_as_wide_as_the_data_sheet_says(table2: Camera) -> None:
    """They lie a tenth further apart than the microlenses, and fill as much less of their pitch."""
    distance = 0.1 * table2.image_distance_mm
    camera = replace(
        table2,
        columns=240,
        rows=200,
        microlens_distance_mm=distance,
        microlens_focal_length_mm=distance,
        aperture_mm=9.0 * float(table2.lattice.pitch[0]),
    )
    found = lens_image_width(render_white(camera, 1000.0).astype(np.float32), camera.micro_image_lattice_px())
    assert found == pytest.approx(camera.lens_image_fill, rel=0.03)
    assert found < 0.95 * camera.lens_image_width


def test_residuals_and_f_numbers_that_are_refused(table2: Camera) -> None:
    # The residual is that of the chosen model.
    fit = replace(sheet_fit(table2), residual_px=np.full(2, 0.1), residual_affine_px=np.full(2, 2.0))
    check_residual(replace(fit, cubic_used=True))
    assert residual_share(fit) == pytest.approx(2.0 / fit.lattice_px.pitch[0])
    with pytest.raises(InputError):
        check_residual(fit)
    assert table2.lens_image_width == pytest.approx(1.0)
    for factor, count in ((0.85, 0), (1.2, 0), (1.67, 1), (0.6, 1)):
        camera = replace(table2, aperture_mm=factor * table2.aperture_mm)
        check_f_numbers(camera)
        assert len(sheet.f_number_notices(camera)) == count
    for factor in (3.1, 0.3):
        with pytest.raises(ConfigError, match="aperture_mm: the main lens is f/"):
            check_f_numbers(replace(table2, aperture_mm=factor * table2.aperture_mm))


def fit_of(camera: Camera, stretch: float) -> Any:
    """Return the sheet's lattice with another pitch, as one that was measured."""
    fit = sheet_fit(camera)
    lattice = replace(fit.lattice_px, basis=fit.lattice_px.basis * stretch)
    return replace(fit, lattice_px=lattice, indices=np.zeros((100, 2), int), pitch_sigma_px=np.full(2, 1e-5))


def test_image_distance_is_that_of_the_exit_pupil(table2: Camera) -> None:
    # telecentric towards the array: no excess of the pitch
    assert image_distance_notices(fit_of(table2, 1.0 / table2.micro_image_scale), table2) == []
    assert image_distance_notices(fit_of(table2, 1.0), table2) == []
    for stretch in (1.002, 0.99):
        (notice,) = image_distance_notices(fit_of(table2, stretch), table2)
        assert notice.code == "image-distance"
    for entrance_over_exit in (1.25, 0.5, 0.0):
        camera = thin_lens(table2, entrance_over_exit)
        assert image_distance_notices(fit_of(camera, 1.0), camera) == []
        (notice,) = image_distance_notices(fit_of(camera, 1.002), camera)
        reported = 100.0 * (1.0 / entrance_over_exit + 1.0) if entrance_over_exit else np.inf
        assert notice.expected == ("an infinite one" if entrance_over_exit == 0.0 else f"{reported:.4g} mm")
        excess = 1.002 * (1.0 + 0.8 / reported) - 1.0
        assert notice.measured == pytest.approx(0.8 / excess)
        assert f"(pupil_ratio {0.8 / excess / 100.0 - 1.0:.3g} if all else is right)" in notice.remedy


def rig_of(folder: Path, *changes: tuple[str, str]) -> Config:
    """Return the sample's rig, z from the focal point, with pieces of its text replaced."""
    return load_rig(sample_rig(folder, AT_FOCUS, *changes))


def test_faults_of_a_rig_that_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"camera.sensor.pixel_um: is 0.0055: lens images would be .* px apart"):
        rig_of(tmp_path, ("pixel_um: 5.5", "pixel_um: 0.0055"))
    with pytest.raises(ConfigError, match="camera.sensor.pixel_um"):
        rig_of(tmp_path, ("pixel_um: 5.5", "pixel_um: 55"))
    (tmp_path / "rig.yaml").write_text(RIG)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lf.LfpivWarning)
        calibration = lf.calibrate(white(), None, lf.load_rig(tmp_path / "rig.yaml"))
    with pytest.raises(InputError, match=r"14.2 px apart and 18.25 px by the data sheet"):
        plan_of(rig_of(tmp_path), calibration)


@pytest.mark.parametrize(
    ("old", "new", "reported"),
    [
        ("", "", []),
        ("layout: square", "layout: hexagonal", []),
        # the sensor sees 3.3 mm
        ("shape_xyz: [30, 22, 40]", "shape_xyz: [35, 22, 40]", []),
        ("shape_xyz: [30, 22, 40]", "shape_xyz: [60, 22, 40]", ["volume-out-of-view"]),
        ("aperture_mm: 25.0", "aperture_mm: 41.0", ["f-numbers"]),
        # through 134 mm of water
        (
            "channel: {width_mm: 4.0, wall_mm: 2.0}",
            "window: {distance_mm: 98, thickness_mm: 2}",
            ["paraxial-refraction"],
        ),
        ("[30, 22, 40], voxel_mm: 0.1", "[1500, 1100, 400], voxel_mm: 0.002", ["heavy-work"]),
    ],
)
def test_faults_of_a_rig_are_told(old: str, new: str, reported: list[str], tmp_path: Path) -> None:
    plan = plan_of(rig_of(tmp_path, (old, new)), None)
    cost = cost_of(plan.settings, plan.camera, plan.source, plan.grid.padded(plan.padding))
    assert [each.code for each in (*plan.notices, *cost_notices(cost))] == reported


OBJECTIVE = """
camera:
  main_lens:   {magnification: -20.0, focal_length_mm: 10.0, aperture_mm: APERTURE}
  microlenses: {f_number: F_NUMBER, pitch_mm: 0.1}
  sensor:      {pixel_um: 5.5, columns: 600, rows: 448}
media:   {air: 1.0, window: 1.0, fluid: 1.0}
volume:  {shape_xyz: [10, 10, 10], voxel_mm: [0.005, 0.005, 0.1]}
"""


@pytest.mark.parametrize(("na", "reported"), [(0.1, []), (0.4, ["paraxial-lens"]), (0.8, None)])
def test_microscope_objectives(na: float, reported: list[str] | None, tmp_path: Path) -> None:
    aperture = 2.0 * 10.5 * np.tan(np.arcsin(na))
    rig = OBJECTIVE.replace("APERTURE", f"{aperture:.4f}").replace("F_NUMBER", f"{210.0 / aperture:.4f}")
    (tmp_path / "rig.yaml").write_text(rig)
    with pytest.raises(ConfigError, match=r"NA 0\.80.* at most 1 may be") if reported is None else nullcontext():
        assert [each.code for each in plan_of(load_rig(tmp_path / "rig.yaml"), None).notices] == reported


def test_refraction_and_sine_errors_are_those_of_two_rays(table2: Camera, water: Media, window: Window) -> None:
    # 0.085 mm of apparent depth at the edge of an f/4 lens through 134 mm of water, under the rim's slope
    error = refraction_error_mm(table2, water, window, np.zeros(1))
    assert error == pytest.approx(0.085 * 12.5 / 200.0, rel=0.05)
    assert refraction_error_mm(table2, Media(), None, np.array([-1.0, 0.0, 5.0])) < 1e-12
    # not known what is before the fluid: less than with it
    assert 0.0 < refraction_error_mm(table2, water, None, np.array([-5.0, 0.0])) < error
    tangent = 12.5 / 200.0
    sine = np.sin(np.arctan(tangent))
    assert sine_error_mm(table2, Media(), np.array([-3.0, 2.0])) == pytest.approx(3.0 * (tangent - sine))


def test_work_is_estimated_before_it_begins(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ("build-weights", sample_rig(tmp_path, AT_FOCUS), "-o", tmp_path / "w.h5")
    estimated = summary_of(capsys, *command, "--dry-run")
    assert not (tmp_path / "w.h5").exists()
    assert estimated["warnings"] == []
    made = summary_of(capsys, *command)
    weights = open_weights(tmp_path / "w.h5").weights.solver_operator
    held = sum(each.cell.nbytes + each.share.nbytes for each in (weights.columns, weights.rows))
    assert estimated["estimated_weights_bytes"] == pytest.approx(held + 4 * 600 * 448, rel=0.5)
    for name in ("voxels_xyz", "padding_xyz", "method"):
        assert estimated[name] == made[name]


def test_columns_on_demand_cost_more_than_factors(tmp_path: Path) -> None:
    square, hexagonal = (
        plan_of(rig_of(tmp_path, *changes), None) for changes in ([], [("layout: square", "layout: hexagonal")])
    )
    costs = [cost_of(each.settings, each.camera, each.source, each.grid) for each in (square, hexagonal)]
    assert costs[1].image_core_s > 10.0 * costs[0].image_core_s
    assert costs[1].weights_core_s == costs[1].weights_bytes == 0.0


@pytest.mark.parametrize(
    ("tracks", "wrong", "more", "reported"),
    [
        (100, 4.9, {}, []),
        (100, 5.1, {}, ["wrong-links"]),
        (4, 0.4, {}, []),
        (0, 0.0, {}, []),
        # a track of five places has four links
        (20, 3.9, {"tracked": 100, "noise_over_stated": [1.3, 2.9, 1.0]}, []),
        (20, 4.1, {"tracked": 100, "noise_over_stated": None}, ["wrong-links"]),
        (20, 0.0, {"tracked": 100, "noise_over_stated": [6.4, 1, 1]}, ["tracks-bend"]),
        (100, 0.0, {"light_b_over_a": 0.81}, []),
        (100, 0.0, {"light_b_over_a": 0.79}, ["light-unequal"]),
        (100, 0.0, {"light_b_over_a": 1.26}, ["light-unequal"]),
    ],
)
def test_doubtful_links_and_bends_are_told(
    tracks: int, wrong: float, more: dict[str, Any], reported: list[str]
) -> None:
    summary = {"tracks": tracks, "expected_wrong_links": wrong} | more
    assert [notice.code for notice in doubt_notices(summary, "a")] == reported


def test_one_image_twice_and_few_links_are_told() -> None:
    def tracks(velocity: float) -> Points:
        arrays = {"velocity": np.full((5, 3), velocity), "velocity_sigma": np.full((5, 3), 1e-3)}
        arrays["velocity_sigma"][0] = np.nan
        return Points(np.zeros((5, 3)), arrays, FOCAL_POINT, attributes={}, provenance={})

    assert [notice.code for notice in still_notices(tracks(1e-6), "a")] == ["frames-alike"]
    assert still_notices(tracks(1e-3), "a") == []
    for counts, staying, linked, codes in (
        ((60, 50), 50, 40, []),
        ((60, 50), 50, 20, ["few-links"]),
        # the others leave the view, as far as they move
        ((60, 50), 30, 20, []),
        ((5, 5), 5, 3, ["few-particles"]),
        ((7, 5), 5, 2, ["few-particles", "few-links"]),
        ((3, 3), 3, 1, ["few-particles"]),
    ):
        summary = {"tracks": linked, "expected_wrong_links": 0.0, "particles_staying": staying}
        assert [notice.code for notice in few_notices(counts, ("a", "b"), summary, tracks(1e-3))] == codes


def reported_of_board(
    camera: Camera, board: BoardGeometry, found: int, z_mm: float, magnification: float, tilt_deg: float = 0.0
) -> list[Notice]:
    """Return what is reported of a board of which so many points, row by row, were found, where the plane has them."""
    zeros, none = np.zeros((found, 3)), np.zeros(2)
    seen = (np.stack(np.divmod(np.arange(found), board.dots[0])[::-1], axis=1), zeros, zeros, zeros, zeros[:, :2])
    pose = BoardPose(*seen, z_mm, 0.0, np.array([0.0, tilt_deg]), none, 0.0, 0.0, none, none, magnification, 0.0)
    return list(board_notices(pose, board, camera, Media(1.0, 1.49, 1.33)))


def test_boards_with_doubts_are_told(table2: Camera) -> None:
    assert reported_of_board(table2, BoardGeometry((3, 3), 0.6, 0.2), 9, 5.0, -1.0) == []
    (reported,) = reported_of_board(table2, BoardGeometry((3, 2), 0.6, 0.2), 6, 5.0, -1.0)
    assert (reported.code, reported.measured) == ("board-few-points", 6.0)
    scale = table2.scale(Media())
    board, larger = (BoardGeometry((5, 4), 0.6, size * scale.lens_mm) for size in (0.7, 1.1))
    (reported,) = reported_of_board(table2, board, 20, -0.1 * scale.depth_mm, -1.0)
    assert reported.code == "board-within-lenses"
    assert reported.measured == pytest.approx(0.8)
    # To where light spreads over two lenses.
    assert "by 1 mm" in reported.remedy
    assert reported_of_board(table2, board, 20, -0.4 * scale.depth_mm, -1.0) == []
    assert reported_of_board(table2, larger, 20, 0.0, -1.0) == []
    board = BoardGeometry((5, 4), 0.6, 0.2)
    # Dots 0.5 mm apart that are said to be 0.6 show a magnification of 0.836.
    cases = (
        (19, -1.0, 0.0, []),
        (20, -1.0112, 0.0, ["magnification"]),
        (20, -1.009, 0.0, []),
        # One row that is not seen leaves the middle 0.6 mm of the board in doubt, by its tilt 0.016 mm of depth.
        (15, -1.0, 0.0, []),
        (15, -1.0, 1.5, []),
        (15, -1.0, 1.55, ["board-incomplete"]),
        (16, -1.0, 1.55, []),
        (10, -1.0, 0.0, ["board-incomplete"]),
        (20, -0.836, 0.0, ["magnification"]),
    )
    for found, magnification, tilt_deg, codes in cases:
        assert [each.code for each in reported_of_board(table2, board, found, 5.0, magnification, tilt_deg)] == codes


def told_of(**measured: object) -> list[Notice]:
    """Return what is told of particles that leave little light unexplained, but for what is measured."""
    little = {"residual": 0.05, "residual_rms_counts": 100.0, "read_noise_counts": 1.0, "particles_per_lens": 0.1}
    points = Points(np.zeros((80, 3)), {}, FOCAL_POINT, attributes=little | {"light": "rays"} | measured, provenance={})
    return list(light_notices(points, "a.vtkhdf"))


@pytest.mark.parametrize(
    ("measured", "code", "words"),
    [
        ({"residual": 0.09}, None, ""),
        ({"residual": 0.11}, "light-model", "give reconstruction.wavelength_nm"),
        ({"residual": 0.19, "residual_alike": 0.02}, None, ""),
        ({"residual": 0.09, "residual_alike": 0.4}, None, ""),
        ({"residual": 0.18, "residual_alike": 0.4, "residual_lit": 0.03}, None, ""),
        ({"residual": 0.09, "residual_alike": 0.6}, "light-model", "60% of what is left is alike in pixels"),
        ({"residual": 0.19, "light": "waves"}, "light-model", "wavelength_nm and diffusion_px"),
        ({"residual": 0.21}, "light-unexplained", ""),
        ({"residual": 0.4, "residual_smooth": 0.05}, None, ""),
        ({"residual": 0.4, "residual_smooth": 0.25}, "light-unexplained", "25% of the light"),
        ({"particles_per_lens": 0.0}, None, ""),
        ({"particles_per_lens": 1.99}, None, ""),
        ({"particles_per_lens": 2.01}, "particles-crowded", "2.01 particles for each microlens, at most 2"),
        ({"per_lens_in_focus": 1.49}, None, ""),
        ({"per_lens_in_focus": 1.51}, "particles-crowded", "focal plane 1.51 particles light each microlens, at most"),
        # Few were found of those that were counted.
        ({"particles_per_lens": 1.2, "tracers_per_lens": 1.9}, None, ""),
        ({"particles_per_lens": 1.2, "tracers_per_lens": 4.0}, "particles-crowded", "4 particles for each microlens, "),
        ({"particles_per_lens": 1.2, "tracers_per_lens": 4.0}, "particles-crowded", ", 1.2 found of 4"),
        ({"beyond_depths": 0.025}, None, ""),
        ({"beyond_depths": 0.0375}, "light-unexplained", "4% of the particles end at the first or last depth in which"),
        ({"depth_ambiguous": 0.24}, None, ""),
        ({"depth_ambiguous": 0.26}, "depth-ambiguous", "26% of the particles about as well, at most 25%"),
        ({"microlens_focus": 0.004, "microlens_focus_sigma": 0.0001}, None, ""),
        ({"microlens_focus": 0.02, "microlens_focus_sigma": 0.005}, None, ""),
        ({"microlens_focus": 0.02, "microlens_focus_sigma": 0.001}, "microlens-focus", "2.0% longer than the rig says"),
        ({"microlens_focus": -0.02, "microlens_focus_sigma": 0.001}, "microlens-focus", "2.0% shorter than the rig"),
        ({"microlens_focus": -0.006, "microlens_focus_sigma": 0.001}, "microlens-focus", "at most 0.5%"),
    ],
)
def test_what_light_tells_of_particles(measured: dict[str, Any], code: str | None, words: str) -> None:
    found = told_of(**measured)
    assert [notice.code for notice in found] == ([] if code is None else [code])
    assert all(words in f"{notice.text}; {notice.remedy}" for notice in found)


def test_crowded_tracers_seem_to_show_another_focal_length() -> None:
    for off, crowd, is_told in ((-0.006, 0.5, True), (-0.019, 4.0, False), (-0.03, 4.0, True), (0.03, 4.0, True)):
        focus = {"microlens_focus": off, "microlens_focus_sigma": 0.001}
        found = {notice.code for notice in told_of(particles_per_lens=1.0, tracers_per_lens=crowd, **focus)}
        assert ("microlens-focus" in found) == is_told


@pytest.mark.thorough
def test_without_a_board_the_data_sheet_is_believed() -> None:
    rig = lf.load_rig(CONFIG)
    white, dark, board = (lf.read_image(SAMPLE / f"{name}.tif") for name in ("white", "dark", "board"))
    with pytest.warns(lf.LfpivWarning, match="no-board"):
        lf.calibrate(white, None, rig, dark=dark)
    with warnings.catch_warnings():
        warnings.simplefilter("error", lf.LfpivWarning)
        lf.calibrate(white, board, rig, dark=dark)
