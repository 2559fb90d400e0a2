"""`field` as a command: tracks and vectors of a flow in, vectors on the grid of the windows out."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.particle_file import TRACKS_FORMAT, Points, open_tracks, write_points
from lfpiv_cli.flow.correlation import SMALLEST_VALID_FRACTION
from lfpiv_cli.flow.field import MASKED
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.grid import Reference
from lfpiv_cli.synthetic.flows import pipe
from lfpiv_cli.verbs.field import FieldOptions, fit_flow, read_places
from lfpiv_cli.verbs.fields import LARGEST_CHI2, fit_notices, fitted, samples_of_tracks
from tests.commands import CONFIG, run, told
from tests.test_particle_stage import HIGH, LOW, write_frame

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
    moved = MOVED_MM + flow(place) + sigma * rng.standard_normal((count, 3))
    per_s = 1e-3 / dt_s
    arrays = {"velocity": moved * per_s, "velocity_sigma": np.tile(sigma * per_s, (count, 1))}
    arrays |= {"displacement_mm": moved, "link_probability": np.full(count, 0.99)}
    arrays |= dict.fromkeys(("particle_a", "particle_b"), np.arange(count))
    if full:
        arrays["displacement_covariance_mm2"] = np.tile([*sigma**2, 0.0, 0.0, 0.0], (count, 1))
    settings = load_rig(CONFIG).overridden("correlation", dt_s=dt_s)
    for section, keys in (changes or {}).items():
        settings = settings.overridden(section, **keys)
    attributes, made = {"dt_s": settings.correlation.dt_s}, {"config": settings.resolved()}
    points = Points(place, arrays, Reference("mid_plane", 0.5), attributes, made)
    write_points(path, TRACKS_FORMAT, points, overwrite=True)
    return path


@pytest.fixture
def fitted_by(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> Callable[..., dict[str, Any]]:
    """What fits, by command with these options, `field.vtkhdf` to tracks, and tells its summary."""

    def fit(*options: object, **how: Any) -> dict[str, Any]:
        tracks = write_tracks(tmp_path / "tracks.vtkhdf", rng, **how)
        return told(capsys, "field", tracks, *options, "-o", tmp_path / "field.vtkhdf")

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
    np.testing.assert_array_equal(field.flag == MASKED, away < SMALLEST_VALID_FRACTION)
    assert 0 < np.sum(field.flag == MASKED) < field.flag.size


@pytest.mark.thorough
@pytest.mark.parametrize("full", [True, False])
def test_field_has_the_flow_of_its_tracks(tmp_path: Path, fitted_by: Callable[..., dict[str, Any]], full: bool) -> None:
    assert fitted_by(full=full)["samples"] == 100
    field = vtkhdf.open_vectors(tmp_path / "field.vtkhdf")
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
        assert summary["reduced_chi2"] > LARGEST_CHI2


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
    told = fitted_by("--at", points, "--derived")
    # the flow moves as a whole: what is left is of the errors, 0.01 mm in 2 ms at most
    assert 0.0 <= told["kinetic_energy_m2_s2"] < 0.5 * 0.005**2
    assert "dissipation_m2_s3" not in told
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
    arrays = {
        "velocity": np.outer(frame, [0.1, 0.2, 0.3]),
        "velocity_sigma": np.full((6, 3), 0.01),
        "track": np.array([0, 0, 0, 1, 1, 1]),
        "frame": frame,
        "particle": np.zeros(6, int),
        "link_probability": np.array([np.nan, 0.9, 0.8, np.nan, 0.7, 0.6]),
    }
    points = Points(np.arange(18.0).reshape(6, 3), arrays, Reference("mid_plane", 0.5), {"dt_s": 2e-3}, {})
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
    place, pair = rng.uniform(LOW, HIGH, (80, 3)), [tmp_path / "a.vtkhdf", tmp_path / "b.vtkhdf"]
    for path, moved in zip(pair, (0.0, MOVED_MM), strict=True):
        write_frame(path, place + moved + 1e-4 * rng.standard_normal((80, 3)))
    run("track", *pair, "--grid", "--by", "spline", "--dt-s", "0.002", "-o", tmp_path / "tracks.vtkhdf", "-q")
    run("field", tmp_path / "tracks.vtkhdf", "-o", tmp_path / "field.vtkhdf", "-q")
    grids = [vtkhdf.open_vectors(tmp_path / name) for name in ("tracks_grid.vtkhdf", "field.vtkhdf")]
    np.testing.assert_array_equal(grids[0].displacement_voxel, grids[1].displacement_voxel)
    assert np.isfinite(grids[0].displacement_voxel).any()
