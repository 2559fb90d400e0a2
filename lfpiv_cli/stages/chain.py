"""A simulated experiment from raw images to vectors, by the stages that recorded images take (Section 4.2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import Console
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.stages import build_weights, calibrate, correlate, reconstruct, simulate, track

# Boards over the depth of the volume: cubic polynomials need four, a fifth tells how well they fit. They leave this
# share of the depth free at both ends: there may be walls, and boards are tilted.
DLFC_BOARDS = 5
DLFC_MARGIN = 0.05


def run_chain(config: Path, output: Path, overwrite: bool, console: Console) -> dict[str, Path]:
    """Simulate the config's experiment in a folder and measure its flow; return the vectors by their method.

    From raw images with all imperfections on, which every method gets alike, through the same stages and files as
    recorded ones; of a longer sequence, the first two.
    """
    settings, images = load_config(config), output / "images"
    methods = settings.flow_methods()
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    simulate.simulate_white(config=config, output=images, **common)
    simulate.simulate_particles(config=config, output=images, **common)
    weights = _weights(config, settings, images, output, common)
    pair = [images / name for name in simulate.frame_names(settings.simulation.frames)[:2]]
    makers = {"volumes": _by_volumes, "particles": _by_particles}
    return {name: makers[name](weights, pair, output, common) for name in methods}


def _weights(config: Path, settings: Config, images: Path, output: Path, common: dict[str, Any]) -> Path:
    """Simulate the boards, calibrate and build the weights; return their file."""
    calibration, weights = output / "calibration.h5", output / "weights.h5"
    boards, depths = [images / "board.tif"], []
    if settings.weights.method == "dlfc":
        low, high = settings.grid().bounds_mm(2)
        margin = DLFC_MARGIN * (high - low)
        depths = np.linspace(low + margin, high - margin, DLFC_BOARDS).round(2).tolist()
        boards = [images / simulate.board_at(depth) for depth in depths]
        simulate.simulate_boards(config=config, output=images, depth_mm=depths, **common)
    else:
        simulate.simulate_board(config=config, output=images, **common)
    calibrate.calibrate_snapshot(
        config=config,
        white=[images / "white.tif"],
        dark=images / "dark.tif",
        board=boards,
        depth_mm=depths,
        output=calibration,
        picture=None,
        views=None,
        **common,
    )
    build_weights.build_weights(
        config=config, calibration=calibration, method=None, refraction=None, sampling=None, output=weights, **common
    )
    return weights


def _by_volumes(weights: Path, pair: list[Path], output: Path, common: dict[str, Any]) -> Path:
    """Reconstruct both images as volumes and correlate them."""
    vectors = output / "vectors.vtkhdf"
    correlate.correlate(
        volumes=_reconstructed(weights, pair, output / "volumes", None, common),
        config=None,
        dt_s=None,
        windows=None,
        overlap=None,
        pairing=None,
        mask=None,
        ensemble=False,
        derived=False,
        mean=None,
        resume=False,
        output=vectors,
        **common,
    )
    return vectors


def _by_particles(weights: Path, pair: list[Path], output: Path, common: dict[str, Any]) -> Path:
    """Find the particles of both images and follow them."""
    track.track_particles(
        particles=_reconstructed(weights, pair, output / "particles", "particles", common),
        dt_s=None,
        search_voxel=None,
        shortest=None,
        grid=True,
        output=output / "tracks.vtkhdf",
        **common,
    )
    return output / "tracks_grid.vtkhdf"


def _reconstructed(
    weights: Path, pair: list[Path], output: Path, solver: str | None, common: dict[str, Any]
) -> list[Path]:
    """Reconstruct the pair in a folder, by the configured solver where none is named."""
    reconstruct.reconstruct(
        weights=weights,
        images=pair,
        solver=solver,
        iterations=None,
        relaxation=None,
        accelerate=None,
        start=None,
        dark=pair[0].with_name("dark.tif"),
        background=None,
        mask=None,
        pairing="ab" if solver == "particles" else None,
        resume=False,
        keep_going=False,
        output=output,
        **common,
    )
    return [output / f"{image.stem}.vtkhdf" for image in pair]
