"""What a flow says against its own vectors: its divergence, and a second measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.flow.field import MASKED, difference_over_stated, divergence_over_stated
from lfpiv_cli.grid import Grid
from tests.vector_fields import SHAPE, SIGMA_VOXEL, SPACING_MM, VOXEL_MM, field_of, noise_mm, places_mm, rotation_mm


@pytest.mark.parametrize("understated", [1.0, 5.0])
def test_divergence_tells_by_how_much_errors_are_understated(understated: float) -> None:
    field = field_of(rotation_mm() + noise_mm(0), SIGMA_VOXEL / understated)
    # 504 places, each sharing vectors with its neighbours: the median of so many scatters by a few hundredths.
    assert divergence_over_stated(field) == pytest.approx(understated, rel=0.15)


def test_a_source_shows() -> None:
    strength = 0.2
    field = field_of(strength * places_mm() + noise_mm(1), SIGMA_VOXEL)
    variance = sum((SIGMA_VOXEL * VOXEL_MM)[k] ** 2 / (2.0 * SPACING_MM[k] ** 2) for k in range(3))
    assert divergence_over_stated(field) == pytest.approx(3.0 * strength / np.sqrt(variance) / 0.6745, rel=0.1)


def test_vectors_that_are_not_there_do_not_count() -> None:
    moved = rotation_mm() + noise_mm(2)
    moved[4, 4, 4] = 1e3
    field = field_of(moved, SIGMA_VOXEL)
    field.flag[4, 4, 4] = MASKED
    assert divergence_over_stated(field) == pytest.approx(1.0, rel=0.15)


def test_what_cannot_be_known_is_none() -> None:
    assert divergence_over_stated(field_of(noise_mm(0), None)) is None
    field = field_of(noise_mm(0), SIGMA_VOXEL)
    field.flag[2:] = MASKED
    assert divergence_over_stated(field) is None
    assert difference_over_stated(field, field_of(noise_mm(0), None)) is None


def test_two_measurements_differ_by_what_they_state() -> None:
    one, other = (field_of(rotation_mm() + noise_mm(seed), SIGMA_VOXEL) for seed in (3, 4))
    assert difference_over_stated(one, other) == pytest.approx([1.0, 1.0, 1.0], rel=0.1)


def test_a_component_that_is_off_shows_in_it_alone() -> None:
    moved = rotation_mm() + noise_mm(5)
    other = moved + noise_mm(6)
    other[..., 1] += 10.0 * (SIGMA_VOXEL * VOXEL_MM)[1]
    found = difference_over_stated(field_of(moved, SIGMA_VOXEL), field_of(other, SIGMA_VOXEL))
    assert found is not None
    assert found[1] > 8.0
    assert max(found[0], found[2]) < 1.2


def test_other_places_are_not_compared() -> None:
    one = field_of(noise_mm(0), SIGMA_VOXEL)
    other = replace(one, grid=Grid(SHAPE[::-1], SPACING_MM, (-4.0, 1.0, 2.5)))
    assert difference_over_stated(one, other) is None
