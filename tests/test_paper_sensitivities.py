"""What matters, and how much: errors of places as a map, wrong ideas of a rig, and the numbers made of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.optics.media import equivalent_object_distance
from lfpiv_cli.paper import small_rig
from lfpiv_cli.paper.influences import (
    DISTANCE,
    F_NUMBERS,
    FOCUS,
    INDEX,
    LEVER,
    NOISE,
    PAPER_PER_LENS,
    SEEDING,
    SHIFT,
    WALL,
    Influence,
)
from lfpiv_cli.paper.sensitivities import (
    INFLUENCES,
    Measured,
    care,
    crowding,
    drawing_of,
    rows_of,
    table_of,
)
from lfpiv_cli.paper.small_rig import CHANNEL, WATER, Case, Rig
from lfpiv_cli.validation.volume import TERMS, fit_errors, pairs_of

DEPTHS = np.array([-3.0, 0.0, 4.0])
FAINT = 1e-4


def places(count: int = 40) -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3)) * [1.0, 1.0, 4.0]


def apparent_mm(rig: Rig, z_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where paraxial rays see depths from the mid plane, from the lens."""
    depths = rig.reference.depth_to_focal_point(0.0) + z_mm
    return equivalent_object_distance(depths, rig.camera.focus_distance_mm, rig.media)


def believed_depth_mm(case: Case, z_mm: NDArray[np.float64]) -> NDArray[np.float64]:
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
def test_the_map_names_each_displacement(name: str, error: Callable[[NDArray[np.float64]], NDArray[np.float64]]):
    true = places()
    figures = fit_errors(true, error(true)).figures
    assert figures.pop(name) == pytest.approx(0.3, abs=1e-12)
    assert np.allclose(list(figures.values()), 0.0, atol=1e-12)


def test_the_map_tells_its_standard_errors_and_leaves_outliers_out():
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


def test_a_map_of_too_few_places_is_not_known():
    true = places(TERMS)
    assert np.isnan(list(fit_errors(true, true).figures.values())).all()


def test_tracers_apart_are_paired_whatever_their_depths_are_wrong_by():
    true = small_rig.strewn_apart(np.random.default_rng(2)).position_mm
    shuffled = np.random.default_rng(3).permutation(len(true))
    pairs = pairs_of(true[shuffled] + [0.02, -0.03, -2.7], true, small_rig.GATE_MM)
    assert len(pairs.true) == len(true)
    assert np.array_equal(shuffled[pairs.found], pairs.true)
    assert np.allclose(pairs.error_voxel, [0.02, -0.03, -2.7])


def test_a_straight_line_is_fitted_by_least_squares():
    figures = {"offset_z": np.array([[1.0], [3.3], [5.0]])}
    line = Measured(WALL, np.array([0.0, 1.0, 2.0]), figures).line(WALL.sensitivities[0])
    assert line == pytest.approx((1.1, 2.0))


def test_eq_21_a_wrong_index_is_right_at_the_inner_wall():
    wall = np.array([-0.5 * CHANNEL.width_mm])
    assert believed_depth_mm(small_rig.index_wrong(1.36), wall) == pytest.approx(wall)
    slope = (believed_depth_mm(small_rig.index_wrong(1.34), DEPTHS) - DEPTHS) / 0.01
    assert slope == pytest.approx((DEPTHS - wall) / WATER.fluid)


def test_eq_21_a_wrong_wall_shifts_depths():
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


def test_lens_images_are_believed_to_lie_further_by_what_is_said():
    case = small_rig.lattice_shifted(0.3)
    true, believed = (rig.camera.micro_image_lattice_px().origin for rig in (case.true, case.believed))
    assert believed - true == pytest.approx([0.3 * case.true.camera.micro_image_scale, 0.0])
    turned = small_rig.lattice_turned(0.1)
    assert turned.true.camera.lattice.rotation_rad == pytest.approx(-np.deg2rad(0.1))


def test_theory_of_the_slant_is_a_ray_through_another_place_of_the_lens():
    # one pixel is s_i/s_mu times as much on the main lens, 200 mm from the focal plane in air
    expected = next(each.expected for each in SHIFT.sensitivities)
    assert expected == pytest.approx(-0.0055 * LEVER / 200.0 / WATER.fluid)
    assert pytest.approx(250.0) == LEVER


def test_spherical_aberration_grows_as_the_square_of_the_aperture():
    assert small_rig.spherical_aberration_mm(4.0) == pytest.approx(4.0 * small_rig.spherical_aberration_mm(8.0))
    # n (2/3) (u^2/2) (t/n) (1 - 1/n^2) of 133.867 mm of water and of the window's 2 mm, u = 1/16
    layers = 133.867 / 1.33 * (1.0 - 1.33**-2) + 2.0 / 1.49 * (1.0 - 1.49**-2)
    assert small_rig.spherical_aberration_mm(4.0) == pytest.approx(1.33 / 3.0 / 256.0 * layers)


def test_the_papers_seeding_in_microlenses():
    assert pytest.approx(0.67, abs=0.005) == PAPER_PER_LENS


def test_tracers_that_are_strewn_are_as_many_as_asked_for_a_microlens():
    tracers = small_rig.strewn(0.5, np.random.default_rng(4))
    width = np.ptp(tracers.position_mm[:, 0])
    assert len(tracers.position_mm) / (width / 0.1) ** 2 == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize("influence", [INDEX, FOCUS, WALL, SHIFT])
def test_rows_are_met_by_theory_and_missed_beside_it(influence: Influence):
    assert [row.verdict for row in rows_of(by_theory(influence))] == ["met"] * len(rows_of(by_theory(influence)))
    assert {row.verdict for row in rows_of(by_theory(influence, 1.2))} == {"missed"}
    assert {row.verdict for row in rows_of(by_theory(influence, -1.0))} == {"missed"}


@pytest.mark.parametrize(("spread", "verdict"), [(1.4e-2, "met"), (1.6e-2, "missed"), (np.nan, "unknown")])
def test_scatter_is_held_against_its_bound(spread: float, verdict: str):
    found = lines_of(NOISE, {})
    found.figures["bound_z"][:], found.figures["spread_z"][:] = 1e-2, spread
    assert [row.verdict for row in rows_of(found)] == [verdict]


def test_a_sensitivity_that_is_not_known_has_no_verdict():
    measured = by_theory(WALL)
    unknown = replace_figures(measured, np.nan)
    assert {row.verdict for row in rows_of(unknown)} == {"unknown"}


def replace_figures(measured: Measured, value: float) -> Measured:
    return replace(measured, figures={name: np.full_like(table, value) for name, table in measured.figures.items()})


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
    found = lines_of(SEEDING, {})
    found.figures["recall"][:] = np.array(recall)[:, np.newaxis]  # type: ignore[index]
    assert told in crowding(found)


@pytest.mark.thorough
@pytest.mark.parametrize("influence", INFLUENCES, ids=lambda each: each.name)
def test_pictures_show_all_series(influence: Influence):
    drawing = drawing_of(by_theory(influence))
    labels = [text.get_text() for axes in drawing.figure.axes for text in axes.get_legend().get_texts()]
    assert labels == [label for panel in influence.panels for label in panel.series.values()]


def test_each_influence_has_a_picture_of_its_own():
    assert {each.name for each in INFLUENCES} > {F_NUMBERS.name, NOISE.name, DISTANCE.name}
    assert len({each.name for each in INFLUENCES}) == len(INFLUENCES) == 9
