"""Parts of the paper's report: planted mistakes, wrong ideas of a rig, bubbles on a wall; how well depth is told."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
import yaml
from click.testing import CliRunner

from lfpiv_cli.arrays import Floats
from lfpiv_cli.cli.main import cli
from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, LimitMissedError
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.vtkhdf import open_volume, write_vectors
from lfpiv_cli.grid import FOCAL_POINT, Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.surfaces import Surface
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.paper import camera as of_camera
from lfpiv_cli.paper import faults, influences, small_rig
from lfpiv_cli.paper import sensitivities as of_sensitivities
from lfpiv_cli.paper.bubbles import _rows, bubbles
from lfpiv_cli.paper.camera import discussion, elongations_mm, geometric_depth_mm
from lfpiv_cli.paper.faults import FAULTS, LIMIT_SIGMAS, NONE, WORDS, Limit, allowed, fault_rows, missed_limits, said_to
from lfpiv_cli.paper.influences import DISTANCE, F_NUMBERS, FOCUS, INDEX, LEVER, NOISE, SHIFT, WALL, Influence
from lfpiv_cli.paper.parts import Findings, Work, read_json, sections
from lfpiv_cli.paper.sensitivities import INFLUENCES, Measured, crowding, drawing_of, rows_of
from lfpiv_cli.paper.small_rig import CHANNEL, Case, Rig, displacement
from lfpiv_cli.paper.table4 import TINY, channel_sections
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.images import still_light
from lfpiv_cli.reconstruction.solvers import SolverSettings
from lfpiv_cli.synthetic.render import Readout
from lfpiv_cli.synthetic.scenes import Box, Bubbles, bubbles_at_wall, channel_walls, render_bubbles
from lfpiv_cli.validation.planning import errors_alone_mm
from lfpiv_cli.validation.volume import TERMS, fit_errors, pairs_of
from tests.commands import SAMPLE, WATER, run, sample_weights
from tests.vector_fields import field_on

# Of places and displacements, x, y and z, mm.
SIGMA_MM = np.array([1e-4, 1e-4, 3e-3])


def tracks(seed: int, change: Any = lambda middle, moved: (middle, moved)) -> dict[str, float]:
    """Figures of tracks with noise, changed by a mistake."""
    rng = np.random.default_rng(seed)
    true = small_rig.strewn_apart(rng).position_mm
    moves = displacement(true)
    middle, moved = (values + rng.normal(0.0, SIGMA_MM, true.shape) for values in (true, moves))
    return faults.place_and_velocity_figures(*change(middle, moved), true, moves)


LIMITS = faults.limits_of(tracks(100))
SIGNS = np.array([1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("change", "given_away"),
    [
        (lambda middle, moved: (middle, -moved), {"slope_u", "slope_v", "slope_w"}),
        (lambda middle, moved: (middle * SIGNS, moved * SIGNS), {"stretch_z", "slope_w"}),
        (lambda middle, moved: (middle * [-1, 1, 1], moved * [-1, 1, 1]), {"stretch_x", "slope_u"}),
        (lambda middle, moved: (middle + [2e-3, 0, 0], moved), {"offset_x"}),
        (lambda middle, moved: (middle * [1, 1, 1.02], moved * [1, 1, 1.02]), {"stretch_z", "slope_w"}),
        (lambda middle, moved: (middle + 3e-3 * middle[:, 2:] * [0, 1, 0], moved), {"slant_y"}),
    ],
    ids=["pair swapped", "z of the wrong sign", "columns mirrored", "offset", "index", "slant"],
)
def test_figures_give_a_mistake_away(change: Any, given_away: set[str]):
    figures = tracks(1, change)
    assert set(missed_limits(figures, LIMITS)) == given_away
    assert all(WORDS[name].text in said_to(figures, LIMITS) for name in given_away)
    # The worst is named first.
    figures = tracks(1, lambda middle, moved: (middle + [1e-3, 4e-3, 0.0], moved))
    assert missed_limits(figures, LIMITS) == ["offset_y", "offset_x"]


def test_limits_are_standard_errors_and_a_good_measurement_is_within_them():
    figures = tracks(100)
    assert LIMITS["offset_z"].half_width == pytest.approx(LIMIT_SIGMAS * figures["offset_z_sigma"])
    assert set(LIMITS) == set(WORDS)
    assert allowed("offset_z", {"offset_z": Limit(0.0, 2e-3, False)}) == "\N{PLUS-MINUS SIGN}2 um"
    assert allowed("spread_z", {"spread_z": Limit(1e-3, 2e-3, True)}) == "up to 3 um"
    for seed in range(20):
        assert said_to(tracks(seed), LIMITS) == ""
    limit = LIMITS["spread_z"]
    assert limit.centre == pytest.approx(SIGMA_MM[2], rel=0.3)
    assert limit.over(0.0) == 0.0
    assert limit.over(limit.centre + 2.0 * limit.half_width) == pytest.approx(2.0)
    assert LIMITS["offset_x"].over(-2.0 * LIMITS["offset_x"].half_width) == pytest.approx(2.0)
    assert Limit(0.0, 1.0, False).over(float("nan")) == np.inf
    figures = tracks(1) | {"stretch_z": float("nan")}
    assert missed_limits(figures, LIMITS) == ["stretch_z"]


def test_rows_tell_which_figure_gave_a_mistake_away_and_false_alarms():
    good = tracks(1)
    swapped = tracks(1, lambda middle, moved: (middle, -moved))
    found, alarms = fault_rows({"pair swapped": swapped}, good, LIMITS)
    assert found.quantity.startswith("pair swapped: error of the slope of ")
    assert found.best == pytest.approx(max(2.0 / LIMITS[f"slope_{name}"].half_width for name in "uv"), rel=0.05)
    assert found.verdict == "met"
    assert (alarms.best, alarms.verdict) == (0.0, "met")
    missed, wrong = fault_rows({"pair swapped": good}, swapped, LIMITS)
    assert (missed.best, missed.verdict, wrong.verdict) == (0.0, "missed", "missed")
    assert "slope of u is -200 %" in wrong.reason
    table = faults.fault_table({"pair swapped": swapped}, good, LIMITS)
    assert [row[0] for row in table.rows] == ["no mistake", *["pair swapped"] * 3]
    assert [row[-1] for row in table.rows] == ["met", *["missed"] * 3]
    assert said_to(good, LIMITS) == ""


def test_the_planted_mistakes_are_those_that_are_told():
    names = "index 1.30 for 1.33, z of the wrong sign, images half a pixel off, lattice turned by 0.02 degrees"
    assert ", ".join(fault.name for fault in FAULTS) == f"{names}, column axis mirrored, pair swapped"
    first, second = np.arange(6.0).reshape(2, 3), np.ones((2, 3))
    assert NONE.images((first, second)) == (first, second)
    mirrored = FAULTS[4].images((first, second))[0]
    assert np.array_equal(mirrored, first[:, ::-1])
    assert FAULTS[5].images((first, second)) == (second, first)
    assert FAULTS[0].case().believed.media.fluid == 1.30
    # A mirrored image fits the lattice, its own mirror image about the sensor's middle: nothing but signs tells.
    assert small_rig.sheet().micro_image_lattice_px().origin == pytest.approx(small_rig.sheet().sensor_centre_px)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("signs", "exit_code"),
    [((1.0, 1.0, 1.0), 0), ((-1.0, -1.0, -1.0), 8), ((-1.0, 1.0, 1.0), 8), ((1.0, 1.0, -1.0), 8)],
    ids=["no mistake", "pair swapped", "column axis mirrored", "z of the wrong sign"],
)
def test_velocities_of_the_wrong_sign_miss_limits(signs: tuple[float, float, float], exit_code: int, tmp_path: Path):
    flow = {"kind": "shear", "along": "x", "across": "z", "rate_per_s": 20.0, "velocity_m_s": [0.1, 0.0, 0.05]}
    limits = {"streamwise_mean_error": 0.05, "within_25_percent_vector": 0.9}
    config, vectors = tmp_path / "rig.yaml", tmp_path / "vectors.vtkhdf"
    config.write_text(yaml.safe_dump(sections(validation={"flow": flow, "limits": limits})))
    grid = Grid.centred((4, 4, 5), (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    z = grid.centres_mm()[..., 2]
    # u = 0.1 m/s + z 20/s, w = 0.05 m/s, with signs; of voxels of 0.1 mm in 1 ms.
    moved = np.stack([0.1 + 0.02 * z, 0.0 * z, 0.0 * z + 0.05], axis=-1) * signs * 1000.0 * 0.001 / 0.1
    write_vectors(vectors, field_on(grid, moved), FOCAL_POINT, provenance={}, overwrite=False)
    ended = CliRunner().invoke(cli, ["validate", "flow", str(config), "--vectors", str(vectors), "-o", str(tmp_path)])
    reported = ended.exception.exit_code if isinstance(ended.exception, LimitMissedError) else ended.exit_code
    assert reported == exit_code, ended.output


DEPTHS = np.array([-3.0, 0.0, 4.0])
FAINT = 1e-4


def places(count: int = 40) -> Floats:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3)) * [1.0, 1.0, 4.0]


def apparent_mm(rig: Rig, z_mm: Floats) -> Floats:
    """Where paraxial rays see depths from the mid plane, from the lens."""
    depths = rig.reference.depth_to_focal_point(0.0) + z_mm
    return equivalent_object_distance(depths, rig.camera.focus_distance_mm, rig.media)


def believed_depth_mm(case: Case, z_mm: Floats) -> Floats:
    """The depths, from the believed mid plane, at which paraxial rays from true ones are seen."""
    seen = apparent_mm(case.true, z_mm) - case.true.camera.focus_distance_mm
    return np.asarray(seen / case.believed.media.depth_ratio - case.believed.reference.z_mm)


def lines_of(influence: Influence, slopes: dict[str, float]) -> Measured:
    """An influence whose figures are straight lines of these slopes, faint ones for all others."""
    values = np.array(influence.values[1])
    names = {figure for panel in influence.panels for figure in panel.series}
    names |= {each.figure for each in influence.sensitivities}
    return Measured(influence, values, {name: slopes.get(name, FAINT) * values[:, np.newaxis] for name in names})


def by_theory(influence: Influence, factor: float = 1.0) -> Measured:
    """Return an influence with the slopes of theory, times a factor."""
    expected = {each.figure: factor * (each.expected or FAINT) for each in influence.sensitivities}
    return lines_of(influence, expected)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("offset_z", lambda p: np.array([0.0, 0.0, 0.3]) + 0.0 * p),
        ("stretch_x", lambda p: 0.3 * p * [1.0, 0.0, 0.0]),
        ("stretch_z", lambda p: 0.3 * p * [0.0, 0.0, 1.0]),
        ("slant_x", lambda p: 0.3 * p[:, 2:] * [1.0, 0.0, 0.0]),
        ("slant_y", lambda p: 0.3 * p[:, 2:] * [0.0, 1.0, 0.0]),
        ("turn", lambda p: 0.3 * np.column_stack([-p[:, 1], p[:, 0], 0.0 * p[:, 0]])),
        ("twist", lambda p: 0.3 * p[:, 2:] * np.column_stack([-p[:, 1], p[:, 0], 0.0 * p[:, 0]])),
    ],
)
def test_the_map_names_each_displacement(name: str, error: Callable[[Floats], Floats]):
    true = places()
    figures, _ = fit_errors(true, error(true))
    assert figures.pop(name) == pytest.approx(0.3, abs=1e-12)
    assert np.allclose(list(figures.values()), 0.0, atol=1e-12)


def test_the_map_tells_its_standard_errors_and_leaves_outliers_out_and_needs_places():
    rng, true = np.random.default_rng(1), places(4000)
    error = rng.normal(0.0, [0.01, 0.01, 0.2], true.shape)
    error[:40, 2] += 50.0
    figures, sigma = fit_errors(true, error)
    assert all(abs(figures[name]) < 5.0 * sigma[name] for name in figures if not name.startswith("spread"))
    assert figures["spread_z"] == pytest.approx(0.2, abs=5.0 * sigma["spread_z"])
    # the mean of n values of this spread
    assert sigma["offset_z"] == pytest.approx(0.2 / np.sqrt(len(true)), rel=0.1)
    true = places(TERMS)
    assert np.isnan(list(fit_errors(true, true)[0].values())).all()


def test_influences_are_fitted_pictured_and_strewn_as_they_are_named():
    figures = {"offset_z": np.array([[1.0], [3.3], [5.0]])}
    line = Measured(WALL, np.array([0.0, 1.0, 2.0]), figures).line(WALL.sensitivities[0])
    assert line == pytest.approx((1.1, 2.0))
    assert {each.name for each in INFLUENCES} > {F_NUMBERS.name, NOISE.name, DISTANCE.name}
    assert len({each.name for each in INFLUENCES}) == len(INFLUENCES) == 9
    tracers = small_rig.strewn(0.5, np.random.default_rng(4))
    width = np.ptp(tracers.position_mm[:, 0])
    assert len(tracers.position_mm) / (width / 0.1) ** 2 == pytest.approx(0.5, rel=0.05)
    assert pytest.approx(0.67, abs=0.005) == influences.PAPER_PER_LENS
    true = small_rig.strewn_apart(np.random.default_rng(2)).position_mm
    shuffled = np.random.default_rng(3).permutation(len(true))
    pairs = pairs_of(true[shuffled] + [0.02, -0.03, -2.7], true, small_rig.GATE_MM)
    assert len(pairs.true) == len(true)
    assert np.array_equal(shuffled[pairs.found], pairs.true)
    assert np.allclose(pairs.error_voxel, [0.02, -0.03, -2.7])


def test_eq_21_a_wrong_index_is_right_at_the_inner_wall_and_a_wrong_wall_shifts_depths():
    wall = np.array([-0.5 * CHANNEL.width_mm])
    assert believed_depth_mm(small_rig.index_wrong(1.36), wall) == pytest.approx(wall)
    slope = (believed_depth_mm(small_rig.index_wrong(1.34), DEPTHS) - DEPTHS) / 0.01
    assert slope == pytest.approx((DEPTHS - wall) / WATER.fluid)
    off = believed_depth_mm(small_rig.wall_wrong(0.5), DEPTHS) - DEPTHS
    assert off == pytest.approx(-0.5 * WATER.fluid / WATER.window)


@pytest.mark.parametrize("by_mm", [-2.0, 1.0])
def test_a_lens_focused_elsewhere_leaves_the_channel_where_it_is(by_mm: float):
    case = small_rig.focus_wrong(by_mm)
    assert case.true.camera.focus_distance_mm == pytest.approx(case.believed.camera.focus_distance_mm - by_mm)
    assert apparent_mm(case.true, DEPTHS) == pytest.approx(apparent_mm(case.believed, DEPTHS))
    white = [rig.camera.micro_image_lattice_px() for rig in (case.true, case.believed)]
    assert white[0].origin == pytest.approx(white[1].origin)
    assert white[0].basis == pytest.approx(white[1].basis)


def test_lens_images_are_believed_to_lie_further_by_what_is_said_and_the_slant_is_that_of_theory():
    case = small_rig.lattice_shifted(0.3)
    true, believed = (rig.camera.micro_image_lattice_px().origin for rig in (case.true, case.believed))
    assert believed - true == pytest.approx([0.3 * case.true.camera.micro_image_scale, 0.0])
    turned = small_rig.lattice_turned(0.1)
    assert turned.true.camera.lattice.rotation_rad == pytest.approx(-np.deg2rad(0.1))
    # one pixel is s_i/s_mu times as much on the main lens, 200 mm from the focal plane in air
    expected = next(each.expected for each in SHIFT.sensitivities)
    assert expected == pytest.approx(-0.0055 * LEVER / 200.0 / WATER.fluid)
    assert pytest.approx(250.0) == LEVER


def test_spherical_aberration_grows_as_the_square_of_the_aperture():
    assert small_rig.spherical_aberration_mm(4.0) == pytest.approx(4.0 * small_rig.spherical_aberration_mm(8.0))
    # n (2/3) (u^2/2) (t/n) (1 - 1/n^2) of 133.867 mm of water and of the window's 2 mm, u = 1/16
    layers = 133.867 / 1.33 * (1.0 - 1.33**-2) + 2.0 / 1.49 * (1.0 - 1.49**-2)
    assert small_rig.spherical_aberration_mm(4.0) == pytest.approx(1.33 / 3.0 / 256.0 * layers)


@pytest.mark.parametrize("influence", [INDEX, FOCUS, WALL, SHIFT])
def test_rows_are_met_by_theory_and_missed_beside_it(influence: Influence):
    found = by_theory(influence)
    unknown = replace(found, figures={name: np.full_like(table, np.nan) for name, table in found.figures.items()})
    cases = ((found, "met"), (by_theory(influence, 1.2), "missed"), (by_theory(influence, -1.0), "missed"))
    for measured, verdict in (*cases, (unknown, "unknown")):
        assert {row.verdict for row in rows_of(measured)} == {verdict}


@pytest.mark.parametrize(("spread", "verdict"), [(1.4e-2, "met"), (1.6e-2, "missed"), (np.nan, "unknown")])
def test_scatter_is_held_against_its_bound(spread: float, verdict: str):
    found = lines_of(NOISE, {})
    found.figures["bound_z"][:], found.figures["spread_z"][:] = 1e-2, spread
    assert [row.verdict for row in rows_of(found)] == [verdict]


def test_what_harms_most_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(of_sensitivities, "measured", lambda _, influence: by_theory(influence))

    def findings(*influences: Influence) -> Findings:
        monkeypatch.setattr(of_sensitivities, "INFLUENCES", influences)
        return of_sensitivities.sensitivities(Work(tmp_path, "quick", Console(quiet=True), {}))

    found = findings(INDEX, WALL, FOCUS, SHIFT)
    text = found.text[2]
    # 0.3 mm of wall, 0.1 mm of focus, 0.005 of index: 0.27, 0.13 and 0.019 mm; lens images harm least
    assert text.index("0.27 mm") < text.index("0.13 mm") < text.index("0.019 mm")
    assert "white image" not in text
    assert [row[0] for row in found.tables[0].rows][:2] == ["wall", "focus"]
    assert "calliper" in text
    # a wall that is known to the micrometre: what harms is something else
    assert "calliper" not in findings(replace(WALL, typical=(0.001, "")), INDEX, FOCUS, SHIFT).text[2]


@pytest.mark.parametrize(("recall", "reported"), [((0.97, 0.95, 0.6), "from 1.2 on"), ((1.0, 1.0, 1.0), "at none")])
def test_from_where_tracers_crowd(recall: tuple[float, ...], reported: str):
    found = lines_of(influences.SEEDING, {})
    found.figures["recall"][:] = np.array(recall)[:, np.newaxis]  # type: ignore[index]
    assert reported in crowding(found)


@pytest.mark.thorough
@pytest.mark.parametrize("influence", INFLUENCES, ids=lambda each: each.name)
def test_pictures_show_all_series(influence: Influence):
    drawing = drawing_of(by_theory(influence))
    labels = [text.get_text() for axes in drawing.figure.axes for text in axes.get_legend().get_texts()]
    assert labels == [label for panel in influence.panels for label in panel.series.values()]


AIR = ObjectSpace(Media())
MARGIN_PX = 3


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize(
    ("wall", "is_deep", "sign"), [("near", True, -1), ("far", True, 1), ("low", False, -1), ("high", False, 1)]
)
def test_bubbles_touch_their_wall_alone(rng: np.random.Generator, axis: int, wall: Surface, is_deep, sign) -> None:
    walls = channel_walls(4.0, -0.3, axis)
    seen = Box((-1.0, -2.0, -2.3), (1.0, 2.0, 1.7)) if axis == "x" else Box((-2.0, -1.0, -2.3), (2.0, 1.0, 1.7))
    found = bubbles_at_wall(50, (0.2, 0.6), wall, seen, walls, rng)
    across, middle = (2, -0.3) if is_deep else ({"x": 1, "y": 0}[axis], 0.0)
    reach = sign * (found.centres_mm[:, across] - middle) + 0.5 * found.diameters_mm
    assert reach == pytest.approx(np.full(50, 2.0))
    radii = 0.5 * found.diameters_mm[:, np.newaxis]
    assert (found.centres_mm - radii >= np.array(walls.low_mm) - 1e-9).all()
    assert (found.centres_mm + radii <= np.array(walls.high_mm) + 1e-9).all()
    assert found.diameters_mm.min() < 0.25
    assert found.diameters_mm.max() > 0.55
    with pytest.raises(ConfigError, match="do not fit"):
        bubbles_at_wall(5, (4.1, 4.2), wall, seen, walls, rng)


@pytest.mark.thorough
def test_a_bubble_gives_its_level_in_the_middle_and_fades_to_its_rim(camera: Camera, rng: np.random.Generator) -> None:
    small = replace(camera, columns=220, rows=180)
    bubble = Bubbles(np.array([[0.1, -0.05, 0.0]]), np.array([0.6]))
    image = render_bubbles(small, AIR, bubble, 1000.0, rng)
    # in focus a micro-image has the light of its lens's place: 1 - r^2/R^2 of the level in the middle of it
    rows, columns = np.indices(image.shape)
    x, y = np.moveaxis(small.px_to_mm(np.stack([columns, rows], axis=-1).astype(float)), -1, 0)
    r = np.hypot(x + 0.1, y - 0.05)
    lit = image[r < 0.05]
    assert np.percentile(lit, 90) == pytest.approx(1000.0, rel=0.1)
    assert image[r > 0.42].max() == 0.0
    # of a paraboloid half of what fills the disc
    lenses = 0.5 * np.pi * 0.3**2 / small.lattice.cell_area
    radius_mm = small.aperture_radius_mm * small.microlens_distance_mm / small.image_distance_mm
    assert image.sum() == pytest.approx(lenses * np.pi * radius_mm**2 / small.pixel_mm**2 * 1000.0, rel=0.02)


def simulated(folder: Path, name: str, **simulation: object) -> Path:
    sections = channel_sections(TINY, simulation={"particles": 20, "rays": 500})
    sections["simulation"] |= simulation
    config = folder / f"{name}.yaml"
    config.write_text(yaml.safe_dump(sections))
    run("simulate", "particles", config, "-o", folder / name)
    return folder / name


def test_both_frames_show_the_same_bubbles_which_need_a_channel_beside_the_same_tracers(tmp_path: Path) -> None:
    noiseless = {"photons_per_count": None, "read_noise_counts": 0.0}
    plain = simulated(tmp_path, "plain", **noiseless)
    bubbly = simulated(tmp_path, "bubbly", **noiseless, bubbles=3, bubble_counts=9000.0, bubble_diameter_mm=[0.3, 0.4])
    difference = [
        read_image(bubbly / f"pair_{k}.tif").astype(float) - read_image(plain / f"pair_{k}.tif") for k in "ab"
    ]
    # counts are rounded
    np.testing.assert_allclose(*difference, atol=1.0)
    assert difference[0].max() > 8000.0
    reported = read_json(bubbly / "particles.json")["bubbles_mm"]
    assert np.shape(reported) == (3, 4)
    assert np.array(reported)[:, 1] + 0.5 * np.array(reported)[:, 3] == pytest.approx(np.full(3, 0.8))
    assert "bubbles_mm" not in read_json(plain / "particles.json")
    # Bubbles need a channel.
    sections = channel_sections(TINY, simulation={"bubbles": 1})
    sections["simulation"]["flow"] = {"kind": "uniform", "velocity_m_s": [0.1, 0.0, 0.0]}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(sections))
    with pytest.raises(ConfigError, match=r"simulation.bubbles: .* no square_duct"):
        run("simulate", "particles", tmp_path / "rig.yaml", "-o", tmp_path / "x")


def frames(rng, bright: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Return two frames of moved spots with noise and one bright thing that rests, and where that is."""
    spots = (rng.random((120, 120)) < 0.01) * 900.0
    rest = np.zeros((120, 120))
    rest[40:60, 70:95] = bright
    still = [np.roll(spots, 6 * k, axis=1) + rest + rng.normal(96.0, 6.0, rest.shape) for k in range(2)]
    return [image.astype(np.float32) for image in still], rest > 0.0


def test_still_light_is_what_rests_and_outshines_what_moves(rng: np.random.Generator) -> None:
    images, rest = frames(rng, 20_000.0)
    side = 2 * MARGIN_PX + 1
    expected = cv2.dilate(rest.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    np.testing.assert_array_equal(still_light(images, MARGIN_PX), expected)
    # what moves is not believed to rest, nor is what rests but is no brighter
    assert not still_light(frames(rng, 0.0)[0], MARGIN_PX).any()
    assert not still_light(frames(rng, 500.0)[0], MARGIN_PX).any()
    # Frames that hardly differ show no bubbles.
    image = (96.0 + 5000.0 * (rng.random((50, 50)) < 0.39)).astype(np.float32)
    with pytest.raises(InputError, match="hardly differ"):
        still_light([image, image + 1.0], MARGIN_PX)
    with pytest.raises(InputError, match="at least two"):
        still_light([image], MARGIN_PX)


@pytest.mark.thorough
def test_a_mask_of_what_is_still_is_that_of_its_image(tmp_path: Path) -> None:
    sample_weights(tmp_path, ("[30, 22, 40]", "[16, 12, 20]"))
    pair = []
    for name in "ab":
        image = read_image(SAMPLE / f"pair_{name}.tif").astype(np.uint16)
        image[180:230, 250:320] = 50_000
        tifffile.imwrite(tmp_path / f"{name}.tif", image)
        pair.append(image.astype(np.float32))
    # from lens to lens 0.1 mm of 0.0055 mm pixels, up to the next whole one
    tifffile.imwrite(tmp_path / "mask.tif", np.where(still_light(pair, 19), 0, 255).astype(np.uint8))
    images = [tmp_path / f"{name}.tif" for name in "ab"]
    common = ("reconstruct", tmp_path / "weights.h5", *images, "--iterations", 2)
    for name, mask in (("still", "still"), ("file", tmp_path / "mask.tif")):
        (tmp_path / name).mkdir()
        run(*common, "--mask", mask, "-o", tmp_path / name)
    found, given = (open_volume(tmp_path / name / "a.vtkhdf") for name in ("still", "file"))
    np.testing.assert_array_equal(found.array, given.array)
    assert found.attributes["excluded_pixels"] == (50 + 2 * 19) * (70 + 2 * 19)
    assert "mask: still over 2 frames, SHA-256" in found.provenance["command"]


@pytest.mark.thorough
def test_the_part_measures_beside_bubbles_in_all_ways(tmp_path: Path) -> None:
    found = bubbles(Work(tmp_path, "tiny", Console(only_warnings=True), {}))
    kept = {path.stem: read_json(path)["result"] for path in tmp_path.glob("*_figures.json")}
    assert set(kept) == {f"{name}_figures" for name in ("clean", "hidden", "paper", "bubbles", "background", "mask")}
    clean, hidden, masked = (kept[f"{name}_figures"] for name in ("clean", "hidden", "mask"))
    error, share = found.rows
    assert error.limit == pytest.approx(100.0 * (abs(hidden["mean_error"]) + 2.0 * hidden["mean_sigma"]))
    assert error.best == pytest.approx(100.0 * abs(masked["mean_error"]))
    assert share.limit == pytest.approx(100.0 * (hidden["within_25"] - 2.0 * hidden["within_sigma"]))
    # the mask leaves out what is saturated in any case, and the rims
    left_out = [figures["excluded_pixels"] for figures in (hidden, masked, kept["bubbles_figures"], clean)]
    assert left_out[0] == left_out[1] > left_out[2] > left_out[3]
    assert [drawing.name for drawing in found.drawings] == ["raw", "vectors", "profile"]


def test_bubbles_that_a_mask_does_not_make_good_miss_the_limit() -> None:
    figures = {"mean_error": -0.02, "mean_sigma": 0.01, "within_25": 0.9, "within_sigma": 0.02}
    found = {"hidden": figures, "mask": figures, "paper": figures | {"mean_error": -0.4, "within_25": 0.4}}
    assert [row.verdict for row in _rows(found)] == ["met", "met"]
    assert [row.verdict for row in _rows(found | {"mask": found["paper"]})] == ["missed", "missed"]
    assert [row.ert for row in _rows(found)] == pytest.approx([40.0, 40.0])


@pytest.fixture
def small_camera() -> Camera:
    """The paper's camera with a small_camera sensor."""
    return Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 300, 300)


def test_geometric_depth_moves_the_outermost_views_by_a_microlens(small_camera) -> None:
    depth = geometric_depth_mm(small_camera, WATER)
    near, far = equivalent_object_distance([0.0, depth], small_camera.focus_distance_mm, WATER)
    # a point on the axis, seen from both ends of the aperture, lies on the focal plane that far apart
    assert 2.0 * small_camera.aperture_radius_mm * (far - near) / near == pytest.approx(0.1, rel=0.01)


def test_depth_is_known_least_at_the_focal_plane_and_less_beside_neighbours(small_camera) -> None:
    view, tracers = raw_view(small_camera, WATER, 0.025), np.array([[0.023, -0.017, z, 5e5] for z in (-3.0, 0.0, 3.0)])
    sigma = errors_alone_mm(view, tracers, Readout())
    assert sigma[1, 2] > 10.0 * sigma[[0, 2], 2].max()
    # read noise alone: twice as much is twice the error
    quiet, loud = (errors_alone_mm(view, tracers[2:], Readout(None, noise, 96.0))[0, 2] for noise in (50.0, 100.0))
    assert loud == pytest.approx(2.0 * quiet, rel=0.01)
    # Neighbours cost accuracy.
    crowd = replace(small_camera, columns=160, rows=160)
    error_mm = of_camera.smallest_errors_crowded_mm
    few, many = (error_mm(crowd, WATER, each, 4.0, np.random.default_rng(3)) for each in (0.05, 1.0))
    assert many[2] > 1.2 * few[2]


@pytest.mark.thorough
def test_more_iterations_make_a_tracer_shorter(small_camera) -> None:
    first, later = (elongations_mm(small_camera, WATER, [3.0], SolverSettings("sart", count))[0] for count in (2, 12))
    assert 0.5 < later < first < 8.0


@pytest.mark.thorough
def test_the_part_names_the_papers_seeding_per_microlens(tmp_path: Path) -> None:
    found = discussion(Work(tmp_path, "tiny", Console(only_warnings=True), {}))
    # 330.6 pixels each
    assert "0.66 per microlens" in found.text[1]
    assert [drawing.name for drawing in found.drawings] == ["depth", "seeding"]
    assert len(found.tables[0].rows) == 1
