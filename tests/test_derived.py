"""Derived fields of flows whose gradients are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.flow.field import REJECTED, VectorField, derived_fields
from lfpiv_cli.grid import Grid

SHAPE = (4, 5, 6)


def field_of(gradient: np.ndarray, shape: tuple[int, int, int] = SHAPE) -> VectorField:
    """A linear flow of a given gradient (1/s), in voxels of 0.1 x 0.1 x 0.2 mm and 1 ms."""
    grid = Grid(shape[::-1], (0.8, 0.4, 1.6), (-1.0, 2.0, 0.5))
    z, y, x = np.meshgrid(*(grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    velocity = np.stack([x, y, z], axis=-1) * 1e-3 @ gradient.T
    displacement = velocity * 1e-3 / (np.array([0.1, 0.1, 0.2]) * 1e-3)
    ones, flag = np.ones(shape), np.zeros(shape, dtype=np.uint8)
    return VectorField(grid, displacement, displacement, ones, ones, ones, flag, None, (0.1, 0.1, 0.2), 1e-3, (8, 8, 8))


def test_rigid_rotation_has_twice_its_rate_as_vorticity_and_no_strain() -> None:
    rate = np.array([3.0, -5.0, 7.0])
    derived = derived_fields(field_of(np.cross(np.eye(3), rate)))
    np.testing.assert_allclose(derived.vorticity, np.broadcast_to(2.0 * rate, (*SHAPE, 3)), rtol=1e-9)
    np.testing.assert_allclose(derived.strain_rate, 0.0, atol=1e-9)
    np.testing.assert_allclose(derived.divergence, 0.0, atol=1e-9)
    np.testing.assert_allclose(derived.q_criterion, rate @ rate, rtol=1e-9)


def test_simple_shear_turns_as_much_as_it_strains() -> None:
    gradient = np.zeros((3, 3))
    gradient[0, 2] = 30.0
    derived = derived_fields(field_of(gradient))
    # du/dz > 0 turns from z towards x, right-handed about +y.
    np.testing.assert_allclose(derived.vorticity, np.broadcast_to([0.0, 30.0, 0.0], (*SHAPE, 3)), atol=1e-9)
    np.testing.assert_allclose(derived.strain_rate, 30.0, rtol=1e-9)
    np.testing.assert_allclose(derived.q_criterion, 0.0, atol=1e-6)


def test_expansion_is_divergence_only() -> None:
    derived = derived_fields(field_of(np.diag([1.0, 2.0, 4.0])))
    np.testing.assert_allclose(derived.divergence, 7.0, rtol=1e-9)
    np.testing.assert_allclose(derived.vorticity, 0.0, atol=1e-9)
    assert derived.divergence_rms == pytest.approx(7.0)


def test_gradients_are_unknown_where_vectors_are_missing_or_there_is_one_plane() -> None:
    field = field_of(np.diag([1.0, 2.0, 4.0]))
    flag = field.flag.copy()
    flag[2, 2, 3] = REJECTED
    divergence = derived_fields(replace(field, flag=flag)).divergence
    assert np.isnan(divergence[2, 2, 2])
    assert np.isnan(divergence[2, 2, 4])
    assert np.isfinite(divergence[0, 0, 0])
    assert derived_fields(field_of(np.eye(3), (1, 5, 6))).divergence_rms is None
