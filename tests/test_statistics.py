"""Statistics over many pairs against ensembles whose moments, noise and memory are known."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import lfpiv_cli as lf
from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import InputError, OutputExistsError, UsageError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.particle_file import TRACKS_FORMAT, Points, write_points
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import open_vectors, write_vectors
from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, VALID, VectorField
from lfpiv_cli.flow.statistics import ENERGY, MEAN, RMS, SKEWNESS, STRESS, Ensemble, decorrelation, statistics_of
from lfpiv_cli.grid import FOCAL_POINT, Grid
from lfpiv_cli.synthetic.flows import pipe, random_modes, square_duct
from lfpiv_cli.verbs.moments import FlowStatistics, notices_of, of_fields, of_tracks, parse_profile, profile_on
from lfpiv_cli.verbs.plot import figures_of
from tests.commands import CONFIG, run, sample_rig, summary_of
from tests.vector_fields import field_on, pair_tracks

SHAPE, DT_S, VOXEL_MM = (2, 3, 4), 1e-3, (0.1, 0.1, 0.1)
TO_M_S = 1e-3 / DT_S
# A stress that is not diagonal.
STRESSES = np.array([[1.0, 0.5, -0.2], [0.5, 2.0, 0.3], [-0.2, 0.3, 0.7]])
AS_SIX = STRESSES[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]


def ensemble(values: Floats, noise: Floats | None = None) -> Ensemble:
    """Return values (frames, places, 3) and the variances of their errors as what was measured at nodes."""
    frames, places, _ = values.shape
    frame, place = (each.ravel() for each in np.indices((frames, places)))
    six = np.zeros((len(place), 6))
    if noise is not None:
        six[:, :3] = noise.reshape(-1, 3)
    return Ensemble(places, frames, place, frame, values.reshape(-1, 3), six, np.zeros((len(place), 0)))


def gaussian(rng: np.random.Generator, frames: int, places: int, memory: float = 0.0) -> Floats:
    """Return Gaussian fluctuations (frames, places, 3) with those stresses, AR(1) in time."""
    drawn = rng.standard_normal((frames, places, 3))
    for number in range(1, frames):
        drawn[number] = memory * drawn[number - 1] + np.sqrt(1.0 - memory**2) * drawn[number]
    return np.asarray(drawn @ np.linalg.cholesky(STRESSES).T)


def told_of(found: FlowStatistics) -> list[str]:
    return [each.code for each in notices_of(found.summary(), "it")]


def fields(rng: np.random.Generator, count: int) -> list[VectorField]:
    grid = Grid(SHAPE[::-1], (0.8,) * 3, (0.0,) * 3)
    # A large mean, in which sums of squares would lose the fluctuations.
    return [field_on(grid, moved, dt_s=DT_S) for moved in 1e6 + rng.standard_normal((count, *SHAPE, 3))]


def test_moments_are_those_of_the_stack_without_what_was_not_measured(rng: np.random.Generator) -> None:
    batch = fields(rng, 5)
    stack = np.stack([field.displacement_voxel for field in batch])
    found = of_fields(iter(batch))
    np.testing.assert_allclose(found.mean.displacement_voxel, stack.mean(axis=0), rtol=1e-12)
    arrays = {name: array for name, (array, _) in found.arrays().items()}
    np.testing.assert_allclose(arrays["displacement_rms_voxel"], stack.std(axis=0, ddof=1), rtol=1e-6)
    # Five pairs are taken for independent: the plain standard error.
    assert found.found.block == 1
    np.testing.assert_allclose(found.mean.uncertainty_voxel, stack.std(axis=0, ddof=1) / np.sqrt(5.0), rtol=1e-6)
    flat = (0.1 * TO_M_S * (stack - stack.mean(axis=0))).reshape(5, -1, 3)
    covariance = np.einsum("fpi,fpj->pij", flat, flat) / 4.0
    for (i, j), name in {(0, 0): "uu", (0, 1): "uv", (1, 2): "vw", (0, 2): "uw"}.items():
        found_stress = arrays[f"reynolds_stress_{name}_with_noise"].ravel()
        np.testing.assert_allclose(found_stress, covariance[:, i, j], rtol=1e-6, atol=1e-12)
    energy = 0.5 * np.trace(covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(arrays["kinetic_energy_with_noise"].ravel(), energy, rtol=1e-6)
    skewness = np.mean(flat**3, axis=0) / np.mean(flat**2, axis=0) ** 1.5
    np.testing.assert_allclose(arrays["skewness"].reshape(-1, 3), skewness, rtol=1e-5, atol=1e-8)
    # Vectors that state no uncertainty do not tell their noise.
    assert np.isnan(arrays["reynolds_stress_uu"]).all()
    flag = np.zeros(SHAPE, dtype=np.uint8)
    flag[0, 0, 0], flag[0, 0, 1], flag[..., 3], flag[..., 2] = REJECTED, REPLACED, REJECTED, MASKED
    spoilt = [replace(field, flag=np.where(np.indices(SHAPE)[2] >= 2, flag, field.flag)) for field in batch]
    spoilt[0] = replace(batch[0], flag=flag, displacement_voxel=np.where(flag[..., None] == REJECTED, np.nan, 1e6))
    found = of_fields(spoilt)
    assert found.arrays()["samples"][0][0, 0].tolist() == [4, 4, 0, 0]
    np.testing.assert_allclose(found.mean.displacement_voxel[0, 0, :2], stack[1:, 0, 0, :2].mean(axis=0), rtol=1e-12)
    assert found.mean.flag[0, 0].tolist() == [VALID, VALID, MASKED, REJECTED]
    assert np.isnan(found.mean.velocity[..., 2:, :]).all()
    one, other = fields(rng, 2)
    for wrong in ([], [one, replace(other, dt_s=2e-3)]):
        with pytest.raises(InputError):
            of_fields(wrong)


def test_moments_of_known_ensembles_lie_within_their_errors(rng: np.random.Generator) -> None:
    # A gamma variable of shape 16 has the skewness 2 / sqrt(16).
    values = gaussian(rng, 400, 60)
    values[..., 2] = (rng.gamma(16.0, size=(400, 60)) - 16.0) / 4.0
    found = statistics_of(ensemble(values))
    assert found.block == 1
    np.testing.assert_allclose(found.tau, 1.0, atol=0.1)  # 1 / sqrt(frames places) a lag, of which a few are summed
    truth = np.zeros(16)
    truth[STRESS] = [1.0, 2.0, 1.0, 0.5, 0.0, 0.0]
    truth[RMS], truth[SKEWNESS], truth[ENERGY] = [1.0, 2.0**0.5, 1.0], [0.0, 0.0, 0.5], 2.0
    off = (found.moments.values - truth) / found.moments.sigma
    # Of 60 places: scatter 1 within 3 / sqrt(120), a tenth for what errors of errors add; means within 3 / sqrt(60).
    rms = np.sqrt(np.mean(off**2, axis=0))
    assert np.all((rms > 0.7) & (rms < 1.45)), rms
    assert np.all(np.abs(off.mean(axis=0)) < 0.5), off.mean(axis=0)


@pytest.mark.thorough
@pytest.mark.parametrize(("memory", "frames"), [(0.8, 400), (0.5, 200), (0.0, 40)])
def test_stated_errors_cover_the_true_mean_of_flows_that_remember(memory: float, frames: int) -> None:
    covered, tau, plain = [], [], []
    for seed in range(200):
        values = gaussian(np.random.default_rng(1000 + seed), frames, 1, memory)
        found = statistics_of(ensemble(values))
        covered.append(np.abs(found.moments.values[0, MEAN]) < 1.96 * found.moments.sigma[0, MEAN])
        plain.append(np.abs(values[:, 0].mean(axis=0)) < 1.96 * values[:, 0].std(axis=0) / np.sqrt(frames))
        tau.append(found.tau)
    # .95 within what 200 draws of three components, in part alike, scatter.
    assert 0.90 <= np.mean(covered) <= 0.97
    assert np.median(tau) == pytest.approx((1.0 + memory) / (1.0 - memory), rel=0.15)
    if memory > 0.5:
        assert np.mean(plain) < 0.6


@pytest.mark.thorough
def test_blocks_tell_places_that_remember_unlike() -> None:
    # Half of the places independent in time, half of a memory of 19 pairs: tau of all is in between.
    covered = []
    for seed in range(60):
        rng = np.random.default_rng(2000 + seed)
        values = np.concatenate([gaussian(rng, 400, 5, 0.9), gaussian(rng, 400, 5)], axis=1)
        found = statistics_of(ensemble(values)).moments
        covered.append((np.abs(found.values[:, MEAN]) < 1.96 * found.sigma[:, MEAN]).reshape(2, -1).mean(axis=1))
    # By tau alone it would be .77 and .999.
    longer, none = np.mean(covered, axis=0)
    assert 0.87 <= longer <= 0.97
    assert 0.93 <= none <= 0.985


def test_stated_noise_is_taken_out_and_what_is_negative_is_kept(rng: np.random.Generator) -> None:
    # Errors that differ from pair to pair and are as large as the fluctuations.
    variance = rng.uniform(0.2, 3.0, (300, 80, 1)) * np.array([1.0, 0.5, 2.0])
    values = gaussian(rng, 300, 80) + np.sqrt(variance) * rng.standard_normal((300, 80, 3))
    found = statistics_of(ensemble(values, variance)).moments
    off = (found.stress - AS_SIX) / found.sigma[:, STRESS]
    rms = np.sqrt(np.mean(off**2, axis=0))
    assert np.all((rms > 0.75) & (rms < 1.35)), rms
    assert np.all(np.abs(off.mean(axis=0)) < 3.0 / np.sqrt(80.0))
    raw = (found.values[:, STRESS] - AS_SIX) / found.sigma[:, STRESS]
    assert np.all(raw[:, :3].mean(axis=0) > 3.0)
    still = statistics_of(ensemble(np.sqrt(variance) * rng.standard_normal((300, 80, 3)), variance))
    share = np.mean(still.moments.stress[:, :3] < 0.0)
    assert 0.3 < share < 0.7  # half, within what 240 draws scatter and the skewness of variances moves


def test_convergence_is_as_one_over_the_root_of_the_number_of_pairs(rng: np.random.Generator) -> None:
    found = statistics_of(ensemble(gaussian(rng, 512, 60)))
    assert found.pairs.tolist() == [2, 4, 8, 16, 32, 64, 128, 512]
    for columns in (MEAN, STRESS):
        slopes = np.polyfit(np.log(found.pairs[1:]), np.log(found.spread[1:, columns]), 1)[0]
        # Stresses of four pairs scatter by a sixth more than 1 / sqrt(n): by 1 / sqrt(n - 1).
        np.testing.assert_allclose(slopes, -0.5, atol=0.06)
    np.testing.assert_allclose(found.spread[0, MEAN], np.sqrt(np.diag(STRESSES) / 2.0), rtol=0.1)


def test_memory_is_found_among_gaps(rng: np.random.Generator) -> None:
    values = gaussian(rng, 600, 40, 0.75)
    whole = ensemble(values)
    keep = rng.random(len(whole.place)) < 0.6
    parts = {name: getattr(whole, name)[keep] for name in ("place", "frame", "value", "noise", "offset")}
    found = statistics_of(replace(whole, **parts))
    np.testing.assert_allclose(found.tau, 7.0, rtol=0.15)  # (1 + phi) / (1 - phi), by 600 * 40 / 7 independent values
    assert decorrelation([np.zeros((1, 1, 16))], 1).tolist() == [1.0, 1.0, 1.0]


def tracks_of(places: Floats, velocity: Floats, sigma_mm: Floats, config: Path = CONFIG) -> Points:
    """Return tracks of a pair at places, with errors of stated size."""
    rig = load_rig(config)
    dt_s = float(rig.correlation.dt_s or DT_S)
    moved = velocity * 1e3 * dt_s
    return pair_tracks(places, moved, sigma_mm, dt_s, record("track", rig.resolved(), {}), FOCAL_POINT)


SIGMA_MM = np.array([0.005, 0.005, 0.03])


def measured(
    rng: np.random.Generator, flow: Any, pairs: int, count: int, half_mm: Floats, config: Path = CONFIG
) -> list[Points]:
    """Return tracks of pairs in a flow (of points and the pair's number), with errors of `SIGMA_MM`."""
    dt_s = float(load_rig(config).correlation.dt_s or DT_S)
    found = []
    for number in range(pairs):
        places = rng.uniform(-half_mm, half_mm, (count, 3))
        error = rng.standard_normal(places.shape) * SIGMA_MM * 1e-3 / dt_s
        found.append(tracks_of(places, flow(places, number) + error, SIGMA_MM, config))
    return found


HALF_MM = np.array([1.5, 1.1, 2.0])


def test_shear_within_a_bin_is_no_fluctuation(rng: np.random.Generator) -> None:
    def shear(places: Floats, _number: int) -> Floats:
        return np.stack([0.1 + 0.08 * places[:, 2], 0.05 * places[:, 0], 0.0 * places[:, 1]], axis=1)

    tracks = measured(rng, shear, 30, 300, HALF_MM)
    found = of_tracks(tracks, (1.0, 1.0, 1.0), 20, "z")
    sigma = found.found.moments.sigma
    off = found.found.moments.stress / sigma[:, STRESS]
    assert np.sqrt(np.mean(off**2)) < 1.3
    velocity = found.mean.velocity
    away = (velocity - shear(found.mean.grid.centres_mm().reshape(-1, 3), 0).reshape(velocity.shape))[..., :2]
    stated = found.arrays()["velocity_sigma"][0][..., :2]
    assert np.sqrt(np.mean((away / stated) ** 2)) == pytest.approx(1.0, abs=0.3)
    # Were it one, it would be a hundred standard errors.
    dt_s = float(found.mean.dt_s or DT_S)
    raw = (0.08 * 1e3 * dt_s) ** 2 / 12.0
    assert raw > 20.0 * np.median(sigma[:, STRESS][:, 0])
    assert found.summary()["negative_variances"] != [0, 0, 0]


def test_without_any_tracks_no_place_has_statistics() -> None:
    pair = tracks_of(np.zeros((0, 3)), np.zeros((0, 3)), SIGMA_MM)
    numbers = dict.fromkeys(("track", "frame", "particle"), np.zeros(0, np.int64))
    for each in (pair, replace(pair, arrays=pair.arrays | numbers)):
        assert (of_tracks([each], None, 20, "z").mean.flag == REJECTED).all()


def test_curved_means_in_bins_are_told(rng: np.random.Generator) -> None:
    def curved(places: Floats, _number: int) -> Floats:
        return np.stack([0.3 - 0.06 * places[:, 2] ** 2, *np.zeros((2, len(places)))], axis=1)

    tracks = measured(rng, curved, 30, 300, HALF_MM)
    for side, codes in ((1.3, ["bins-curved"]), (0.3, [])):
        found = of_tracks(tracks, (3.0, 2.2, side), 20, "z")
        assert told_of(found) == codes
        # c^2 h^4 / 720 of the second derivative, in m^2/s^2, at the inner bins.
        curvature = np.nanmedian(found.curved_mm2[:, 0]) * (1e-3 / float(found.mean.dt_s or 1.0)) ** 2
        assert curvature == pytest.approx(0.12**2 * side**4 / 720.0, rel=0.2)


@pytest.mark.thorough
def test_the_stresses_of_turbulence_lie_within_their_errors(rng: np.random.Generator) -> None:
    # Waves of up to 4 mm: the bins of one volume are several independent ones.
    flows = [random_modes(0.02, longest_mm=4.0, seed=900 + seed, velocity_m_s=(0.1, 0.0, 0.0)) for seed in range(60)]
    tracks = measured(rng, lambda places, number: flows[number](places), 60, 150, HALF_MM)
    found = of_tracks(tracks, (0.75, 0.7, 1.0), 20, "z")
    truth = np.array([4e-4, 4e-4, 4e-4, 0.0, 0.0, 0.0])
    moments, line = found.found.moments, found.found.profile
    off = (moments.stress * found.scales[STRESS] - truth) / (moments.sigma * found.scales)[:, STRESS]
    # .95 less what variances of 60 pairs are skewed, .91, within what 48 bins scatter that are not independent.
    assert np.mean(np.abs(off) < 1.96) > 0.85
    assert np.all(np.abs(off.mean(axis=0)) < 1.2), off.mean(axis=0)
    assert line is not None
    off = (line.stress * found.scales[STRESS] - truth) / (line.sigma * found.scales)[:, STRESS]
    assert np.sqrt(np.mean(off**2)) < 1.7
    assert found.summary()["independent_pairs"] > 40.0


@pytest.mark.thorough
def test_the_experiment_has_its_mean_no_stress(data_folder: Path, rng: np.random.Generator, tmp_path: Path) -> None:
    rig = sample_rig(tmp_path, ("shape_xyz: [30, 22, 40]", "shape_xyz: [100, 90, 90]"))
    truth = np.load(data_folder / "channel" / "particles.npz")
    places, velocity = truth["position_mm"], 1e-3 * truth["velocity_mm_s"]
    middle = float(json.loads((data_folder / "channel" / "truth.json").read_text())["mid_plane_z_mm"])
    places = places - [0.0, 0.0, middle]
    dt_s = float(load_rig(rig).correlation.dt_s or DT_S)
    tracks = []
    for _ in range(40):
        some = rng.choice(len(places), 1000, replace=False)
        error = rng.standard_normal((1000, 3)) * SIGMA_MM * 1e-3 / dt_s
        tracks.append(tracks_of(places[some], velocity[some] + error, SIGMA_MM, rig))
    found = of_tracks(tracks, (10.0, 1.0, 1.0), 20, "z@y=0")
    there = found.mean.flag == VALID
    assert there.sum() > 70
    # The mean over a bin, of which the middle of a trend is one.
    inner = (np.indices((3, 3)).reshape(2, -1).T - 1.0) / 3.0
    nodes = found.mean.grid.centres_mm()[there]
    duct = square_duct(10.0, 0.1082)
    true = np.mean([duct(nodes + [0.0, y, z])[:, 0] for y, z in inner], axis=0)
    off = (found.mean.velocity[there][:, 0] - true) / found.arrays()["velocity_sigma"][0][there][:, 0]
    assert np.sqrt(np.mean(off**2)) < 1.5
    stress = found.found.moments.stress[there.ravel()] / found.found.moments.sigma[there.ravel(), STRESS]
    # The profile's curvature leaves some tenths of a standard error in u.
    assert np.sqrt(np.mean(stress**2)) < 1.4
    assert told_of(found) == []


def test_profiles_around_an_axis_turn_what_they_average(rng: np.random.Generator) -> None:
    flow, angular = pipe(2.0, 0.1), 0.02

    def swirl(places: Floats, number: int) -> Floats:
        radial = np.linalg.norm(places[:, 1:], axis=1, keepdims=True)
        around = np.cross([1.0, 0.0, 0.0], places)
        outward = np.concatenate([np.zeros((len(places), 1)), places[:, 1:]], axis=1) / radial
        # A breathing flow: only <v_r v_r> is not zero.
        return np.asarray(flow(places) + angular * around + 0.01 * (-1.0) ** number * outward)

    rig = np.array([1.4, 1.0, 1.0])
    tracks = measured(rng, swirl, 60, 400, rig)
    found = of_tracks(tracks, (2.8, 0.25, 0.25), 20, "r@x")
    line, profile = found.found.profile, found.profile
    assert line is not None
    assert profile is not None
    inner = (profile.at_mm > 0.2) & (profile.at_mm < 0.95)
    velocity = (line.values * found.scales)[inner, MEAN]
    np.testing.assert_allclose(velocity[:, 0], 0.2 * (1.0 - (profile.at_mm[inner] / 2.0) ** 2), rtol=0.02)
    np.testing.assert_allclose(velocity[:, 1], 0.0, atol=0.001)
    np.testing.assert_allclose(velocity[:, 2], angular * profile.at_mm[inner], rtol=0.1)
    stress = (line.stress * found.scales[STRESS])[inner]
    np.testing.assert_allclose(stress[:, 1], 1e-4, rtol=0.25)
    assert np.abs(stress[:, 3:]).max() < 2e-5


@pytest.mark.parametrize("text", ["q", "z@z=1", "z@x=a", "r@", "r@x,x=1", "z@x=1,x=2", "z@x=1,", "r@x,y"])
def test_profiles_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="expected an axis, as z"):
        parse_profile(text)


def test_profiles_lie_where_they_are_asked_for(rng: np.random.Generator) -> None:
    grid = fields(rng, 1)[0].grid
    for text, count, each in (("z", 2, 12), ("x@y=0.8,z=0", 4, 1), ("y@z=0.5", 3, 4), ("r@z, x=1.2, y=0.8", 2, 0)):
        profile = profile_on(grid, text)
        assert len(profile.at_mm) == count
        if each:
            assert np.bincount(profile.point[profile.point >= 0]).tolist() == [each] * count
    with pytest.raises(UsageError, match="y is -0.4 to 2 mm"):
        profile_on(grid, "x@y=3")


def test_what_speaks_against_statistics_is_told_and_ordinary_ones_are_quiet(rng: np.random.Generator) -> None:
    def batch(values: Floats, sigma: float) -> FlowStatistics:
        first = fields(rng, 1)[0]
        stated = np.full((*SHAPE, 3), sigma)
        return of_fields(
            replace(first, displacement_voxel=each.reshape(*SHAPE, 3), uncertainty_voxel=stated) for each in values
        )

    places = int(np.prod(SHAPE))
    assert told_of(batch(gaussian(rng, 40, places), 0.3)) == []
    assert told_of(batch(rng.standard_normal((40, places, 3)), 1.0)) == []
    assert told_of(batch(gaussian(rng, 40, places), 3.0)) == ["noise-above-scatter"]
    assert told_of(batch(gaussian(rng, 40, places, 0.8), 0.3)) == ["few-independent"]
    drift = np.linspace(0.0, 5.0, 60)[:, np.newaxis, np.newaxis]
    assert told_of(batch(gaussian(rng, 60, places) + drift, 0.3)) == ["few-independent"]
    tracks = measured(rng, lambda places, _number: 0.0 * places, 30, 30, HALF_MM)
    found = of_tracks(tracks, (0.7, 0.7, 0.7), 20, "z")
    assert told_of(found) == ["places-sparse"]
    with pytest.raises(UsageError, match="not of both"):
        lf.statistics(*fields(rng, 2), bin_mm=(1.0, 1.0, 1.0))


@pytest.fixture
def folder(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A folder of twelve pairs' vectors, one of their tracks."""
    made = record("correlate", load_rig(CONFIG).resolved(), {})
    (tmp_path / "vectors").mkdir()
    (tmp_path / "tracks").mkdir()
    for number, field in enumerate(fields(rng, 12)):
        moved = field.displacement_voxel - 1e6 + [2.0, 0.0, 0.0]
        each = replace(field, displacement_voxel=moved, uncertainty_voxel=np.full((*SHAPE, 3), 0.2))
        write_vectors(tmp_path / "vectors" / f"v{number}.vtkhdf", each, FOCAL_POINT, provenance=made, overwrite=False)
    tracks = measured(rng, lambda places, _number: 0.1 + 0.0 * places, 12, 200, HALF_MM)
    for number, points in enumerate(tracks):
        write_points(tmp_path / "tracks" / f"t{number}.vtkhdf", TRACKS_FORMAT, points, overwrite=False)
    return tmp_path


def test_files_become_one_of_statistics(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "s.vtkhdf"
    summary = summary_of(capsys, "statistics", folder / "vectors", "--profile", "x@y=0.8", "-o", out)
    assert (summary["files"], summary["pairs"], summary["places"]) == (12, 12, 24)
    assert [each["code"] for each in summary["warnings"]] == ["few-independent"]
    paths = [folder / "vectors" / f"v{number}.vtkhdf" for number in range(12)]
    found = of_fields(map(open_vectors, paths), "x@y=0.8")
    with h5py.File(out) as file:
        for name, (array, unit) in found.arrays().items():
            np.testing.assert_array_equal(file[name][...], array)
            assert file[name].attrs["units"].decode() == unit
            assert f"VTKHDF/PointData/{name}" in file
        for table, columns in found.tables().items():
            assert set(file[table]) == set(columns)
            assert all(file[table][name].attrs["units"].decode() == unit for name, (_, unit) in columns.items())
        assert file.attrs["profile"] == b"x@y=0.8"
        assert file["profile/at_mm"].shape == (4,)
    # In the order of time, however a shell sorts them; and as Python has it.
    before = out.read_bytes()
    run("statistics", *sorted(paths), "--profile", "x@y=0.8", "-o", out, "--overwrite", "-q")
    assert out.read_bytes() == before
    with pytest.warns(lf.LfpivWarning, match="few-independent"):
        again = lf.statistics(*map(open_vectors, paths), profile="x@y=0.8")
    np.testing.assert_array_equal(again.mean.velocity, open_vectors(out).velocity)
    with pytest.raises(OutputExistsError):
        run("statistics", folder / "vectors", "-o", out)
    again = ("statistics", folder / "vectors", "--profile", "x@y=0.8", "-o", out, "--resume")
    assert summary_of(capsys, *again)["skipped"] == 1
    with pytest.raises(OutputExistsError, match="other inputs or settings"):
        run("statistics", folder / "vectors", "-o", out, "--resume")
    # One pair tells no fluctuations, and its figures no convergence.
    single = summary_of(capsys, "statistics", paths[0], "-o", folder / "one.vtkhdf")
    assert (single["pairs"], single["kinetic_energy_m2_s2"]) == (1, None)
    assert "convergence" in figures_of(out)
    assert {"moments", "profile"} <= set(figures_of(folder / "one.vtkhdf"))
    assert "convergence" not in figures_of(folder / "one.vtkhdf")
    with pytest.raises(UsageError, match="bins are of tracks"):
        run("statistics", folder / "vectors", "--bin-mm", 1, "-o", folder / "n.vtkhdf")
    with pytest.raises(InputError, match="is of one kind"):
        run("statistics", folder / "vectors", folder / "tracks", "-o", folder / "n.vtkhdf")
    assert not (folder / "n.vtkhdf").exists()


@pytest.mark.thorough
def test_tracks_count_where_they_are_and_the_page_shows_them(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    out = folder / "s.vtkhdf"
    summary = summary_of(capsys, "statistics", folder / "tracks", "--bin-mm", "1x1x2", "--fewest", 10, "-o", out)
    assert (summary["pairs"], summary["places"], summary["rejected"]) == (12, 3 * 2 * 2, 0)
    field = open_vectors(out)
    assert field.grid.spacing_mm == (1.0, 1.0, 2.0)
    np.testing.assert_allclose(field.velocity, 0.1, atol=0.02)
    run("plot", out, "--only", "profile", "--only", "convergence", "-o", folder / "p.png", "-q")
    assert (folder / "p_profile.png").stat().st_size > 10_000
    run("report", out, "-o", folder / "s.html", "-q")
    page = (folder / "s.html").read_text()
    assert "Profile, without noise" in page
    assert "block of the bootstrap" in page
