"""The whole chain on the shipped sample: raw images to velocity vectors, against the sample's truth."""

from __future__ import annotations

import json
from pathlib import Path

import numba
import numpy as np
import pytest

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError, LimitMissedError, UsageError
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume
from lfpiv_cli.files.weights_file import open_weights
from tests.commands import CONFIG, SAMPLE, run, told


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
    found, true = told(capsys, "calibrate-snapshot", CONFIG, *pictures, "-o", chain / "c.h5"), truth("board")
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
    settings = load_config(CONFIG)
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
    with pytest.raises(LimitMissedError, match="streamwise_mean_error"):
        run("validate", "flow", strict, "--vectors", chain / "vectors.vtkhdf", "-o", tmp_path / "strict", "--json")
    assert json.loads(capsys.readouterr().out)["streamwise_mean_error"] != 0.0
    assert (tmp_path / "strict" / "flow.json").exists()


def test_weights_from_python(chain) -> None:
    weights = open_weights(chain / "weights.h5")
    assert weights.shape == (40, 22, 30)
    assert weights.image_shape == (448, 600)
    assert weights.frame == "rectified"
    rows, columns, share = weights.column(20, 11, 15)
    volume = np.zeros(weights.shape, np.float32)
    volume[20, 11, 15] = 2.0
    image = weights.forward(volume)
    np.testing.assert_allclose(image[rows, columns], 2.0 * share, rtol=1e-5)
    assert share.sum() == pytest.approx(1.0, abs=0.01)


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


@pytest.mark.thorough
def test_volumes_that_do_not_belong_together_are_refused(chain, tmp_path) -> None:
    a, b = (chain / "volumes" / f"pair_{name}.vtkhdf" for name in "ab")
    weights, image = chain / "weights.h5", SAMPLE / "pair_b.tif"
    run("reconstruct", weights, image, "--iterations", 2, "-o", tmp_path / "other.vtkhdf")
    with pytest.raises(InputError, match="another config"):
        run("correlate", a, tmp_path / "other.vtkhdf", "-o", tmp_path / "v.vtkhdf")
    for volumes, message in (((a,), "pairs"), ((a, b, a), "pairs"), ((a, b, a, b), "--pairing")):
        with pytest.raises(UsageError, match=message):
            run("correlate", *volumes, "-o", tmp_path / "v.vtkhdf")


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_every_help_has_an_example(name) -> None:
    assert "Example: lfpiv " + name in (cli.commands[name].help or "")
