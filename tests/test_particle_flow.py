"""From raw images to the vectors of particles at full size: a recorded pair, and a flow with velocity in depth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.cli.main import cli
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, read_points
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.validation.volume import particle_figures

CONFIGS = Path(__file__).parent.parent / "configs"


def run(*arguments: object) -> None:
    cli.main([str(argument) for argument in arguments], standalone_mode=False)


def vectors_of(config: Path, images: Path, folder: Path) -> Path:
    """Calibrate, find particles and follow them in a folder; return the vectors."""
    dark = ("--dark", images / "dark.tif")
    stills = ("--white", images / "white.tif", "--board", images / "board.tif")
    run("calibrate-snapshot", config, *stills, *dark, "-o", folder / "calibration.h5")
    run("build-weights", config, "--calibration", folder / "calibration.h5", "-o", folder / "weights.h5")
    pair = images / "pair_a.tif", images / "pair_b.tif"
    run("reconstruct", folder / "weights.h5", *pair, *dark, "--solver", "particles", "-o", folder / "particles")
    frames = (folder / "particles" / f"pair_{name}.vtkhdf" for name in "ab")
    run("track", *frames, "-o", folder / "tracks.vtkhdf", "--grid")
    return folder / "tracks_grid.vtkhdf"


def figures_of(config: Path, vectors: Path, folder: Path) -> dict[str, float]:
    folder.mkdir(exist_ok=True)
    run("validate", "flow", config, "--vectors", vectors, "-o", folder / "report")
    return json.loads((folder / "report" / "flow.json").read_text())["figures"]


def check_particles(frame: Path, truth: Path, time_s: float) -> None:
    """Hold the particles of the recorded pair to the figures that they reached when this was written."""
    found, true = read_points(frame, PARTICLES_FORMAT), read_particles(truth)
    places = found.reference.points_to_focal_point(found.position_mm)
    moved = true.positions_mm + true.velocities_m_s * 1e3 * time_s
    low, high = np.array([-6.5, -5.0, -5.46]), np.array([6.5, 5.0, 4.53])
    figures = particle_figures(places, moved, low, high, 0.1, np.sqrt(found.arrays["covariance_mm2"][:, :3]))
    assert figures["recall"] > 0.89
    assert figures["precision"] > 0.93
    for axis, spread, bias in (("x", 0.006, 0.001), ("y", 0.006, 0.001), ("z", 0.16, 0.03)):
        assert figures[f"spread_{axis}_voxel"] < spread
        assert abs(figures[f"bias_{axis}_voxel"]) < bias
        # The errors are stated, not scaled to fit: near the focal plane they are still too small.
        assert figures[f"coverage_{axis}"] == pytest.approx(0.95, abs=0.03)


@pytest.mark.slow
def test_a_recorded_pair(data_folder: Path, tmp_path: Path) -> None:
    data = data_folder / "channel"
    vectors = vectors_of(CONFIGS / "channel.yaml", data, tmp_path)
    check_particles(tmp_path / "particles" / "pair_a.vtkhdf", data / "particles.npz", -0.0009)
    figures = figures_of(CONFIGS / "channel.yaml", vectors, tmp_path)
    # Measured 0.0057, 0.0014 and 0.050 voxel, 0.002 % and 99.5 %.
    for name, limit in (("u", 0.01), ("v", 0.005), ("w", 0.08)):
        assert figures[f"rms_{name}_voxel"] < limit
    assert abs(figures["streamwise_mean_error"]) < 0.001
    assert figures["within_25_percent_streamwise"] > 0.999
    assert figures["within_25_percent_vector"] > 0.99

    pair, dark = (data / "pair_a.tif", data / "pair_b.tif"), ("--dark", data / "dark.tif")
    run("reconstruct", tmp_path / "weights.h5", *pair, *dark, "-o", tmp_path / "volumes")
    volumes = (tmp_path / "volumes" / f"pair_{name}.vtkhdf" for name in "ab")
    run("correlate", *volumes, "-o", tmp_path / "vectors.vtkhdf")
    run("combine", tmp_path / "vectors.vtkhdf", vectors, "-o", tmp_path / "combined.vtkhdf")
    combined = figures_of(CONFIGS / "channel.yaml", tmp_path / "combined.vtkhdf", tmp_path / "of_both")
    # Twelve times as noisy and more, the correlation adds next to nothing, and must not take anything away.
    for name in "uvw":
        assert combined[f"rms_{name}_voxel"] < 1.01 * figures[f"rms_{name}_voxel"]
    assert combined["within_25_percent_vector"] >= figures["within_25_percent_vector"] - 0.001


@pytest.mark.slow
def test_a_flow_with_velocity_in_depth(tmp_path: Path) -> None:
    config, images = CONFIGS / "rotation.yaml", tmp_path / "images"
    for kind in ("white", "board", "particles"):
        run("simulate", kind, config, "-o", images)
    figures = figures_of(config, vectors_of(config, images, tmp_path), tmp_path)
    # Measured 1.0002, 1.0001 and 99.4 %; nothing moves along y.
    assert figures["slope_u"] == pytest.approx(1.0, abs=0.01)
    assert figures["slope_w"] == pytest.approx(1.0, abs=0.02)
    assert figures["within_25_percent_vector"] > 0.99
