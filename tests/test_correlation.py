"""Displacements of known particle volumes: signs, sub-voxel accuracy, borders, odd windows, empty volumes."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.flow.correlation import correlate, count_passes
from lfpiv_cli.flow.deformation import deform_pair, spline_coefficients, spline_matrix
from lfpiv_cli.flow.field import MASKED, REJECTED, VectorField
from lfpiv_cli.flow.peaks import find_peaks, vertex
from lfpiv_cli.flow.windows import CorrelationSettings, layout_windows
from lfpiv_cli.grid import Grid

HALF = (0.5, 0.5, 0.5)
MOVED = (1.3, -0.7, 0.4)
COMMON = CorrelationSettings([(16, 16, 16)], HALF)
# A corner's window has lost half of its 8 particles, and the faces cut others.
CORNER = 0.1
Flow = Callable[[Floats], Floats]


def unit_grid(shape_xyz: tuple[int, int, int]) -> Grid:
    """A grid whose mm are voxel indices."""
    return Grid(shape_xyz, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))


def particle_volume(centres: Floats, shape_xyz: tuple[int, int, int], sigma: tuple[float, float, float]) -> Singles:
    """Gaussian particles (n, 3), in voxels, as a volume [z, y, x]."""
    profiles = [
        np.exp(-0.5 * ((np.arange(n)[:, np.newaxis] - centres[:, axis]) / s) ** 2)
        for axis, (n, s) in enumerate(zip(shape_xyz, sigma, strict=True))
    ]
    return np.einsum("zn,yn,xn->zyx", profiles[2], profiles[1], profiles[0], optimize=True).astype(np.float32)


def moving_pair(
    flow: Flow,
    shape_xyz: tuple[int, int, int],
    rng: np.random.Generator,
    per_window: float = 8.0,
    sigma: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> tuple[Singles, Singles]:
    """Two volumes half a displacement before and after; particles also beyond the faces, so that some come and go."""
    beyond = 8.0
    sides = np.array(shape_xyz) + 2 * beyond
    centres = rng.random((int(per_window * np.prod(sides) / 16**3), 3)) * sides - beyond
    half = 0.5 * flow(centres)
    return particle_volume(centres - half, shape_xyz, sigma), particle_volume(centres + half, shape_xyz, sigma)


def truth_at(field: VectorField, flow: Flow) -> Floats:
    points = field.grid.centres_mm()
    return flow(points.reshape(-1, 3)).reshape(points.shape)


def rigid(*shift: float) -> Flow:
    return lambda points: np.broadcast_to(np.array(shift), points.shape)


def root_mean_square(error: Floats) -> Floats:
    return np.sqrt(np.mean(error**2, axis=(0, 1, 2)))


def test_windows_are_centred_in_the_volume_and_give_the_paper_s_number() -> None:
    layout = layout_windows((100, 130, 100), (16, 16, 16), HALF)
    assert layout.count == (12, 16, 12)
    # 100 = 2 + 12 x 8 + 2 and 130 = 1 + 16 x 8 + 1: cells of 8 in the middle, windows 4 wider on both sides.
    assert layout.first == (-2, -3, -2)
    # Grid of window centres is in millimetres.
    volume = Grid.centred((100, 130, 100), (0.1, 0.1, 0.1), (1.0, 2.0, 3.0))
    centres = layout_windows((100, 130, 100), (16, 16, 16), HALF).grid(volume)
    for axis, middle in enumerate((1.0, 2.0, 3.0)):
        assert np.mean(centres.axis_mm(axis)) == pytest.approx(middle)
    assert centres.spacing_mm == pytest.approx((0.8, 0.8, 0.8))


@pytest.mark.parametrize(("voxels", "size", "overlap"), [(100, 16, 0.5), (37, 16, 0.75), (50, 17, 0.5), (5, 16, 0.5)])
def test_windows_are_centred_in_the_volume(voxels: int, size: int, overlap: float) -> None:
    layout = layout_windows((voxels, 8, 8), (size, 8, 8), (overlap, 0.0, 0.0))
    centres = layout.centres_voxel(0)
    assert layout.count[0] == max(1, voxels // layout.step[0])
    # Windows start on whole voxels: an odd remainder shifts them by half a voxel.
    assert abs(0.5 * (centres[0] + centres[-1]) - 0.5 * (voxels - 1)) <= 0.5


def test_peaks_of_gaussians_are_exact_and_second_ones_are_maxima_of_their_own() -> None:
    shifts = np.arange(-2, 3)
    place, width = np.array([0.3, -0.4, 0.2]), np.array([1.4, 1.2, 2.0])
    x, y, z = (np.exp(-0.5 * ((shifts - p) / w) ** 2) for p, w in zip(place, width, strict=True))
    peaks = find_peaks(np.einsum("z,y,x->zyx", z, y, x)[np.newaxis, np.newaxis, np.newaxis])
    np.testing.assert_allclose(peaks.offset[0, 0, 0], place, atol=1e-12)
    np.testing.assert_allclose(peaks.width[0, 0, 0], width, rtol=1e-12)
    assert peaks.second_height[0, 0, 0] == 0.0
    # Second peak is a maximum of its own.
    shifts = np.arange(-3, 4)
    first = np.exp(-0.5 * (shifts + 2) ** 2)
    second = 0.5 * np.exp(-0.5 * (shifts - 2) ** 2)
    flank = np.exp(-0.5 * shifts**2)
    peaks = find_peaks(np.einsum("z,y,x->zyx", flank, flank, first + second)[np.newaxis, np.newaxis, np.newaxis])
    np.testing.assert_allclose(peaks.second_offset[0, 0, 0], [2.0, 0.0, 0.0], atol=0.05)
    assert peaks.ratio[0, 0, 0] == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize(
    "values", [(0.0, 1.0, 0.5), (-0.1, 1.0, 0.5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.9, 1.0), (0.5, 0.6, 0.69)]
)
def test_peak_that_is_no_gaussian_stays_within_one_voxel(values: tuple[float, float, float]) -> None:
    place, _ = vertex(*values)
    assert abs(place) <= 1.0


def test_spline_matrix_is_exact_for_cubics_straight_beyond_the_nodes_and_constant_on_few() -> None:
    nodes = np.linspace(2.0, 20.0, 7)
    inside, outside = np.linspace(2.0, 20.0, 40), np.array([-1.0, 23.0])
    np.testing.assert_allclose(spline_matrix(nodes, inside) @ nodes**3, inside**3, rtol=1e-10)
    np.testing.assert_allclose(spline_matrix(nodes, outside) @ (2.0 * nodes), 2.0 * outside, rtol=1e-10)
    assert spline_matrix(nodes, np.array([23.0])) @ nodes**2 == pytest.approx(20.0**2 + 3.0 * 40.0)
    for count in (1, 2, 3):
        matrix = spline_matrix(np.arange(count) * 8.0, np.arange(-4.0, 24.0))
        np.testing.assert_allclose(matrix.sum(axis=1), 1.0, rtol=1e-12)


def deformed(
    a: Singles, b: Singles, mask: Flags, shift: tuple[float, float, float]
) -> tuple[Singles, Singles, NDArray[np.uint8]]:
    """Both volumes deformed by a uniform predictor."""
    along_z, along_y, along_x = (np.ones((n, 1), np.float32) for n in a.shape)
    field = np.array(shift).reshape(1, 1, 1, 3)
    none = (0, 0, 0)
    splines = (spline_coefficients(a), spline_coefficients(b))
    return deform_pair(*splines, mask, field, (along_x, along_y, along_z), none, none)


def test_deformation_brings_a_pair_together_but_where_either_source_is_unseen() -> None:
    shape, shift = (24, 26, 22), (1.4, -0.6, 0.8)
    centre = np.array([[11.0, 13.0, 10.0]])
    half = 0.5 * np.array(shift)
    # Wide enough that the spline's own error is below the tolerance.
    a, b, middle = (particle_volume(centre + s * half, shape, (2.5, 2.5, 2.5)) for s in (-1, 1, 0))
    got_a, got_b, _ = deformed(a, b, np.zeros((0, 0, 0), dtype=np.bool_), shift)
    np.testing.assert_allclose(got_a / a.max() ** 0, middle / a.max(), atol=1e-3)
    np.testing.assert_allclose(got_b, middle / b.max(), atol=1e-3)
    # Joint mask takes both volumes where either source is unseen.
    a = np.ones((10, 11, 12), dtype=np.float32)
    mask = np.ones(a.shape, dtype=np.bool_)
    mask[:, :, 6:] = False
    got_a, got_b, valid = deformed(a, a, mask, (4.0, 0.0, 0.0))
    # Sources at x - 2 and x + 2 must both lie in 0 ... 5.
    assert np.array_equal(np.flatnonzero(valid[5, 5]), [2, 3])
    np.testing.assert_allclose(got_a[5, 5], valid[5, 5], atol=1e-5)
    np.testing.assert_array_equal(got_a > 0.5, got_b > 0.5)


@pytest.mark.thorough
@pytest.mark.parametrize("shift", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (2.3, -3.6, 0.7)])
def test_rigid_shift_is_found_up_to_the_borders(shift: tuple[float, float, float], rng: np.random.Generator) -> None:
    shape = (44, 52, 40)
    a, b = moving_pair(rigid(*shift), shape, rng)
    field = correlate([(a, b)], unit_grid(shape), COMMON)
    assert field.flag.max() == 0
    error = field.displacement_voxel - np.array(shift)
    # A face cuts particles of 8 per window; a corner's window has lost a third of its own.
    assert np.all(root_mean_square(error) < 0.02)
    assert np.all(np.abs(error) < 0.15)
    assert np.all(np.abs(error[1:-1, 1:-1, 1:-1]) < 0.02)


@pytest.mark.thorough
def test_linear_shear_is_found_up_to_the_borders(rng: np.random.Generator) -> None:
    shape = (48, 48, 48)

    def shear(points: Floats) -> Floats:
        return np.outer(0.08 * (points[:, 2] - 23.5), (1.0, 0.0, 0.0))

    a, b = moving_pair(shear, shape, rng)
    field = correlate([(a, b)], unit_grid(shape), COMMON)
    # The windows at the borders see one side of the shear only, and approach its value pass by pass.
    error = field.displacement_voxel - truth_at(field, shear)
    assert np.all(root_mean_square(error) < 0.06)
    assert np.all(root_mean_square(error[1:-1, 1:-1, 1:-1]) < 0.015)


@pytest.mark.thorough
def test_elongated_particles_and_windows(rng: np.random.Generator) -> None:
    shape, shift = (40, 40, 48), (1.3, 0.7, 1.5)
    a, b = moving_pair(rigid(*shift), shape, rng, sigma=(1.0, 1.0, 4.0))
    field = correlate([(a, b)], unit_grid(shape), CorrelationSettings([(16, 16, 24)], (0.5, 0.5, 0.75)))
    assert field.window_voxel == (16, 16, 24)
    error = root_mean_square(field.displacement_voxel - np.array(shift))
    # The depth is located four times less well at best; by three points of the long peak it was ten times.
    assert np.all(error < (0.02, 0.02, 0.1))
    assert field.uncertainty_voxel is not None


@pytest.mark.thorough
def test_long_particles_do_not_flatten_a_curved_flow(rng: np.random.Generator) -> None:
    shape = (40, 40, 96)

    def wave(points: Floats) -> Floats:
        return np.outer(1.5 * np.cos(2.0 * np.pi * points[:, 2] / 96.0), (1.0, 0.0, 0.0))

    a, b = moving_pair(wave, shape, rng, per_window=40.0, sigma=(1.0, 1.0, 8.0))
    field = correlate([(a, b)], unit_grid(shape), COMMON)
    truth = truth_at(field, wave)
    inner = (slice(1, -1),) * 3
    slopes = [
        np.sum((found * truth)[inner]) / np.sum(truth[inner] ** 2)
        for found in (field.displacement_voxel, field.displacement_raw_voxel)
    ]
    # The mean over their length is exp(-(2 pi / 96)^2 8^2 / 4) = 0.934; the filter between passes takes from it, too.
    assert slopes[1] < 0.96
    assert abs(slopes[0] - 1.0) < 0.6 * abs(slopes[1] - 1.0)


@pytest.mark.thorough
def test_roots_of_intensities_let_dim_particles_count(rng: np.random.Generator) -> None:
    shape, shift = (40, 40, 40), MOVED
    sharp = (0.5, 0.5, 0.5)
    dim, bright = (moving_pair(rigid(*shift), shape, rng, sigma=sharp, per_window=n) for n in (12.0, 0.3))
    a, b = (faint + np.float32(20.0) * strong for faint, strong in zip(dim, bright, strict=True))
    errors = []
    for exponent in (1.0, 0.5):
        field = correlate([(a, b)], unit_grid(shape), CorrelationSettings([(16, 16, 16)], HALF, None, exponent))
        errors.append(np.sqrt(np.nanmean((field.displacement_voxel - np.array(shift)) ** 2)))
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("windows", "overlap"),
    [
        ([(32, 32, 32), (16, 16, 16)], HALF),
        ([(17, 13, 15)], (0.5, 0.3, 0.6)),
        ([(16, 16, 16)], (0.0, 0.0, 0.0)),
        ([(48, 48, 48)], HALF),
    ],
)
def test_any_windows_and_overlap_work(
    windows: list[tuple[int, int, int]], overlap: tuple[float, float, float], rng: np.random.Generator
) -> None:
    shape, shift = (40, 44, 36), MOVED
    a, b = moving_pair(rigid(*shift), shape, rng)
    field = correlate([(a, b)], unit_grid(shape), CorrelationSettings(windows, overlap, 0.5))
    np.testing.assert_allclose(field.displacement_voxel, np.broadcast_to(shift, (*field.flag.shape, 3)), atol=0.03)


@pytest.mark.thorough
def test_exchanging_volumes_or_axes_turns_vectors_round(rng: np.random.Generator) -> None:
    shape = (40, 40, 40)
    a, b = moving_pair(rigid(*MOVED), shape, rng)
    there, back = (correlate([pair], unit_grid(shape), COMMON) for pair in ((a, b), (b, a)))
    np.testing.assert_allclose(there.displacement_voxel, -back.displacement_voxel, atol=1e-4)
    # Exchanging axes exchanges components.
    a, b = moving_pair(rigid(*MOVED), (40, 44, 36), rng)
    straight = correlate([(a, b)], unit_grid((40, 44, 36)), COMMON)
    exchanged = np.ascontiguousarray(a.T), np.ascontiguousarray(b.T)
    turned = correlate([exchanged], unit_grid((36, 44, 40)), COMMON)
    back = turned.displacement_voxel.transpose(2, 1, 0, 3)[..., ::-1]
    np.testing.assert_allclose(straight.displacement_voxel, back, atol=1e-4)


def test_volumes_with_nothing_in_them_are_flagged() -> None:
    empty = np.zeros((24, 24, 24), dtype=np.float32)
    field = correlate([(empty, empty)], unit_grid((24, 24, 24)), CorrelationSettings([(16, 16, 16)], HALF, 1.0))
    assert np.all(field.flag == REJECTED)
    assert np.all(np.isnan(field.velocity))
    assert np.all(field.correlation == 0.0)
    assert np.all(field.valid_fraction > 0.4)


@pytest.mark.thorough
def test_what_is_masked_empty_or_not_finite_leaves_the_rest_unharmed(rng: np.random.Generator) -> None:
    shape, shift = (64, 32, 32), MOVED
    a, b = moving_pair(rigid(*shift), shape, rng)
    a[:, :, 28:] = 0.0
    b[:, :, 28:] = 0.0
    field = correlate([(a, b)], unit_grid(shape), CorrelationSettings([(16, 16, 16)], HALF, 1e-3))
    error = (field.displacement_voxel - np.array(shift))[:, :, field.grid.axis_mm(0) < 18.0]
    # Of thirty pairs none exceeds half of what a corner's window errs by.
    assert np.sqrt(np.mean(error**2)) < 0.5 * CORNER
    assert np.all(field.flag[:, :, -2:] == REJECTED)
    assert np.array_equal(np.isnan(field.velocity).any(axis=-1), field.flag >= REJECTED)
    # Masked windows are masked and their neighbours unharmed.
    a, b = moving_pair(rigid(*shift), shape, rng)
    mask = np.ones(a.shape, dtype=np.bool_)
    mask[:, :, 32:] = False
    a[:, :, 32:] = rng.random(a[:, :, 32:].shape)
    field = correlate([(a, b)], unit_grid(shape), CorrelationSettings([(16, 16, 16)], HALF, 1e-3), mask=mask)
    beyond = field.grid.axis_mm(0) > 40.0
    assert np.all(field.flag[:, :, beyond] == MASKED)
    seen = field.flag < REJECTED
    np.testing.assert_allclose(field.displacement_voxel[seen], np.broadcast_to(shift, (seen.sum(), 3)), atol=CORNER)
    # Voxels that are not finite are masked.
    shape, shift = (40, 40, 40), MOVED
    a, b = moving_pair(rigid(*shift), shape, rng)
    a[20, 20, 20] = np.nan
    field = correlate([(a, b)], unit_grid(shape), CorrelationSettings([(16, 16, 16)], HALF, 1e-3))
    np.testing.assert_allclose(field.displacement_voxel, np.broadcast_to(shift, (*field.flag.shape, 3)), atol=CORNER)


@pytest.mark.thorough
def test_an_ensemble_finds_what_its_pairs_are_too_sparse_for(rng: np.random.Generator) -> None:
    shape, shift = (40, 40, 40), MOVED
    pairs = [moving_pair(rigid(*shift), shape, rng, per_window=1.0) for _ in range(12)]
    together = correlate(iter(pairs), unit_grid(shape), COMMON)
    single = correlate(pairs[:1], unit_grid(shape), COMMON)
    errors = [np.abs(field.displacement_raw_voxel - np.array(shift)) for field in (together, single)]
    assert np.all(errors[0] < 0.1)
    assert not np.all(errors[1] < 0.5)
    with pytest.raises(InputError):
        correlate([], unit_grid(shape), COMMON)


@pytest.mark.thorough
def test_one_pair_twice_changes_nothing(rng: np.random.Generator) -> None:
    shape = (32, 32, 32)
    a, b = moving_pair(rigid(*MOVED), shape, rng)
    once = correlate([(a, b)], unit_grid(shape), COMMON)
    twice = correlate([(a, b), (a, b)], unit_grid(shape), COMMON)
    np.testing.assert_allclose(twice.displacement_voxel, once.displacement_voxel, atol=1e-6)
    np.testing.assert_allclose(twice.correlation, once.correlation, atol=1e-6)


def test_progress_counts_every_pass(rng: np.random.Generator) -> None:
    windows = [(16, 16, 16), (8, 8, 8)]
    a, b = moving_pair(rigid(0.5, 0.0, 0.0), (24, 24, 24), rng)
    units: list[int] = []
    correlate([(a, b)], unit_grid((24, 24, 24)), CorrelationSettings(windows, HALF), progress=units.append)
    assert sum(units) == count_passes(windows)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"windows": []}, ConfigError),
        ({"windows": [(16, 16, 1)]}, ConfigError),
        ({"overlap": (0.5, 1.0, 0.5)}, ConfigError),
        ({"dt_s": 0.0}, ConfigError),
        ({"exponent": 0.0}, ConfigError),
        ({"exponent": 1.5}, ConfigError),
        ({"pairs": [(np.zeros((4, 4, 4), np.float32), np.zeros((4, 4, 5), np.float32))]}, InputError),
        ({"mask": np.ones((4, 4, 5), dtype=np.bool_)}, InputError),
    ],
)
def test_arguments_that_do_not_belong_together_are_refused(change: dict, error: type[Exception]) -> None:
    empty = np.zeros((4, 4, 4), dtype=np.float32)
    settings = {"windows": [(4, 4, 4)], "overlap": HALF, "dt_s": 1.0, "exponent": 1.0}
    arguments = {"pairs": [(empty, empty)], "grid": unit_grid((4, 4, 4)), "mask": None}
    settings |= {name: value for name, value in change.items() if name in settings}
    arguments |= {name: value for name, value in change.items() if name in arguments}
    with pytest.raises(error):
        correlate(**arguments, settings=CorrelationSettings(**settings))


@pytest.mark.thorough
def test_a_region_without_tracers_has_no_vectors(rng: np.random.Generator) -> None:
    shape = (48, 32, 32)
    pair = moving_pair(rigid(0.6, -0.3, 0.2), shape, rng)
    for volume in pair:
        volume[:, :, 28:] = 0.0
        # What a solver makes of noise: a hundredth of a tracer's light, different in both.
        volume += (0.01 * rng.random(volume.shape)).astype(np.float32)
    field = correlate([pair], unit_grid(shape), CorrelationSettings([(16, 16, 16), (8, 8, 8)], HALF))
    x = field.grid.axis_mm(0)
    # At corners as much as half of a window has come from beyond the volume: those are masked.
    assert np.all(field.flag[:, :, x > 34.0] >= REJECTED)
    assert np.isnan(field.displacement_voxel[:, :, x > 34.0]).all()
    # One tracer is expected in such a window, so that a third of them are empty as well.
    assert np.mean(field.flag[:, :, x < 20.0] != REJECTED) > 0.5


@pytest.mark.thorough
def test_tails_of_long_particles_are_no_vectors(rng: np.random.Generator) -> None:
    """Particles of 8 voxels standard deviation in the middle third of the depth: what lies beyond is their light."""
    shape, sigma = (64, 64, 144), 8.0
    centres = rng.uniform((0.0, 0.0, 48.0), (64.0, 64.0, 96.0), (round(16 * 64 * 64 * 48 / 12**3), 3))
    half, settings = 0.5 * np.array(MOVED), CorrelationSettings([(24, 24, 24), (12, 12, 12)], HALF)
    pair = [particle_volume(centres + way * half, shape, (1.0, 1.0, sigma)) for way in (-1.0, 1.0)]
    pair = [each + rng.normal(0.0, 0.003, each.shape).astype(np.float32) for each in pair]
    field = correlate([(pair[0], pair[1])], unit_grid(shape), settings)
    off = np.abs(field.grid.centres_mm()[..., np.newaxis, :] - centres) - 6.0
    # how far the nearest tracer is outside of each window, or the innermost one inside
    nearest, found = off.max(axis=-1).min(axis=-1), field.flag < REJECTED
    # of three pairs one in a hundred was lost, and none kept
    assert np.mean(~found[nearest < -3.0]) <= 0.02
    assert np.mean(found[nearest > 0.5 * sigma]) <= 0.03
    assert not found[nearest > sigma].any()
