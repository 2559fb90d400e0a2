"""Vector fields: units, flags, derived quantities, consistency, masks by walls; and two fields of one flow combined."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.flow import field as of_field
from lfpiv_cli.flow.combining import Paths, WindowGrid, combine, vectors_from_paths
from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.field import (
    MASKED,
    REJECTED,
    REPLACED,
    SECOND_PEAK,
    VALID,
    VectorField,
    derived_fields,
    difference_over_stated,
    divergence_over_stated,
)
from lfpiv_cli.flow.outliers import mixing, smooth_field, unresolved
from lfpiv_cli.flow.peaks import with_locking
from lfpiv_cli.flow.windows import CorrelationSettings, ParallelWalls, RoundWall, inside
from lfpiv_cli.grid import Grid, Reference, Scale
from tests.vector_fields import SIGMA_VOXEL, SPACING_MM, VOXEL_MM, field_of, field_on, noise_mm, places_mm, rotation_mm


@pytest.mark.parametrize("understated", [1.0, 5.0])
def test_divergence_tells_by_how_much_errors_are_understated(understated: float) -> None:
    field = field_of(rotation_mm() + noise_mm(0), SIGMA_VOXEL / understated)
    # 504 places, each sharing vectors with its neighbours: the median of so many scatters by a few hundredths.
    assert divergence_over_stated(field) == pytest.approx(understated, rel=0.15)


def test_a_source_shows_and_vectors_that_are_not_there_do_not_count() -> None:
    strength = 0.2
    field = field_of(strength * places_mm() + noise_mm(1), SIGMA_VOXEL)
    variance = sum((SIGMA_VOXEL * VOXEL_MM)[k] ** 2 / (2.0 * SPACING_MM[k] ** 2) for k in range(3))
    assert divergence_over_stated(field) == pytest.approx(3.0 * strength / np.sqrt(variance) / 0.6745, rel=0.1)
    moved = rotation_mm() + noise_mm(2)
    moved[4, 4, 4] = 1e3
    field = field_of(moved, SIGMA_VOXEL)
    field.flag[4, 4, 4] = MASKED
    assert divergence_over_stated(field) == pytest.approx(1.0, rel=0.15)


def test_what_cannot_be_known_is_none() -> None:
    assert divergence_over_stated(field_of(noise_mm(0), None)) is None
    field = field_of(noise_mm(0), SIGMA_VOXEL)
    elsewhere = replace(field, grid=replace(field.grid, origin_mm=(-4.0, 1.0, 2.5)))
    assert difference_over_stated(field, elsewhere) is None
    field.flag[2:] = MASKED
    assert divergence_over_stated(field) is None
    assert difference_over_stated(field, field_of(noise_mm(0), None)) is None


def test_two_measurements_differ_by_what_they_state_but_for_a_component_that_is_off() -> None:
    one, other = (field_of(rotation_mm() + noise_mm(seed), SIGMA_VOXEL) for seed in (3, 4))
    assert difference_over_stated(one, other) == pytest.approx([1.0, 1.0, 1.0], rel=0.1)
    moved = rotation_mm() + noise_mm(5)
    other = moved + noise_mm(6)
    other[..., 1] += 10.0 * (SIGMA_VOXEL * VOXEL_MM)[1]
    found = difference_over_stated(field_of(moved, SIGMA_VOXEL), field_of(other, SIGMA_VOXEL))
    assert found is not None
    assert found[1] > 8.0
    assert max(found[0], found[2]) < 1.2


def linear_field(gradient: np.ndarray, shape: tuple[int, int, int] = (4, 5, 6)) -> of_field.VectorField:
    """A linear flow of a given gradient (1/s), in voxels of 0.1 x 0.1 x 0.2 mm and 1 ms."""
    grid = Grid(shape[::-1], (0.8, 0.4, 1.6), (-1.0, 2.0, 0.5))
    moved = grid.centres_mm() * 1e-3 @ gradient.T * 1e-3 / (np.array([0.1, 0.1, 0.2]) * 1e-3)
    return field_on(grid, moved, voxel_mm=(0.1, 0.1, 0.2))


def test_rotation_shear_and_expansion() -> None:
    # Rigid rotation has twice its rate as vorticity, and no strain.
    rate = np.array([3.0, -5.0, 7.0])
    derived = derived_fields(linear_field(np.cross(np.eye(3), rate)))
    np.testing.assert_allclose(derived.vorticity, np.broadcast_to(2.0 * rate, derived.vorticity.shape), rtol=1e-9)
    np.testing.assert_allclose(derived.strain_rate, 0.0, atol=1e-9)
    np.testing.assert_allclose(derived.divergence, 0.0, atol=1e-9)
    np.testing.assert_allclose(derived.q_criterion, rate @ rate, rtol=1e-9)
    # Simple shear turns as much as it strains.
    gradient = np.zeros((3, 3))
    gradient[0, 2] = 30.0
    derived = derived_fields(linear_field(gradient))
    # du/dz > 0 turns from z towards x, right-handed about +y.
    np.testing.assert_allclose(derived.vorticity, np.broadcast_to([0.0, 30.0, 0.0], derived.vorticity.shape), atol=1e-9)
    np.testing.assert_allclose(derived.strain_rate, 30.0, rtol=1e-9)
    np.testing.assert_allclose(derived.q_criterion, 0.0, atol=1e-6)
    # Expansion is divergence only.
    derived = derived_fields(linear_field(np.diag([1.0, 2.0, 4.0])))
    np.testing.assert_allclose(derived.divergence, 7.0, rtol=1e-9)
    np.testing.assert_allclose(derived.vorticity, 0.0, atol=1e-9)
    assert derived.divergence_rms == pytest.approx(7.0)


def test_gradients_are_unknown_where_vectors_are_missing_or_there_is_one_plane() -> None:
    field = linear_field(np.diag([1.0, 2.0, 4.0]))
    flag = field.flag.copy()
    flag[2, 2, 3] = REJECTED
    divergence = derived_fields(replace(field, flag=flag)).divergence
    assert np.isnan(divergence[2, 2, 2])
    assert np.isnan(divergence[2, 2, 4])
    assert np.isfinite(divergence[0, 0, 0])
    assert derived_fields(linear_field(np.eye(3), (1, 5, 6))).divergence_rms is None


def test_velocity_is_displacement_over_time_in_metres_up_to_the_second_peak() -> None:
    flag = np.array([VALID, of_field.REPLACED, of_field.SECOND_PEAK, REJECTED, MASKED], dtype=np.uint8).reshape(1, 1, 5)
    grid, moved = Grid((5, 1, 1), (0.8, 0.8, 0.8), (0.0, 0.0, 0.0)), np.tile([1.0, -2.0, 0.5], (1, 1, 5, 1))
    field = field_on(grid, moved, flag, voxel_mm=(0.1, 0.1, 0.2), dt_s=0.0018)
    # One voxel of 0.1 mm in 1.8 ms is 0.0556 m/s; along z the voxel is twice as long.
    np.testing.assert_allclose(field.velocity[0, 0, 0], [0.1e-3 / 0.0018, -0.2e-3 / 0.0018, 0.1e-3 / 0.0018])
    assert np.array_equal(np.isfinite(field.velocity[0, 0, :, 0]), [True, True, True, False, False])
    assert np.all(np.isfinite(field.displacement_voxel))
    assert np.all(np.isnan(replace(field, dt_s=None).velocity))


SCALE = Scale(lens_mm=0.1, depth_mm=1.0)


def test_lateral_uncertainty_grows_in_the_focal_plane_alone(rng: np.random.Generator) -> None:
    grid = Grid((16, 16, 48), (0.05, 0.1, 0.2), (0.0, 0.0, -2.0))
    volume = rng.random(grid.shape_zyx).astype(np.float32)
    field = correlate([(volume, volume)], grid, CorrelationSettings([(8, 8, 8)], (0.5, 0.5, 0.5)))
    field = replace(field, uncertainty_voxel=np.zeros_like(field.uncertainty_voxel))
    # The focal plane lies at -1.2 mm in the volume's coordinates.
    stated = with_locking(field, Reference("mid_plane", 1.2), SCALE).uncertainty_voxel
    assert stated is not None
    assert np.all(stated[..., 2] == 0.0)
    np.testing.assert_allclose(stated[..., 0] * 0.05, stated[..., 1] * 0.1)
    depth = field.grid.axis_mm(2) + 1.2
    np.testing.assert_allclose(stated[:, 0, 0, 0] * 0.05, 0.1 * 0.1 * np.exp(-0.5 * depth**2), rtol=1e-12)


VOLUME = Grid.centred((40, 30, 20), (0.1, 0.1, 0.2), (0.0, 0.0, 0.0))
WINDOWS = WindowGrid(VOLUME, (8, 8, 4), (0.5, 0.5, 0.5))


def paths_in(count: int, share: float, rng: np.random.Generator) -> Paths:
    """Tracks in a share of the volume's width, from its lower end on."""
    low, high = np.array([VOLUME.bounds_mm(axis) for axis in range(3)]).T
    high[0] = low[0] + share * (high[0] - low[0])
    points = rng.uniform(low, high, (count, 3))
    return Paths(points, np.tile((0.05, 0.0, 0.0), (count, 1)), np.full((count, 3), 0.002))


@pytest.mark.parametrize("count", [200, 1000])
def test_a_region_without_tracks_has_no_vectors(count: int, rng: np.random.Generator) -> None:
    paths = paths_in(count, 0.6, rng)
    field = vectors_from_paths(paths, WINDOWS, None)
    low, high = VOLUME.bounds_mm(0)
    away = field.grid.axis_mm(0) - (low + 0.6 * (high - low))
    # From where a window, 0.8 mm wide, no longer reaches the tracks; the last of few lie up to 0.2 mm inside.
    assert np.all(field.flag[:, :, away > (0.4 if count == 1000 else 0.6)] == REJECTED)
    assert np.isnan(field.displacement_voxel[field.flag == REJECTED]).all()
    assert np.all(field.flag[:, :, away < 0.0] == VALID)
    # No window that holds a track loses its vector, wherever it is.
    off = np.abs(field.grid.centres_mm()[..., np.newaxis, :] - paths.middle_mm) / WINDOWS.sides_mm
    assert np.all(field.flag[np.any(np.all(off < 0.5, axis=-1), axis=-1)] == VALID)


def test_a_layer_without_tracks_has_no_vectors(rng: np.random.Generator) -> None:
    """As thick as a window, where a cube of what would hold many tracks reaches into those beside it."""
    paths = paths_in(3000, 1.0, rng)
    away = np.abs(paths.middle_mm[:, 1]) > 0.41
    field = vectors_from_paths(Paths(*(each[away] for each in vars(paths).values())), WINDOWS, None)
    beside = np.abs(field.grid.axis_mm(1))
    assert np.count_nonzero(beside < 0.01) == 1
    assert np.all(field.flag[:, beside < 0.01] == REJECTED)
    assert np.all(field.flag[:, beside > 0.01] == VALID)


@pytest.mark.parametrize("count", [80, 300, 3000])
def test_even_seeding_has_no_empty_regions(count: int, rng: np.random.Generator) -> None:
    # Where tracks are few the fit's reach may leave gaps of its own.
    wide = WindowGrid(VOLUME, (16, 16, 8), (0.5, 0.5, 0.5))
    field = vectors_from_paths(paths_in(count, 1.0, rng), wide, None)
    assert np.all(field.flag == VALID)


WINDOWED = (12, 16, 12)


def polynomial_field(degree: int) -> Floats:
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in WINDOWED), indexing="ij")
    return np.stack([0.7 * y**degree - 0.3 * z, 0.5 * x**degree, 0.2 * x - 0.1 * z**degree], axis=-1)


def test_filter_keeps_linear_flows_and_short_axes_and_damps_noise_everywhere(rng: np.random.Generator) -> None:
    linear = polynomial_field(1)
    np.testing.assert_allclose(smooth_field(linear), linear, atol=1e-12)
    noise = rng.normal(size=(*WINDOWED, 3))
    smoothed = smooth_field(noise)
    assert np.std(smoothed) < 0.6 * np.std(noise)
    assert np.std(smoothed[0, 0]) < np.std(noise[0, 0])
    field = np.arange(12.0).reshape(1, 2, 2, 3)
    np.testing.assert_allclose(smooth_field(field), field, rtol=1e-12)


def test_filter_keeps_curved_flows_away_from_the_borders_and_parabolas_at_them() -> None:
    cubic = polynomial_field(3)
    # The straight line at the ends is felt by two windows.
    inner = (slice(2, -2),) * 3
    np.testing.assert_allclose(smooth_field(cubic)[inner], cubic[inner], atol=1e-9)
    parabola = polynomial_field(2)
    # With the straight line through the outer three values at the ends, 2 F - F F would miss -0.1 z^2 by 5/36 of that.
    lost = np.abs(smooth_field(parabola) - parabola)[0, 8, 6, 2]
    assert lost < 0.5 * 0.1 * 5.0 / 36.0


def test_what_is_not_resolved_is_nothing_in_a_linear_flow_and_grows_around_a_spike() -> None:
    field = polynomial_field(1)
    np.testing.assert_allclose(unresolved(field), 0.002, rtol=1e-6)
    field[6, 8, 6, 1] += 1.0
    left = unresolved(field)[..., 1]
    # 1 - (10 / 16)^3 of the spike itself goes, shared with the 26 neighbours' smaller losses.
    lost = 1.0 - (10 / 16) ** 3
    assert lost / np.sqrt(27.0) < left[6, 8, 6] < 1.2 * lost / np.sqrt(27.0)
    assert left[5, 7, 7] > 0.9 * left[6, 8, 6]
    assert left[0, 0, 0] == pytest.approx(0.002, rel=1e-6)


def test_mixing_is_the_mean_over_a_particle_s_length() -> None:
    sigma, step = 6.0, 8
    field = polynomial_field(2)
    places = np.linspace(-30.0, 30.0, 601)
    weights = np.exp(-((places / sigma) ** 2))
    mean = np.average(np.square(places), weights=weights) / step**2
    found = mixing(field, np.array([0.0, 0.0, sigma]), (step,) * 3)
    # Away from the ends, whose straight lines bend the parabola. Only the third component is curved along z, by -0.2.
    inner = (slice(2, -2),) * 3
    np.testing.assert_allclose(found[inner], np.broadcast_to([0.0, 0.0, -0.1 * mean], found[inner].shape), atol=1e-6)
    assert np.all(found[0] == 0.0)
    assert np.all(mixing(field, np.zeros(3), (step,) * 3) == 0.0)


def test_voxels_of_a_pipe_are_those_whose_centres_it_contains() -> None:
    grid = Grid((2, 3, 4), (0.1, 0.2, 0.5), (1.0, -2.0, 3.0))
    centres = grid.centres_mm()
    assert centres.shape == (4, 3, 2, 3)
    np.testing.assert_allclose(centres[[3, 0], 2, [1, 0]], [[1.1, -1.6, 4.5], [1.0, -1.6, 3.0]])
    grid = Grid.centred((2, 12, 13), (0.3, 0.3, 0.3), (0.4, 0.0, 0.2))
    np.testing.assert_array_equal(inside(grid, PIPE), PIPE.contain(grid.centres_mm()))


def test_voxels_and_windows_count_as_far_as_they_lie_between_the_walls() -> None:
    grid = Grid.centred((1, 2, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    found = inside(grid, ParallelWalls(3.0))
    assert found.shape == grid.shape_zyx
    # centres at -2, -1, 0, 1, 2; walls at -1.5 and 1.5
    np.testing.assert_array_equal(found[:, 0, 0], [False, True, True, True, False])
    np.testing.assert_array_equal(found[:, 1, 0], found[:, 0, 0])
    share = ParallelWalls(3.0).shares(grid.centres_mm(), np.array([1.0, 1.0, 2.0]))[:, 0, 0]
    # a window from -3 to -1 has a quarter of its depth behind the wall at -1.5, one from -2 to 0 three quarters
    np.testing.assert_allclose(share, [0.25, 0.75, 1.0, 0.75, 0.25])


def test_a_slice_of_a_box_in_a_pipe_is_what_lies_in_both(rng: np.random.Generator) -> None:
    low = rng.uniform(-1.5, 1.0, (40, 2))
    high = low + rng.uniform(0.0, 2.0, (40, 2))
    slices = np.insert(low, 0, 0.0, axis=1), np.insert(high, 0, 1.0, axis=1)
    area = RoundWall(1.0).volumes_mm3(*slices)
    # cells of 1/200 of a side: of those that the circle cuts half count too much and half too little
    share = (np.arange(200) + 0.5) / 200
    x, y = (low[:, axis, np.newaxis] + share * (high - low)[:, axis, np.newaxis] for axis in range(2))
    counted = np.mean(x[:, :, np.newaxis] ** 2 + y[:, np.newaxis] ** 2 <= 1.0, axis=(1, 2))
    np.testing.assert_allclose(area, counted * np.prod(high - low, axis=1), atol=4e-3)
    assert RoundWall(1.0).volumes_mm3(np.array([0.0, -2.0, -1.0]), np.array([1.0, 2.0, 3.0])) == np.float64(np.pi)


PIPE = RoundWall(1.3, (0.4, -0.2, 0.3), "x")


def test_boxes_that_fill_a_pipe_hold_all_of_it() -> None:
    grid = Grid.centred((3, 9, 11), (0.5, 0.4, 0.3), (0.0, 0.0, 0.0))
    sides = np.array(grid.spacing_mm)
    share = PIPE.shares(grid.centres_mm(), sides)
    assert share.min() == 0.0
    np.testing.assert_allclose(share.max(), 1.0, rtol=1e-12)
    np.testing.assert_allclose(share.sum() * np.prod(sides), np.pi * 1.3**2 * 1.5, rtol=1e-12)
    nothing = np.array([[0.0, 0.0, 0.0]]), np.array([[1.0, -0.1, 1.0]])
    assert PIPE.volumes_mm3(*nothing) == 0.0


def test_a_pipe_along_y_is_one_along_x_with_axes_exchanged(rng: np.random.Generator) -> None:
    other = RoundWall(1.3, (-0.2, 0.4, 0.3), "y")
    points = rng.uniform(-2.0, 2.0, (300, 3))
    turned = points[:, [1, 0, 2]]
    contained = PIPE.contain(points)
    assert 0 < contained.sum() < 300
    np.testing.assert_array_equal(contained, other.contain(turned))
    sides = np.array([0.3, 0.7, 0.5])
    np.testing.assert_allclose(PIPE.shares(points, sides), other.shares(turned, sides[[1, 0, 2]]))


def test_a_tilted_pipe_is_a_round_one_about_its_axis(rng: np.random.Generator) -> None:
    tilted = RoundWall(1.3, (0.4, -0.2, 0.3), (1.0, 0.03, -0.04))
    assert (tilted.along, tilted.tilt_deg) == (0, pytest.approx(np.rad2deg(np.arctan(0.05))))
    at = rng.uniform(-2.0, 2.0, 50)
    on_axis = np.array(tilted.centre_mm) + at[:, np.newaxis] * np.array(tilted.axis)
    np.testing.assert_allclose(tilted.distances_mm(on_axis), 0.0, atol=1e-12)
    # halves of boxes are as full as the points in them say: 40,000 leave 0.003 of chance
    grid = Grid.centred((3, 4, 4), (1.0, 0.7, 0.7), (0.0, 0.0, 0.0))
    sides, centres = np.array(grid.spacing_mm), grid.centres_mm().reshape(-1, 3)
    points = centres[:, np.newaxis] + sides * rng.uniform(-0.5, 0.5, (len(centres), 40_000, 3))
    np.testing.assert_allclose(tilted.shares(centres, sides), tilted.contain(points).mean(axis=1), atol=0.012)
    low, high = np.array([-1.0, -1.0, -2.0]), np.array([1.0, 2.0, 2.0])
    wall = tilted.points(low, high, np.array([0.5, 0.2, 0.3]))
    # rings stand across x: they are off by the tilt's square
    np.testing.assert_allclose(tilted.distances_mm(wall), 1.3, rtol=2e-3)
    assert len(wall) > 100
    assert np.all((wall >= low) & (wall <= high))


def test_points_on_walls_leave_no_gaps_and_are_in_the_box() -> None:
    low, high = np.array([-1.0, -1.0, -2.0]), np.array([1.0, 2.0, 2.0])
    found = PIPE.points(low, high, np.array([0.5, 0.2, 0.3]))
    np.testing.assert_allclose(PIPE.distances_mm(found), 1.3)
    assert np.all((found >= low) & (found <= high))
    # the box cuts the wall at y = -1: cos of the angle from the axis is -0.8 / 1.3 there, on both sides
    angles = np.unique(np.round(np.arctan2(found[:, 2] - 0.3, found[:, 1] + 0.2), 9))
    assert np.abs(angles).max() <= np.arccos(-0.8 / 1.3)
    assert np.diff(angles).max() * 1.3 <= 0.2 + 1e-9
    assert np.diff(np.unique(found[:, 0])).max() <= 0.5
    np.testing.assert_allclose([found[:, 0].min(), found[:, 0].max()], [-1.0, 1.0])
    low, high = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 2.0])
    found = ParallelWalls(3.0).points(low, high, np.array([0.5, 1.0, 1.0]))
    assert found.shape == (15, 3)
    np.testing.assert_array_equal(found[:, 2], 1.5)


GRID = Grid((10, 11, 12), (0.8, 0.8, 0.8), (-3.6, -4.0, -4.4))
SHAPE = GRID.shape_zyx


def truth() -> Floats:
    """A shear in depth, voxels."""
    x, y, z = np.moveaxis(GRID.centres_mm(), -1, 0)
    return np.stack([2.0 + 0.5 * z, 0.3 * x, 0.2 * y], axis=-1)


def stated_field(values: Floats, sigma: Floats) -> VectorField:
    return field_on(GRID, values, sigma_voxel=sigma, dt_s=0.002)


@pytest.fixture
def pair(rng: np.random.Generator) -> tuple[VectorField, VectorField]:
    """Noise that grows with depth in the one field and falls in the other, stated truly."""
    ramp = np.linspace(0.02, 0.2, SHAPE[0])[:, np.newaxis, np.newaxis, np.newaxis]
    sigmas = [np.broadcast_to(s, (*SHAPE, 3)).copy() for s in (ramp, ramp[::-1])]
    first, second = (stated_field(truth() + rng.normal(0.0, sigma), sigma) for sigma in sigmas)
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
    sharp = stated_field(truth() + 0.05 * (second.displacement_voxel - truth()), 0.05 * second.uncertainty_voxel)
    noisy = stated_field(truth() + 3.0 * (first.displacement_voxel - truth()), first.uncertainty_voxel)
    found = combine(noisy, sharp)
    # Depth by depth the noise is another; of 1,320 differences a median shows the factor to 4 %.
    np.testing.assert_allclose(found.widened, [[3.0] * 3, [1.0] * 3], rtol=0.15)


def test_where_vectors_err_alike_by_more_than_stated_they_count_for_less(pair: tuple[VectorField, VectorField]) -> None:
    first, second = pair
    assert first.uncertainty_voxel is not None
    # Three depths of twelve, of the noisier field, one way.
    depths = slice(8, 11)
    first.displacement_voxel[depths] += 2.0 * first.uncertainty_voxel[depths]
    found = combine(first, second).field
    assert found.uncertainty_voxel is not None
    error = found.displacement_voxel - truth()
    assert np.all(rms(found.displacement_voxel)[depths] < 1.1 * rms(second.displacement_voxel)[depths])
    assert np.sqrt(np.mean((error / found.uncertainty_voxel)[depths] ** 2)) < 1.3


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
