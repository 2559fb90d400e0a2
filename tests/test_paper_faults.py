"""Planted mistakes and wrong ideas of a rig: what they do to a measurement, and the figures that give them away."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from lfpiv_cli.arrays import Floats
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.grid import FOCAL_POINT, Grid
from lfpiv_cli.optics.media import equivalent_object_distance
from lfpiv_cli.paper import faults, influences, small_rig
from lfpiv_cli.paper.faults import FAULTS, LIMIT_SIGMAS, NONE, WORDS, Limit, allowed, fault_rows, missed_limits, said_to
from lfpiv_cli.paper.influences import DISTANCE, F_NUMBERS, FOCUS, INDEX, LEVER, NOISE, SHIFT, WALL, Influence
from lfpiv_cli.paper.parts import sections
from lfpiv_cli.paper.sensitivities import INFLUENCES, Measured, care, crowding, drawing_of, rows_of, table_of
from lfpiv_cli.paper.small_rig import CHANNEL, WATER, Case, Rig, displacement
from lfpiv_cli.validation.volume import TERMS, fit_errors, pairs_of
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
    assert [fault.name for fault in FAULTS] == [
        "index 1.30 for 1.33",
        "z of the wrong sign",
        "images half a pixel off",
        "lattice turned by 0.02 degrees",
        "column axis mirrored",
        "pair swapped",
    ]
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
    told = ended.exception.exit_code if isinstance(ended.exception, LimitMissedError) else ended.exit_code
    assert told == exit_code, ended.output


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
    figures = fit_errors(true, error(true)).figures
    assert figures.pop(name) == pytest.approx(0.3, abs=1e-12)
    assert np.allclose(list(figures.values()), 0.0, atol=1e-12)


def test_the_map_tells_its_standard_errors_and_leaves_outliers_out_and_needs_places():
    rng, true = np.random.default_rng(1), places(4000)
    error = rng.normal(0.0, [0.01, 0.01, 0.2], true.shape)
    error[:40, 2] += 50.0
    fitted = fit_errors(true, error)
    figures, sigma = fitted.figures, fitted.sigma
    assert fitted.count <= len(true) - 40
    assert all(abs(figures[name]) < 5.0 * sigma[name] for name in figures if not name.startswith("spread"))
    assert figures["spread_z"] == pytest.approx(0.2, abs=5.0 * sigma["spread_z"])
    # the mean of n values of this spread
    assert sigma["offset_z"] == pytest.approx(0.2 / np.sqrt(len(true)), rel=0.1)
    true = places(TERMS)
    assert np.isnan(list(fit_errors(true, true).figures.values())).all()


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


def test_what_harms_most_comes_first():
    found = [by_theory(INDEX), by_theory(WALL), by_theory(FOCUS), by_theory(SHIFT)]
    text = care(found)
    # 0.3 mm of wall, 0.1 mm of focus, 0.005 of index: 0.27, 0.13 and 0.019 mm; lens images harm least
    assert text.index("0.27 mm") < text.index("0.13 mm") < text.index("0.019 mm")
    assert "white image" not in text
    assert [row[0] for row in table_of(found).rows][:2] == ["wall", "focus"]
    # a wall that is known to the micrometre: what harms is something else
    known = replace(WALL, typical=(0.001, ""))
    assert "calliper" not in care([by_theory(known), *found[:1], *found[2:]])


@pytest.mark.parametrize(("recall", "told"), [((0.97, 0.95, 0.6), "from 1.2 on"), ((1.0, 1.0, 1.0), "at none")])
def test_from_where_tracers_crowd(recall: tuple[float, ...], told: str):
    found = lines_of(influences.SEEDING, {})
    found.figures["recall"][:] = np.array(recall)[:, np.newaxis]  # type: ignore[index]
    assert told in crowding(found)


@pytest.mark.thorough
@pytest.mark.parametrize("influence", INFLUENCES, ids=lambda each: each.name)
def test_pictures_show_all_series(influence: Influence):
    drawing = drawing_of(by_theory(influence))
    labels = [text.get_text() for axes in drawing.figure.axes for text in axes.get_legend().get_texts()]
    assert labels == [label for panel in influence.panels for label in panel.series.values()]
