"""Fields kriged as vectors, tracks drawn without images, turbulence: what must come out, and stated errors."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.field_tracks import BLIND_MM, LENS_MM, stated_covariance, tracks_of, true_displacement_mm
from lfpiv_cli.arrays import Floats
from lfpiv_cli.fields.fit import KrigedField, is_rough, kriged_field
from lfpiv_cli.fields.spline_field import gradient_covariance_at, spline_field
from lfpiv_cli.fields.stencils import Lattice, rows_of
from lfpiv_cli.fields.structure import INDEPENDENT, Samples, VectorStructure, estimated, unknown_variance
from lfpiv_cli.flow.field import dissipation, fluctuations, kinetic_energy, reynolds_stresses, spectrum
from lfpiv_cli.synthetic.flows import rigid_rotation, taylor_green

BOX_MM = np.array([6.0, 5.0, 5.0])
LATERAL_MM, DEPTH_MM = 0.001, 0.015


def turbulence(points: Floats, seed: int = 3, potential: bool = False) -> Floats:
    """Return displacements (n, 3) by random waves, across their directions or along them."""
    rng = np.random.default_rng(seed)
    wave = 2.0 * np.pi / np.exp(rng.uniform(np.log(0.7), np.log(20.0), 60))
    direction = rng.normal(size=(60, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.cross(direction, rng.normal(size=(60, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    amplitude = 0.05 * wave[:, np.newaxis] ** (-1.0 / 3.0) * (direction if potential else across)
    return np.asarray(np.cos(points @ (wave[:, np.newaxis] * direction).T + rng.uniform(0, 6, 60)) @ amplitude)


def samples_of(points: Floats, value: Floats, seed: int = 1) -> Samples:
    """Return samples with errors that are ten times as large in depth as laterally."""
    sigma = np.array([LATERAL_MM, LATERAL_MM, DEPTH_MM])
    noise = np.random.default_rng(seed).normal(size=points.shape) * sigma
    covariance = np.broadcast_to(np.diag(sigma**2), (len(points), 3, 3))
    return Samples(points, value + noise, covariance, np.full(len(points), 0.98))


def places(count: int, seed: int = 0) -> Floats:
    return (np.random.default_rng(seed).random((count, 3)) - 0.5) * BOX_MM


def structure(potential_share: float) -> VectorStructure:
    return VectorStructure(0.03, 1.0, 0.4, 5.0, 1e-7, 1.0, potential_share)


@pytest.fixture
def field() -> KrigedField:
    """Return a field without divergence of 100 tracks."""
    points = places(100)
    return KrigedField(samples_of(points, turbulence(points)), structure(0.0), np.ones((100, 3)), 0)


@pytest.mark.parametrize("share", [0.0, INDEPENDENT, 1.0])
def test_structure_of_solenoidal_and_potential_parts(share: float) -> None:
    """Incompressibility: D_NN = D_LL + (r/2) dD_LL/dr; without rotation D_LL = D_NN + r dD_NN/dr; or both alike."""
    r, step = 0.7, 1e-5

    def longitudinal_and_transverse(distance: float) -> Floats:
        level, along = structure(share).parts(np.array(distance**2))
        return np.array([level + along * distance**2, level])

    here = longitudinal_and_transverse(r)
    slope = (longitudinal_and_transverse(r + step) - longitudinal_and_transverse(r - step)) / (2.0 * step)
    if share == 0.0:
        assert here[1] == pytest.approx(here[0] + 0.5 * r * slope[0], rel=1e-8)
    elif share == 1.0:
        assert here[0] == pytest.approx(here[1] + r * slope[1], rel=1e-8)
    else:
        assert here[0] == pytest.approx(here[1], rel=1e-12)


def test_constants_are_kept_and_divergence_is_zero(field: KrigedField) -> None:
    moved = replace(field.samples, value_mm=field.samples.value_mm + [7.0, -3.0, 1.0])
    other = KrigedField(moved, field.structure, field.off_by, field.kept)
    at = places(5, seed=9)
    np.testing.assert_allclose(other.value_at(at), field.value_at(at) + [7.0, -3.0, 1.0], atol=1e-9)
    gradient = field.gradient_at(places(20, seed=9))
    assert np.abs(np.einsum("mii->m", gradient)).max() < 1e-10 * np.abs(gradient).max()


def test_gradient_is_that_of_the_estimate_with_its_samples_held() -> None:
    """Also of a flow with sources, and off the middle of the neighbourhood."""
    points = places(30)
    samples = samples_of(points, turbulence(points))
    found = KrigedField(samples, structure(0.2), np.ones((30, 3)), 0)
    at, near, step = places(2, seed=9), np.tile(np.arange(30), (2, 1)), 1e-4
    unknown = unknown_variance(samples)

    def moved(by: Floats) -> Floats:
        return estimated(at + by, near, samples, found.structure, unknown)[0]

    expected = np.stack([(moved(step * axis) - moved(-step * axis)) / (2.0 * step) for axis in np.eye(3)], axis=2)
    gradient = found.gradient_at(at)
    np.testing.assert_allclose(gradient, expected, atol=1e-6 * np.abs(gradient).max())


def test_variance_is_that_of_many_flows() -> None:
    """Displacements drawn with the model's own covariances are missed by as much as the equations say."""
    rng = np.random.default_rng(5)
    points, at = places(25), places(1, seed=9)
    model = VectorStructure(0.03, 1.0, 0.4, 1.0, 1e-6, 2.0, 0.0)
    everywhere = np.concatenate([points, at])
    offset = everywhere[:, np.newaxis] - everywhere
    level, along = model.parts(np.sum(offset**2, axis=2))
    half = 0.5 * (
        level[..., np.newaxis, np.newaxis] * np.eye(3)
        + along[..., np.newaxis, np.newaxis] * (offset[..., :, np.newaxis] * offset[..., np.newaxis, :])
    )
    # at infinity the structure function is twice the variance
    covariance = (0.5 * 0.03 * 0.4 * 1.0 * np.eye(3) - half).transpose(0, 2, 1, 3).reshape(78, 78)
    drawn = (np.linalg.cholesky(covariance + 1e-12 * np.eye(78)) @ rng.normal(size=(78, 3000))).T.reshape(3000, 26, 3)
    error = np.array([LATERAL_MM, LATERAL_MM, DEPTH_MM])
    noisy = drawn[:, :25] + rng.normal(size=(3000, 25, 3)) * np.sqrt(2.0 * error**2 + 1e-6)
    stated = np.broadcast_to(np.diag(error**2), (75000, 3, 3))
    samples = Samples(np.tile(points, (3000, 1)), noisy.reshape(-1, 3), stated, np.ones(75000))
    value, covariance = estimated(np.tile(at, (3000, 1)), np.arange(75000).reshape(3000, 25), samples, model, 1.0)
    missed = value - drawn[:, 25]
    # the variance of 3,000 draws is known to 2.6 %
    np.testing.assert_allclose(np.cov(missed.T, bias=True).diagonal(), covariance[0].diagonal(), rtol=0.1)


@pytest.mark.thorough
def test_errors_are_as_stated_where_the_samples_understate_theirs() -> None:
    points, at = places(800), places(300, seed=9)
    honest = samples_of(points, turbulence(points))
    samples = Samples(points, honest.value_mm, honest.covariance_mm2 / 1.5**2, honest.probability)
    value, covariance = kriged_field(samples, "free").estimates_at(at)
    sigma = np.sqrt(np.einsum("mii->mi", covariance))
    inside = np.mean(np.abs(value - turbulence(at)) < 1.96 * sigma)
    assert 0.9 <= inside <= 0.98


@pytest.mark.thorough
def test_sources_are_found_where_there_are_some_and_as_is_chosen() -> None:
    points = places(400)
    shares = [
        kriged_field(samples_of(points, value), "penalised").structure.potential_share
        for value in (turbulence(points), turbulence(points) + turbulence(points, potential=True))
    ]
    assert shares[0] == 0.0
    assert shares[1] >= 0.1
    # Choices of divergence.
    points = places(80)
    samples = samples_of(points, turbulence(points))
    assert kriged_field(samples, "off").structure.potential_share == INDEPENDENT
    assert kriged_field(samples, "free").reported()["potential_share"] == 0.0


@pytest.mark.thorough
def test_outliers_are_dropped_and_rough_is_turbulence() -> None:
    points = places(300)
    honest = samples_of(points, turbulence(points))
    value = honest.value_mm.copy()
    value[:9] += np.random.default_rng(4).normal(size=(9, 3)) * 0.4
    found = kriged_field(Samples(points, value, honest.covariance_mm2, honest.probability), "free")
    kept = np.isin(points[:, 0], found.samples.points_mm[:, 0])
    assert not kept[:9].any()
    assert np.mean(kept[9:]) > 0.98
    # Rough is turbulence and not a smooth flow.
    points = places(400)
    smooth = 0.2 * np.stack([np.sin(points[:, 2]), np.cos(points[:, 0]), np.sin(points[:, 1])], axis=1)
    assert is_rough(samples_of(points, turbulence(points)))
    assert not is_rough(samples_of(points, smooth))


@pytest.mark.parametrize("count", [2, 10])
def test_few_samples_without_stated_errors_that_are_all_alike(count: int) -> None:
    points = places(count)
    samples = Samples(points, np.ones((count, 3)), np.zeros((count, 3, 3)), np.ones(count))
    np.testing.assert_allclose(kriged_field(samples, "penalised").value_at(places(2, seed=9)), 1.0, atol=1e-6)
    assert not is_rough(samples)


def test_two_samples_at_one_place_without_errors() -> None:
    points = places(20)
    points[1] = points[0]
    model = VectorStructure(0.03, 1.0, 0.4, 5.0, 0.0, 1.0, 0.0)
    samples = Samples(points, turbulence(points), np.zeros((20, 3, 3)), np.ones(20))
    found = KrigedField(samples, model, np.ones((20, 3)), 0)
    np.testing.assert_allclose(found.value_at(points[:2]), samples.value_mm[:2], atol=1e-6)


FLOW = taylor_green(0.1, 12.0)


def off_truth(tracks):
    return tracks.displacement_mm - true_displacement_mm(FLOW, tracks.middle_mm, tracks.dt_s)


def exact_and_drawn(count, scale=1.0):
    return (tracks_of(FLOW, count, np.random.default_rng(3), sigma_scale=each) for each in (1e-9, scale))


def test_errors_are_those_that_are_stated_and_scale() -> None:
    exact, drawn = exact_and_drawn(3000)
    root = np.linalg.cholesky(drawn.covariance_mm2)
    for name, share in (("displacement_mm", 1.0), ("middle_mm", 0.5)):
        off = (getattr(drawn, name) - getattr(exact, name))[..., np.newaxis]
        whitened = np.linalg.solve(share * root, off)[..., 0]
        # of 3000 draws a variance is known to 0.026 and a correlation to 0.018
        np.testing.assert_allclose(np.cov(whitened.T), np.eye(3), atol=0.09)
    (none, half), (_, whole) = exact_and_drawn(50, 0.5), exact_and_drawn(50)
    assert half.covariance_mm2 == pytest.approx(0.25 * whole.covariance_mm2)
    off, of_whole = half.middle_mm - none.middle_mm, whole.middle_mm - none.middle_mm
    np.testing.assert_allclose(off, 0.5 * of_whole, rtol=1e-6, atol=1e-10)


def test_displacements_without_errors_are_the_truth_and_chords_of_circles(rng: np.random.Generator) -> None:
    exact, _ = exact_and_drawn(200)
    assert np.abs(off_truth(exact)).max() < 1e-7
    assert np.sqrt(np.mean(np.sum(exact.displacement_mm**2, axis=1))) == pytest.approx(0.4, rel=0.02)
    # turned by half an angle each way about z; the chord's middle is nearer to the centre by its cosine
    points, angle = rng.uniform(-5.0, 5.0, (20, 3)), 0.3
    found = true_displacement_mm(rigid_rotation((0.0, 0.0, angle / 1e-3)), points, 1e-3)
    expected = 2.0 * np.tan(0.5 * angle) * np.cross((0.0, 0.0, 1.0), points)
    # four steps of 0.04 rad each: 1e-8 of the distance
    assert found == pytest.approx(expected, abs=1e-6)


def test_stated_errors_point_to_the_lens_and_are_largest_near_the_focal_plane(rng: np.random.Generator) -> None:
    points = np.array([(6.0, -4.0, 4.0), (0.0, 0.0, 1.0), (0.0, 0.0, 4.0), (0.0, 0.0, 0.5 * BLIND_MM)])
    covariance = np.mean([stated_covariance(points, 5.0, rng) for _ in range(200)], axis=0)
    ray = (points[0] - LENS_MM) / np.linalg.norm(points[0] - LENS_MM)
    assert np.abs(np.linalg.eigh(covariance[0])[1][:, 2] @ ray) == pytest.approx(1.0)
    # an error of 0.01 mm in depth is one of 6/204 of it along x
    assert covariance[0, 0, 2] / covariance[0, 2, 2] == pytest.approx(6.0 / 204.0, rel=0.01)
    near, far, blind = np.sqrt(covariance[1:, 2, 2])
    assert 0.005 < near < far < 0.02 < 1.5 * blind
    assert blind > 2.0 * near
    assert np.all((np.sqrt(covariance[:, 1, 1]) > 0.0003) & (np.sqrt(covariance[:, 1, 1]) < 0.001))


def test_wrong_links_lead_to_neighbours(rng: np.random.Generator) -> None:
    tracks = tracks_of(FLOW, 1000, rng, wrong_share=0.1)
    off = np.linalg.norm(off_truth(tracks), axis=1)
    assert tracks.wrong.sum() == 100
    # 1000 in 1300 mm^3 are 0.6 mm apart
    assert 0.3 < np.median(off[tracks.wrong]) < 2.0
    assert np.median(off[~tracks.wrong]) < 0.02
    assert not tracks_of(FLOW, 20, rng).wrong.any()


NONE = np.zeros((1, 9, 9))


def test_fluctuations_and_reynolds_stresses_are_those_of_the_flow(rng: np.random.Generator) -> None:
    velocity = rng.normal(size=(4, 2, 3, 5, 3))
    np.testing.assert_allclose(fluctuations(velocity, (0,)).mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(fluctuations(velocity, (1, 3)).mean(axis=(1, 3)), 0.0, atol=1e-12)
    velocity[0, 0, 0, 0] = np.nan
    assert np.isnan(fluctuations(velocity, (0,))).sum() == 3
    true = rng.multivariate_normal(np.zeros(3), [[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]], 20000)
    # a fit is what the flow would be expected to be, and the flow lies about it
    fitted, true = true, true + rng.normal(0.0, 0.7, true.shape)
    found = reynolds_stresses(fitted, np.full(true.shape, 0.49))
    # of 20000 draws a variance of 4 is known to 0.04
    np.testing.assert_allclose(found, true.T @ true / len(true), atol=0.15)
    assert kinetic_energy(found) == pytest.approx(0.5 * np.trace(found))


def test_dissipation_of_shear_is_viscosity_times_its_square_and_of_rotation_nothing() -> None:
    gradient = np.zeros((1, 3, 3))
    gradient[0, 0, 1] = 5.0
    assert dissipation(gradient, NONE, 1e-6, 1.0)[0] == pytest.approx(1e-6 * 25.0)
    rotation = np.array([[[0.0, -3.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    assert dissipation(rotation, NONE, 1e-6, 1.0)[0] == 0.0


def test_dissipation_has_what_the_fit_lacks_put_on(rng: np.random.Generator) -> None:
    fitted = rng.normal(size=(3, 3))
    root = 0.8 * rng.normal(size=(9, 9))
    flow = (fitted.ravel() + rng.normal(size=(20000, 9)) @ root.T).reshape(-1, 3, 3)
    strain = 0.5 * (flow + flow.swapaxes(1, 2))
    squares = np.sum(strain**2, axis=(1, 2))
    covariance = np.broadcast_to(root @ root.T, (20000, 9, 9))
    rate, _ = dissipation(np.broadcast_to(fitted, flow.shape), covariance, 0.5, 20000.0)
    # of 20000 draws
    assert abs(rate - np.mean(squares)) < 4.0 * np.std(squares) / np.sqrt(20000.0)
    assert rate > np.sum((0.5 * (fitted + fitted.T)) ** 2)


def test_the_spectrum_sums_up_to_the_kinetic_energy_and_lies_at_a_wave_s_wavenumber(rng: np.random.Generator) -> None:
    field = rng.normal(size=(16, 16, 20, 3))
    found = spectrum(field, (0.5, 0.5, 0.5))
    window = [np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in (16, 16, 20)]
    square = np.einsum("i,j,k->ijk", *(each**2 / np.mean(each**2) for each in window))
    energy = 0.5 * np.mean(square * np.sum(field**2, axis=-1))
    assert np.sum(found.energy) * found.width == pytest.approx(energy, rel=1e-12)
    # white noise of 16,000 numbers under a window of an effective tenth of them
    assert energy == pytest.approx(1.5, rel=0.15)
    # The energy of a wave lies at its wavenumber.
    z = np.arange(32) * 0.5
    field = np.zeros((32, 16, 16, 3))
    field[..., 1] = np.sin(2.0 * np.pi * z / 4.0)[:, np.newaxis, np.newaxis]
    found = spectrum(field, (0.5, 0.5, 0.5))
    near = np.abs(found.wavenumber - 2.0 * np.pi / 4e-3) < 1.5 * found.width
    assert np.sum(found.energy[near]) > 0.95 * np.sum(found.energy)
    # A thin grid has no spectrum.
    with pytest.raises(ValueError, match="needs 4 planes"):
        spectrum(np.zeros((3, 8, 8, 3)), (1.0, 1.0, 1.0))


@pytest.mark.thorough
def test_gradients_vary_by_their_coefficients(rng: np.random.Generator) -> None:
    """The covariance of differences of the field, by a dense inverse that is put together from its blocks."""
    tracks = tracks_of(taylor_green(0.1, 10.0), 150, rng, (8.0, 4.0, 4.0))
    samples = Samples(tracks.middle_mm, tracks.displacement_mm, tracks.covariance_mm2, np.ones(150))
    lattice = Lattice.over(samples.points_mm.min(axis=0), samples.points_mm.max(axis=0), 1.9)
    field = spline_field(samples, lattice, "penalised", rng, np.zeros((0, 3)))
    diagonal, below = field.covariance
    plane = int(np.prod(field.lattice.shape[1:]))
    point = np.array([[0.3, -0.4, 0.7]])
    found = gradient_covariance_at(field, point)[0]
    assert np.linalg.eigvalsh(found).min() > 0.0
    for component in range(3):
        for axis in range(3):
            columns, slopes = rows_of(field.lattice, point, axis)
            planes, within = columns[0] // plane, columns[0] % plane
            rows = (planes * 3 + component) * plane + within
            whole = np.zeros((len(rows), len(rows)))
            length = len(diagonal[0])
            for i, row in enumerate(rows):
                for j, column in enumerate(rows):
                    high, low = max(row, column), min(row, column)
                    block = diagonal[high // length] if high // length == low // length else below[low // length]
                    whole[i, j] = block[high % length, low % length]
            assert found[3 * component + axis, 3 * component + axis] == pytest.approx(slopes[0] @ whole @ slopes[0])
