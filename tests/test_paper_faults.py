"""Planted mistakes: limits that a good measurement sets, and the figures that miss them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from numpy.typing import NDArray

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.flow.field import VALID, VectorField
from lfpiv_cli.grid import Grid
from lfpiv_cli.paper import small_rig
from lfpiv_cli.paper.faults import (
    FAULTS,
    LIMIT_SIGMAS,
    NONE,
    WORDS,
    Limit,
    allowed,
    fault_rows,
    fault_table,
    limits_of,
    missed_limits,
    place_and_velocity_figures,
    said_to,
)
from lfpiv_cli.paper.parts import sections
from lfpiv_cli.paper.small_rig import displacement
from lfpiv_cli.reference import FOCAL_POINT

Points = NDArray[np.float64]
# Of places and displacements, x, y and z, mm.
SIGMA_MM = np.array([1e-4, 1e-4, 3e-3])


def tracks(seed: int, change: Any = lambda middle, moved: (middle, moved)) -> dict[str, float]:
    """Figures of tracks with noise, changed by a mistake."""
    rng = np.random.default_rng(seed)
    true = small_rig.strewn_apart(rng).position_mm
    moves = displacement(true)
    middle, moved = (values + rng.normal(0.0, SIGMA_MM, true.shape) for values in (true, moves))
    return place_and_velocity_figures(*change(middle, moved), true, moves)


LIMITS = limits_of(tracks(100))
SIGNS = np.array([1.0, 1.0, -1.0])


def test_a_good_measurement_is_within_its_limits():
    for seed in range(20):
        assert said_to(tracks(seed), LIMITS) == ""


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


def test_the_worst_figure_is_named_first():
    figures = tracks(1, lambda middle, moved: (middle + [1e-3, 4e-3, 0.0], moved))
    assert missed_limits(figures, LIMITS) == ["offset_y", "offset_x"]


def test_more_spread_is_a_miss_and_less_is_not():
    limit = LIMITS["spread_z"]
    assert limit.centre == pytest.approx(SIGMA_MM[2], rel=0.3)
    assert limit.over(0.0) == 0.0
    assert limit.over(limit.centre + 2.0 * limit.half_width) == pytest.approx(2.0)
    assert LIMITS["offset_x"].over(-2.0 * LIMITS["offset_x"].half_width) == pytest.approx(2.0)


def test_what_is_not_known_is_a_miss():
    assert Limit(0.0, 1.0, False).over(float("nan")) == np.inf
    figures = tracks(1) | {"stretch_z": float("nan")}
    assert missed_limits(figures, LIMITS) == ["stretch_z"]


def test_limits_are_standard_errors():
    figures = tracks(100)
    assert LIMITS["offset_z"].half_width == pytest.approx(LIMIT_SIGMAS * figures["offset_z_sigma"])
    assert set(LIMITS) == set(WORDS)
    assert allowed("offset_z", {"offset_z": Limit(0.0, 2e-3, False)}) == "\N{PLUS-MINUS SIGN}2 um"
    assert allowed("spread_z", {"spread_z": Limit(1e-3, 2e-3, True)}) == "up to 3 um"


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
    table = fault_table({"pair swapped": swapped}, good, LIMITS)
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


def test_a_mirrored_image_fits_the_lattice():
    # it is its own mirror image about the sensor's middle, so that nothing but signs tells
    lattice = small_rig.sheet().micro_image_lattice_px()
    middle = small_rig.sheet().sensor_centre_px
    assert lattice.origin == pytest.approx(middle)


def vectors_of_a_shear(turned: tuple[float, float, float]) -> VectorField:
    """Vectors of u = 0.1 m/s + z 20/s, w = 0.05 m/s, their components with signs."""
    grid = Grid.centred((4, 4, 5), (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    z = grid.centres_mm()[..., 2]
    velocity = np.stack([0.1 + 0.02 * z, 0.0 * z, 0.0 * z + 0.05], axis=-1) * turned
    moved = velocity * 1000.0 * 0.001 / 0.1
    ones, flag = np.ones(z.shape), np.full(z.shape, VALID, np.uint8)
    return VectorField(grid, moved, moved, ones, ones, ones, flag, None, (0.1, 0.1, 0.1), 0.001, (16, 16, 16))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("signs", "exit_code"),
    [((1.0, 1.0, 1.0), 0), ((-1.0, -1.0, -1.0), 8), ((-1.0, 1.0, 1.0), 8), ((1.0, 1.0, -1.0), 8)],
    ids=["no mistake", "pair swapped", "column axis mirrored", "z of the wrong sign"],
)
def test_validate_flow_fails_on_velocities_of_the_wrong_sign(
    signs: tuple[float, float, float], exit_code: int, tmp_path: Path
):
    flow = {"kind": "shear", "along": "x", "across": "z", "rate_per_s": 20.0, "velocity_m_s": [0.1, 0.0, 0.05]}
    limits = {"streamwise_mean_error": 0.05, "within_25_percent_vector": 0.9}
    config, vectors = tmp_path / "rig.yaml", tmp_path / "vectors.vtkhdf"
    config.write_text(yaml.safe_dump(sections(validation={"flow": flow, "limits": limits})))
    write_vectors(vectors, vectors_of_a_shear(signs), FOCAL_POINT, provenance={}, overwrite=False)
    ended = CliRunner().invoke(cli, ["validate", "flow", str(config), "--vectors", str(vectors), "-o", str(tmp_path)])
    told = ended.exception.exit_code if isinstance(ended.exception, LimitMissedError) else ended.exit_code
    assert told == exit_code, ended.output
