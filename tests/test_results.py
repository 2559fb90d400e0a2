"""Results in Python: described, saved, drawn, as labelled arrays; what `info` tells of files, and their verdict."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

import lfpiv_cli as lf
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import OutputExistsError, UsageError
from lfpiv_cli.files.hdf5 import write_tree
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, Points, write_points
from lfpiv_cli.files.vtkhdf import write_vectors, write_volume
from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, VALID
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.results import ArrayResult, Result
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs.checks import FOR_INFORMATION, Line, of_two_ways, of_vectors, of_warnings, worst
from lfpiv_cli.verbs.plot import figures_of
from lfpiv_cli.verbs.results import KINDS
from tests.commands import ROOT, table2_rig
from tests.vector_fields import SHAPE, SIGMA_VOXEL, VOXEL_MM, field_of, field_on, noise_mm, rotation_mm, steady_mm
from tests.written_files import WrittenFiles

# The kinds of files that are opened, and what opens them.
OPENED = {
    **dict.fromkeys(("calibration", "fitted rays", "refined calibration"), lf.open_calibration),
    **dict.fromkeys(
        ("weights", "weights without calibration", "weights on demand", "counted weights", "weights in strips"),
        lf.open_weights,
    ),
    "volume": lf.open_volume,
    "tracks on a grid": lf.open_vectors,
    **dict.fromkeys(("particles", "followed particles"), lf.open_particles),
    **dict.fromkeys(("tracks", "tracks of a sequence"), lf.open_tracks),
}


DERIVED = ("vorticity", "divergence", "strain_rate", "q_criterion")


def inside(path: Path, *left_out: str) -> dict[str, Any]:
    """Return all datasets and attributes of a file, but for what HDF5 keeps itself and the sums over attributes."""
    found: dict[str, Any] = {}

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = (item.dtype, item.shape, np.asarray(item).tobytes())
        for each, value in item.attrs.items():
            if each not in ("REFERENCE_LIST", "DIMENSION_LIST", "attributes_sha256", *left_out):
                found[f"{name}@{each}"] = repr(value)

    with h5py.File(path) as file:
        take("", file)
        file.visititems(take)
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("kind", OPENED)
def test_what_is_opened_is_saved_and_drawn_as_its_file(files: WrittenFiles, kind: str, tmp_path: Path) -> None:
    path, saved = files.path(kind), tmp_path / "saved.h5"
    result = OPENED[kind](path)
    said = repr(result).splitlines()
    assert len(said) == 2
    assert max(map(len, said)) < 180
    result.save(saved)
    assert inside(saved) == inside(path)
    with pytest.raises(OutputExistsError):
        result.save(str(saved))
    OPENED[kind](saved).save(str(saved), overwrite=True)
    assert inside(saved) == inside(path)
    figure = result.plot(list(figures_of(saved))[-1])
    assert len(figure.axes)
    with pytest.raises(UsageError, match="has the figures"):
        result.plot("nothing of the kind")


@pytest.mark.thorough
def test_what_functions_return_is_saved_as_commands_write_it(files: WrittenFiles, tmp_path: Path) -> None:
    volumes = [lf.open_volume(files.path(name)) for name in ("first volume", "volume")]
    particles = [lf.open_particles(files.path(name)) for name in ("first particles", "particles")]
    vectors, on_grid = (lf.open_vectors(files.path(name)) for name in ("vectors", "tracks on a grid"))
    tracks, pairs = lf.track(*particles), sorted(files.path("mean/vectors").iterdir())
    second = [lf.open_volume(files.path(f"volumes/frame_{number:04d}.vtkhdf")) for number in (1, 2)]
    made = {
        "mean/vectors/frame_0001.vtkhdf": lf.correlate(*second),
        "tracks": tracks,
        "tracks on a grid": tracks.vectors()[0],
        "combined vectors": lf.combine(vectors, on_grid),
        "statistics": lf.statistics(*map(lf.open_vectors, pairs)),
        "field": lf.fit_field(tracks, vectors),
    }
    assert lf.correlate(*volumes).provenance["config"] == vectors.provenance["config"]
    for kind, result in made.items():
        result.save(tmp_path / "saved.vtkhdf", overwrite=True)
        found, expected = (inside(path, "provenance") for path in (tmp_path / "saved.vtkhdf", files.path(kind)))
        # The command was asked for derived quantities, too.
        asked = {name for name in expected if name.rpartition("/")[2].startswith(("gradient_", *DERIVED))}
        assert found == {name: each for name, each in expected.items() if name not in asked}, kind
        assert bool(asked) == (kind in ("field", "mean/vectors/frame_0001.vtkhdf"))
        assert len(repr(result).splitlines()) == 2
    assert {type(each).__name__ for each in made.values()} < set(KINDS)
    # Statistics have the figures of theirs, a field those of vectors.
    assert len(made["statistics"].plot("convergence").axes) == 2
    assert made["field"].plot().axes


@pytest.mark.thorough
def test_arrays_are_labelled_and_tables_have_units(files: WrittenFiles) -> None:
    xarray = pytest.importorskip("xarray")
    for kind, opened in (("volume", lf.open_volume), ("tracks on a grid", lf.open_vectors)):
        found = opened(files.path(kind)).to_xarray()
        with xarray.open_dataset(files.path(kind), engine="h5netcdf") as stored:
            assert set(found) == set(stored)
            for name in stored:
                assert found[name].dims == stored[name].dims
                np.testing.assert_array_equal(found[name], stored[name])
                assert found[name].units == stored[name].attrs["units"]
                assert found[name].long_name
            np.testing.assert_array_equal(found.z, stored.z)
        assert found.attrs["reference"] == "mid_plane"
    tracks = lf.open_tracks(files.path("tracks"))
    table, labelled = tracks.to_pandas(), tracks.to_xarray()
    assert table.attrs["units"]["u"] == labelled.velocity.units == "m/s"
    assert table.attrs["long_name"]["link_probability"] == "probability that the link is right"
    np.testing.assert_array_equal(table[["u", "v", "w"]], tracks.arrays["velocity"])
    depths = labelled.displacement_covariance_mm2.sel(component_6="zz")
    np.testing.assert_array_equal(depths, tracks.arrays["displacement_covariance_mm2"][:, 2])
    grid = lf.open_vectors(files.path("tracks on a grid"))
    rows = grid.to_pandas()
    np.testing.assert_array_equal(rows["w"], grid.velocity[..., 2].ravel())
    np.testing.assert_allclose(rows[["x", "y", "z"]], grid.grid.centres_mm().reshape(-1, 3))


@pytest.mark.parametrize(("name", "extra"), [("xarray", "arrays"), ("pandas", "arrays"), ("matplotlib", "plot")])
def test_what_is_not_installed_is_named(name: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    volume = lf.correlate(*np.random.default_rng(1).random((2, 12, 12, 12)), voxel_mm=(0.1, 0.1, 0.1), windows=(6,))
    do = {"xarray": volume.to_xarray, "pandas": volume.to_pandas, "matplotlib": volume.plot}[name]
    with pytest.raises(lf.LfpivError, match=rf"{name}.*lfpiv\[{extra}\]"):
        do()


def test_each_result_has_its_kind() -> None:
    def under(kind: type) -> set[str]:
        return {kind.__name__}.union(*map(under, kind.__subclasses__()))

    assert under(Result) - {"Result", "ArrayResult"} == set(KINDS)
    assert {name for name, kind in KINDS.items() if kind.content} == under(ArrayResult) - {"ArrayResult"}


AT_FOCUS = Reference("focal_point", 0.0)
VOXELS = Grid.centred((1, 2, 3), (0.1, 0.1, 0.2), (0.0, 0.0, 0.0))


@pytest.fixture
def weights(tmp_path):
    config, output = tmp_path / "rig.yaml", tmp_path / "weights.h5"
    config.write_text(table2_rig(240, 200, volume={"shape_xyz": [5, 4, 3], "voxel_mm": [0.1, 0.1, 0.4]}))
    run("build-weights", str(config), "-o", str(output))
    return output


def run(*arguments: str) -> str:
    return CliRunner().invoke(cli, list(arguments), catch_exceptions=False).stdout


def test_info_names_format_method_shapes_and_origin(weights):
    found = json.loads(run("info", str(weights), "--json"))
    assert found["format"] == "lfpiv-weights"
    assert (found["method"], found["refraction"], found["sampling"]) == ("ert", "paraxial", "exact")
    assert found["grid/shape_xyz"] == [5, 4, 3]
    assert found["columns/share"].startswith("float32")
    assert found["inputs"] == ["config rig.yaml"]


@pytest.mark.thorough
def test_info_draws_a_column(weights, tmp_path):
    picture = tmp_path / "column.png"
    run("info", str(weights), "--picture", str(picture), "--voxel", "4", "0", "2")
    assert picture.stat().st_size > 5_000
    with pytest.raises(UsageError, match="5 x 4 x 3"):
        run("info", str(weights), "--picture", str(picture), "--overwrite", "--voxel", "5", "0", "0")


def test_info_draws_weights_alone_and_names_plot_for_the_rest(tmp_path):
    path = tmp_path / "volume.vtkhdf"
    write_volume(path, np.ones((3, 2, 1)), VOXELS, AT_FOCUS, provenance={}, attributes={}, overwrite=True)
    with pytest.raises(UsageError, match=r"lfpiv plot .*volume\.vtkhdf"):
        run("info", str(path), "--picture", str(tmp_path / "p.png"))
    found = json.loads(run("info", str(path), "--json"))
    assert (found["voxels_xyz"], found["largest_intensity"], found["lit_share"]) == ([1, 2, 3], 1.0, 1.0)
    assert found["bounds_mm"][2] == pytest.approx([-0.3, 0.3])


def test_info_counts_vectors_by_flag_and_gives_medians(tmp_path):
    path = tmp_path / "vectors.vtkhdf"
    displacement = np.array([[1.0, 0.0, 5.0], [3.0, 0.0, 6.0], [99.0, 0.0, 99.0]]).reshape(3, 1, 1, 3)
    sigma = np.array([[0.1, np.nan, 1.0], [0.3, np.nan, 2.0], [9.0, 9.0, 9.0]]).reshape(3, 1, 1, 3)
    flag = np.array([VALID, REPLACED, REJECTED], np.uint8).reshape(3, 1, 1)
    grid = Grid.centred((1, 1, 3), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    field = field_on(grid, displacement, flag, sigma)
    write_vectors(path, field, AT_FOCUS, provenance=made("correlate", "few-tracers"), overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    assert (found["vectors"], found["valid_share"]) == (3, pytest.approx(1.0 / 3.0))
    counts = [found[f"vectors_{name}"] for name in ("valid", "replaced", "second_peak", "rejected", "masked")]
    assert counts == [1, 1, 0, 1, 0]
    assert found["median_displacement_voxel"] == [2.0, 0.0, 5.5]
    assert found["median_velocity_m_s"] == pytest.approx([0.2, 0.0, 0.55])
    assert found["median_sigma_voxel"] == pytest.approx([0.2, None, 1.5])
    assert found["median_velocity_sigma_m_s"] == pytest.approx([0.02, None, 0.15])
    assert "few-tracers" in found["warnings_recorded"][0]


def test_info_tells_of_particles_and_tracks_what_a_person_wants(tmp_path):
    path = tmp_path / "points.vtkhdf"
    places = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
    tensors = np.tile([1e-6, 4e-6, 9e-6, 0.0, 0.0, 0.0], (3, 1))
    arrays = {"intensity": np.array([1.0, 2.0, 9.0]), "covariance_mm2": tensors, "chi2": np.ones(3), "seen": np.ones(3)}
    outside = np.array([0, 0, 1], np.uint8)
    write_points(path, PARTICLES_FORMAT, Points(places, arrays | {"flag": outside}, AT_FOCUS, {}, {}), overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    assert (found["particles"], found["particles_outside"], found["depths_mm"]) == (3, 1, [-1.0, 3.0])
    assert found["median_sigma_mm"] == pytest.approx([1e-3, 2e-3, 3e-3])
    assert (found["median_light_counts"], found["median_chi2"]) == (2.0, 1.0)
    links = {"velocity": places, "velocity_sigma": np.ones((3, 3)), "link_probability": np.array([np.nan, 0.5, 1.0])}
    pair = links | {"displacement_mm": places, "particle_a": outside, "particle_b": outside}
    write_points(path, TRACKS_FORMAT, Points(places, pair, AT_FOCUS, {}, {}), overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    # Three numbers are told as they are, but for one that is none.
    assert found["link_probability"] == "float64 [3]"
    assert (found["tracks"], found["expected_wrong_links"], found["links_of_unknown_probability"]) == (3, 0.5, 1)
    assert found["median_velocity_m_s"] == [0.0, 0.0, 2.0]
    paths = links | {"track": np.array([4, 4, 7]), "frame": np.array([0, 1, 1]), "particle": outside}
    write_points(path, TRAJECTORIES_FORMAT, Points(places, paths, AT_FOCUS, {}, {}), overwrite=True)
    found = json.loads(run("info", str(path), "--json"))
    assert (found["tracks"], found["frames"], found["median_frames_of_a_track"]) == (2, 2, 1.5)


def test_info_tells_of_files_of_other_formats(tmp_path):
    path = tmp_path / "other.h5"
    write_tree(path, {"a_mm": np.zeros(9)}, format_name="x", format_version=1, provenance={}, overwrite=True)
    assert json.loads(run("info", str(path), "--json"))["a_mm"] == "float64 [9]"


TROUBLESHOOTING = ROOT / "docs" / "troubleshooting.md"


def made(command: str, *codes: str) -> dict[str, Any]:
    warning = {"about": "a.tif", "remedy": "mend it", "measured": None}
    return {"command": command, "warnings": [warning | {"code": code, "text": f"found {code}"} for code in codes]}


def words(lines: list[Line]) -> dict[str, str]:
    parts = ("calibration", "images", "vectors")
    return {part: worst((line for line in lines if line.about == part), "good") for part in parts}


def test_warnings_count_for_the_part_that_their_command_makes() -> None:
    records = {
        "calibration.h5": made("calibrate-snapshot", "f-numbers"),
        "particles/a.vtkhdf": made("reconstruct page 0", "light-unexplained"),
        "tracks.vtkhdf": made("track"),
    }
    assert words(of_warnings(records)) == {"calibration": "look", "images": "no", "vectors": "good"}
    found = of_warnings({"a.vtkhdf": made("reconstruct", "particle-diameter-limit")})
    assert [(each.about, each.verdict) for each in found] == [("images", "good")]
    records = {f"{number}.vtkhdf": made("reconstruct", "frame-saturated") for number in range(5)}
    [reason] = of_warnings(records)
    assert "(and 4 more)" in reason.reason
    assert "mend it" in reason.reason
    lines = [Line("images", "good", "fine"), Line("images", "no", "dark"), Line("images", "look", "dim")]
    assert (worst(lines), worst([])) == ("no", "unknown")
    documented = set(re.findall(r"^\| `([a-z-]+)` \|", TROUBLESHOOTING.read_text(encoding="utf-8"), re.MULTILINE))
    assert documented >= checks.WORTHLESS | FOR_INFORMATION


def test_vectors_as_good_as_they_state_and_not() -> None:
    # Of errors as stated, half of them, and a sixth.
    for understated, word in ((1.0, "good"), (2.0, "good"), (6.0, "look")):
        field = field_of(rotation_mm() * 20.0 + noise_mm(0), SIGMA_VOXEL / understated)
        assert words(of_vectors(field, "v"))["vectors"] == word
    [_, reason] = of_vectors(field_of(noise_mm(0), SIGMA_VOXEL), "v")
    assert reason.verdict == "look"
    assert "standard deviations of zero" in reason.reason
    reasons = of_vectors(field_of(steady_mm(), np.array([0.05, 0.02, 1.2])), "v")
    [reason] = [each for each in reasons if each.verdict == "look"]
    assert "w is known to 0.36 mm, 36% of the usual displacement" in reason.reason
    assert words(of_vectors(field_of(steady_mm(), SIGMA_VOXEL), "v"))["vectors"] == "good"
    field = field_of(rotation_mm(), SIGMA_VOXEL)
    for flag in (REJECTED, MASKED):
        field.flag[:] = flag
        assert words(of_vectors(field, "v"))["vectors"] == "no"
    one, same = (field_of(rotation_mm() + noise_mm(seed), SIGMA_VOXEL) for seed in (1, 2))
    off = field_of(rotation_mm() + noise_mm(3) + 8.0 * SIGMA_VOXEL * VOXEL_MM, SIGMA_VOXEL)
    assert of_two_ways(one, same, ("a", "b"))[0].verdict == "good"
    assert of_two_ways(one, off, ("a", "b"))[0].verdict == "look"
    assert not of_two_ways(one, field_of(np.zeros((*SHAPE, 3)), None), ("a", "b"))
