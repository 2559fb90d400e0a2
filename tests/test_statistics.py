"""Mean and fluctuations of a batch, against numpy over the stack."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.flow.field import REJECTED, VectorField, statistics_of
from lfpiv_cli.grid import Grid

SHAPE = (2, 3, 4)


def fields(rng: np.random.Generator, count: int) -> list[VectorField]:
    ones, flag = np.ones(SHAPE), np.zeros(SHAPE, dtype=np.uint8)
    made = []
    for _ in range(count):
        # A large mean, in which sums of squares would lose the fluctuations.
        moved = 1e6 + rng.standard_normal((*SHAPE, 3))
        grid = Grid(SHAPE[::-1], (0.8,) * 3, (0.0,) * 3)
        made.append(VectorField(grid, moved, moved, ones, ones, ones, flag, None, (0.1,) * 3, 1e-3, (8, 8, 8)))
    return made


def test_mean_and_fluctuations_are_those_of_the_stack(rng: np.random.Generator) -> None:
    batch = fields(rng, 5)
    stack = np.stack([field.displacement_voxel for field in batch])
    found = statistics_of(iter(batch))
    np.testing.assert_allclose(found.mean.displacement_voxel, stack.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.rms_voxel, stack.std(axis=0), rtol=1e-8)
    np.testing.assert_allclose(found.mean.uncertainty_voxel, stack.std(axis=0, ddof=1) / np.sqrt(5.0), rtol=1e-8)
    assert np.all(found.samples == 5)


def test_rejected_vectors_count_for_nothing(rng: np.random.Generator) -> None:
    batch = fields(rng, 3)
    flag = np.zeros(SHAPE, dtype=np.uint8)
    flag[0, 0, 0] = REJECTED
    spoilt = np.where(flag[..., np.newaxis] == REJECTED, np.nan, batch[0].displacement_voxel)
    batch[0] = replace(batch[0], flag=flag, displacement_voxel=spoilt)
    nothing = [replace(field, flag=np.where(np.indices(SHAPE)[2] == 3, REJECTED, field.flag)) for field in batch]
    found = statistics_of(nothing)
    expected = np.mean([field.displacement_voxel[0, 0, 0] for field in batch[1:]], axis=0)
    np.testing.assert_allclose(found.mean.displacement_voxel[0, 0, 0], expected, rtol=1e-12)
    assert found.samples[0, 0, 0] == 2
    assert np.all(found.mean.flag[..., 3] == REJECTED)
    assert np.all(np.isnan(found.mean.velocity[..., 3, :]))


def test_fields_that_do_not_belong_together_have_no_mean(rng: np.random.Generator) -> None:
    one, other = fields(rng, 2)
    for batch in ([], [one, replace(other, dt_s=2e-3)]):
        with pytest.raises(InputError):
            statistics_of(batch)
