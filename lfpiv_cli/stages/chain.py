"""A simulated experiment from raw images to vectors, by the stages that recorded images take (Section 4.2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.stages import build_weights, calibrate, correlate, reconstruct, simulate, track

# Boards over the depth of the volume: cubic polynomials need four, a fifth tells how well they fit. They leave this
# share of the depth free at both ends: there may be walls, and boards are tilted.
DLFC_BOARDS = 5
DLFC_MARGIN = 0.05


def run_chain(config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE) -> dict[str, Path]:
    """Simulate the config's experiment in a folder and measure its flow; return the vectors by their method.

    From raw images with all imperfections on, which every method gets alike, through the same stages and files as
    recorded ones; of a longer sequence, the first two.
    """
    images = output / "images"
    simulate_images(config, images, overwrite=overwrite, console=console)
    return measure_images(config, images, output, overwrite=overwrite, console=console)


def simulate_images(config: Path, images: Path, *, overwrite: bool = False, console: Console = CONSOLE) -> None:
    """Simulate all images of the config's experiment, boards at several depths where its weights need them."""
    settings = load_config(config)
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    simulate.simulate_white(config, images, **common)
    simulate.simulate_particles(config, images, **common)
    if settings.weights.method == "dlfc":
        simulate.simulate_boards(config, images, board_depths(settings), **common)
    else:
        simulate.simulate_board(config, images, **common)


def measure_images(
    config: Path, images: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Path]:
    """Measure the flow in images that `simulate_images` made, calibration included; return the vectors by method."""
    settings = load_config(config)
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    weights = _weights(config, settings, images, output, common)
    pair = [images / name for name in simulate.frame_names(settings.simulation.frames)[:2]]
    makers = {"volumes": _by_volumes, "particles": _by_particles}
    return {name: makers[name](weights, pair, output, common) for name in settings.flow_methods()}


def board_depths(settings: Config) -> list[float]:
    """Return the depths of the boards that rays are fitted to, from the origin of the volume's coordinates."""
    low, high = settings.grid().bounds_mm(2)
    margin = DLFC_MARGIN * (high - low)
    return [float(depth) for depth in np.linspace(low + margin, high - margin, DLFC_BOARDS).round(2)]


def _weights(config: Path, settings: Config, images: Path, output: Path, common: dict[str, Any]) -> Path:
    """Calibrate and build the weights; return their file."""
    calibration, weights = output / "calibration.h5", output / "weights.h5"
    boards, depths = [images / "board.tif"], []
    if settings.weights.method == "dlfc":
        depths = board_depths(settings)
        boards = [images / simulate.board_at(depth) for depth in depths]
    pictures = calibrate.CalibrateOptions(
        white=[images / "white.tif"], dark=images / "dark.tif", board=boards, depth_mm=depths
    )
    calibrate.calibrate_snapshot(config, calibration, pictures, **common)
    build_weights.build_weights(config, weights, build_weights.BuildWeightsOptions(calibration=calibration), **common)
    return weights


def _by_volumes(weights: Path, pair: list[Path], output: Path, common: dict[str, Any]) -> Path:
    """Reconstruct both images as volumes and correlate them."""
    options = reconstruct.ReconstructOptions(dark=pair[0].with_name("dark.tif"))
    volumes = _reconstructed(weights, pair, output / "volumes", options, common)
    correlate.correlate(volumes, output / "vectors.vtkhdf", **common)
    return output / "vectors.vtkhdf"


def _by_particles(weights: Path, pair: list[Path], output: Path, common: dict[str, Any]) -> Path:
    """Find the particles of both images and follow them."""
    options = reconstruct.ReconstructOptions(solver="particles", pairing="ab", dark=pair[0].with_name("dark.tif"))
    particles = _reconstructed(weights, pair, output / "particles", options, common)
    track.track_particles(particles, output / "tracks.vtkhdf", track.TrackOptions(grid=True), **common)
    return output / "tracks_grid.vtkhdf"


def _reconstructed(
    weights: Path,
    pair: list[Path],
    output: Path,
    options: reconstruct.ReconstructOptions,
    common: dict[str, Any],
) -> list[Path]:
    """Reconstruct the pair in a folder; return the files."""
    reconstruct.reconstruct(weights, pair, output, options, **common)
    return [output / f"{image.stem}.vtkhdf" for image in pair]
