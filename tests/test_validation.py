"""Figures of boards, volumes, particles and weights that are known; the Cramer-Rao bound, and fits that keep to it."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import click
import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError, InputError, LimitMissedError
from lfpiv_cli.files.particle_file import Particles, write_particles
from lfpiv_cli.files.vtkhdf import write_volume
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.view import Light, View, raw_view
from lfpiv_cli.synthetic.render import Readout
from lfpiv_cli.validation import volume as of_volume
from lfpiv_cli.validation import weights
from lfpiv_cli.validation.board import DEPTH_DEFINITIONS, board_figures, elongation_mm, gaussian_centre_mm, measure_dots
from lfpiv_cli.validation.flow import limits_missed
from lfpiv_cli.validation.planning import UNKNOWNS, cramer_rao_bound, expected_image, pixel_variance, slopes
from lfpiv_cli.validation.volume import known_volume, match, normalised_correlation, particle_figures, volume_figures
from lfpiv_cli.validation.weights import Column, make_columns, ssim, weights_figures
from tests.commands import CONFIG, changed, run, table2_rig

BOARD_GRID = Grid.centred((30, 20, 60), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
DOTS = np.array([(x, y) for y in (-0.5, 0.5) for x in (-1.0, 0.0, 1.0)])


def board(z_mm: float, sigma_mm: float = 0.5, spacing: float = 1.0) -> np.ndarray:
    """A volume of 3 x 2 Gaussian dots."""
    z, y, x = np.meshgrid(*(BOARD_GRID.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    lateral = sum(np.exp(-((x - cx * spacing) ** 2 + (y - cy) ** 2) / (2 * 0.12**2)) for cx, cy in DOTS)
    return (lateral * np.exp(-0.5 * ((z - z_mm) / sigma_mm) ** 2)).astype(np.float32)


def test_elongation_and_centre_of_profiles_and_every_definition_of_a_depth():
    z = np.linspace(-3.0, 3.0, 61)
    # exp(-z^2 / 2 s^2) = 1/e at z = s sqrt 2; straight lines between samples err by less than a hundredth of a sample
    assert elongation_mm(z, np.exp(-0.5 * ((z - 0.13) / 0.5) ** 2)) == pytest.approx(2 * np.sqrt(2) * 0.5, abs=0.005)
    # It ends at the volume.
    assert elongation_mm(np.linspace(0.0, 1.0, 11), np.ones(11)) == pytest.approx(1.0)
    profile = 5.0 * np.exp(-0.5 * ((z - 0.137) / 0.7) ** 2)
    assert gaussian_centre_mm(z, profile) == pytest.approx(0.137, abs=1e-6)
    for name, definition in DEPTH_DEFINITIONS.items():
        # masses above a threshold err by a part of a sample
        assert definition.depth_mm(z, profile) == pytest.approx(0.137, abs=0.015), name
    # They differ for a dot with a tail.
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
    dots = [measure_dots(board(1.1 * z, spacing=1.02), BOARD_GRID, DOTS, 0.5) for z in (-1.0, 0.0, 1.0)]
    figures = board_figures(dots, (-1.0, 0.0, 1.0), (3, 2), 1.0)
    assert figures["depth_error"] == pytest.approx(0.10, abs=1e-4)
    assert figures["depth_error_mass"] == pytest.approx(0.10, abs=0.02)
    assert figures["depth_definitions"]["gaussian"] == pytest.approx({"error": 0.1, "shortest": 1.1, "longest": 1.1})
    assert figures["lateral_error"] == pytest.approx(0.02, abs=0.002)
    assert figures["elongation_mm"] == pytest.approx(np.sqrt(2), abs=0.01)
    assert figures["elongation_sigma_mm"] == pytest.approx(0.0, abs=0.01)


def test_boards_without_light_and_volumes_too_thin_for_them_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no light"):
        measure_dots(np.zeros(BOARD_GRID.shape_zyx, np.float32), BOARD_GRID, DOTS, 0.5)
    thin = tmp_path / "thin.yaml"
    thin.write_text(changed("table2", ("shape_xyz: [80, 80, 240]", "shape_xyz: [80, 80, 18]")))
    with pytest.raises(ConfigError, match="holds 1 of the boards"):
        run("validate", "board", thin, "-o", tmp_path / "report")


@pytest.mark.slow
def test_validate_board_on_a_small_camera(tmp_path: Path) -> None:
    changes = {"columns": "2352/520", "rows": "1768/520", "shape_xyz": "[80, 80, 240]/[24, 24, 120]"}
    changes |= {"voxel_mm": "0.1 /[0.1, 0.1, 0.2] ", "dots": "[7, 7]/[3, 3]", "spacing_mm": "1.0/0.7"}
    changes |= {"solver": "sart/em", "iterations": "200/8", "rotation_deg": "0.0   /0.4   "}
    changes |= {"shift_px": "[0.0, 0.0]  /[5.0, -4.0]  ", "images": "ideal/both"}
    changes |= {"methods": "[ert, dlfc]/[ert, dlfc, discs]"}
    pairs = (tuple(f"{key}: {value}" for value in values.split("/")) for key, values in changes.items())
    (tmp_path / "small.yaml").write_text(changed("table2", *pairs))
    run("validate", "board", tmp_path / "small.yaml", "-o", tmp_path / "report")
    report = json.loads((tmp_path / "report" / "board.json").read_text())["figures"]
    for half, method in product(("ideal", "recorded"), ("ert", "dlfc")):
        assert report[half][method]["lateral_error"] < 0.02
        assert report[half][method]["depth_error"] < 0.3
        assert (tmp_path / "report" / f"board_{half}_{method}.png").stat().st_size > 10_000
        assert report[half]["discs"]["depth_error"] < 0.02
        assert report[half]["discs"]["lateral_error"] < 0.002
    centres = {str(each["by_depth"]["centre_mm"]) for half in report.values() for each in half.values()}
    assert len(centres) == 6


GRID = Grid.centred((30, 24, 40), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
SIGMA = np.array([0.1, 0.1, 0.1])


@pytest.fixture
def particles(rng) -> np.ndarray:
    """Ten particles 0.4 mm apart in depth, none of them half way between two voxels."""
    x, y = rng.uniform(-1.0, 1.0, (2, 10))
    return np.stack([x, y, np.linspace(-1.77, 1.83, 10)], axis=1)


def test_a_gaussian_particle_and_ghosts_are_counted_as_they_were_put(particles):
    volume = known_volume(GRID, np.array([[0.23, -0.11, 0.4]]), np.array([3.0]), np.array([0.1, 0.15, 0.2]))
    z, y, x = np.meshgrid(*(GRID.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    exponent = ((x - 0.23) / 0.1) ** 2 + ((y + 0.11) / 0.15) ** 2 + ((z - 0.4) / 0.2) ** 2
    # cut at 4.3 standard deviations along each axis, where 1e-4 is left
    np.testing.assert_allclose(volume, 3.0 * np.exp(-0.5 * exponent), atol=3.5e-4)
    place = np.array([[0.23, -0.11, 0.4]])
    volume = of_volume.shared_among_voxels(GRID, place, np.array([3.0]))
    assert volume.sum() == pytest.approx(3.0, rel=1e-6)
    at = np.argwhere(volume)
    centre = (volume[tuple(at.T)][:, np.newaxis] * at[:, ::-1]).sum(axis=0) / 3.0
    np.testing.assert_allclose(GRID.voxel_to_mm(centre), place[0], atol=1e-6)
    assert not of_volume.shared_among_voxels(GRID, np.array([[9.0, 0.0, 0.0]]), np.array([3.0])).any()
    near = of_volume.near_a_particle(GRID, np.array([[0.05, 0.05, 0.05]]), 0.11)
    # within 0.11 mm laterally: the voxel and its four neighbours; within 0.44 in depth: four up and down
    assert near[20].sum() == 5
    assert near[:, 12, 15].sum() == 9
    light = np.linspace(0.6, 1.4, 10)
    figures = volume_figures(known_volume(GRID, particles, light, SIGMA), GRID, particles, light, 0.1)
    assert figures["q_gaussian"] == pytest.approx(1.0)
    assert figures["completeness"] == figures["precision"] == 1.0
    # exp(-z^2 / 2 s^2) = 1/e at s sqrt 2; samples a standard deviation apart
    assert figures["elongation_mm"] == pytest.approx(2.0 * np.sqrt(2.0) * 0.1, rel=0.1)
    assert figures["particles"] == figures["peaks"] == 10
    light = np.ones(10)
    ghosts = particles + [0.0, 0.9, 0.0]
    ghosts[:, 1] = np.where(ghosts[:, 1] > 1.1, ghosts[:, 1] - 2.0, ghosts[:, 1])
    # the last ghost is as faint as noise and does not count as a peak
    seen, height = np.concatenate([particles[:8], ghosts[:5]]), np.array([1.0] * 12 + [0.05])
    volume = known_volume(GRID, seen, height, np.array([0.04, 0.04, 0.1]))
    figures = volume_figures(volume, GRID, particles, light, 0.1)
    assert figures["completeness"] == pytest.approx(0.8)
    assert figures["precision"] == pytest.approx(8 / 12)
    assert figures["ghost_light"] == pytest.approx(4 / 12, abs=0.1)
    assert figures["ghost_light_uniform"] > 0.9
    with pytest.raises(InputError, match="none of the true particles"):
        volume_figures(volume, GRID, particles + 50.0, light, 0.1)


def test_validate_volume_moves_the_particles_to_the_frame(particles: np.ndarray, tmp_path: Path) -> None:
    speed, dt_s = np.tile([0.1, 0.0, 0.0], (10, 1)), 0.002
    volume = known_volume(GRID, particles + 0.5 * dt_s * 1000.0 * speed, np.ones(10), SIGMA)
    made = {"provenance": {}, "attributes": {"residual": np.array([0.4, 0.3, 0.2])}}
    write_volume(tmp_path / "b.vtkhdf", volume, GRID, Reference("mid_plane", 0.5), **made, overwrite=False)
    true = Particles(particles + [0.0, 0.0, 0.5], speed, np.ones(10))
    write_particles(tmp_path / "true.npz", true, overwrite=False)
    known = ("volume", CONFIG, "--volume", tmp_path / "b.vtkhdf", "--particles", tmp_path / "true.npz")
    figures = {}
    for frame in ("a", "b"):
        run("validate", *known, "--frame", frame, "-o", tmp_path / frame)
        figures[frame] = json.loads((tmp_path / frame / "volume.json").read_text())["figures"]
    assert figures["b"]["q_gaussian"] == pytest.approx(1.0)
    assert figures["a"]["q_gaussian"] < 0.9
    assert (figures["b"]["residual"], figures["b"]["iterations"]) == (0.2, 2)
    with pytest.raises(click.UsageError, match="--frame"):
        run("validate", *known, "-o", tmp_path / "c")


LOW, HIGH = np.zeros(3), np.full(3, 5.0)


def test_each_true_particle_is_matched_once_within_the_volume() -> None:
    true = np.array([[1.0, 1.0, 1.0]])
    found = np.array([[1.02, 1.0, 1.0], [1.01, 1.0, 1.0]])
    pairs = match(found, true, 0.1)
    assert pairs.found.tolist() == [1]
    np.testing.assert_allclose(pairs.error_voxel, [[0.1, 0.0, 0.0]], atol=1e-12)
    true = np.array([[1.0, 1.0, 1.0], [6.0, 1.0, 1.0]])
    figures = particle_figures(np.array([[1.0, 1.0, 1.0], [7.0, 1.0, 1.0]]), true, LOW, HIGH, 0.1)
    assert figures["recall"] == figures["precision"] == 1.0


@pytest.mark.parametrize(("offset", "matched"), [((0.049, 0, 0.19), 1), ((0.04, 0.04, 0), 0), ((0, 0, 0.21), 0)])
def test_limits_are_half_a_voxel_and_two_in_depth(offset: tuple[float, float, float], matched: int) -> None:
    true = np.array([[1.0, 1.0, 1.0]])
    assert len(match(true + offset, true, 0.1).found) == matched


def test_figures_of_a_known_list_their_coverage_and_depths(rng: np.random.Generator) -> None:
    true = rng.uniform(LOW, HIGH, (1000, 3))
    error = rng.normal((0.0, 0.0, 0.01), (0.002, 0.004, 0.02), true.shape)
    found = np.concatenate([(true + error)[:900], rng.uniform(LOW, HIGH, (100, 3))])
    figures = particle_figures(found, true, LOW, HIGH, 0.1)
    # A hundred missing, a hundred invented, some of which meet a true one by chance; three standard errors.
    assert figures["recall"] == pytest.approx(0.9, abs=0.01)
    assert figures["precision"] == pytest.approx(0.9, abs=0.01)
    assert figures["bias_z_voxel"] == pytest.approx(0.1, abs=0.03)
    assert figures["spread_x_voxel"] == pytest.approx(0.02, rel=0.15)
    assert figures["spread_y_voxel"] == pytest.approx(0.04, rel=0.15)
    true = rng.uniform((0.0, 0.0, -5.0), (50.0, 50.0, 5.0), (2000, 3))
    near = np.abs(true[:, 2]) < 2.0
    sigma = np.full(true.shape, 0.002)
    found = true + np.where(near[:, np.newaxis], 3.0, 1.0) * rng.normal(0.0, sigma)
    found = found[~near | (rng.uniform(size=2000) < 0.5)]
    bounds = np.array([0.0, 0.0, -5.0]), np.array([50.0, 50.0, 5.0])
    inner, outer = (
        particle_figures(found, true, *bounds, 0.1, sigma[: len(found)], band) for band in ((0.0, 2.0), (2.0, np.inf))
    )
    # Within 1.96/3 standard deviations lie 48.6 %; three standard errors of 400 and of 1,200 particles.
    assert inner["coverage_z"] == pytest.approx(0.486, abs=0.08)
    assert outer["coverage_z"] == pytest.approx(0.95, abs=0.02)
    assert inner["recall"] == pytest.approx(0.5, abs=0.06)
    assert outer["recall"] > 0.995


VOXEL, CENTRES = Grid((1, 1, 1), (0.1,) * 3, (0.3, -0.2, 3.0)), np.array([(0.3, -0.2, 3.0)])


def test_ssim_eq_16_and_figures_of_a_column_by_hand(rng):
    # Constant images have no variance: only the means are left, (2 a b + c1) / (a^2 + b^2 + c1) with c1 = 2.55^2.
    size = 21
    a, b = np.full((size, size), 100.0), np.full((size, size), 150.0)
    border = 5
    c1 = 2.55**2
    expected = (2 * 100 * 150 + c1) / (100**2 + 150**2 + c1)
    middle = np.pad(a, border), np.pad(b, border)  # zeros around: windows at the edge see them, the middle does not
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(*middle) < 1.0
    assert _local_ssim_at_middle(*middle) == pytest.approx(expected, rel=1e-6)
    # One pixel has one window; zeros beyond the edge count as pixels.
    a, b = 255.0 * rng.random((1, 1)), 255.0 * rng.random((1, 1))
    assert ssim(a, b) == pytest.approx(_local_ssim_at_middle(np.pad(a, 5), np.pad(b, 5)), rel=1e-9)
    volume = rng.random((3, 4, 5), dtype=np.float32)
    assert normalised_correlation(volume, 7.0 * volume) == pytest.approx(1.0)
    assert normalised_correlation(np.eye(3, dtype=np.float32)[0], np.eye(3, dtype=np.float32)[1]) == 0.0
    assert normalised_correlation(volume, np.zeros_like(volume)) == 0.0
    reference = np.array([[0.5, 0.25], [0.25, 0.0]])
    image = np.array([[0.5, 0.25], [0.15, 0.1]])
    column = Column((0.0, 0.0, 1.0), {"ert": reference, "factorised": image})
    figures = weights_figures([column], np.array([0]))["voxels"][0]["factorised_to_converged"]
    assert figures["l1"] == pytest.approx(0.2)
    assert figures["rmse_grey"] == pytest.approx(510.0 * np.sqrt(0.02 / 4))
    figures = {"a.ssim_smallest": 0.9, "a.l1_mean": 0.02}
    assert limits_missed(figures, {"a.ssim_smallest": 0.8, "a.l1_mean": 0.03, "b.l1_mean": None}) == []
    missed = limits_missed(figures, {"a.ssim_smallest": 0.95, "a.l1_mean": 0.01, "b.l1_mean": 0.1})
    found = {"a.ssim_smallest": "0.9", "a.l1_mean": "0.02", "b.l1_mean": "unknown"}
    assert [each.rpartition(",")[0] for each in missed] == [f"{name} is {value}" for name, value in found.items()]


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
    alike = (2 * mean[0] * mean[1] + c1) * (2 * covariance + c2)
    return float(alike / ((mean[0] ** 2 + mean[1] ** 2 + c1) * (variance_a + variance_b + c2)))


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
def test_validate_weights_writes_its_report_and_fails_on_a_limit(tmp_path: Path) -> None:
    limits = {"factorised_to_converged": {"l1_mean": 1e-6}}
    volume = {"shape_xyz": [10, 1, 3], "voxel_mm": 0.1}
    rig = table2_rig(1200, 100, volume=volume, validation={"weights": {"sample": 0, "limits": limits}})
    (tmp_path / "rig.yaml").write_text(rig)
    with pytest.raises(LimitMissedError) as missed:
        run("validate", "weights", tmp_path / "rig.yaml", "-o", tmp_path / "report")
    assert missed.value.exit_code == 8
    figures = json.loads((tmp_path / "report" / "weights.json").read_text())["figures"]
    assert len(figures["voxels"]) == 5
    assert figures["factorised_to_converged"]["l1_largest"] < 0.02
    for name in ("columns", "similarity"):
        assert (tmp_path / "report" / f"weights_{name}.png").stat().st_size > 10_000


def test_curves_of_the_similarity_are_told_apart_and_columns_have_axes() -> None:
    pytest.importorskip("matplotlib")
    names = [f"comparison_{k}" for k in range(9)]
    voxel = {name: {"ssim": 0.9, "rmse_grey": 1.0, "l1": 0.1} for name in names}
    figure = weights.similarity_figure({"voxels": [voxel], "unknown": None} | dict.fromkeys(names, {"l1_mean": 0.1}), 1)
    looks = {(line.get_color(), line.get_marker(), line.get_linestyle()) for line in figure.axes[0].lines}
    assert len(looks) == 9
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [name.replace("_", " ") for name in names]
    images = {"ert": np.eye(3), "factorised": 0.5 * np.eye(3)}
    columns = weights.columns_figure([Column((0.0, 0.0, 1.0), images)]).axes[:2]
    assert [axes.get_xlabel() for axes in columns] == ["column (px)"] * 2
    assert len({axes.images[0].get_clim() for axes in columns}) == 1


# Two that overlap, and one alone on the other side of the focal plane.
PARTICLES = np.array([[0.21, -0.2, 2.0, 4e5], [0.25, -0.18, 2.1, 5e5], [-0.42, 0.33, -1.5, 3e5]])
READOUT = Readout(photons_per_count=0.5, read_noise_counts=6.0)
IMAGES = 150
# Gauss-Newton steps of a fit: from the truth the second is a thousandth of a standard error already.
STEPS = 2


@pytest.fixture(scope="module", params=["square", "hexagonal", pytest.param("waves", marks=pytest.mark.thorough)])
def view(request: pytest.FixtureRequest) -> View:
    """The paper's camera with a small sensor, either kind of array, seen through distortion; and by waves."""
    by_waves = request.param == "waves"
    lattice = Lattice.regular(0.1, "square" if by_waves else request.param)
    camera = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, lattice, 0.0055, 290, 260, distortion_per_mm2=2e-4)
    light = Light(532e-6, 0.3, (-1.6, 2.2)) if by_waves else None
    return raw_view(camera, Media(1.0, 1.49, 1.33), 0.025, light=light)


def fitted(view: View, image: Floats, weight: Floats) -> Floats:
    """Return the particles (n, 4) that fit an image best, by weighted least squares from the truth."""
    particles = PARTICLES.copy()
    for _ in range(STEPS):
        slope = slopes(view, particles)
        weighted = slope.T * weight
        matrix, right = (weighted @ slope).toarray(), weighted @ (image - expected_image(slope, particles))
        particles += np.linalg.solve(matrix, right).reshape(particles.shape)
    return particles


@pytest.mark.thorough
def test_slopes_are_finite_differences(view: View) -> None:
    slope = slopes(view, PARTICLES)
    for unknown, step in enumerate((1e-3, 1e-3, 1e-2, 1.0)):
        moved = np.zeros_like(PARTICLES)
        moved[1, unknown] = step
        there = [expected_image(slopes(view, each), each) for each in (PARTICLES + moved, PARTICLES - moved)]
        difference = (there[0] - there[1]) / (2.0 * step)
        analytic = slope[:, [UNKNOWNS + unknown]].toarray().ravel()
        # Steps that are small against the ball's 0.05 mm; the kinks of its profile within them remain.
        assert np.abs(analytic - difference).sum() < 0.04 * np.abs(difference).sum()


@pytest.mark.thorough
def test_bound_is_the_inverse_of_the_whole_matrix(view: View) -> None:
    # A chain: the first and the last share no pixel, the middle one some with both.
    chain = np.array([[-0.4, 0.0, 2.0, 4e5], [0.0, 0.02, 2.1, 5e5], [0.38, 0.0, 1.9, 3e5]])
    slope = slopes(view, chain)
    variance = pixel_variance(expected_image(slope, chain), READOUT)
    dense = slope.toarray()
    matrix = dense.T @ (dense / variance[:, np.newaxis])
    bound = cramer_rao_bound(slope, variance)
    for number in range(len(chain)):
        part = slice(UNKNOWNS * number, UNKNOWNS * (number + 1))
        assert bound.alone[number] == pytest.approx(np.linalg.inv(matrix[part, part]), rel=1e-5)
        # What is two steps away is held.
        assert np.diag(bound.joint[number]) == pytest.approx(np.diag(np.linalg.inv(matrix)[part, part]), rel=0.02)


@pytest.mark.thorough
def test_no_fit_is_better_and_a_good_one_as_good(view: View) -> None:
    slope = slopes(view, PARTICLES)
    expected = expected_image(slope, PARTICLES)
    variance = pixel_variance(expected, READOUT)
    bound = cramer_rao_bound(slope, variance)
    rng = np.random.default_rng(6)
    errors = []
    for _ in range(IMAGES):
        image = READOUT.record(expected, rng) - READOUT.dark_level_counts
        errors.append(fitted(view, image, 1.0 / variance) - PARTICLES)
    ratio = np.std(errors, axis=0) / np.sqrt(np.diagonal(bound.joint, axis1=1, axis2=2))
    # A standard deviation of so many is known to 1/sqrt(2 n), here to 6 %.
    assert np.abs(ratio - 1.0).max() < 3.0 / np.sqrt(2.0 * IMAGES)


@pytest.mark.thorough
def test_neighbours_cost_accuracy_and_only_where_they_are(view: View) -> None:
    particles = PARTICLES.copy()
    particles[1] = particles[0] + (0.01, 0.01, 0.05, 0.0)
    slope = slopes(view, particles)
    bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, particles), READOUT))
    price = bound.sigma_mm(joint=True) / bound.sigma_mm(joint=False)
    assert price[2] == pytest.approx(1.0)
    assert price[:2].min() > 1.0
    assert price[:2].max() > 1.5


def test_place_is_hardly_known_in_focus_and_not_at_all_off_the_sensor(view: View) -> None:
    # Well within its lens, whose micro-image follows it by the ratio of the distances behind the array and before it.
    particles = np.array([[0.003, -0.002, 0.0, 5e5], [0.003, -0.002, 2.0, 5e5], [9.0, 0.0, 2.0, 5e5]])
    slope = slopes(view, particles)
    sigma = cramer_rao_bound(slope, pixel_variance(expected_image(slope, particles), READOUT)).sigma_mm(joint=False)
    assert np.all(sigma[0, :2] > 20.0 * sigma[1, :2])
    assert np.all(np.isinf(sigma[2]))
    # No particles have no bound.
    slope = slopes(view, np.zeros((0, UNKNOWNS)))
    bound = cramer_rao_bound(slope, np.ones(view.camera.rows * view.camera.columns))
    assert bound.joint.shape == (0, UNKNOWNS, UNKNOWNS)


def test_variance_adds_up() -> None:
    light = np.array([-1.0, 0.0, 100.0])
    base = 6.0**2 + 1.0 / 12.0  # of rounding to whole counts
    assert pixel_variance(light, READOUT) == pytest.approx([base, base, base + 200.0])
    assert pixel_variance(light, replace(READOUT, photons_per_count=None)) == pytest.approx([base] * 3)
    assert pixel_variance(light, READOUT, counts_per_ray=10.0)[2] > base + 200.0
