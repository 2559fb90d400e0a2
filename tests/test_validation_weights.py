"""The comparison of columns: SSIM by hand, limits, and the voxels of the paper."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.validation.weights import (
    GREY_LEVELS,
    WINDOW_RADIUS_PX,
    Column,
    columns_figure,
    compare_columns,
    make_columns,
    similarity_figure,
    ssim,
    weights_figures,
    weights_limits_missed,
)

VOXEL, CENTRES = Grid((1, 1, 1), (0.1,) * 3, (0.3, -0.2, 3.0)), np.array([(0.3, -0.2, 3.0)])


def test_ssim_of_constants_eq_16():
    # Constant images have no variance: only the means are left, (2 a b + c1) / (a^2 + b^2 + c1) with c1 = 2.55^2.
    size = 4 * WINDOW_RADIUS_PX + 1
    a, b = np.full((size, size), 100.0), np.full((size, size), 150.0)
    border = WINDOW_RADIUS_PX
    c1 = (0.01 * GREY_LEVELS) ** 2
    expected = (2 * 100 * 150 + c1) / (100**2 + 150**2 + c1)
    middle = np.pad(a, border), np.pad(b, border)  # zeros around: windows at the edge see them, the middle does not
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(*middle) < 1.0
    assert _local_ssim_at_middle(*middle) == pytest.approx(expected, rel=1e-6)


def _local_ssim_at_middle(a: np.ndarray, b: np.ndarray) -> float:
    """Return Eq. 16 in the middle's window, written out: Gaussian weights of sigma 1.5 on 11 x 11 pixels."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    weight = np.outer(line, line) / line.sum() ** 2
    row, column = a.shape[0] // 2, a.shape[1] // 2
    part = np.s_[row - 5 : row + 6, column - 5 : column + 6]
    mean = [np.sum(weight * image[part]) for image in (a, b)]
    moments = [np.sum(weight * first[part] * second[part]) for first, second in ((a, a), (b, b), (a, b))]
    variance_a, variance_b = moments[0] - mean[0] ** 2, moments[1] - mean[1] ** 2
    covariance = moments[2] - mean[0] * mean[1]
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    return float(
        (2 * mean[0] * mean[1] + c1)
        * (2 * covariance + c2)
        / ((mean[0] ** 2 + mean[1] ** 2 + c1) * (variance_a + variance_b + c2))
    )


def test_ssim_is_the_mean_of_local_windows_eq_16(rng):
    # One pixel has one window; zeros beyond the edge count as pixels.
    a, b = 255.0 * rng.random((1, 1)), 255.0 * rng.random((1, 1))
    assert ssim(a, b) == pytest.approx(_local_ssim_at_middle(np.pad(a, 5), np.pad(b, 5)), rel=1e-9)


def test_figures_of_a_column_by_hand():
    reference = np.array([[0.5, 0.25], [0.25, 0.0]])
    image = np.array([[0.5, 0.25], [0.15, 0.1]])
    figures = compare_columns(reference, image)
    assert figures["l1"] == pytest.approx(0.2)
    assert figures["rmse_grey"] == pytest.approx(510.0 * np.sqrt(0.02 / 4))


def test_limits_are_lower_ones_on_ssim_and_upper_ones_elsewhere():
    figures = {"a": {"ssim_smallest": 0.9, "l1_mean": 0.02}, "b": None}
    assert weights_limits_missed(figures, {"a": {"ssim_smallest": 0.8, "l1_mean": 0.03}, "b": {"l1_mean": None}}) == []
    assert (
        len(weights_limits_missed(figures, {"a": {"ssim_smallest": 0.95, "l1_mean": 0.01}, "b": {"l1_mean": 0.1}})) == 3
    )


@pytest.mark.thorough
def test_every_way_agrees_within_its_error(table2, water, window, rng):
    camera = replace(table2, columns=380, rows=260)
    columns = make_columns(camera, ObjectSpace(water, window), VOXEL, CENTRES, rng, np.array([200_000]))
    figures = weights_figures(columns, np.array([200_000]))
    assert figures["ert_to_drt_paraxial"]["l1_largest"] < 1e-6
    assert figures["ert_exact_to_drt_exact"]["l1_largest"] < 1e-6
    assert 0.02 < figures["ert_to_drt_exact"]["l1_largest"] < 0.07  # the aberration of 134 mm of water
    assert figures["factorised_to_converged"]["l1_largest"] < 0.02
    assert figures["coarser_to_converged"]["l1_largest"] < 0.002
    # 2000 points of 100 rays: about three times the error of 200,000 independent rays.
    expected = figures["voxels"][0]["independent_rays_l1"]
    assert figures["ert_exact_to_long_count"]["l1_largest"] < 4.0 * expected


@pytest.mark.thorough
def test_a_hexagonal_array_is_judged_without_the_factorised_form(table2, water, rng):
    camera = replace(table2, columns=380, rows=260, lattice=Lattice.regular(0.1, "hexagonal"))
    columns = make_columns(camera, ObjectSpace(water), VOXEL, CENTRES, rng, np.array([0]))
    figures = weights_figures(columns, np.array([0]))
    assert figures["factorised_to_converged"] is None
    assert figures["ert_to_drt_exact"] is None
    assert figures["ray_count_to_converged"]["l1_largest"] < 0.1


@pytest.mark.thorough
def test_validate_weights_writes_its_report_and_fails_on_a_limit(tmp_path):
    config = {
        "camera": {
            "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
            "microlenses": {"pitch_mm": 0.1, "focal_length_mm": 0.8},
            "sensor": {"pixel_um": 5.5, "columns": 1200, "rows": 100},
        },
        "media": {"air": 1.0, "window": 1.49, "fluid": 1.33},
        "volume": {"shape_xyz": [10, 1, 3], "voxel_mm": 0.1},
        "validation": {"weights": {"sample": 0, "limits": {"factorised_to_converged": {"l1_mean": 1e-6}}}},
    }
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(config))
    result = CliRunner().invoke(cli, ["validate", "weights", str(path), "-o", str(tmp_path / "report")])
    assert isinstance(result.exception, LimitMissedError)
    assert result.exception.exit_code == 8
    report = json.loads((tmp_path / "report" / "weights.json").read_text())
    assert len(report["figures"]["voxels"]) == 5
    assert report["figures"]["factorised_to_converged"]["l1_largest"] < 0.02
    assert (tmp_path / "report" / "weights_columns.png").stat().st_size > 10_000
    assert (tmp_path / "report" / "weights_similarity.png").stat().st_size > 10_000


def test_curves_of_the_similarity_are_told_apart_and_columns_have_axes() -> None:
    pytest.importorskip("matplotlib")
    names = [f"comparison_{k}" for k in range(9)]
    voxel = {name: {"ssim": 0.9, "rmse_grey": 1.0, "l1": 0.1} for name in names}
    figure = similarity_figure({"voxels": [voxel], "unknown": None} | dict.fromkeys(names, {"l1_mean": 0.1}), 1)
    looks = {(line.get_color(), line.get_marker(), line.get_linestyle()) for line in figure.axes[0].lines}
    assert len(looks) == 9
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [name.replace("_", " ") for name in names]
    images = {"ert": np.eye(3), "factorised": 0.5 * np.eye(3)}
    columns = columns_figure([Column((0.0, 0.0, 1.0), images)]).axes[:2]
    assert [axes.get_xlabel() for axes in columns] == ["column (px)"] * 2
    assert len({axes.images[0].get_clim() for axes in columns}) == 1
