"""The vector field's units and flags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, SECOND_PEAK, VALID, VectorField
from lfpiv_cli.grid import Grid


@pytest.fixture
def field() -> VectorField:
    """Five windows in a row, one for each flag."""
    displacement = np.tile([1.0, -2.0, 0.5], (1, 1, 5, 1))
    ones = np.ones((1, 1, 5))
    flag = np.array([VALID, REPLACED, SECOND_PEAK, REJECTED, MASKED], dtype=np.uint8).reshape(1, 1, 5)
    grid = Grid((5, 1, 1), (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    return VectorField(
        grid, displacement, displacement, ones, ones, ones, flag, None, (0.1, 0.1, 0.2), 0.0018, (16, 16, 8)
    )


def test_velocity_is_displacement_over_time_in_metres(field: VectorField) -> None:
    # One voxel of 0.1 mm in 1.8 ms is 0.0556 m/s; along z the voxel is twice as long.
    np.testing.assert_allclose(field.velocity[0, 0, 0], [0.1e-3 / 0.0018, -0.2e-3 / 0.0018, 0.1e-3 / 0.0018])


def test_velocity_is_finite_up_to_the_second_peak(field: VectorField) -> None:
    assert np.array_equal(np.isfinite(field.velocity[0, 0, :, 0]), [True, True, True, False, False])
    assert np.all(np.isfinite(field.displacement_voxel))


def test_velocity_is_unknown_without_a_time(field: VectorField) -> None:
    assert np.all(np.isnan(replace(field, dt_s=None).velocity))
