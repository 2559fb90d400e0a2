"""Measures of reconstructed boards: Eqs. 17 to 20 on volumes whose figures are known."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.grid import Grid
from lfpiv_cli.validation.board import DEPTH_DEFINITIONS, board_figures, elongation_mm, gaussian_centre_mm, measure_dots

CONFIG = Path(__file__).parent.parent / "configs" / "table2.yaml"
GRID = Grid.centred((30, 20, 60), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
CENTRES = np.array([(x, y) for y in (-0.5, 0.5) for x in (-1.0, 0.0, 1.0)])


def board(z_mm: float, sigma_mm: float = 0.5, spacing: float = 1.0) -> np.ndarray:
    """A volume of 3 x 2 Gaussian dots."""
    z, y, x = np.meshgrid(*(GRID.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    lateral = sum(np.exp(-((x - cx * spacing) ** 2 + (y - cy) ** 2) / (2 * 0.12**2)) for cx, cy in CENTRES)
    return (lateral * np.exp(-0.5 * ((z - z_mm) / sigma_mm) ** 2)).astype(np.float32)


def test_elongation_of_a_gaussian_is_its_width_at_1_over_e():
    z = np.linspace(-3.0, 3.0, 61)
    # exp(-z^2 / 2 s^2) = 1/e at z = s sqrt 2; straight lines between samples err by less than a hundredth of a sample
    assert elongation_mm(z, np.exp(-0.5 * ((z - 0.13) / 0.5) ** 2)) == pytest.approx(2 * np.sqrt(2) * 0.5, abs=0.005)


def test_elongation_ends_at_the_volume():
    z = np.linspace(0.0, 1.0, 11)
    assert elongation_mm(z, np.ones(11)) == pytest.approx(1.0)


def test_gaussian_centre_between_samples():
    z = np.linspace(-3.0, 3.0, 61)
    assert gaussian_centre_mm(z, 5.0 * np.exp(-0.5 * ((z - 0.137) / 0.7) ** 2)) == pytest.approx(0.137, abs=1e-6)


def test_every_definition_finds_the_middle_of_an_even_dot():
    z = np.linspace(-3.0, 3.0, 61)
    profile = 5.0 * np.exp(-0.5 * ((z - 0.137) / 0.7) ** 2)
    for name, definition in DEPTH_DEFINITIONS.items():
        # masses above a threshold err by a part of a sample
        assert definition.depth_mm(z, profile) == pytest.approx(0.137, abs=0.015), name


def test_definitions_differ_for_a_dot_with_a_tail():
    z = np.linspace(-3.0, 3.0, 61)
    profile = np.exp(-0.5 * (z / 0.3) ** 2) + 0.6 * np.exp(-0.5 * ((z - 0.8) / 0.5) ** 2)
    depths = {name: definition.depth_mm(z, profile) for name, definition in DEPTH_DEFINITIONS.items()}
    assert depths["three_point"] < 0.1 < depths["gaussian_peak"] < depths["gaussian"]
    assert depths["middle"] > depths["mass"] > 0.3


@pytest.mark.parametrize("lit", [slice(30, 31), slice(0, 1), slice(60, 61), slice(0, 61)])
def test_definitions_of_profiles_without_a_width(lit, recwarn):
    z = np.linspace(-3.0, 3.0, 61)
    profile = np.zeros(61)
    profile[lit] = 1.0
    for name, definition in DEPTH_DEFINITIONS.items():
        assert z[lit].min() - 0.05 <= definition.depth_mm(z, profile) <= z[lit].max() + 0.05, name
    assert not recwarn.list


def test_figures_of_boards_eqs_17_to_20():
    # true steps of 1 mm measured as 1.1 mm: depth error 10 %; spacing 1.02 mm: lateral error 2 %
    dots = [measure_dots(board(1.1 * z, spacing=1.02), GRID, CENTRES, 0.5) for z in (-1.0, 0.0, 1.0)]
    figures = board_figures(dots, (-1.0, 0.0, 1.0), (3, 2), 1.0)
    assert figures["depth_error"] == pytest.approx(0.10, abs=1e-4)
    assert figures["depth_error_mass"] == pytest.approx(0.10, abs=0.02)
    assert figures["depth_definitions"]["gaussian"] == pytest.approx({"error": 0.1, "shortest": 1.1, "longest": 1.1})
    assert figures["lateral_error"] == pytest.approx(0.02, abs=0.002)
    assert figures["elongation_mm"] == pytest.approx(np.sqrt(2), abs=0.01)
    assert figures["elongation_sigma_mm"] == pytest.approx(0.0, abs=0.01)


def test_a_board_without_light_is_refused():
    with pytest.raises(InputError, match="no light"):
        measure_dots(np.zeros(GRID.shape_zyx, np.float32), GRID, CENTRES, 0.5)


@pytest.mark.slow
def test_validate_board_on_a_small_camera(tmp_path):
    text = CONFIG.read_text()
    for old, new in (
        ("columns: 2352", "columns: 520"),
        ("rows: 1768", "rows: 520"),
        ("shape_xyz: [80, 80, 240]", "shape_xyz: [24, 24, 120]"),
        ("voxel_mm: 0.1 ", "voxel_mm: [0.1, 0.1, 0.2] "),
        ("dots: [7, 7]", "dots: [3, 3]"),
        ("spacing_mm: 1.0", "spacing_mm: 0.7"),
        ("solver: sart", "solver: em"),
        ("iterations: 200", "iterations: 8"),
        ("rotation_deg: 0.0   ", "rotation_deg: 0.4   "),
        ("shift_px: [0.0, 0.0]  ", "shift_px: [5.0, -4.0]  "),
        ("images: ideal", "images: both"),
        ("methods: [ert, dlfc]", "methods: [ert, dlfc, discs]"),
    ):
        assert old in text, old
        text = text.replace(old, new)
    small = tmp_path / "small.yaml"
    small.write_text(text)
    cli.main(["validate", "board", str(small), "-o", str(tmp_path / "report")], standalone_mode=False)
    report = json.loads((tmp_path / "report" / "board.json").read_text())["figures"]
    for half, method in product(("ideal", "recorded"), ("ert", "dlfc")):
        assert report[half][method]["lateral_error"] < 0.02
        assert report[half][method]["depth_error"] < 0.3
        assert (tmp_path / "report" / f"board_{half}_{method}.png").stat().st_size > 10_000
        assert report[half]["discs"]["depth_error"] < 0.02
        assert report[half]["discs"]["lateral_error"] < 0.002
    centres = {str(each["by_depth"]["centre_mm"]) for half in report.values() for each in half.values()}
    assert len(centres) == 6


def test_a_volume_too_thin_for_boards_is_refused(tmp_path):
    text = CONFIG.read_text().replace("shape_xyz: [80, 80, 240]", "shape_xyz: [80, 80, 18]")
    thin = tmp_path / "thin.yaml"
    thin.write_text(text)
    with pytest.raises(ConfigError, match="holds 1 of the boards"):
        cli.main(["validate", "board", str(thin), "-o", str(tmp_path / "report")], standalone_mode=False)
