"""Two fields of one flow combined: no worse than the better one, honest about its errors, and not led astray."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.flow.combining import combine
from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, SECOND_PEAK, VALID, VectorField
from lfpiv_cli.grid import Grid, Reference
from tests.vector_fields import field_on

GRID = Grid((10, 11, 12), (0.8, 0.8, 0.8), (-3.6, -4.0, -4.4))
SHAPE = GRID.shape_zyx


def truth() -> Floats:
    """A shear in depth, voxels."""
    x, y, z = np.moveaxis(GRID.centres_mm(), -1, 0)
    return np.stack([2.0 + 0.5 * z, 0.3 * x, 0.2 * y], axis=-1)


def field_of(values: Floats, sigma: Floats) -> VectorField:
    return field_on(GRID, values, sigma_voxel=sigma, dt_s=0.002)


@pytest.fixture
def pair(rng: np.random.Generator) -> tuple[VectorField, VectorField]:
    """Noise that grows with depth in the one field and falls in the other, stated truly."""
    ramp = np.linspace(0.02, 0.2, SHAPE[0])[:, np.newaxis, np.newaxis, np.newaxis]
    sigmas = [np.broadcast_to(s, (*SHAPE, 3)).copy() for s in (ramp, ramp[::-1])]
    first, second = (field_of(truth() + rng.normal(0.0, sigma), sigma) for sigma in sigmas)
    return first, second


def rms(values: Floats) -> Floats:
    return np.sqrt(np.mean((values - truth()) ** 2, axis=(1, 2, 3)))


def test_the_combination_is_better_than_the_better_one_and_favours_none(pair: tuple[VectorField, VectorField]) -> None:
    found = combine(*pair)
    better = np.minimum(*(rms(field.displacement_voxel) for field in pair))
    # 330 values a depth: 4 % of the rms; what the worse one adds ranges from 1 to 50 % of the weight.
    assert np.all(rms(found.field.displacement_voxel) < 1.04 * better)
    middle = slice(5, 7)
    assert np.all(rms(found.field.displacement_voxel)[middle] < 0.8 * better[middle])
    assert found.field.uncertainty_voxel is not None
    ratio = (found.field.displacement_voxel - truth()) / found.field.uncertainty_voxel
    # 3,960 values: 1.1 %; those that chance took apart are one of a hundred.
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.04)
    assert np.all(found.field.flag == VALID)
    # Neither order nor field is favoured.
    one, other = combine(*pair), combine(*pair[::-1])
    np.testing.assert_allclose(one.field.displacement_voxel, other.field.displacement_voxel, atol=1e-12)
    np.testing.assert_allclose(one.first_share, 1.0 - other.first_share, atol=1e-12)


def test_outliers_of_either_are_left_out(pair: tuple[VectorField, VectorField], rng: np.random.Generator) -> None:
    wrong = rng.uniform(size=(2, *SHAPE)) < 0.03
    wrong[1] &= ~wrong[0]
    for field, where in zip(pair, wrong, strict=True):
        field.displacement_voxel[where] += rng.choice((-3.0, 3.0), (where.sum(), 3))
        # Bold about it: the smaller uncertainty is that of the wrong one.
        assert field.uncertainty_voxel is not None
        field.uncertainty_voxel[where] = 0.01
    found = combine(*pair)
    either = wrong.any(axis=0)
    error = np.abs(found.field.displacement_voxel - truth()).max(axis=-1)
    # Five standard deviations of the noisiest right one.
    assert error[either].max() < 1.0
    assert found.left_out[either].all()
    assert found.left_out[~either].mean() < 0.03


def test_uncertainties_that_are_too_small_are_found_out(pair: tuple[VectorField, VectorField]) -> None:
    first, second = pair
    assert second.uncertainty_voxel is not None
    sharp = field_of(truth() + 0.05 * (second.displacement_voxel - truth()), 0.05 * second.uncertainty_voxel)
    noisy = field_of(truth() + 3.0 * (first.displacement_voxel - truth()), first.uncertainty_voxel)
    found = combine(noisy, sharp)
    # Depth by depth the noise is another; of 1,320 differences a median tells the factor to 4 %.
    np.testing.assert_allclose(found.widened, [[3.0] * 3, [1.0] * 3], rtol=0.15)


def test_what_cannot_be_weighed_only_fills_gaps(pair: tuple[VectorField, VectorField]) -> None:
    first, second = pair
    flags = first.flag.copy(), second.flag.copy()
    flags[0][0], flags[1][1], flags[0][2], flags[1][2] = REPLACED, MASKED, REJECTED, REJECTED
    flags[0][3], flags[1][3], flags[0][4], flags[1][4] = REPLACED, REJECTED, SECOND_PEAK, REJECTED
    assert first.uncertainty_voxel is not None
    unknown = first.uncertainty_voxel.copy()
    # Ten vectors are too few to tell what they are worth.
    unknown[5, 0] = np.nan
    values = first.displacement_voxel.copy()
    values[2] = np.nan
    first = replace(first, flag=flags[0], uncertainty_voxel=unknown, displacement_voxel=values)
    second = replace(second, flag=flags[1])
    found = combine(first, second).field
    np.testing.assert_array_equal(found.displacement_voxel[0], second.displacement_voxel[0])
    np.testing.assert_array_equal(found.displacement_voxel[5, 0], second.displacement_voxel[5, 0])
    np.testing.assert_array_equal(found.displacement_voxel[[3, 4]], first.displacement_voxel[[3, 4]])
    expected = [VALID, MASKED, REJECTED, REPLACED, SECOND_PEAK, VALID]
    np.testing.assert_array_equal(found.flag[:6, 0, 0], expected)
    assert np.isnan(found.velocity[[1, 2]]).all()
    assert np.isfinite(found.velocity[found.flag <= SECOND_PEAK]).all()


def test_uncertainties_that_are_not_stated_are_those_of_the_differences(pair: tuple[VectorField, VectorField]) -> None:
    first, second = pair
    assert first.uncertainty_voxel is not None
    first.uncertainty_voxel[6:] = np.nan
    found = combine(first, second)
    assert found.field.uncertainty_voxel is not None
    ratio = (found.field.displacement_voxel - truth()) / found.field.uncertainty_voxel
    # One for all depths, where noise is .11 to .2: too small for the one half of them, too large for the other.
    assert np.sqrt(np.mean(ratio[6:] ** 2)) == pytest.approx(1.0, abs=0.1)
    better = np.minimum(*(rms(field.displacement_voxel) for field in pair))
    assert np.all(rms(found.field.displacement_voxel) < 1.06 * better)
    assert rms(found.field.displacement_voxel)[6] < 0.9 * better[6]


def test_the_command_writes_vectors_of_the_contract(pair: tuple[VectorField, VectorField], tmp_path: Path) -> None:
    paths = tmp_path / "a.vtkhdf", tmp_path / "b.vtkhdf"
    reference = Reference("mid_plane", -0.3)
    for path, field in zip(paths, pair, strict=True):
        vtkhdf.write_vectors(path, field, reference, provenance={}, overwrite=False)
    output = tmp_path / "c.vtkhdf"
    cli.main(["combine", *map(str, paths), "-o", str(output)], standalone_mode=False)
    written, found = vtkhdf.open_vectors(output), combine(*pair).field
    np.testing.assert_array_equal(written.displacement_voxel, found.displacement_voxel)
    np.testing.assert_array_equal(written.uncertainty_voxel, found.uncertainty_voxel)
    assert vtkhdf.read_header(output).reference == reference
    # Fields that do not fit are refused.
    other = replace(pair[1], grid=Grid((10, 11, 12), (0.8, 0.8, 0.8), (-3.6, -4.0, 0.0)))
    with pytest.raises(InputError, match="differ in grid"):
        combine(pair[0], other)
