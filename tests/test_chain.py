"""The whole chain on the shipped sample: by commands, against the sample's truth; from Python, as by commands."""

import inspect
import json
import os
import pydoc
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest

import lfpiv_cli as lf
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import ConfigError, InputError, LimitMissedError, UsageError
from lfpiv_cli.files.config import carried_config, load_rig
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.particle_file import read_particles
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume
from lfpiv_cli.reconstruction.haze import ROUNDING_COUNTS
from lfpiv_cli.reconstruction.images import light
from lfpiv_cli.verbs.frames import bench_of
from tests.commands import CONFIG, SAMPLE, run, summary_of


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the chain's outputs on the sample."""
    out = tmp_path_factory.mktemp("chain")
    white, dark, board = (SAMPLE / f"{name}.tif" for name in ("white", "dark", "board"))
    calibration, weights = out / "calibration.h5", out / "weights.h5"
    pictures = ("--picture", out / "calibration.png")
    run("calibrate-snapshot", CONFIG, "--white", white, "--dark", dark, "--board", board, "-o", calibration, *pictures)
    run("build-weights", CONFIG, "--calibration", calibration, "-o", weights)
    pair = SAMPLE / "pair_a.tif", SAMPLE / "pair_b.tif"
    run("reconstruct", weights, *pair, "--dark", dark, "-o", out / "volumes")
    volumes = out / "volumes" / "pair_a.vtkhdf", out / "volumes" / "pair_b.vtkhdf"
    run("correlate", *volumes, "-o", out / "vectors.vtkhdf")
    run("validate", "flow", CONFIG, "--vectors", out / "vectors.vtkhdf", "-o", out / "report")
    return out


def truth(name: str) -> dict:
    return json.loads((SAMPLE / f"{name}.json").read_text())


@pytest.mark.thorough
def test_calibration_finds_what_was_simulated(chain, capsys) -> None:
    pictures = [word for name in ("white", "dark", "board") for word in (f"--{name}", SAMPLE / f"{name}.tif")]
    found, true = summary_of(capsys, "calibrate-snapshot", CONFIG, *pictures, "-o", chain / "c.h5"), truth("board")
    # The bounds asked of the full-size experiment, from a fifteenth of its lenses.
    assert found["rotation_deg"] == pytest.approx(true["rotation_deg"], abs=0.01)
    assert np.allclose(found["origin_px"], true["origin_px"], atol=0.2)
    assert np.allclose(found["pitch_px"], true["pitch_px"], atol=0.01)
    assert found["board_z_mm"] == pytest.approx(true["board_z_mm"], abs=0.15)
    assert np.allclose(found["offset_mm"], true["offset_mm"], atol=0.01)
    assert np.allclose(found["tilt_deg"], true["tilt_deg"], atol=1.0)
    assert found["mid_plane_z_mm"] == pytest.approx(truth("particles")["reference_z_mm"], abs=0.2)


def test_light_is_reconstructed_where_the_particles_are(chain) -> None:
    volume = open_volume(chain / "volumes" / "pair_a.vtkhdf")
    settings = load_rig(CONFIG)
    particles = read_particles(SAMPLE / "particles.npz")
    start = particles.positions_mm - particles.velocities_m_s * 1e3 * 0.5 * settings.correlation.dt_s
    start[:, 2] -= truth("particles")["reference_z_mm"]
    at = np.rint(volume.grid.mm_to_voxel(start)).astype(int)
    at = at[np.all((at >= 0) & (at < volume.grid.shape_xyz), axis=1)]
    mirrored = np.array(volume.grid.shape_xyz) - 1 - at
    light = volume.array[at[:, 2], at[:, 1], at[:, 0]].mean()
    # A wrong sign of any axis would find the mean light of the volume at the true places.
    assert light > 4.0 * volume.array.mean()
    for axis in range(3):
        wrong = at.copy()
        wrong[:, axis] = mirrored[:, axis]
        assert volume.array[wrong[:, 2], wrong[:, 1], wrong[:, 0]].mean() < 0.5 * light


def test_vectors_follow_the_shear(chain) -> None:
    field = open_vectors(chain / "vectors.vtkhdf")
    assert field.grid.shape_xyz == (5, 3, 6)  # floor(N / 6) windows of 12 voxels at half overlap in 30 x 22 x 40
    z = field.grid.axis_mm(2)
    profile = np.nanmean(field.velocity[..., 0], axis=(1, 2))
    slope, middle = np.polyfit(z, profile, 1)
    assert slope == pytest.approx(0.030, rel=0.15)  # m/s per mm; elongation mixes depths, more so at the ends
    assert middle == pytest.approx(0.12, rel=0.05)
    assert np.nanmax(np.abs(np.nanmean(field.velocity[..., 1], axis=(1, 2)))) < 0.01


def test_report_holds_figures_no_nan_and_a_missed_limit(chain) -> None:
    report = json.loads((chain / "report" / "flow.json").read_text(), parse_constant=pytest.fail)
    assert report["figures"]["within_25_percent_streamwise"] > 0.8
    assert report["provenance"]["inputs"]["config"]["name"] == "sample.yaml"
    assert (chain / "report" / "flow.png").stat().st_size > 10_000


@pytest.mark.thorough
def test_true_particles_judge_like_the_analytic_flow_and_a_missed_limit_is_told_last(chain, tmp_path, capsys) -> None:
    particles = SAMPLE / "particles.npz"
    vectors = chain / "vectors.vtkhdf"
    run("validate", "flow", CONFIG, "--vectors", vectors, "--particles", particles, "-o", tmp_path)
    by_particles = json.loads((tmp_path / "flow.json").read_text())["figures"]
    by_flow = json.loads((chain / "report" / "flow.json").read_text())["figures"]
    # The shear is linear, so the fit to the particles is exact but for their float32 and the focal plane's 2 um.
    assert by_particles["rms_u_voxel"] == pytest.approx(by_flow["rms_u_voxel"], abs=0.01)
    # A missed limit is told after report and figures.
    strict = tmp_path / "strict.yaml"
    strict.write_text(CONFIG.read_text() + "  limits: {streamwise_mean_error: 0.0}\n")
    capsys.readouterr()
    with pytest.raises(LimitMissedError, match="streamwise_mean_error"):
        run("validate", "flow", strict, "--vectors", chain / "vectors.vtkhdf", "-o", tmp_path / "strict", "--json")
    assert json.loads(capsys.readouterr().out)["streamwise_mean_error"] != 0.0
    assert (tmp_path / "strict" / "flow.json").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("threads", [1, 2])
def test_same_bytes_for_any_number_of_threads(chain, tmp_path, threads) -> None:
    before = numba.get_num_threads()
    dark = ("--dark", SAMPLE / "dark.tif", "--threads", threads)
    try:
        run("reconstruct", chain / "weights.h5", SAMPLE / "pair_a.tif", *dark, "-o", tmp_path / "a.vtkhdf")
        pair = chain / "volumes" / "pair_a.vtkhdf", chain / "volumes" / "pair_b.vtkhdf"
        run("correlate", *pair, "--threads", threads, "-o", tmp_path / "v.vtkhdf")
    finally:
        numba.set_num_threads(before)
    assert (tmp_path / "a.vtkhdf").read_bytes() == (chain / "volumes" / "pair_a.vtkhdf").read_bytes()
    assert (tmp_path / "v.vtkhdf").read_bytes() == (chain / "vectors.vtkhdf").read_bytes()


@pytest.mark.slow
def test_the_run_that_compiles_gives_the_bits_of_later_ones(chain, tmp_path) -> None:
    """A kernel that others call is optimised in each of them: which copy runs depends on what was compiled here."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    command = ("reconstruct", chain / "weights.h5", SAMPLE / "pair_a.tif", "--dark", SAMPLE / "dark.tif", "-o")
    for name in ("first", "later"):
        words = [*command, tmp_path / f"{name}.vtkhdf", "--solver", "particles", "--no-residual"]
        subprocess.run([sys.executable, "-m", "lfpiv_cli", *map(str, words)], env=environment, check=True)
    assert (tmp_path / "first.vtkhdf").read_bytes() == (tmp_path / "later.vtkhdf").read_bytes()


@pytest.mark.thorough
def test_volumes_that_do_not_belong_together_are_refused(chain, tmp_path) -> None:
    a, b = (chain / "volumes" / f"pair_{name}.vtkhdf" for name in "ab")
    weights, image = chain / "weights.h5", SAMPLE / "pair_b.tif"
    run("reconstruct", weights, image, "--iterations", 2, "-o", tmp_path / "other.vtkhdf")
    with pytest.raises(InputError, match="another config"):
        run("correlate", a, tmp_path / "other.vtkhdf", "-o", tmp_path / "v.vtkhdf")
    with pytest.raises(UsageError, match="--pairing"):
        run("correlate", a, b, a, b, "-o", tmp_path / "v.vtkhdf")


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_every_help_has_an_example(name) -> None:
    assert "Example: lfpiv " + name in (cli.commands[name].help or "")


def image(name: str) -> np.ndarray:
    return lf.read_image(SAMPLE / f"{name}.tif")


def corner() -> np.ndarray:
    """Return a mask that leaves a part of the image, with few particles to look for."""
    mask = np.zeros((448, 600), np.uint8)
    mask[100:300, 150:400] = 1
    return mask


@pytest.fixture(scope="module")
def by_commands(chain: Path) -> Path:
    """The folder of what the commands write: the chain, and a part of the images by particles."""
    write_tiff(chain / "mask.tif", corner(), overwrite=False)
    searched = ("--dark", SAMPLE / "dark.tif", "--mask", chain / "mask.tif", "--solver", "particles")
    images = SAMPLE / "pair_a.tif", SAMPLE / "pair_b.tif"
    run("reconstruct", chain / "weights.h5", *images, *searched, "-o", chain / "particles", "-q")
    found = sorted((chain / "particles").glob("pair_?.vtkhdf"))
    run("track", *found, "--grid", "-o", chain / "tracks.vtkhdf", "-q")
    return chain


@pytest.mark.thorough
def test_calibration_and_weights_are_those_of_the_commands(by_commands: Path) -> None:
    rig = lf.load_rig(CONFIG)
    calibration = lf.calibrate(image("white"), image("board"), rig, dark=image("dark"))
    written = lf.open_calibration(by_commands / "calibration.h5")
    assert calibration.summary() == written.summary()
    np.testing.assert_array_equal(calibration.transmission, written.transmission)
    weights, stored = lf.build_weights(rig, calibration), lf.open_weights(by_commands / "weights.h5")
    volume = np.random.default_rng(1).random(weights.shape, dtype=np.float32)
    np.testing.assert_array_equal(weights.forward(volume), stored.forward(volume))
    assert (stored.reference, stored.frame) == (weights.reference, "rectified")


@pytest.mark.thorough
def test_volumes_and_vectors_are_those_of_the_commands(by_commands: Path) -> None:
    weights = lf.open_weights(by_commands / "weights.h5")
    pair = [lf.reconstruct(weights, image(name), dark=image("dark")) for name in ("pair_a", "pair_b")]
    for volume, name in zip(pair, ("pair_a", "pair_b"), strict=True):
        written = lf.open_volume(by_commands / "volumes" / f"{name}.vtkhdf")
        np.testing.assert_array_equal(volume.array, written.array)
        assert volume.grid == written.grid
        assert volume.attributes["residual"].tolist() == list(written.attributes["residual"])
    field, written_field = lf.correlate(*pair), lf.open_vectors(by_commands / "vectors.vtkhdf")
    np.testing.assert_array_equal(field.velocity, written_field.velocity)
    np.testing.assert_array_equal(field.uncertainty_voxel, written_field.uncertainty_voxel)
    # Plain arrays with the settings in the call: the same displacements.
    rig, arrays = lf.load_rig(CONFIG), [volume.array for volume in pair]
    settings = rig.resolved()["correlation"] | {"exponent": 0.5}
    plain = lf.correlate(*arrays, voxel_mm=pair[0].grid.spacing_mm, **settings)
    np.testing.assert_array_equal(plain.displacement_voxel, written_field.displacement_voxel)


@pytest.mark.thorough
def test_rounding_hides_the_level_between_lens_images(by_commands: Path) -> None:
    weights = lf.open_weights(by_commands / "weights.h5")
    bench = bench_of(weights, carried_config(weights.provenance, "the weights"), image("dark"), None)
    # With a twelfth of the gain: noise of half a count.
    coarse = np.rint(light(image("pair_a"), image("dark"), None) / 12.0)
    haze, error = bench.haze_in(coarse, np.zeros((448, 600), np.bool_))
    assert haze is None
    assert ROUNDING_COUNTS <= error < 0.5


@pytest.mark.thorough
def test_pixels_behind_specks_take_no_part(by_commands: Path) -> None:
    content = lf.open_weights(by_commands / "weights.h5")
    shadowed = np.zeros((448, 600), np.bool_)
    shadowed[200:206, 300:308] = True
    calibration = replace(content.weights.calibration, shadowed=shadowed)
    content = replace(content, weights=replace(content.weights, calibration=calibration))
    bench = bench_of(content, carried_config(content.provenance, "the weights"), None, None)
    np.testing.assert_array_equal(bench.lasting, shadowed)
    assert bench.excluded[203, 304]


@pytest.mark.thorough
def test_particles_and_tracks_are_those_of_the_commands(by_commands: Path) -> None:
    weights = lf.open_weights(by_commands / "weights.h5")
    found = [
        lf.find_particles(weights, image(name), dark=image("dark"), mask=corner()) for name in ("pair_a", "pair_b")
    ]
    for points, name in zip(found, ("pair_a", "pair_b"), strict=True):
        written = lf.open_particles(by_commands / "particles" / f"{name}.vtkhdf")
        np.testing.assert_array_equal(points.position_mm, written.position_mm)
        assert points.attributes == written.attributes
        # Those in front of and behind the volume lie before its 30 x 22 microlenses, too.
        before = np.all(np.abs(points.position_mm[:, :2]) <= (1.5, 1.1), axis=1)
        assert points.attributes["particles_per_lens"] == pytest.approx(before.sum() / 660.0, rel=1e-3)
        # A tracer of 0.05 mm before a lens of 0.1 mm; light spreads by one lens in 1.064 mm of water.
        in_focus = before & (np.abs(points.reference.points_to_focal_point(points.position_mm)[:, 2]) < 1.064)
        assert points.attributes["per_lens_in_focus"] == pytest.approx(1.5**2 * in_focus.sum() / 660.0, rel=0.01)
        for array in written.arrays:
            np.testing.assert_array_equal(points.arrays[array], written.arrays[array])
    tracks, written = lf.track(*found), lf.open_tracks(by_commands / "tracks.vtkhdf")
    np.testing.assert_array_equal(tracks.points.position_mm, written.position_mm)
    np.testing.assert_array_equal(tracks.points.arrays["velocity"], written.arrays["velocity"])
    on_grid, written_grid = tracks.vectors()[0], lf.open_vectors(by_commands / "tracks_grid.vtkhdf")
    np.testing.assert_array_equal(on_grid.velocity, written_grid.velocity)
    correlated = lf.open_vectors(by_commands / "vectors.vtkhdf")
    assert lf.combine(correlated, on_grid).field.flag.shape == correlated.flag.shape
    field = lf.fit_field(tracks, correlated)
    known = field.vectors().flag == 0
    assert known.any()
    nodes = on_grid.grid.centres_mm()[known]
    np.testing.assert_allclose(field.at(nodes), field.vectors().velocity[known], rtol=1e-9)
    with pytest.raises(InputError, match="times between frames differ: 0.002 and 0.005 s"):
        lf.fit_field(tracks, replace(correlated, dt_s=0.005))


@pytest.mark.thorough
def test_what_cannot_be_is_refused(by_commands: Path) -> None:
    weights, rig = lf.open_weights(by_commands / "weights.h5"), lf.load_rig(str(CONFIG))
    with pytest.raises(ConfigError, match="iteratoins"):
        lf.reconstruct(weights, image("pair_a"), iteratoins=3)
    with pytest.raises(UsageError, match="find_particles"):
        lf.reconstruct(weights, image("pair_a"), solver="particles")
    with pytest.raises(InputError, match="shape|pixels"):
        lf.reconstruct(weights, image("pair_a")[:-1])
    with pytest.raises(UsageError, match="sensor"):
        lf.calibrate(image("white")[:-1], None, rig)
    with pytest.raises(UsageError, match="voxel_mm"):
        lf.correlate(np.zeros((8, 8, 8)), np.zeros((8, 8, 8)))
    with pytest.raises(UsageError, match="two frames"):
        lf.track(lf.open_particles(by_commands / "particles" / "pair_a.vtkhdf"))


PROMISED = sorted(set(lf.__all__) - {"__version__", "LfpivError", "LfpivWarning"})


@pytest.mark.parametrize("name", PROMISED)
def test_what_is_promised_is_documented(name: str) -> None:
    function = getattr(lf, name)
    words = inspect.getdoc(function) or ""
    assert words.splitlines()[0].endswith((".", ":", ","))
    assert "Raises" in words
    for parameter in inspect.signature(function).parameters.values():
        assert parameter.annotation is not inspect.Parameter.empty
    assert name in pydoc.plain(pydoc.render_doc(lf))
