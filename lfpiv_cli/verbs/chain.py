"""Simulated experiments, from raw images to vectors by the steps that recorded images take (Section 4.2).

Warming up is a small one, in which every step is taken once, so that all kernels are compiled.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files.atomic import write_text
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.verbs.build_weights import BuildWeightsOptions, build_weights_file
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.verbs.correlate import correlate_files
from lfpiv_cli.verbs.reconstruct import ReconstructOptions, reconstruct_files
from lfpiv_cli.verbs.run import run
from lfpiv_cli.verbs.run_steps import RunOptions
from lfpiv_cli.verbs.simulate import (
    board_at,
    frame_names,
    simulate_board,
    simulate_boards,
    simulate_particles,
    simulate_white,
)
from lfpiv_cli.verbs.track import TrackOptions, track_particles

# A corner of the paper's sensor and a thin channel, as small as every step still works on.
RIG = """\
camera:
  main_lens:   {magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}
  microlenses: {focal_length_mm: 0.8, pitch_mm: 0.1, layout: square}
  sensor:      {pixel_um: 5.5, columns: 450, rows: 448, microlens_distance_mm: 0.8, column_axis: x}
media:   {air: 1.0, window: 1.49, fluid: 1.33}
channel: {width_mm: 3.0, wall_mm: 2.0}
board:   {dots: [4, 4], spacing_mm: 0.5, dot_diameter_mm: 0.15, thickness_mm: 0.0}
volume:  {shape_xyz: [20, 20, 28], voxel_mm: 0.1, centre_mm: [0, 0, 0], reference: mid_plane}
reconstruction: {solver: em, iterations: 4}
correlation:    {windows: [16, 10], overlap: 0.5, dt_s: 0.002}
simulation:
  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}
  particles: 80
  particle_diameter_mm: 0.05
  frames: 4
  board_z_mm: 2.2
  distortion_per_mm2: 2.0e-5
  seed: 3
"""
STEPS = 3


def warm_up(*, console: Console = CONSOLE) -> dict[str, Any]:
    """Compile all kernels into numba's folder, by simulating a small experiment and measuring it each way."""
    quiet = Console(quiet=True)
    with tempfile.TemporaryDirectory() as name, console.progress(STEPS, "warm-up") as advance:
        folder = Path(name)
        config = folder / "rig.yaml"
        write_text(config, RIG, overwrite=False)
        for simulate in (simulate_white, simulate_board, simulate_particles):
            simulate(config, folder, console=quiet)
        advance(1)
        images = [folder / frame for frame in frame_names(load_config(config).simulation.frames)]
        recording = RunOptions(
            images=images[:2],
            white=(folder / "white.tif",),
            dark=folder / "dark.tif",
            board=(folder / "board.tif",),
            report=False,
        )
        run(config, folder / "pair", replace(recording, method="both", combine=True), console=quiet)
        advance(1)
        run(config, folder / "sequence", replace(recording, images=images, follow=True), console=quiet)
        advance(1)
    return {"steps": STEPS}


# Boards over the depth of the volume: cubic polynomials need four, a fifth tells how well they fit. They leave this
# share of the depth free at both ends: there may be walls, and boards are tilted.
DLFC_BOARDS = 5
DLFC_MARGIN = 0.05


def simulate_images(config: Path, images: Path, *, overwrite: bool = False, console: Console = CONSOLE) -> None:
    """Simulate all images of the config's experiment, boards at several depths where its weights need them."""
    settings = load_config(config)
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    simulate_white(config, images, **common)
    simulate_particles(config, images, **common)
    if settings.weights.method == "dlfc":
        simulate_boards(config, images, board_depths(settings), **common)
    else:
        simulate_board(config, images, **common)


def board_depths(settings: Config) -> list[float]:
    """Return the depths of the boards that rays are fitted to, from the origin of the volume's coordinates."""
    low, high = settings.grid().bounds_mm(2)
    margin = DLFC_MARGIN * (high - low)
    return [float(depth) for depth in np.linspace(low + margin, high - margin, DLFC_BOARDS).round(2)]


def measure_images(
    config: Path, images: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Path]:
    """Measure the flow in images that `simulate_images` made, calibration included; return the vectors by method."""
    settings, dark = load_config(config), images / "dark.tif"
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    calibration, weights = output / "calibration.h5", output / "weights.h5"
    depths = board_depths(settings) if settings.weights.method == "dlfc" else []
    boards = [images / board_at(depth) for depth in depths] or [images / "board.tif"]
    pictures = CalibrateOptions(white=[images / "white.tif"], dark=dark, board=boards, depth_mm=depths)
    calibrate_snapshot(config, calibration, pictures, **common)
    build_weights_file(config, weights, BuildWeightsOptions(calibration=calibration), **common)
    pair = [images / name for name in frame_names(settings.simulation.frames)[:2]]
    vectors: dict[str, Path] = {}
    for method in settings.flow_methods():
        options = ReconstructOptions(dark=dark)
        if method == "particles":
            options = replace(options, solver="particles", pairing="ab")
        reconstruct_files(weights, pair, output / method, options, **common)
        found = [output / method / f"{image.stem}.vtkhdf" for image in pair]
        if method == "volumes":
            vectors[method] = output / "vectors.vtkhdf"
            correlate_files(found, vectors[method], **common)
        else:
            vectors[method] = output / "tracks_grid.vtkhdf"
            track_particles(found, output / "tracks.vtkhdf", TrackOptions(grid=True), **common)
    return vectors
