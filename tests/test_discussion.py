"""How well depth can be told: the geometry of the views, the bound of a tracer, and its reconstructed length."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.console import Console
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.paper.discussion import (
    discussion,
    elongations_mm,
    geometric_depth_mm,
    smallest_errors_crowded_mm,
    smallest_errors_mm,
)
from lfpiv_cli.paper.parts import Work
from lfpiv_cli.reconstruction.solvers import SolverSettings
from lfpiv_cli.synthetic.render import Readout

WATER = Media(1.0, 1.49, 1.33)


@pytest.fixture
def small() -> Camera:
    """The paper's camera with a small sensor."""
    return Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 300, 300)


def test_geometric_depth_moves_the_outermost_views_by_a_microlens(small):
    depth = geometric_depth_mm(small, WATER)
    near, far = equivalent_object_distance([0.0, depth], small.focus_distance_mm, WATER)
    # a point on the axis, seen from both ends of the aperture, lies on the focal plane that far apart
    assert 2.0 * small.aperture_radius_mm * (far - near) / near == pytest.approx(0.1, rel=0.01)


def test_the_light_says_least_of_depth_at_the_focal_plane(small):
    sigma = smallest_errors_mm(small, WATER, [-3.0, 0.0, 3.0], Readout())
    assert sigma[1, 2] > 10.0 * sigma[[0, 2], 2].max()
    # read noise alone: twice as much is twice the error
    quiet, loud = (smallest_errors_mm(small, WATER, [2.0], Readout(None, noise, 96.0))[0, 2] for noise in (50.0, 100.0))
    assert loud == pytest.approx(2.0 * quiet, rel=0.01)


def test_neighbours_cost_accuracy(small):
    crowd = replace(small, columns=160, rows=160)
    few, many = (
        smallest_errors_crowded_mm(crowd, WATER, each, 4.0, Readout(), np.random.default_rng(3)) for each in (0.05, 1.0)
    )
    assert many[2] > 1.2 * few[2]


@pytest.mark.thorough
def test_more_iterations_make_a_tracer_shorter(small):
    first, later = (elongations_mm(small, WATER, [3.0], SolverSettings("sart", count))[0] for count in (2, 12))
    assert 0.5 < later < first < 8.0


@pytest.mark.thorough
def test_the_part_names_the_papers_seeding_per_microlens(tmp_path: Path):
    found = discussion(Work(tmp_path, "tiny", Console(only_warnings=True), {}))
    # 330.6 pixels each
    assert "0.66 per microlens" in found.text[1]
    assert [drawing.name for drawing in found.drawings] == ["depth", "seeding"]
    assert len(found.tables[0].rows) == 1
