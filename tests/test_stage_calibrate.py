"""The stage of calibrate-snapshot with small pictures: which white image serves for what, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, UsageError
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot

SHAPE = (200, 240)
CONFIG = """
camera:
  microlenses: {{pitch_mm: {pitch}, {layout}}}
  sensor:      {{pixel_um: 5.0, columns: 240, rows: 200}}
"""
QUIET = Console(quiet=True)


def white(path: Path, lattice: Lattice, radius_px: float) -> Path:
    row, column = np.indices(SHAPE)
    place = np.stack([column, row], axis=-1).astype(float)
    distance = np.linalg.norm(place - lattice.points(lattice.nearest(place)), axis=-1)
    image: NDArray[Any] = 200.0 + 20000.0 * np.clip(radius_px + 0.5 - distance, 0.0, 1.0)
    noise = np.random.default_rng(3).normal(0.0, 50.0, SHAPE)
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


def test_layout_is_found_and_checked_when_given(tmp_path: Path) -> None:
    hexagons = Lattice.regular(14.2, "hexagonal", np.deg2rad(0.7), (117.3, 98.4))
    picture = white(tmp_path / "w.tif", hexagons, 5.5)
    assert calibrated(tmp_path, config(tmp_path), [picture])["layout"] == "hexagonal"
    with pytest.raises(InputError, match="shows a hexagonal array, and microlenses.layout is square"):
        calibrated(tmp_path, config(tmp_path, layout="layout: square"), [picture])


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


def test_another_pitch_than_the_data_sheets_is_refused(tmp_path: Path, square: Lattice) -> None:
    picture = white(tmp_path / "w.tif", square, 5.5)
    assert calibrated(tmp_path, config(tmp_path, pitch=0.0745), [picture])["lenses"] > 150
    with pytest.raises(InputError, match=r"14\.2 px apart and 15 px by the data sheet, 5 % off.*pixel_um"):
        calibrated(tmp_path, config(tmp_path, pitch=0.075), [picture])


def test_no_picture_is_a_slip_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--white, --board or both"):
        calibrated(tmp_path, config(tmp_path), [])


def test_a_known_focus_needs_no_board(tmp_path: Path, square: Lattice) -> None:
    """The mid plane is where it is told to be; a board measures it."""
    rig, picture = config(tmp_path), white(tmp_path / "w.tif", square, 5.5)
    options = CalibrateOptions(white=[picture], depth_mm=[-0.35])
    with pytest.raises(ConfigError, match="section `channel` is missing"):
        calibrate_snapshot(rig, tmp_path / "c.h5", options, console=QUIET)
    rig.write_text(rig.read_text() + "channel: {width_mm: 4.0, wall_mm: 2.0}\n")
    figures = calibrate_snapshot(rig, tmp_path / "c.h5", options, console=QUIET)
    assert (figures["mid_plane_z_mm"], figures["mid_plane_z_mm_sigma"], figures["mid_plane_given"]) == (
        -0.35,
        None,
        True,
    )
    assert open_calibration(tmp_path / "c.h5").summary() == figures
    with pytest.raises(UsageError, match="0 --board and 2 --depth-mm"):
        calibrate_snapshot(rig, tmp_path / "d.h5", replace(options, depth_mm=[0.0, 1.0]), console=QUIET)
    with pytest.raises(UsageError, match="a depth of nan mm"):
        calibrate_snapshot(rig, tmp_path / "d.h5", replace(options, depth_mm=[np.nan]), console=QUIET)


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
