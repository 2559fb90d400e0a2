"""The stages of `correlate` and `field`: masks, ensembles, means, flows fitted to tracks and vectors, through files."""

import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.volumes import Seeding, volume_pair
from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, PartialError, UsageError
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.particle_file import TRACKS_FORMAT, TRAJECTORIES_FORMAT, open_tracks, write_points
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import open_vectors, read_header, write_volume
from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.field import MASKED
from lfpiv_cli.flow.windows import CorrelationSettings, RoundWall, WindowLayout, layout_windows
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.synthetic.flows import pipe
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs.checks import Quality, calibration_notices, field_notices, pair_notices, tracers_per_window
from lfpiv_cli.verbs.field import FieldOptions, fit_flow, read_places
from lfpiv_cli.verbs.fields import fit_notices, fitted, samples_of_tracks
from tests.commands import CONFIG, run, sample_rig, summary_of
from tests.test_particle_stage import HIGH, LOW, write_frames
from tests.vector_fields import pair_tracks, points_of

SHAPE = (30, 22, 40)
GRID = Grid.centred(SHAPE, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
SHIFT = (0.9, -0.5, 0.3)
REFERENCE = Reference("mid_plane", 0.0)


def moved(
    folder: Path,
    shape: tuple[int, int, int] = SHAPE,
    spacing: tuple[float, float, float] = (0.1, 0.1, 0.1),
    seeding: Seeding = Seeding(40.0, (1.0,) * 3),  # noqa: B008
    number: int = 0,
    times_s: tuple[float, ...] = (),
) -> list[Path]:
    """Write a pair of volumes in which tracers move by SHIFT."""
    arrays = volume_pair(lambda at: np.tile(SHIFT, (len(at), 1)), shape, seeding, np.random.default_rng(5 + number))
    grid, paths = Grid.centred(shape, spacing, (0.0, 0.0, 0.0)), [folder / f"{name}{number}.vtkhdf" for name in "ab"]
    for k, (path, array) in enumerate(zip(paths, arrays, strict=True)):
        made_by = record("test", load_rig(CONFIG).resolved(), {})
        if times_s:
            made_by["inputs"] = {"image": {"name": "run.cine", "sha256": "x", "time_s": times_s[k]}}
        write_volume(path, array, grid, REFERENCE, provenance=made_by, attributes={}, overwrite=False)
    return paths


@pytest.fixture(scope="module")
def volumes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two pairs of volumes that move by SHIFT, and one of a mask that leaves out x < 0."""
    folder, seeding = tmp_path_factory.mktemp("volumes"), Seeding(40.0, (1.0,) * 3, lost=0.2)
    paths = [path for number in (0, 1) for path in moved(folder, seeding=seeding, number=number)]
    mask = np.broadcast_to(GRID.axis_mm(0) >= 0.0, GRID.shape_zyx).astype(np.float32)
    write_volume(folder / "mask.vtkhdf", mask, GRID, REFERENCE, provenance={}, attributes={}, overwrite=False)
    return [*paths, folder / "mask.vtkhdf"]


def test_masks_and_walls_leave_windows_out_and_a_mean_needs_pairs(volumes: list[Path], tmp_path: Path) -> None:
    run("correlate", *volumes[:2], "--mask", volumes[4], "-o", tmp_path / "v.vtkhdf")
    field = open_vectors(tmp_path / "v.vtkhdf")
    assert np.all(field.flag[:, :, field.grid.axis_mm(0) < -0.6] == MASKED)
    kept = field.displacement_voxel[:, :, field.grid.axis_mm(0) > 0.3]
    np.testing.assert_allclose(np.median(kept, axis=(0, 1, 2)), SHIFT, atol=0.05)
    other = tmp_path / "other.vtkhdf"
    grid = Grid.centred((3, 3, 3), (0.1,) * 3, (0.0,) * 3)
    write_volume(other, np.ones((3, 3, 3)), grid, REFERENCE, provenance={}, attributes={}, overwrite=False)
    with pytest.raises(InputError, match="other.vtkhdf: its grid"):
        run("correlate", *volumes[:2], "--mask", other, "-o", tmp_path / "w.vtkhdf")
    rig = sample_rig(tmp_path, ("dt_s: 0.002", "dt_s: 0.002, mask: channel"), ("width_mm: 4.0", "width_mm: 2.0"))
    run("correlate", *volumes[:2], "--config", rig, "-o", tmp_path / "narrow.vtkhdf")
    field = open_vectors(tmp_path / "narrow.vtkhdf")
    beyond = np.abs(field.grid.axis_mm(2)) > 1.4
    assert beyond.any()
    assert np.all(field.flag[beyond] == MASKED)
    assert np.all(field.flag[np.abs(field.grid.axis_mm(2)) < 0.9] != MASKED)
    for extra in ((*volumes[:2],), (*volumes[:4], "--pairing", "ab", "--ensemble")):
        with pytest.raises(UsageError, match="--mean"):
            run("correlate", *extra, "--mean", tmp_path / "m.vtkhdf", "-o", tmp_path / "v.vtkhdf")
    with pytest.raises(UsageError, match="-o: is missing"):
        run("correlate", *volumes[:2])


@pytest.mark.thorough
def test_an_ensemble_is_one_field(volumes: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("correlate", *volumes[:4], "--pairing", "ab", "--ensemble", "-o", tmp_path / "together.vtkhdf")
    together = open_vectors(tmp_path / "together.vtkhdf")
    folder, mean = tmp_path / "each", tmp_path / "mean.vtkhdf"
    summary = summary_of(
        capsys, "correlate", *volumes[:4], "--pairing", "ab", "--derived", "--mean", mean, "-o", folder
    )
    each = [open_vectors(folder / f"a{number}.vtkhdf") for number in range(2)]
    expected = np.mean([field.displacement_voxel for field in each], axis=0)
    np.testing.assert_allclose(open_vectors(mean).displacement_voxel, expected, atol=1e-12)
    errors = [np.sqrt(np.nanmean((field.displacement_voxel - SHIFT) ** 2)) for field in (together, *each)]
    assert errors[0] < min(errors[1:])
    with h5py.File(mean) as file:
        assert file["velocity_rms"].attrs["units"] == b"m/s"
        assert file["velocity_rms"].shape == (*each[0].flag.shape, 3)
        assert np.all(file["samples"][...] == 2)
    with h5py.File(folder / "a0.vtkhdf") as file:
        assert file["vorticity"].shape == (*each[0].flag.shape, 3)
        assert summary["divergence_rms_per_s"] > 0.0
        assert "q_criterion" in file["VTKHDF/PointData"]
    # The fields are there: their mean is the same, with and without the options that pairs need.
    for number, extra in enumerate(((), ("--pairing", "ab", "-o", tmp_path / "unused"))):
        run("correlate", folder, "--derived", "--mean", tmp_path / f"{number}.vtkhdf", *extra)
        assert (tmp_path / f"{number}.vtkhdf").read_bytes() == mean.read_bytes()
    assert not (tmp_path / "unused").exists()


def warned(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[dict[str, Any], list[str]]:
    """Run correlate; return its summary and the codes of what it warns of."""
    summary = summary_of(capsys, "correlate", *arguments, "--overwrite")
    return summary, [each["code"] for each in summary["warnings"]]


def test_the_summary_says_how_good_it_is(
    volumes: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary, codes = warned(capsys, *volumes[:4], "--pairing", "ab", "-o", tmp_path)
    fields = [open_vectors(tmp_path / f"a{number}.vtkhdf") for number in range(2)]
    assert codes == []
    assert summary["vectors"] == sum(field.flag.size for field in fields)
    sigma = [field.uncertainty_voxel for field in fields]
    known = [np.isfinite(each).all(axis=-1) & (field.flag < 3) for each, field in zip(sigma, fields, strict=True)]
    medians = [np.median(each[here], axis=0) for each, here in zip(sigma, known, strict=True)]
    np.testing.assert_allclose(summary["uncertainty_voxel_median"], np.median(medians, axis=0))
    finite = sum(np.count_nonzero(field.flag < 3) for field in fields)
    assert summary["without_uncertainty_share"] == pytest.approx(1.0 - sum(each.sum() for each in known) / finite)
    in_doubt = sum(np.count_nonzero((field.flag > 0) & (field.flag < 4)) for field in fields)
    assert summary["in_doubt_share"] == pytest.approx(in_doubt / summary["vectors"])


def test_windows_that_do_not_fit_and_few_tracers_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = moved(tmp_path, (40, 40, 20), (0.1, 0.1, 0.4))
    output = ("-o", tmp_path / "v.vtkhdf")
    assert warned(capsys, *pair, "--windows", "32,16", *output)[1] == ["windows-too-large"]
    assert warned(capsys, *pair, "--windows", "32x32x16,16x16x8", *output)[1] == []
    pair = moved(tmp_path, seeding=Seeding(1.0, (1.0,) * 3), number=1)
    summary, codes = warned(capsys, *pair, "-o", tmp_path / "v.vtkhdf")
    assert "few-tracers" in codes
    assert open_vectors(tmp_path / "v.vtkhdf").flag.size == summary["vectors"]
    assert [each["code"] for each in read_header(tmp_path / "v.vtkhdf").provenance["warnings"]] == codes


def made_with(calibration: str, weights: str = "w") -> dict:
    return {
        "inputs": {"weights": {"sha256": weights}},
        "made_from": {weights: {"inputs": {"calibration": {"sha256": calibration}} if calibration else {}}},
    }


def test_volumes_that_are_no_pair_or_of_different_calibrations_are_told(rng: np.random.Generator) -> None:
    shape = (24, 24, 24)
    grid, settings = Grid.centred(shape, (0.1,) * 3, (0.0,) * 3), CorrelationSettings([(12, 12, 12)], (0.5,) * 3)
    one, other = (gaussian_filter((rng.random(shape) < 0.01).astype(np.float32), 1.0) for _ in range(2))
    for pair, codes in (
        ((one, one), ["volumes-alike"]),
        ((one, np.roll(one, 1, axis=2)), []),
        ((one, other), ["volumes-unlike"]),
    ):
        field = correlate([pair], grid, settings)
        assert [each.code for each in pair_notices(field, checks.quality_of(field), "v")] == codes
    assert calibration_notices({"a": made_with("1"), "b": made_with("1", "x"), "c": {}}) == []
    assert calibration_notices({"a": {}, "b": {}}) == []
    for other in (made_with("2"), made_with("", "x")):
        (notice,) = calibration_notices({"a": made_with("1"), "b": other})
        assert notice.code == "other-calibration"
        assert notice.about == "b"
    good = Quality(100, 90, 9, 85, 8, np.ones((1, 3)))
    assert list(field_notices(good, "v")) == []
    assert [each.code for each in field_notices(replace(good, without=60), "v")] == ["no-uncertainty"]
    assert [each.code for each in field_notices(replace(good, in_doubt=60), "v")] == ["vectors-in-doubt"]
    nothing = checks.quality_of_all([]).summary()
    assert nothing == {"uncertainty_voxel_median": None, "without_uncertainty_share": None, "in_doubt_share": None}
    volume = np.zeros((10, 10, 10), np.float32)
    volume[1::3, 1::3, 1::3] = 1.0
    # Along each axis they lie at 1, 4 and 7; the window in the middle holds two of these.
    assert tracers_per_window(volume, layout_windows((10, 10, 10), (6, 6, 6), (0.0, 0.0, 0.0))) == 8.0
    # The first windows hold two, the last ones one: 8, three times 4, three times 2, and 1.
    assert tracers_per_window(volume, WindowLayout((6, 6, 6), (6, 6, 6), (2, 2, 2), (-1, -1, -1))) == 3.0


@pytest.mark.thorough
def test_a_lost_frame_costs_its_pair_alone(tmp_path: Path) -> None:
    pair, folder = moved(tmp_path), tmp_path / "vectors"
    for name in ("a1", "a2", "b2", "b3", "a4", "b4"):
        shutil.copyfile(pair[name[0] == "b"], tmp_path / f"{name}.vtkhdf")
    left = sorted(tmp_path.glob("*[1-9].vtkhdf"))
    with pytest.raises(InputError, match=r"a1.vtkhdf: the second frame of its pair is missing, and 1 more"):
        run("correlate", *left, "--pairing", "ab", "-o", folder)
    assert not folder.exists()
    with pytest.raises(PartialError, match="2 of 4 pairs failed"):
        run("correlate", *left, "--pairing", "ab", "--keep-going", "-o", folder)
    assert sorted(path.name for path in folder.iterdir()) == ["a2.vtkhdf", "a4.vtkhdf"]
    for path in folder.iterdir():
        field = open_vectors(path)
        np.testing.assert_allclose(np.median(field.displacement_voxel, axis=(0, 1, 2)), SHIFT, atol=0.1)
    (tmp_path / "pairs.txt").write_text("a2 b3\n")
    run("correlate", *left, "--pairs", tmp_path / "pairs.txt", "-o", tmp_path / "listed.vtkhdf")
    assert open_vectors(tmp_path / "listed.vtkhdf").flag.size


def test_a_stated_time_against_the_recorded_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("correlate", *moved(tmp_path, times_s=(0.5, 0.504)), "-o", tmp_path / "v.vtkhdf")
    assert "recorded 0.004 s apart, and 0.002 s are stated" in capsys.readouterr().err


MOVED_MM = np.array([0.1, -0.05, 0.02])


def write_tracks(
    path: Path,
    rng: np.random.Generator,
    count: int = 100,
    *,
    full: bool = True,
    flow: Callable[[np.ndarray], np.ndarray] = np.zeros_like,
    changes: dict[str, dict[str, Any]] | None = None,
) -> Path:
    """Write tracks, with errors as stated, of a flow that is added to what moves as a whole."""
    sigma, dt_s = np.array([1e-3, 1e-3, 1e-2]), 2e-3
    place = rng.uniform(LOW, HIGH, (count, 3))
    displaced = MOVED_MM + flow(place) + sigma * rng.standard_normal((count, 3))
    settings = load_rig(CONFIG).overridden("correlation", dt_s=dt_s)
    for section, keys in (changes or {}).items():
        settings = settings.overridden(section, **keys)
    dt_s = float(settings.correlation.dt_s or dt_s)
    points = pair_tracks(place, displaced, sigma, dt_s, {"config": settings.resolved()}, Reference("mid_plane", 0.5))
    if not full:
        del points.arrays["displacement_covariance_mm2"]
    write_points(path, TRACKS_FORMAT, points, overwrite=True)
    return path


@pytest.fixture
def fitted_by(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> Callable[..., dict[str, Any]]:
    """What fits, by command with these options, `field.vtkhdf` to tracks, and tells its summary."""

    def fit(*options: object, **how: Any) -> dict[str, Any]:
        tracks = write_tracks(tmp_path / "tracks.vtkhdf", rng, **how)
        return summary_of(capsys, "field", tracks, *options, "-o", tmp_path / "field.vtkhdf")

    return fit


@pytest.mark.parametrize("no_slip", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_the_fluid_stands_still_at_a_pipes_wall(rng: np.random.Generator, no_slip: bool) -> None:
    wall, flow, dt_s = RoundWall(1.0, axis="x"), pipe(1.0, 0.05), 2e-3
    # few tracks, and none near the wall
    place = rng.uniform((-1.5, -0.8, -0.8), (1.5, 0.8, 0.8), (400, 3))
    place = place[wall.distances_mm(place) < 0.75]
    covariance = np.tile(np.diag([1e-3, 1e-3, 1e-2]) ** 2, (len(place), 1, 1))
    moved = flow(place) * dt_s * 1e3 + rng.normal(0.0, (1e-3, 1e-3, 1e-2), place.shape)
    sections = {"volume": {"shape_xyz": (30, 24, 24), "voxel_mm": (0.1, 0.1, 0.1)}}
    sections |= {"correlation": {"dt_s": dt_s, "windows": ((8, 8, 8),), "mask": "pipe"}}
    settings = Config.from_resolved(sections | {"pipe": {"radius_mm": 1.0, "no_slip": no_slip}})
    found = fitted([Samples(place, moved, covariance, np.ones(len(place)))], settings, "penalised", "tracks")
    at_wall = found.at(wall.points(np.array([-1.0, -1.1, -1.1]), np.array([1.0, 1.1, 1.1]), np.full(3, 0.3)))
    largest = np.abs(at_wall[:, 0]).max() / 0.1
    # of the velocity on the axis; without the wall the tracks do not tell it there
    assert largest < 0.02 if no_slip else largest > 0.03
    field = found.vectors()
    away = wall.shares(field.grid.centres_mm(), np.full(3, 0.8))
    np.testing.assert_array_equal(field.flag == MASKED, away < 0.25)
    assert 0 < np.sum(field.flag == MASKED) < field.flag.size


@pytest.mark.thorough
@pytest.mark.parametrize("full", [True, False])
def test_field_has_the_flow_of_its_tracks(tmp_path: Path, fitted_by: Callable[..., dict[str, Any]], full: bool) -> None:
    assert fitted_by(full=full)["samples"] == 100
    field = open_vectors(tmp_path / "field.vtkhdf")
    found = field.displacement_voxel[field.flag == 0] * field.voxel_mm
    np.testing.assert_allclose(found.mean(axis=0), MOVED_MM, atol=3e-3)
    assert field.uncertainty_voxel is not None
    # What it writes is samples again, of vectors.
    run("field", tmp_path / "field.vtkhdf", tmp_path / "tracks.vtkhdf", "-o", tmp_path / "both.vtkhdf")


@pytest.mark.thorough
def test_walls_stand_still_by_command(tmp_path: Path, fitted_by: Callable[..., dict[str, Any]]) -> None:
    wall, at = 0.5 * load_rig(CONFIG).resolved()["channel"]["width_mm"], tmp_path / "at.csv"
    np.savetxt(at, [[0.0, 0.0, -wall], [0.3, 0.2, wall], [0.0, 0.0, 0.0]], delimiter=",")
    still = {"flow": lambda place: -((place[:, 2:] / wall) ** 2) * MOVED_MM, "changes": {"channel": {"no_slip": True}}}
    assert fitted_by("--at", at, **still)["method"] == "splines"
    found = np.loadtxt(tmp_path / "field_at.csv", delimiter=",", skiprows=1)
    speed = np.linalg.norm(found[:, 3:6], axis=1)
    # walls hold the field within a thousandth of the displacements' spread
    assert np.all(speed[:2] < 1e-3 * speed[2])
    assert speed[2] == pytest.approx(np.linalg.norm(MOVED_MM) * 1e-3 / 2e-3, rel=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize("divergence", ["penalised", "free", "off"])
def test_what_is_known_of_the_divergence_is_chosen(fitted_by: Callable[..., dict[str, Any]], divergence: str) -> None:
    summary = fitted_by("--divergence", divergence, flow=lambda place: 0.05 * place)
    share = summary["divergence_rms_over_gradients_rms"]
    # the divergence is three times each of three gradients, and their rms counts six that are none
    assert share < 0.05 if divergence == "free" else share == pytest.approx(3.0 * np.sqrt(3.0), rel=0.05)
    if divergence == "free":
        assert summary["reduced_chi2"] > 2.0


def test_few_tracks_make_no_field_pairs_no_frames_and_no_pressure(tmp_path: Path, rng: np.random.Generator) -> None:
    tracks, output = write_tracks(tmp_path / "tracks.vtkhdf", rng, 5), tmp_path / "field.vtkhdf"
    with pytest.raises(InputError, match="5 samples, expected at least 20"):
        run("field", tracks, "-o", output)
    write_tracks(tracks, rng, 30)
    with pytest.raises(UsageError, match="one sequence"):
        fit_flow([tracks], output, FieldOptions(pressure=[tracks]), console=Console(quiet=True))
    with pytest.raises(UsageError, match="of a pair"):
        samples_of_tracks(open_tracks(tracks), 1)


# What two ways of measuring one flow differ in, and what makes their coordinates or displacements others.
@pytest.mark.parametrize(
    ("section", "key", "value", "found"),
    [
        ("reconstruction", "solver", "particles", None),
        ("weights", "sampling", "rays", None),
        ("correlation", "windows", ((8, 8, 8),), None),
        ("weights", "refraction", "exact", "weights.refraction is exact, expected paraxial"),
        ("media", "fluid", 1.4, "media.fluid is 1.4, expected 1.33"),
        ("correlation", "dt_s", 0.003, "0.002 and 0.003 s"),
    ],
)
def test_measurements_of_one_flow_need_the_same_coordinates_alone(
    section: str, key: str, value: Any, found: str | None, tmp_path: Path, rng: np.random.Generator
) -> None:
    changes = {"a": {}, "b": {section: {key: value}}}
    paths = [write_tracks(tmp_path / f"{name}.vtkhdf", rng, 20, changes=each) for name, each in changes.items()]
    with nullcontext() if found is None else pytest.raises(InputError, match=found):
        fit_flow(paths, tmp_path / "field.vtkhdf", console=Console(quiet=True))


def test_velocities_at_points_and_gradients(tmp_path: Path, fitted_by: Callable[..., dict[str, Any]]) -> None:
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n0.1, 0.2, 0.3\n\n-0.5,0,1e-1\n", encoding="utf-8")
    reported = fitted_by("--at", points, "--derived")
    # the flow moves as a whole: what is left is of the errors, 0.01 mm in 2 ms at most
    assert 0.0 <= reported["kinetic_energy_m2_s2"] < 0.5 * 0.005**2
    assert "dissipation_m2_s3" not in reported
    header, *lines = (tmp_path / "field_at.csv").read_text(encoding="utf-8").splitlines()
    rows = np.array([[float(word) for word in line.split(",")] for line in lines])
    assert header.split(",")[3] == "u_m_s"
    np.testing.assert_allclose(rows[:, :3], [[0.1, 0.2, 0.3], [-0.5, 0.0, 0.1]])
    # a hundred tracks with errors of 0.001 and 0.01 mm in 2 ms: a third of one track's
    np.testing.assert_allclose(rows[:, 3:6], np.tile(MOVED_MM / 2.0, (2, 1)), atol=2e-3)
    assert np.all(np.abs(rows[:, 3:6] - MOVED_MM / 2.0) < 5.0 * rows[:, 6:])
    with h5py.File(tmp_path / "field.vtkhdf") as file:
        trace = sum(file[f"gradient_{name}"][..., axis] for axis, name in enumerate("uvw"))
        np.testing.assert_allclose(trace, file["divergence"][()], atol=1e-12)
    for text, found in (("", "is empty"), ("\n", "no points"), ("1,2\n", "line 1"), ("1,2,nan\n", "line 1")):
        points.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=found):
            read_places(points)


def test_a_sequence_s_samples_are_those_of_its_frame() -> None:
    frame = np.array([0, 1, 2, 0, 1, 2])
    points = points_of(TRAJECTORIES_FORMAT, np.random.default_rng(1), 6, dt_s=2e-3)
    probability = np.array([np.nan, 0.9, 0.8, np.nan, 0.7, 0.6])
    points.arrays.update(velocity=np.outer(frame, [0.1, 0.2, 0.3]), velocity_sigma=np.full((6, 3), 0.01))
    points.arrays.update(frame=frame, link_probability=probability)
    found = samples_of_tracks(points)
    np.testing.assert_array_equal(found.points_mm, points.position_mm[[1, 4]])
    np.testing.assert_allclose(found.value_mm, np.tile([0.2, 0.4, 0.6], (2, 1)))
    np.testing.assert_allclose(found.covariance_mm2, np.tile(4e-4 * np.eye(3), (2, 1, 1)))
    np.testing.assert_array_equal(samples_of_tracks(points, 2).probability, [0.8, 0.6])
    with pytest.raises(UsageError, match="frame 3 is none of 3"):
        samples_of_tracks(points, 3)


def test_doubts_are_told() -> None:
    for divergence, share, chi2, belonging, codes in (
        ("penalised", 0.01, 0.9, 99, []),
        ("penalised", 0.5, 0.9, 99, ["flow-with-sources"]),
        ("free", 0.01, 3.0, 99, ["field-off-samples"]),
        ("off", 0.5, 0.9, 60, ["samples-left-out"]),
    ):
        summary = {"divergence_rms_over_gradients_rms": share, "reduced_chi2": chi2, "samples": 100}
        notices = fit_notices(summary | {"samples_belonging": belonging}, divergence, "tracks.vtkhdf")
        assert [notice.code for notice in notices] == codes


@pytest.mark.thorough
def test_the_grid_of_track_by_splines_is_the_field_of_its_tracks(tmp_path: Path, rng: np.random.Generator) -> None:
    pair = write_frames(tmp_path, rng.uniform(LOW, HIGH, (80, 3)), MOVED_MM + 1e-4 * rng.standard_normal((80, 3)))
    run("track", *pair, "--grid", "--by", "spline", "--dt-s", "0.002", "-o", tmp_path / "tracks.vtkhdf", "-q")
    run("field", tmp_path / "tracks.vtkhdf", "-o", tmp_path / "field.vtkhdf", "-q")
    grids = [open_vectors(tmp_path / name) for name in ("tracks_grid.vtkhdf", "field.vtkhdf")]
    np.testing.assert_array_equal(grids[0].displacement_voxel, grids[1].displacement_voxel)
    assert np.isfinite(grids[0].displacement_voxel).any()
